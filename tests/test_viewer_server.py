"""The server as clients meet it: over real sockets, well-behaved and hostile."""

from __future__ import annotations

import http.client
import json
import threading
import time
from contextlib import ExitStack, contextmanager
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from echospline.errors import InputError
from echospline.scene import UltrasoundImage
from echospline.viewer import Sessions, Settings, UploadLimits, build_app, serve
from echospline.viewer.client import IN_FLIGHT
from echospline.viewer.guard import Allowance, Guard
from echospline.viewer.protocol import (
    COMMAND_BYTES,
    FAILED,
    FROZEN,
    HAS_REFERENCE,
    RECORDING,
    REPLAYING,
    PoseCommand,
    decode_frame,
    encode_command,
)
from echospline.viewer.served_scene import grey_bytes, tip_of
from live_scene import EXERCISE, IMAGE_GRID, MESH, running, scene, speckle


class Page:
    """A client that does what the page does: draw, report, ask."""

    def __init__(self, socket):
        self.socket, self.commands, self.drawn, self.frame = socket, 0, 0, None
        self.told = {}
        self.hello = self.hear("scene")

    def receive(self, timeout=10.0):
        message = self.socket.recv(timeout)
        if isinstance(message, str):
            told = json.loads(message)
            self.told[told["tell"]] = told
            return told
        self.frame = decode_frame(message)
        return self.frame

    def hear(self, what, timeout=10.0):
        """Draw frames until the server has told this."""
        self.told.pop(what, None)
        until = time.monotonic() + timeout
        while what not in self.told:
            assert time.monotonic() < until, f"never told {what!r}; got {list(self.told)}"
            got = self.receive(timeout)
            if not isinstance(got, dict):
                self.send()
        return self.told[what]

    def send(self, pose=None, sent=0.0):
        self.commands += 1
        drawn = self.frame.number if self.frame else 0
        self.socket.send(encode_command(PoseCommand(drawn, self.commands, sent, pose)))

    def ask(self, **request):
        self.socket.send(json.dumps(request))

    def until(self, condition, pose=None, timeout=10.0):
        """Draw frames until one fulfils the condition."""
        until = time.monotonic() + timeout
        if pose is not None:
            self.send(pose)
        while True:
            assert time.monotonic() < until, f"no such frame; the last was {self.frame}"
            got = self.receive(timeout)
            if not isinstance(got, dict):
                self.send()
                if condition(got):
                    return got

    def push(self, depth, angle=90.0, entry=(20.0, 0.0)):
        return self.until(
            lambda f: abs(np.hypot(f.tip[0] - f.entry[0], f.tip[1] - f.entry[1]) - depth) < 1e-6,
            (*entry, angle, depth),
        )


@contextmanager
def page(address, query="", **options):
    with connect(f"ws{address[4:]}/live{query}", compression=None, max_size=None, **options) as socket:
        yield Page(socket)


def get(address, path, method="GET", body=None, **headers):
    where = urlsplit(address)
    link = http.client.HTTPConnection(where.hostname, where.port, timeout=10)
    try:
        link.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            link.putheader(name, value)
        if body is not None:
            link.putheader("Content-Length", str(len(body)))
        link.endheaders(body)
        answer = link.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        link.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with running(tmp_path_factory.mktemp("server")) as (address, sessions, app):
        yield address, sessions, app


@pytest.fixture
def address(server):
    return server[0]


# --- what a client gets


def test_a_page_gets_the_scene_then_frames_of_the_whole_mesh(address):
    with page(address) as client:
        described = client.hello["scene"]
        assert described["mesh"]["shape"] == list(MESH.shape)
        assert [m["name"] for m in described["models"]] == ["soft", "stiff"]
        frame = client.until(lambda f: True)
        assert frame.displacement.shape == (MESH.size, 2)
        assert (frame.displacement == 0).all()


