"""A class: what a trainee and an instructor get to see, as pure functions and over HTTP behind the guard."""

from __future__ import annotations

import csv
import http.client
import io
import json
import os
import subprocess
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from statistics import median

import numpy as np
import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware

import page_scene
from echospline.cli.app import loaded
from echospline.errors import InputError
from echospline.page import parsed_sessions, score, verify
from echospline.viewer import Criterion, Record, Sessions
from echospline.viewer.class_answers import (
    METRICS,
    class_answer,
    curves_csv,
    may_see,
    own_answer,
    sessions_csv,
    trainee_curve,
)
from echospline.viewer.class_routes import COOKIE, Classroom, Instructor, class_routes
from echospline.viewer.guard import Guard
from echospline.viewer.learning_curve import learning_curve
from echospline.viewer.served_scene import Scene
from node_here import NODE, STEADY
from test_page_replay import honest
from test_sessions import trace_of

EXERCISE = page_scene.EXERCISE
CLASS = Criterion()
ANN, BEN = "a" * 64, "b" * 64


@pytest.fixture(scope="module")
def pack():
    return page_scene.small()


@pytest.fixture(scope="module")
def rows():
    return page_scene.poses()


@pytest.fixture(scope="module")
def sessions(tmp_path_factory, rows):
    """Ann, Ben and an expert; Ann's third is not verified, Ben's second was reset."""
    stored = Sessions(tmp_path_factory.mktemp("class") / "class.sqlite")
    trace = trace_of(rows)
    base = score(trace, EXERCISE)
    told = [
        ("Ann", ANN, 5.0, False, {}),
        ("Ben", BEN, 1.0, True, {}),
        ("Ann", ANN, 1.2, True, {}),
        ("Ben", BEN, 0.5, True, {"ended": "reset"}),
        ("Ann", ANN, 0.1, True, {"verified": False, "difference": "time is 4, the page said 3"}),
        ("Eve", BEN, float("inf"), False, {}),
        ("Dr. X", "", 0.4, True, {}),
        ("Dr. X", "", 0.6, True, {}),
        ("=cmd", "", 0.7, True, {}),
    ]
    for k, (name, owner, error, passed, more) in enumerate(told):
        record = Record(
            started=f"2026-03-01T10:{k:02}:00+00:00", owner=owner, pack="d" * 64, version="0.1.0", **more
        )
        stored.add(
            EXERCISE, trace, replace(base, final_error=error, passed=passed, time=float(k)), trainee=name, scene="S",
            model="tps", record=record,
        )  # fmt: skip
    stored.mark_expert([7, 8], True)
    return stored.every()


def test_a_trainee_sees_the_own_sessions_of_the_own_browser_and_experts_without_a_name(sessions):
    answer = own_answer(sessions, ANN, "Ann", CLASS)
    assert [s["id"] for s in answer["sessions"]] == [1, 3, 5]
    assert [(s["id"], s["trainee"]) for s in answer["experts"]] == [(7, ""), (8, "")]
    (group,) = answer["curves"]
    assert [one["trainee"] for one in group["trainees"]] == ["Ann"]
    assert set(group) == {"scene", "exercise", "trainees", "expert"}  # no median of others
    assert group["expert"]["sessions"] == [7, 8]
    said = json.dumps(answer)
    for other in ("Ben", "Eve", "Dr. X", "=cmd", ANN, BEN):
        assert other not in said
    assert own_answer(sessions, BEN, "Ann", CLASS)["sessions"] == []  # another's name in another browser
    assert own_answer(sessions, "", "Ann", CLASS)["sessions"] == []
    assert own_answer(sessions, "", "=cmd", CLASS)["sessions"] == []  # sent by nobody


def test_whole_sessions_are_for_their_browser_and_experts_are_for_all(sessions):
    assert [may_see(s, ANN) for s in sessions] == [True, False, True, False, True, False, True, True, False]
    assert [s.id for s in sessions if may_see(s, "")] == [7, 8]


def test_an_instructor_sees_curves_of_all_trainees_their_median_and_the_experts_level(sessions):
    answer = class_answer(sessions, CLASS)
    assert [s["id"] for s in answer["sessions"]] == list(range(1, 10))
    (group,) = answer["curves"]
    by_name = {one["trainee"]: one for one in group["trainees"]}
    assert list(by_name) == ["=cmd", "Ann", "Ben", "Eve"]  # an expert is no trainee
    assert by_name["Ann"]["sessions"] == [1, 3]  # what is not verified does not count
    assert by_name["Ann"]["not_counted"] == 1
    assert by_name["Ben"]["successes"] == [True, False]  # who resets gives up
    up = CLASS.gain
    assert by_name["Ann"]["values"] == pytest.approx([0.0, up])
    assert by_name["Ben"]["values"] == pytest.approx([up, 0.0])
    assert by_name["Eve"]["metrics"]["final_error"] == [None]
    assert group["median"]["trainees"] == [4, 2]
    assert group["median"]["values"] == pytest.approx([median([up, 0.0, up, 0.0]), median([up, 0.0])])
    assert group["median"]["metrics"]["final_error"] == [median([0.7, 5.0, 1.0, 1e9]), median([1.2, 0.5])]
    assert group["expert"]["sessions"] == [7, 8]
    assert group["expert"]["metrics"]["final_error"] == pytest.approx(0.5)
    assert set(group["expert"]["metrics"]) == set(METRICS)
    json.dumps(answer, allow_nan=False)
    assert class_answer([], CLASS)["curves"] == []


