"""The drawn needle has the traits of one in B-mode, in the right place, and only those asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echospline.errors import InputError
from echospline.picture import NeedleEcho, draw_needle
from echospline.picture.needle_echo import needle_echo
from echospline.scene import NeedlePose, UltrasoundImage

BARE = NeedleEcho(shaft=False, tip=False, reverberation=False, shadow=False)
GREY = UltrasoundImage.from_array(np.full((400, 500), 100, np.uint8), (0.1, 0.1))
FLAT = NeedlePose((5.0, 15.0), (35.0, 15.0))


def at(*points, pose, echo=None):
    return needle_echo(np.array(points), pose, echo or NeedleEcho())


def profile(image, x):
    return image.pixels[:, round(x / 0.1)].astype(int)


def test_nothing_is_drawn_before_the_needle_enters_or_with_every_trait_off():
    np.testing.assert_array_equal(draw_needle(GREY, NeedlePose((5.0, 0.0), (5.0, 0.0))).pixels, GREY.pixels)
    np.testing.assert_array_equal(draw_needle(GREY, FLAT, BARE).pixels, GREY.pixels)


def test_the_picture_grows_without_a_jump():
    """One hundredth of a millimetre more never changes a pixel by more than a few grey levels."""
    previous = GREY.pixels.astype(int)
    for depth in np.arange(0.01, 2.0, 0.01):
        pixels = draw_needle(GREY, NeedlePose((20.0, 5.0), (20.0 + 0.8 * depth, 5.0 + 0.6 * depth))).pixels
        assert np.abs(pixels.astype(int) - previous).max() <= 10
        previous = pixels.astype(int)


def test_the_brightest_line_is_the_shaft():
    drawn = draw_needle(GREY, FLAT, replace(BARE, shaft=True))
    rows = drawn.pixels[:, 100:300].argmax(axis=0) * 0.1
    np.testing.assert_allclose(
        rows, 15.0 - NeedleEcho().diameter / 2, atol=0.1
    )  # the wall that faces the probe


def test_thickness_comes_from_the_gauge():
    def width(gauge):
        bright = profile(draw_needle(GREY, FLAT, replace(BARE, shaft=True, gauge=gauge)), 20.0) > 150
        return 0.1 * bright.sum()

    assert width(14) - width(18) == pytest.approx(2.108 - 1.270, abs=0.25)
    assert width(18) - width(25) == pytest.approx(1.270 - 0.515, abs=0.25)


def test_the_shafts_echo_fades_as_it_turns_towards_the_beam_and_the_tip_stays_bright():
    shaft, tip = [], []
    for angle in np.radians([0, 20, 40, 60, 80]):
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([np.sin(angle), -np.cos(angle)])
        pose = NeedlePose((10.0, 10.0), tuple(10.0 + 20.0 * along))
        wall = 10.0 + 9.0 * along + across * NeedleEcho().diameter / 2
        shaft.append(at(wall, pose=pose, echo=replace(BARE, shaft=True))[0][0])
        tip.append(at(pose.tip, pose=pose, echo=replace(BARE, tip=True))[0][0])
    assert (np.diff(shaft) < 0).all()
    assert shaft[-1] < 0.45 * shaft[0]
    assert min(tip) > 0.8 * max(tip)
    assert min(tip) > max(shaft[2:])


def test_turning_the_probe_with_the_needle_changes_nothing():
    """Only the angle between beam and shaft counts: a curved array seen along its own axis."""
    angle = np.radians(25.0)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    points = np.random.default_rng(1).uniform(0, 40, (500, 2))
    apex = np.array([20.0, -40.0])
    pose = NeedlePose((5.0, 5.0), (30.0, 20.0))
    turned = NeedlePose(tuple(pose.entry @ turn), tuple(pose.tip @ turn))
    light, passed = needle_echo(points, pose, NeedleEcho(apex=tuple(apex)))
    light2, passed2 = needle_echo(points @ turn, turned, NeedleEcho(apex=tuple(apex @ turn)))
    assert light.max() > 0.3
    np.testing.assert_allclose(light2, light, atol=1e-9)
    np.testing.assert_allclose(passed2, passed, atol=1e-9)


def test_reverberations_are_equally_spaced_fainter_copies_below_the_shaft():
    looks = replace(BARE, reverberation=True, resolution=0.2)
    column = profile(draw_needle(GREY, FLAT, looks), 20.0) - 100
    assert (column[: round((15.0 - looks.diameter / 2) / 0.1)] == 0).all()  # none above
    inner = column[1:-1]
    peaks = 1 + np.flatnonzero((inner > column[:-2]) & (inner >= column[2:]) & (inner > 2))
    np.testing.assert_allclose(np.diff(peaks[:4]) * 0.1, looks.diameter, atol=0.11)
    assert (np.diff(column[peaks[:4]]) < 0).all()


def test_the_shadow_lies_behind_the_shaft_and_nowhere_else():
    looks = replace(BARE, shadow=True)
    drawn = draw_needle(GREY, FLAT, looks).pixels
    assert (drawn[:149] == 100).all()
    assert (drawn[:, : round(4.0 / 0.1)] == 100).all()
    assert (drawn[:, round(38.0 / 0.1) :] == 100).all()
    behind = drawn[170:, 200].astype(int)
    assert behind[0] < 70
    assert (np.diff(behind) >= 0).all()  # and fills up with depth
    slanted = draw_needle(GREY, NeedlePose((5.0, 5.0), (35.0, 30.0)), looks).pixels
    assert slanted[100, 250] == 100
    assert slanted[390, 250] < 95


def test_only_the_traits_asked_for_are_drawn_and_each_changes_the_picture():
    pictures = [draw_needle(GREY, FLAT, replace(BARE, **{trait: True})).pixels.tobytes()
                for trait in ("shaft", "tip", "reverberation", "shadow")]  # fmt: skip
    assert len({GREY.pixels.tobytes(), *pictures}) == 5


@given(
    entry=st.tuples(st.floats(-5, 55), st.floats(-2, 5)),
    tip=st.tuples(st.floats(-5, 55), st.floats(-2, 45)),
    gauge=st.integers(14, 25),
)
def test_the_needle_never_leaves_its_neighbourhood_or_the_range(entry, tip, gauge):
    """Cropping to the touched rows and columns changes nothing, and light and shade stay within their bounds."""
    small = UltrasoundImage.from_array(np.full((40, 50), 100, np.uint8), (1.0, 1.0))
    pose, looks = NeedlePose(entry, tip), NeedleEcho(gauge=gauge)
    light, passed = needle_echo(small.grid.nodes, pose, looks)
    assert (light >= 0).all()
    assert (light <= looks.brightness).all()
    assert (passed >= 1 - looks.opacity).all()
    assert (passed <= 1).all()
    whole = 100.0 * passed
    whole += light * (255.0 - whole)
    np.testing.assert_array_equal(
        draw_needle(small, pose, looks).pixels, np.rint(whole).astype(np.uint8).reshape(40, 50)
    )


def test_colour_floats_and_wide_integers_keep_their_type_and_the_given_image_its_pixels():
    grey = GREY.pixels
    reference = draw_needle(GREY, FLAT).pixels
    colour = UltrasoundImage(np.repeat(grey[:, :, None], 3, axis=2), GREY.grid)
    np.testing.assert_array_equal(draw_needle(colour, FLAT).pixels[:, :, 1], reference)
    share = draw_needle(UltrasoundImage((grey / 255.0).astype(np.float32), GREY.grid), FLAT, white=1.0).pixels
    assert share.dtype == np.float32
    np.testing.assert_allclose(share * 255, reference, atol=0.51)
    wide = draw_needle(UltrasoundImage(grey.astype(np.uint16) * 16, GREY.grid), FLAT, white=255.0 * 16).pixels
    np.testing.assert_allclose(wide / 16, reference, atol=0.6)
    assert (grey == 100).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [("gauge", 3), ("brightness", 1.5), ("resolution", 0.0), ("fade_angle", np.nan), ("apex", (np.inf, 0.0))],
)
def test_looks_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        NeedleEcho(**{name: value})
