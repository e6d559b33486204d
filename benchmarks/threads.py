"""Scenes in threads of one Python process: steps per second of each, 1, 2 and 24 of them.

    python benchmarks/threads.py [--seconds 3] [--rounds 5]

Each thread has a model of its own and steps as fast as it can. The core's calls release the interpreter's lock; what is left of
a step is Python's and is not shared. `core` makes the two calls of a step alone, `model` the whole of it, with its state as a value. The
limit is two processes of one scene each, which share nothing but the machine: on a busy one they do not get twice as far either. All take
turns in each round, so that a busy neighbour meets all of them; medians over the rounds are printed, and how many processors' worth of
time was used.
"""

import argparse
import json
import multiprocessing as mp
import os
import threading
from itertools import cycle
from time import perf_counter, process_time

import numpy as np

from echospline import _native as core
from echospline.mechanics import Elastic, ThinPlate, describe_core
from echospline.study.bench import MESHES, PERIOD, path, scene

COUNTS = (1, 2, 24)


def of_core(model, poses):
    """One step by the core's calls alone."""
    library, tissue, pose = core.library(), model.native._tissue, core.Pose(dt=PERIOD)
    mesh = np.empty((model.grid.size, 2), np.float32)
    endless = cycle(poses)
    entry, tip = pose.entry, pose.tip

    def step():
        p = next(endless)
        entry[0], entry[1] = p.entry
        tip[0], tip[1] = p.tip
        pose.speed = p.speed
        library.echospline_advance(tissue, pose)
        library.echospline_displacement_single(tissue, mesh.ctypes.data, mesh.size)

    return step


def of_model(model, poses):
    """One step by the public model."""
    endless, state = cycle(poses), [model.rest()]

    def step():
        state[0] = model.advance(state[0], next(endless), PERIOD)
        model.displacement(state[0])

    return step


def there_and_back():
    """A push and its withdrawal, without end when repeated."""
    inwards = list(path())
    return inwards + [type(p)(p.entry, p.tip, -p.speed) for p in reversed(inwards)]


def rate(steps, seconds):
    """Steps per second of every thread, and processors used."""
    ready, counts = threading.Barrier(len(steps) + 1), [0] * len(steps)
    until = [0.0]

    def work(k):
        step, done = steps[k], 0
        for _ in range(300):
            step()
        ready.wait()
        ready.wait()
        while perf_counter() < until[0]:
            for _ in range(10):
                step()
            done += 10
        counts[k] = done

    threads = [threading.Thread(target=work, args=(k,)) for k in range(len(steps))]
    for thread in threads:
        thread.start()
    ready.wait()
    begin, used = perf_counter(), process_time()
    until[0] = begin + seconds
    ready.wait()
    for thread in threads:
        thread.join()
    wall, used = perf_counter() - begin, process_time() - used
    return np.array(counts) / wall, used / wall


def rate_of_processes(steps, seconds):
    """The same by a process for each: what the machine can give."""
    context, pipes, children = mp.get_context("fork"), [], []
    for step in steps:
        here, there = context.Pipe()
        children.append(context.Process(target=lambda s=step, p=there: p.send(rate([s], seconds))))
        pipes.append(here)
    for child in children:
        child.start()
    found = [pipe.recv() for pipe in pipes]
    for child in children:
        child.join()
    return np.array([rates[0] for rates, _ in found]), sum(processors for _, processors in found)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    poses, rows = there_and_back(), []
    for kernel in (ThinPlate(), Elastic()):
        for nodes, shape in MESHES.items():
            models = [scene(shape, kernel) for _ in range(max(COUNTS))]
            for name, make in (("core", of_core), ("model", of_model)):
                steps = [make(model, poses) for model in models]
                hosts = {f"{count} threads": (rate, steps[:count]) for count in COUNTS}
                hosts["2 processes"] = (rate_of_processes, steps[:2])
                found = {host: [] for host in hosts}
                for _ in range(options.rounds):
                    for host, (run, some) in hosts.items():
                        rates, processors = run(some, options.seconds)
                        found[host].append((rates.sum(), rates.min(), processors))
                alone = np.array([values[0] for values in found["1 threads"]])
                for host, values in found.items():
                    total, least, processors = np.array(values).T
                    rows.append(
                        {
                            "kernel": type(kernel).__name__,
                            "nodes": nodes,
                            "step": name,
                            "host": host,
                            "steps_per_s": float(np.median(total)),
                            "least_of_a_thread": float(np.median(least)),
                            "of_one_thread": np.quantile(total / alone, [0, 0.5, 1]).tolist(),
                            "processors": float(np.median(processors)),
                        }
                    )
    if options.json:
        print(json.dumps({"core": describe_core(), "cores": os.cpu_count(), "rows": rows}, indent=1))
        return
    print("core {version}, level {level}".format(**describe_core()) + f", {os.cpu_count()} processors")
    for r in rows:
        print(
            f"{r['kernel']:10} {r['nodes']:5} nodes  {r['step']:6} {r['host']:12} {r['steps_per_s']:9.0f} steps/s  "
            "{:5.2f} {:5.2f} {:5.2f} x one (least, median, most)".format(*r["of_one_thread"])
            + f"  least of a thread {r['least_of_a_thread']:8.0f}  processors {r['processors']:4.2f}"
        )


if __name__ == "__main__":
    main()
