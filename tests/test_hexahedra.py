"""Quadratic hexahedra and closed forms corrected by them, against scikit-fem's elements and against loads spread over fine elements."""

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.mechanics.half_space import kelvinlet
from echospline.mechanics.hexahedra import MOST_NODES, Hexahedra, lines_for
from echospline.mechanics.landmarks import SIDES, Clamps
from echospline.mechanics.space_response import SpaceResponse, block, shear_modulus
from echospline.mechanics.spatial_fem_response import SpatialFEMResponse
from echospline.scene import Box, Label, Layer, Region, RegularGrid, SpatialGrid, Sphere, Tissue, VolumeLabel
from space_reference import Corrected

SIZE = (24.0, 20.0, 18.0)
WALLS = dict.fromkeys(("left", "right", "bottom", "front", "back"), "clamped")
HELD = {
    "walls": {face: WALLS.get(face, "free") for face in SIDES},
    "probe": {face: {**WALLS, "top": "sliding"}.get(face, "free") for face in SIDES},
    "mirror": {
        face: {"bottom": "clamped", "left": "sliding", "top": "sliding"}.get(face, "free") for face in SIDES
    },
}
PLACES = np.array([[-2.0, 6.0, 0.5], [-1.4, 6.8, 0.5], [-0.8, 7.6, 0.5]])
FORCES = np.outer([0.05, 0.05, 0.2], [0.6, 0.8, 0.0])


def points(n=7):
    x, y, z = (np.linspace(a, b, n) for a, b in ((-11, 11), (0.1, 19.5), (-8, 8)))
    return np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3)


def summed(response, places=PLACES, forces=FORCES):
    return response.field_of([response.column(p[None], np.ones(1)) for p in places], forces)


def off(u, v):
    return np.linalg.norm(u - v, axis=1).mean() / np.linalg.norm(v, axis=1).mean()


def test_the_stiffness_is_that_of_scikit_fem():
    grid, clamps = block(SIZE, HELD["walls"])
    ours = Hexahedra(lines_for(grid, Tissue(), 8.0), Tissue(10.0, 0.45), clamps)
    theirs = Corrected(*grid.corners, HELD["walls"], 10.0, 0.45, 8.0)
    places = theirs.basis.doflocs.T
    node = np.array([np.abs(ours.nodes - p).sum(axis=1).argmin() for p in places])
    order = 3 * node + np.arange(len(node)) % 3
    difference = abs(ours.stiffness.tocsr()[order][:, order] - theirs.K).max()
    assert difference < 1e-12 * abs(theirs.K).max()


@pytest.mark.parametrize("held", HELD)
def test_corrected_closed_forms_are_those_of_scikit_fem_on_the_same_mesh(held):
    grid, clamps = block(SIZE, HELD[held])
    tissue = Tissue(10.0, 0.45)
    ours, base = SpatialFEMResponse(grid, clamps, tissue, cell=5.0), SpaceResponse(grid, clamps, tissue)
    theirs = Corrected(*grid.corners, HELD[held], 10.0, 0.45, 5.0)
    v = theirs.correct(
        lambda p: base._moves(p, PLACES, FORCES), lambda p, n: base._pulls(p, n, PLACES, FORCES), points()
    )
    # a free surface is freed by a point's image: the reference takes away what that leaves of a spread force
    assert off(summed(ours)(points()), v) < (2.5e-3 if held == "walls" else 1e-5)


def spread_load(mesh, places, forces, radius):
    """Nodal loads of forces spread as the Kelvinlet spreads them: no closed form of the displacement is in it."""
    q = mesh.integration_points(5)
    body = np.zeros_like(q)
    for p, f in zip(places, forces, strict=True):
        R2 = ((q - p) ** 2).sum(axis=2) + radius**2
        body += (15 * radius**4 / (8 * np.pi) * R2**-3.5)[:, :, None] * f
    return mesh.integrated(body)


def graded(low, high, a, b, fine=1.3, coarse=4.5, through=()):
    """A line whose cells are fine from a to b and grow outside, with points on interfaces."""
    line = [low]
    while line[-1] < high - 1e-9:
        away = max(a - line[-1] - fine, line[-1] - b, 0.0)
        line.append(line[-1] + min(coarse, fine + 0.45 * away))
    line = low + (np.array(line) - low) * (high - low) / (line[-1] - low)
    return np.unique(np.append(line, through))


