"""Finite elements that answer forces: every mix of clamped, sliding and free edges, against symmetry and quadratic elements."""

import pickle
from itertools import product

import numpy as np
import pytest

from cut_cell_reference import QuadraticPlane, needle
from echospline.errors import InputError
from echospline.mechanics import Clamps, FEMModel, ViscousForces
from echospline.mechanics.fem_response import FEMResponse
from echospline.mechanics.finite_elements import factor, stiffness
from echospline.scene import Insertion, RegularGrid, Tissue

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
SIZE = (40.0, 30.0)
EDGES = ("top", "bottom", "left", "right")
PLACES = np.array([(14.3, 9.2), (20.0, 17.7)])
FORCES = np.array([[[0.1], [0.3]], [[-0.05], [0.2]]])


def made(kinds, grid=GRID, tissue=None):
    clamped = tuple(e for e, k in zip(EDGES, kinds, strict=True) if k == "clamped")
    sliding = tuple(e for e, k in zip(EDGES, kinds, strict=True) if k == "sliding")
    return FEMResponse(grid, Clamps.of(grid, clamped, None, sliding), tissue or Tissue())


def on_edge(points, edge):
    axis, value = {"top": (1, 0.0), "bottom": (1, SIZE[1]), "left": (0, 0.0), "right": (0, SIZE[0])}[edge]
    return np.abs(points[:, axis] - value) < 1e-6


def held_by(kinds):
    def held(points):
        fixed = np.zeros((len(points), 2), dtype=bool)
        for edge, kind in zip(EDGES, kinds, strict=True):
            on = on_edge(points, edge)
            if kind == "clamped":
                fixed[on] = True
            elif kind == "sliding":
                fixed[on, 1 if edge in ("top", "bottom") else 0] = True
        return fixed

    return held


def determined(kinds):
    """One clamped edge, or one that slides across x and one across y: an edge that slides does not turn."""
    slides = {e for e, k in zip(EDGES, kinds, strict=True) if k == "sliding"}
    return "clamped" in kinds or bool(slides & {"top", "bottom"} and slides & {"left", "right"})


@pytest.mark.parametrize("kinds", list(product(("clamped", "sliding", "free"), repeat=4)))
def test_every_mix_of_edges_is_solved_in_balance_or_refused(kinds):
    grid = RegularGrid((13, 10), (40 / 12, 30 / 9))
    if not determined(kinds):
        with pytest.raises(InputError, match=r"clamp one edge, for example the bottom"):
            made(kinds, grid)
        return
    response = made(kinds, grid)
    u, _ = response.answer(PLACES, FORCES, PLACES)
    held = held_by(kinds)(grid.nodes)
    assert (u[held, 0] == 0).all()
    reaction = (response.stiffness @ u.ravel()).reshape(-1, 2)
    loads = np.zeros_like(reaction)
    loads[held] = reaction[held]
    np.testing.assert_allclose(loads.sum(axis=0), -FORCES.sum(axis=0)[:, 0], rtol=1e-9)
    moment = grid.nodes[:, 0] * loads[:, 1] - grid.nodes[:, 1] * loads[:, 0]
    lever = PLACES[:, 0] * FORCES[:, 1, 0] - PLACES[:, 1] * FORCES[:, 0, 0]
    assert moment.sum() == pytest.approx(-lever.sum(), rel=1e-9)


MIXES = [  # top, bottom, left, right
    ("free", "clamped", "clamped", "clamped"),
    ("sliding", "clamped", "clamped", "clamped"),
    ("clamped", "clamped", "clamped", "clamped"),
    ("free", "clamped", "free", "free"),
    ("sliding", "clamped", "free", "free"),
    ("free", "free", "clamped", "free"),
    ("free", "clamped", "sliding", "sliding"),
    ("sliding", "sliding", "sliding", "sliding"),
    ("free", "sliding", "free", "clamped"),
]


@pytest.mark.parametrize(("plane", "nu", "share"), [("stress", 0.45, 0.006), ("strain", 0.49, 0.015)])
@pytest.mark.parametrize("kinds", MIXES)
def test_homogeneous_tissue_is_close_to_quadratic_elements_for_any_edges(kinds, plane, nu, share):
    reference = QuadraticPlane(
        SIZE, 2 / 3, [], lambda p: np.full(len(p), 10.0), held_by(kinds), nu, plane=plane
    )
    response = made(kinds, tissue=Tissue(10.0, nu, plane=plane))
    for each in (((12.0, 0.0), 60.0, 22.0), ((27.0, 0.0), 105.0, 18.0)):
        places, forces = needle(*each)
        truth = reference.solve(places, forces, GRID.nodes)
        u = response.answer(places, forces[..., None], GRID.nodes[:1])[0][..., 0]
        assert np.hypot(*(u - truth).T).mean() < share * np.hypot(*truth.T).mean()


