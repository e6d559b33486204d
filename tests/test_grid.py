"""Grids and images: index and millimetre, edges, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echospline.errors import InputError
from echospline.scene import Cine, RegularGrid, UltrasoundImage

GRID = RegularGrid((5, 4), (0.5, 2.0), (10.0, -1.0))


def test_nodes_are_image_like():
    nodes = GRID.nodes.reshape(4, 5, 2)
    np.testing.assert_array_equal(nodes[2, 3], [10 + 3 * 0.5, -1 + 2 * 2.0])
    assert GRID.extent == (10.0, 12.0, -1.0, 5.0)


@given(st.floats(-50, 50), st.floats(-50, 50))
def test_millimetres_and_index_are_inverse(x, y):
    np.testing.assert_allclose(GRID.to_mm(GRID.to_index([(x, y)])), [(x, y)], atol=1e-12)


def test_a_mesh_over_an_image_shares_its_corners():
    image = RegularGrid((512, 400), (0.1, 0.08))
    mesh = RegularGrid.covering(image, (40, 30))
    np.testing.assert_allclose(mesh.extent, image.extent)
    assert mesh.contains(image.nodes).mean() > 0.99


def test_edges_hold_the_nodes_on_them_once():
    np.testing.assert_array_equal(GRID.boundary(["top"]), np.arange(5))
    np.testing.assert_array_equal(GRID.boundary(["left", "top"]), [0, 1, 2, 3, 4, 5, 10, 15])
    assert len(GRID.boundary(["top", "bottom", "left", "right"])) == 14
    assert len(GRID.boundary([])) == 0


def test_nearest_is_nearest():
    points = np.random.default_rng(0).uniform([9, -2], [13, 6], (50, 2))
    for p in points:
        distance = np.hypot(*((GRID.nodes - p) / GRID.spacing).T)
        assert distance[GRID.nearest(p)] == pytest.approx(distance.min())


@pytest.mark.parametrize(
    "wrong",
    [
        {"shape": (0, 4)},
        {"shape": (2.5, 4)},
        {"spacing": (0.1, 0.0)},
        {"spacing": (0.1, float("nan"))},
        {"origin": (float("inf"), 0.0)},
    ],
)
def test_grids_that_are_none_are_refused(wrong):
    with pytest.raises(InputError, match=f"{next(iter(wrong))} must be two"):
        RegularGrid(**{"shape": (5, 4), "spacing": (1.0, 1.0), **wrong})


def test_edges_and_meshes_that_are_none_are_refused():
    with pytest.raises(InputError, match="'west'"):
        GRID.boundary(["west"])
    with pytest.raises(InputError, match="2 x 2"):
        RegularGrid.covering(GRID, (1, 9))


def test_an_image_needs_a_grid_of_its_size():
    with pytest.raises(InputError, match=r"\(5, 4\).*\(4, 5\)"):
        UltrasoundImage(np.zeros((4, 5)), RegularGrid((4, 5), (1, 1)))
    with pytest.raises(InputError, match="rows, columns"):
        UltrasoundImage.from_array(np.zeros((4, 5, 2)), (1, 1))


def test_a_cine_gives_its_frames_as_images():
    cine = Cine(np.arange(24).reshape(2, 3, 4), np.array([0.0, 0.1]), RegularGrid((4, 3), (1, 1)))
    assert len(list(cine)) == len(cine) == 2
    np.testing.assert_array_equal(cine[1].pixels, np.arange(12, 24).reshape(3, 4))
    with pytest.raises(InputError, match="ascending"):
        Cine(cine.frames, np.array([0.1, 0.0]), cine.grid)
