"""The live loop: newest in, newest out, steady steps, and faults that stay where they happen."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.live import Command, LiveEngine, Metronome, Pacer, Slot, follow
from echospline.scene import Insertion, NeedlePose, RegularGrid

GRID = RegularGrid((9, 7), (5.0, 5.0))
HOME = NeedlePose((20.0, 0.0), (20.0, 0.0))


@dataclass(frozen=True)
class Bump:
    """Stand-in tissue: a smooth bump that is dragged by the tip and relaxes; `strength` tells models apart."""

    grid: RegularGrid = GRID
    strength: float = 1.0
    fails_below: float = np.inf

    def rest(self):
        return (0.0, (0.0, 0.0), (20.0, 0.0))

    def advance(self, state, pose, dt):
        if pose.depth > self.fails_below:
            raise ZeroDivisionError("no tissue left")
        push = state[0] * np.exp(-2.0 * dt) + self.strength * 0.02 * pose.speed * dt
        return (push, pose.axis if pose.depth > 0 else state[1], pose.tip)

    def displacement(self, state):
        return self.displacement_at(state, self.grid.nodes)

    def displacement_at(self, state, points):
        push, axis, tip = state
        r2 = ((np.asarray(points) - tip) ** 2).sum(axis=1)
        return push * np.exp(-r2 / 50.0)[:, None] * np.asarray(axis)


def models(name):
    known = {"soft": Bump(), "stiff": Bump(strength=0.5), "fragile": Bump(fails_below=3.0)}
    return known[name]


def engine(name="soft", **options):
    return LiveEngine(models, name, HOME, rate=100.0, **options)


def run(live, steps):
    for _ in range(steps):
        snapshot = live.step()
    return snapshot


# --- the slot


def test_a_slow_reader_gets_the_newest_value_and_none_of_the_old():
    slot = Slot()
    for value in range(1000):
        slot.put(value)
    assert slot.wait(newer_than=3) == (1000, 999)
    assert slot.wait(newer_than=1000, timeout=0.01) is None


def test_a_waiting_reader_wakes_for_a_newer_value_only():
    slot = Slot()
    slot.put("old")
    got = []
    reader = threading.Thread(target=lambda: got.append(slot.wait(newer_than=1, timeout=10)))
    reader.start()
    time.sleep(0.05)
    assert not got
    slot.put("new")
    reader.join(10)
    assert got == [(2, "new")]


def test_a_callback_is_called_once_and_at_once_if_the_value_is_here():
    slot, calls = Slot(), []
    slot.call_when_newer(0, lambda: calls.append("first"))
    assert calls == []
    slot.put(1)
    slot.put(2)
    assert calls == ["first"]
    slot.call_when_newer(1, lambda: calls.append("late"))
    assert calls == ["first", "late"]


# --- following the hand


def test_speed_is_that_of_the_hand_whatever_the_rate_of_commands():
    """Commands at 30 Hz of a hand that moves at 12 mm/s, steps at 120 Hz: the engine's speed stays near 12."""
    pose, speeds, depth = HOME, [], 0.0
    for step in range(480):
        if step % 4 == 0:
            depth = 12.0 * step / 120.0
        pose = follow(pose, Command((20, 0), (20.0, depth)), 1 / 120, lag=0.1, fastest=200.0)
        speeds.append(pose.speed)
    settled = np.array(speeds[240:])
    assert settled.mean() == pytest.approx(12.0, rel=0.01)
    assert settled.std() < 0.15 * 12.0
    raw = np.where(np.arange(240) % 4 == 0, 48.0, 0.0)  # what commands taken as they come would give
    assert raw.std() > 10 * settled.std()


@pytest.mark.parametrize("every", [1, 2, 8, 20])
def test_a_steady_push_is_steady_however_slow_the_screen(every):
    """A hand at 10 mm/s seen at 120, 60, 15 or 6 Hz: the speed that the tissue feels stays within half of it."""
    live, speeds = LiveEngine(models, "soft", HOME, rate=120.0), []
    for step in range(480):
        if step % every == 0:
            live.command((20.0, 0.0), (20.0, 10.0 * step / 120.0))
        speeds.append(live.step().pose.speed)
    settled = np.array(speeds[240:])
    assert settled.mean() == pytest.approx(10.0, rel=0.05)
    assert settled.max() < 17.0
    assert settled.min() > 5.0


def test_the_needle_arrives_exactly_and_then_rests():
    live = engine()
    live.command((20.0, 0.0), (22.5, 14.25))
    end = run(live, 200)
    assert end.pose.tip == (22.5, 14.25)
    assert end.pose.speed == 0.0


def test_withdrawal_has_negative_speed_and_no_pose_is_faster_than_the_limit():
    live = engine(fastest=50.0)
    live.command((20.0, 0.0), (20.0, 30.0))
    speeds = [live.step().pose.speed for _ in range(150)]
    assert max(speeds) == pytest.approx(50.0)
    live.command((20.0, 0.0), (20.0, 0.0))
    assert min(live.step().pose.speed for _ in range(150)) == pytest.approx(-50.0)


def test_newest_command_wins_and_its_number_comes_back():
    live = engine(lag=0.0, fastest=1e9)
    for k in range(500):
        live.command((20.0, 0.0), (20.0, 0.01 * k), number=k, sent=k / 8)
    snapshot = live.step()
    assert (snapshot.command.number, snapshot.command.sent) == (499, 499 / 8)
    assert snapshot.pose.tip == (20.0, 4.99)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_command_that_is_not_finite_is_refused_and_changes_nothing(bad):
    live = engine()
    with pytest.raises(InputError, match="finite"):
        live.command((20.0, 0.0), (20.0, bad))
    assert live.step().pose.tip == (20.0, 0.0)


# --- states