def test_the_needle_goes_where_it_is_sent_and_the_command_comes_back(address):
    with page(address) as client:
        client.send((20.0, 0.0, 60.0, 8.0), sent=77.5)
        number = client.commands
        frame = client.until(lambda f: f.command >= number)
        assert frame.sent == 77.5
        client.push(8.0, 60.0)
        assert client.frame.tip == pytest.approx(tip_of((20.0, 0.0), 60.0, 8.0), abs=1e-5)
        assert client.frame.largest > 1.0


def test_frames_wait_for_the_page_and_the_newest_one_comes_then(address):
    """A page that draws nothing gets two frames, however long it sleeps; then the present, not the past."""
    with page(address) as client:
        client.until(lambda f: True)
        for _ in range(IN_FLIGHT):
            client.receive()
        asleep = client.frame
        with pytest.raises(TimeoutError):
            client.socket.recv(0.5)
        client.send()
        fresh = client.receive()
        assert fresh.number == asleep.number + 1
        assert fresh.time > asleep.time + 0.4


def test_reset_freeze_switch_and_compare(address):
    with page(address) as client:
        client.push(8.0)
        client.ask(do="model", name="stiff")
        frame = client.until(lambda f: f.largest < 1.0)
        assert frame.tip == (20.0, 8.0)
        client.ask(do="compare", name="soft")
        frame = client.until(lambda f: f.flags & HAS_REFERENCE)
        np.testing.assert_allclose(frame.reference, 2 * frame.displacement, rtol=1e-5)
        assert frame.difference == pytest.approx(frame.largest, rel=1e-5)
        client.ask(do="compare", name=None)
        client.until(lambda f: not f.flags & HAS_REFERENCE)
        client.ask(do="freeze", on=True)
        frozen = client.until(lambda f: f.flags & FROZEN)
        assert client.until(lambda f: f.number > frozen.number + 3).time == frozen.time
        client.ask(do="freeze", on=False)
        client.until(lambda f: not f.flags & FROZEN)
        client.ask(do="reset")
        frame = client.until(lambda f: f.tip == (20.0, 0.0))
        assert (frame.displacement == 0).all()
        client.ask(do="model", name="jelly")
        assert "jelly" in client.hear("notice")["text"]


def test_two_clients_do_not_disturb_each_other(address):
    with page(address) as one, page(address) as two:
        one.push(9.0)
        still = two.until(lambda f: f.number > 5)
        assert (still.displacement == 0).all()
        two.ask(do="model", name="stiff")
        two.push(4.0)
        assert one.push(9.0).largest == pytest.approx(1.8, rel=1e-3)


def test_a_model_that_fails_is_told_to_its_client_alone_and_reset_helps(address, caplog):
    with page(address) as one, page(address) as two:
        one.send((20.0, 0.0, 90.0, 31.0))
        assert "through the table" in one.hear("failure")["text"]
        one.until(lambda f: f.flags & FAILED)
        assert two.push(5.0).flags & FAILED == 0
        one.ask(do="reset")
        one.until(lambda f: not f.flags & FAILED and f.tip == (20.0, 0.0))
        one.push(5.0)


def test_a_reload_resumes_where_the_page_was(address):
    with page(address, "?seat=" + "ab" * 16) as client:
        client.push(7.0)
    with page(address, "?seat=" + "ab" * 16) as again:
        assert again.hello["resumed"]
        assert again.hello["pose"]["tip"] == [20.0, 7.0]
    with page(address, "?seat=" + "cd" * 16) as other:
        assert not other.hello["resumed"]
    with page(address, "?seat=../../etc") as odd:
        assert not odd.hello["resumed"]


def engines():
    return sum(thread.name == "echospline-engine" for thread in threading.enumerate())


def wait_for(condition, timeout=15.0):
    until = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_a_client_that_vanishes_frees_its_engine(server):
    address, _, app = server
    wait_for(lambda: engines() == 0)  # those of the tests before
    with ExitStack() as stack:
        clients = [stack.enter_context(page(address)) for _ in range(4)]
        wait_for(lambda: engines() == 4)
        for client in clients:
            client.socket.socket.shutdown(2)  # the cable is cut: no closing handshake
        wait_for(lambda: engines() == 0)
    wait_for(lambda: app.state.room.clients == 0)


