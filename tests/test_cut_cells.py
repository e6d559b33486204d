"""Elements that a boundary crosses: exact for layers, within bounds, and close to quadratic elements that follow the boundary."""

import numpy as np
import pytest

from cut_cell_reference import QuadraticPlane, needle
from echospline.mechanics import Clamps
from echospline.mechanics.cut_cells import elements_of, isotropic, laminate, normals
from echospline.mechanics.fem_response import FEMResponse
from echospline.mechanics.finite_elements import factor, line_loads, stiffness
from echospline.scene import Circle, Label, Layer, Region, RegularGrid, Tissue

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
SIZE = (40.0, 30.0)
NEEDLES = (
    ((12.0, 0.0), 60.0, 22.0),
    ((26.0, 0.0), 115.0, 22.0),
    ((20.0, 0.0), 90.0, 20.0),
    ((6.0, 0.0), 45.0, 24.0),
)


def sides_and_bottom(p):
    on = (np.abs(p[:, 0] * (p[:, 0] - SIZE[0])) < 1e-6) | (np.abs(p[:, 1] - SIZE[1]) < 1e-9)
    return np.stack([on, on], axis=1)


def errors(tissue, circles, h, grid=GRID):
    """Mean distance to the reference as a share of its mean displacement, %, for each needle."""
    reference = QuadraticPlane(SIZE, h, circles, lambda p: tissue.at(p)[0], sides_and_bottom)
    response = FEMResponse(grid, Clamps.of(grid, ("left", "right", "bottom")), tissue)
    shares = []
    for each in NEEDLES:
        places, forces = needle(*each)
        truth = reference.solve(places, forces, grid.nodes)
        u = response.answer(places, forces[..., None], grid.nodes[:1])[0][..., 0]
        shares.append(100 * np.hypot(*(u - truth).T).mean() / np.hypot(*truth.T).mean())
    return np.array(shares)


@pytest.mark.parametrize(
    ("centre", "radius", "young", "mean", "worst"),
    [
        ((24.0, 15.0), 5.0, 1.0, 3.0, 5.0),  # ten times as soft
        ((23.0, 19.0), 5.0, 1.0, 3.0, 5.0),
        ((24.0, 17.0), 6.0, 2.0, 2.0, 3.0),
        ((24.0, 17.0), 6.0, 50.0, 1.0, 2.0),
        ((20.0, 15.0), 5.0, 50.0, 1.2, 2.2),
    ],
)
def test_lesions_are_close_to_quadratic_elements_that_follow_them(centre, radius, young, mean, worst):
    shares = errors(Tissue(10.0, regions=[Region(Circle(centre, radius), young)]), [(centre, radius)], 0.5)
    assert shares.mean() < mean
    assert shares.max() < worst


@pytest.mark.parametrize(
    ("bottom", "young", "mean"), [(18.0, 50.0, 1.0), (18.0, 2.0, 1.5), (31.0, 50.0, 0.8)]
)
def test_layers_across_cells_are_close_to_quadratic_elements_that_end_at_them(bottom, young, mean):
    tissue = Tissue(10.0, regions=[Region(Layer(10.4, bottom), young)])
    assert errors(tissue, [], 0.4).mean() < mean


@pytest.mark.parametrize("top", [10.3, 10.6, 10.9])
def test_layers_across_cells_stretch_as_springs_in_series_and_in_parallel(top):
    """Exact for a straight boundary anywhere in a cell (nu = 0, so that nothing bulges)."""
    grid, soft, stiff = RegularGrid((9, 21), (1.0, 1.0)), 5.0, 40.0
    tissue = Tissue(soft, 0.0, [Region(Layer(top, 99.0), stiff, 0.0)], thickness=1.0)
    share = np.floor((11 - top) * 16 + 0.5) / 16  # of the cut cell, as its samples see it
    made = elements_of(tissue, grid)
    K = stiffness(grid, made.young, made.poisson, 1.0, excess=made[2:])
    down = line_loads(grid, (0.0, 0.0), (8.0, 0.0), (0.0, 0.01))
    u = factor(K, grid.boundary(["bottom"])).solve(down)[0, 1]
    assert u == pytest.approx(10.0 * ((9 + share) / stiff + (11 - share) / soft), rel=1e-9)
    held = np.zeros((grid.size, 2), dtype=bool)
    held[grid.boundary(["left"]), 0] = held[0, 1] = True
    stretched = grid.nodes * [0.01, 0.0]
    held[grid.boundary(["right"]), 0] = True
    pulled = factor(K, held).solve(np.zeros((grid.size, 2)), stretched)
    reaction = (K @ pulled.ravel()).reshape(-1, 2)[grid.boundary(["right"]), 0].sum()
    assert reaction == pytest.approx(0.01 * 1e-3 * ((9 + share) * stiff + (11 - share) * soft), rel=1e-9)


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_a_laminate_lies_between_the_means_of_compliance_and_of_stiffness(plane):
    rng = np.random.default_rng(0)
    E, nu = 10 ** rng.uniform(0, 2, (200, 9)), rng.uniform(0.0, 0.49, (200, 9))
    angle = rng.uniform(0, np.pi, 200)
    D = laminate(E, nu, np.stack([np.cos(angle), np.sin(angle)], axis=1), plane)
    young = 1 / (1 / E).mean(axis=1)
    least = isotropic(young, young * (nu / E).mean(axis=1), plane)
    most = isotropic(E, nu, plane).mean(axis=1)
    for excess in (D - least, most - D):
        assert (np.linalg.eigvalsh(excess).min(axis=1) > -1e-9 * np.abs(D).max(axis=(1, 2))).all()