@pytest.mark.parametrize(
    ("regions", "interfaces", "allowed"),
    [
        ([], ((), (), ()), 0.012),
        ([Region(Sphere((5.5, 9.0, 0.0), 4.0), 50.0)], ((), (), ()), 0.045),
        ([Region(Layer(11.0, 20.0), 50.0)], ((), (11.0,), ()), 0.045),
        ([Region(Box((-12.0, 10.0, -9.0), (0.0, 20.0, 9.0)), 2.0)], ((0.0,), (10.0,), ()), 0.045),
    ],
    ids=["homogeneous", "stiff sphere", "stiff layer", "soft box"],
)
def test_regions_answer_as_fine_elements_under_a_spread_load(regions, interfaces, allowed):
    radius = 1.2
    grid, clamps = block(SIZE, HELD["walls"])
    tissue = Tissue(10.0, 0.45, regions)
    low, high = grid.corners
    ends = PLACES.min(axis=0) - 1.0, PLACES.max(axis=0) + 1.0
    lines = tuple(graded(low[k], high[k], ends[0][k], ends[1][k], through=interfaces[k]) for k in range(3))
    fine = Hexahedra(lines, tissue, clamps)
    v = fine.at(fine.solve(spread_load(fine, PLACES, FORCES, radius)[:, :, None])[:, :, 0], points())
    u = summed(SpatialFEMResponse(grid, clamps, tissue, cell=3.5, radius=radius))(points())
    assert off(u, v) < allowed


def test_a_region_that_is_everything_is_homogeneous_tissue():
    grid, clamps = block(SIZE, HELD["walls"])
    whole = Tissue(10.0, 0.45, [Region(Box((-50, -1, -50), (50, 50, 50)), 30.0)])
    a, b = (SpatialFEMResponse(grid, clamps, tissue, cell=6.0) for tissue in (whole, Tissue(30.0, 0.45)))
    np.testing.assert_allclose(summed(a)(points()), summed(b)(points()), atol=1e-9)


def test_columns_are_reciprocal():
    """Maxwell and Betti: the displacement at b by a force at a is that at a by a force at b, over interfaces too."""
    grid, clamps = block(SIZE, HELD["walls"])
    tissue = Tissue(10.0, 0.45, [Region(Layer(11.0, 20.0), 50.0)])
    response = SpatialFEMResponse(grid, clamps, tissue, cell=3.5)
    a, b = np.array([[-4.0, 6.0, 2.0]]), np.array([[3.0, 14.0, -2.0]])
    ab = response.column_at(response.column(a, np.ones(1)), b)[0]
    ba = response.column_at(response.column(b, np.ones(1)), a)[0]
    np.testing.assert_allclose(ab, ba.T, atol=0.03 * np.abs(ab).max())


def test_quadratic_fields_are_interpolated_exactly():
    grid, clamps = block(SIZE, HELD["walls"])
    mesh = Hexahedra(lines_for(grid, Tissue(regions=[Region(Layer(7.3, 20.0), 50.0)]), 5.0), Tissue(), clamps)

    def quadratic(p):
        x, y, z = p.T
        return np.stack([x * x - y * z, 1 + y * y * z, x * y * z], axis=1)

    p = points()
    np.testing.assert_allclose(mesh.at(quadratic(mesh.nodes), p), quadratic(p), atol=1e-9)
    assert 7.3 in mesh.lines[1]


def test_columns_at_points_are_the_field_of_one_force():
    grid, clamps = block(SIZE, HELD["probe"])
    tissue = Tissue(10.0, 0.45)
    for response in (SpatialFEMResponse(grid, clamps, tissue, cell=6.0), SpaceResponse(grid, clamps, tissue)):
        column = response.column(PLACES, np.array([0.25, 0.5, 0.25]))
        f = np.array([0.1, 0.2, -0.3])
        inside = points()[(np.abs(points()) < [10.9, 19.4, 7.9]).all(axis=1)]
        u = response.field_of([column], f[None])(inside)
        # the field carries what the faces do on a lattice
        np.testing.assert_allclose(response.column_at(column, inside) @ f, u, atol=4e-3 * np.abs(u).max())


def test_too_fine_a_mesh_is_refused():
    with pytest.raises(InputError, match=str(MOST_NODES)):
        lines_for(block(SIZE, HELD["walls"])[0], Tissue(), 0.6)


# ---- shapes in space -------------------------------------------------------------------------------------------------------------


