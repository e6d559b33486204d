"""Green's function of clamped tissue under a free surface: against its own laws and against finite elements."""

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.mechanics import FEMModel, GreenModel, ViscousForces
from echospline.mechanics.half_plane import GreensFunction, fundamental
from echospline.scene import Circle, Insertion, NeedlePose, Region, RegularGrid, Tissue

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
NU = 0.31
BOX = ("left", "right", "bottom")
SOURCE = np.array([[3.0, 2.0]])


def displacement_gradient(p, h=1e-4, surface=0.0):
    """du_i/dx_j per force direction by central differences, shape (2, 2, 2)."""
    steps = np.array([[h, 0], [-h, 0], [0, h], [0, -h]])
    u = fundamental(p + steps, SOURCE, NU, 1e-9, surface).reshape(2, 4, 2)
    return np.stack([(u[:, 0] - u[:, 1]) / (2 * h), (u[:, 2] - u[:, 3]) / (2 * h)], axis=1)


def test_surface_carries_no_traction():
    lam = 2 * NU / (1 - 2 * NU)
    for x in (-4.0, 1.3, 3.0, 9.0):
        g = displacement_gradient(np.array([x, 1e-4]))
        syy = lam * (g[0, 0] + g[1, 1]) + 2 * g[1, 1]
        sxy = g[0, 1] + g[1, 0]
        sxx = lam * (g[0, 0] + g[1, 1]) + 2 * g[0, 0]
        assert np.abs([syy, sxy]).max() < 2e-3
        assert np.abs(sxx).max() > 0.05  # the surface is not simply unloaded


def test_field_is_in_equilibrium_away_from_the_force():
    """Navier: (lambda + mu) grad div u + mu Laplacian u = 0."""
    p, h = np.array([5.0, 3.5]), 1e-2
    offsets = np.array([[i, j] for j in (-1, 0, 1) for i in (-1, 0, 1)]) * h
    u = fundamental(p + offsets, SOURCE, NU, 1e-9, 0.0).reshape(2, 3, 3, 2)  # component, y, x, force
    xx = (u[:, 1, 2] - 2 * u[:, 1, 1] + u[:, 1, 0]) / h**2
    yy = (u[:, 2, 1] - 2 * u[:, 1, 1] + u[:, 0, 1]) / h**2
    xy = (u[:, 2, 2] - u[:, 2, 0] - u[:, 0, 2] + u[:, 0, 0]) / (4 * h**2)
    ratio = 1 / (1 - 2 * NU)
    residual_x = ratio * (xx[0] + xy[1]) + xx[0] + yy[0]
    residual_y = ratio * (xy[0] + yy[1]) + xx[1] + yy[1]
    assert np.abs([residual_x, residual_y]).max() < 1e-4 * np.abs([xx, yy]).max()


@pytest.mark.parametrize("surface", [None, 0.0])
def test_force_here_and_displacement_there_may_be_swapped(surface):
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 10, (5, 2)), rng.uniform(0, 10, (4, 2))
    there = fundamental(a, b, NU, 0.4, surface)
    np.testing.assert_allclose(there, fundamental(b, a, NU, 0.4, surface).T, rtol=1e-12, atol=1e-12)


def test_deep_down_the_surface_is_not_felt():
    """Far below the surface the field of a pair of opposite forces is Kelvin's."""
    pair = np.array([[0.0, 1000.0], [0.5, 1001.0]])
    points = np.array([[3.0, 998.0], [-2.0, 1003.0]])
    with_surface, without = (
        fundamental(points, pair, NU, 0.1, s) @ np.array([1.0, -1.0, 0.5, -0.5]) for s in (0.0, None)
    )
    turned = with_surface - without
    np.testing.assert_allclose(turned, 0, atol=2e-2 * np.abs(without).max())


def test_anchors_stay():
    anchors = np.array([[0.0, 0.0], [0.0, 10.0], [20.0, 10.0], [20.0, 0.0], [10.0, 10.0]])
    G = GreensFunction(anchors, 10.0, 0.45, 40.0, surface=0.0)
    held = G.columns(anchors, [[7.0, 4.0]])
    moved = G.columns([[7.5, 4.0]], [[7.0, 4.0]])
    assert np.abs(held).max() < 1e-10 * np.abs(moved).max()


def test_clamped_response_is_symmetric_and_positive():
    corners = np.array([[0.0, 0.0], [0.0, 10.0], [20.0, 10.0], [20.0, 0.0]])
    G = GreensFunction(corners, 10.0, 0.45, 40.0, radius=0.3, anchor_radius=0.3, surface=0.0)
    p = np.random.default_rng(1).uniform((1, 1), (19, 9), (6, 2))
    C = G.columns(p, p)
    np.testing.assert_allclose(C, C.T, atol=1e-10 * np.abs(C).max())
    assert (np.linalg.eigvalsh(C) > 0).all()


@pytest.mark.parametrize(
    ("entry", "angle", "depth", "friction"),
    [((12, 0), 60, 26, 0.0), ((26, 0), 115, 22, 1e-3), ((20, 0), 90, 24, 1e-4), ((6, 0), 45, 24, 1e-3)],
)
def test_green_agrees_with_finite_elements_without_any_fitting(entry, angle, depth, friction):
    """Same E, nu, thickness, forces: mean difference below 3 % of the mean displacement at every depth."""
    forces = ViscousForces(0.4, friction, ramp=0.0)
    fem, green = FEMModel(GRID, BOX, forces=forces), GreenModel(GRID, BOX, forces=forces)
    insertion = Insertion.straight(entry, angle, depth)
    a, b = fem.rest(), green.rest()
    for t in np.linspace(0, insertion.duration, 11)[1:]:
        a, b = fem.advance(a, insertion.pose(t), 0.5), green.advance(b, insertion.pose(t), 0.5)
        difference = np.hypot(*(a.displacement - b.displacement).T).mean()
        assert difference < 0.03 * np.hypot(*a.displacement.T).mean()


def test_difference_to_finite_elements_falls_as_both_are_refined():
    pose = NeedlePose((12, 0), (21.3, 16.2), 5.0)
    differences = []
    for n, spacing in ((1, 2.0), (2, 1.0), (4, 0.5)):
        grid = RegularGrid((20 * n + 1, 15 * n + 1), (2.0 / n, 2.0 / n))
        forces = ViscousForces(0.4, 0.0, ramp=0.0)
        fem = FEMModel(grid, BOX, forces=forces)
        green = GreenModel(grid, BOX, forces=forces, radius=0.2, anchor_spacing=spacing)
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


def test_tissue_with_regions_is_refused():
    lesion = Tissue(regions=[Region(Circle((20, 15), 5), 90.0)])
    with pytest.raises(InputError, match=r"homogeneous.*fem"):
        GreenModel(GRID, BOX, lesion)


def test_points_above_the_surface_are_refused():
    model = GreenModel(GRID, BOX)
    state = model.advance(model.rest(), NeedlePose((12, 0), (15, 10), 5.0), 0.1)
    with pytest.raises(InputError, match="above the surface"):
        model.displacement_at(state, [(3.0, -1.0)])
