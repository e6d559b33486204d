"""Rate and memory of dataset making: in one process, then with two workers.

    pip install 'echospline[dataset,distributed]'
    python benchmarks/dataset.py --out out/dataset_rate --n 12

Samples of 8 frames of 400 x 400 pixels, finite elements on 40 x 30 nodes. Memory is the peak resident size of the
process that makes the samples, after the first and after the last: it must not grow with their number.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from importlib.resources import as_file, files
from pathlib import Path

from echospline.scenario import load
from echospline.study import Task, create_store, make_sample, sweep


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/dataset_rate"))
    parser.add_argument("--n", type=int, default=12)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    results = {}
    with as_file(files("echospline").joinpath("data", "dataset.toml")) as base:
        one = args.out / "one.zarr"
        create_store(one, load(base), args.n, 8, 0, ["dataset.toml"])
        peak = []
        make_sample(store=str(one), bases=[str(base)], index=0, seed=0, frames=8)  # loads
        wall, used = time.perf_counter(), time.process_time()
        for i in range(args.n):
            make_sample(store=str(one), bases=[str(base)], index=i, seed=0, frames=8)
            peak.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
        results["one process"] = {
            "samples per second": args.n / (time.perf_counter() - wall),
            "processor seconds per sample": (time.process_time() - used) / args.n,
            "peak MiB after the first and the last": [peak[0], peak[-1]],
        }
        print(results["one process"], flush=True)
        many = args.out / "many.zarr"
        create_store(many, load(base), args.n, 8, 0, ["dataset.toml"])
        tasks = [
            Task(f"{i:07d}", {"store": str(many), "bases": [str(base)], "index": i, "seed": 0, "frames": 8})
            for i in range(args.n)
        ]
        wall = time.perf_counter()
        sweep(make_sample, tasks, many / "tasks", workers=args.workers)
        results[f"{args.workers} workers, start included"] = {
            "samples per second": args.n / (time.perf_counter() - wall)
        }
        print(results)
    (args.out / "rate.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
