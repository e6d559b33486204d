"""The needle in space and the imaging plane: names, handedness, orientation, projection and fading."""

from __future__ import annotations

from itertools import pairwise
from math import cos, radians, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from echospline.errors import InputError
from echospline.picture import draw_needle
from echospline.scene import (
    AXIAL,
    ImagingPlane,
    NeedlePose,
    Reach,
    RegularGrid,
    TrackedNeedle,
    UltrasoundImage,
    frames_of,
    transform_between,
)

GRID = RegularGrid((41, 31), (1.0, 1.0))  # 40 mm wide, 30 mm deep
REACH = Reach()
angle = st.floats(-3, 3)
length = st.floats(-100, 100)


def rigid(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    matrix[:3, 3] = shift
    return matrix


def needle_at(
    plane: ImagingPlane, tip: tuple[float, float, float], direction: tuple[float, float, float]
) -> np.ndarray:
    """NeedleTipToReference of a needle given in the plane's frame, built without the code under test."""
    z = np.asarray(direction, float) / np.linalg.norm(direction)
    x = np.cross([0.3, 0.5, 0.8], z)
    x /= np.linalg.norm(x)
    local = np.eye(4)
    local[:3, :3] = np.column_stack((x, np.cross(z, x), z))
    local[:3, 3] = tip
    return plane.matrix @ local


@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("NeedleTipToReference", ("NeedleTip", "Reference")),
        ("ToolToTracker", ("Tool", "Tracker")),
        ("ImageToTop", ("Image", "Top")),
    ],
)
def test_frames_are_read_from_names(name: str, frames: tuple[str, str]) -> None:
    assert frames_of(name) == frames


@pytest.mark.parametrize("name", ["Needle", "", "ToReference", "AToBToC", "NeedleTo", "needletoreference"])
def test_names_that_are_no_transforms_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="<From>To<To>"):
        frames_of(name)


@given(st.tuples(angle, angle, angle), st.tuples(length, length, length), st.tuples(angle, angle, angle))
def test_a_tracked_tip_is_found_through_tracker_reference_and_calibration(
    turn: tuple[float, float, float], shift: tuple[float, float, float], other: tuple[float, float, float]
) -> None:
    known = {
        "NeedleToTracker": rigid(turn, shift),
        "ReferenceToTracker": rigid(other, (5, 6, 7)),
        "NeedleTipToNeedle": rigid((0, 0, 0), (0, 0, 120)),
    }
    found = transform_between(known, "NeedleTip", "Reference")
    expected = (
        np.linalg.inv(known["ReferenceToTracker"]) @ known["NeedleToTracker"] @ known["NeedleTipToNeedle"]
    )
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert transform_between(known, "NeedleTip", "Image") is None


def test_the_plane_of_slicers_axial_view_is_right_handed_with_depth_to_the_back() -> None:
    plane = ImagingPlane(AXIAL)
    np.testing.assert_allclose(np.cross(AXIAL[:3, 0], AXIAL[:3, 1]), AXIAL[:3, 2])
    # RAS: R grows to the right, A to the front. 10 mm to the image's right and 20 mm deep:
    np.testing.assert_allclose(plane.lift(np.array([[10.0, 20.0]])), [[-10.0, -20.0, 0.0]])
    with pytest.raises(InputError, match="right-handed"):
        ImagingPlane(np.diag([-1.0, 1.0, 1.0, 1.0]))


def test_an_asymmetric_picture_lands_where_its_pixels_are() -> None:
    """A bright pixel near the marked side and deep comes out at the same place through image and plane."""
    grid = RegularGrid((6, 4), (0.5, 2.0), (3.0, -1.0))
    plane = ImagingPlane(rigid((0.3, -0.8, 1.2), (10, -20, 30)))
    matrix = plane.image_matrix(grid)
    for column, row in ((0, 0), (5, 0), (0, 3), (4, 2)):
        in_plane = grid.to_mm([[column, row]])
        np.testing.assert_allclose((matrix @ [column, row, 0, 1])[:3], plane.lift(in_plane)[0], atol=1e-12)
    # MF: the column axis points to the marked side (x), the row axis away from the probe (y)
    np.testing.assert_allclose(matrix[:3, 0], 0.5 * plane.matrix[:3, 0])
    np.testing.assert_allclose(matrix[:3, 1], 2.0 * plane.matrix[:3, 1])