def test_a_sliding_edge_is_a_mirror():
    """Tissue that ends at a sliding edge moves like half of tissue with a mirrored load beyond that edge."""
    half = made(("free", "clamped", "sliding", "clamped"), RegularGrid((21, 16), (1.0, 1.0)))
    whole = made(("free", "clamped", "clamped", "clamped"), RegularGrid((41, 16), (1.0, 1.0), (-20.0, 0.0)))
    places, forces = np.array([(4.3, 6.1), (0.0, 9.0)]), np.array([[[0.1], [0.3]], [[0.0], [0.2]]])
    twin = places * [-1, 1], forces * [[-1], [1]]
    both = (
        np.vstack([places[:1], twin[0][:1], places[1:]]),
        np.vstack([forces[:1], twin[1][:1], 2 * forces[1:]]),
    )
    points = np.array([(3.2, 2.2), (0.0, 4.4), (12.0, 0.0)])
    np.testing.assert_allclose(
        half.answer(places, forces, points)[1], whole.answer(*both, points)[1], atol=1e-12
    )


def test_load_cases_add_up_and_points_are_interpolated():
    response = made(MIXES[1])
    cases = np.concatenate(
        [FORCES * [[[1], [0]], [[0], [0]]], FORCES - FORCES * [[[1], [0]], [[0], [0]]]], axis=2
    )
    together, _ = response.answer(PLACES, FORCES, PLACES)
    mesh, at = response.answer(PLACES, cases, np.vstack([PLACES, GRID.nodes[[100]]]))
    np.testing.assert_allclose(mesh.sum(axis=2), together[..., 0], atol=1e-14)
    np.testing.assert_allclose(at[-1], mesh[100], atol=1e-12)
    with pytest.raises(InputError, match=r"forces must have shape \(2, 2, k\)"):
        response.answer(PLACES, FORCES[:1], PLACES)
    with pytest.raises(InputError, match="must lie in the mesh"):
        response.answer(PLACES, FORCES, [(50.0, 3.0)])


def test_a_pickled_response_answers_alike():
    response = made(MIXES[6], RegularGrid((13, 10), (40 / 12, 30 / 9)))
    copy = pickle.loads(pickle.dumps(response))
    for a, b in zip(
        response.answer(PLACES, FORCES, PLACES), copy.answer(PLACES, FORCES, PLACES), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def test_the_response_is_said_in_one_sentence():
    said = made(MIXES[0]).describe()
    assert "40 x 30 nodes" in said
    assert "plane stress" in said
    assert "cholmod" in said


def test_clamped_points_that_share_a_mesh_node_are_refused_with_the_remedy():
    points = [(10.0, 10.0), (10.1, 10.0)]
    with pytest.raises(
        InputError, match=r"clamped points reach 1 mesh node\).*further apart than the mesh's spacing"
    ):
        FEMModel(GRID, (), clamped_points=points)
    FEMModel(GRID, (), clamped_points=[(10.0, 10.0), (14.0, 10.0)])


def test_held_components_are_checked():
    K = stiffness(GRID, 10.0, 0.45, 40.0)
    held = np.zeros((GRID.size, 2), dtype=bool)
    held[:3, 0] = True
    with pytest.raises(InputError, match="nothing holds the tissue along y"):
        factor(K, held)
    held[:3, 0], held[0] = False, True
    with pytest.raises(InputError, match="or the tissue turns"):
        factor(K, held)
    with pytest.raises(InputError, match="boolean for each of 1200 x 2"):
        factor(K, held.T)


def test_nodes_and_both_of_their_components_are_the_same_clamp():
    K, nodes = stiffness(GRID, 10.0, 0.45, 40.0), GRID.boundary(["bottom"])
    held = np.zeros((GRID.size, 2), dtype=bool)
    held[nodes] = True
    loads = np.random.default_rng(0).normal(size=(GRID.size, 2))
    np.testing.assert_array_equal(factor(K, nodes).solve(loads), factor(K, held).solve(loads))


def test_skin_under_a_sliding_probe_stays_at_the_probe_and_slips_along_it():
    model = FEMModel(GRID, sliding=["top"], forces=ViscousForces(ramp=0.0))
    insertion = Insertion.straight((12.0, 0.0), 60, 20)
    u = model.displacement(model.advance(model.rest(), insertion.pose(insertion.duration), 1.0))
    top = u[GRID.boundary(["top"])]
    assert (top[:, 1] == 0).all()
    assert np.abs(top[:, 0]).max() > 0.05
