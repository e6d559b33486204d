"""Forces that stick, slip and cut: closed forms on rigid tissue, energy, repetition, noise, speed and time step."""

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from echospline.errors import InputError
from echospline.mechanics import ForceModel, NeedleForces
from echospline.mechanics import stick_slip as law_in_numpy
from echospline.mechanics.finite_elements import point_loads
from echospline.mechanics.stick_slip import solve_box
from echospline.scene import Insertion, NeedlePose
from forced_paths import GRID, depths, largest, model, pose, response

LAW = NeedleForces()
QUICK = [
    Phase.explicit,
    Phase.reuse,
    Phase.generate,
]  # the reference takes tens of ms a step: a failure is not made smaller


class Rigid:
    """Tissue that does not move: what is left is the law alone."""

    grid = GRID

    def answer(self, places, forces, points):
        cases = forces.shape[2]
        return np.zeros((GRID.size, 2, cases)), np.zeros((len(points), 2, cases))

    def describe(self):
        return "rigid"


# ---- the law on rigid tissue ---------------------------------------------------------------------------------------------------


def test_on_rigid_tissue_the_tip_cuts_at_its_force_and_friction_reaches_its_limit_on_the_cut_length():
    reached = depths(ForceModel(Rigid(), LAW), np.linspace(0.1, 20, 200))[-1].load
    cut = 20 - LAW.tip / LAW.tip_stiffness
    assert reached.tip == pytest.approx(LAW.tip, abs=1e-9)
    assert reached.cut == pytest.approx(cut, abs=1e-5)
    assert reached.friction == pytest.approx(LAW.friction_limit * cut, rel=0.01)


def test_on_rigid_tissue_friction_turns_over_twice_its_bond_stretch():
    made = ForceModel(Rigid(), LAW)
    pushed = depths(made, np.linspace(0.1, 20, 200))[-1]
    stretch = LAW.friction_limit / LAW.bond
    half, whole = depths(made, [20 - stretch, 20 - 2 * stretch], state=pushed)
    assert half.load.friction == pytest.approx(0, abs=2e-3)
    assert whole.load.friction == pytest.approx(-pushed.load.friction, rel=0.02)


def test_on_rigid_tissue_tilting_presses_in_proportion_to_the_angle():
    made = ForceModel(Rigid(), LAW)
    pushed = depths(made, np.linspace(0.1, 20, 200))[-1]
    slope = 1e-3
    tilted = made.advance(pushed, pose(20, 90 + np.degrees(slope)), 0.1).load
    cut = pushed.load.cut
    # each mm of shaft at depth s presses by side_stiffness * s * slope; the torque about the entry has one more s
    assert tilted.side == pytest.approx(LAW.side_stiffness * slope * cut**2 / 2, rel=0.02)
    assert tilted.torque == pytest.approx(LAW.side_stiffness * slope * cut**3 / 3, rel=0.02)


def test_viscosity_adds_force_in_proportion_to_the_speed_of_slip():
    viscous = replace(LAW, viscosity=5e-4)
    slow, fast = (
        depths(ForceModel(Rigid(), viscous), np.linspace(0.1, 20, 200), dt=0.1 / v)[-1] for v in (5, 20)
    )
    gained = (fast.load.friction - slow.load.friction) / (viscous.viscosity * 15)
    assert gained == pytest.approx(19.8, rel=0.02)  # mm of shaft


# ---- equilibrium and energy ----------------------------------------------------------------------------------------------------


def test_the_displacement_is_that_of_the_forces_by_a_direct_solution():
    made = model()
    state = made.rest()
    for k in range(1, 81):
        state = made.advance(state, pose(0.25 * k, 70 + 0.1 * k), 0.02)
    loads = np.zeros((GRID.size, 2))
    for a, f in zip(state.track, state.forces, strict=True):
        loads += point_loads(GRID, a.station.points, a.station.weights[:, None] * f)
    direct = made.response.factored.solve(loads)
    np.testing.assert_allclose(state.displacement, direct, atol=1e-6 * largest(state))
    np.testing.assert_allclose(made.displacement_at(state, GRID.nodes), direct, atol=1e-9)
    axis = np.array(pose(20, 78).axis)
    total = state.load.tip + state.load.friction, state.load.side
    np.testing.assert_allclose(
        loads.sum(axis=0), total[0] * axis + total[1] * np.array([-axis[1], axis[0]]), atol=1e-9
    )


