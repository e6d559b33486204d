"""Where the microseconds of one plain step go.

    python benchmarks/step_profile.py

Each part is timed by a call of its own from Python, so it carries about a microsecond of calling that the whole step, one
call, pays once. Minimum and median of 2000.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

from time import perf_counter

import numpy as np

from echospline.mechanics import compiled_step, mesh_field, tip_column, touch
from echospline.mechanics.tip_patch import NODES
from echospline.study.bench import MESHES, path, scene


def timed(name, call, repeats=2000):
    call()
    times = np.empty(repeats)
    for i in range(repeats):
        begin = perf_counter()
        call()
        times[i] = perf_counter() - begin
    print(f"  {name:58} {1e6 * times.min():7.1f} {1e6 * np.median(times):7.1f} us")


def profile(shape):
    model = scene(shape)
    f, state, poses = model.fast, model.rest(), list(path())
    r, s = f.response, f.setting
    for pose in poses[:2400]:
        state = model.advance(state, pose, 1e-3)
    for pose in poses[2400:]:
        built = r.statistics.built
        state = model.advance(state, pose, 1e-3)
        if r.statistics.built == built:
            break
    b, table, tip, k, plain = r.basis, state.landmarks, state.tip, len(state.landmarks), np.empty(0)
    needle = touch.needle(*pose.entry, *pose.tip, pose.speed, 1e-3, False, tip, plain)
    q = np.ascontiguousarray(table[:, 2:4])
    x, y = (np.array(pose.tip) - r.scene.centre) / r.scene.scale
    which, alongs, none = np.empty(len(r.at), dtype=np.int64), np.empty(len(r.at)), np.empty((0, 2))
    tip_column.meet(b, x, y)
    print(
        f"{model.grid.size} nodes, {k} contacts, {len(model.anchors)} anchors, {len(model.lattice)} possible contacts, "
        f"{r.near_count.max()} nodes near the tip"
    )
    n = r.single.shape[1]
    rows, weights, out = (
        r.single[r.head : r.head + k],
        np.ones((2, k), np.float32),
        np.empty((2, n), np.float32),
    )
    timed("the limit: bare product of the contacts' rows", lambda: np.dot(weights, rows, out=out))
    every = r.single[r.head - len(NODES) : r.head + k]
    more = np.ones((2, len(every)), np.float32)
    timed("the same with the patch's rows", lambda: np.dot(more, every, out=out))
    timed(
        "which nodes touch the needle",
        lambda: touch.touch(
            s.places, f.lines, r.at, state.mesh, table, needle, s.numbers, tip[11], which, alongs
        ),
    )
    timed("friction and relaxation", lambda: touch.load(s.places, table, needle, s.numbers, q))
    timed("the tip against anchors and contacts", lambda: tip_column.meet(b, x, y))
    timed("the same without a patch", lambda: tip_column.meet_exactly(b, x, y))
    tip_column.meet(b, x, y)
    timed("weights of the contacts", lambda: mesh_field.combine(b, table, q))
    timed("all of the field", lambda: mesh_field.spread(b, k, tip, -1, 0.0, state.mesh))
    timed(
        "  without looking for the largest change",
        lambda: mesh_field.spread(b, k, tip, -1, 0.0, none),
    )
    timed(
        "all of it, one compiled call",
        lambda: compiled_step.step(
            b, s.places, f.lines, s.posts, s.walls, s.numbers, table, tip, state.mesh, plain, *pose.entry, *pose.tip,
            pose.speed, 1e-3,
        ),
    )  # fmt: skip
    timed("the whole step, from pose to mesh", lambda: model.displacement(model.advance(state, pose, 1e-3)))


if __name__ == "__main__":
    for shape in MESHES.values():
        profile(shape)
