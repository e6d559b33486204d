"""The loop: what comes out, frame by frame, and that nothing is kept."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from echospline.errors import FoldingError, InputError
from echospline.mechanics import TPSModel, TPSParameters
from echospline.picture import NeedleEcho, frame_count, simulate
from echospline.scene import Insertion, RegularGrid, UltrasoundImage

IMAGE = UltrasoundImage.from_array(
    np.random.default_rng(0).integers(0, 255, (121, 161)).astype(np.uint8), (0.25, 0.25)
)
MESH = RegularGrid.covering(IMAGE.grid, (33, 25))
PATH = Insertion.straight((10, 0), 60, 12, 6.0, dwell=0.5, retract=True)


def test_first_frame_is_the_image_and_times_are_regular():
    frames = list(simulate(IMAGE, PATH, TPSModel(MESH), fps=10))
    np.testing.assert_array_equal(frames[0].image.pixels, IMAGE.pixels)
    assert not frames[0].displacement.any()
    np.testing.assert_allclose([f.time for f in frames], np.arange(len(frames)) / 10)
    assert len(frames) == frame_count(PATH, 10) == 46
    assert max(f.pose.depth for f in frames) == pytest.approx(12)
    assert frames[5].pose.speed == pytest.approx(6)
    assert frames[-1].pose.speed == pytest.approx(-6)


def test_the_picture_changes_near_the_needle_and_not_far_away():
    last = list(simulate(IMAGE, Insertion.straight((10, 0), 60, 12), TPSModel(MESH), fps=10))[-1]
    change = np.abs(last.image.pixels.astype(int) - IMAGE.pixels)
    assert change[30:50, 50:70].mean() > 20
    assert change[-8:, -8:].mean() < 5


@pytest.mark.parametrize(("inverse", "limit"), [("exact", 1e-3), ("auto", 0.1)])
def test_origins_of_pixels_are_checked_in_every_frame(inverse, limit):
    frames = list(simulate(IMAGE, PATH, TPSModel(MESH), fps=10, inverse=inverse))
    assert max(f.residual for f in frames) < limit
    assert max(f.residual for f in frames) > 0


@pytest.mark.parametrize("border", [0.0, "transparent"])
def test_images_outside_the_core_give_the_same_pictures(border):
    """float64 goes through the inverse map, cv2.remap and `draw_needle`."""
    wide = UltrasoundImage(IMAGE.pixels.astype(np.float64), IMAGE.grid)
    options = {"fps": 4, "border": border, "needle": NeedleEcho(), "inverse": "exact"}
    pairs = zip(
        simulate(IMAGE, PATH, TPSModel(MESH), **options),
        simulate(wide, PATH, TPSModel(MESH), **options),
        strict=True,
    )
    for ours, other in pairs:
        colour = np.s_[..., :3] if border == "transparent" else np.s_[...]
        # cv2.remap rounds positions to 1/32 pixel, and this image is noise from pixel to pixel
        difference = ours.image.pixels[colour].astype(float) - other.image.pixels[colour]
        assert np.abs(difference).max() < 255 / 16
        assert np.abs(difference).mean() < 1.5
        assert ours.residual == other.residual


def test_slow_frames_step_the_model_as_often_as_fast_ones():
    path = Insertion.straight((10, 0), 60, 12, 6.0)
    slow = list(simulate(IMAGE, path, TPSModel(MESH), fps=5, longest_step=1 / 20))
    fast = list(simulate(IMAGE, path, TPSModel(MESH), fps=20, longest_step=1 / 20))
    np.testing.assert_allclose(slow[-1].displacement, fast[-1].displacement, atol=1e-9)


def test_frames_are_made_one_by_one():
    frames = simulate(IMAGE, PATH, TPSModel(MESH), fps=10)
    assert [f.index for f in itertools.islice(frames, 3)] == [0, 1, 2]


def test_needle_echo_is_drawn_on_request():
    path = Insertion.straight((10, 0), 60, 12, 6.0)
    bare = list(simulate(IMAGE, path, TPSModel(MESH), fps=2))[-1].image.pixels
    drawn = list(simulate(IMAGE, path, TPSModel(MESH), fps=2, needle=NeedleEcho()))[-1].image.pixels
    assert (bare != drawn).any()


def test_folding_is_flagged_or_refused():
    model = TPSModel(MESH, parameters=TPSParameters(loading="immediate", alpha1=1.5))
    path = Insertion.straight((10, 0), 60, 20, 6.0)
    flagged = [f.folds for f in simulate(IMAGE, path, model, fps=5)]
    assert any(flagged)
    with pytest.raises(FoldingError, match=r"at \d\.\d\d s .* fold"):
        list(simulate(IMAGE, path, model, fps=5, folding="refuse"))


def test_a_former_of_images_gets_the_deformation_and_its_inverse():
    seen = []

    def form(deformation, inverse):
        seen.append((deformation.displacement, inverse))
        return IMAGE

    frames = list(simulate(IMAGE, PATH, TPSModel(MESH), fps=4, form_image=form))
    assert all(f.image is IMAGE for f in frames)
    np.testing.assert_array_equal([u for u, _ in seen], [f.displacement for f in frames])
    assert [inverse.residual for _, inverse in seen] == [f.residual for f in frames]


def test_an_unknown_way_to_find_origins_is_refused():
    with pytest.raises(InputError, match="auto"):
        next(simulate(IMAGE, PATH, TPSModel(MESH), inverse="fast"))


@pytest.mark.parametrize("options", [{"fps": 0}, {"fps": float("nan")}, {"longest_step": -1.0}])
def test_nonsense_is_refused(options):
    with pytest.raises(InputError, match="positive"):
        list(simulate(IMAGE, PATH, TPSModel(MESH), **options))
