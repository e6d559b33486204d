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
@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
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


def marks(model, dt, entry=(14.0, 0.0), angle=75.0, depth=24.0, speed=10.0):
    """Fields in the middle and at the end of push, dwell and withdrawal, and 5 s after."""
    path = Insertion.straight(entry, angle, depth, speed, dwell=2.0, retract=True)
    times = np.array([0.5, 1.0]) * depth / speed
    times = np.concatenate([times, times[-1] + [1.0, 2.0], times[-1] + 2 + times, [path.duration + 5]])
    state, fields = model.rest(), []
    for i in range(1, round(times[-1] / dt) + 1):
        state = model.advance(state, path.pose(i * dt), dt)
        if np.abs(times - i * dt).min() < 1e-6:
            fields.append(np.array(model.displacement(state)))
    assert len(fields) == len(times)
    return np.array(fields)


@pytest.mark.parametrize(("kernel", "law"), MODELS)
def test_push_dwell_withdrawal_and_after_do_not_depend_on_the_time_step(kernel, law):
    model = MODELS[kernel, law]
    every = [marks(model, dt) for dt in (1e-3, 5e-3, 0.1 / 3, 0.1)]
    largest = length(every[0].reshape(-1, 2))
    assert largest > 0.9
    for fields in every[1:]:
        assert length((fields - every[0]).reshape(-1, 2)) < 0.02 * largest


@pytest.mark.parametrize(("kernel", "law"), MODELS)
@pytest.mark.parametrize("dt", [1e-3, 0.1 / 3, 0.1])
def test_a_needle_that_is_out_leaves_the_tissue_where_it_was(kernel, law, dt):
    fields = marks(MODELS[kernel, law], dt)
    assert length(fields[-3]) > 0.9  # dragged back, half way out
    assert length(fields[-2]) < 0.01


@pytest.mark.parametrize("kernel", KERNELS)
def test_tissue_that_sticks_keeps_still_while_the_needle_rests(kernel):
    model = MODELS[kernel, "stick"]
    path = Insertion.straight((14, 0), 75, 24, 10.0)
    state = model.rest()
    for i in range(72):
        state = model.advance(state, path.pose((i + 1) / 30), 1 / 30)
    pushed = model.displacement(state)
    for _ in range(20):
        state = model.advance(state, path.pose(99.0), 0.5)
    np.testing.assert_allclose(model.displacement(state), pushed, rtol=0, atol=1e-3)
    # where it follows it has been let go along the needle, (17); across the needle it stays
    state = MODELS[kernel, "follow"].rest()
    for i in range(72 + 300):
        state = MODELS[kernel, "follow"].advance(state, path.pose((i + 1) / 30), 1 / 30)
    assert length(MODELS[kernel, "follow"].displacement(state)) < 0.1 * length(pushed)


@pytest.mark.parametrize("kernel", KERNELS)
def test_speed_does_not_matter_to_tissue_that_sticks(kernel):
    model, fields = MODELS[kernel, "stick"], []
    for v in (1.0, 5.0, 20.0, 80.0):
        path, state = Insertion.straight((14, 0), 75, 24, v), model.rest()
        for i in range(1, 101):
            state = model.advance(state, path.pose(i * 0.24 / v), 0.24 / v)
        fields.append(np.array(model.displacement(state)))
    for u in fields[1:]:
        assert length(u - fields[0]) < 0.02 * length(fields[0])


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_withdrawn_needle_drags_tissue_back_through_zero_and_slips(kernel):
    # 2 f of travel reverse the stop, f being what friction holds
    model = MODELS[kernel, "stick"]
    state, depth = model.rest(), 0.0
    for _ in range(240):
        depth += 0.1
        state = model.advance(state, NeedlePose((20, 0), (20, depth), 5.0), 0.02)
    axial = []
    for _ in range(30):
        axial.append(model.displacement_at(state, [(20.0, 8.0)])[0, 1])
        depth -= 0.1
        state = model.advance(state, NeedlePose((20, 0), (20, depth), -5.0), 0.02)
    assert axial[0] == pytest.approx(-axial[-1], rel=0.05)
    assert axial[0] > 0.8
    np.testing.assert_allclose(np.diff(axial)[1:12], -0.1, atol=0.02)  # bonded
    np.testing.assert_allclose(np.diff(axial)[-8:], 0.0, atol=0.005)  # slipping


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_tip_that_trembles_at_rest_moves_the_tissue_no_further_than_itself(kernel):
    model, rng = MODELS[kernel, "stick"], np.random.default_rng(0)
    path = Insertion.straight((14, 0), 75, 20, 10.0)
    state = model.rest()
    for i in range(120):
        state = model.advance(state, path.pose((i + 1) / 60), 1 / 60)
    pushed, end = np.array(model.displacement(state)), path.pose(2.0)
    kept = []
    for i in range(1200):
        tip = tuple(np.add(end.tip, rng.normal(0, 0.05, 2)))
        state = model.advance(state, NeedlePose(end.entry, tip), 1 / 60)
        if i % 300 == 299:
            kept.append(np.array(model.displacement(state)))
    for u in kept:
        assert length(u - pushed) < 0.5
        assert np.hypot(*u.T).mean() > 0.7 * np.hypot(*pushed.T).mean()


