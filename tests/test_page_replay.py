"""Sessions of a page: run again by the native core, compared with WebAssembly and with what the page said, imported and refused."""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
from pathlib import Path

import numpy as np
import pytest

import page_scene
from echospline.cli.app import loaded
from echospline.errors import InputError
from echospline.page import packed, read_sessions, replay, score, verify
from echospline.page.bundle import assembled
from echospline.page.scoring import printed, prints_alike
from echospline.page.sessions_file import parsed_sessions
from echospline.picture import Drawing, NeedleEcho
from echospline.scenario import Scenario, build_model
from echospline.scene import NeedlePose
from echospline.viewer import Sessions
from node_here import NODE, STEADY
from test_page_pack import stub

WASM = page_scene.ROOT / "src" / "echospline" / "_native" / "echospline.wasm"
MODELS = ["tps", "elastic", "green"]


@pytest.fixture(scope="module")
def small():
    return page_scene.small()


@pytest.fixture(scope="module")
def rows():
    return page_scene.poses()


def read(tree):
    return parsed_sessions(json.dumps(tree).encode(), "sessions.json")[0]


def honest(pack, rows, model="tps", **more):
    """Session with the score that its motion has."""
    given = page_scene.session(pack, rows, model)
    session = read(given)
    found = score(replay(pack, session), session.exercise).to_dict()
    return {**given, "score": found, **more}


# --- the native core and the page's


@pytest.mark.parametrize("kind", MODELS)
def test_target_and_vessels_move_as_in_pythons_own_model(small, rows, kind):
    session = read(page_scene.session(small, rows, kind))
    trace = replay(small, session)
    np.testing.assert_array_equal(trace.poses, rows)
    own = build_model(page_scene.scenario(), small.mesh, kind=kind)
    state, places = own.rest(), np.array(session.exercise.landmarks)
    for k, (x, y, tx, ty, speed) in enumerate(rows):
        state = own.advance(state, NeedlePose((x, y), (tx, ty), speed), 1 / 120)
        if k % 60 == 59:
            np.testing.assert_allclose(
                trace.watched[k], places + own.displacement_at(state, places), atol=1e-9
            )
    assert np.abs(trace.watched[-1] - places).max() > 0.05


