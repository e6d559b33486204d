"""Scores against paths whose metrics are known by hand, and sessions that survive."""

from __future__ import annotations

import csv
import io
import os
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echospline.errors import InputError
from echospline.live import LiveEngine, Recorder, Trace
from echospline.page import Disc, Exercise, default_exercises, score
from echospline.page.exercise import check_exercises
from echospline.page.scoring import redirections, smoothness
from echospline.scenario import load
from echospline.scene import Insertion, NeedlePose, RegularGrid
from echospline.viewer import Sessions, sessions_csv, trace_csv

PERIOD = 0.01
MESH = RegularGrid((41, 31), (1.0, 1.0))
EXERCISE = Exercise(
    name="straight-down",
    title="Straight down",
    goal="Push the tip into the ring.",
    target=Disc(centre=(20.0, 12.0), radius=3.0),
)
PAST = Exercise(
    name="past",
    title="Past the vessel",
    target=Disc(centre=(28.0, 18.0), radius=2.0),
    vessels=[Disc(centre=(20.0, 10.0), radius=2.0)],
    most_redirections=0,
)


class Still:
    """Tissue that does not move."""

    grid = MESH

    def rest(self):
        return None

    def advance(self, state, pose, dt):
        return pose

    def displacement(self, state):
        return np.zeros((MESH.size, 2))

    def displacement_at(self, state, points):
        return np.zeros(np.shape(points))


def trace_of(insertion, exercise=EXERCISE, after=0.0, shift=(0.0, 0.0)):
    times = np.arange(1, round((insertion.duration + after) / PERIOD) + 1) * PERIOD
    poses = [insertion.pose(t) for t in times]
    rows = np.array([(*p.entry, *p.tip, p.speed) for p in poses])
    watched = np.repeat(np.array(exercise.landmarks)[None] + shift, len(rows), axis=0)
    return Trace(PERIOD, rows, watched)


def path(*keyframes, entry=(20.0, 0.0)):
    """Insertion through (time, angle, depth)."""
    times, angles, depths = np.array(keyframes, dtype=float).T
    fine = np.linspace(times[0], times[-1], 2001)
    a, d = np.radians(np.interp(fine, times, angles)), np.interp(fine, times, depths)
    return Insertion(fine, np.array(entry), entry + d[:, None] * np.stack([np.cos(a), np.sin(a)], axis=1))


def test_a_straight_hit_scores_as_by_hand():
    result = score(trace_of(Insertion.straight((20.0, 0.0), 90.0, 12.0, 4.0)), EXERCISE)
    assert result.passed
    assert result.time == pytest.approx(3.0)
    assert result.tissue_time == pytest.approx(3.0 - 0.5 / 4, abs=PERIOD)
    assert result.path_length == pytest.approx(11.5, abs=0.05)  # half a millimetre counts as outside
    assert result.path_inefficiency == pytest.approx(0.0, abs=1e-9)
    assert result.tissue_damage == pytest.approx(0.0, abs=1e-9)
    assert (result.punctures, result.redirections, result.vessel_contacts) == (1, 0, 0)
    assert result.final_error == pytest.approx(0.0, abs=1e-9)


def test_the_error_is_measured_to_the_deformed_target():
    straight = Insertion.straight((20.0, 0.0), 90.0, 12.0, 4.0)
    result = score(trace_of(straight, shift=(0.0, 3.5)), EXERCISE)
    assert result.final_error == pytest.approx(3.5)
    assert result.target_shift == pytest.approx(3.5)
    assert not result.passed
    followed = score(trace_of(Insertion.straight((20.0, 0.0), 90.0, 15.5, 4.0), shift=(0.0, 3.5)), EXERCISE)
    assert followed.passed


def test_a_needle_swept_about_its_entry_damages_a_sector():
    """Area of a sector: angle (radians) times depth squared over two."""
    result = score(trace_of(path((0, 60, 0), (2, 60, 20), (6, 90, 20))), EXERCISE)
    assert result.tissue_damage == pytest.approx(np.radians(30) * 20**2 / 2, rel=1e-3)


def test_going_there_and_back_doubles_the_path():
    result = score(trace_of(path((0, 90, 1), (2, 90, 12), (3, 90, 6), (4, 90, 12))), EXERCISE)
    assert result.path_inefficiency == pytest.approx(100 * 12 / 11, rel=0.01)


def test_turns_are_counted_once_each_however_long_they_take():
    turning = path(
        (0, 60, 0), (1, 60, 10), (3, 80, 10), (4, 80, 10), (4.3, 70, 10), (5.5, 70, 10), (6, 70, 15)
    )
    assert score(trace_of(turning), EXERCISE).redirections == 2
    trembling = path((0, 60, 0), (1, 60, 10), (1.5, 61, 10), (2, 59.5, 10), (2.5, 61, 10), (4, 60, 15))
    assert score(trace_of(trembling), EXERCISE).redirections == 0
    outside = path((0, 60, 0), (1, 120, 0), (3, 120, 12))
    assert score(trace_of(outside), EXERCISE).redirections == 0


