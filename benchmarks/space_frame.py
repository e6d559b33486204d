"""A frame in space, from the needle's pose to the picture with its echo: a plane of 512 x 512 pixels through a volume of 256^3 voxels.

    python benchmarks/space_frame.py [--frames 120] [--json]
    python benchmarks/space_frame.py --memory

A block of homogeneous tissue under a probe's face, a needle that sticks, slips and cuts at 10 mm/s in 60 Hz, one thread. Stages: step (the
law), field (what the faces answer), inverse (where the plane's pixels come from), slice, needle. Whole frames are given in ``cv2.remap``
calls on 512 x 512 pixels of the same run, interleaved frame by frame, as the median of the ratios, and the same of processor time, which
other processes disturb less: with the probe held still, and moved by 1 mm and turned by 1 degree from frame to frame. ``--memory`` prints the resident memory of a fresh process with the program loaded, and
the most that it held while it drew.
"""

from __future__ import annotations

import argparse
import json
import resource
from time import perf_counter, thread_time

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from echospline.mechanics import SpatialForceModel
from echospline.picture import NeedleEcho
from echospline.picture.slices import SliceDrawing
from echospline.scene import Probe, SpatialGrid, SpatialInsertion, Tissue, Volume, probe_plane

SIDE, SPACING, FPS = 256, 0.2, 60.0  # voxels, mm, Hz
FACES = ("left", "right", "bottom", "front", "back")
WARM = 30  # frames
LINEAR = Probe("linear", width=51.1, depth=51.1, pixel=0.1)
PATHS = {
    "in the plane": SpatialInsertion.straight((-14.0, 0.0, 0.0), (0.55, 0.83, 0.0), 30.0, 10.0),
    "crossing it": SpatialInsertion.straight((-8.0, 0.0, -10.0), (0.4, 0.8, 0.45), 30.0, 10.0),
}


def volume() -> Volume:
    """Speckle, smooth over a millimetre or so, whose surface is y = 0."""
    noise = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, SIDE), dtype=np.uint8)
    for z in range(SIDE):
        noise[z] = cv2.normalize(cv2.GaussianBlur(noise[z], (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    half = SPACING * (SIDE - 1) / 2
    return Volume(noise, (SPACING,) * 3, (-half, 0.0, -half))


def resident() -> float:
    """MB in use now."""
    with open("/proc/self/statm", encoding="ascii") as f:
        return int(f.read().split()[1]) * resource.getpagesize() / 1e6


def set_up() -> tuple[SpatialForceModel, SliceDrawing]:
    half = SPACING * (SIDE - 1) / 2
    grid = SpatialGrid.spanning((-half, 0.0, -half), (half, 2 * half, half), (14, 14, 14))
    model = SpatialForceModel.green(grid, FACES, Tissue(10.0, 0.45), sliding=("top",))
    return model, SliceDrawing(volume(), LINEAR)


def measure(
    model: SpatialForceModel, drawing: SliceDrawing, path: str, moved: bool, frames: int
) -> dict[str, float]:
    """Medians over the frames after the first half second."""
    insertion, state, echo = PATHS[path], model.rest(), NeedleEcho()
    picture = np.random.default_rng(1).integers(0, 256, (512, 512), dtype=np.uint8)
    x, y = (v.astype(np.float32) for v in np.meshgrid(np.arange(512) + 0.3, np.arange(512) + 0.2))
    out = np.empty_like(picture)
    stages, ratios = [], []
    for i in range(frames):
        swing = abs(i % 16 - 8) - 4.0 if moved else 0.0  # mm and degrees, to and fro
        plane = probe_plane((0.0, 0.0, swing), swing)
        pose = insertion.pose((i + 1) / FPS)
        began, busy = perf_counter(), thread_time()
        state = model.advance(state, pose, 1 / FPS)
        stepped = perf_counter()
        field = model.field(state)
        summed = perf_counter()
        drawn = drawing.draw(plane, field, pose, echo)
        done, worked = perf_counter(), thread_time()
        cv2.remap(picture, x, y, cv2.INTER_LINEAR, dst=out)
        remap, remapped = perf_counter() - done, thread_time() - worked
        stages.append(
            [
                1e3 * (stepped - began),
                1e3 * (summed - stepped),
                *drawn.milliseconds.values(),
                1e3 * (done - began),
                1e3 * remap,
            ]
        )
        ratios.append(((done - began) / remap, (worked - busy) / remapped))
    names = ["step", "field", *drawn.milliseconds, "frame", "remap"]
    times = dict(zip(names, np.median(stages[WARM:], axis=0).tolist(), strict=True))
    wall, processor = np.median(ratios[WARM:], axis=0).tolist()
    return {
        **times,
        "p99": float(np.percentile([row[-2] for row in stages[WARM:]], 99)),
        "remaps": wall,
        "processor": processor,
        "residual": drawn.residual,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--memory", action="store_true")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    with threadpool_limits(limits=1):
        before = resident()
        model, drawing = set_up()
        if given.memory:
            ready = resident()
            measure(model, drawing, "crossing it", True, 60)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
            print(
                f"program {before:.0f} MB; with a volume of {SIDE}^3 voxels {ready:.0f}, while drawing {resident():.0f}, at most "
                f"{peak:.0f}: {resident() - before:.0f} above the program, {peak - before:.0f} at most"
            )
            return
        rows = [
            {
                "path": path,
                "probe": "moved" if moved else "held",
                **measure(model, drawing, path, moved, given.frames),
            }
            for path in PATHS
            for moved in (False, True)
        ]
    if given.json:
        print(json.dumps(rows))
        return
    for row in rows:
        stages = "  ".join(
            f"{name} {row[name]:.2f}"
            for name in ("step", "field", "inverse", "slice", "needle", "frame", "p99", "remap")
        )
        print(
            f"{row['path']:13} {row['probe']:6} {stages} ms  {row['remaps']:.1f} remaps, {row['processor']:.1f} of processor time  residual {row['residual']:.2f} px"
        )


if __name__ == "__main__":
    main()
