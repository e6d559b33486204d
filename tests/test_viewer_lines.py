"""The server under bad lines: slow and stalled uploads, half-open connections, restarts, and an end at the first Ctrl+C."""

from __future__ import annotations

import json
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from echospline.cli.live import opener_for
from echospline.errors import InputError
from echospline.scenario import Scenario
from echospline.scene import UltrasoundImage
from echospline.viewer import Sessions, Settings, UploadLimits, announce
from echospline.viewer import idle as idle_module
from echospline.viewer.pictures import KEPT_UNUSED, Pictures
from echospline.viewer.words import for_page
from live_scene import IMAGE_GRID, running, scene, speckle
from test_viewer_server import get, page

QUICK = UploadLimits(deadline=20.0, stall=0.6, floor=20_000.0, grace=0.3, reading=20.0)
SEATS = ["ab" * 16, "cd" * 16, "ef" * 16]


def picture_scene(path, spacing):
    """The scene of a stored picture, which is any file that Pillow reads."""
    try:
        pixels = np.asarray(Image.open(path).convert("L").resize((161, 121)))
    except OSError as error:
        raise InputError(f"{path} is no image: give --spacing") from error
    return scene(title="Your image", image=UltrasoundImage(pixels, IMAGE_GRID))


def png(folder: Path, shade: int = 90) -> bytes:
    path = folder / f"{shade}.png"
    Image.fromarray(np.full((50, 80), shade, np.uint8)).save(path)
    return path.read_bytes()


@contextmanager
def begun(address: str, head: str, body: bytes = b""):
    """A connection that has sent this much."""
    where = urlsplit(address)
    with socket.create_connection((where.hostname, where.port), timeout=20) as line:
        line.sendall(head.replace("\n", "\r\n").encode() + body)
        yield line


def post(size: int, seat: str = "") -> str:
    return (
        f"POST /api/upload?name=a.png&spacing=0.2&seat={seat} HTTP/1.1\nHost: 127.0.0.1\n"
        f"Content-Length: {size}\n\n"
    )


def answer(line: socket.socket) -> str:
    """Everything up to the end of the connection."""
    data = b""
    while piece := line.recv(65536):
        data += piece
    return data.decode()


def upload(address: str, body: bytes, seat: str = "", name: str = "a.png", spacing: str = "0.2"):
    return get(address, f"/api/upload?name={name}&spacing={spacing}&seat={seat}", "POST", body)


# --- uploads


def test_a_stalled_upload_ends_by_itself_and_holds_no_other_up(tmp_path):
    with running(tmp_path, settings=Settings(port=0, uploads=QUICK), opener=picture_scene) as (address, _, _):
        with begun(address, post(1000, SEATS[0]), b"ab") as line:
            assert upload(address, png(tmp_path), SEATS[1])[0] == 200
            assert upload(address, png(tmp_path), SEATS[0])[0] == 429  # one per client
            said = answer(line)
        assert said.startswith("HTTP/1.1 408")
        assert "too slowly" in said
        assert upload(address, png(tmp_path), SEATS[0])[0] == 200


def test_an_upload_that_drips_below_the_floor_is_ended(tmp_path):
    with (
        running(tmp_path, settings=Settings(port=0, uploads=QUICK), opener=picture_scene) as (address, _, _),
        begun(address, post(100_000)) as line,
    ):
        over = threading.Event()

        def drip():
            while not over.wait(0.1):
                try:
                    line.sendall(b"x")
                except OSError:
                    return

        thread = threading.Thread(target=drip)
        thread.start()
        try:
            assert "expected 20 KiB/s" in answer(line)
        finally:
            over.set()
            thread.join()


def test_an_upload_has_a_deadline(tmp_path):
    limits = UploadLimits(deadline=1.0, stall=20.0, floor=0.0)
    with (
        running(tmp_path, settings=Settings(port=0, uploads=limits), opener=picture_scene) as (address, _, _),
        begun(address, post(1000), b"ab") as line,
    ):
        assert answer(line).startswith("HTTP/1.1 408")


