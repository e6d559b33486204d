"""A mesh with a node per pixel, evaluated from a coarse one, against the spline itself."""

from __future__ import annotations

import numpy as np
import pytest

from echospline.mechanics import Elastic, ThinPlate, TPSModel, TPSParameters
from echospline.mechanics.native import FINE
from echospline.scene import RegularGrid
from paths import wandering

BOUND = 0.005
"""mm; what is promised for a node per pixel."""
KERNELS = [ThinPlate(), Elastic()]


def fine(shape=(512, 512)):
    return RegularGrid(shape, (40 / (shape[0] - 1), 30 / (shape[1] - 1)))


def chosen(grid, pose):
    """All pixels around the needle's tip, and every fifth of every fifth line elsewhere."""
    columns, lines = np.arange(grid.size) % grid.shape[0], np.arange(grid.size) // grid.shape[0]
    near = np.hypot(*(grid.nodes - pose.tip).T) < 1.5
    return near | (lines % 5 == 0) & (columns % 5 == 0)


def worst_error(model, seed, duration, dt=1 / 20):
    """Largest error against the exact spline over a path, and the largest displacement, mm."""
    state, error, moved = model.rest(), 0.0, 0.0
    for i, pose in enumerate(wandering(seed, dt, duration)):
        state = model.advance(state, pose, dt)
        if i % 20 == 19:
            some = chosen(model.grid, pose)
            exact = model.displacement_at(state, model.grid.nodes[some])
            error = max(error, float(np.abs(model.displacement(state)[some] - exact).max()))
            moved = max(moved, float(np.abs(exact).max()))
    return error, moved


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
@pytest.mark.parametrize("tip", ["point", "node"])
def test_a_node_per_pixel_is_within_the_bound_of_the_exact_field(kernel, tip):
    model = TPSModel(fine(), parameters=TPSParameters(tip=tip), kernel=kernel)
    assert not model.displacement(model.rest()).any()
    error, moved = worst_error(model, 2, 4.0)
    assert error < BOUND
    assert moved > 0.3


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
@pytest.mark.parametrize(
    "grid",
    [
        fine((301, 260)),
        fine((1000, 131)),
        RegularGrid((150, 700), (0.27, 0.043)),
        RegularGrid((700, 150), (0.057, 0.2), (0.0, 0.0)),
    ],
    ids=["301 x 260", "1000 x 131", "narrow", "wide"],
)
def test_anisotropic_meshes_are_within_the_bound_too(kernel, grid):
    assert grid.size > FINE
    error, moved = worst_error(TPSModel(grid, kernel=kernel), 3, 3.0)
    assert error < BOUND
    assert moved > 0.1


@pytest.mark.parametrize("kernel", [ThinPlate(), Elastic(radius=0.5)], ids=["thin plate", "elastic"])
def test_a_strong_push_with_a_sharp_kernel_is_within_the_bound(kernel):
    model = TPSModel(fine(), parameters=TPSParameters(sigma=2.0), kernel=kernel)
    error, moved = worst_error(model, 2, 3.0)
    assert error < BOUND
    assert moved > 1.0


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
def test_a_fine_mesh_gives_what_a_coarse_one_gives_at_shared_nodes(kernel):
    coarse, pixels = fine((129, 129)), fine((257, 257))
    assert coarse.size <= FINE < pixels.size
    parameters = TPSParameters(contact_spacing=0.9375)
    models = [TPSModel(g, parameters=parameters, kernel=kernel) for g in (coarse, pixels)]
    shared = np.arange(257 * 257).reshape(257, 257)[::2, ::2].ravel()
    np.testing.assert_allclose(pixels.nodes[shared], coarse.nodes, atol=1e-12)
    # the same nodes may become contacts, or there would be nothing to compare
    np.testing.assert_allclose(pixels.nodes[models[1].lattice], coarse.nodes[models[0].lattice], atol=1e-12)
    states = [m.rest() for m in models]
    for pose in wandering(3, 1 / 20, 2.0):
        states = [m.advance(s, pose, 1 / 20) for m, s in zip(models, states, strict=True)]
    u = [m.displacement(s) for m, s in zip(models, states, strict=True)]
    assert np.abs(u[1][shared] - u[0]).max() < BOUND


def test_a_fine_mesh_steps_as_algorithm_2_has_it():
    grid = fine((180, 150))
    assert grid.size > FINE
    slow, fast = TPSModel(grid, solver="refit"), TPSModel(grid, precision="double")
    a, b = slow.rest(), fast.rest()
    for pose in wandering(5, 1 / 20, 1.5):
        a, b = slow.advance(a, pose, 1 / 20), fast.advance(b, pose, 1 / 20)
    assert np.array_equal(a.contacts, fast.landmarks(b).contacts)
    assert np.abs(slow.displacement(a) - fast.displacement(b)).max() < BOUND