def stored(state, law):
    """Elastic energy of tissue, bonds and contacts, N mm; a front that lags behind its tip has been pushed for nothing yet."""
    slip, f = state.law, state.forces
    if not len(f):
        return 0.0
    on, track, h = slip.covered > 0, slip.track, law.station_spacing
    weights = law_in_numpy._front(slip.cut, len(track), h)
    touch = float(weights @ [s.share > 0 for s in track.stations])
    eta = float(weights @ ((slip.tip - track.places - slip.moved) @ slip.axis))
    energy = 0.5 * np.einsum("ic,icjd,jd", f, track.compliance, f)
    energy += np.sum(slip.friction[on] ** 2 / (2 * law.bond * slip.covered[on]))
    energy += np.sum(slip.side[0, on] ** 2 / (2 * law.side_stiffness * slip.covered[on]))
    if touch > 0:
        energy += slip.push**2 / (2 * law.tip_stiffness * touch)
        energy += law.tip * touch * max(eta - law.tip / law.tip_stiffness, 0.0)
    return float(energy)


@settings(max_examples=4, deadline=None, phases=QUICK, derandomize=True)
@given(
    st.lists(st.tuples(st.floats(0, 10), st.floats(-10, 10), st.floats(-1, 1)), min_size=1, max_size=2),
    st.sampled_from([3.0, 10.0, 50.0]),
)
def test_work_is_stored_or_lost_and_never_created(corners, young):
    """The hand's work, step by step, covers what the tissue stores: over a closed cycle from rest it is not negative."""
    made = model(young=young, solver="reference")
    state, before, work, kept = made.rest(), (0.0, np.pi / 2, np.array([20.0, 0.0])), 0.0, 0.0
    path = np.array([(0.0, 0.0, 0.0), *corners, (0.0, 0.0, 0.0)])
    for first, last in pairwise(path):
        way = last - first
        for k in range(
            1, (n := int(np.ceil(max(abs(way[0]), 0.4 * abs(way[1]), abs(way[2])) / 0.25)) or 1) + 1
        ):
            depth, tilt, shift = first + way * k / n
            at = pose(depth, 90 + tilt, 20 + shift)
            state = made.advance(state, at, 0.01)
            angle, entry = np.radians(90 + tilt), np.array(at.entry)
            force, axis = state.forces.sum(axis=0), np.array([np.cos(angle), np.sin(angle)])
            done = force @ axis * (depth - before[0]) + force @ (entry - before[2])
            done += state.load.torque * (angle - before[1])
            now = stored(state, LAW)
            assert done - (now - kept) > -2e-3  # a step's loss, to first order in the step
            work, kept, before = work + done, now, (depth, angle, entry)
            assert work >= now - 1e-4  # N mm, of several; the same
    assert not state.displacement.any()


# ---- the table of targets ------------------------------------------------------------------------------------------------------

CYCLE = Insertion.straight((20.0, 0.0), 80, 20, 10, dwell=1.0, retract=True)


def recorded(made, dt, times):
    """Forces and largest displacement at times that the step divides."""
    state, rows = made.rest(), {}
    for k in range(1, round(times[-1] / dt) + 1):
        at = CYCLE.pose(k * dt)
        state = made.advance(state, at, dt)
        if any(abs(k * dt - t) < 1e-6 for t in times):
            rows[round(k * dt, 3)] = (state.load.tip, state.load.friction, largest(state))
    return np.array([rows[t] for t in times])


def test_the_time_step_changes_nothing_in_push_dwell_withdrawal_and_after():
    times = [0.7, 1.5, 1.9, 2.2, 2.6, 3.2, 3.3, 3.6, 4.2, 4.8, 5.0, 10.0]
    made = model()
    fine = recorded(made, 0.001, times)
    for dt in (0.005, 1 / 30, 0.1):
        apart = np.abs(recorded(made, dt, times) - fine) / fine.max(axis=0)
        assert apart.max() < 0.02, dt


def test_forces_do_not_depend_on_speed_without_the_viscous_term():
    loads = []
    for speed in (1, 5, 20, 80):
        state = depths(made := model(), np.linspace(0, 20, 301)[1:], dt=20 / 300 / speed)[-1]
        loads.append((state.load.tip, state.load.friction, largest(state)))
        assert made.needle_load(state) == state.load
    np.testing.assert_allclose(loads, [loads[0]] * 4, rtol=0.02)


