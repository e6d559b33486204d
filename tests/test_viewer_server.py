"""The server as pages meet it: over real sockets, well-behaved and hostile."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
import threading
import time
from contextlib import contextmanager
from urllib.parse import urlsplit

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from echospline.errors import InputError, ProtocolError
from echospline.page import Pack, core_bytes
from echospline.scene import NeedlePose
from echospline.viewer import Sessions, Settings, UploadLimits, announce, build_app, serve, steer, turn
from echospline.viewer.guard import Allowance, Guard
from echospline.viewer.reference import MOST_ROWS
from echospline.viewer.served_files import takes_gzip
from echospline.viewer.sockets import turn_of
from live_scene import PAGE_KEY, fem, free_port, get, listening, pack, post, recorded, running, scene, waited
from page_scene import poses

OTHER_KEY = "cd" * 16


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with running(tmp_path_factory.mktemp("server")) as (address, sessions, app):
        yield address, sessions, app


@pytest.fixture
def address(server):
    return server[0]


# --- what a page fetches


def test_the_page_comes_with_the_policy_of_its_own_script_and_asks_its_own_server_alone(address):
    status, headers, body = get(address, "/")
    html = body.decode()
    assert status == 200
    assert '<meta name="echospline-server" content="1">' in html
    assert 'id="core"' not in html
    assert 'id="scene"' not in html
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "connect-src 'self'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe-inline" not in policy
    (script,) = re.findall(r'<script type="module">(.*?)</script>', html, re.DOTALL)
    assert f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}" in policy


@pytest.mark.parametrize("path", ["/core.wasm", "/pack"])
def test_core_and_pack_come_plain_compressed_or_not_at_all_where_the_browser_has_them(address, path):
    plain = core_bytes() if path == "/core.wasm" else pack().to_bytes()
    status, headers, body = get(address, path)
    assert (status, body) == (200, plain)
    assert headers["etag"].strip('"') == hashlib.sha256(plain).hexdigest()
    status, packed, small = get(address, path, Accept_Encoding="br, gzip")
    assert (status, packed["content-encoding"], gzip.decompress(small)) == (200, "gzip", plain)
    assert len(small) < len(plain)
    assert packed["etag"] != headers["etag"]
    assert "accept-encoding" in packed["vary"].lower()
    for known, wanted in ((headers["etag"], ""), (f'"x", W/{packed["etag"]}', "gzip")):
        status, again, nothing = get(address, path, If_None_Match=known, Accept_Encoding=wanted)
        assert (status, nothing) == (304, b"")
        assert again["etag"] in known
    assert get(address, path, If_None_Match='"other"')[0] == 200


@pytest.mark.parametrize(
    ("accepted", "takes"),
    [("gzip", True), ("br;q=1.0, GZIP;q=0.5", True), ("gzip;q=0", False), ("gzip; q=0.0", False), ("br", False), ("", False), ("xgzip", False)],
)  # fmt: skip
def test_only_a_browser_that_takes_gzip_gets_it(accepted, takes):
    assert takes_gzip(accepted) is takes


def test_the_pack_that_is_served_is_the_scenes(address):
    read = Pack.from_bytes(get(address, "/pack")[2])
    assert read.digest == pack().digest
    assert read.manifest.title == "Speckle"


def test_hello_says_what_there_is(address, tmp_path):
    told = json.loads(get(address, "/api/hello")[2])
    assert told == {
        "version": told["version"],
        "instructor": True,
        "fem": True,
        "tracker": "",
        "uploads": False,
    }
    with running(tmp_path, opener=lambda *_: scene(), fem=None) as (other, _, app):
        with listening(other):
            announce(app, "The tracker: stale")
            until = time.monotonic() + 10
            while (told := json.loads(get(other, "/api/hello")[2]))["tracker"] == "":
                assert time.monotonic() < until
        assert (told["fem"], told["uploads"], told["tracker"]) == (False, True, "The tracker: stale")


@pytest.mark.parametrize(
    "path",
    ["/static/main.js", "/static/%2e%2e/server.py", "/..%2fserver.py", "/etc/passwd", "/api/image", "/live"],
)
def test_nothing_else_is_served(address, path):
    assert get(address, path)[0] == 404


# --- sessions


def test_a_session_is_run_again_stored_and_verified(server):
    address, sessions, _ = server
    told = recorded(trainee="Bo")
    status, answer = post(address, "/api/sessions", told)
    assert (status, answer["verified"], answer["difference"]) == (200, True, "")
    stored, exercise, trace = sessions.load(answer["number"])
    assert (stored.trainee, stored.model, stored.verified) == ("Bo", "tps", True)
    assert stored.score == pytest.approx(told["score"])
    assert len(trace) == told["steps"]
    assert exercise == pack().manifest.exercises[0]


def test_a_session_that_is_sent_twice_is_stored_once(server):
    address, sessions, _ = server
    told = recorded(trainee="Twice")
    first, second = (post(address, "/api/sessions", told)[1] for _ in range(2))
    assert first == second
    assert len([s for s in sessions.newest() if s.trainee == "Twice"]) == 1


def test_a_page_that_flatters_is_stored_with_the_difference(server):
    address, sessions, _ = server
    told = recorded(trainee="Liar")
    told["score"] = {**told["score"], "final_error": 0.01, "passed": True}
    status, answer = post(address, "/api/sessions", told)
    assert (status, answer["verified"]) == (200, False)
    assert "the page said 0.01" in answer["difference"]
    assert sessions.load(answer["number"])[0].difference == answer["difference"]


def test_a_session_of_another_scene_is_not_stored(server):
    address, sessions, _ = server
    before = len(sessions.newest())
    status, said = post(address, "/api/sessions", recorded(pack("Another")))
    assert status == 422
    assert "a scene that this server does not have: export it" in said
    assert len(sessions.newest()) == before


HOSTILE_SESSIONS = {
    "no json": b"{",
    "deep": b"[" * 100_000,
    "a list": b"[]",
    "nothing": b"",
    "another kind": b'{"kind": "rm"}',
    "none": json.dumps({"format": 1, "kind": "echospline sessions", "sessions": []}).encode(),
}


@pytest.mark.parametrize("name", HOSTILE_SESSIONS)
def test_what_is_no_session_is_refused_with_a_reason(server, name):
    address, sessions, _ = server
    before = len(sessions.newest())
    status, _, said = get(address, "/api/sessions", "POST", HOSTILE_SESSIONS[name])
    assert status == 422
    assert len(said) > 10
    assert len(sessions.newest()) == before


@pytest.mark.parametrize(
    "change",
    [{"rate": 1e400}, {"steps": 3}, {"poses": "!"}, {"model": "fem"}, {"trainee": "x" * 1000}, {"extra": 1}, ],
)  # fmt: skip
def test_a_damaged_session_is_refused_with_a_reason(address, change):
    told = {**recorded(), **change}
    status, _, said = get(address, "/api/sessions", "POST", json.dumps(told).encode())
    assert status == 422
    assert len(said) > 10


def test_a_session_in_the_plane_that_moves_a_probe_is_not_verified(address):
    _, answer = post(address, "/api/sessions", recorded(planes="AAAA", trainee="Odd"))
    assert "no probe" in answer["difference"]


def test_a_browser_reads_what_it_handed_in_and_the_instructor_everything(address):
    handed = json.dumps(recorded(trainee="Eve")).encode()
    status, headers, _ = get(address, "/api/sessions", "POST", handed)
    assert status == 200
    cookie = headers["set-cookie"].split(";")[0]
    mine = json.loads(get(address, "/api/sessions?trainee=Eve", Cookie=cookie)[2])["sessions"]
    assert [s["trainee"] for s in mine] == ["Eve"]
    assert json.loads(get(address, "/api/sessions?trainee=Eve")[2])["sessions"] == []
    number = mine[0]["id"]
    whole = json.loads(get(address, f"/api/sessions/{number}", Cookie=cookie)[2])
    assert whole["poses"] == json.loads(handed)["poses"]
    assert "Eve" in {s["trainee"] for s in json.loads(get(address, "/api/class")[2])["sessions"]}


def test_a_class_is_shown_to_the_instructor_alone_where_others_reach_the_server(tmp_path):
    settings = Settings(port=free_port(), origins=("https://sim.example.org",))
    address = f"http://127.0.0.1:{settings.port}"
    with running(tmp_path, settings=settings):
        for path in ("/api/class", "/api/class.csv"):
            assert get(address, path)[0] == 401
            assert get(address, path, Authorization=f"Bearer {settings.token}")[0] == 403
            assert get(address, path, Authorization=f"Bearer {settings.instructor}")[0] == 200


# --- finite elements


def rows(count=240):
    return poses()[:count]


def asked(table, of=None):
    return {"pack": (of or pack()).digest, "rows": base64.b64encode(table.astype("<f8").tobytes()).decode()}


def test_finite_elements_follow_the_poses_of_a_page(address):
    status, headers, body = get(address, "/api/fem", "POST", json.dumps(asked(rows())).encode())
    assert (status, headers["content-type"]) == (200, "application/octet-stream")
    moved = np.frombuffer(body, "<f4").reshape(-1, 2)
    model, table = fem(), rows()
    assert moved.shape == (model.grid.size, 2)
    state, dt = model.rest(), 1 / 120
    for x, y, tx, ty, speed in table.tolist():  # every step of the page, one by one
        state = model.advance(state, NeedlePose((x, y), (tx, ty), speed), dt)
    exact = model.displacement(state)
    assert np.abs(exact).max() > 0.1
    np.testing.assert_allclose(moved, exact, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "status", "match"),
    [
        ({**asked(rows(3)), "pack": "0" * 64}, 404, "no finite elements"),
        (asked(rows(0)), 422, "one or more rows"),
        (asked(np.zeros((MOST_ROWS + 1, 5))), 422, f"at most {MOST_ROWS} steps"),
        (asked(np.full((2, 5), np.nan)), 422, "not finite"),
        (asked(np.full((2, 5), 1e9)), 422, "not finite or beyond"),
        ({**asked(rows(3)), "rows": "?"}, 422, "base64"),
        ({**asked(rows(3)), "rows": "AAAA"}, 422, "rows of 5 numbers"),
        ({"pack": 3}, 422, "as JSON"),
        ([], 422, "as JSON"),
    ],
)
def test_what_finite_elements_cannot_follow_is_said(address, content, status, match):
    got, said = post(address, "/api/fem", content)
    assert (got, match in str(said)) == (status, True), said


def test_a_page_waits_for_its_own_finite_elements_and_for_nobody_elses(tmp_path):
    entered, go = threading.Event(), threading.Event()

    def slow():
        entered.set()
        assert go.wait(30)
        return fem()

    with running(tmp_path, fem=slow) as (address, _, _):
        answers = []
        first = threading.Thread(
            target=lambda: answers.append(post(address, f"/api/fem?page={PAGE_KEY}", asked(rows(9)))[0])
        )
        first.start()
        try:
            assert entered.wait(20)
            assert post(address, f"/api/fem?page={PAGE_KEY}", asked(rows(9)))[0] == 429
            second = threading.Thread(
                target=lambda: answers.append(post(address, f"/api/fem?page={OTHER_KEY}", asked(rows(9)))[0])
            )
            second.start()
            assert get(address, "/api/hello")[0] == 200
        finally:
            go.set()
        first.join(30)
        second.join(30)
        assert answers == [200, 200]


# --- what steers a page


def test_a_tracker_steers_every_page_and_the_newest_pose_wins(server):
    address, _, app = server
    with listening(address) as one, listening(address) as two:
        waited(app, 2)
        for depth in range(1, 200):
            steer(app, NeedlePose((8.0, 0.0), (8.0, float(depth) / 10)), depth == 1)
        for page in (one, two):
            told = [page.hear("entry")]
            while told[-1]["tip"] != [8.0, 19.9]:
                told.append(page.hear("entry"))
            assert len(told) < 100
            assert told[0]["appears"]
            assert not any(message["appears"] for message in told[1:])
        turn(app, [1, 2, 3, 10, 20, 30])
        assert one.hear("plane")["plane"] == [1, 2, 3, 10, 20, 30]


def test_a_page_is_told_of_the_tracker_whenever_it_comes(server):
    address, _, app = server
    with listening(address) as early:
        waited(app, 1)
        announce(app, "The tracker: stale")
        assert early.hear("tracker")["tracker"] == "The tracker: stale"
        with listening(address) as late:
            assert late.hear("tracker")["tracker"] == "The tracker: stale"
            announce(app, "")
            assert early.hear("tracker")["tracker"] == ""
            assert late.hear("tracker")["tracker"] == ""


def test_a_page_that_hears_nothing_delays_no_other_and_hears_the_newest_later(server):
    address, _, app = server
    with listening(address) as deaf, listening(address) as page:
        waited(app, 2)
        for k in range(3):
            steer(app, NeedlePose((8.0, 0.0), (8.0, 1.0 + k)), False)
            while page.hear("tip")["tip"][1] != 1.0 + k:
                pass
        while deaf.hear("tip")["tip"][1] != 3.0:
            pass


@contextmanager
def phoning(address, key, **options):
    with connect(f"ws{address[4:]}/phone?room={key}", compression=None, **options) as line:
        yield line


def test_a_phone_turns_the_plane_of_its_own_page_alone(server):
    address, _, app = server
    with listening(address, PAGE_KEY) as mine, listening(address, OTHER_KEY) as other:
        waited(app, 2)
        with phoning(address, PAGE_KEY) as phone:
            assert mine.hear("phone")["phone"] is True
            phone.send(json.dumps({"turn": [5.0, -10, 0.5]}))
            assert mine.hear("turn")["turn"] == [5.0, -10.0, 0.5]
        assert mine.hear("phone")["phone"] is False
        with pytest.raises(TimeoutError):
            other.hear("turn", timeout=0.3)


@pytest.mark.parametrize("key", [OTHER_KEY, "", "../../etc"])
def test_a_phone_without_a_page_is_told_so(server, key):
    address, _, app = server
    with listening(address, PAGE_KEY):
        waited(app, 1)
        with phoning(address, key) as phone:
            assert closing(phone).code == 4404


def test_the_phones_page_comes_with_its_own_policy(address):
    status, headers, body = get(address, f"/phone?room={PAGE_KEY}")
    assert status == 200
    assert b"deviceorientation" in body
    assert "connect-src 'self'" in headers["content-security-policy"]


@given(
    st.one_of(st.text(max_size=60), st.lists(st.floats(), max_size=4).map(lambda v: json.dumps({"turn": v})))
)
def test_any_message_of_a_phone_is_a_turn_or_refused(text):
    try:
        angles = turn_of(text)
    except ProtocolError:
        return
    assert len(angles) == 3
    assert max(map(abs, angles)) <= 360


# --- who may connect


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 421),
        ({"Host": "127.0.0.1.evil.example:80"}, 421),
        ({"Host": "user@127.0.0.1"}, 421),
        ({"Host": "127.0.0.1:notaport"}, 421),
        ({"Host": ""}, 421),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
    ],
)
def test_foreign_names_and_pages_are_refused(address, headers, status):
    for path in ("/", "/pack", "/api/sessions"):
        assert get(address, path, **headers)[0] == status


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
def test_a_socket_of_a_foreign_page_is_refused(address, origin):
    for path in ("poses", "phone"):
        with pytest.raises(InvalidStatus) as refused, connect(f"ws{address[4:]}/{path}", origin=origin):
            pass
        assert refused.value.response.status_code == 403
    with listening(address, origin=address):
        pass


def test_elsewhere_than_on_loopback_a_token_is_needed(tmp_path):
    assert Settings().token is None
    assert len(Settings(host="0.0.0.0").token) >= 24
    settings = Settings(port=0, token="secret-word")
    with running(tmp_path, settings=settings) as (address, _, _):
        for path in ("/", "/core.wasm", "/phone"):  # the page itself: it presents the token afterwards
            assert get(address, path)[0] == 200
        for path in ("/pack", "/api/hello", "/api/sessions"):
            assert get(address, path)[0] == 401
            assert get(address, path, Authorization="Bearer wrong")[0] == 401
            assert get(address, path, Authorization="Bearer secret-word")[0] == 200
        for options in ({}, {"subprotocols": ["echospline.1", "token.wrong"]}):
            with pytest.raises(InvalidStatus), listening(address, **options):
                pass
        with listening(address, subprotocols=["echospline.1", "token.secret-word"]) as page:
            assert page.line.subprotocol == "echospline.1"


def test_the_instructor_is_who_has_the_instructors_token_where_others_reach_the_server(tmp_path):
    settings = Settings(port=free_port(), origins=("https://sim.example.org",))
    assert settings.instructor not in (None, settings.token)
    address = f"http://127.0.0.1:{settings.port}"
    with running(tmp_path, settings=settings):
        for token, teaches in ((settings.token, False), (settings.instructor, True)):
            told = get(address, "/api/hello", Authorization=f"Bearer {token}")[2]
            assert json.loads(told)["instructor"] is teaches
    open_ = Settings(port=settings.port, origins=("https://sim.example.org",), open_door=True)
    with running(tmp_path, settings=open_):
        assert json.loads(get(address, "/api/hello")[2])["instructor"] is False
        told = get(address, "/api/hello", Authorization=f"Bearer {open_.instructor}")[2]
        assert json.loads(told)["instructor"] is True


def test_any_host_name_needs_the_token():
    guard = Guard(lambda *_: None, None, ("word",))
    scope = {"type": "http", "path": "/pack", "headers": [(b"host", b"anything:80")]}
    assert guard.refusal(scope)[0] == 401
    assert guard.refusal({**scope, "headers": [(b"host", b"a"), (b"host", b"b")]})[0] == 400


# --- hostile sockets


def closing(line, messages=()):
    """Send what the server will not bear, and return how it closed."""

    def talk():
        for message in messages:
            line.send(message)
        while True:
            line.recv(10)

    with pytest.raises(ConnectionClosed) as closed:
        talk()
    assert closed.value.rcvd is not None, "closed without a word"
    return closed.value.rcvd


TURN = '{"turn": [1, 2, 3]}'
HOSTILE_PHONES = {
    "no json": ["{"],
    "deep json": ["[" * 900],
    "bytes": [b"\x00\x01"],
    "another message": ['{"do": "rm"}'],
    "not a number": ['{"turn": [NaN, 0, 0]}'],
    "infinite": ['{"turn": [1e999, 0, 0]}'],
    "words": ['{"turn": ["1", "2", "3"]}'],
    "booleans": ['{"turn": [true, true, true]}'],
    "two": ['{"turn": [1, 2]}'],
    "more": ['{"turn": [1, 2, 3], "room": "x"}'],
    "oversized": [f'{{"turn": [1, 2, 3{" " * 2000}]}}'],
    "flood": [TURN] * 2000,
}


@pytest.mark.parametrize("name", HOSTILE_PHONES)
def test_a_hostile_phone_is_closed_with_a_reason_and_its_page_lives_on(server, name):
    address, _, app = server
    with listening(address, PAGE_KEY) as page:
        waited(app, 1)
        with phoning(address, PAGE_KEY) as phone:
            closed = closing(phone, HOSTILE_PHONES[name])
            assert closed.code in (1008, 1009)
            assert closed.code == 1009 or len(closed.reason) > 10
        with phoning(address, PAGE_KEY) as phone:
            phone.send('{"turn": [7, 8, 9]}')
            while page.hear("turn")["turn"] != [7.0, 8.0, 9.0]:
                pass


def test_a_page_that_talks_is_closed(address):
    with listening(address) as page:
        assert closing(page.line, ["x"] * 100).code == 1008
    with listening(address) as page:
        assert closing(page.line, ["x" * 70_000]).code == 1009


def test_one_page_too_many_is_turned_away_and_its_place_is_given_free(tmp_path):
    with running(tmp_path, settings=Settings(port=0, clients=1)) as (address, _, app):
        with listening(address):
            waited(app, 1)
            with connect(f"ws{address[4:]}/poses") as extra:
                assert closing(extra).code == 1013
        waited(app, 0)
        with listening(address):
            waited(app, 1)


def test_an_old_page_is_told_to_reload(address):
    with connect(f"ws{address[4:]}/poses", subprotocols=["echospline.0"]) as old:
        assert "reload" in closing(old).reason


def test_an_allowance_refills_with_time():
    now = [0.0]
    allowance = Allowance(10.0, 5.0, clock=lambda: now[0])
    assert [allowance.take() for _ in range(6)] == [True] * 5 + [False]
    now[0] = 0.3
    assert [allowance.take() for _ in range(4)] == [True] * 3 + [False]


# --- pictures of one's own


def opener(path, spacing):
    if path.read_bytes()[:4] != b"good":
        raise InputError(f"{path.name} is no image")
    if spacing is None:
        raise InputError("this file carries no spacing; give it")
    return scene(title=f"Upload of {spacing[0]:g} mm")


@pytest.fixture(scope="module")
def uploading(tmp_path_factory):
    settings = Settings(port=0, uploads=UploadLimits(size=10_000))
    with running(tmp_path_factory.mktemp("uploads"), settings=settings, opener=opener) as (address, _, _):
        yield address


def test_a_picture_becomes_a_pack_whose_sessions_are_taken(uploading):
    status, headers, body = get(uploading, "/api/open?name=a.png&spacing=0.2", "POST", b"good")
    assert (status, headers["content-type"]) == (200, "application/octet-stream")
    mine = Pack.from_bytes(body)
    assert mine.manifest.title == "Upload of 0.2 mm"
    status, answer = post(uploading, "/api/sessions", recorded(mine))
    assert (status, answer["verified"]) == (200, True)
    assert post(uploading, "/api/fem", asked(rows(9), mine))[0] == 200
    assert Pack.from_bytes(get(uploading, "/pack")[2]).manifest.title == "Speckle"


@pytest.mark.parametrize(
    ("query", "body", "status"),
    [
        ("name=a.png&spacing=0.2", b"bad", 422),
        ("name=a.png", b"good", 422),
        ("name=a.png&spacing=nan", b"good", 422),
        ("name=a.png&spacing=-1,2", b"good", 422),
        ("name=a.png&spacing=1,2,3", b"good", 422),
        ("name=../../a&spacing=1", b"good", 422),
        ("name=&spacing=1", b"good", 422),
    ],
)
def test_a_wrong_upload_is_refused_with_a_reason(uploading, query, body, status):
    got, _, text = get(uploading, f"/api/open?{query}", "POST", body)
    assert got == status
    assert len(text) > 10


def test_a_large_upload_is_refused_before_it_is_kept(uploading):
    status, _, _text = get(uploading, "/api/open?name=a.png&spacing=1", "POST", b"good" * 3000)
    assert status == 413


def test_uploads_are_read_one_at_a_time(tmp_path):
    entered, go = threading.Event(), threading.Event()

    def slow(path, spacing):
        entered.set()
        assert go.wait(20)
        return scene(title="Slow")

    with running(tmp_path, opener=slow) as (address, _, _):
        answers = []
        first = threading.Thread(
            target=lambda: answers.append(get(address, "/api/open?name=a.png&spacing=1", "POST", b"good")[0])
        )
        first.start()
        assert entered.wait(20)
        assert get(address, "/api/open?name=b.png&spacing=1", "POST", b"good")[0] == 429
        go.set()
        first.join(20)
        assert answers == [200]


def test_uploads_are_off_without_an_opener(address):
    assert get(address, "/api/open?name=a.png&spacing=1", "POST", b"good")[0] == 403


# --- settings


@pytest.mark.parametrize(("name", "value"), [("port", 70_000), ("clients", 0)])
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        Settings(**{name: value})


def test_a_taken_port_is_an_input_error(address, tmp_path):
    settings = Settings(port=urlsplit(address).port)
    app = build_app(scene(), Sessions(tmp_path / "s.sqlite"), settings)
    with pytest.raises(InputError, match="--port"):
        serve(app, settings, lambda *_: None)
