"""The server under bad lines: slow and stalled uploads, half-open connections, restarts, and an end at the first Ctrl+C."""

from __future__ import annotations

import base64
import json
import re
import signal
import socket
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
from echospline.page import Pack, packed
from echospline.scenario import Scenario
from echospline.scene import RegularGrid, UltrasoundImage
from echospline.viewer import Settings, UploadLimits, announce
from echospline.viewer import idle as idle_module
from echospline.viewer.pictures import KEPT_UNUSED, Pictures
from echospline.viewer.reference import MOST_ROWS
from echospline.viewer.words import for_page
from live_scene import fem, get, listening, pack, post, recorded, running, scene
from page_scene import poses, scenario

QUICK = UploadLimits(deadline=20.0, stall=2.0, floor=20_000.0, grace=0.3, reading=20.0)
SEATS = ["ab" * 16, "cd" * 16, "ef" * 16]


def picture_scene(path, spacing):
    """The scene of a stored picture, which is any file that Pillow reads."""
    try:
        pixels = np.asarray(Image.open(path).convert("L"))
    except OSError as error:
        raise InputError(f"{path} is no image: give --spacing") from error
    size = spacing or (0.2, 0.2)
    return scene(title=f"{int(pixels[0, 0])} of {size[0]:g} mm")


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


def head_of(size: int, seat: str = "") -> str:
    return (
        f"POST /api/open?name=a.png&spacing=0.2&page={seat} HTTP/1.1\nHost: 127.0.0.1\n"
        f"Content-Length: {size}\n\n"
    )


def answer(line: socket.socket) -> str:
    """Everything up to the end of the connection."""
    data = b""
    while piece := line.recv(65536):
        data += piece
    return data.decode()


def upload(address: str, body: bytes, seat: str = "", name: str = "a.png", spacing: str = "0.2"):
    return get(address, f"/api/open?name={name}&spacing={spacing}&page={seat}", "POST", body)


# --- uploads


def test_a_stalled_upload_ends_by_itself_and_holds_no_other_up(tmp_path):
    with running(tmp_path, settings=Settings(port=0, uploads=QUICK), opener=picture_scene) as (address, _, _):
        with begun(address, head_of(1000, SEATS[0]), b"ab") as line:
            assert upload(address, png(tmp_path), SEATS[1])[0] == 200
            assert upload(address, png(tmp_path), SEATS[0])[0] == 429  # one per client
            said = answer(line)
        assert said.startswith("HTTP/1.1 408")
        assert "too slowly" in said
        assert upload(address, png(tmp_path), SEATS[0])[0] == 200


def test_an_upload_that_drips_below_the_floor_is_ended(tmp_path):
    with (
        running(tmp_path, settings=Settings(port=0, uploads=QUICK), opener=picture_scene) as (address, _, _),
        begun(address, head_of(100_000)) as line,
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
        begun(address, head_of(1000), b"ab") as line,
    ):
        assert answer(line).startswith("HTTP/1.1 408")


def test_a_client_that_leaves_in_mid_upload_leaves_nothing_behind(tmp_path, caplog):
    with running(tmp_path, settings=Settings(port=0, uploads=QUICK), opener=picture_scene) as (
        address,
        sessions,
        _,
    ):
        with begun(address, head_of(1000), b"ab"):
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
    with running(tmp_path, opener=picture_scene) as (address, _, _), begun(address, head_of(10**12)) as line:
        line.settimeout(20)
        assert line.recv(4096).startswith(b"HTTP/1.1 413")


# --- connections


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(idle_module, "HEADERS", 1.0)
    monkeypatch.setattr(idle_module, "STALL", 1.0)
    monkeypatch.setattr(idle_module, "PAUSE", 0.1)


def test_two_hundred_half_open_connections_are_closed_and_a_page_lives_on(impatient, tmp_path):
    with running(tmp_path) as (address, _, app), listening(address) as page, ExitStack() as stack:
        lines = [
            stack.enter_context(begun(address, "GET / HTTP/1.1\nHost: 127.0.0.1\nX-Slow: "))
            for _ in range(200)
        ]
        for line in lines:
            line.settimeout(20)
            assert not line.recv(100)  # the end; a timeout would raise
        announce(app, "still here")
        assert page.hear("tracker")["tracker"] == "still here"


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