# --- training


def test_an_exercise_is_recorded_scored_stored_replayed_and_scored_again(server):
    address, sessions, _ = server
    with page(address) as client:
        client.ask(do="start", exercise="straight-down", trainee="Bo")
        client.hear("running")
        assert client.push(14.0).flags & RECORDING
        client.until(lambda f: len(f.watched) == 1 and f.watched[0, 1] > 12.5)
        client.ask(do="finish", keep=True)
        summary = client.hear("summary")
        result = summary["score"]
        assert result["passed"]
        assert result["target_shift"] > 0.5
        assert result["punctures"] == 1
        assert summary["plot"]["depth"][-1] == pytest.approx(14.0)
        session, exercise, trace = sessions.load(summary["session"])
        assert (session.trainee, exercise) == ("Bo", EXERCISE)
        assert trace.depth[-1] == pytest.approx(14.0)
        client.ask(do="replay", session=summary["session"])
        assert client.hear("running")["replay"]
        client.until(lambda f: f.flags & REPLAYING)
        again = client.hear("summary", timeout=30)
        assert again["replayed"]
        assert again["score"] == result
        client.push(3.0)  # and the needle obeys again


def test_an_abandoned_exercise_leaves_no_session(server):
    address, sessions, _ = server
    count = len(sessions.newest())
    with page(address) as client:
        client.ask(do="start", exercise="straight-down")
        client.hear("running")
        client.push(5.0)
        client.ask(do="finish", keep=False)
        client.hear("stopped")
        assert len(client.until(lambda f: len(f.watched) == 0).watched) == 0
        client.ask(do="finish", keep=True)
        assert "no exercise" in client.hear("notice")["text"]
        client.ask(do="start", exercise="no such")
        assert "no such" in client.hear("notice")["text"]
        client.ask(do="replay", session=10**9)
        assert "no session" in client.hear("notice")["text"]
    assert len(sessions.newest()) == count


def test_sessions_are_listed_and_exported(server):
    address, sessions, _ = server
    if not sessions.newest():
        test_an_exercise_is_recorded_scored_stored_replayed_and_scored_again(server)
    status, _, body = get(address, "/api/sessions")
    assert status == 200
    number = json.loads(body)[0]["id"]
    status, headers, body = get(address, "/api/sessions.csv")
    assert headers["content-disposition"].endswith('.csv"')
    assert body.decode().startswith("id,started")
    assert get(address, f"/api/sessions/{number}.csv")[2].startswith(b"time (s)")
    assert get(address, "/api/sessions/999999999999999999999.csv")[0] == 422


# --- files and headers


def test_the_page_comes_with_a_strict_policy_and_no_inline_code(address):
    status, headers, body = get(address, "/")
    assert status == 200
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert b"style=" not in body
    assert b"http:" not in body
    assert b"https:" not in body
    for path in ("/static/main.js", "/static/style.css", "/favicon.ico"):
        assert get(address, path)[0] == 200


@pytest.mark.parametrize(
    "path", ["/static/../server.py", "/static/%2e%2e/server.py", "/static/..%2fserver.py", "/etc/passwd"]
)
def test_nothing_else_is_served(address, path):
    assert get(address, path)[0] == 404


def test_the_image_comes_as_grey_bytes(address):
    assert get(address, "/api/image")[2] == speckle().tobytes()
    assert get(address, "/api/image?scene=gone")[0] == 404