def test_a_client_that_leaves_in_mid_upload_leaves_nothing_behind(tmp_path, caplog):
    with running(tmp_path, settings=Settings(port=0, uploads=QUICK), opener=picture_scene) as (
        address,
        sessions,
        _,
    ):
        with begun(address, post(1000), b"ab"):
            time.sleep(0.2)
        until = time.monotonic() + 10
        while list(sessions.pictures.folder.glob("*")) and time.monotonic() < until:
            time.sleep(0.02)
        assert not list(sessions.pictures.folder.glob("*"))
        assert upload(address, png(tmp_path))[0] == 200
    assert not [record for record in caplog.records if record.exc_info]


def test_a_picture_that_takes_too_long_to_read_is_given_up_and_others_are_read(tmp_path):
    go = threading.Event()

    def opener(path, spacing):
        if path.read_bytes()[:4] == b"slow":
            go.wait(60)
        return scene()

    limits = UploadLimits(reading=0.5)
    with running(tmp_path, settings=Settings(port=0, uploads=limits), opener=opener) as (address, _, _):
        try:
            for k in range(3):
                status, _, body = upload(address, b"slow%d" % k, SEATS[k])
                assert (status, b"could not be read within" in body) == (422, True)
            assert upload(address, b"quick", SEATS[0])[0] == 200
            assert upload(address, b"slow3", SEATS[0])[0] == 422
            assert (
                upload(address, b"quick too", SEATS[0])[0] == 503
            )  # four threads that do not end are enough
        finally:
            go.set()
        until = time.monotonic() + 10
        while upload(address, b"quick three", SEATS[0])[0] != 200:
            assert time.monotonic() < until
            time.sleep(0.05)


def test_a_size_announced_beyond_the_limit_is_refused_before_a_byte_comes(tmp_path):
    with running(tmp_path, opener=picture_scene) as (address, _, _), begun(address, post(10**12)) as line:
        line.settimeout(20)
        assert line.recv(4096).startswith(b"HTTP/1.1 413")


# --- connections


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(idle_module, "HEADERS", 1.0)
    monkeypatch.setattr(idle_module, "STALL", 1.0)
    monkeypatch.setattr(idle_module, "PAUSE", 0.1)


def test_two_hundred_half_open_connections_are_closed_and_a_page_lives_on(impatient, tmp_path):
    with running(tmp_path) as (address, _, _), page(address) as client, ExitStack() as stack:
        lines = [
            stack.enter_context(begun(address, "GET / HTTP/1.1\nHost: 127.0.0.1\nX-Slow: "))
            for _ in range(200)
        ]
        for line in lines:
            line.settimeout(20)
            assert not line.recv(100)  # the end; a timeout would raise
        client.push(6.0)


def test_a_byte_now_and_then_keeps_no_unfinished_headers_open(impatient, tmp_path):
    with running(tmp_path) as (address, _, _), begun(address, "GET / HTTP/1.1\nX: ") as line:
        line.settimeout(0.2)
        until = time.monotonic() + 20
        while True:
            assert time.monotonic() < until
            try:
                line.sendall(b"x")
                if not line.recv(100):
                    break
            except TimeoutError:
                continue
            except OSError:
                break


