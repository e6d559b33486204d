"""Lesions and vessels put into pictures: the grain fits, the border has no seam, all else stays as it was."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage, stats

from echospline.errors import InputError
from echospline.io import read_image
from echospline.laboratory import (
    Body,
    Phantom,
    Round,
    Tube,
    imaged,
    imaged_volume,
    speckle_statistics,
)
from echospline.scenario import load, open_spatial, validated
from echospline.scene import Display, Echo, RegularGrid, UltrasoundImage, Volume
from echospline.scene.transducer import LINEAR

SPACING = 0.1
GREY_PER_DB = 255.0 / 60.0
LESION = Round((20.0, 16.0), 7.0)


def phantom_picture(angles=(0.0,), seed=2, spacing=SPACING):
    """Homogeneous speckle of known statistics, 40 x 40 mm."""
    n = int(40 / spacing)
    phantom = Phantom(LINEAR, RegularGrid((n, n), (spacing, spacing)), seed=seed)
    looks = [phantom.form(noise_seed=1, steering=angle).envelope() for angle in angles]
    mean = np.mean(looks, axis=0).astype(np.complex64)
    return Echo(mean, phantom.samples, LINEAR.carrier).b_mode(Display(), phantom.grid)


@pytest.fixture(scope="module")
def speckle():
    return phantom_picture()


@pytest.fixture(scope="module")
def calf():
    return read_image("sample:calf")


def places(image):
    x, y = np.meshgrid(image.grid.x, image.grid.y)
    return np.stack([x, y], axis=-1)


def patch(pixels, x, y, half=4.5, spacing=SPACING):
    i, j, n = round(y / spacing), round(x / spacing), round(half / spacing)
    return pixels[i - n : i + n, j - n : j + n].astype(float)


@pytest.mark.parametrize("angles", [(0.0,), (-12.0, 0.0, 12.0)])
def test_speckle_inside_has_the_statistics_of_the_surrounding_up_to_the_contrast(angles):
    image = phantom_picture(angles)
    made = imaged(image, [Body(LESION, -6.0)], seed=5).pixels
    inside = patch(made, *LESION.centre)
    around = np.concatenate([patch(image.pixels, 8.0, 33.0), patch(image.pixels, 30.0, 33.0)])
    assert inside.mean() == pytest.approx(around.mean() - 6.0 * GREY_PER_DB, abs=2.0)
    assert inside.std() == pytest.approx(around.std(), rel=0.12)
    shifted = inside.ravel() + 6.0 * GREY_PER_DB
    assert stats.ks_2samp(shifted, around.ravel()).statistic < 0.06
    found = speckle_statistics(inside, (SPACING, SPACING))
    known = [speckle_statistics(patch(image.pixels, x, 33.0), (SPACING, SPACING)) for x in (8.0, 20.0, 30.0)]
    assert found.lateral == pytest.approx(np.mean([k.lateral for k in known]), rel=0.15)
    assert found.axial == pytest.approx(np.mean([k.axial for k in known]), rel=0.2)


def test_new_speckle_is_not_that_which_was_there(speckle):
    made = imaged(speckle, [Body(LESION, 0.0)]).pixels
    inside = [patch(pixels, *LESION.centre).ravel() for pixels in (made, speckle.pixels)]
    assert abs(np.corrcoef(*inside)[0, 1]) < 0.1


@pytest.mark.parametrize("echo", ["hypoechoic", "anechoic", "hyperechoic"])
def test_pixels_outside_and_not_behind_are_unchanged(calf, echo):
    shapes = [Round((27.0, 20.0), 2.5), Tube((-3.0, 33.0), (20.0, 35.0), 1.5)]
    made = imaged(calf, [Body.of(echo, shape) for shape in shapes])
    at = places(calf)
    allowed = np.zeros(calf.pixels.shape, dtype=bool)
    for shape in shapes:
        allowed |= shape.distance(at) < 0
        low, high = shape.bounds
        column = (at[..., 0] >= low[0]) & (at[..., 0] <= high[0])
        allowed |= column & (at[..., 1] >= low[1])
    changed = made.pixels != calf.pixels
    assert changed.any()
    assert not (changed & ~allowed).any()


def test_an_even_body_leaves_no_trace_at_its_border():
    """Contrast 0: mean and variance in narrow rings about the outline are those of the speckle."""
    rings, all_rings = [], []
    for seed in range(4):
        image = phantom_picture((-12.0, 0.0, 12.0), seed=seed)
        distance = LESION.distance(places(image))
        made = imaged(image, [Body(LESION, 0.0)], seed=seed).pixels.astype(float)
        rings.append([made[(distance >= a) & (distance < a + 0.25)] for a in np.arange(-1.5, 0.5, 0.25)])
        all_rings.append(image.pixels[distance > 1.0].astype(float))
    usual = np.concatenate(all_rings)
    for parts in zip(*rings, strict=True):
        ring = np.concatenate(parts)
        assert ring.mean() == pytest.approx(usual.mean(), abs=0.25 * usual.std())
        assert ring.std() == pytest.approx(usual.std(), rel=0.2)


def test_what_lies_behind_a_vessel_is_brighter_by_the_way_through_it(speckle):
    vessel = Body(Round((20.0, 14.0), 4.0), -45.0, enhancement=0.8)
    made = imaged(speckle, [vessel]).pixels.astype(float) - speckle.pixels
    behind = made[round(19.0 / SPACING), round(20.0 / SPACING)] / GREY_PER_DB
    # the outer half radius counts by half: 2 * (2 + 1) mm of the way at 0.8 dB/mm, less what fades within 5 mm
    assert behind == pytest.approx(0.8 * 6.0 * np.exp(-5.0 / 25.0), abs=0.4)
    below = made[round(35.0 / SPACING), round(20.0 / SPACING)]
    assert 0 < below < behind * GREY_PER_DB
    middle, edge = (made[round(19.0 / SPACING), round(x / SPACING)] for x in (20.0, 23.5))
    assert 0 <= edge < 0.3 * middle  # towards the edge the beam passes less of it


def test_beams_of_a_curved_array_cast_their_enhancement_away_from_the_apex(speckle):
    vessel = Body(Round((28.0, 14.0), 3.0), -45.0, enhancement=1.0)
    apex = (20.0, -20.0)
    made = imaged(speckle, [vessel], apex=apex).pixels.astype(float) - speckle.pixels
    row = made[round(30.0 / SPACING)]
    centre = float((row * speckle.grid.x).sum() / row.sum())
    assert centre == pytest.approx(apex[0] + (28.0 - apex[0]) * 50.0 / 34.0, abs=0.3)


def test_a_vessel_is_black_inside_and_bright_where_the_beam_meets_its_wall(calf):
    vessel = Round((27.0, 20.0), 2.5)
    made = imaged(calf, [Body.of("anechoic", vessel)]).pixels.astype(float)
    at = places(calf)
    distance = vessel.distance(at)
    assert made[distance < -1.6].mean() < 0.2 * calf.pixels.mean()
    steep = np.abs(at[..., 1] - 20.0) / np.maximum(np.hypot(at[..., 0] - 27.0, at[..., 1] - 20.0), 1e-9)
    wall = (distance < -0.1) & (distance > -0.4)
    top, side = made[wall & (steep > 0.95)].mean(), made[wall & (steep < 0.3)].mean()
    assert top > side + 15.0
    assert top > made[(distance > 0.5) & (distance < 1.5) & (at[..., 1] < 18.0)].mean()


def test_it_is_a_pure_function(calf):
    before = calf.pixels.copy()
    bodies = [Body.of("hypoechoic", Round((27.0, 20.0), 2.5))]
    first, again, other = (imaged(calf, bodies, seed=s).pixels for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    np.testing.assert_array_equal(calf.pixels, before)
    assert imaged(calf, []) is calf


def test_grey_in_three_channels_is_grey_and_opacity_stays(speckle):
    bodies = [Body(LESION, -6.0)]
    grey = speckle.pixels
    opacity = np.full_like(grey, 7)
    colour = UltrasoundImage(np.dstack([grey, grey, grey, opacity]), speckle.grid)
    made = imaged(colour, bodies).pixels
    np.testing.assert_array_equal(made[..., 1], imaged(speckle, bodies).pixels)
    np.testing.assert_array_equal(made[..., 3], opacity)


def coloured(image):
    pixels = np.repeat(image.pixels[..., None], 3, axis=-1)
    pixels[100:140, 100:140, 0] = 255
    return UltrasoundImage(pixels, image.grid)


def burnt_in(image):
    pixels = image.pixels.copy()
    cv2.putText(pixels, "Dr. No", (180, 170), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 255, 1)
    return UltrasoundImage(pixels, image.grid)


def smooth(image):
    ramp = np.linspace(60, 120, image.pixels.shape[0])[:, None].repeat(image.pixels.shape[1], axis=1)
    return UltrasoundImage(ramp.astype(np.uint8), image.grid)


@pytest.mark.parametrize(
    ("spoil", "shape", "words"),
    [
        (coloured, LESION, "has colours"),
        (burnt_in, LESION, "text, a ruler"),
        (smooth, LESION, "no speckle"),
        (lambda i: UltrasoundImage(np.zeros_like(i.pixels), i.grid), LESION, "0 pixels of tissue"),
        (lambda i: UltrasoundImage(i.pixels.astype(float), i.grid), LESION, "8-bit"),
        (lambda i: i, Round((90.0, 16.0), 3.0), "outside the picture"),
        (lambda i: i, Round((20.0, 16.0, 0.0), 3.0), "3 coordinates"),
    ],
)
def test_where_it_cannot_be_done_it_is_said(speckle, spoil, shape, words):
    with pytest.raises(InputError, match=words):
        imaged(spoil(speckle), [Body(shape, -6.0)])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Round((1.0, 2.0), 0.0), "positive number of mm"),
        (lambda: Round((1.0,), 1.0), r"\(x, y\) or \(x, y, z\)"),
        (lambda: Tube((1.0, 2.0), (1.0, 2.0), 1.0), "from one point to another"),
        (lambda: Body(LESION, float("nan")), "contrast of a body"),
        (lambda: Body.of("pink", LESION), "echo is one of"),
    ],
)
def test_bodies_out_of_range_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


# --- in space


@pytest.fixture(scope="module")
def block():
    """Correlated noise of known widths, (z, y, x) = (40, 90, 70)."""
    rng = np.random.default_rng(4)

    field = [ndimage.gaussian_filter(rng.normal(size=(40, 90, 70)), (2.0, 1.2, 1.8)) for _ in range(2)]
    envelope = np.hypot(*field)
    envelope /= np.sqrt(np.mean(envelope**2))
    return Volume(Display().grey(envelope), (0.35, 0.25, 0.5), (-12.0, 0.0, -10.0))


def test_a_ball_in_a_volume_has_the_volumes_speckle(block):
    ball = Round((0.0, 11.0, 0.0), 6.0)
    made = imaged_volume(block, [Body(ball, -6.0)], seed=1)
    z, y, x = (slice(14, 27), slice(32, 57), slice(25, 45))
    inside = made.voxels[z, y, x].astype(float)
    usual = block.voxels.astype(float)
    assert inside.mean() == pytest.approx(usual.mean() - 6.0 * GREY_PER_DB, abs=3.0)
    assert inside.std() == pytest.approx(usual.std(), rel=0.15)

    def neighbours(v, axis):
        a, b = np.take(v, range(1, v.shape[axis]), axis), np.take(v, range(v.shape[axis] - 1), axis)
        return np.corrcoef(a.ravel(), b.ravel())[0, 1]

    for axis in range(3):
        assert neighbours(inside, axis) == pytest.approx(neighbours(usual, axis), abs=0.08)


def test_voxels_outside_a_tube_and_above_it_are_unchanged(block):
    tube = Tube((-30.0, 9.0, 0.0), (30.0, 11.0, 3.0), 2.0)
    made = imaged_volume(block, [Body(tube, -45.0, enhancement=1.2)])
    nz, ny, nx = block.voxels.shape
    z, y, x = np.meshgrid(
        *(o + h * np.arange(n) for o, h, n in zip(block.origin[::-1], block.spacing[::-1], (nz, ny, nx), strict=True)),
        indexing="ij",
    )  # fmt: skip
    distance = tube.distance(np.stack([x, y, z], axis=-1))
    changed = made.voxels != block.voxels
    behind = np.cumsum(distance < 0, axis=1) > 0
    assert not (changed & (distance >= 0) & ~behind).any()
    assert made.voxels[distance < -1.2].mean() < 0.2 * block.voxels.mean()
    assert (made.voxels.astype(int) - block.voxels)[behind & (distance > 0.5)].mean() > 3.0


# --- the words of a scenario


SCENARIO = {
    "format": 2,
    "image": {"file": "sample:calf"},
    "body": [{"echo": "anechoic", "tube": {"start": [0.0, 33.0], "end": [49.0, 34.0], "radius": 1.0}}],
    "exercise": [
        {
            "name": "a",
            "title": "A",
            "target": {"centre": [27.0, 25.0], "radius": 2.0, "imaged": True, "young": 40.0},
            "vessels": [
                {"centre": [20.0, 19.0], "radius": 2.5, "imaged": True},
                {"centre": [35.0, 19.0], "radius": 2.0},
            ],
        },
        {"name": "b", "title": "B", "target": {"centre": [27.0, 25.0], "radius": 2.0, "echo": "hypoechoic"}},
    ],
}


def test_a_scenario_images_what_its_words_say(calf, tmp_path):
    scenario = validated(SCENARIO, "test")
    image = scenario.read_image(Path())
    want = imaged(
        calf,
        [
            Body.of("anechoic", Tube((0.0, 33.0), (49.0, 34.0), 1.0)),
            Body.of("hypoechoic", Round((27.0, 25.0), 2.0)),
            Body.of("anechoic", Round((20.0, 19.0), 2.5)),
        ],
    )
    np.testing.assert_array_equal(image.pixels, want.pixels)
    tissue = scenario.make_tissue(Path(), scenario.grid(image))
    assert tissue.at([(27.0, 25.0), (20.0, 19.0)])[0].tolist() == [40.0, 10.0]
    scenario.save(tmp_path / "again.toml", Path())
    assert load(tmp_path / "again.toml") == scenario


def test_a_tube_may_be_stiffer_in_the_plane():
    body = SCENARIO["body"][0] | {"young": 2.0}
    scenario = validated(SCENARIO | {"body": [body], "exercise": []}, "test")
    image = scenario.read_image(Path())
    tissue = scenario.make_tissue(Path(), scenario.grid(image))
    assert tissue.at([(24.5, 33.5), (24.5, 35.5)])[0].tolist() == [2.0, 10.0]


def test_bodies_of_a_scene_in_space_are_in_its_volume_and_its_tissue():
    lesion = {"sphere": {"centre": [0.0, 25.0, 0.0], "radius": 4.0}, "young": 50.0}
    bare = {"format": 2, "image": {"file": "sample:spine"}}
    with_body, without = (
        open_spatial(validated(bare | extra, "test"), Path()) for extra in ({"body": [lesion]}, {})
    )
    changed = (with_body.volume.voxels != without.volume.voxels).mean()
    assert 0 < changed < 0.1
    assert with_body.tissue.at([(0.0, 25.0, 0.0), (0.0, 35.0, 0.0)])[0].tolist() == [50.0, 10.0]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"echo": "anechoic"}, "exactly one of circle, sphere, tube"),
        ({"echo": "black", "circle": {"centre": [1, 2], "radius": 1}}, r"body\.0\.echo"),
        ({"circle": {"centre": [1, 2], "radius": -1}}, "radius"),
    ],
)
def test_faults_of_a_body_are_said(body, words):
    with pytest.raises(InputError, match=words):
        validated({"format": 2, "body": [body]}, "test")
