"""The needle's looks reach the core under their names, and its echo any type of picture.

How the echo looks (contrast against tilt, grain, shadow, growth without a jump) is tested in tests/core/test_picture.py.
"""

from __future__ import annotations

import ctypes
from dataclasses import fields, replace

import numpy as np
import pytest

from echospline import _native as core
from echospline.errors import InputError
from echospline.picture import NeedleEcho, draw_needle, needle_echo
from echospline.scene import NeedlePose, UltrasoundImage

NOTHING = {"shaft": False, "tip": False, "tail": False, "shadow": False}
GREY = UltrasoundImage.from_array(np.full((200, 250), 100, np.uint8), (0.2, 0.2))
FLAT = NeedlePose((5.0, 15.0), (35.0, 15.0))
STEEP = NeedlePose((8.0, 0.0), (30.0, 22.0))


def decibels(power):
    return 10 * np.log10(np.maximum(power, 1e-30))


def test_defaults_are_the_cores():
    needle = core.Needle(struct_size=ctypes.sizeof(core.Needle))
    core.library().echospline_needle_defaults(ctypes.byref(needle))
    ours = NeedleEcho().at(FLAT)
    for name, _ in core.Needle._fields_:
        if name not in ("entry", "tip", "apex"):
            assert getattr(ours, name) == getattr(needle, name), name
    assert (*ours.entry, *ours.tip) == (5.0, 15.0, 0.0, 35.0, 15.0, 0.0)


def test_every_look_reaches_the_core():
    names = {f.name for f in fields(NeedleEcho)} - {"gauge", "apex", *NOTHING}
    assert names == {name for name, _ in core.Needle._fields_} - {
        "struct_size", "parts", "curved", "entry", "tip", "apex", "diameter",
    }  # fmt: skip
    for name in names:
        value = getattr(NeedleEcho(), name)
        other = value + 1 if name == "seed" else value * 0.9
        assert getattr(NeedleEcho(**{name: other}).at(FLAT), name) == other
    assert NeedleEcho(**NOTHING).at(FLAT).parts == 0
    assert NeedleEcho(tail=False).at(FLAT).parts == 15 - core.NeedlePart.TAIL
    assert NeedleEcho(gauge=14).at(FLAT).diameter == 2.108
    curved = NeedleEcho(apex=(20.0, -40.0)).at(FLAT)
    assert (curved.curved, *curved.apex) == (1, 20.0, -40.0)


def test_nothing_is_drawn_before_the_needle_enters_or_with_every_part_off():
    outside = NeedlePose((5.0, 0.0), (5.0, 0.0))
    np.testing.assert_array_equal(draw_needle(GREY, outside).pixels, GREY.pixels)
    np.testing.assert_array_equal(draw_needle(GREY, FLAT, NeedleEcho(**NOTHING)).pixels, GREY.pixels)
    power, passed = needle_echo([(5.0, 1.0)], outside, NeedleEcho())
    assert (power, passed) == (0.0, 1.0)


def test_the_brightest_line_is_the_wall_that_faces_the_probe():
    looks = replace(NeedleEcho(gauge=14, **NOTHING), shaft=True)
    rows = draw_needle(GREY, FLAT, looks).pixels[:, 50:150].argmax(axis=0) * 0.2
    np.testing.assert_allclose(rows, 15.0 - looks.diameter / 2, atol=0.21)


def test_pictures_show_the_echo_at_points():
    """White plus the sum's decibels over the dynamic range: tissue that passes, and the echo."""
    looks = NeedleEcho(shadow=False)
    power, passed = needle_echo(GREY.grid.nodes, STEEP, looks)
    assert (passed == 1).all()
    tissue = 10 ** ((100 / 255 - 1) * looks.dynamic_range / 10)
    expected = 255 * (1 + decibels(tissue + power) / looks.dynamic_range)
    drawn = draw_needle(GREY, STEEP, looks).pixels.ravel()
    np.testing.assert_allclose(drawn, np.clip(expected, 0, 255), atol=1.5)
    assert drawn.max() > 200


def test_a_fainter_needle_has_that_share_of_the_amplitude():
    looks = NeedleEcho(shadow=False)
    whole, half = (needle_echo(GREY.grid.nodes, STEEP, e)[0] for e in (looks, looks.fainter(0.5)))
    seen = whole > 1e-6
    np.testing.assert_allclose(half[seen] / whole[seen], 0.25, rtol=1e-3)
    assert looks.fainter(1.0) == looks


@pytest.mark.parametrize("dtype", [np.int8, np.int32, np.uint16, np.int16, np.float32, np.float64])
@pytest.mark.parametrize("colour", [False, True])
def test_types_and_colour_get_the_same_needle(dtype, colour):
    scale = 0.5 if dtype == np.int8 else 4.0
    pixels = (GREY.pixels * scale).astype(dtype)
    if colour:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    drawn = draw_needle(UltrasoundImage(pixels, GREY.grid), STEEP, white=255 * scale if scale > 1 else 127.0)
    assert drawn.pixels.dtype == dtype
    grey = drawn.pixels[..., 1] if colour else drawn.pixels
    reference = draw_needle(GREY, STEEP).pixels
    np.testing.assert_allclose(grey / scale, reference, atol=2 if scale > 1 else 4)


def test_pixels_without_a_needle_keep_their_values_and_the_given_image_all():
    values = np.random.default_rng(0).normal(0, 1e5, (200, 250))
    image = UltrasoundImage(values.copy(), GREY.grid)
    drawn = draw_needle(image, FLAT, NeedleEcho(shadow=False)).pixels
    changed = drawn != values
    assert changed.any()
    assert not changed[:50].any()
    np.testing.assert_array_equal(image.pixels, values)


def test_no_needle_where_there_is_no_tissue():
    rgba = np.full((200, 250, 4), 100, np.uint8)
    rgba[..., 3] = 255
    rgba[:, :100] = 0
    drawn = draw_needle(UltrasoundImage(rgba, GREY.grid), FLAT).pixels
    assert (drawn[:, :100] == 0).all()
    assert (drawn[:, 100:, 3] == 255).all()
    assert drawn[:, 100:, :3].max() > 200


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gauge", 3),
        ("opacity", 1.5),
        ("lateral", 0.0),
        ("lobe", np.nan),
        ("seed", -1),
        ("apex", (np.inf, 0.0)),
    ],
)
def test_looks_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        NeedleEcho(**{name: value})
