"""Build the core from its sources: one library for this machine or another, or WebAssembly.

Every source is compiled once, `level.cpp` once per processor level with that level's flags. Compiled here is by the system's C++20
compiler where one is found, else by the Python package ziglang, which also makes WebAssembly and the libraries of other
platforms. Objects are kept in build/core under the hash of everything that goes into them. Needs nothing but Python.

    python core/build.py                          library for this machine, into src/echospline/_native
    python core/build.py wasm                     echospline.wasm, into src/echospline/_native
    python core/build.py strict                   every object with warnings as errors; nothing is installed
    python core/build.py library --target windows-x86_64 --output out/

ECHOSPLINE_STRICT=1 makes warnings errors everywhere: `make` sets it, so that `make check` compiles nothing twice.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CACHE = ROOT / "build" / "core"
NATIVE = ROOT / "src" / "echospline" / "_native"
ZIG = "ziglang==0.17.1"  # also in pyproject's dev group

FLAGS = [
    "-std=c++20",
    "-O3",
    "-fno-exceptions",
    "-fno-rtti",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
    "-fvisibility=hidden",
    "-DECHOSPLINE_BUILD",
]
WARNINGS = ["-Wall", "-Wextra", "-Werror"]
# psabi: vectors wider than the plain level's registers are arguments of inlined functions alone. format-security: formats of
# messages are literals that pass through one function.
QUIET = ["-Wno-psabi", "-Wno-format-security"]
LEVELS = {  # architecture: {level: processor that its code may assume, as g++ and clang write it}
    "x86_64": {"baseline": "x86-64", "avx2": "x86-64-v3", "avx512": "x86-64-v4"},
    "aarch64": {"neon": ""},
    "wasm32": {"simd128": ""},
}
WIDE = {"avx512": ["-mprefer-vector-width=512"]}


class BuildError(Exception):
    """The core cannot be built; the message says what to do."""


@dataclass(frozen=True)
class Target:
    """What is built: processor, file name of the library, triple for zig (None: this machine), tag of a wheel."""

    architecture: str
    library: str
    triple: str | None = None
    wheel_tag: str = ""

    @property
    def levels(self) -> dict[str, str]:
        """Levels of the architecture; a processor that is not listed has the plain level alone."""
        return LEVELS.get(self.architecture, {"baseline": ""})


TARGETS = {
    "linux-x86_64": Target(
        "x86_64", "libechospline.so", "x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64.manylinux2014_x86_64"
    ),
    "linux-aarch64": Target(
        "aarch64",
        "libechospline.so",
        "aarch64-linux-gnu.2.17",
        "manylinux_2_17_aarch64.manylinux2014_aarch64",
    ),
    "macos-arm64": Target("aarch64", "libechospline.dylib", "aarch64-macos.11.0", "macosx_11_0_arm64"),
    "macos-x86_64": Target("x86_64", "libechospline.dylib", "x86_64-macos.11.0", "macosx_11_0_x86_64"),
    "windows-x86_64": Target("x86_64", "echospline.dll", "x86_64-windows-gnu", "win_amd64"),
}
WASM = Target("wasm32", "echospline.wasm", "wasm32-wasi")


def this_machine() -> Target:
    """Target of the running interpreter."""
    machine = platform.machine().lower()
    architecture = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    if sys.maxsize < 2**32 and architecture == "x86_64":
        architecture = "x86"  # a 32-bit interpreter
    tag = re.sub(r"[-.]", "_", sysconfig.get_platform())
    if sys.platform == "darwin":
        tag = f"macosx_11_0_{'arm64' if architecture == 'aarch64' else architecture}"
        return Target(architecture, "libechospline.dylib", wheel_tag=tag)
    return Target(
        architecture, "echospline.dll" if sys.platform == "win32" else "libechospline.so", wheel_tag=tag
    )


@dataclass(frozen=True)
class Compiler:
    """Commands that compile and link, and a text that differs where their output might."""

    compile: tuple[str, ...]
    link: tuple[str, ...]
    identity: str
    is_zig: bool = False
    warnings: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """First line of what the compiler says of itself."""
        return self.identity.splitlines()[0]


PROBE = """
#include <cmath>
#include <cstdint>
template <class T> concept Number = requires(T a) { a + a; };
typedef float Floats __attribute__((vector_size(WIDTH)));
typedef int32_t Ints __attribute__((vector_size(WIDTH)));
template <Number T> T twice(T a) { return a + a; }
extern "C" void probe(const Floats* a, Ints* b) { *b = __builtin_convertvector(twice(*a), Ints) + (*a < std::sqrt((*a)[0])); }
"""


def _builds(command: Sequence[str], target: Target) -> bool:
    """Whether a compiler turns C++20 with vectors of every level into a library."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "probe.cpp")
        source.write_text(PROBE)
        for level, processor in target.levels.items():
            flags = [f"-march={processor}"] if processor else []
            width = {"avx512": 64, "avx2": 32}.get(level, 16)
            output = Path(folder, "probe.bin")
            line = [
                *command,
                *FLAGS,
                *QUIET,
                *flags,
                *WIDE.get(level, []),
                f"-DWIDTH={width}",
                "-fPIC",
                "-shared",
            ]
            run = subprocess.run([*line, str(source), "-o", str(output)], capture_output=True, check=False)
            if run.returncode != 0:
                return False
    return True