def test_other_pixel_types_become_grey():
    grey = speckle()
    assert grey_bytes(UltrasoundImage(np.repeat(grey[:, :, None], 3, axis=2), IMAGE_GRID)) == grey.tobytes()
    wide = UltrasoundImage(grey.astype(np.float32) * 7 - 3, IMAGE_GRID)
    spread = np.frombuffer(grey_bytes(wide), np.uint8)
    assert (spread.min(), spread.max()) == (0, 255)
    assert len(set(grey_bytes(UltrasoundImage(np.full((121, 161), 9.0), IMAGE_GRID)))) == 1


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
    assert get(address, "/", **headers)[0] == status
    assert get(address, "/api/sessions", **headers)[0] == status


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
def test_a_socket_of_a_foreign_page_is_refused(address, origin):
    with pytest.raises(InvalidStatus) as refused, page(address, origin=origin):
        pass
    assert refused.value.response.status_code == 403
    with page(address, origin=address):
        pass


def test_elsewhere_than_on_loopback_a_token_is_needed(tmp_path):
    assert Settings().token is None
    assert len(Settings(host="0.0.0.0").token) >= 24
    settings = Settings(port=0, token="secret-word")
    with running(tmp_path, settings=settings) as (address, _, _):
        assert get(address, "/")[0] == 200  # the page itself: it presents the token afterwards
        assert get(address, "/api/image")[0] == 401
        assert get(address, "/api/image", Authorization="Bearer wrong")[0] == 401
        assert get(address, "/api/image", Authorization="Bearer secret-word")[0] == 200
        with pytest.raises(InvalidStatus), page(address):
            pass
        with pytest.raises(InvalidStatus), page(address, subprotocols=["echospline.1", "token.wrong"]):
            pass
        with page(address, subprotocols=["echospline.1", "token.secret-word"]) as client:
            client.until(lambda f: True)


def test_any_host_name_needs_the_token():
    guard = Guard(lambda *_: None, None, "word")
    scope = {"type": "http", "path": "/api/image", "headers": [(b"host", b"anything:80")]}
    assert guard.refusal(scope)[0] == 401
    assert guard.refusal({**scope, "headers": [(b"host", b"a"), (b"host", b"b")]})[0] == 400


# --- hostile messages


def good(number=1, drawn=0, pose=(20.0, 0.0, 90.0, 1.0)):
    return encode_command(PoseCommand(drawn, number, 0.0, pose))


def closing(socket, messages=()):
    """Send what the server will not bear, and return how it closed."""
    try:
        for message in messages:
            socket.send(message)
        while True:
            socket.recv(10)
    except ConnectionClosed as closed:
        return closed


