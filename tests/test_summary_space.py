"""The figure of a run in space: its cuts, the lines in which they meet the picture's plane, and what lies before what."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import ConvexHull

from echospline.mechanics import SpatialForceModel
from echospline.picture.simulate_space import simulate_space
from echospline.picture.slices import NativeVolume
from echospline.picture.summary_space import CUTS, _cut, _hull, _met, _outline, _parts, summary_figure_space
from echospline.scene import PlanePath, Probe, SpatialGrid, SpatialInsertion, Volume, probe_plane

PROBES = (
    Probe(width=16.0, depth=14.0, pixel=0.5),
    Probe("curved", radius=12.0, opening=70.0, depth=14.0, pixel=0.5),
)


@pytest.fixture(scope="module")
def volume():
    grey = np.random.default_rng(3).integers(0, 255, (21, 25, 31)).astype(np.uint8)
    return Volume(grey, (0.8, 0.8, 0.8), (-12.0, 0.0, -8.0))


def frames(volume, probe, plane):
    low = np.array(volume.origin)
    grid = SpatialGrid.spanning(tuple(low), tuple(low + volume.size), (5, 5, 5))
    insertion = SpatialInsertion.straight((-6, 0, -2), (1, 1, 0.7), 9, 20)
    return list(
        simulate_space(volume, probe, PlanePath.still(plane), insertion, SpatialForceModel.green(grid), fps=5)
    )


@pytest.mark.parametrize("probe", PROBES, ids=["linear", "curved"])
@pytest.mark.parametrize("yaw", [0.0, 90.0, 30.0])
def test_the_figure_is_a_whole_picture(volume, probe, yaw, tmp_path):
    first, *_, last = frames(volume, probe, probe_plane((0, 0, 0), yaw, 5.0, 0.0))
    summary_figure_space(volume, probe, first, last, tmp_path / "figure.png", title="a run")
    with Image.open(tmp_path / "figure.png") as picture:
        assert min(picture.size) > 500
        picture.verify()


@pytest.mark.parametrize("directions", CUTS, ids=["z", "x", "y"])
def test_a_cut_of_tissue_at_rest_is_a_layer_of_voxels_and_moves_with_the_tissue(volume, directions):
    across, down, through = directions
    frame, voxels = frames(volume, PROBES[0], probe_plane((0, 0, 0)))[0], NativeVolume(volume)
    at = volume.origin[through] + 7 * volume.spacing[through]
    layer = np.moveaxis(volume.voxels, (2 - down, 2 - across, 2 - through), (0, 1, 2))[:, :, 7]
    pixels, pixel = _cut(volume, voxels, frame, directions, at)
    assert pixel == pytest.approx(0.8)
    np.testing.assert_array_equal(pixels, layer)
    shift = np.zeros(3)
    shift[across], shift[through] = 2 * 0.8, -3 * 0.8
    object.__setattr__(frame, "motion", lambda p: np.broadcast_to(shift, p.shape))
    moved, _ = _cut(volume, voxels, frame, directions, at)
    layer = np.moveaxis(volume.voxels, (2 - down, 2 - across, 2 - through), (0, 1, 2))[:, :, 10]
    np.testing.assert_array_equal(moved[:, 2:], layer[:, :-2])


@pytest.mark.parametrize("probe", PROBES, ids=["linear", "curved"])
def test_a_cut_meets_the_plane_in_what_lies_in_both(probe):
    plane = probe_plane((1.0, 0.0, 2.0), 40.0, 12.0, 5.0)
    outline = plane.lift(_outline(probe))
    for axis in range(3):
        at = float(outline[:, axis].mean())
        pieces = _met(outline, axis, at, 0.1)
        assert pieces
        for piece in pieces:
            np.testing.assert_allclose(piece[:, axis], at, atol=1e-9)
            place = plane.lower(np.linspace(*piece, 9)[1:-1])
            np.testing.assert_allclose(place[:, 2], 0, atol=1e-9)
            assert probe.sees(place[:, :2]).all()
    assert not _met(outline, 0, 100.0, 0.1)


def test_a_cut_across_a_curved_face_meets_the_plane_in_two_pieces_and_the_planes_own_cut_in_its_outline():
    outline = probe_plane((0, 0, 0)).lift(_outline(PROBES[1]))
    assert len(_met(outline, 1, -1.0, 0.1)) == 2
    (whole,) = _met(outline, 2, 0.05, 0.1)
    assert whole is outline


def test_the_outline_of_the_drawn_probe_is_convex_and_holds_its_corners():
    points = np.random.default_rng(0).normal(size=(40, 2))
    ours, theirs = _hull(points), points[ConvexHull(points).vertices]
    assert {tuple(p) for p in ours} == {tuple(p) for p in theirs}


def test_a_needle_through_the_plane_is_parted_where_it_crosses_it(volume):
    frame = frames(volume, PROBES[0], probe_plane((0, 0, 0), 0.0))[-1]
    (behind,), (before,) = _parts(frame.pose, frame)
    assert before[:, 2].min() < -1  # z points away from who looks
    assert behind[:, 2].max() > 0.1
    np.testing.assert_allclose([before[:, 2].max(), behind[:, 2].min()], 0, atol=1e-9)
    lengths = sum(np.linalg.norm(piece[1] - piece[0]) for piece in (behind, before))
    assert lengths == pytest.approx(frame.pose.depth)
