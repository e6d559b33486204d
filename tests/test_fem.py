"""Finite elements under a needle: forces, their build-up and relaxation, and agreement with the pure solver."""

from itertools import pairwise

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.mechanics import FEMModel, ViscousForces
from echospline.mechanics.finite_elements import factor, point_loads, stiffness
from echospline.scene import Circle, Insertion, NeedlePose, Region, RegularGrid, Tissue

GRID = RegularGrid((31, 25), (40 / 30, 30 / 24))
PRINTED = ViscousForces(ramp=0.0)
PUSH = NeedlePose((8.0, 0.0), (22.0, 14.0), 5.0)


def run(model, insertion, dt):
    state, before = model.rest(), insertion.times[0]
    for t in np.arange(1, round(insertion.duration / dt) + 1) * dt:
        state = model.advance(state, insertion.pose(t), t - before)
        before = t
    return state


def test_printed_law_is_one_solve_with_the_force_at_the_tip():
    model = FEMModel(GRID, forces=ViscousForces(0.4, 0.0, ramp=0.0))
    state = model.advance(model.rest(), PUSH, 0.1)
    K = stiffness(GRID, 10.0, 0.45, 40.0)
    axis = np.array([1.0, 1.0]) / np.sqrt(2)
    expected = factor(K, GRID.boundary(["left", "right", "bottom"]), "superlu").solve(
        point_loads(GRID, PUSH.tip, 0.4 * axis)
    )
    np.testing.assert_allclose(model.displacement(state), expected, atol=1e-12)


def test_friction_loads_add_up_to_speed_times_length_times_coefficient():
    model = FEMModel(GRID, forces=ViscousForces(friction=1e-3))
    total = model.friction_loads(PUSH).sum(axis=0)
    np.testing.assert_allclose(total, 1e-3 * 5.0 * np.array([14.0, 14.0]))


def test_withdrawal_drags_the_tissue_back():
    model = FEMModel(GRID, forces=ViscousForces(0.0, 1e-3, ramp=0.0))
    out = NeedlePose(PUSH.entry, PUSH.tip, -5.0)
    pushed = model.displacement(model.advance(model.rest(), PUSH, 0.1))
    pulled = model.displacement(model.advance(model.rest(), out, 0.1))
    np.testing.assert_allclose(pulled, -pushed, atol=1e-14)


def test_displacement_is_inversely_proportional_to_youngs_modulus():
    soft, stiff = (FEMModel(GRID, tissue=Tissue(E), forces=PRINTED) for E in (5.0, 20.0))
    a, b = (m.displacement(m.advance(m.rest(), PUSH, 0.1)) for m in (soft, stiff))
    np.testing.assert_allclose(a, 4 * b, rtol=1e-9, atol=1e-12)