def large_pack():
    """A scene of 4000 x 4000 pixels."""
    grid = RegularGrid((4000, 4000), (0.008, 0.005))
    pixels = np.random.default_rng(2).integers(0, 200, (4000, 4000), dtype=np.uint8)
    return packed(scenario(), UltrasoundImage(pixels, grid, "large"), Path())


def test_an_answer_that_nobody_reads_is_given_up(impatient, tmp_path):
    with running(tmp_path, pack=large_pack()) as (address, _, _):
        where = urlsplit(address)
        line = socket.socket()
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.connect((where.hostname, where.port))
        line.settimeout(20)
        line.sendall(b"GET /pack HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
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
    with running(tmp_path, pack=large_pack()) as (address, _, _):
        where = urlsplit(address)
        line = socket.socket()
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        line.connect((where.hostname, where.port))
        line.settimeout(20)
        line.sendall(b"GET /pack HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
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
            link.request("GET", "/api/sessions?trainee=Bo")
            assert json.loads(link.getresponse().read())["sessions"] == []
            time.sleep(0.4)
        assert link.sock is first
        link.close()


# --- the end


def test_the_first_ctrl_c_ends_a_busy_server_within_three_seconds(tmp_path):
    """A stalled upload, unfinished headers, an open web socket, and finite elements at work."""
    command = [sys.executable, "-m", "echospline", "live", "--no-browser", "--port", "0", "--mesh", "12x9",
               "--sessions", str(tmp_path / "kept.sqlite")]  # fmt: skip
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process, ExitStack() as stack:
        try:
            said = next(line for line in process.stderr if "http://" in line)
            address = re.search(r"http://\S+", said).group().rstrip("/")
            stack.enter_context(begun(address, head_of(10_000_000, SEATS[0]), b"ab"))
            stack.enter_context(begun(address, "GET / HTTP/1.1\nX: "))
            stack.enter_context(listening(address))
            pack = Pack.from_bytes(get(address, "/pack")[2])
            (x, y), depths = pack.manifest.needle.entry, np.linspace(0.0, 20.0, MOST_ROWS)
            rows = np.array([(x, y, x, y + depth, 0.3) for depth in depths]).astype("<f8")
            body = json.dumps({"pack": pack.digest, "rows": base64.b64encode(rows.tobytes()).decode()})
            head = f"POST /api/fem HTTP/1.1\nHost: 127.0.0.1\nContent-Length: {len(body)}\n\n"
            stack.enter_context(begun(address, head, body.encode()))
            time.sleep(0.5)
            process.send_signal(signal.SIGINT)
            assert process.wait(3.0) == 0
        finally:
            process.kill()
        assert "Traceback" not in process.stderr.read()


def test_a_picture_being_read_does_not_delay_the_end(tmp_path):
    """Nor do finite elements that are set up."""
    entered, following, go = threading.Event(), threading.Event(), threading.Event()

    def opener(path, spacing):
        entered.set()
        go.wait(60)
        return scene()

    def slow():
        following.set()
        go.wait(60)
        return fem()

    def asking(address):
        rows = base64.b64encode(poses()[:9].astype("<f8").tobytes()).decode()
        answers.append(post(address, "/api/fem", {"pack": pack().digest, "rows": rows})[0])

    over, answers = threading.Event(), []
    try:
        with running(tmp_path, opener=opener, fem=slow, over=over, patience=3.0) as (address, _, _):
            stuck = [
                threading.Thread(target=lambda: answers.append(upload(address, b"good")[0])),
                threading.Thread(target=asking, args=(address,)),
            ]
            for thread in stuck:
                thread.start()
            assert entered.wait(20)
            assert following.wait(20)
            over.set()
            time.sleep(0.1)
    finally:
        go.set()
    for thread in stuck:
        thread.join(20)
    assert answers == [503, 503]


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
    with running(tmp_path) as (address, sessions, _):
        sessions.path.rename(tmp_path / "elsewhere")
        sessions.path.mkdir()
        status, _, said = get(address, "/api/sessions?trainee=Bo")
        assert status >= 400
        assert str(tmp_path) not in said.decode()
        assert "sqlite" not in said.decode()


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


def opened(address, body, spacing="0.2"):
    status, _, data = upload(address, body, spacing=spacing)
    assert status == 200, data
    return Pack.from_bytes(data)


def test_a_session_in_an_uploaded_picture_is_taken_after_a_restart(tmp_path):
    with running(tmp_path, opener=picture_scene) as (address, _, _):
        mine = opened(address, png(tmp_path))
    told = recorded(mine)
    with running(tmp_path, opener=picture_scene) as (address, sessions, _):
        status, answer = post(address, "/api/sessions", told)
        assert (status, answer["verified"]) == (200, True)
        assert sessions.load(answer["number"])[0].upload == mine.digest[:16]
    with running(tmp_path, opener=lambda *_: scene(title="Other tissue")) as (address, _, _):
        status, said = post(address, "/api/sessions", {**told, "trainee": "Late"})
        assert (status, "does not have" in said) == (422, True)


def test_a_picture_stays_as_long_as_its_sessions(tmp_path):
    with running(tmp_path, opener=picture_scene) as (address, sessions, _):
        used, unused = (opened(address, png(tmp_path, shade)) for shade in (90, 91))
        assert post(address, "/api/sessions", recorded(used))[0] == 200
    pictures = sessions.pictures
    pictures.sweep(sessions.needs)
    assert pictures.find(unused.digest[:16]) is not None  # not at once: its page may come back
    pictures.sweep(sessions.needs, time.time() + KEPT_UNUSED + 60)
    assert pictures.find(unused.digest[:16]) is None
    assert pictures.find(used.digest[:16]) is not None
    assert len(list(pictures.folder.iterdir())) == 2  # the picture and its record
    assert Pictures(pictures.folder).find("../../../etc/pas") is None


def test_a_scene_that_was_dropped_from_memory_is_opened_again(tmp_path, monkeypatch):
    monkeypatch.setattr("echospline.viewer.room.UPLOADED_SCENES", 1)
    with running(tmp_path, opener=picture_scene) as (address, _, app):
        first, second = (opened(address, png(tmp_path, shade)) for shade in (90, 91))
        assert list(app.state.room.opened) == [second.digest]
        assert post(address, "/api/sessions", recorded(first))[1]["verified"]
        assert list(app.state.room.opened) == [first.digest]


def test_only_so_many_pictures_without_a_session_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr("echospline.viewer.routes.UNUSED_PICTURES", 2)
    with running(tmp_path, opener=picture_scene) as (address, sessions, _):
        used = opened(address, png(tmp_path, 80))
        assert post(address, "/api/sessions", recorded(used))[0] == 200
        packs = [opened(address, png(tmp_path, shade)) for shade in (90, 91, 92)]
        kept = [sessions.pictures.find(mine.digest[:16]) is not None for mine in (used, *packs)]
        assert kept == [True, False, True, True]


def test_the_same_file_in_two_sizes_is_two_scenes_of_one_file(tmp_path):
    with running(tmp_path, opener=picture_scene) as (address, sessions, _):
        one, two = (opened(address, png(tmp_path), size) for size in ("0.2", "0.4"))
        assert one.digest != two.digest
        assert opened(address, png(tmp_path)).digest == one.digest
        assert len(list(sessions.pictures.folder.glob("*.png"))) == 1
        sessions.pictures.drop(one.digest[:16])
        assert sessions.pictures.find(two.digest[:16]) is not None


def test_a_file_that_fails_takes_no_other_with_it(tmp_path):
    """The same file is opened twice at once, by two pages, and only one of them says its pixels' size."""
    waiting, go = threading.Event(), threading.Event()

    def opener(path, spacing):
        if spacing is None:
            raise InputError("fill it in")
        waiting.set()
        assert go.wait(20)
        return picture_scene(path, spacing)

    with running(tmp_path, opener=opener) as (address, sessions, _):
        answers = []
        good = threading.Thread(target=lambda: answers.append(upload(address, png(tmp_path), SEATS[0])[0]))
        good.start()
        assert waiting.wait(20)
        assert upload(address, png(tmp_path), SEATS[1], spacing="")[0] == 422
        go.set()
        good.join(20)
        assert answers == [200]
        assert len(list(sessions.pictures.folder.glob("*.png"))) == 1