def test_reset_restores_the_tissue_exactly():
    live = engine()
    live.command((20.0, 0.0), (20.0, 12.0))
    assert np.abs(run(live, 20).displacement).max() > 0.01
    live.reset()
    snapshot = live.step()
    assert (snapshot.displacement == 0).all()
    assert (snapshot.pose, snapshot.time) == (HOME, pytest.approx(live.period))


def test_time_stands_still_while_frozen_and_the_newest_command_waits():
    live = engine()
    live.command((20.0, 0.0), (20.0, 12.0))
    before = run(live, 5)
    live.freeze(True)
    live.command((20.0, 0.0), (20.0, 20.0), number=7)
    frozen = run(live, 30)
    assert frozen.frozen
    assert frozen.pose.speed == 0.0
    assert (frozen.time, frozen.pose.tip) == (before.time, before.pose.tip)
    np.testing.assert_array_equal(frozen.displacement, before.displacement)
    live.freeze(False)
    assert run(live, 200).pose.tip == (20.0, 20.0)


def test_switching_the_model_keeps_the_pose():
    live = engine()
    live.command((20.0, 0.0), (24.0, 12.0))
    before = run(live, 200)
    live.switch("stiff")
    after = live.step()
    assert (after.model, after.pose) == ("stiff", before.pose)
    assert np.abs(after.displacement).max() > 0


def test_two_models_compared_see_the_same_poses():
    """The stand-in is linear in its strength, so the model of half the strength gives half the field."""
    live = engine()
    live.compare("stiff")
    live.command((20.0, 0.0), (20.0, 12.0))
    snapshot = run(live, 30)
    assert np.abs(snapshot.displacement).max() > 0.01
    np.testing.assert_allclose(snapshot.reference, snapshot.displacement / 2, atol=1e-12)
    live.compare(None)
    assert live.step().reference is None


def test_watched_points_move_with_the_tissue():
    live = engine()
    live.watch([(20.0, 10.0), (0.0, 30.0)])
    assert (live.step().watched == [(20.0, 10.0), (0.0, 30.0)]).all()
    live.command((20.0, 0.0), (20.0, 9.0))
    snapshot = run(live, 8)
    assert snapshot.watched[0, 1] > 10.01
    assert snapshot.watched[1] == pytest.approx((0.0, 30.0), abs=1e-3)


def test_a_recording_replayed_gives_the_same_field_bit_for_bit():
    live, seen = engine(), []
    live.observe(seen.append)
    path = Insertion.straight((20.0, 0.0), 80.0, 15.0, 20.0, retract=True)
    for k in range(120):
        live.command(path.pose(0.01 * k).entry, path.pose(0.01 * k).tip)
        live.step()
    live.unobserve(seen.append)
    live.replay([snapshot.pose for snapshot in seen])
    for recorded in seen:
        again = live.step()
        assert again.replaying
        assert again.pose == recorded.pose
        np.testing.assert_array_equal(again.displacement, recorded.displacement)
    assert not live.step().replaying


def test_a_model_that_fails_is_reported_and_a_reset_starts_it_again(caplog):
    live = engine("fragile")
    live.command((20.0, 0.0), (20.0, 2.0))
    good = run(live, 100)
    live.command((20.0, 0.0), (20.0, 10.0))
    failed = run(live, 100)
    assert failed.failure == "ZeroDivisionError: no tissue left"
    assert np.isfinite(failed.displacement).all()
    assert failed.pose.depth < 3.0 or failed.pose == good.pose
    assert "fragile failed" in caplog.text
    assert sum("failed" in r.message for r in caplog.records) == 1  # said once, not at every step
    live.reset()
    assert live.step().failure is None


def test_an_unknown_model_is_reported_and_the_old_one_can_go_on(caplog):
    live = engine()
    live.switch("jelly")
    assert "KeyError" in live.step().failure
    live.reset()
    assert (live.step().model, live.step().failure) == ("soft", None)


@pytest.mark.parametrize(
    ("name", "value"), [("rate", 0.0), ("rate", np.nan), ("lag", -1.0), ("fastest", 0.0)]
)
def test_an_engine_refuses_settings_out_of_range(name, value):
    with pytest.raises(InputError, match=name):
        LiveEngine(models, "soft", HOME, **{name: value})


# --- the clock


def test_a_steady_clock_gives_one_step_per_period():
    now, beats = 100.0, []
    metronome = Metronome(0.01, now)
    for _ in range(50):
        now += 0.003  # the step itself
        now += metronome.wait(now)
        beats.append(now)
    np.testing.assert_allclose(beats, 100.0 + 0.01 * np.arange(1, 51))
    assert metronome.missed == 0


def test_a_short_hitch_is_made_up_and_a_long_one_is_given_up():
    metronome = Metronome(0.01, 0.0)
    assert metronome.wait(0.035) == 0.0  # two and a half periods late: steps follow without sleeping
    assert metronome.wait(0.035) == 0.0
    assert metronome.wait(0.035) == 0.0
    assert metronome.wait(0.035) == pytest.approx(0.005)
    assert metronome.missed == 0
    assert metronome.wait(10.0) == 0.0  # an hour of sleep is not made up
    assert metronome.missed == pytest.approx(995, abs=1)
    assert metronome.wait(10.0) == pytest.approx(0.01)


def test_the_pacers_thread_steps_and_ends():
    live = engine()
    with Pacer(live) as pacer:
        first = live.snapshots.wait(newer_than=1, timeout=10)
        later = live.snapshots.wait(newer_than=first.number + 3, timeout=10)
        assert later.value.step > first.value.step
        assert pacer.alive
    assert not pacer.alive
    number = live.snapshots.latest().number
    time.sleep(0.05)
    assert live.snapshots.latest().number == number
