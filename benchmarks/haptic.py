"""1 kHz for a minute beside a busy process: a loop in C against one in Python, in turns of the same run.

    python benchmarks/haptic.py [--seconds 60] [--turns 6] [--pin]

The C loop is core/hosts/c/main.c, compiled here; the Python loop makes the same motion by the public model. Each turn runs the one and then
the other for its share of the seconds. `--pin` puts both and the busy process on one processor. Printed: quantiles of the step's own time,
from pose to mesh displacement, median over the turns; their ratio; and what the C loop allocated, which has to be nothing.
"""

import argparse
import json
import multiprocessing as mp
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from echospline import _native as core
from echospline.live import Command, follow
from echospline.mechanics import TPSModel, describe_core
from echospline.scene import NeedlePose, RegularGrid

ROOT = Path(__file__).resolve().parent.parent
PERIOD, LAG, FASTEST = 1e-3, 0.08, 20.0
IN, OUT = Command((8.0, 0.0), (26.0, 18.0)), Command((8.0, 0.0), (9.0, 1.0))
LEVELS = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}


def compiled(folder):
    """The C host, linked to the package's library."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        sys.exit("a C compiler is needed for the C loop: install one")
    library, program = Path(core.__file__).parent / core.FILE, Path(folder) / "host"
    include, source = ROOT / "core" / "include", ROOT / "core" / "hosts" / "c" / "main.c"
    command = [compiler, "-O2", "-std=c17", "-I", include, source, library, f"-Wl,-rpath,{library.parent}"]
    subprocess.run([*command, "-lm", "-o", program], check=True)
    return program


def in_c(program, seconds):
    """Quantiles of the C loop's steps in microseconds, and what it allocated."""
    command = [program, str(seconds), str(round(1 / PERIOD))]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = {name: float(re.search(rf"{re.escape(name)} ([0-9.]+)", text)[1]) for name in LEVELS}
    return found, int(re.search(r"allocations in the loop (\d+)", text)[1])


def in_python(seconds):
    """Microseconds of every step of the same motion by the public model."""
    model = TPSModel(RegularGrid((40, 30), (40 / 39, 30 / 29)))
    state, pose, took = model.rest(), NeedlePose((8.0, 0.0), (9.0, 1.0)), []
    begin = time.perf_counter()
    for i in range(round(seconds / PERIOD)):
        rest = begin + i * PERIOD - time.perf_counter()
        if rest > 0:
            time.sleep(rest)
        pose = follow(pose, IN if i * PERIOD % 4.0 < 2.0 else OUT, PERIOD, LAG, FASTEST)
        start = time.perf_counter()
        state = model.advance(state, pose, PERIOD)
        model.displacement(state)
        took.append(time.perf_counter() - start)
    assert model.native.statistics.allocations == 0
    quantiles = 1e6 * np.quantile(took, list(LEVELS.values()))
    return dict(zip(LEVELS, quantiles.tolist(), strict=True))


def busy():
    while True:
        np.sin(np.arange(1000.0)).sum()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--turns", type=int, default=6)
    parser.add_argument("--pin", action="store_true")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    if given.pin:
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    share, of_c, of_python, allocated = given.seconds / given.turns, [], [], 0
    in_python(1.0)  # everything is loaded
    neighbour = mp.get_context("spawn").Process(target=busy, daemon=True)
    neighbour.start()
    try:
        with tempfile.TemporaryDirectory() as folder:
            program = compiled(folder)
            for _ in range(given.turns):
                quantiles, blocks = in_c(program, share)
                allocated += blocks
                of_c.append(quantiles)
                of_python.append(in_python(share))
    finally:
        neighbour.terminate()
    rows = {
        host: {name: float(np.median([turn[name] for turn in turns])) for name in LEVELS}
        for host, turns in (("C", of_c), ("Python", of_python))
    }
    rows["C / Python"] = {name: rows["C"][name] / rows["Python"][name] for name in LEVELS}
    if given.json:
        print(json.dumps({"core": describe_core(), "allocations": allocated, "us": rows}, indent=1))
        return
    print(
        "core {version}, level {level}, 1200 nodes, 1 kHz, ".format(**describe_core())
        + f"{given.seconds:g} s each in {given.turns} turns"
    )
    for name, row in rows.items():
        print(f"{name:10} " + "  ".join(f"{level} {value:8.2f}" for level, value in row.items()))
    print(f"allocations of the C loop: {allocated}; load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