def test_a_trainees_curve_is_lc_cusum_of_the_attempts_that_count(sessions):
    counted, curve = trainee_curve([s for s in sessions if s.trainee == "Ann"], CLASS)
    assert [s.id for s in counted] == [1, 3]
    assert curve == learning_curve([False, True], CLASS)


def test_tables_for_a_spreadsheet_hold_every_attempt_and_no_formula(sessions):
    table = list(csv.DictReader(io.StringIO(sessions_csv(sessions))))
    assert [row["verified"] for row in table] == ["", "", "", "", "no", "", "", "", ""]
    assert [row["difference"] for row in table if row["difference"]] == ["time is 4, the page said 3"]
    assert table[8]["trainee"] == "'=cmd"
    assert [row["attempt"] for row in table[:5]] == ["1", "1", "2", "2", "3"]
    curves = list(csv.DictReader(io.StringIO(curves_csv(class_answer(sessions, CLASS)))))
    assert [(row["trainee"], row["count"], row["session"]) for row in curves] == [
        ("'=cmd", "1", "9"),
        ("Ann", "1", "1"),
        ("Ann", "2", "3"),
        ("Ben", "1", "2"),
        ("Ben", "2", "4"),
        ("Eve", "1", "6"),
    ]
    assert float(curves[2]["lc_cusum"]) == pytest.approx(CLASS.gain, abs=1e-6)
    assert curves[2]["final_error (mm)"] == "1.2"