def test_dwelling_changes_nothing():
    made = model()
    stopped = depths(made, np.linspace(0.1, 20, 200))[-1]
    rested = depths(made, [20.0] * 600, dt=1 / 60, state=stopped)[-1]
    assert largest(rested) == pytest.approx(largest(stopped), rel=0.05)
    assert rested.load.tip == pytest.approx(stopped.load.tip, rel=0.01)


@pytest.mark.parametrize(("band", "within"), [(0.0, 0.2), (0.15, 0.05)])
def test_under_a_trackers_noise_the_forces_of_a_resting_needle_reach_a_plateau(band, within):
    made = model(replace(LAW, dead_band=band))
    arrived = depths(made, np.linspace(0.1, 20, 200))[-1]
    rng = np.random.default_rng(5)
    noisy = depths(made, 20 + 0.05 * rng.standard_normal(60 * 60), dt=1 / 60, state=arrived)
    seconds = np.array([(s.load.tip, largest(s)) for s in noisy]).reshape(60, 60, 2).mean(axis=1)
    free = np.array([arrived.load.tip, largest(arrived)])
    plateau = seconds[2:].mean(axis=0)
    np.testing.assert_allclose(plateau, free, rtol=within)
    np.testing.assert_allclose(seconds[-20:].mean(axis=0), seconds[2:22].mean(axis=0), rtol=0.02)  # no trend


def test_a_tip_that_moves_less_than_the_dead_band_is_at_rest():
    made = model(replace(LAW, dead_band=0.15))
    arrived = depths(made, np.linspace(0.1, 20, 200))[-1]
    held = depths(made, [19.8, 19.71, 19.99, 19.75], state=arrived)
    for state in held:
        np.testing.assert_array_equal(state.displacement, arrived.displacement)
    assert largest(depths(made, [19.6], state=held[-1])[0]) < largest(arrived)


def test_a_cut_track_costs_friction_alone_until_its_end():
    made = model()
    inserted = depths(made, np.linspace(0.1, 16, 160))[-1]
    out = depths(made, np.linspace(16, 0, 161), state=inserted)[-1]
    assert largest(out) < 1e-3
    again = depths(made, np.linspace(0.1, 19, 190), state=out)
    tips = np.array([s.load.tip for s in again])
    front = inserted.load.cut
    at = np.linspace(0.1, 19, 190)
    assert not tips[at < front].any()
    assert tips[-1] == pytest.approx(LAW.tip)
    assert again[100].load.friction > 0.8 * LAW.friction_limit * at[100]


def test_a_needle_that_enters_elsewhere_cuts_anew():
    made = model()
    out = depths(made, [*np.linspace(0.1, 16, 160), *np.linspace(16, 0, 161)])[-1]
    state = made.advance(out, pose(0, x=26), 0.1)
    for d in np.linspace(0.1, 10, 100):
        state = made.advance(state, pose(d, x=26), 0.01)
    fresh = made.rest()
    for d in np.linspace(0.1, 10, 100):
        fresh = made.advance(fresh, pose(d, x=26), 0.01)
    assert state.load.tip == pytest.approx(LAW.tip)
    np.testing.assert_allclose(state.displacement, fresh.displacement, atol=1e-6)


@pytest.mark.parametrize("young", [2.0, 3.0, 5.0, 10.0, 50.0])
@pytest.mark.parametrize("step", [0.02, 0.25, 1.0])
def test_no_node_moves_more_than_twice_as_far_as_the_needle(young, step):
    made = model(young=young)
    path = np.arange(step, 22, step)
    path = [*path, *path[::-1], 0.0]
    before, last = np.zeros((GRID.size, 2)), 0.0
    for d, state in zip(path, depths(made, path), strict=True):
        moved = np.hypot(*(state.displacement - before).T).max()
        assert moved <= 2 * abs(d - last) + 1e-6
        before, last = state.displacement, d


def test_tilting_moves_the_tissue_along_and_back():
    made = model()
    inserted = depths(made, np.linspace(0.1, 20, 200))[-1]
    state, sides = inserted, []
    for angle in [*np.linspace(90, 100, 20), *np.linspace(100, 90, 20)]:
        state = made.advance(state, pose(20, angle), 0.02)
        sides.append(state)
    tilted = sides[19]
    deepest = GRID.nearest((20.0, 18.0))
    assert tilted.displacement[deepest, 0] < -0.5 * 18 * np.tan(np.radians(10))
    # the axis turns from +y towards -x, so n = (-axis_y, axis_x) is where the shaft presses
    assert tilted.load.side > 0.5
    assert tilted.load.torque > 0
    assert abs(state.load.side) < 0.1 * tilted.load.side


