"""How punctual a step is: 60 s at 1 kHz on 1200 nodes, beside a process that keeps a core busy.

    python benchmarks/jitter.py [--seconds 60] [--out out/jitter.json]

Three hosts: a thread of a program that also draws frames, a process of its own that leaves the displacement in shared memory,
and the same process under SCHED_FIFO where the system allows it. For each: the step's own time (by the clock,
and of the processor: without the time that others had the core), how late it woke, and how
many periods it missed altogether.
"""

import argparse
import json
import multiprocessing as mp
import os
import threading
import time
from multiprocessing import shared_memory
from pathlib import Path

import numpy as np

from echospline.mechanics import describe_core
from echospline.scene import NeedlePose
from echospline.study.bench import MESHES, scene

PERIOD = 1e-3


def poses():
    """In and out again, without end: 5 mm/s, down to 20 mm."""
    x, speed, i = 0.0, 5.0, 0
    while True:
        x += speed * PERIOD
        speed = -5.0 if x >= 20 else (5.0 if x <= 0.1 else speed)
        i += 1
        yield NeedlePose((12.3, 0.0), (12.3 + 0.4 * x, 0.9165 * x), speed)


def run(seconds, model, keep):
    """Step at 1 kHz; a step that is still due when the next one is skips it."""
    state, path = model.rest(), poses()
    for _ in range(2000):  # contacts as in the middle of a session
        state = model.advance(state, next(path), PERIOD)
    count = int(seconds / PERIOD)
    own, late, missed, done = np.full((2, count), np.nan), np.full(count, np.nan), 0, 0
    start = time.perf_counter() + 0.05
    while done < count:
        due = start + done * PERIOD
        rest = due - time.perf_counter()
        if rest > 0:
            time.sleep(rest)
        woke, processor = time.perf_counter(), time.thread_time()
        state = model.advance(state, next(path), PERIOD)
        keep(model.displacement(state))
        now = time.perf_counter()
        own[:, done], late[done] = (now - woke, time.thread_time() - processor), woke - due
        behind = int((now - start) / PERIOD) - done
        missed += max(0, behind)
        done += max(1, behind + 1)
    return report(own, late, missed, count, model)


def report(own, late, missed, count, model):
    (own, processor), late = 1e3 * own[:, ~np.isnan(late)], 1e3 * late[~np.isnan(late)]
    levels = [0.5, 0.99, 0.999, 1.0]
    return {
        "step_ms": dict(zip(map(str, levels), np.quantile(own, levels).tolist(), strict=True)),
        "step_processor_ms": dict(
            zip(map(str, levels), np.quantile(processor, levels).tolist(), strict=True)
        ),
        "late_ms": dict(zip(map(str, levels), np.quantile(late, levels).tolist(), strict=True)),
        "missed": missed,
        "periods": count,
        "statistics": vars(model.native.statistics),
    }


def in_thread(seconds):
    """Beside a thread that draws frames: it shares this interpreter."""
    stop, out = threading.Event(), {}
    newest = [None]

    def draw():
        while not stop.is_set():
            u = newest[0]
            if u is not None:
                np.hypot(u[:, 0], u[:, 1]).max()
            time.sleep(1 / 60)

    def step():
        def keep(u):
            newest[0] = u

        out.update(run(seconds, scene(MESHES[1200]), keep))

    threads = [threading.Thread(target=draw), threading.Thread(target=step)]
    for t in threads:
        t.start()
    threads[1].join()
    stop.set()
    threads[0].join()
    return out


def in_process(seconds, fifo):
    room = shared_memory.SharedMemory(create=True, size=1200 * 2 * 8)
    try:
        context = mp.get_context("spawn")
        here, there = context.Pipe()
        child = context.Process(target=_child, args=(seconds, fifo, room.name, there))
        child.start()
        out = here.recv()
        child.join()
    finally:
        room.close()
        room.unlink()
    return out


def _child(seconds, fifo, name, pipe):
    if fifo:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
        except (OSError, AttributeError) as error:
            pipe.send({"refused": str(error)})
            return
    room = shared_memory.SharedMemory(name)
    shared = np.ndarray((1200, 2), buffer=room.buf)

    def keep(u):
        shared[:] = u

    pipe.send(run(seconds, scene(MESHES[1200]), keep))
    room.close()


def busy():
    while True:
        np.sin(np.arange(1000.0)).sum()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--out", type=Path, default=Path("out/jitter.json"))
    options = parser.parse_args()
    neighbour = mp.get_context("spawn").Process(target=busy, daemon=True)
    neighbour.start()
    try:
        found = {
            "core": describe_core(),
            "thread": in_thread(options.seconds),
            "process": in_process(options.seconds, False),
            "process, SCHED_FIFO": in_process(options.seconds, True),
        }
    finally:
        neighbour.terminate()
    found["load"] = os.getloadavg()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(found, indent=1))
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
