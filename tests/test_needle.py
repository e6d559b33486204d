"""The needle's pose and path: equations (10), (11), (13)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echospline.errors import InputError
from echospline.scene import Insertion, NeedlePose

coordinate = st.floats(-50, 50)
point = st.tuples(coordinate, coordinate)


@given(point, point, point)
def test_the_closest_point_is_no_further_than_any_other(entry, tip, p):
    pose = NeedlePose(entry, tip)
    t, d = pose.closest([p])
    sampled = pose.shaft(np.linspace(0, 1, 400))
    assert d[0] <= np.hypot(*(sampled - p).T).min() + 1e-9
    assert np.hypot(*(pose.shaft(t)[0] - p)) == pytest.approx(d[0], abs=1e-6)


def test_distance_beyond_the_ends_is_that_to_the_ends():
    pose = NeedlePose((0, 0), (0, 10))
    t, d = pose.closest([(3, -4), (3, 14), (2, 5)])
    np.testing.assert_allclose(t, [0, 1, 0.5])
    np.testing.assert_allclose(d, [5, 5, 2])


def test_a_needle_of_zero_length_has_no_axis_but_a_place():
    pose = NeedlePose((3, 4), (3, 4))
    assert (pose.depth, pose.axis) == (0.0, (0.0, 0.0))
    np.testing.assert_allclose(pose.closest([(0, 0)])[1], [5])


@pytest.mark.parametrize(
    "wrong", [((0, np.nan), (0, 0), 0), ((0, 0), (np.inf, 0), 0), ((0, 0), (1, 1), np.nan)]
)
def test_poses_that_are_not_finite_are_refused(wrong):
    with pytest.raises(InputError, match="finite"):
        NeedlePose(*wrong)


def test_angle_grows_from_lateral_to_depth():
    assert Insertion.straight((0, 0), 0, 10).pose(99).tip == pytest.approx((10, 0))
    assert Insertion.straight((0, 0), 90, 10).pose(99).tip == pytest.approx((0, 10))
    assert Insertion.straight((0, 0), 180, 10).pose(99).tip == pytest.approx((-10, 0))


def test_push_dwell_and_withdrawal_have_their_speeds():
    path = Insertion.straight((5, 0), 60, 12, 4.0, dwell=1.0, retract=True, retract_speed=6.0)
    assert path.duration == pytest.approx(3 + 1 + 2)
    speeds = {t: path.pose(t).speed for t in (0.0, 1.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0)}
    assert speeds == pytest.approx({0.0: 0, 1.5: 4, 3.0: 4, 3.5: 0, 4.0: 0, 5.0: -6, 6.0: -6, 7.0: 0})
    assert path.pose(6.0).depth == pytest.approx(0)


def test_speed_is_what_the_depth_changes_by():
    rng = np.random.default_rng(0)
    path = Insertion(np.cumsum(rng.uniform(0.5, 1, 8)), (5, 0), np.cumsum(rng.uniform(0, 3, (8, 2)), axis=0))
    h = 1e-6
    for t in rng.uniform(path.times[0] + 0.1, path.times[-1] - 0.1, 30):
        numeric = (path.pose(t).depth - path.pose(t - h).depth) / h
        assert path.pose(t).speed == pytest.approx(numeric, abs=2e-4)


def test_rounding_at_a_keyframe_does_not_stop_the_needle():
    path = Insertion.straight((0, 0), 90, 12, 6.0, dwell=1.0)
    assert path.pose(2.0 + 1e-13).speed == path.pose(2.0 - 1e-13).speed == 6.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": -1}, "depth must be a positive"),
        ({"speed": 0}, "speed must be a positive"),
        ({"dwell": -1}, "dwell"),
        ({"angle": float("nan")}, "angle"),
        ({"entry": (0, float("nan"))}, "entry must be finite"),
        ({"retract_speed": -2}, "retract_speed"),
    ],
)
def test_insertions_out_of_range_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        Insertion.straight(**{"entry": (0, 0), "angle": 90, "depth": 10, **change})


@pytest.mark.parametrize("times", [[0.0], [0.0, 0.0], [1.0, 0.5], [0.0, np.nan]])
def test_paths_whose_times_do_not_ascend_are_refused(times):
    with pytest.raises(InputError, match="ascending"):
        Insertion(np.array(times), (0, 0), np.zeros((len(times), 2)))