def test_a_turned_laminate_stores_the_same_energy_under_the_turned_strain():
    rng = np.random.default_rng(1)
    E, nu, turn = rng.uniform(1, 50, (1, 16)), np.full((1, 16), 0.4), 0.7
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s], [s, c]])
    strain = np.array([[0.01, 0.004], [0.004, -0.02]])

    def energy(D, e):
        v = np.array([e[0, 0], e[1, 1], 2 * e[0, 1]])
        return v @ D[0] @ v

    flat = energy(laminate(E, nu, np.array([[1.0, 0.0]]), "stress"), strain)
    assert energy(laminate(E, nu, np.array([[c, s]]), "stress"), R @ strain @ R.T) == pytest.approx(flat)


def test_normals_point_across_boundaries():
    lesion = Circle((20.2, 15.1), 6.3)
    tissue = Tissue(10.0, regions=[Region(lesion, 60.0)])
    cells = elements_of(tissue, GRID).cells
    found = normals(tissue.sampled(GRID, cells, 16)[0], GRID.spacing)
    centres = GRID.to_mm(np.stack(np.divmod(cells, 39)[::-1], axis=-1) + 0.5) - lesion.centre
    along = np.abs((found * centres).sum(axis=1)) / np.hypot(*centres.T)
    assert np.median(along) > 0.995
    middle = Tissue(
        10.0, regions=[Region(Layer(1.25, 1.75), 60.0)]
    )  # in the middle of a cell: no first moment
    mesh = RegularGrid((4, 4), (1.0, 1.0))
    made = elements_of(middle, mesh)
    np.testing.assert_allclose(
        np.abs(normals(middle.sampled(mesh, made.cells, 16)[0], (1.0, 1.0))), [[0, 1]] * 3, atol=1e-12
    )


def test_whole_cells_and_homogeneous_tissue_have_no_excess():
    pixels = np.ones((30, 40), dtype=int)
    same = Tissue(10.0, regions=[Region(Label(pixels, RegularGrid((40, 30), (1.0, 1.0)), 1), 10.0)])
    on_lines = Tissue(10.0, regions=[Region(Layer(5.0, 9.0), 80.0)])
    mesh = RegularGrid((21, 16), (2.0, 1.0))
    for tissue in (Tissue(10.0), same, on_lines):
        made = elements_of(tissue, mesh)
        assert len(made.cells) == 0
    assert (elements_of(on_lines, mesh).young.reshape(15, 20)[5:9] == 80.0).all()


def test_nearly_incompressible_plane_strain_does_not_lock_in_cut_cells():
    """Lambda of a nearly incompressible laminate is 2500 times mu: were it in the excess, cut cells would stop moving."""
    fields = []
    for nu in (0.499, 0.4999):
        tissue = Tissue(10.0, nu, [Region(Circle((24.0, 17.0), 6.0), 50.0, nu)], plane="strain")
        response = FEMResponse(GRID, Clamps.of(GRID, ("left", "right", "bottom")), tissue)
        places, forces = needle(*NEEDLES[0])
        fields.append(response.answer(places, forces[..., None], GRID.nodes[:1])[0])
    assert np.abs(fields[1] - fields[0]).max() < 0.03 * np.abs(fields[0]).max()