def test_an_answer_that_nobody_reads_is_given_up(impatient, tmp_path):
    grid = IMAGE_GRID.covering(IMAGE_GRID, (4000, 4000))
    large = UltrasoundImage(np.zeros((4000, 4000), np.uint8), grid)
    with running(tmp_path, image=large) as (address, _, _):
        where = urlsplit(address)
        line = socket.socket()
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.connect((where.hostname, where.port))
        line.settimeout(20)
        line.sendall(b"GET /api/image HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        time.sleep(3.0)
        size = 0
        try:
            while piece := line.recv(1 << 20):
                size += len(piece)
        except ConnectionResetError:
            pass
        assert 0 < size < 15_000_000  # what the system's buffers held, not the whole
        line.close()


def test_an_answer_that_is_read_slowly_comes_whole(impatient, tmp_path):
    grid = IMAGE_GRID.covering(IMAGE_GRID, (4000, 4000))
    large = UltrasoundImage(np.zeros((4000, 4000), np.uint8), grid)
    with running(tmp_path, image=large) as (address, _, _):
        where = urlsplit(address)
        line = socket.socket()
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        line.connect((where.hostname, where.port))
        line.settimeout(20)
        line.sendall(b"GET /api/image HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
        size, until = 0, time.monotonic() + 3.0  # three times what an idle connection has
        while piece := line.recv(1 << 20):
            size += len(piece)
            if time.monotonic() < until:
                time.sleep(0.05)
        assert size > 16_000_000
        line.close()


def test_a_connection_that_is_used_again_and_again_stays_open(impatient, tmp_path):
    import http.client  # noqa: PLC0415

    with running(tmp_path) as (address, _, _):
        where = urlsplit(address)
        link = http.client.HTTPConnection(where.hostname, where.port, timeout=10)
        link.connect()
        first = link.sock
        for _ in range(6):
            link.request("GET", "/api/sessions")
            assert link.getresponse().read() == b"[]"
            time.sleep(0.4)
        assert link.sock is first
        link.close()


# --- the end


def test_the_first_ctrl_c_ends_a_busy_server_within_three_seconds(tmp_path):
    """A stalled upload, unfinished headers, an answer nobody reads and an open web socket."""
    command = [sys.executable, "-m", "echospline", "live", "--no-browser", "--port", "0", "--mesh", "12x9",
               "--sessions", str(tmp_path / "kept.sqlite")]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process, ExitStack() as stack:
        try:
            said = next(line for line in process.stderr if "http://" in line)
            address = re.search(r"http://\S+", said).group().rstrip("/")
            stack.enter_context(begun(address, post(10_000_000, SEATS[0]), b"ab"))
            stack.enter_context(begun(address, "GET / HTTP/1.1\nX: "))
            client = stack.enter_context(page(address))
            client.push(4.0, entry=tuple(client.hello["pose"]["entry"]))
            process.send_signal(signal.SIGINT)
            assert process.wait(3.0) == 0
        finally:
            process.kill()
        assert "Traceback" not in process.stderr.read()


def test_a_picture_being_read_does_not_delay_the_end(tmp_path):
    """Nor does a model being built."""
    entered, go = threading.Event(), threading.Event()

    def opener(path, spacing):
        entered.set()
        go.wait(60)
        return scene()

    def models(name):
        if threading.current_thread().name == "echospline-engine":
            go.wait(60)
        return scene().models(name)

    over = threading.Event()
    try:
        with running(tmp_path, opener=opener, models=models, over=over, patience=3.0) as (address, _, _):
            answers = []
            stuck = threading.Thread(target=lambda: answers.append(upload(address, b"good")[0]))
            stuck.start()
            assert entered.wait(20)
            with page(address) as client:
                client.ask(do="model", name="stiff")
                client.until(lambda f: True)
                over.set()
                time.sleep(0.1)
    finally:
        go.set()
    stuck.join(20)
    assert answers == [503]


# --- messages


def bad_files(folder: Path) -> dict[str, bytes]:
    Image.fromarray(np.full((500, 800), 90, np.uint8)).save(folder / "whole.png")
    whole = (folder / "whole.png").read_bytes()
    np.savez(folder / "a.npz", a=np.zeros(3))
    return {
        "a picture without spacing": whole,
        "cut short": whole[: len(whole) // 2],
        "a text": b"hello, this is no picture at all",
        "empty": b"",
        "arrays": (folder / "a.npz").read_bytes(),
        "a scenario": b"[image]\nfile = '/etc/passwd'\n",
        "a volume cut short": b"ObjectType = Image\nNDims = 2\nDimSize = 10 10\nElementType = MET_UCHAR\nElementDataFile = LOCAL\nab",
        "a volume in another file": b"ObjectType = Image\nNDims = 2\nDimSize = 10 10\nElementType = MET_UCHAR\nElementDataFile = /etc/passwd\n",
        "far too large": b"ObjectType = Image\nNDims = 2\nDimSize = 90000 90000\nElementType = MET_DOUBLE\nElementDataFile = LOCAL\nab",
    }


def test_a_message_of_an_upload_holds_no_path_and_no_option(tmp_path):
    opener = opener_for(Scenario())
    with running(tmp_path / "served", opener=opener) as (address, sessions, _):
        for kind, body in bad_files(tmp_path).items():
            status, _, text = upload(address, body, spacing="", name="a.mha")
            said = text.decode()
            assert status == 422, kind
            assert len(said) > 10, kind
            for secret in ("--", "/tmp", "/etc", "spacing=", ".toml", ".mha", str(tmp_path)):
                assert secret not in said, f"{kind}: {said}"
            assert not re.search(r"[0-9a-f]{16}", said), f"{kind}: {said}"
        assert (
            "size of a pixel in mm"
            in upload(address, (tmp_path / "whole.png").read_bytes(), spacing="")[2].decode()
        )
        assert not list(sessions.pictures.folder.glob("*"))  # none of them stays


def test_other_messages_hold_no_path_either(tmp_path):
    with running(tmp_path) as (address, sessions, _), page(address) as client:
        said = get(address, "/api/sessions/99.csv")[2].decode()
        client.ask(do="replay", session=99)
        for text in (said, client.hear("notice")["text"]):
            assert "no session 99" in text
            assert str(sessions.path) not in text
            assert "sqlite" not in text


WORDS = st.text("abcdefgh ,.()", min_size=1, max_size=20)


@given(
    st.lists(
        st.tuples(WORDS, st.sampled_from(["", " --spacing 1,2", " /home/a/b.png", " spacing=(1, 2)", " needle.entry = 3", " C:\\a\\b.mha"])),
        min_size=1,
        max_size=5,
    ),
    st.sampled_from([": ", "; "]),
)  # fmt: skip
def test_words_for_the_page_keep_what_is_public_and_nothing_else(clauses, between):
    text = between.join(a + b for a, b in clauses)
    said = for_page(text, Path("/tmp/upload/x.png"))
    assert said
    for secret in ("--", "/home", "spacing=", "needle.entry", "\\"):
        assert secret not in said
    for public, private in clauses:
        if not private and public.strip():
            assert public.strip() in said


def test_the_uploaded_file_is_called_this_file(tmp_path):
    path = tmp_path / "x.png"
    assert for_page(f"{path} is cut short", path) == "this file is cut short"
    assert for_page(f"x.png ({path}): broken", path) == "this file (this file): broken"


# --- stored pictures


def train(client, exercise="straight-down"):
    client.ask(do="start", exercise=exercise, trainee="Bo")
    client.hear("running")
    client.push(6.0)
    client.ask(do="finish", keep=True)
    return client.hear("summary")


def test_a_session_in_an_uploaded_picture_is_replayed_after_a_restart(tmp_path):
    with running(tmp_path, opener=picture_scene) as (address, _, _):
        name = json.loads(upload(address, png(tmp_path))[2])["scene"]
        with page(address, f"?scene={name}") as client:
            summary = train(client)
    with running(tmp_path, opener=picture_scene) as (address, _, _):
        with page(address, f"?scene={name}") as client:
            assert client.hello["scene"]["title"] == "Your image"
            client.ask(do="replay", session=summary["session"])
            again = client.hear("summary", timeout=30)
            assert again["replayed"]
            assert again["score"] == summary["score"]
        assert get(address, f"/api/image?scene={name}")[2][:100] == bytes([90] * 100)


def test_a_replay_in_another_picture_is_refused_and_says_where_it_belongs(tmp_path):
    with running(tmp_path, opener=picture_scene) as (address, _, _):
        first, second = (json.loads(upload(address, png(tmp_path, shade))[2])["scene"] for shade in (90, 91))
        with page(address, f"?scene={first}") as client:
            number = train(client)["session"]
        for query, home in (("", ""), (f"?scene={second}", second)):
            with page(address, query) as other:
                other.ask(do="replay", session=number)
                told = other.hear("elsewhere")
                assert (told["scene"], told["session"]) == (first, number)
                assert "another picture" in told["text"]
                assert other.hello["scene"]["upload"] == home
                other.push(3.0)


def test_a_picture_stays_as_long_as_its_sessions(tmp_path):
    with running(tmp_path, opener=picture_scene) as (address, sessions, _):
        used, unused = (json.loads(upload(address, png(tmp_path, shade))[2])["scene"] for shade in (90, 91))
        with page(address, f"?scene={used}") as client:
            train(client)
    folder = sessions.pictures.folder
    sessions.pictures.sweep(sessions.needs)
    assert sessions.pictures.find(unused) is not None  # not at once: its page may come back
    sessions.pictures.sweep(sessions.needs, time.time() + KEPT_UNUSED + 60)
    assert sessions.pictures.find(unused) is None
    assert sessions.pictures.find(used) is not None
    assert len(list(folder.iterdir())) == 2  # the picture and its record
    assert Pictures(folder).find("../../../etc/pas") is None


def test_a_scene_that_was_dropped_from_memory_is_opened_again_if_it_has_sessions(tmp_path, monkeypatch):
    monkeypatch.setattr("echospline.viewer.room.UPLOADED_SCENES", 1)
    with running(tmp_path, opener=picture_scene) as (address, sessions, app):
        used = json.loads(upload(address, png(tmp_path, 90))[2])["scene"]
        with page(address, f"?scene={used}") as client:
            train(client)
        unused, last = (json.loads(upload(address, png(tmp_path, shade))[2])["scene"] for shade in (91, 92))
        assert sorted(app.state.room.scenes) == ["", last]
        assert sessions.pictures.find(unused) is None
        assert get(address, f"/api/image?scene={unused}")[0] == 404
        assert get(address, f"/api/image?scene={used}")[2][:100] == bytes([90] * 100)


def test_the_same_file_in_two_sizes_is_two_scenes_of_one_file(tmp_path):
    with running(tmp_path, opener=picture_scene) as (address, sessions, _):
        one, two = (
            json.loads(upload(address, png(tmp_path), spacing=size)[2])["scene"] for size in ("0.2", "0.4")
        )
        assert one != two
        assert json.loads(upload(address, png(tmp_path))[2])["scene"] == one
        assert len(list(sessions.pictures.folder.glob("*.png"))) == 1
        sessions.pictures.drop(one)
        assert sessions.pictures.find(two) is not None


def test_sessions_of_the_first_schema_are_read_and_replayed_in_a_scene_of_their_title(tmp_path):
    with running(tmp_path) as (address, sessions, _), page(address) as client:
        number = train(client)["session"]
    database = sqlite3.connect(sessions.path)
    with database:
        for column in ("picture", "upload"):
            database.execute(f"ALTER TABLE session DROP COLUMN {column}")
        database.execute("PRAGMA user_version = 1")
    database.close()
    assert Sessions(sessions.path).load(number)[0].picture == ""
    with running(tmp_path) as (address, _, _), page(address) as client:
        client.ask(do="replay", session=number)
        assert client.hear("running")["replay"]
    with running(tmp_path, title="Another") as (address, _, _), page(address) as client:
        client.ask(do="replay", session=number)
        assert "another picture" in client.hear("elsewhere")["text"]


def test_pictures_differ_by_a_pixel_and_by_their_spacing():
    grey = speckle()
    other = grey.copy()
    other[5, 5] ^= 1
    wider = IMAGE_GRID.covering(IMAGE_GRID, IMAGE_GRID.shape)
    names = {
        scene(image=UltrasoundImage(pixels, grid)).picture
        for pixels, grid in ((grey, IMAGE_GRID), (other, IMAGE_GRID), (grey.astype(np.uint16), IMAGE_GRID))
    }
    assert len(names) == 3
    assert scene(image=UltrasoundImage(grey, wider)).picture in names


# --- the tracker


def test_pages_are_told_when_the_tracker_is_lost_and_when_it_is_back(tmp_path):
    with running(tmp_path) as (address, _, app), page(address) as early:
        announce(app, "The tracker: stale")
        assert early.hear("tracker")["text"] == "The tracker: stale"
        with page(address) as late:
            assert late.told.get("tracker", late.hear("tracker"))["text"] == "The tracker: stale"
            announce(app, "")
            assert early.hear("tracker")["text"] == ""
            assert late.hear("tracker")["text"] == ""
