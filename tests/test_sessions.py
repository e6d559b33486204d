"""The file of sessions: attempts counted, origin and verification kept, older files brought up to date, several processes at once."""

from __future__ import annotations

import base64
import json
import sqlite3
import subprocess
import sys

import numpy as np
import pytest

import page_scene
from echospline.errors import InputError
from echospline.live import Trace
from echospline.page import Exercise, parsed_sessions, score, verify
from echospline.viewer import Record, Sessions
from echospline.viewer.class_answers import session_file, sessions_file
from echospline.viewer.session_schema import SCHEMA_VERSION
from node_here import NODE, STEADY
from test_page_replay import honest

EXERCISE = page_scene.EXERCISE
OLD = """CREATE TABLE session (id INTEGER PRIMARY KEY, started TEXT NOT NULL, trainee TEXT NOT NULL, exercise TEXT NOT NULL,
definition TEXT NOT NULL, scene TEXT NOT NULL, source TEXT NOT NULL, model TEXT NOT NULL, score TEXT NOT NULL, trace BLOB NOT NULL{})"""
COLUMNS = {
    1: [],
    2: ["picture", "upload"],
    3: ["picture", "upload", "verified", "made", "digest"],
}
MADE = {
    "version": "0.1.0", "core": "c" * 64, "pack": "d" * 64, "attempt": 7, "ended": "reset", "examination": True,
    "events": [[3, "entered"]],
}  # fmt: skip


@pytest.fixture(scope="module")
def pack():
    return page_scene.small()


@pytest.fixture(scope="module")
def rows():
    return page_scene.poses()


def trace_of(rows):
    return Trace(1 / 120, rows, np.repeat(np.array([EXERCISE.landmarks]), len(rows), axis=0))


def old_file(path, version, rows, people=("Ann", "Ben", "Ann")):
    """Write a file as the version of that schema did."""
    trace = trace_of(rows)
    definition = EXERCISE.model_dump(
        exclude={"help", "entry", "entry_between", "attempts"}
    )  # not known at the time
    with sqlite3.connect(path) as database:
        more = "".join(f", {name} TEXT NOT NULL DEFAULT ''" for name in COLUMNS[version])
        database.execute(OLD.format(more))
        for k, name in enumerate(people):
            row = [
                f"2026-01-0{k + 1}T10:00:00+00:00", name, EXERCISE.name, json.dumps(definition), "Speckle", "{}", "tps",
                json.dumps(score(trace, EXERCISE).to_dict()), trace.to_bytes(),
            ]  # fmt: skip
            given = {"picture": "p", "upload": "u", "verified": ("yes", "", "time is 4, the page said 3")[k]}
            given |= {"made": json.dumps(MADE) if k != 1 else "", "digest": f"{k}" * 64 if k != 1 else ""}
            row += [given[name] for name in COLUMNS[version]]
            database.execute(
                f"INSERT INTO session (started, trainee, exercise, definition, scene, source, model, score, trace{''.join(', ' + c for c in COLUMNS[version])}) "
                f"VALUES ({', '.join('?' * len(row))})",
                row,
            )
        database.execute(f"PRAGMA user_version = {version}")
    return trace


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_file_of_an_older_version_is_kept_whole_and_its_attempts_are_counted(tmp_path, rows, version):
    trace = old_file(tmp_path / "old.sqlite", version, rows)
    sessions = Sessions(tmp_path / "old.sqlite")
    found = sessions.every()
    assert [(s.id, s.trainee, s.attempt) for s in found] == [(1, "Ann", 1), (2, "Ben", 1), (3, "Ann", 2)]
    for session in found:
        _, exercise, again = sessions.load(session.id)
        np.testing.assert_array_equal(again.poses, trace.poses)
        assert score(again, exercise).to_dict() == session.score
        assert exercise == EXERCISE
    assert [s.picture for s in found] == (["p"] * 3 if version > 1 else [""] * 3)
    if version < 3:
        assert [s.verified for s in found] == [None] * 3
    else:
        assert [s.verified for s in found] == [True, None, False]
        assert found[2].difference == "time is 4, the page said 3"
        assert [s.told for s in found] == [7, None, 7]
        assert (found[0].version, found[0].core, found[0].pack) == ("0.1.0", "c" * 64, "d" * 64)
        assert (found[0].ended, found[0].examination, found[0].events) == ("reset", True, [[3, "entered"]])
        assert sessions.number_of("2" * 64) == 3
    number = sessions.add(
        EXERCISE, trace, score(trace, EXERCISE), trainee="Ann", scene="Speckle", model="tps"
    )
    assert sessions.find(number).attempt == 3
    with sqlite3.connect(tmp_path / "old.sqlite") as database:
        assert database.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    assert [s.id for s in Sessions(tmp_path / "old.sqlite").every()] == [1, 2, 3, 4]


