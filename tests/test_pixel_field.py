"""A mesh with a node per pixel, evaluated from a coarse one, against the spline itself."""

from __future__ import annotations

import numpy as np
import pytest

from echospline.mechanics import Elastic, ThinPlate, TPSModel, TPSParameters
from echospline.mechanics.pixel_field import FINE, coarse_grid, strides, taps
from echospline.scene import RegularGrid
from paths import wandering

BOUND = 0.005
"""mm; what is promised for a node per pixel."""


def fine(shape=(512, 512)):
    return RegularGrid(shape, (40 / (shape[0] - 1), 30 / (shape[1] - 1)))


def test_the_taps_are_exact_for_cubics():
    x = np.arange(-1, 3)
    for power in range(4):
        t = np.arange(5) / 5
        np.testing.assert_allclose(taps(5) @ x.astype(float) ** power, t**power, atol=1e-14)


@pytest.mark.parametrize("shape", [(512, 512), (301, 260), (1000, 131)])
def test_the_coarse_grid_holds_every_fine_node_with_two_neighbours(shape):
    grid, coarse = fine(shape), coarse_grid(fine(shape))
    assert coarse.size < FINE
    index = coarse.to_index(grid.nodes)
    assert index.min() >= 1 - 1e-9
    assert (index <= np.subtract(coarse.shape, 2) + 1e-9).all()
    np.testing.assert_allclose(coarse.spacing, np.multiply(grid.spacing, strides(grid)))


@pytest.mark.parametrize("kernel", [ThinPlate(), Elastic()], ids=["thin plate", "elastic"])
@pytest.mark.parametrize("tip", ["point", "node"])
def test_a_node_per_pixel_is_within_the_bound_of_the_exact_field(kernel, tip):
    grid = fine()
    model = TPSModel(grid, parameters=TPSParameters(tip=tip), kernel=kernel)
    assert model.pixels is not None
    state, moved = model.rest(), 0.0
    assert not model.displacement(state).any()
    for i, pose in enumerate(wandering(2, 1 / 20, 4.0)):
        state = model.advance(state, pose, 1 / 20)
        if i % 20 == 19:
            u = model.displacement(state)
            # all pixels around the needle, and every fifth line elsewhere
            near = np.hypot(*(grid.nodes - pose.tip).T) < 1.5
            rows = near | (np.arange(grid.size) // 512 % 5 == 0) & (np.arange(grid.size) % 5 == 0)
            exact = model.displacement_at(state, grid.nodes[rows])
            assert np.abs(u[rows] - exact).max() < BOUND
            moved = max(moved, np.abs(exact).max())
    assert moved > 0.3


@pytest.mark.parametrize("kernel", [ThinPlate(), Elastic(radius=0.5)], ids=["thin plate", "elastic"])
def test_the_patterns_take_most_of_the_error_away(kernel):
    model = TPSModel(fine(), parameters=TPSParameters(sigma=2.0), kernel=kernel)
    state = model.rest()
    for pose in wandering(2, 1 / 20, 3.0):
        state = model.advance(state, pose, 1 / 20)
    exact = model.displacement_at(state, model.grid.nodes[::7])
    with_patterns = np.abs(model.displacement(state)[::7] - exact).max()
    model.pixels.patterns = model.pixels.patterns[:0]
    without = np.abs(model.displacement(state)[::7] - exact).max()
    assert with_patterns < 0.2 * without
    assert with_patterns < BOUND


def test_a_fine_mesh_gives_what_a_coarse_one_gives_at_shared_nodes():
    coarse, pixels = fine((129, 129)), fine((257, 257))
    models = [TPSModel(g, parameters=TPSParameters(contact_spacing=0.9375)) for g in (coarse, pixels)]
    assert models[0].pixels is None
    shared = np.arange(257 * 257).reshape(257, 257)[::2, ::2].ravel()
    np.testing.assert_allclose(pixels.nodes[shared], coarse.nodes, atol=1e-12)
    # the same nodes may become contacts, or there would be nothing to compare
    np.testing.assert_allclose(pixels.nodes[models[1].lattice], coarse.nodes[models[0].lattice], atol=1e-12)
    states = [m.rest() for m in models]
    for pose in wandering(3, 1 / 20, 2.0):
        states = [m.advance(s, pose, 1 / 20) for m, s in zip(models, states, strict=True)]
    u = [m.displacement(s) for m, s in zip(models, states, strict=True)]
    assert np.abs(u[1][shared] - u[0]).max() < BOUND
