"""The field in space where a picture needs it: 36 000 points, about 150 landmarks, both kernels, one thread.

    python benchmarks/space.py [--points 36000] [--repeats 200]

Tissue of 40 x 30 x 40 mm held at five faces by about 100 anchors, a needle with about 50 contacts, points at random in the tissue.
`echospline_displacement_at` is timed: kernels evaluated anew for every point and landmark. Beside it the bare float32 product of
(landmarks) x (points) and three components, which is one read of a matrix that nobody has to keep. Least and median.
"""

import argparse
import ctypes
from time import perf_counter, process_time

import numpy as np

from echospline import _native as core
from echospline.mechanics import describe_core
from echospline.study.bench import median_time

EXTENT = (40.0, 30.0, 40.0)  # mm
SHAPE = (21, 16, 21)
ENTRY, AXIS, DEPTH = np.array([12.3, 0.0, 18.1]), np.array([0.4, 0.87, 0.17]), 25.0


def options(kernel, precision, anchor_spacing):
    o = core.SceneOptions(struct_size=ctypes.sizeof(core.SceneOptions), dimension=3)
    core.library().echospline_scene_defaults(o)
    o.dimension, o.kernel, o.precision = 3, kernel, precision
    o.shape[:] = SHAPE
    o.spacing[:] = [length / (n - 1) for length, n in zip(EXTENT, SHAPE, strict=True)]
    o.anchor_spacing, o.contact_spacing, o.delta = anchor_spacing, 2.0, 2.2
    return o


def scene(kernel, precision, anchors=100):
    """Scene whose anchors are nearest to a number."""
    library, best = core.library(), None
    for spacing in np.arange(6.0, 16.0, 0.5):
        handle = ctypes.c_void_p()
        status = library.echospline_scene_create(options(kernel, precision, float(spacing)), handle)
        core.check(status, library.echospline_scene_message, handle)
        distance = abs(library.echospline_scene_anchor_count(handle) - anchors)
        if best is None or distance < best[0]:
            if best is not None:
                library.echospline_scene_destroy(best[1])
            best = distance, handle
        else:
            library.echospline_scene_destroy(handle)
    return best[1]


def pushed(handle):
    """Tissue after a push at 60 Hz, the median time of a step of its mesh, and its landmarks."""
    library, tissue, seconds = core.library(), ctypes.c_void_p(), []
    core.check(library.echospline_tissue_create(handle, tissue), library.echospline_tissue_message, tissue)
    axis, steps = AXIS / np.linalg.norm(AXIS), 150
    for i in range(1, steps + 1):
        tip = ENTRY + axis * DEPTH * i / steps
        pose = core.Pose(tuple(ENTRY), tuple(tip), 10.0, DEPTH / steps / 10.0)
        begin = perf_counter()
        status = library.echospline_advance(tissue, pose)
        seconds.append(perf_counter() - begin)
        core.check(status, library.echospline_tissue_message, tissue)
    count = ctypes.c_int64()
    library.echospline_landmarks(tissue, None, 0, count)
    return tissue, float(np.median(seconds[steps // 2 :])), count.value


def measure(kernel, precision, points, repeats):
    library, handle = core.library(), scene(kernel, precision)
    tissue, step, moving = pushed(handle)
    anchors = library.echospline_scene_anchor_count(handle)
    p = np.ascontiguousarray(np.random.default_rng(0).uniform(0, EXTENT, (points, 3)))
    out, wall, processor = np.empty_like(p), np.empty(repeats), np.empty(repeats)
    for i in range(repeats):
        begin, busy = perf_counter(), process_time()
        status = library.echospline_displacement_at(tissue, p.ctypes.data, points, out.ctypes.data)
        wall[i], processor[i] = perf_counter() - begin, process_time() - busy
        core.check(status, library.echospline_tissue_message, tissue)
    assert np.isfinite(out).all()
    weights = np.ones((3, anchors + moving), np.float32)
    rows = np.random.default_rng(0).random((anchors + moving, points), dtype=np.float32)
    product = np.empty((3, points), np.float32)
    limit = median_time(lambda: np.dot(weights, rows, out=product), repeats)
    print(
        f"{kernel.name.lower():10} {precision.name.lower():6} {anchors:4} anchors {moving:3} moving  "
        f"points: least {1e3 * wall.min():6.3f} median {1e3 * np.median(wall):6.3f} ms  processor {1e3 * np.median(processor):6.3f} ms  "
        f"bare product {1e3 * limit:6.3f} ms  step of {np.prod(SHAPE)} nodes {1e3 * step:6.3f} ms  largest {np.abs(out).max():.2f} mm"
    )
    library.echospline_tissue_destroy(tissue)
    library.echospline_scene_destroy(handle)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=36_000)
    parser.add_argument("--repeats", type=int, default=200)
    given = parser.parse_args()
    print("core {version}, level {level}, one thread, ".format(**describe_core()) + f"{given.points} points")
    for precision in core.Precision:
        for kernel in core.Kernel:
            measure(kernel, precision, given.points, given.repeats)


if __name__ == "__main__":
    main()