def test_a_newer_file_and_a_database_of_something_else_are_refused_and_left_as_they_are(tmp_path):
    newer = tmp_path / "newer.sqlite"
    with sqlite3.connect(newer) as database:
        database.execute("CREATE TABLE session (other TEXT)")
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    other = tmp_path / "other.sqlite"
    with sqlite3.connect(other) as database:
        database.execute("CREATE TABLE accounts (name TEXT)")
    before = [path.read_bytes() for path in (newer, other)]
    with pytest.raises(
        InputError, match=rf"newer version \(schema {SCHEMA_VERSION + 1}, .* update echospline"
    ):
        Sessions(newer)
    with pytest.raises(InputError, match="database of something else"):
        Sessions(other)
    assert [path.read_bytes() for path in (newer, other)] == before


def test_a_file_whose_first_process_was_killed_before_it_was_ready_is_made_anew(tmp_path):
    path = tmp_path / "begun.sqlite"
    with sqlite3.connect(path) as database:
        database.execute(OLD.format(""))
    assert Sessions(path).every() == []


def test_a_migration_that_fails_leaves_the_file_as_it_was(tmp_path, rows):
    path = tmp_path / "old.sqlite"
    old_file(path, 3, rows)
    with sqlite3.connect(path) as database:
        database.execute("UPDATE session SET made = 'no JSON' WHERE id = 3")
    with pytest.raises(InputError, match=r"session 3 in .* is damaged"):
        Sessions(path)
    with sqlite3.connect(path) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (3,)
        assert database.execute("SELECT made FROM session ORDER BY id").fetchall() == [
            (json.dumps(MADE),),
            ("",),
            ("no JSON",),
        ]


ADDING = """
import sys, numpy as np
from pathlib import Path
sys.path.insert(0, "tests")
import page_scene
from test_sessions import trace_of, EXERCISE
from echospline.page import score
from echospline.viewer import Sessions
trace = trace_of(page_scene.poses()[:24])
result = score(trace, EXERCISE)
print("ready", flush=True); sys.stdin.readline()
for path in sys.argv[1:]:
    for _ in range(3):
        Sessions(Path(path)).add(EXERCISE, trace, result, trainee="Ann", scene="Speckle", model="tps")
"""