def test_shapes_in_space_contain_what_they_say():
    p = np.array([[0.0, 5, 0], [0, 5, 2.9], [0, 5, 3.1], [9, 5, 0]])
    assert Sphere((0, 5, 0), 3.0).contains(p).tolist() == [True, True, False, False]
    assert Box((-1, 0, -1), (1, 10, 3)).contains(p).tolist() == [True, True, False, False]
    labels = np.zeros((4, 3, 2), dtype=np.uint8)
    labels[3, 1, 0] = 7
    grid = SpatialGrid((2, 3, 4), (2.0, 5.0, 1.0), (0.0, 0.0, 0.0))
    assert VolumeLabel(labels, grid, 7).contains(p).tolist() == [False, True, True, False]
    assert Layer(5.0, 6.0).contains(p).all()
    young, poisson = Tissue(10, 0.45, [Region(Sphere((0, 5, 0), 3.0), 50, 0.3)]).at(p)
    assert young.tolist() == [50, 50, 10, 10]
    assert poisson.tolist() == [0.3, 0.3, 0.45, 0.45]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Sphere((0, 0, 0), -1.0), "radius of a sphere"),
        (lambda: Box((0, 0, 0), (1, 0, 1)), "lower to a higher corner"),
        (lambda: VolumeLabel(np.zeros((2, 2, 2)), SpatialGrid((2, 2, 2), (1, 1, 1)), 1), "must be integers"),
        (
            lambda: Tissue(10, 0.45, [Region(Sphere((0, 5, 0), 3.0), 50)]).at([[0.0, 5.0]]),
            "use a circle or a layer",
        ),
        (
            lambda: Label(np.zeros((2, 2), dtype=int), RegularGrid((2, 2), (1, 1)), 1).contains(
                np.zeros((1, 3))
            ),
            "labels of a volume or a layer",
        ),
    ],
)
def test_shapes_that_make_no_sense_get_a_sentence(make, said):
    with pytest.raises(InputError, match=said):
        make()


def test_the_closed_form_is_what_elements_are_given_to_correct():
    """With faces far away the elements have next to nothing to do."""
    grid = SpatialGrid.spanning((-2000, 0, -2000), (2000, 4000, 2000), (3, 3, 3))
    response = SpatialFEMResponse(grid, Clamps.of(grid, WALLS), Tissue(10.0, 0.45), cell=1000.0)
    place = np.array([[0.0, 10.0, 0.0]])
    near = np.array([[3.0, 9.0, 2.0], [-2.0, 4.0, 1.0]])
    exact = kelvinlet(near, place, 0.45, 0.7, "free")[:, :, 0] / (
        16 * np.pi * shear_modulus(10.0, 0.45) * 0.55
    )
    u = response.column_at(response.column(place, np.ones(1)), near)
    np.testing.assert_allclose(u, exact, atol=0.01 * np.abs(exact).max())


@pytest.mark.parametrize(("least", "within"), [(10.0, 0.05), (0.0, None)], ids=["solid about it", "its own"])
def test_a_force_in_fluid_moves_what_is_about_the_fluid(least, within):
    """Against a spread load on fine elements, outside the fluid: the closed form of the fluid itself is too steep to be corrected."""
    grid = SpatialGrid((5, 5, 5), (7.5, 7.0, 7.5), (-15.0, 0.0, -15.0))
    clamps = Clamps.of(grid, ["left", "right", "bottom", "front", "back"])
    ball, radius = Sphere((0.0, 13.0, 0.0), 4.0), 3.0
    tissue = Tissue(10.0, 0.45, [Region(ball, 0.5, 0.49, "urine", fluid=True)])
    place, force = np.array([[0.5, 12.5, 0.3]]), np.array([[0.1, 0.2, 0.0]])
    low, high = grid.corners
    lines = tuple(
        graded(low[k], high[k], ball.centre[k] - 4.5, ball.centre[k] + 4.5, 2.0, 6.0) for k in range(3)
    )
    fine = Hexahedra(lines, tissue, clamps)
    values = fine.solve(spread_load(fine, place, force, radius)[:, :, None])[:, :, 0]
    p = np.random.default_rng(0).uniform(low + 1, high - 1, (800, 3))
    outside = p[np.linalg.norm(p - ball.centre, axis=1) > 5.0]
    response = SpatialFEMResponse(grid, clamps, tissue, cell=5.0, radius=radius, least=least)
    error = off(
        response.field_of([response.column(place, np.ones(1))], force)(outside), fine.at(values, outside)
    )
    assert error > 0.2 if within is None else error < within


def test_stiffness_less_that_of_other_tissue_is_that_of_the_difference():
    grid, clamps = block(SIZE, HELD["walls"])
    lines = lines_for(grid, Tissue(), 6.0)
    some = Hexahedra(lines, Tissue(10.0, 0.45, [Region(Layer(10.0, 20.0), 30.0)]), clamps)
    for young, poisson in ((10.0, 0.45), (7.0, 0.3), (30.0, 0.45)):
        less = some.difference(young, poisson)
        other = Hexahedra(lines, Tissue(young, poisson), clamps)
        np.testing.assert_allclose(
            less.toarray(),
            (some.stiffness - other.stiffness).toarray(),
            atol=1e-12 * abs(some.stiffness).max(),
        )
