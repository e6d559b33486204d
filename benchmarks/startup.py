"""Start-up: processor time and peak memory of whole processes, the least of ten; `--against SRC` takes turns with another tree."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
PICTURE = HERE / "src" / "echospline" / "data" / "calf.png"
CASES = {
    "python itself": ["-c", "pass"],
    "import numpy": ["-c", "import numpy"],
    "import echospline": ["-c", "import echospline"],
    "echospline --help": ["-m", "echospline", "--help"],
    "simulate --help": ["-m", "echospline", "simulate", "--help"],
    "a mistyped command": ["-m", "echospline", "simulat"],
    "a mistyped option": ["-m", "echospline", "simulate", "--angl", "3"],
    "a file that is missing": ["-m", "echospline", "simulate", "missing.png"],
    "a value out of range": ["-m", "echospline", "simulate", "sample:calf", "--angle", "1000"],
    "info of a PNG": ["-m", "echospline", "info", str(PICTURE)],
    "the first frame": [
        "-c",
        "import echospline as es; i = es.sample_image(); m = es.TPSModel(es.RegularGrid.covering(i.grid, (40, 30)));"
        "next(iter(es.simulate(i, es.Insertion.straight((8.0, 0.0), 45.0, 30.0), m)))",
    ],
}


def cost(words: list[str], source: Path, folder: str) -> tuple[float, float]:
    """Run one process; return its processor time in s and its peak memory in MB."""
    plain = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, *words], env=plain, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as run:
        _, _, used = os.wait4(run.pid, 0)
        run.returncode = 0
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="another src folder, measured in turn")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--only", nargs="*", default=list(CASES), metavar="CASE", help="by name")
    given = parser.parse_args()
    sources = [HERE / "src", *([given.against.resolve()] if given.against else [])]
    print("| whole process | processor time, s | peak memory, MB |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, words in ((name, CASES[name]) for name in given.only):
            found: list[list[tuple[float, float]]] = [[] for _ in sources]
            for turn in range(given.runs + 1):  # the first fills caches and is not counted
                for k, source in enumerate(sources):
                    measured = cost(words, source, folder)
                    if turn:
                        found[k].append(measured)
            least = [tuple(min(column) for column in zip(*rows, strict=True)) for rows in reversed(found)]
            print(
                f"| {name} | {', '.join(f'{t:.2f}' for t, _ in least)} | {', '.join(f'{m:.0f}' for _, m in least)} |"
            )


if __name__ == "__main__":
    main()