@pytest.mark.skipif(
    NODE is None, reason="Node is not installed: the page's core is not compared with the native one"
)
@pytest.mark.parametrize("kind", MODELS)
def test_webassembly_gives_pythons_field_and_picture_over_a_session(small, rows, kind, tmp_path):
    if not WASM.exists():
        pytest.skip("echospline.wasm is not built; run make wasm")
    session = read(page_scene.session(small, rows, kind))
    places = np.array(session.exercise.landmarks)
    (tmp_path / "scene.pack").write_bytes(small.to_bytes())
    (tmp_path / "poses.f64").write_bytes(rows.astype("<f8").tobytes())
    done = subprocess.run(
        [NODE, STEADY, "tests/node/replay_pack.mjs", *(str(tmp_path / name) for name in ("scene.pack", "poses.f64")), kind, str(tmp_path / "out")],
        cwd=page_scene.ROOT, env={**os.environ, "WATCHED": json.dumps(places.ravel().tolist())},
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    numbers = np.fromfile(tmp_path / "out.f64")
    count = len(rows) // 10
    fields = numbers[: count * small.mesh.size * 2].reshape(count, -1, 2)
    watched = numbers[fields.size :].reshape(len(rows), -1, 2)

    own = build_model(page_scene.scenario(), small.mesh, kind=kind)
    state, native = own.rest(), []
    for k, (x, y, tx, ty, speed) in enumerate(rows):
        pose = NeedlePose((x, y), (tx, ty), speed)
        state = own.advance(state, pose, 1 / 120)
        if k % 10 == 9:
            native.append(own.displacement(state))
    assert np.abs(native).max() > 0.3
    assert np.abs(fields - native).max() <= 1e-4
    assert np.abs(places + watched - replay(small, session).watched).max() <= 1e-4
    picture = np.fromfile(tmp_path / "out.u8", np.uint8).reshape(80, 128)
    expected = (
        Drawing(page_scene.image(), small.mesh).draw(own.displacement(state), pose, NeedleEcho()).image.pixels
    )
    assert np.abs(picture.astype(int) - expected.astype(int)).max() <= 1
    assert np.abs(expected.astype(int) - page_scene.image().pixels).max() > 20


def hands(count: int) -> list[list[tuple[list[float], list[float], int]]]:
    """Ways of a hand that jumps, trembles, turns, rests and leaves, some of them ending on target or vessel."""
    rng = np.random.default_rng(7)
    ways = [[([14.5, 0.0], [14.5, 0.0], 20), ([14.5, 0.0], [15.0, 11.0], 200)]]  # straight onto the target
    for _ in range(count - 1):
        x = float(rng.uniform(4.0, 12.0))
        way = [([x, 0.0], [x, 0.0], 20)]
        for _ in range(rng.integers(2, 6)):
            tip = [float(rng.uniform(9.0, 26.0)), float(rng.uniform(2.0, 17.0))]
            way += [([x, 0.0], tip, int(rng.integers(5, 120)))]
            way += [([x, 0.0], [tip[0] + float(rng.normal(0, 0.2)), tip[1]], 3)] * int(rng.integers(0, 4))
        if rng.random() < 0.4:
            way += [([x, 0.0], [x, 0.0], 60)]
        if rng.random() < 0.6:
            way += [([x, 0.0], [15.2, 11.2], 90)]
        ways.append(way)
    return ways


@pytest.mark.skipif(
    NODE is None, reason="Node is not installed: no session is recorded by the page's own code"
)
@pytest.mark.parametrize("kind", MODELS)
def test_every_metric_of_the_page_is_that_of_the_replay_to_the_printed_digits(small, kind, tmp_path):
    if not WASM.exists():
        pytest.skip("echospline.wasm is not built; run make wasm")
    (tmp_path / "scene.pack").write_bytes(small.to_bytes())
    done = subprocess.run(
        [NODE, STEADY, "tests/node/record_session.mjs", str(tmp_path / "scene.pack"), kind, json.dumps(hands(12))],
        cwd=page_scene.ROOT, capture_output=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()
    found = [verify(small, session) for session in parsed_sessions(done.stdout, "page")]
    assert [one.differences for one in found] == [()] * 12
    assert len({one.score.redirections for one in found}) > 2
    assert {one.score.passed for one in found} == {True, False}
    assert max(one.score.vessel_contacts for one in found) > 1
    assert max(one.score.target_shift for one in found) > 0.1


# --- verification


def test_a_session_with_the_numbers_of_its_motion_is_verified(small, rows):
    found = verify(small, read(honest(small, rows)))
    assert found.differences == ()
    assert found.score.redirections == 1
    assert found.score.punctures == 1
    assert found.score.tissue_damage > 0


@pytest.mark.parametrize(
    "name", ["final_error", "path_length", "tissue_damage", "smoothness", "vessel_contacts", "passed", "time"]
)
def test_a_metric_that_was_changed_is_named(small, rows, name):
    given = honest(small, rows)
    value = given["score"][name]
    given["score"][name] = (not value) if isinstance(value, bool) else value * 1.1 + 1
    (difference,) = verify(small, read(given)).differences
    assert difference.startswith(f"{name} is ")


def test_an_open_metric_is_not_a_number(small, rows):
    given = honest(small, rows[:20])  # not yet in the tissue
    assert given["score"]["final_error"] is None
    assert verify(small, read(given)).differences == ()
    given["score"]["final_error"] = 0.2
    assert verify(small, read(given)).differences == ("final_error is –, the page said 0.20",)


def test_a_motion_that_no_hand_makes_is_said(small, rows):
    jump = rows.copy()
    jump[200:, 2] += 5.0
    said = " ".join(verify(small, read(honest(small, jump))).differences)
    assert "the tip jumps" in said
    assert "step 200" in said
    slow = rows.copy()
    slow[50, 4] = 0.0
    (said,) = verify(small, read(honest(small, slow))).differences
    assert said.startswith("the speed in step 50 is said to be 0.00 mm/s")
    deep = verify(small, read(honest(small, rows[170:]))).differences
    assert any(text.startswith("the needle begins ") for text in deep)


def test_an_easier_exercise_and_another_rate_are_said(small, rows):
    given = page_scene.session(small, rows)
    given["exercise"]["target"]["radius"] = 9.0
    trace = replay(small, read(given))
    given["score"] = score(trace, read(given).exercise).to_dict()
    assert verify(small, read(given)).differences == ("its exercise 'between' is not that of the scene",)
    given = page_scene.session(small, rows)
    given["exercise"]["name"] = "another"
    assert "no exercise 'another'" in verify(small, read(given)).differences[0]
    said = " ".join(verify(small, read(honest(small, rows, rate=60.0))).differences)
    assert "60 steps a second, the scene 120" in said


def test_a_session_of_another_scene_or_of_no_model_is_refused(small, rows):
    with pytest.raises(InputError, match="recorded in another scene"):
        verify(
            page_scene.small(**{"tissue.young": 21.0, "needle.entry": (9.0, 0.0)}),
            read(page_scene.session(small, rows)),
        )
    with pytest.raises(InputError, match="no model 'fem'"):
        verify(small, read(page_scene.session(small, rows, "fem")))


def test_values_are_printed_as_the_page_prints_them():
    assert [printed(v) for v in (None, 0.0049, -0.0049, 2.0, 9.999, 12.25, 12.35, 999.96, 1234.5, -3.456, 0.125)] == [
        "–", "0", "0", "2", "10.00", "12.3", "12.3", "1000.0", "1235", "-3.46", "0.13",
    ]  # fmt: skip


def test_values_are_alike_when_printed_alike_or_closer_than_the_core_is_sure():
    assert prints_alike(1.2341, 1.2349)
    assert prints_alike(1.23499, 1.23501)
    assert not prints_alike(1.2349, 1.2353)
    assert prints_alike(None, None)
    assert not prints_alike(None, 0.0)
    assert not prints_alike(True, False)
    assert not prints_alike(3, 4)


# --- files


def test_one_session_and_several_are_read(small, rows, tmp_path):
    one = page_scene.session(small, rows)
    several = {"format": 1, "kind": "echospline sessions", "sessions": [one, {**one, "attempt": 3}]}
    path = tmp_path / "sessions.json"
    for tree, count in ((one, 1), (several, 2)):
        path.write_text(json.dumps(tree), encoding="utf-8-sig")
        found = read_sessions(path)
        assert len(found) == count
        np.testing.assert_array_equal(found[0].rows(2), rows)
        assert found[0].when == "2026-03-01T10:20:30+00:00"
    assert len({session.digest for session in found}) == 2


HOSTILE = {
    "another kind": {"kind": "<script>"},
    "another format": {"format": 2},
    "an unknown key": {"html": "<b>"},
    "steps of text": {"steps": "360"},
    "more steps than rows": {"steps": 361},
    "steps without end": {"steps": 10**12},
    "poses that are no base64": {"poses": "<>"},
    "poses cut in a number": {"poses": "AAAA"},
    "poses of another alphabet": {"poses": 7},
    "no time": {"started": "yesterday"},
    "a digest of another length": {"core": "abc"},
    "an ending of its own": {"ended": "won"},
    "a rate of zero": {"rate": 0},
    "a trainee without end": {"trainee": "A" * 1000},
    "an event of the future": {"events": [[10**9, "entered"]]},
    "a score of tables": {"score": {"passed": {"a": 1}}},
    "an exercise without target": {"exercise": {"name": "a", "title": "A"}},
    "planes that are no rows": {"planes": "AAAA"},
}


def whole(small, data: bytes) -> None:
    """Read a session with all that it holds, and run it again."""
    session = parsed_sessions(data, "sessions.json")[0]
    session.plane_rows()
    verify(small, session)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_session_is_refused_in_one_sentence(small, rows, name):
    given = {**page_scene.session(small, rows), **HOSTILE[name]}
    with pytest.raises(InputError) as refused:
        whole(small, json.dumps(given).encode())
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize("number", [np.nan, np.inf, 1e300])
def test_poses_that_are_no_places_are_refused(small, rows, number):
    broken = rows.copy()
    broken[7, 2] = number
    with pytest.raises(InputError, match="not finite or beyond"):
        verify(small, read(page_scene.session(small, broken)))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xfe",
        b"[1]",
        b"null",
        b'{"kind": "echospline sessions", "format": 1}',
        b"[" * 100_000,
        b'{"a": NaN}',
    ],
)
def test_a_file_of_something_else_is_refused(data):
    with pytest.raises(InputError, match=r"sessions\.json"):
        parsed_sessions(data, "sessions.json")