@pytest.mark.parametrize(("kernel", "law"), MODELS)
@pytest.mark.parametrize("side", ["left", "right", "bottom"])
def test_a_needle_along_a_clamped_edge_throws_nothing(kernel, law, side):
    way = {"left": ((0, 0), (0, 25)), "right": ((40, 0), (40, 25)), "bottom": ((4, 30), (36, 30))}[side]
    model = MODELS[kernel, law]
    state, most = model.rest(), 0.0
    path = Insertion([0.0, 3.0, 6.0], way[0], [way[0], way[1], way[0]])
    for i in range(1, 181):
        state = model.advance(state, path.pose(i / 30), 1 / 30)
        most = max(most, length(model.displacement(state)))
    assert most < 0.25


@pytest.mark.parametrize(("kernel", "law"), MODELS)
@pytest.mark.parametrize(
    ("entry", "angle", "depth"), [((20, 5), 20, 26), ((22, 0), 45, 30), ((14, 0), 75, 34)]
)
def test_withdrawal_through_a_clamped_side_is_as_calm_as_finite_elements(kernel, law, entry, angle, depth):
    path = Insertion.straight(entry, angle, depth, 8.0, dwell=0.5, retract=True)

    def largest(model):
        state, most = model.rest(), 0.0
        for i in range(1, round(path.duration * 30) + 1):
            state = model.advance(state, path.pose(i / 30), 1 / 30)
            if i / 30 > path.times[2]:
                most = max(most, length(model.displacement(state)))
        return most

    assert largest(MODELS[kernel, law]) < max(1.15, largest(FEMModel(GRID)))


def test_the_stop_operator_is_that_of_coulomb_friction():
    """Against the play of a spring and a slider, stepped in tiny parts; and it takes no work out of a closed cycle."""
    rng, axis, held = np.random.default_rng(1), np.array([0.6, 0.8]), np.array([0.7])
    q, fine, work = np.zeros((1, 2)), 0.0, 0.0
    for moved in rng.normal(0, 0.5, 200):
        now = stick(q, held, np.array([moved]), np.zeros((1, 2)), axis, abs(moved))
        for _ in range(1000):
            fine = min(max(fine + moved / 1000, -0.7), 0.7)
        work += 0.5 * float((q + now)[0] @ axis) * moved
        q = now
        assert float(q[0] @ axis) == pytest.approx(fine, abs=1e-12)
    back = stick(q, held, -q @ axis, np.zeros((1, 2)), axis, np.inf)
    work += 0.5 * float((q + back)[0] @ axis) * float(-q[0] @ axis)
    assert work > 0


def test_what_yields_beside_a_clamp_bends_the_spline_gently():
    f, c = np.full(2001, 0.8), np.linspace(0.0, 6.0, 2001)
    u = yielding(f, c)
    assert u[0] == 0.0
    np.testing.assert_array_equal(u[c >= 4.0], 0.8)
    assert np.diff(u).min() >= 0.0
    assert (np.diff(u) / np.diff(c)).max() < 0.4
    np.testing.assert_array_equal(yielding(-f, c), -u)