HOSTILE = {
    "empty": [b""],
    "one byte short": [good()[:-1]],
    "another version": [b"\x09" + good()[1:]],
    "unknown flags": [good()[:2] + b"\xff\xff" + good()[4:]],
    "not a number": [good()[:20] + b"\x00\x00\xc0\x7f" + good()[24:]],
    "infinite": [good()[:32] + b"\x00\x00\x80\x7f"],
    "far away": [good(pose=(1e6, 0.0, 90.0, 1.0))],
    "negative depth": [good(pose=(20.0, 0.0, 90.0, -5.0))],
    "number going back": [good(5), good(4)],
    "number twice": [good(5), good(5)],
    "a frame never sent": [good(1, drawn=4_000_000)],
    "no json": ["{"],
    "deep json": ["[" * 4000],
    "unknown request": ['{"do": "rm"}'],
    "wrong type": ['{"do": "freeze", "on": 1}'],
    "oversized binary": [b"\x01\x01" + bytes(70_000)],
    "oversized text": ['{"do": "' + "x" * 70_000 + '"}'],
    "flood of commands": [good(k) for k in range(1, 1500)],
    "flood of requests": ['{"do": "reset"}'] * 200,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_client_is_closed_with_a_reason_and_harms_nobody(address, name):
    with page(address) as calm:
        calm.push(6.0)
        with page(address) as hostile:
            closed = closing(hostile.socket, HOSTILE[name])
            assert closed.rcvd is not None, "closed without a word"
            code, reason = closed.rcvd.code, closed.rcvd.reason
            assert code in (1008, 1009)
            assert code == 1009 or len(reason) > 10
        before = calm.frame
        after = calm.until(lambda f: f.number > before.number + 3)
        assert after.tip == before.tip


def test_frames_drawn_out_of_order_close_the_client(address):
    with page(address) as client:
        client.until(lambda f: f.number > 5)
        client.commands += 1
        client.socket.send(good(client.commands, drawn=client.frame.number))
        client.commands += 1
        client.socket.send(good(client.commands, drawn=1))
        assert closing(client.socket).rcvd.code == 1008


def test_one_page_too_many_is_turned_away(tmp_path):
    with running(tmp_path, settings=Settings(port=0, clients=1)) as (address, _, _):
        with page(address):
            with connect(f"ws{address[4:]}/live") as extra, pytest.raises(ConnectionClosed) as closed:
                extra.recv(10)
            assert closed.value.rcvd.code == 1013
        until = time.monotonic() + 10
        while time.monotonic() < until:
            try:
                with page(address):
                    return
            except ConnectionClosed:
                time.sleep(0.05)
        pytest.fail("the place was not given free")


def test_an_old_page_is_told_to_reload(address):
    with connect(f"ws{address[4:]}/live", subprotocols=["echospline.0"]) as old:
        with pytest.raises(ConnectionClosed) as closed:
            old.recv(10)
        assert "reload" in closed.value.rcvd.reason


def test_an_allowance_refills_with_time():
    now = [0.0]
    allowance = Allowance(10.0, 5.0, clock=lambda: now[0])
    assert [allowance.take() for _ in range(6)] == [True] * 5 + [False]
    now[0] = 0.3
    assert [allowance.take() for _ in range(4)] == [True] * 3 + [False]


# --- uploads


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


def test_an_uploaded_image_is_a_scene_of_its_own(uploading):
    status, _, body = get(uploading, "/api/upload?name=a.png&spacing=0.2", "POST", b"good")
    assert status == 200
    with page(uploading, f"?scene={json.loads(body)['scene']}") as client:
        assert client.hello["scene"]["title"] == "Upload of 0.2 mm"
    with page(uploading) as client:
        assert client.hello["scene"]["title"] == "Speckle"
    with connect(f"ws{uploading[4:]}/live?scene=gone") as socket, pytest.raises(ConnectionClosed) as closed:
        socket.recv(10)
    assert closed.value.rcvd.code == 4404


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
    got, _, text = get(uploading, f"/api/upload?{query}", "POST", body)
    assert got == status
    assert len(text) > 10


def test_a_large_upload_is_refused_before_it_is_kept(uploading):
    status, _, _text = get(uploading, "/api/upload?name=a.png&spacing=1", "POST", b"good" * 3000)
    assert status == 413


def test_uploads_are_read_one_at_a_time(tmp_path):
    entered, go = threading.Event(), threading.Event()

    def slow(path, spacing):
        entered.set()
        assert go.wait(20)
        return scene()

    with running(tmp_path, opener=slow) as (address, _, _):
        answers = []
        first = threading.Thread(
            target=lambda: answers.append(
                get(address, "/api/upload?name=a.png&spacing=1", "POST", b"good")[0]
            )
        )
        first.start()
        assert entered.wait(20)
        assert get(address, "/api/upload?name=b.png&spacing=1", "POST", b"good")[0] == 429
        go.set()
        first.join(20)
        assert answers == [200]


def test_uploads_are_off_without_an_opener(address):
    assert get(address, "/api/upload?name=a.png&spacing=1", "POST", b"good")[0] == 403


# --- settings


@pytest.mark.parametrize(("name", "value"), [("port", 70_000), ("clients", 0)])
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        Settings(**{name: value})


def test_a_taken_port_is_an_input_error(address, tmp_path):
    settings = Settings(port=urlsplit(address).port)
    app = build_app(scene(), Sessions(tmp_path / "s.sqlite"), settings)
    with pytest.raises(InputError, match="--port"):
        serve(app, settings, lambda _: None)


def test_a_scene_needs_a_model_and_exercises_that_fit():
    with pytest.raises(InputError, match="one model"):
        scene(names=())
    assert len(good()) == COMMAND_BYTES