@functools.cache
def system_compiler() -> Compiler | None:
    """First of $CXX, c++, g++ and clang++ that builds what the core needs; none on Windows, where zig does it."""
    if sys.platform == "win32":
        return None
    for name in (os.environ.get("CXX"), "c++", "g++", "clang++"):
        command = shlex.split(name or "")
        if command and shutil.which(command[0]) and _builds(command, this_machine()):
            version = subprocess.run(
                [*command, "--version"], capture_output=True, text=True, check=False
            ).stdout
            return Compiler(tuple(command), tuple(command), version)
    return None


def zig() -> Compiler | None:
    """The Python package ziglang, where it is installed."""
    if importlib.util.find_spec("ziglang") is None:
        return None
    command = (sys.executable, "-m", "ziglang")
    identity = f"ziglang {importlib.metadata.version('ziglang')}"
    return Compiler((*command, "c++"), (*command, "cc"), identity, is_zig=True)


def compiler_for(target: Target) -> Compiler:
    """Compiler that builds a target."""
    found = (None if target.triple else system_compiler()) or zig()
    if found is None:
        what = "WebAssembly needs" if target is WASM else "building the core for another platform needs"
        if not target.triple:
            what = "the core needs a C++20 compiler (g++ 11, clang 14 or newer, found by $CXX, c++, g++ or clang++) or"
        raise BuildError(f"{what} the Python package ziglang; run: {sys.executable} -m pip install {ZIG}")
    return found


def _target_flags(compiler: Compiler, target: Target) -> list[str]:
    if not compiler.is_zig:
        return ["-fPIC", *(["-mmacosx-version-min=11.0"] if sys.platform == "darwin" else [])]
    triple = (
        target.triple
        or f"{target.architecture}-{ {'win32': 'windows-gnu', 'darwin': 'macos.11.0'}.get(sys.platform, 'linux') }"
    )
    if not target.triple and sys.platform.startswith("linux"):
        triple = f"{target.architecture}-linux-{'gnu' if platform.libc_ver()[0] == 'glibc' else 'musl'}"
    return ["-target", triple, *([] if target.library.endswith((".dll", ".wasm")) else ["-fPIC"])]


def _processor_flags(compiler: Compiler, target: Target, level: str) -> list[str]:
    """Flags of a level; zig would otherwise assume the processor that it runs on."""
    processor = target.levels[level]
    if target is WASM:
        return ["-mcpu=generic+simd128"]
    if compiler.is_zig:
        return [f"-mcpu={processor.replace('-', '_') or 'baseline'}", *WIDE.get(level, [])]
    return [*([f"-march={processor}"] if processor else []), *WIDE.get(level, [])]