def test_punctures_and_vessel_contacts_are_counted():
    twice = path((0, 90, 0), (2, 90, 12), (4, 90, 0), (5, 45, 0), (6, 45, 20))
    result = score(trace_of(twice, PAST), PAST)
    assert result.punctures == 2
    assert result.vessel_contacts == 1  # straight down through (20, 10); at 45 degrees it passes by
    assert not result.passed


def test_a_vessel_moves_with_the_tissue():
    beside = path((0, 90, 0), (2, 90, 15), entry=(24.5, 0.0))
    assert score(trace_of(beside, PAST), PAST).vessel_contacts == 0
    assert score(trace_of(beside, PAST, shift=(3.0, 0.0)), PAST).vessel_contacts == 1


def test_too_many_redirections_fail_the_exercise():
    end = PAST.target.centre
    angle = np.degrees(np.arctan2(end[1], end[0] - 26.0))
    depth = np.hypot(end[0] - 26.0, end[1])
    straight = path((0, angle, 0), (3, angle, depth), entry=(26.0, 0.0))
    turned = path((0, angle - 20, 0), (1, angle - 20, 5), (2, angle, 5), (3, angle, 5), (5, angle, depth),
                  entry=(26.0, 0.0))  # fmt: skip
    assert score(trace_of(straight, PAST), PAST).passed
    assert score(trace_of(turned, PAST), PAST).redirections == 1
    assert not score(trace_of(turned, PAST), PAST).passed


def test_smoothness_of_a_cubic_path_is_its_jerk():
    """x = j t^3 / 6 has the constant jerk j, so the metric is j sqrt(T) over the blocks that have a third difference."""
    times, jerk = np.arange(1, 401) * PERIOD, 30.0
    rows = np.zeros((400, 5))
    rows[:, 3] = jerk * times**3 / 6
    got = smoothness(Trace(PERIOD, rows, np.zeros((400, 1, 2))))
    assert got == pytest.approx(jerk * np.sqrt(0.05 * (80 - 3)), rel=1e-6)


def test_a_trembling_hand_is_less_smooth():
    calm = trace_of(path((0, 90, 1), (4, 90, 20)))
    rows = calm.poses.copy()
    rows[:, 3] += 0.2 * np.sin(2 * np.pi * 4 * calm.times)
    assert smoothness(replace(calm, poses=rows)) > 10 * smoothness(calm) + 10


def test_nothing_recorded_is_no_success():
    empty = Trace(PERIOD, np.empty((0, 5)), np.empty((0, 1, 2)))
    assert not score(empty, EXERCISE).passed
    out = score(trace_of(path((0, 90, 0), (1, 90, 12), (2, 90, 0))), EXERCISE)
    assert not out.passed
    assert out.to_dict()["final_error"] is None


def test_a_trace_of_another_exercise_is_refused():
    with pytest.raises(InputError, match="watches 2 places"):
        score(trace_of(path((0, 90, 0), (1, 90, 12))), PAST)


def test_redirections_need_the_needle_inside():
    trace = trace_of(path((0, 60, 10), (1, 90, 10), (3, 90, 10)))
    assert redirections(trace, np.zeros(len(trace), bool)) == 0
    assert redirections(trace, np.ones(len(trace), bool)) == 1


# --- recording


def test_a_recorder_takes_every_step_and_begins_anew_at_a_reset():
    live = LiveEngine(lambda _: Still(), "still", NeedlePose((20.0, 0.0), (20.0, 0.0)), rate=100.0)
    live.watch(EXERCISE.landmarks)
    recorder = Recorder(live.period, longest=0.5)
    live.observe(recorder)
    live.command((20.0, 0.0), (20.0, 8.0))
    for _ in range(20):
        live.step()
    live.reset()
    for _ in range(10):
        live.step()
    live.freeze(True)
    for _ in range(10):
        live.step()
    assert len(recorder.trace()) == 10
    assert recorder.elapsed == pytest.approx(0.1)
    live.freeze(False)
    for _ in range(100):
        live.step()
    assert recorder.over
    assert len(recorder.trace()) == 50


@given(st.integers(0, 40), st.integers(0, 3))
def test_a_trace_comes_back_from_its_bytes(rows, watched):
    rng = np.random.default_rng(rows)
    trace = Trace(1 / 120, rng.normal(size=(rows, 5)), rng.normal(size=(rows, watched, 2)))
    again = Trace.from_bytes(trace.to_bytes())
    assert again.period == trace.period
    np.testing.assert_array_equal(again.poses, trace.poses)
    np.testing.assert_array_equal(again.watched, trace.watched)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda b: b[:10],
        lambda b: b[:-5],
        lambda b: b[:8] + np.float64(1e15).tobytes() + b[16:],
        lambda b: b[:8] + np.float64(-1).tobytes() + b[16:],
        lambda b: np.float64(np.nan).tobytes() + b[8:],
        lambda b: b[:24] + b"rubbish",
    ],
)
def test_a_damaged_trace_is_refused(spoil):
    data = trace_of(path((0, 90, 0), (1, 90, 12))).to_bytes()
    with pytest.raises(InputError, match="stored trace"):
        Trace.from_bytes(spoil(data))


