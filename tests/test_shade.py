"""The display's picture: gain, gain by depth, dynamic range, inversion and flip, against their equations in dB."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from echospline import _native

RECORDED = 60.0


def look(**given: object) -> _native.Look:
    made = _native.Look(struct_size=ctypes.sizeof(_native.Look))
    _native.library().echospline_look_defaults(ctypes.byref(made))
    for name, value in given.items():
        if name == "depth_gains":
            made.depth_gain_count = len(value)
            made.depth_gains[: len(value)] = value
        else:
            setattr(made, name, value)
    return made


def shade(grey: np.ndarray, **given: object) -> np.ndarray:
    rgba = np.zeros((*grey.shape, 4), np.uint8)
    rows, columns = grey.shape
    made = look(**given)
    status = _native.library().echospline_shade(
        ctypes.byref(made), grey.ctypes.data, columns, rows, rgba.ctypes.data, rgba.nbytes
    )
    assert status == _native.Status.OK
    return rgba


def shown(grey: np.ndarray, gain: np.ndarray, dynamic_range: float) -> np.ndarray:
    """Grey level on the display before rounding, by levels in dB; the lowest recorded levels are not spoken of."""
    level = RECORDED * (grey / 255.0 - 1.0) + gain
    return np.clip(255.0 * (1.0 + level / dynamic_range), 0, 255)


@pytest.fixture
def grey() -> np.ndarray:
    rng = np.random.default_rng(3)
    picture = rng.integers(0, 256, (83, 61), dtype=np.uint8)  # neither a multiple of any vector's width
    picture[5] = np.arange(61) * 255 // 60
    return picture


def test_the_default_look_shows_the_picture_as_it_is(grey):
    rgba = shade(grey)
    assert np.array_equal(rgba[..., :3], np.repeat(grey[..., None], 3, axis=2))
    assert np.all(rgba[..., 3] == 255)


@pytest.mark.parametrize("gain", [-23.0, 0.0, 7.5, 100.0])
@pytest.mark.parametrize("dynamic_range", [20.0, 60.0, 95.0])
@pytest.mark.parametrize("sliders", [[], [4.0], [-9.0, 6.0], [0.0, 10.0, -20.0, 3.0, 3.0, 0.0, -1.0, 12.0]])
def test_levels_in_decibels_are_shown_over_the_dynamic_range(grey, gain, dynamic_range, sliders):
    rgba = shade(grey, gain=gain, dynamic_range=dynamic_range, depth_gains=sliders)
    depth = np.linspace(0, 1, len(grey))
    along = np.linspace(0, 1, len(sliders)) if len(sliders) > 1 else [0.0]
    by_depth = np.interp(depth, along, sliders) if sliders else np.zeros(len(grey))
    expected = shown(grey.astype(float), gain + by_depth[:, None], dynamic_range)
    above = grey >= 8
    assert np.abs(rgba[..., 0] - expected)[above].max() <= 0.55  # rounding, and the slope's own to 0.03
    assert np.all(rgba[..., 0][~above] <= expected[~above] + 0.55)  # bent towards black
    assert np.all(rgba[..., 0][grey == 0] == 0)
    assert np.array_equal(rgba[..., 0], rgba[..., 1])
    assert np.array_equal(rgba[..., 0], rgba[..., 2])


def test_brighter_recorded_tissue_is_never_shown_darker():
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None], 40, axis=0)
    for dynamic_range in (1.0, 40.0, 300.0):
        rgba = shade(ramp, dynamic_range=dynamic_range, depth_gains=[-100.0, 100.0])
        assert np.all(np.diff(rgba[..., 0].astype(int), axis=1) >= 0)


def test_inverted_is_the_complement_and_flipped_the_mirror_image(grey):
    plain = shade(grey, gain=5.0, depth_gains=[0.0, 9.0])
    inverted = shade(grey, gain=5.0, depth_gains=[0.0, 9.0], invert=1)
    assert np.array_equal(inverted[..., :3], 255 - plain[..., :3])
    assert np.all(inverted[..., 3] == 255)
    assert np.array_equal(shade(grey, gain=5.0, depth_gains=[0.0, 9.0], flip=1), plain[:, ::-1])


def test_every_level_shades_alike(grey):
    library = _native.library()
    best = shade(grey, gain=3.3, dynamic_range=45.0, depth_gains=[1.0, -4.0, 8.0])
    for level in range(1, 6):
        if library.echospline_level_available(level):
            other = shade(grey, gain=3.3, dynamic_range=45.0, depth_gains=[1.0, -4.0, 8.0], level=level)
            assert np.array_equal(best, other)


def test_one_row_has_the_first_sliders_gain():
    row = np.array([[10, 100, 200]], np.uint8)
    assert np.array_equal(shade(row, depth_gains=[6.0, -30.0]), shade(row, gain=6.0))


@pytest.mark.parametrize(
    ("given", "status"),
    [
        ({"gain": float("nan")}, _native.Status.WRONG_VALUE),
        ({"gain": 101.0}, _native.Status.WRONG_VALUE),
        ({"dynamic_range": 0.0}, _native.Status.WRONG_VALUE),
        ({"recorded_range": 301.0}, _native.Status.WRONG_VALUE),
        ({"invert": 2}, _native.Status.WRONG_VALUE),
        ({"flip": -1}, _native.Status.WRONG_VALUE),
        ({"level": 77}, _native.Status.WRONG_VALUE),
        ({"depth_gains": [0.0, float("inf")]}, _native.Status.WRONG_VALUE),
        ({"depth_gain_count": 9}, _native.Status.WRONG_SIZE),
        ({"depth_gain_count": -1}, _native.Status.WRONG_SIZE),
        ({"struct_size": 8}, _native.Status.WRONG_SIZE),
    ],
)
def test_a_look_that_makes_no_sense_is_refused_and_draws_nothing(grey, given, status):
    rgba = np.full((*grey.shape, 4), 9, np.uint8)
    made = look(**given)
    rows, columns = grey.shape
    shade_into = _native.library().echospline_shade
    assert (
        shade_into(ctypes.byref(made), grey.ctypes.data, columns, rows, rgba.ctypes.data, rgba.nbytes)
        == status
    )
    assert np.all(rgba == 9)


def test_room_of_another_size_is_refused(grey):
    rgba = np.zeros(4 * grey.size - 4, np.uint8)
    made = look()
    rows, columns = grey.shape
    shade_into = _native.library().echospline_shade
    assert (
        shade_into(ctypes.byref(made), grey.ctypes.data, columns, rows, rgba.ctypes.data, rgba.nbytes)
        == _native.Status.WRONG_SIZE
    )
    assert shade_into(None, None, columns, rows, None, 0) == _native.Status.NULL_POINTER