def sources() -> list[Path]:
    """Sources that are compiled once, by name."""
    return sorted(path for path in (ROOT / "core" / "src").glob("*.cpp") if path.name != "level.cpp")


def functions() -> list[str]:
    """Names of the C interface's functions, in the headers' order."""
    folder = ROOT / "core" / "include" / "echospline"
    text = "".join(
        (folder / name).read_text(encoding="utf-8") for name in ("echospline.h", "green.h", "space.h")
    )
    return re.findall(r"^ECHOSPLINE_API[^;(]*?\b(echospline_\w+)\(", text, flags=re.MULTILINE)


@functools.cache
def _headers() -> bytes:
    folders = (ROOT / "core" / "include" / "echospline", ROOT / "core" / "src")
    paths = sorted(path for folder in folders for path in folder.iterdir() if path.suffix in {".h", ".hpp"})
    return b"".join(path.name.encode() + b"\0" + path.read_bytes() for path in paths)


def _run(command: Sequence[str]) -> None:
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode != 0:
        raise BuildError(f"{shlex.join(command)}\n{run.stdout}{run.stderr}")
    if run.stderr.strip():
        print(run.stderr.rstrip(), file=sys.stderr)


def _kept(key: Sequence[object], name: str) -> tuple[Path, Path]:
    """Where a file made from `key` is kept, and a name beside it to write it under."""
    digest = hashlib.sha256("\0".join(map(str, key)).encode())
    folder = CACHE / digest.hexdigest()[:20]
    folder.mkdir(parents=True, exist_ok=True)
    return folder / name, folder / f"new-{os.getpid()}-{name}"


def _objects(compiler: Compiler, target: Target, extra: Sequence[str]) -> list[tuple[Path, list[str]]]:
    """Every object with the command that makes it, without its output."""
    plain = next(iter(target.levels))
    jobs = [(path.stem, path, plain, []) for path in sources()]
    level_source = ROOT / "core" / "src" / "level.cpp"
    jobs += [(f"level_{name}", level_source, name, [f"-DECHOSPLINE_LEVEL={name}"]) for name in target.levels]
    warnings = WARNINGS if os.environ.get("ECHOSPLINE_STRICT") else []
    common = [*compiler.compile, *FLAGS, *warnings, *QUIET, *extra, *_target_flags(compiler, target)]
    headers = hashlib.sha256(_headers()).hexdigest()
    result = []
    for name, source, level, defined in jobs:
        flags = [*common, *_processor_flags(compiler, target, level), *defined]
        content = hashlib.sha256(source.read_bytes()).hexdigest()
        path, _ = _kept((compiler.identity, flags[1:], headers, source.name, content), f"{name}.o")
        result.append((path, [*flags, "-c", str(source.relative_to(ROOT))]))
    return result


def objects(compiler: Compiler, target: Target, extra: Sequence[str] = ()) -> list[Path]:
    """Compile every object that is not kept from before, several at a time."""

    def compiled(job: tuple[Path, list[str]]) -> Path:
        path, command = job
        if not path.exists():
            new = path.with_name(f"new-{os.getpid()}-{path.name}")
            _run([*command, "-o", str(new)])
            new.replace(path)
        return path

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(compiled, _objects(compiler, target, extra)))


def _link_flags(compiler: Compiler, target: Target) -> list[str]:
    if target is WASM:
        exported = [f"-Wl,--export={name}" for name in (*functions(), "malloc", "free")]
        return ["-mexec-model=reactor", "-Wl,--gc-sections", "-Wl,-z,stack-size=1048576", "-s", *exported]
    flags = ["-shared"]
    if target.library.endswith(".so"):
        flags += ["-s", "-Wl,-z,defs", "-Wl,--as-needed", "-Wl,-soname,libechospline.so"]
    elif target.library.endswith(".dylib"):
        flags += ["-Wl,-install_name,@rpath/libechospline.dylib", *(["-s"] if compiler.is_zig else [])]
    else:
        flags += ["-s"]
    return [*flags, *([] if target.library.endswith(".dll") else ["-lm"])]


