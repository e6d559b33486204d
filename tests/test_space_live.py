"""The live loop in space and the geometry of a tracked needle: newest pose wins, pictures are those of the plane, rest is still."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echospline.errors import InputError
from echospline.live import Pacer
from echospline.live.space_engine import IDLE, LONGEST
from echospline.mechanics.motion import follow, follow_in_space
from echospline.scene import (
    ImagingPlane,
    NeedlePose,
    PlanePath,
    Reach,
    SpatialInsertion,
    SpatialPose,
    TrackedNeedle,
    nearest_rigid,
    pose_in_space,
    probe_plane,
    tip_frame,
)
from space_link import HOME, MODELS, expected_picture, make_engine, rigid

LOW, HIGH = np.array([-15.0, 0.0, -10.0]), np.array([15.0, 24.0, 10.0])
angle = st.floats(-3, 3)
DEEP = SpatialPose((-6.0, 0.0, 1.0), (1.0, 8.0, 2.0))


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def tick(self, engine, dt=0.04, times=1):
        for _ in range(times):
            self.now += dt
            shown = engine.step()
        return shown


@pytest.fixture
def clock():
    return Clock()


def test_a_plane_shows_the_brightness_of_its_places(clock):
    engine = make_engine(clock=clock)
    for plane in (probe_plane((1.0, 1.0, -2.0), 30.0, 10.0, -5.0), probe_plane((0.0, 2.0, 0.0), 90.0)):
        engine.move_probe(plane)
        shown = clock.tick(engine)
        assert shown.plane is plane
        pixels = shown.drawn.image.pixels.astype(float)
        inside = expected_picture(plane) > 0
        assert inside.mean() > 0.9
        assert np.abs(pixels - expected_picture(plane))[inside].max() < 2.0


def test_the_needle_deforms_the_plane_wherever_it_is(clock):
    engine = make_engine(clock=clock, lag=0.0, fastest=1e6)
    engine.command(DEEP.entry, DEEP.tip)
    plane = probe_plane((0.0, 0.0, 2.0), 15.0)
    engine.move_probe(plane)
    shown = clock.tick(engine, times=2)
    assert shown.pose.tip == pytest.approx(DEEP.tip)
    pixels = shown.drawn.image.pixels.astype(float)
    still, moved = expected_picture(plane), expected_picture(plane, DEEP)
    inside = (still > 0) & (moved > 0)
    assert np.abs(still - moved)[inside].max() > 10  # the deformation is seen at all
    assert np.abs(pixels - moved)[inside].max() < 4
    assert np.abs(pixels - moved)[inside].mean() < 0.6


def test_the_newest_pose_wins_and_none_is_queued(clock):
    engine = make_engine(clock=clock, lag=0.0, fastest=1e6)
    for k in range(20):
        engine.command(DEEP.entry, (float(k), 5.0, 0.0))
        engine.move_probe(probe_plane((float(k), 0.0, 0.0)))
    shown = clock.tick(engine)
    assert shown.pose.tip == pytest.approx((19.0, 5.0, 0.0))
    assert shown.plane.matrix[0, 3] == 19.0
    assert clock.tick(engine).pose.tip == pytest.approx((19.0, 5.0, 0.0))


def test_a_slow_machine_shows_fewer_pictures_and_no_slower_needle():
    ends = []
    for dt, times in ((0.01, 20), (0.05, 4)):
        clock = Clock()
        engine = make_engine(clock=clock, fastest=10.0, lag=0.0)
        engine.command(HOME.entry, (-6.0, 20.0, 0.0))
        ends.append(clock.tick(engine, dt, times).pose.tip[1])
    assert ends == pytest.approx([2.0, 2.0])  # 0.2 s at 10 mm/s
    clock = Clock()
    engine = make_engine(clock=clock, fastest=10.0, lag=0.0)
    engine.command(HOME.entry, (-6.0, 20.0, 0.0))
    assert clock.tick(engine, 5.0).pose.tip[1] == pytest.approx(10.0 * LONGEST)  # no leap after a pause


def test_what_rests_is_drawn_seldom_and_what_moves_at_once(clock):
    engine = make_engine(clock=clock, lag=0.0, fastest=1e6)
    engine.command(DEEP.entry, DEEP.tip)
    clock.tick(engine, times=2)
    before = engine.snapshots.latest().number
    clock.tick(engine, IDLE / 10, times=9)
    assert engine.snapshots.latest().number == before
    clock.tick(engine, IDLE, times=1)
    assert engine.snapshots.latest().number == before + 1
    engine.move_probe(probe_plane((1.0, 0.0, 0.0)))
    clock.tick(engine, IDLE / 10)
    assert engine.snapshots.latest().number == before + 2


def test_time_that_is_frozen_lets_the_probe_move_alone(clock):
    engine = make_engine(clock=clock, lag=0.0, fastest=1e6)
    engine.freeze(True)
    engine.command(DEEP.entry, DEEP.tip)
    engine.move_probe(probe_plane((2.0, 0.0, 0.0)))
    shown = clock.tick(engine)
    assert shown.frozen
    assert shown.pose.tip == HOME.tip
    assert shown.plane.matrix[0, 3] == 2.0
    engine.freeze(False)
    assert clock.tick(engine).pose.tip == pytest.approx(DEEP.tip)


def test_a_path_moves_needle_and_probe_by_the_clock(clock):
    insertion = SpatialInsertion.straight((-6.0, 0.0, 0.0), (1.0, 1.0, 0.0), 10.0, 10.0)
    planes = PlanePath(np.array([0.0, 1.0]), (probe_plane((0, 0, 0)), probe_plane((4.0, 0, 0))))
    engine = make_engine(clock=clock)
    engine.play(insertion, planes)
    shown = clock.tick(engine, 0.05, times=10)
    assert shown.replaying
    assert shown.pose.tip == pytest.approx(insertion.pose(0.5).tip)
    assert shown.plane.matrix[0, 3] == pytest.approx(2.0)
    shown = clock.tick(engine, 0.05, times=11)
    assert not shown.replaying
    assert shown.pose.tip == pytest.approx(insertion.pose(1.0).tip)
    engine.reset()
    shown = clock.tick(engine)
    assert shown.pose.tip == HOME.tip
    assert np.abs(shown.drawn.image.pixels - expected_picture(shown.plane)).max() < 2


def test_a_model_that_fails_stops_the_engine_until_a_reset(clock):
    engine = make_engine(clock=clock)
    engine.switch("failing")
    engine.command(DEEP.entry, DEEP.tip)
    shown = clock.tick(engine, times=3)
    assert "no answer" in shown.failure
    engine.reset()
    engine.switch("soft")
    shown = clock.tick(engine, times=2)
    assert shown.failure is None
    assert shown.model == "soft"


def test_a_needle_that_is_placed_was_inserted_straight(clock):
    seen = []

    class Watching(type(MODELS["soft"])):
        def advance(self, state, pose, dt):
            seen.append(pose)
            return pose

    engine = make_engine(clock=clock)
    engine._model = Watching()
    engine.place(DEEP.entry, DEEP.tip)
    shown = clock.tick(engine)
    assert shown.pose.tip == pytest.approx(DEEP.tip)
    depths = [pose.depth for pose in seen[:-1]]
    assert max(np.diff([0.0, *depths])) <= 0.5 + 1e-9
    assert all(np.allclose(pose.axis, DEEP.axis) for pose in seen if pose.depth)


def test_one_thread_steps_while_others_command():
    engine = make_engine(rate=200.0)
    threads = set()
    draw = engine.drawing.draw
    engine.drawing.draw = lambda *words: (threads.add(threading.get_ident()), draw(*words))[1]
    with Pacer(engine):
        until = time.monotonic() + 30
        k = 0
        while len(threads) < 1 or k < 50:
            assert time.monotonic() < until
            engine.move_probe(probe_plane((k / 10, 0.0, 0.0)))
            engine.command(DEEP.entry, DEEP.tip)
            k += 1
            time.sleep(0.002)
    assert len(threads) == 1
    assert threading.get_ident() not in threads


@pytest.mark.parametrize("wrong", [{"rate": 0}, {"lag": -1}, {"fastest": 0}])
def test_an_engine_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        make_engine(**wrong)


@given(
    st.lists(st.floats(-20, 20), min_size=8, max_size=8), st.floats(0.001, 0.1), st.floats(0, 0.1), st.floats(1, 300)
)  # fmt: skip
def test_following_in_a_plane_of_space_is_following_in_the_plane(numbers, dt, lag, fastest):
    a, b, c, d = ((numbers[2 * i], numbers[2 * i + 1]) for i in range(4))
    flat = follow(NeedlePose(a, b), c, d, dt, lag, fastest)
    space = follow_in_space(SpatialPose((*a, 3.0), (*b, 3.0)), (*c, 3.0), (*d, 3.0), dt, lag, fastest)
    np.testing.assert_allclose(
        (*space.entry, *space.tip), (*flat.entry, 3.0, *flat.tip, 3.0), rtol=1e-12, atol=1e-12
    )
    assert space.speed == pytest.approx(flat.speed, rel=1e-9, abs=1e-9)


@given(st.floats(-8, 8), st.floats(-8, 8), st.floats(-60, 60), st.floats(-60, 60), st.floats(1, 20))
def test_a_tracked_needle_enters_where_its_axis_crosses_the_skin(x, z, tilt, lean, depth):
    direction = np.array([np.tan(np.radians(tilt)), 1.0, np.tan(np.radians(lean))])
    direction /= np.linalg.norm(direction)
    entry = np.array([x, 0.0, z])
    tip = entry + depth * direction
    pose = pose_in_space(TrackedNeedle(tuple(tip), tuple(direction)), LOW - 100, HIGH + 100, Reach())
    np.testing.assert_allclose((*pose.entry, *pose.tip), (*entry, *tip), atol=1e-9)
    before = pose_in_space(
        TrackedNeedle(tuple(entry - 3 * direction), tuple(direction)), LOW - 100, HIGH + 100, Reach()
    )
    assert before.depth == 0
    if direction[1] > 0.06:
        np.testing.assert_allclose(before.entry, entry, atol=1e-9)


@pytest.mark.parametrize("tip", [(-26, 5, 0), (26, 5, 0), (0, 35, 0), (0, 5, -21), (0, 5, 21)])
def test_a_needle_far_from_the_volume_touches_nothing(tip):
    assert pose_in_space(TrackedNeedle(tip, (0, 1, 0)), LOW, HIGH, Reach()) is None
    nearer = tuple(np.clip(tip, LOW - 9.9, HIGH + 9.9))
    assert pose_in_space(TrackedNeedle(nearer, (0, 1, 0)), LOW, HIGH, Reach()) is not None


def test_a_needle_above_the_skin_waits_at_the_height_of_the_skin_however_far_up():
    pose = pose_in_space(TrackedNeedle((1.0, -200.0, 2.0), (0, 1, 0)), LOW, HIGH, Reach())
    assert pose.tip == (1.0, 0.0, 2.0)
    level = pose_in_space(TrackedNeedle((1.0, -5.0, 2.0), (1, 0, 0)), LOW, HIGH, Reach())
    assert level.tip == (1.0, 0.0, 2.0)


@given(st.tuples(angle, angle, angle), st.tuples(angle, angle, angle))
def test_the_tip_frame_that_is_sent_is_the_one_that_would_be_read(a, b):
    pose = SpatialPose(a, b)
    matrix = tip_frame(pose)
    np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    seen = ImagingPlane(np.eye(4)).see(matrix)
    assert seen.tip == pytest.approx(b)
    if pose.depth > 1e-3:
        np.testing.assert_allclose(
            seen.direction, np.subtract(b, a) / np.linalg.norm(np.subtract(b, a)), atol=1e-6
        )


@given(st.tuples(angle, angle, angle), st.integers(0, 2**31))
def test_the_nearest_motion_to_a_rounded_one_is_a_motion_and_near(turn, seed):
    exact = rigid(turn, (1.0, 2.0, 3.0))
    rounded = exact.copy()
    rounded[:3, :3] += np.random.default_rng(seed).uniform(-5e-4, 5e-4, (3, 3))
    found = nearest_rigid(rounded)
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(found, exact, atol=2e-3)
    np.testing.assert_array_equal(found[:3, 3], rounded[:3, 3])
    np.testing.assert_allclose(nearest_rigid(exact), exact, atol=1e-12)