@pytest.mark.parametrize("version", [None, 1])
def test_several_processes_open_and_write_one_file_at_once(tmp_path, rows, version):
    paths = [tmp_path / f"shared-{k}.sqlite" for k in range(20)]
    for path in paths if version else ():
        old_file(path, version, rows)
    people = [
        subprocess.Popen(
            [sys.executable, "-c", ADDING, *map(str, paths)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=page_scene.ROOT,
        )
        for _ in range(5)
    ]
    for person in people:
        assert person.stdout.readline() == "ready\n"
    for person in people:
        person.stdin.write("go\n")
        person.stdin.flush()
    assert [person.communicate(timeout=120)[1] for person in people] == [""] * 5
    for path in paths:
        attempts = [s.attempt for s in Sessions(path).every() if s.trainee == "Ann"]
        assert sorted(attempts) == list(range(1, 16 + (2 if version else 0)))


# --- attempts and origin


def kept(sessions, pack, rows, model="tps", **more):
    session = parsed_sessions(json.dumps(honest(pack, rows, model, **more)).encode(), "test")[0]
    return sessions.keep(verify(pack, session))


def test_a_session_says_what_made_it_and_is_stored_once(tmp_path, pack, rows):
    sessions = Sessions(tmp_path / "kept.sqlite")
    first = kept(sessions, pack, rows)
    assert (first.number, first.attempt, first.new, first.verified) == (1, 1, True, True)
    again = kept(sessions, pack, rows)
    assert (again.number, again.attempt, again.new) == (1, 1, False)
    session = sessions.find(1)
    assert (session.version, session.core, session.pack) == ("0.1.0", "0" * 64, pack.digest)
    assert (session.verified, session.difference, session.examination, session.told) == (True, "", True, 2)
    assert session.started == "2026-03-01T10:20:30+00:00"
    assert session.scene == pack.manifest.title


def test_a_changed_session_is_stored_with_its_difference_and_does_not_count(tmp_path, pack, rows):
    sessions = Sessions(tmp_path / "kept.sqlite")
    told = honest(pack, rows)
    told["score"]["time"] = 1.0
    found = sessions.keep(verify(pack, parsed_sessions(json.dumps(told).encode(), "test")[0]))
    session = sessions.find(found.number)
    assert not found.verified
    assert session.verified is False
    assert not session.counts
    assert session.difference == found.difference == "time is 3, the page said 1"
    assert session.score["time"] == pytest.approx(3.0)  # ours is stored, not the page's


def test_attempts_are_counted_per_trainee_and_exercise_whatever_the_page_says(tmp_path, pack, rows):
    sessions = Sessions(tmp_path / "kept.sqlite")
    for k, name in enumerate(["Ann", "Ann", "Ben", "Ann"]):
        kept(sessions, pack, rows, trainee=name, attempt=1, started=f"2026-03-01T10:2{k}:00Z")
    assert [(s.trainee, s.attempt) for s in sessions.every()] == [
        ("Ann", 1),
        ("Ann", 2),
        ("Ben", 1),
        ("Ann", 3),
    ]


def test_an_attempt_beyond_those_that_an_exercise_has_is_kept_and_does_not_count(tmp_path, rows):
    limited = {**EXERCISE.model_dump(), "attempts": 2}
    pack = page_scene.small(exercise=[limited])
    sessions = Sessions(tmp_path / "kept.sqlite")
    for k, attempt in enumerate([1, 2, 1, 4]):  # the third says that it is the first again
        kept(sessions, pack, rows, attempt=attempt, started=f"2026-03-01T10:2{k}:00Z")
    found = sessions.every()
    assert [s.counts for s in found] == [True, True, False, False]
    assert found[2].difference == "it is attempt 3; the exercise has 2"
    assert found[3].difference == "it is attempt 4; the exercise has 2"


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        ({"entry": (8.0, 0.0)}, "the entry moved"),
        ({"entry_between": (4.0, 9.0)}, "the entry moved"),
        ({"time_limit": 2.0}, "it lasts 3.0 s; the exercise ends after 2 s"),
        ({"help": False, "attempts": 2}, ""),
        ({"attempts": 1}, "it is attempt 2; the exercise has 1"),
    ],
)
def test_rules_of_an_exercise_are_checked_on_the_recorded_motion(rows, rules, said):
    pack = page_scene.small(exercise=[{**EXERCISE.model_dump(), **rules}])
    session = parsed_sessions(json.dumps(honest(pack, rows)).encode(), "test")[0]
    found = "; ".join(verify(pack, session).differences)
    assert said in found
    assert bool(said) == bool(found)


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        ({"entry": (8.0, 0.0)}, ""),
        ({"entry": (9.0, 0.0)}, "entered at 8.00, 0.00 mm; the exercise says 9.00, 0.00"),
        ({"entry_between": (4.0, 9.0)}, ""),
        ({"entry_between": (10.0, 12.0)}, "entered at x = 8.00 mm; the exercise draws it from 10 to 12 mm"),
    ],
)
def test_an_entry_that_is_given_is_that_of_the_motion(rows, rules, said):
    pack = page_scene.small(exercise=[{**EXERCISE.model_dump(), **rules}])
    still = rows[:150]  # before the hand moves the entry
    session = parsed_sessions(json.dumps(honest(pack, still)).encode(), "test")[0]
    found = "; ".join(verify(pack, session).differences)
    assert said in found
    assert bool(said) == bool(found)


@pytest.mark.parametrize(
    ("rules", "said"),
    [
        ({"entry": (5.0, 0.0), "entry_between": (4.0, 9.0)}, "not both"),
        ({"entry_between": (9.0, 4.0)}, "the smaller one first"),
        ({"attempts": 0}, "greater than or equal to 1"),
        ({"entry": (99.0, 0.0)}, "the entry must lie in the image"),
        ({"entry_between": (4.0, 99.0)}, "the entry must lie in the image"),
    ],
)
def test_rules_that_cannot_be_kept_are_refused(rules, said):
    with pytest.raises(InputError, match=said):
        page_scene.small(exercise=[{**EXERCISE.model_dump(), **rules}])


READING = """
import { readExercise } from "./src/echospline/page/static/scene.js";
let text = "";
for await (const part of process.stdin) text += part;
process.stdout.write(JSON.stringify(JSON.parse(text).map((exercise) => readExercise(exercise, "exercise", 2))));
"""