def build(target: Target, compiler: Compiler | None = None) -> Path:
    """Library of a target, or WebAssembly, in build/core; quick when nothing has changed."""
    begin = time.monotonic()
    compiler = compiler or compiler_for(target)
    made = objects(compiler, target)
    flags = [*_target_flags(compiler, target), *_processor_flags(compiler, target, next(iter(target.levels)))]
    flags += _link_flags(compiler, target)
    path, new = _kept((compiler.identity, flags, *made), target.library)
    if not path.exists():
        with tempfile.TemporaryDirectory(
            dir=path.parent
        ) as folder:  # a linker may leave files beside its output
            output = Path(folder, target.library)
            _run([*compiler.link, *map(str, made), *flags, "-o", str(output)])
            if target is WASM:
                check_wasm(output)
            output.replace(new)
        new.replace(path)
    if target is WASM:
        install(path, CACHE / f"wasm-{_sources_digest()}")
    seconds = time.monotonic() - begin
    levels = ", ".join(target.levels)
    print(
        f"core: {target.library} for {target.triple or target.architecture} ({levels}) by {compiler.name}:"
        f" {path.stat().st_size / 1000:.0f} kB, {seconds:.1f} s",
        file=sys.stderr,
    )
    return path


def _sources_digest() -> str:
    """Hash of everything that WebAssembly is made from."""
    texts = [path.read_bytes() for path in (*sources(), ROOT / "core" / "src" / "level.cpp", Path(__file__))]
    return hashlib.sha256(b"\0".join([*texts, _headers(), ZIG.encode()])).hexdigest()[:20]


def kept_wasm() -> Path | None:
    """WebAssembly built before from the same sources, if it is still here; zig is not needed for that."""
    path = CACHE / f"wasm-{_sources_digest()}" / WASM.library
    return path if path.exists() else None


def wasm_imports(data: bytes) -> list[str]:
    """Names that a WebAssembly module asks of its host."""

    def number() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    def text() -> str:
        nonlocal at
        count = number()
        at += count
        return data[at - count : at].decode()

    at = 8
    while at < len(data):
        section = data[at]
        at += 1
        size = number()
        if section != 2:
            at += size
            continue
        names = []
        for _ in range(number()):
            names.append(f"{text()}.{text()}")
            kind = data[at]
            at += 1
            if kind != 0:
                raise BuildError(f"{names[-1]} is imported and is no function")
            number()
        return names
    return []


def check_wasm(path: Path) -> None:
    """Refuse WebAssembly that needs anything from its host."""
    if names := wasm_imports(path.read_bytes()):
        raise BuildError(f"echospline.wasm must import nothing; it imports {', '.join(names)}")


def install(path: Path, folder: Path) -> None:
    """Copy a built file; a program that has loaded the one before keeps it."""
    folder.mkdir(parents=True, exist_ok=True)
    new = folder / f"new-{os.getpid()}-{path.name}"
    shutil.copyfile(path, new)
    new.replace(folder / path.name)


def main() -> int:
    """Build what the command line asks for."""
    parser = argparse.ArgumentParser(
        description="Build the core: library, WebAssembly, or every object with warnings as errors."
    )
    parser.add_argument("what", nargs="?", choices=("library", "wasm", "strict"), default="library")
    parser.add_argument(
        "--target", choices=sorted(TARGETS), help="another platform, built by zig; default: this machine"
    )
    parser.add_argument("--output", type=Path, default=NATIVE, help="folder for the result")
    arguments = parser.parse_args()
    target = TARGETS[arguments.target] if arguments.target else this_machine()
    try:
        if arguments.what == "strict":
            os.environ["ECHOSPLINE_STRICT"] = "1"
            objects(compiler_for(target), target)
        else:
            install(build(WASM if arguments.what == "wasm" else target), arguments.output)
    except BuildError as error:
        print(f"core: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