def test_friction_relaxes_exponentially_once_the_needle_stops():
    model = FEMModel(GRID, forces=ViscousForces(0.0, 1e-3, alpha3=0.7, ramp=0.0))
    pushed = model.advance(model.rest(), PUSH, 0.1)
    still = NeedlePose(PUSH.entry, PUSH.tip, 0.0)
    once = model.advance(pushed, still, 1.0)
    twice = model.advance(model.advance(pushed, still, 0.5), still, 0.5)
    np.testing.assert_allclose(model.displacement(once), model.displacement(pushed) * np.exp(-0.7), rtol=1e-9)
    np.testing.assert_allclose(model.displacement(twice), model.displacement(once), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("ramp", [0.0, 1.0])
def test_tip_force_stays_while_the_needle_rests(ramp):
    model = FEMModel(GRID, forces=ViscousForces(friction=0.0, ramp=ramp))
    insertion = Insertion.straight((8, 0), 45, 18, 5, dwell=2.0)
    arrived = run(model, Insertion.straight((8, 0), 45, 18, 5), 0.02)
    rested = run(model, insertion, 0.02)
    assert np.abs(arrived.displacement).max() > 0.1
    np.testing.assert_allclose(rested.displacement, arrived.displacement, atol=1e-9)


@pytest.mark.parametrize("steps_per_second", [30, 60, 120])
def test_the_field_never_jumps(steps_per_second):
    """No node moves further in a step than a few times the needle, through insertion, rest and withdrawal."""
    model = FEMModel(GRID, forces=ViscousForces(friction=1e-4))
    insertion = Insertion.straight((8, 0), 60, 20, 5, dwell=1.0, retract=True)
    state, worst = model.rest(), 0.0
    dt = 1 / steps_per_second
    for t in np.arange(1, int(insertion.duration / dt) + 2) * dt:
        new = model.advance(state, insertion.pose(t), dt)
        worst = max(worst, np.hypot(*(new.displacement - state.displacement).T).max())
        state = new
    assert worst < 3 * 5.0 * dt  # the same bound at every rate: a jump would not shrink with dt


def test_withdrawn_needle_leaves_tissue_that_comes_to_rest():
    model = FEMModel(GRID, forces=ViscousForces(friction=1e-4))
    insertion = Insertion.straight((8, 0), 60, 20, 5, retract=True)
    state = run(model, insertion, 1 / 30)
    out = insertion.pose(insertion.duration)
    for _ in range(100):
        state = model.advance(state, NeedlePose(out.entry, out.tip, 0.0), 0.5)
    assert np.abs(state.displacement).max() < 1e-6


def test_step_length_matters_only_to_first_order():
    """Friction that grows with the shaft builds up with travel: the error of a step falls as dt."""
    model = FEMModel(GRID, forces=ViscousForces(friction=1e-3))
    insertion = Insertion.straight((8, 0), 60, 20, 5)
    fields = [run(model, insertion, 4 / n).displacement for n in (50, 100, 200, 400)]
    steps = [np.abs(a - b).max() for a, b in pairwise(fields)]
    assert steps[-1] < 0.6 * steps[-2] < 0.36 * steps[-3] + 1e-6


def test_stiff_lesion_deforms_less():
    lesion = Circle((20.0, 15.0), 5.0)
    soft = FEMModel(GRID, forces=PRINTED)
    stiff = FEMModel(GRID, tissue=Tissue(10.0, regions=[Region(lesion, 100.0)]), forces=PRINTED)
    pose = NeedlePose((8.0, 0.0), (12.0, 11.0), 5.0)
    strains = []
    for model in (soft, stiff):
        u = model.displacement(model.advance(model.rest(), pose, 0.1)).reshape(25, 31, 2)
        by_y, by_x = np.gradient(u, *GRID.spacing[::-1], axis=(0, 1))
        strain = np.stack([by_x[..., 0], by_y[..., 1], (by_x[..., 1] + by_y[..., 0]) / 2])
        inside = lesion.contains(GRID.nodes).reshape(25, 31)
        strains.append(np.abs(strain[:, inside]).mean())
    assert strains[1] < 0.3 * strains[0]


def test_only_the_part_of_the_needle_in_the_tissue_acts():
    model = FEMModel(GRID, forces=ViscousForces(0.4, 1e-3, ramp=0.0))
    outside = model.advance(model.rest(), NeedlePose((8, -20), (8, -5), 5.0), 0.1)
    assert not outside.displacement.any()
    reaching = model.friction_loads(NeedlePose((8, -20), (8, 5), 5.0))
    np.testing.assert_allclose(reaching.sum(axis=0), (0.0, 1e-3 * 5 * 5))


def test_points_outside_the_tissue_are_refused():
    model = FEMModel(GRID)
    with pytest.raises(InputError, match="must lie in the mesh"):
        model.displacement_at(model.rest(), [(50.0, 3.0)])


@pytest.mark.parametrize("dt", [-0.1, float("nan")])
def test_bad_time_step_is_refused(dt):
    model = FEMModel(GRID)
    with pytest.raises(InputError, match="dt must be"):
        model.advance(model.rest(), PUSH, dt)


def test_nearly_incompressible_plane_strain_needs_no_choice():
    pose = PUSH
    fields = []
    for nu in (0.49, 0.4999):
        model = FEMModel(GRID, tissue=Tissue(10.0, nu, plane="strain"), forces=PRINTED)
        fields.append(model.displacement(model.advance(model.rest(), pose, 0.1)))
    change = np.abs(fields[1] - fields[0]).max() / np.abs(fields[0]).max()
    assert change < 0.15  # locking would shrink the field many times
