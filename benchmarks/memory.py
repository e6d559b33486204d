"""Memory of an hour's use: needle in and out, again and again, at 60 Hz.

    python benchmarks/memory.py [--minutes 60]

Prints the resident memory at the start and after each sixth of the time, and what the core has done; its step allocates
nothing while its reserved room is enough.
"""

import argparse

import numpy as np

from echospline.scene import NeedlePose
from echospline.study.bench import MESHES, scene


def resident():
    """MiB in use now."""
    with open("/proc/self/statm", encoding="ascii") as f:
        return int(f.read().split()[1]) * 4096 / 2**20


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    minutes = parser.parse_args().minutes
    model, rng = scene(MESHES[4524]), np.random.default_rng(0)
    state, steps = model.rest(), int(minutes * 3600)
    depth, speed, angle, entry = 0.0, 8.0, 1.2, 15.0
    for i in range(steps + 1):
        if i == 1000 or (i and i % (steps // 6) == 0):
            found = model.landmarks(state)
            print(
                f"{i / 3600:6.1f} min  resident {resident():7.1f} MiB  contacts {len(found.contacts)}  "
                f"{vars(model.native.statistics)}",
                flush=True,
            )
        depth += speed / 60
        if depth > 24 or depth < 0.05:
            depth = min(max(depth, 0.05), 24.0)
            speed = -speed
            if speed > 0:
                angle, entry = rng.uniform(0.8, 2.3), rng.uniform(12, 28)
        angle = min(max(angle + 0.002 * rng.normal(), 0.7), 2.4)
        tip = (entry + depth * np.cos(angle), depth * np.sin(angle))
        state = model.advance(state, NeedlePose((entry, 0.0), tip, speed), 1 / 60)


if __name__ == "__main__":
    main()