# --- exercises


SCENARIO = """format = 1
[[exercise]]
name = "a"
title = "A"
target = { centre = [20.0, 12.0], radius = 2 }
vessels = [{ centre = [1, 2], radius = 3 }]
"""


def test_exercises_are_read_from_a_scenario_and_written_back(tmp_path):
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    loaded = load(tmp_path / "scenario.toml")
    assert loaded.exercise[0].landmarks == [(20.0, 12.0), (1.0, 2.0)]
    loaded.save(tmp_path / "again.toml", tmp_path)
    assert load(tmp_path / "again.toml").exercise == loaded.exercise


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('title = "A"', "", r"exercise\.0\.title is missing"),
        ("[20.0, 12.0]", "[nan, 1]", "centre"),
        ("radius = 2", "radius = -1", "radius"),
        ('title = "A"', 'title = "A"\ncolour = 1', "colour is not a known key"),
    ],
)
def test_wrong_exercises_are_refused_by_name(tmp_path, old, new, match):
    (tmp_path / "scenario.toml").write_text(SCENARIO.replace(old, new))
    with pytest.raises(InputError, match=match):
        load(tmp_path / "scenario.toml")


def corners(grid):
    x0, x1, y0, y1 = grid.extent
    return (x0, y0), (x1, y1)


def test_two_exercises_of_one_name_are_refused():
    with pytest.raises(InputError, match="names must differ"):
        check_exercises([EXERCISE, EXERCISE], *corners(MESH))


def test_a_target_outside_the_image_is_refused_and_the_default_ones_fit_any():
    outside = Exercise(name="a", title="A", target=Disc(centre=(99.0, 1.0), radius=1.0))
    with pytest.raises(InputError, match="must lie in the image"):
        check_exercises([outside], *corners(MESH))
    for grid in (RegularGrid((5, 90), (3.0, 1.0), (-10.0, 4.0)), MESH):
        check_exercises(default_exercises(grid), *corners(grid))


# --- sessions


def stored(folder, count=1):
    sessions = Sessions(folder / "deep" / "sessions.sqlite")
    trace = trace_of(Insertion.straight((20.0, 0.0), 90.0, 12.0, 4.0))
    for _ in range(count):
        sessions.add(EXERCISE, trace, score(trace, EXERCISE), trainee="=Ann", scene="Speckle", model="soft")
    return sessions, trace


def test_a_session_comes_back_whole_and_scores_the_same(tmp_path):
    sessions, trace = stored(tmp_path, 2)
    newest = sessions.newest()
    assert [session.id for session in newest] == [2, 1]
    session, exercise, again = Sessions(sessions.path).load(2)
    np.testing.assert_array_equal(again.poses, trace.poses)
    assert score(again, exercise).to_dict() == session.score == newest[0].score
    with pytest.raises(InputError, match="no session 3"):
        sessions.load(3)


def test_csv_has_units_and_no_formula(tmp_path):
    sessions, trace = stored(tmp_path, 2)
    rows = list(csv.DictReader(io.StringIO(sessions_csv(sessions.newest()))))
    assert [row["id"] for row in rows] == ["1", "2"]
    assert rows[0]["trainee"] == "'=Ann"
    assert float(rows[0]["final_error (mm)"]) == pytest.approx(0.0, abs=1e-9)
    table = list(csv.DictReader(io.StringIO(trace_csv(trace))))
    assert len(table) == len(trace)
    assert float(table[-1]["tip_y (mm)"]) == pytest.approx(12.0)


def test_another_file_is_not_taken_for_sessions(tmp_path):
    (tmp_path / "text").write_text("not a database, and long enough to have a header" * 40)
    with pytest.raises(InputError, match="--sessions"):
        Sessions(tmp_path / "text")
    newer = tmp_path / "newer.sqlite"
    with sqlite3.connect(newer) as database:
        database.execute("PRAGMA user_version = 99")
    with pytest.raises(InputError, match="schema 99"):
        Sessions(newer)


def test_sessions_survive_being_killed_at_any_point(tmp_path):
    """A process that stores sessions without end is killed several times; what is there is always whole."""
    writer = (
        "import sys; sys.path.insert(0, 'tests')\nfrom pathlib import Path\nfrom test_viewer_scoring import stored\n"
        "print('up', flush=True)\nwhile True: stored(Path(sys.argv[1]), 20)\n"
    )
    root = Path(__file__).resolve().parent.parent
    counts = []
    for delay in (0.02, 0.09):
        process = subprocess.Popen(
            [sys.executable, "-c", writer, str(tmp_path)], cwd=root, stdout=subprocess.PIPE
        )
        assert process.stdout.readline()
        time.sleep(delay + 0.15)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
        sessions = Sessions(tmp_path / "deep" / "sessions.sqlite")
        with sqlite3.connect(sessions.path) as database:
            assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        counts.append(len(sessions.newest()))
        session, exercise, trace = sessions.load(counts[-1])
        assert score(trace, exercise).to_dict() == session.score
    assert counts[0] > 0
    assert counts == sorted(set(counts))