@pytest.mark.skipif(NODE is None, reason="Node is not installed: the page's reader is not compared")
def test_the_page_hands_every_key_of_an_exercise_on_as_it_was():
    """Or a session's exercise would not be that of its scene."""
    exercises = [
        Exercise.model_validate({**EXERCISE.model_dump(), **more}).model_dump(mode="json")
        for more in (
            {},
            {
                "help": False,
                "entry": (8.0, 0.0),
                "attempts": 3,
                "time_limit": 12.5,
                "most_redirections": None,
            },
            {"entry_between": (4.0, 9.0)},
            {
                "target": {"centre": (5.0, 6.0), "radius": 1.0, "imaged": True, "young": 40.0},
                "vessels": [{"centre": (9.0, 6.0), "radius": 1.5, "echo": "hyperechoic"}],
            },
        )
    ]
    done = subprocess.run(
        [NODE, STEADY, "--input-type=module", "-e", READING],
        input=json.dumps(exercises), cwd=page_scene.ROOT, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == exercises


# --- export, benchmarks, deletion


def test_what_is_exported_for_a_page_is_imported_as_the_same_session(tmp_path, pack, rows):
    sessions = Sessions(tmp_path / "kept.sqlite")
    kept(sessions, pack, rows)
    text = sessions_file([session_file(*sessions.load(1))])
    (again,) = parsed_sessions(text.encode(), "export")
    np.testing.assert_array_equal(again.rows(2), rows)
    found = verify(pack, again)
    assert found.differences == ()
    assert sessions.keep(found).new is False
    other = Sessions(tmp_path / "other.sqlite")
    assert other.keep(found).new is True
    anonymous = session_file(*sessions.load(1), named=False)
    assert (anonymous["trainee"], again.trainee) == ("", "Ann")


def test_sessions_of_no_page_are_not_exported_for_one(tmp_path, rows):
    sessions = Sessions(tmp_path / "kept.sqlite")
    trace = trace_of(rows)
    sessions.add(EXERCISE, trace, score(trace, EXERCISE), trainee="Ann", scene="Speckle", model="tps")
    with pytest.raises(InputError, match="can be written as CSV"):
        session_file(*sessions.load(1))


def test_benchmarks_and_deletions_change_all_named_sessions_or_none(tmp_path, rows):
    sessions = Sessions(tmp_path / "kept.sqlite")
    trace = trace_of(rows)
    for _ in range(3):
        sessions.add(
            EXERCISE, trace, score(trace, EXERCISE), trainee="Ann", scene="Speckle", model="tps",
            record=Record(ended="reset"),
        )  # fmt: skip
    sessions.mark_expert([1, 3], True)
    with pytest.raises(InputError, match=r"no session 9.*nothing was changed"):
        sessions.mark_expert([2, 9], True)
    assert [s.expert for s in sessions.every()] == [True, False, True]
    with pytest.raises(InputError, match="no session 9"):
        sessions.delete([1, 9])
    assert len(sessions.every()) == 3
    sessions.delete([3])
    again = sessions.add(EXERCISE, trace, score(trace, EXERCISE), trainee="Ben", scene="Speckle", model="tps")
    assert [s.id for s in sessions.every()] == [1, 2, again]
    assert again == 4  # a number is not given twice
    assert isinstance(Exercise.model_validate(EXERCISE.model_dump()), Exercise)


def test_a_deleted_trainee_is_not_left_in_the_file(tmp_path, rows):
    sessions = Sessions(tmp_path / "kept.sqlite")
    trace = trace_of(rows)
    for name in ("Rumpelstiltskin", "Ann"):
        sessions.add(EXERCISE, trace, score(trace, EXERCISE), trainee=name, scene="Speckle", model="tps")
    sessions.delete([1])
    with sqlite3.connect(sessions.path) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert b"Rumpelstiltskin" not in sessions.path.read_bytes()


def test_where_a_probe_was_comes_back_as_it_was(tmp_path, pack, rows):
    sessions = Sessions(tmp_path / "kept.sqlite")
    planes = base64.b64encode(np.array([[0.0, 1, 2, 3, 4, 5, 6], [9, 1, 2, 3, 4, 5, 7]]).tobytes()).decode()
    trace = trace_of(rows)
    for told in (planes, ""):
        sessions.add(
            EXERCISE, trace, score(trace, EXERCISE), trainee="Ann", scene="S", model="tps",
            record=Record(planes=told, version="0.1.0", core="c" * 64, pack=pack.digest),
        )  # fmt: skip
    found = parsed_sessions(
        sessions_file([session_file(*sessions.load(n)) for n in (1, 2)]).encode(), "export"
    )
    assert [session.planes for session in found] == [planes, None]
    assert found[0].plane_rows()[1].tolist() == [9, 1, 2, 3, 4, 5, 7]
    assert "planes" not in sessions.find(1).to_dict()