@pytest.mark.skipif(
    NODE is None, reason="Node is not installed: the page's reader is not tried on Python's answer"
)
def test_the_pages_reader_takes_this_answer(sessions):
    answer = json.dumps(class_answer(sessions, CLASS))
    done = subprocess.run(
        [NODE, STEADY, "--test", "--test-reporter=tap", "tests/js/page_class.test.js"],
        cwd=page_scene.ROOT, env={**os.environ, "ECHOSPLINE_CLASS": answer}, capture_output=True, text=True, timeout=60,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    assert "# skipped 0" in done.stdout


# --- over HTTP


@contextmanager
def served(path, pack, *, token=None, instructor=None, alone=False, more=()):
    """Serve the routes of a class, and others; yields a function that asks."""
    scene = Scene(pack, upload="upload")

    async def scene_of(digest):
        return scene if digest == pack.digest else None

    classroom = Classroom(Sessions(path), scene_of, Instructor(instructor, alone))
    app = Starlette(
        routes=[*class_routes(classroom), *more],
        middleware=[
            Middleware(
                Guard,
                hosts=frozenset({"127.0.0.1"}),
                tokens=tuple(t for t in (token, instructor) if t and token),
            ),
        ],
    )
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="error"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]

    def ask(method, path, body=None, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
        connection.request(method, path, body, headers)
        response = connection.getresponse()
        data = response.read()
        connection.close()
        return response.status, data, dict(response.getheaders())

    ask.address = f"http://127.0.0.1:{port}"
    try:
        yield ask
    finally:
        server.should_exit = True
        thread.join(20)


def bearer(token):
    return {"Authorization": f"Bearer {token}"}


def cookie_of(headers):
    said = headers["set-cookie"]
    assert "HttpOnly" in said
    assert "SameSite=strict" in said
    return {"Cookie": said.split(";")[0]}


def body_of(pack, rows, **more):
    return json.dumps(honest(pack, rows, **more)).encode()


def test_a_page_hands_in_sessions_and_gets_its_own_back_and_nobody_elses(tmp_path, pack, rows):
    with served(tmp_path / "s.sqlite", pack, token="t", instructor="i") as ask:
        status, data, headers = ask("POST", "/api/sessions", body_of(pack, rows), **bearer("t"))
        assert (status, json.loads(data)) == (
            200,
            {"number": 1, "attempt": 1, "verified": True, "difference": ""},
        )
        ann = {**cookie_of(headers), **bearer("t")}
        status, data, headers = ask(
            "POST", "/api/sessions", body_of(pack, rows, trainee="Ben"), **bearer("t")
        )
        ben = {**cookie_of(headers), **bearer("t")}
        assert json.loads(data)["number"] == 2
        assert ann["Cookie"] != ben["Cookie"]
        status, data, headers = ask(
            "POST", "/api/sessions", body_of(pack, rows, started="2026-03-02T10:00:00Z"), **ann
        )
        assert json.loads(data)["attempt"] == 2
        assert cookie_of(headers)["Cookie"] == ann["Cookie"]
        _, data, headers = ask("GET", "/api/sessions?trainee=Ann", **ann)
        assert [s["id"] for s in json.loads(data)["sessions"]] == [1, 3]
        assert headers["cache-control"] == "no-store"
        for who, where, seen in (
            (ben, "Ann", []),
            (ben, "Ben", [2]),
            (bearer("t"), "Ann", []),
            (ann, "Ben", []),
        ):
            _, data, _ = ask("GET", f"/api/sessions?trainee={where}", **who)
            assert [s["id"] for s in json.loads(data)["sessions"]] == seen
        status, data, _ = ask("GET", "/api/sessions/1", **ann)
        (again,) = parsed_sessions(data, "answer")
        np.testing.assert_array_equal(again.rows(2), rows)
        assert verify(pack, again).differences == ()
        other = ask("GET", "/api/sessions/1", **ben)[:2]
        none = ask("GET", "/api/sessions/999999999999999999999999", **ben)[:2]
        assert (other[0], none[0]) == (404, 404)
        assert other[1] == b"you have no session 1"
        for path in ("/api/class", "/api/class.csv", "/api/class/curves.csv", "/api/class/1.csv"):
            assert ask("GET", path, **ann)[0] == 403
        assert ask("POST", "/api/class/expert", b"{}", **ann)[0] == 403
        assert ask("GET", "/api/sessions?trainee=Ann", **{"Cookie": ann["Cookie"]})[0] == 401


def test_the_instructors_token_opens_the_class(tmp_path, pack, rows):
    with served(tmp_path / "s.sqlite", pack, token="t", instructor="i") as ask:
        for name in ("Ann", "Ben"):
            ask("POST", "/api/sessions", body_of(pack, rows, trainee=name), **bearer("t"))
        status, data, _ = ask("GET", "/api/class", **bearer("i"))
        assert status == 200
        assert [s["trainee"] for s in json.loads(data)["sessions"]] == ["Ann", "Ben"]
        status, data, headers = ask("GET", "/api/class.csv", **bearer("i"))
        assert len(data.decode().splitlines()) == 3
        assert "attachment" in headers["content-disposition"]
        assert len(ask("GET", "/api/class/curves.csv", **bearer("i"))[1].decode().splitlines()) == 3
        assert len(ask("GET", "/api/class/1.csv", **bearer("i"))[1].decode().splitlines()) == 1 + len(rows)
        assert json.loads(ask("GET", "/api/sessions/2", **bearer("i"))[1])["trainee"] == "Ben"
        mark = json.dumps({"number": 2, "expert": True})
        assert ask("POST", "/api/class/expert", mark, **bearer("i"))[0] == 200
        assert json.loads(ask("GET", "/api/class", **bearer("i"))[1])["curves"][0]["expert"]["sessions"] == [
            2
        ]
        status, data, _ = ask("GET", "/api/sessions/2", **bearer("t"))  # anybody may replay an expert
        assert (status, json.loads(data)["trainee"]) == (200, "")
        for wrong in (b"", b"[]", b'{"number": 1}', b'{"number": "1", "expert": true}', b'{"number": 77, "expert": true}'):  # fmt: skip
            status, data, _ = ask("POST", "/api/class/expert", wrong, **bearer("i"))
            assert status == 422
            assert b"Traceback" not in data
        assert ask("POST", "/api/class/expert", b" " * 2000, **bearer("i"))[0] == 413


def test_alone_on_this_machine_everybody_is_the_instructor_unless_a_token_says_otherwise(tmp_path, pack):
    with served(tmp_path / "s.sqlite", pack, alone=True) as ask:
        assert ask("GET", "/api/class")[0] == 200
    with served(tmp_path / "s.sqlite", pack, alone=True, instructor="i") as ask:
        assert ask("GET", "/api/class")[0] == 403
        assert ask("GET", "/api/class", **bearer("i"))[0] == 200
    with served(tmp_path / "s.sqlite", pack) as ask:  # behind a proxy, and nobody has a token
        assert ask("GET", "/api/class")[0] == 403


def test_what_is_handed_in_is_run_again_and_what_is_no_session_is_refused_in_a_sentence(tmp_path, pack, rows):
    forged = honest(pack, rows)
    forged["score"]["final_error"] = 0.1
    path = tmp_path / "s.sqlite"
    with served(path, pack) as ask:
        status, data, _ = ask("POST", "/api/sessions", json.dumps(forged).encode())
        answer = json.loads(data)
        assert (status, answer["verified"]) == (200, False)
        assert "the page said 0.1" in answer["difference"]
        wrong = [
            b"", b"\xff\xfe", b"{" * 100_000, b"{}", json.dumps([1]).encode(),
            json.dumps({**forged, "poses": forged["poses"][:-12]}).encode(),
            json.dumps({**forged, "scene": {"title": "S", "pack": "0" * 64}}).encode(),
            json.dumps({"format": 1, "kind": "echospline sessions", "sessions": [forged, forged]}).encode(),
        ]  # fmt: skip
        for body in wrong:
            status, data, _ = ask("POST", "/api/sessions", body)
            assert status == 422, body[:60]
            assert 10 < len(data) < 300
            assert str(tmp_path).encode() not in data
        status, data, _ = ask(
            "POST", "/api/sessions", b"x", **{"Content-Length": str(17 * 2**20)}
        )  # announced too large
        assert status == 413
        assert [s.verified for s in Sessions(path).every()] == [False]
        assert ask("GET", "/api/sessions", Cookie=f"{COOKIE}=zzz")[0] == 200  # no key, no sessions
        assert ask("GET", "/api/sessions", Origin="http://evil.example")[0] == 403


def test_pages_that_hand_in_at_once_are_all_served(tmp_path, pack, rows):
    with served(tmp_path / "s.sqlite", pack) as ask:
        bodies = [
            body_of(pack, rows[:120], trainee=f"T{k % 3}", started=f"2026-03-01T11:00:{k:02}Z")
            for k in range(12)
        ]
        answers = [None] * len(bodies)

        def send(k):
            answers[k] = json.loads(ask("POST", "/api/sessions", bodies[k])[1])

        threads = [threading.Thread(target=send, args=(k,)) for k in range(len(bodies))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        assert sorted(answer["number"] for answer in answers) == list(range(1, 13))
        assert all(answer["verified"] for answer in answers)
        for name in range(3):
            assert sorted(answers[k]["attempt"] for k in range(name, 12, 3)) == [1, 2, 3, 4]


# --- on the command line


def run(*words):
    """Run echospline sessions; returns its exit code."""
    return loaded("sessions").main(list(map(str, words)), standalone_mode=False) or 0


@pytest.fixture
def kept(tmp_path, pack, rows):
    path = tmp_path / "s.sqlite"
    stored = Sessions(path)
    for k, name in enumerate(["Ann", "Ben\x1b[2J", "Ann", "Dr. X"]):
        told = honest(pack, rows, trainee=name, started=f"2026-03-01T10:2{k}:00Z")
        stored.keep(verify(pack, parsed_sessions(json.dumps(told).encode(), "test")[0]))
    return path


def test_the_command_shows_curves_exports_and_deletes(kept, pack, tmp_path, capsys):
    assert run("expert", 4, "--sessions", kept) == 0
    assert run("curve", "--sessions", kept, "--json") == 0
    answer = json.loads(capsys.readouterr().out.partition("\n")[2])
    assert [one["trainee"] for one in answer["curves"][0]["trainees"]] == ["Ann", "Ben\x1b[2J"]
    assert answer["criterion"]["threshold"] == pytest.approx(CLASS.threshold)
    assert run("curve", "--sessions", kept, "--trainee", "Ann", "--attempts", 20, "--risk", 0.1) == 0
    said = capsys.readouterr()
    assert "not yet" in said.out
    assert "Ben" not in said.out
    assert "\x1b" not in said.out
    assert "within 20 with a probability of" in said.err
    assert run("list", "--sessions", kept, "--trainee", "Ann") == 0
    assert "2 sessions" in capsys.readouterr().out
    assert run("export", tmp_path / "all.json", "--sessions", kept, "--trainee", "Ann") == 0
    assert [
        s.trainee for s in parsed_sessions((tmp_path / "all.json").read_bytes(), "all.json")
    ] == ["Ann"] * 2  # fmt: skip
    assert run("export", tmp_path / "curves.csv", "--curves", "--sessions", kept) == 0
    assert len((tmp_path / "curves.csv").read_text().splitlines()) == 4
    with pytest.raises(InputError, match=r"FILE\.csv or FILE\.json"):
        run("export", tmp_path / "all.txt", "--sessions", kept)
    with pytest.raises(InputError, match="one of both"):
        run("delete", "--sessions", kept)
    with pytest.raises(InputError, match="'Zoe' has no sessions"):
        run("delete", "--trainee", "Zoe", "--yes", "--sessions", kept)
    assert run("delete", "--trainee", "Ann", "--yes", "--sessions", kept) == 0
    assert [s.id for s in Sessions(kept).every()] == [2, 4]
