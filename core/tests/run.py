"""Compile and run the core's own tests: every test_*.c and test_*.cpp in this folder is a program that returns 0.

python core/tests/run.py                    all of them
python core/tests/run.py --sanitize         under the address and undefined behaviour sanitizers, and a short fuzz
python core/tests/run.py --fuzz 60          random misuse of the C interface for 60 s, sanitizers on
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER.parent))
import build  # noqa: E402

# Sanitizers cost most in what the compiler would otherwise fold away: -O1 keeps both builds and runs short.
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1"]
OPTIONS = {  # memory that is not there is a status of the interface, so malloc has to return NULL
    "ASAN_OPTIONS": "allocator_may_return_null=1:max_allocation_size_mb=2000:detect_leaks=1",
    "UBSAN_OPTIONS": "print_stacktrace=1",
}
LANGUAGES = {".c": ["-x", "c", "-std=c17"], ".cpp": ["-x", "c++", "-std=c++20"]}


def program(
    source: Path, folder: Path, objects: Sequence[Path], extra: Sequence[str], language: str = ""
) -> Path:
    """Compile a test against the core's objects."""
    compiler = build.compiler_for(build.this_machine())
    language = language or source.suffix
    path = folder / f"{source.stem}{language.replace('.', '_')}"
    strict = [*LANGUAGES[language], *build.WARNINGS, "-pedantic", "-Wno-psabi", "-Wno-attributes"]
    command = [
        *compiler.compile,
        *strict,
        *extra,
        "-DECHOSPLINE_STATIC",
        "-I",
        str(FOLDER.parent / "include"),
    ]
    command += [str(source), "-x", "none", *map(str, objects), "-lm", "-o", str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode != 0:
        raise build.BuildError(f"{source.name}: {run.stdout}{run.stderr}")
    return path


def passes(path: Path, *arguments: str) -> bool:
    """Run a program and say how it ended."""
    begin = time.monotonic()
    run = subprocess.run(
        [path, *arguments], capture_output=True, text=True, check=False, env={**os.environ, **OPTIONS}
    )
    print(
        f"{'ok  ' if run.returncode == 0 else 'FAIL'} {path.name} {time.monotonic() - begin:.1f} s {run.stdout.strip()}"
    )
    if run.returncode != 0:
        before = run.stderr.rfind("\nseed ") + 1  # the fuzzer writes every seed; the last one failed
        print(run.stderr[before:][-8000:])
    return run.returncode == 0


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description="Compile and run the core's own tests.")
    parser.add_argument("--sanitize", action="store_true", help="address and undefined behaviour sanitizers")
    parser.add_argument("--fuzz", type=float, metavar="SECONDS", help="only the fuzzer, sanitizers on")
    parser.add_argument(
        "--seed", type=int, default=1, help="first seed of the fuzzer, to repeat what it found"
    )
    arguments = parser.parse_args()
    extra = SANITIZERS if arguments.sanitize or arguments.fuzz else []
    tests = sorted(path for path in FOLDER.glob("test_*") if path.suffix in LANGUAGES)
    try:
        target = build.this_machine()
        objects = build.objects(build.compiler_for(target), target, extra)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            if arguments.fuzz:
                fuzz = program(FOLDER / "fuzz.cpp", folder, objects, extra)
                return 0 if passes(fuzz, str(arguments.fuzz), str(arguments.seed)) else 1
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                programs = list(pool.map(lambda test: program(test, folder, objects, extra), tests))
            programs.append(program(FOLDER / "test_header.c", folder, objects, extra, ".cpp"))
            results = [passes(path) for path in programs]
            results.append(passes(program(FOLDER / "fuzz.cpp", folder, objects, extra), "5"))
            return 0 if all(results) else 1
    except build.BuildError as error:
        print(f"core: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
