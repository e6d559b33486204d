"""Laws of the landmark models: no jumps on any path, no dependence on the time step, calm beside clamps, stick and slip."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from echospline.mechanics import Elastic, FEMModel, ThinPlate, TPSModel, TPSParameters
from echospline.mechanics.interaction import needle_travel, stick, yielding
from echospline.scene import Insertion, NeedlePose, RegularGrid

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
KERNELS = {"tps": ThinPlate(), "elastic": Elastic()}
MODELS = {
    (kernel, law): TPSModel(
        GRID, kernel=KERNELS[kernel], parameters=TPSParameters(loading=law), precision="double"
    )
    for kernel in KERNELS
    for law in ("stick", "follow")
}
MOST_STEPS = 150


def length(u):
    return float(np.hypot(*np.asarray(u).T).max())


@st.composite
def paths(draw):
    """Corners that entry and tip pass at some speed, in steps of some length: pushes, pulls, tilts, shifts, stops."""
    x = st.one_of(st.sampled_from([0.0, 0.3, 1.0, 39.5, 40.0]), st.floats(-3.0, 43.0))
    y = st.one_of(st.sampled_from([0.0, 1.0, 29.5, 30.0]), st.floats(-3.0, 33.0))
    point = st.tuples(x, y)
    entry = draw(st.one_of(st.tuples(x, st.just(0.0)), point))
    corners = [(entry, entry)]
    for what in draw(
        st.lists(st.sampled_from(["push", "pull", "tip", "shift", "stop"]), min_size=2, max_size=6)
    ):
        e, t = corners[-1]
        if what == "pull":
            share = draw(st.sampled_from([0.0, 0.3, 0.9]))
            corners.append((e, tuple(np.add(e, share * np.subtract(t, e)))))
        elif what == "shift":
            by = draw(st.tuples(st.floats(-4, 4), st.floats(-1, 1)))
            corners.append((tuple(np.add(e, by)), tuple(np.add(t, by))))
        elif what == "stop":
            corners.append((e, t))
        else:
            corners.append((e, draw(point)))
    speeds = st.one_of(st.sampled_from([0.01, 1.0, 5.0, 50.0, 200.0]), st.floats(0.01, 200.0))
    return corners, [draw(speeds) for _ in corners[1:]], draw(st.sampled_from([1e-3, 5e-3, 1 / 30, 0.1]))


def poses(path):
    """Poses of a path, one a step; speed is that of the tip along the axis relative to the entry."""
    corners, speeds, dt = path
    now, count = NeedlePose(*corners[0]), 0
    yield now
    for (a, b), speed in zip(pairwise(corners), speeds, strict=True):
        way = max(np.hypot(*np.subtract(b[0], a[0])), np.hypot(*np.subtract(b[1], a[1])))
        steps = int(np.clip(np.ceil(way / (speed * dt)), 1, 60)) if way else 5
        for i in range(1, steps + 1):
            share = min(1.0, i * speed * dt / way) if way else 0.0
            entry, tip = (tuple(np.add(p, share * np.subtract(q, p))) for p, q in zip(a, b, strict=True))
            there = NeedlePose(entry, tip)
            now = NeedlePose(entry, tip, (there.depth - now.depth) / dt)
            yield now
            count += 1
            if count == MOST_STEPS:
                return
        corners_left = share < 1
        if corners_left:  # slow: it ends on the way
            return


@pytest.mark.parametrize(("kernel", "law"), MODELS)
@settings(max_examples=400, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(path=paths())
@example(path=([((12.0, 0.0),) * 2, ((12.0, 0.0), (24.0, 20.8)), ((12.0, 0.0),) * 2], [50.0, 50.0], 1e-3))
@example(path=([((0.0, 0.0),) * 2, ((0.0, 0.0), (0.0, 25.0)), ((0.0, 0.0),) * 2], [8.0, 8.0], 0.1))
def test_no_node_moves_further_than_three_times_travel_and_relaxation(kernel, law, path):
    model = MODELS[kernel, law]
    state, dt = model.rest(), path[2]
    u, before = model.displacement(state), None
    for pose in poses(path):
        travel = needle_travel(before or NeedlePose(pose.entry, pose.entry), pose)
        relaxation = length(u) * -np.expm1(-model.parameters.alpha3 * dt)
        state = model.advance(state, pose, dt)
        new = model.displacement(state)
        assert length(new - u) <= 3 * (travel + relaxation) + 1e-4, pose
        u, before = new, pose