def ending(small, data: bytes) -> str:
    """Sentence with which import ends; empty where a session is read."""
    try:
        whole(small, data)
    except InputError as error:
        return str(error)
    return ""


def test_whatever_bytes_are_changed_the_reader_ends_in_a_session_or_a_sentence(small, rows):
    data = json.dumps(page_scene.session(small, rows[:4])).encode()
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(400):
        broken = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            broken[rng.integers(0, len(data))] = rng.integers(0, 256)
        said = ending(small, bytes(broken))
        assert len(said.splitlines()) <= 1
        refused += bool(said)
    assert refused > 100


# --- the command


def run(*words):
    """Run echospline sessions; returns its exit code."""
    return loaded("sessions").main(list(map(str, words)), standalone_mode=False) or 0


@pytest.fixture
def trainer(small, tmp_path):
    path = tmp_path / "trainer.html"
    path.write_text(assembled(stub, {"core": b"core", "scene": small.to_bytes()})[0], encoding="utf-8")
    return path


def test_imported_sessions_are_verified_stored_once_listed_and_exported(
    small, rows, trainer, tmp_path, capsys
):
    good = honest(small, rows)
    forged = {**honest(small, rows, "elastic"), "attempt": 3, "trainee": "=Bob\x1b[2J"}
    forged["score"] = {**forged["score"], "final_error": 0.1}
    path, kept = tmp_path / "class.json", tmp_path / "deep" / "sessions.sqlite"
    path.write_text(json.dumps({"format": 1, "kind": "echospline sessions", "sessions": [good, forged]}))
    assert run("import", path, "--pack", trainer, "--sessions", kept) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "1. Ann, between, tps, attempt 2: verified: stored as 1"
    assert "final_error is " in lines[1]
    assert "the page said 0.10: stored as 2" in lines[1]
    assert "\x1b" not in lines[1]
    assert lines[2] == "1 of 2 sessions verified"
    path.write_text(json.dumps(good))
    assert run("import", path, "--pack", trainer, "--sessions", kept) == 0
    assert "stored before as 1" in capsys.readouterr().out
    stored = Sessions(kept)
    newest = stored.newest()
    assert [(session.verified, session.difference[:14]) for session in newest] == [
        (False, "final_error is"),
        (True, ""),
    ]
    assert (newest[1].attempt, newest[1].told) == (1, 2)
    assert newest[1].pack == small.digest
    assert newest[1].started == "2026-03-01T10:20:30+00:00"
    session, exercise, trace = stored.load(1)
    assert score(trace, exercise).to_dict() == session.score
    assert run("export", tmp_path / "all.csv", "--sessions", kept) == 0
    table = (tmp_path / "all.csv").read_text(encoding="utf-8").splitlines()
    assert "attempt,ended,examination,verified" in table[0]
    assert "1,finished,True,yes" in table[1]
    assert "'=Bob" in table[2]


