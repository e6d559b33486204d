"""Where the microseconds of one plain step go.

    python benchmarks/step_profile.py

Each part is timed by a call of its own from Python, so it carries about a microsecond of calling that the whole step, one
call, pays once. Minimum and median of 400.
"""

from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

import echospline.mechanics.compiled_step as c
from echospline.bench import MESHES, path, scene
from echospline.mechanics.compiled import add_product
from echospline.mechanics.tip_patch import COEFFICIENTS, DEGREE


def timed(name, call, repeats=400):
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
    r, a, s = f.response, f.response.scene, f.setting
    for pose in poses[:2400]:
        state = model.advance(state, pose, 1e-3)
    while r.built < r.sources_in_patch:
        state = model.advance(state, pose, 1e-3)
    table, tip, k, plain = state.landmarks, state.tip, len(state.landmarks), np.empty(0)
    slots = c.slots_of(table, r.slot_of_source)
    needle = c.needle(*pose.entry, *pose.tip, pose.speed, 1e-3, False, tip, plain)
    q = np.ascontiguousarray(table[:, 2:4])
    x, y = (np.array(pose.tip) - a.centre) / a.scale

    def at_point():
        return c.at_point(
            a.form, x, y, a.anchors, a.L_inverse, a.sources, a.felt, r.slots, r.count, r.inverse
        )

    def spread(nodes):
        return c.spread(
            a.form, a.frame, a.columns, a.table, r.rows, r.single, r.product, r.head, slots, q, tip, -1, 0.0, quantities,
            r.square, COEFFICIENTS, DEGREE, r.toq, r.near, r.rough, nodes, state.mesh,
        )  # fmt: skip

    quantities = at_point()
    print(
        f"{model.grid.size} nodes, {k} contacts, {len(model.anchors)} anchors, {len(model.lattice)} possible contacts, {len(r.near)} nodes near the tip"
    )
    rows = r.single[r.head : r.head + k]
    weights, out = np.ones((2, k), np.float32), np.empty((2, rows.shape[1]), np.float32)
    timed("the limit: bare product of the contacts' rows", lambda: np.dot(weights, rows, out=out))
    every = r.single[: r.head + k]
    weights2 = np.ones((2, len(every)), np.float32)
    timed("product with the patch's 21 rows", lambda: add_product(out, weights2, every))
    timed("all of the field (product, nodes near the tip, copy)", lambda: spread(r.at))
    timed("  without looking for the largest change", lambda: spread(r.at[:0]))
    timed(
        "which nodes touch the needle",
        lambda: c.touch(s.places, r.at, state.mesh, table, needle, s.numbers, f.marks, f.alongs, tip[11]),
    )
    timed("friction and relaxation", lambda: c.load(s.places, table, needle, s.numbers, q.copy()))
    timed("the tip against anchors and contacts, in double", at_point)
    timed("the whole step, from pose to mesh", lambda: model.displacement(model.advance(state, pose, 1e-3)))


if __name__ == "__main__":
    with threadpool_limits(1):
        for shape in MESHES.values():
            profile(shape)