def test_a_needle_that_leaves_through_the_far_edge_cuts_no_more_there():
    made = model()
    state = depths(made, np.linspace(0.25, 36, 144))[-1]  # the mesh is 30 mm deep
    assert state.load.tip == 0
    assert 0.2 < state.load.friction <= LAW.friction_limit * 30 * (1 + 1e-9)


def test_a_needle_outside_the_tissue_exerts_nothing():
    made, state = model(), model().rest()
    for d in np.linspace(0, 10, 50):
        state = made.advance(state, NeedlePose((20.0, -20.0), (20.0, -15.0 + d / 3)), 0.1)
    assert not state.displacement.any()
    assert state.load.tip == state.load.friction == 0


# ---- the core and the reference ------------------------------------------------------------------------------------------------


@settings(max_examples=6, deadline=None, phases=QUICK)
@given(
    st.lists(
        st.tuples(st.floats(-5, 7), st.floats(-8, 8), st.floats(-1, 1), st.floats(0, 0.2)),
        min_size=2,
        max_size=6,
    ),
    st.sampled_from([0.0, 3.0, 28.0]),
    st.sampled_from([2.0, 10.0, 50.0]),
    st.sampled_from(
        [LAW, replace(LAW, viscosity=5e-4, dead_band=0.1), replace(LAW, tip=0.0, friction_limit=0.03)]
    ),
)
def test_core_and_reference_agree_on_any_path(steps, depth, young, law):
    tissue = response(young)
    native, plain = ForceModel(tissue, law), ForceModel(tissue, law, solver="reference")
    a, b, angle, x = native.rest(), plain.rest(), 80.0, 20.0
    for deeper, turn, shift, dt in steps:
        depth, angle, x = max(depth + deeper, 0.0), angle + turn, x + shift
        at = pose(depth, angle, x)
        a, b = native.advance(a, at, dt), plain.advance(b, at, dt)
        scale = max(1.0, largest(b))
        np.testing.assert_allclose(a.displacement, b.displacement, atol=2e-6 * scale)
        for name in (f.name for f in fields(b.load)):
            assert getattr(a.load, name) == pytest.approx(getattr(b.load, name), abs=1e-6 * scale), name


def test_the_solution_of_the_programme_is_that_of_another_solver():
    rng = np.random.default_rng(2)
    for n in (1, 4, 15, 40):
        for _ in range(10):
            root = rng.normal(size=(n, n)) + np.diag(rng.uniform(0.3, 3, n))
            A, b = root @ root.T, rng.normal(size=n) * 3
            low, high = -rng.uniform(0, 1, n), rng.uniform(0, 1, n)
            low[rng.random(n) < 0.2], high[rng.random(n) < 0.2] = -np.inf, np.inf
            L = np.linalg.cholesky(A)
            other = lsq_linear(L.T, np.linalg.solve(L, b), (low, high), method="bvls", tol=1e-14).x
            np.testing.assert_allclose(solve_box(A, b, low, high, np.zeros(n)), other, atol=1e-6)


@pytest.mark.parametrize("left_out", [["MOST_GUESSES"], ["MOST_GUESSES", "MOST_CHANGES"]])
def test_the_slower_ways_reach_what_guessing_reaches(monkeypatch, left_out):
    rng = np.random.default_rng(3)
    root = rng.normal(size=(12, 12)) + 3 * np.eye(12)
    A, b = root @ root.T, rng.normal(size=12) * 5
    low, high, soft = -np.full(12, 0.1), np.full(12, 0.2), np.where(rng.random(12) < 0.5, 0.7, 0.0)
    guessed = solve_box(A, b, low, high, soft)
    for name in left_out:
        monkeypatch.setattr(law_in_numpy, name, 0)
    np.testing.assert_allclose(solve_box(A, b, low, high, soft), guessed, atol=1e-10)


# ---- parameters ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"tip": -1.0},
        {"friction_limit": np.nan},
        {"bond": 0.0},
        {"substep": 0.0},
        {"station_spacing": -1.0},
        {"dead_band": -0.1},
    ],
)
def test_a_parameter_out_of_its_range_is_named_with_its_unit(wrong):
    with pytest.raises(InputError, match=rf"{next(iter(wrong))} must be .* in (N|mm)"):
        NeedleForces(**wrong)


def test_stations_too_close_for_the_tissue_are_refused():
    with pytest.raises(InputError, match=r"station_spacing must be 0\.1 mm or more"):
        model(replace(LAW, station_spacing=0.05))