@given(st.tuples(angle, angle, angle), st.tuples(length, length, length))
def test_the_plane_is_recovered_from_its_images_matrix(
    turn: tuple[float, float, float], shift: tuple[float, float, float]
) -> None:
    grid = RegularGrid((64, 48), (0.2, 0.15), (1.0, 2.0))
    plane = ImagingPlane(rigid(turn, shift))
    matrix = plane.image_matrix(grid)
    matrix[:3, 2] = 0  # what Slicer and PLUS say about the slice axis of a 2-D image means nothing
    np.testing.assert_allclose(ImagingPlane.of_image(matrix, grid).matrix, plane.matrix, atol=1e-9)


def test_a_calibration_for_another_spacing_is_refused() -> None:
    with pytest.raises(InputError, match=r"0\.4 x 0\.3 mm per pixel, the image 0\.2 x 0\.15"):
        ImagingPlane.of_image(np.diag([0.4, 0.3, 1, 1]), RegularGrid((64, 48), (0.2, 0.15)))


@given(
    st.tuples(angle, angle, angle), st.tuples(length, length, length), st.floats(5, 25), st.floats(30, 150)
)
def test_a_needle_in_the_plane_keeps_its_depth_angle_and_entry_wherever_the_plane_is(
    turn: tuple[float, float, float], shift: tuple[float, float, float], depth: float, degrees: float
) -> None:
    plane = ImagingPlane(rigid(turn, shift))
    dx, dy = cos(radians(degrees)), sin(radians(degrees))
    tip = (20 + depth * dx, depth * dy)
    tracked = plane.see(needle_at(plane, (*tip, 0.0), (dx, dy, 0.0)))
    assert tracked.out_of_plane == pytest.approx(0, abs=1e-9)
    assert tracked.tilt == pytest.approx(0, abs=1e-5)
    pose = tracked.pose(GRID, REACH)
    assert pose is not None
    np.testing.assert_allclose(pose.entry, (20, 0), atol=1e-6)
    np.testing.assert_allclose(pose.tip, tip, atol=1e-9)


def test_the_shaft_lies_behind_the_tip_along_minus_z() -> None:
    plane = ImagingPlane(np.eye(4))
    tip_frame = np.eye(4)
    tip_frame[:3, :3] = Rotation.from_euler("x", -90, degrees=True).as_matrix()  # takes +Z to +Y, into depth
    tip_frame[:3, 3] = (15, 12, 0)
    pose = plane.see(tip_frame).pose(GRID, REACH)
    assert pose is not None
    np.testing.assert_allclose((*pose.entry, *pose.tip), (15, 0, 15, 12), atol=1e-9)
    reverse = plane.see(tip_frame, axis=(0, 0, -1))
    np.testing.assert_allclose(reverse.direction, (0, -1, 0), atol=1e-9)