def test_a_session_of_the_shipped_scene_needs_no_page(tmp_path, capsys):
    scenario, image = Scenario().opened(Path(), eight_bit=True)
    pack = packed(scenario, image, Path(), language="de")
    given = page_scene.session(pack, page_scene.poses()[:60])
    path = tmp_path / "one.json"
    path.write_text(json.dumps({**given, "score": None, "ended": "reset"}))
    assert run("import", path, "--sessions", tmp_path / "s.sqlite") == 0
    assert "verified" in capsys.readouterr().out


def test_a_session_without_its_page_and_a_page_without_a_scene_end_in_a_sentence(
    small, rows, tmp_path, capsys
):
    path = tmp_path / "one.json"
    path.write_text(json.dumps(page_scene.session(small, rows)))
    assert run("import", path, "--sessions", tmp_path / "s.sqlite") == 1
    assert "give the page that it came from with --pack" in capsys.readouterr().out
    (tmp_path / "other.html").write_text("<html></html>")
    with pytest.raises(InputError, match="no page of echospline"):
        run("import", path, "--pack", tmp_path / "other.html", "--sessions", tmp_path / "s.sqlite")
    (tmp_path / "other.html").write_text('<script type="text/plain" id="scene">AAA</script>')
    with pytest.raises(InputError, match="damaged"):
        run("import", path, "--pack", tmp_path / "other.html", "--sessions", tmp_path / "s.sqlite")


@pytest.mark.parametrize("schema", [1, 2])
def test_sessions_of_older_schemas_stay_readable_and_take_imports(small, rows, trainer, tmp_path, schema):
    kept = tmp_path / "sessions.sqlite"
    session = read(honest(small, rows))
    trace = replay(small, session)
    number = Sessions(kept).add(
        session.exercise, trace, score(trace, session.exercise), trainee="Old", scene="S", model="tps"
    )
    columns = "id, started, trainee, exercise, definition, scene, source, model, score, trace"
    columns += ", picture, upload" if schema == 2 else ""
    with sqlite3.connect(kept) as database:  # as an older version had it
        given = database.execute(f"SELECT {columns} FROM session").fetchall()
        database.execute("DROP TABLE session")
        types = columns.replace("id,", "id INTEGER PRIMARY KEY,", 1)
        database.execute(f"CREATE TABLE session ({types})")
        database.executemany(f"INSERT INTO session VALUES ({','.join('?' * len(given[0]))})", given)
        database.execute(f"PRAGMA user_version = {schema}")
    path = tmp_path / "one.json"
    path.write_text(json.dumps(honest(small, rows)))
    assert run("import", path, "--pack", trainer, "--sessions", kept) == 0
    found = Sessions(kept).newest()
    assert [(one.id, one.trainee, one.verified) for one in found] == [
        (number + 1, "Ann", True),
        (number, "Old", None),
    ]
