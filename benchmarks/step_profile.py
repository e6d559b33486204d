"""Where the microseconds of one step go: the calls of the core that a step from Python makes, one by one.

    python benchmarks/step_profile.py

Least and median of the last quarter of a push at 1 kHz. Contacts join and leave in some of its steps; those are a line of their own.
"""

import ctypes
import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

from time import perf_counter

import numpy as np

from echospline import _native as core
from echospline.mechanics import Elastic, ThinPlate, describe_core
from echospline.study.bench import MESHES, PERIOD, bare_product, path, scene, time_steps


def show(name, seconds):
    print(f"  {name:48} {1e6 * np.min(seconds):7.1f} {1e6 * np.median(seconds):7.1f} us")


def calls(step, poses):
    """Seconds of each of the core's calls in each step of a push from rest, and whether contacts changed in it."""
    library, tissue, pose = core.library(), step._tissue, core.Pose(dt=PERIOD)
    nodes = library.echospline_scene_node_count(step._scene)
    single, double = np.empty((nodes, 2), np.float32), np.empty((nodes, 2))
    state = ctypes.create_string_buffer(1 << 16)
    statistics = core.Statistics(struct_size=ctypes.sizeof(core.Statistics))
    parts = {
        "the step: echospline_advance": lambda: library.echospline_advance(tissue, pose),
        "mesh in single precision": lambda: library.echospline_displacement_single(
            tissue, single.ctypes.data, single.size
        ),
        "mesh in double precision": lambda: library.echospline_displacement(
            tissue, double.ctypes.data, double.size
        ),
        "state as bytes": lambda: library.echospline_state_save(tissue, state, len(state)),
        "statistics": lambda: library.echospline_tissue_statistics(tissue, statistics),
    }
    library.echospline_tissue_reset(tissue)
    seconds, changes = np.empty((len(poses), len(parts))), [0]
    for i, p in enumerate(poses):
        pose.entry[:2], pose.tip[:2], pose.speed = p.entry, p.tip, p.speed
        for j, call in enumerate(parts.values()):
            begin = perf_counter()
            status = call()
            seconds[i, j] = perf_counter() - begin
            assert status == core.Status.OK
        changes.append(statistics.joined + statistics.left)
    return dict(zip(parts, seconds.T, strict=True)), np.diff(changes) > 0


def profile(shape, kernel):
    model, poses = scene(shape, kernel), list(path())
    in_python, landmarks = time_steps(model, poses)
    late = np.arange(len(poses)) > 0.75 * len(poses)
    found, changed = calls(scene(shape, kernel).native, poses)
    print(
        f"{type(kernel).__name__}, {model.grid.size} nodes, {landmarks} moving landmarks, {len(model.anchors)} anchors, "
        f"{len(model.lattice)} possible contacts"
    )
    limit = bare_product(model.grid.size, landmarks, kernel.components)
    print(f"  {'the limit: bare product':48} {'':7} {1e6 * limit:7.1f} us")
    first, *others = found
    show(first, found[first][late & ~changed])
    show("the same while contacts join or leave", found[first][late & changed])
    for name in others:
        show(name, found[name][late])
    show("a call that does nothing, timed", [timed_nothing() for _ in range(2000)])
    show("all of a step from Python, pose to mesh", in_python[late])


def timed_nothing():
    version = core.library().echospline_version
    begin = perf_counter()
    version()
    return perf_counter() - begin


if __name__ == "__main__":
    print("core {version}, level {level}".format(**describe_core()))
    for kernel in (ThinPlate(), Elastic()):
        for shape in MESHES.values():
            profile(shape, kernel)
