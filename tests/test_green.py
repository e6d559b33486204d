"""The model of Green's function under a needle: against finite elements, and its bookkeeping."""

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.mechanics import FEMModel, GreenModel, ViscousForces
from echospline.scene import Circle, Insertion, NeedlePose, Region, RegularGrid, Tissue

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
BOX = ("left", "right", "bottom")


@pytest.mark.parametrize(
    ("entry", "angle", "depth", "friction"),
    [((12, 0), 60, 26, 0.0), ((26, 0), 115, 22, 1e-3), ((20, 0), 90, 24, 1e-4), ((6, 0), 45, 24, 1e-3)],
)
def test_green_agrees_with_finite_elements_without_any_fitting(entry, angle, depth, friction):
    """Same E, nu, thickness, forces: mean difference below 2 % of the mean displacement at every depth."""
    forces = ViscousForces(0.4, friction, ramp=0.0)
    fem, green = FEMModel(GRID, BOX, forces=forces), GreenModel(GRID, BOX, forces=forces)
    insertion = Insertion.straight(entry, angle, depth)
    a, b = fem.rest(), green.rest()
    for t in np.linspace(0, insertion.duration, 11)[1:]:
        a, b = fem.advance(a, insertion.pose(t), 0.5), green.advance(b, insertion.pose(t), 0.5)
        difference = np.hypot(*(a.displacement - b.displacement).T).mean()
        assert difference < 0.02 * np.hypot(*a.displacement.T).mean()


def test_difference_to_finite_elements_falls_as_both_are_refined():
    pose = NeedlePose((12, 0), (21.3, 16.2), 5.0)
    differences = []
    for n in (1, 2, 4):
        grid = RegularGrid((20 * n + 1, 15 * n + 1), (2.0 / n, 2.0 / n))
        forces = ViscousForces(0.4, 0.0, ramp=0.0)
        fem = FEMModel(grid, BOX, forces=forces)
        green = GreenModel(grid, BOX, forces=forces, radius=0.2)
        away = np.hypot(*(grid.nodes - pose.tip).T) > 3.0
        u, v = (m.advance(m.rest(), pose, 1.0).displacement[away] for m in (fem, green))
        differences.append(np.hypot(*(u - v).T).mean() / np.hypot(*u.T).mean())
    assert differences[2] < differences[1] < differences[0]
    assert differences[2] < 0.005


def test_field_at_nodes_is_the_field_at_points():
    model = GreenModel(GRID, BOX, forces=ViscousForces(0.4, 1e-3))
    state = model.rest()
    for t in (1.0, 2.0, 3.3):
        state = model.advance(state, Insertion.straight((12, 0), 60, 26).pose(t), 1.0)
    np.testing.assert_allclose(model.displacement_at(state, GRID.nodes), state.displacement, atol=1e-12)


@pytest.mark.parametrize("depth", [0.3, 7.0, 12.6])
def test_stations_carry_the_whole_shaft_and_its_moment(depth):
    """Lengths add up to the depth; whole stations have their centre in the middle of what they stand for."""
    model = GreenModel(GRID, BOX)
    pose = Insertion.straight((12, 0), 60, depth).pose(depth / 5)
    points, covered = model.stations(pose)
    assert covered.sum() == pytest.approx(depth)
    whole = covered == model.station_spacing
    centre = np.average(points[whole], axis=0, weights=covered[whole]) if whole.any() else None
    if centre is not None:
        expected = np.array([12.0, 0.0]) + np.floor(depth + 1e-9) / 2 * np.array(pose.axis)
        np.testing.assert_allclose(centre, expected, atol=1e-9)


def test_stations_kept_between_steps_change_nothing():
    model = GreenModel(GRID, BOX, forces=ViscousForces(0.4, 1e-3, ramp=0.0))
    insertion = Insertion.straight((12, 0), 60, 26)
    stepped = model.rest()
    for t in np.linspace(0.1, 5.0, 20):
        stepped = model.advance(stepped, insertion.pose(t), 0.1)
    at_once = model.advance(model.rest(), insertion.pose(5.0), 5.0)
    np.testing.assert_allclose(stepped.displacement, at_once.displacement, atol=1e-10)


def test_tissue_with_regions_agrees_with_finite_elements():
    tissue = Tissue(regions=[Region(Circle((20, 15), 5), 50.0)])
    forces, pose = ViscousForces(0.4, 0.0, ramp=0.0), NeedlePose((12, 0), (16, 9), 5.0)
    grid = RegularGrid((81, 61), (0.5, 0.5))
    u, v = (
        m.advance(m.rest(), pose, 1.0).displacement
        for m in (kind(grid, BOX, tissue, forces) for kind in (FEMModel, GreenModel))
    )
    assert np.hypot(*(u - v).T).mean() < 0.03 * np.hypot(*u.T).mean()


def test_points_above_the_surface_are_refused():
    model = GreenModel(GRID, BOX)
    state = model.advance(model.rest(), NeedlePose((12, 0), (15, 10), 5.0), 0.1)
    with pytest.raises(InputError, match="must lie in the tissue"):
        model.displacement_at(state, [(3.0, -1.0)])
