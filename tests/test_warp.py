"""Warping: values come from the reference, types and ranges stay."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from echospline.errors import FoldingError, InputError
from echospline.picture import Deformation, warp
from echospline.scene import RegularGrid, UltrasoundImage

RNG = np.random.default_rng(0)
MESH = RegularGrid((11, 9), (2.0, 2.0))  # 20 x 16 mm


def picture(dtype=np.uint8, colour=False) -> UltrasoundImage:
    shape = (81, 101, 3) if colour else (81, 101)
    values = RNG.integers(0, 120, shape) if np.issubdtype(dtype, np.integer) else RNG.random(shape)
    return UltrasoundImage.from_array(values.astype(dtype), (0.2, 0.2))


def bump(amplitude: float) -> Deformation:
    r2 = ((MESH.nodes - (10.0, 8.0)) ** 2).sum(axis=1)
    return Deformation(MESH, amplitude * np.exp(-r2 / 9)[:, None] * [1.0, 0.5])


@pytest.mark.parametrize("dtype", [np.uint8, np.int8, np.uint16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("colour", [False, True])
def test_no_motion_gives_back_the_same_pixels(dtype, colour):
    image = picture(dtype, colour)
    still = warp(image, bump(0.0))
    assert still.pixels.dtype == dtype
    if np.issubdtype(dtype, np.integer):
        np.testing.assert_array_equal(still.pixels, image.pixels)
    else:
        np.testing.assert_allclose(still.pixels, image.pixels, atol=1e-4)


def test_whole_pixels_are_shifted_exactly():
    image = picture()
    moved = warp(image, Deformation(MESH, np.tile([1.0, 0.0], (MESH.size, 1))), border=7)
    np.testing.assert_array_equal(moved.pixels[:, 5:], image.pixels[:, :-5])
    assert (moved.pixels[:, :5] == 7).all()


def test_a_bright_point_goes_where_the_tissue_goes():
    x, y = np.meshgrid(np.arange(101) * 0.2, np.arange(81) * 0.2)
    image = UltrasoundImage.from_array(255 * np.exp(-((x - 10) ** 2 + (y - 8) ** 2) / 0.25), (0.2, 0.2))
    moved = warp(image, bump(1.2)).pixels
    row, column = np.unravel_index(moved.argmax(), moved.shape)
    np.testing.assert_allclose((column * 0.2, row * 0.2), (11.2, 8.6), atol=0.21)


def test_values_equal_scipy_at_the_inverse_map():
    image = picture(np.float64)
    inverse = bump(1.5).inverse(image.grid)
    theirs = map_coordinates(
        image.pixels, [inverse.y.astype(float), inverse.x.astype(float)], order=1, mode="nearest"
    )
    # remap may round the place to 1/32 pixel, half of that off in each direction; values span 0 to 1
    np.testing.assert_allclose(warp(image, inverse).pixels, theirs, atol=2 / 64)


@pytest.mark.parametrize("interpolation", ["linear", "nearest", "cubic"])
def test_the_range_of_values_is_kept(interpolation):
    image = picture(np.int16)
    moved = warp(image, bump(2.0), interpolation=interpolation).pixels
    assert image.pixels.min() <= moved.min()
    assert moved.max() <= image.pixels.max()


def test_transparent_outside():
    moved = warp(
        picture(), Deformation(MESH, np.tile([1.0, 0.0], (MESH.size, 1))), border="transparent"
    ).pixels
    assert moved.shape == (81, 101, 4)
    assert (moved[:, :5, 3] == 0).all()
    assert (moved[:, 5:, 3] == 255).all()


def test_folding_is_refused_when_asked():
    assert warp(picture(), bump(6.0)).pixels.shape == (81, 101)
    with pytest.raises(FoldingError, match="cells fold"):
        warp(picture(), bump(6.0), folding="refuse")


def test_unknown_options_are_refused():
    with pytest.raises(InputError, match="linear, nearest, cubic"):
        warp(picture(), bump(0.0), interpolation="spline")
    with pytest.raises(InputError, match="refuse"):
        warp(picture(), bump(0.0), folding="hide")
    with pytest.raises(InputError, match="inverse map"):
        warp(picture(), bump(0.0).inverse(RegularGrid((5, 5), (1, 1))))