def test_the_tip_frame_that_is_sent_is_the_one_that_would_be_read() -> None:
    plane = ImagingPlane(rigid((0.3, -0.8, 1.2), (10, -20, 30)))
    pose = NeedlePose((10.0, 0.0), (22.0, 16.0))
    tip = plane.tip_matrix(pose)
    np.testing.assert_allclose(tip[:3, :3].T @ tip[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(tip) == pytest.approx(1)
    back = plane.see(tip).pose(GRID, REACH)
    assert back is not None
    np.testing.assert_allclose((*back.entry, *back.tip), (10, 0, 22, 16), atol=1e-9)


def test_a_needle_above_the_skin_waits_where_it_aims() -> None:
    direction = (sin(radians(30)), cos(radians(30)), 0.0)
    pose = TrackedNeedle((10.0, -8.0, 0.0), direction).pose(GRID, REACH)
    assert pose is not None
    assert pose.depth == 0
    assert pose.entry == pytest.approx((10 + 8 * np.tan(radians(30)), 0))


@given(st.floats(-0.5, 0.5), st.floats(-20, 20))
def test_going_through_the_skin_does_not_jump(x: float, tilt: float) -> None:
    direction = (sin(radians(tilt)), cos(radians(tilt)), 0.0)
    before, after = (TrackedNeedle((20 + x, y, 1.0), direction).pose(GRID, REACH) for y in (-1e-6, 1e-6))
    assert before is not None
    assert after is not None
    np.testing.assert_allclose((*before.entry, *before.tip), (*after.entry, *after.tip), atol=1e-5)


@pytest.mark.parametrize(
    "tip", [(20, 10, 10.1), (20, 10, -10.1), (-10.1, 10, 0), (50.1, 10, 0), (20, 40.1, 0)]
)
def test_a_needle_far_away_does_not_touch_this_tissue(tip: tuple[float, float, float]) -> None:
    assert TrackedNeedle(tip, (0, 1, 0)).pose(GRID, REACH) is None


def test_leaving_the_plane_fades_to_half_at_half_the_beam() -> None:
    def brightness(z: float) -> float:
        seen = TrackedNeedle((20.0, 15.0, z), (0.0, 1.0, 0.0)).seen(0.0, REACH)
        return 0.0 if seen is None else seen.brightness

    assert brightness(0) == 1
    assert brightness(2.0) == brightness(-2.0) == pytest.approx(0.5)  # full width at half maximum is 4 mm
    assert brightness(4.0) == 0
    values = [brightness(z) for z in np.linspace(0, 5, 200)]
    assert all(a >= b for a, b in pairwise(values))
    assert max(np.abs(np.diff(values))) < 0.11  # the last step is the cut at a tenth


def test_a_crossing_needle_shows_the_piece_inside_the_beam_not_its_tip() -> None:
    tilted = TrackedNeedle((20.0, 20.0, 8.0), (0.0, cos(radians(45)), sin(radians(45))))
    seen = tilted.seen(0.0, REACH)
    pose = tilted.pose(GRID, REACH)
    assert seen is not None
    assert pose is not None
    piece = seen.of(pose)
    # 45 degrees: 8 mm out of the plane means that the shaft crosses it 8 mm above the tip
    middle = (piece.entry[1] + piece.tip[1]) / 2
    assert middle == pytest.approx(12, abs=1e-9)
    assert piece.tip[1] < 20 - 4
    assert piece.depth == pytest.approx(REACH.thickness * np.sqrt(np.log2(10)), rel=1e-9)
    assert seen.brightness == 1


def test_a_perpendicular_needle_shows_as_a_dot_in_the_picture() -> None:
    across = TrackedNeedle((20.0, 15.0, 0.0), (0.0, 0.0, 1.0))
    seen, pose = across.seen(0.0, REACH), across.pose(GRID, REACH)
    assert seen is not None
    assert pose is not None
    image = UltrasoundImage(np.zeros((31, 41), np.uint8), GRID)
    drawn = draw_needle(image, seen.of(pose)).pixels.astype(float)
    rows, columns = np.nonzero(drawn > 60)
    assert len(rows) > 0
    assert abs(rows - 15).max() <= 2
    assert abs(columns - 20).max() <= 2


def test_nothing_is_drawn_before_the_skin_and_above_the_entry() -> None:
    assert TrackedNeedle((20.0, -3.0, 0.0), (0.0, 1.0, 0.0)).seen(0.0, REACH) is None
    grazing = TrackedNeedle(
        (20.0, 2.0, 12.0), (0.0, 0.1, np.sqrt(0.99))
    )  # it crosses the plane above the skin
    seen = grazing.seen(0.0, REACH)
    assert seen is not None
    assert seen.of(NeedlePose((20.0, 0.0), (20.0, 2.0))).depth <= 2 + 1e-9


def test_bad_reach_is_refused() -> None:
    with pytest.raises(InputError, match="thickness"):
        Reach(thickness=0)
