"""The tracker's word: its status, its silence, matrices that no tool can have, and tools in TDATA, QTDATA and QTRANS."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from echospline.errors import InputError
from echospline.openigtlink import (
    Link,
    LinkLimits,
    Message,
    Naming,
    Rates,
    Session,
    SessionOptions,
    Status,
    Transform,
)
from echospline.openigtlink.message import Request
from echospline.openigtlink.pose import QuaternionTransform, quaternion_of
from echospline.openigtlink.tools import QuaternionTrackingData, StartTracking, Tool, TrackingData
from echospline.openigtlink.transforms import Tracking, is_valid
from echospline.scene import TrackedNeedle, rigid_fault
from test_openigtlink_peers import example, free_port, peer, run, start, until
from test_openigtlink_session import GRID, PLANE, Console, make_stage, pose_at

__all__ = ["example", "peer"]  # fixtures
NAME = "NeedleTipToReference"
QUICK = SessionOptions(port=0, rates=Rates(image=100, mesh=0, status=50))


def turned(pose_depth: float) -> np.ndarray:
    return PLANE.tip_matrix(pose_at(pose_depth))


def status_text(console: Console, *words: str, error: str | None = None) -> str:
    """Wait for a STATUS with these words (and this error name); the tracker is silent meanwhile."""

    def wanted(message: Message) -> bool:
        content = message.content
        return (
            isinstance(content, Status)
            and all(word in content.text for word in words)
            and error in (None, content.error)
        )

    content = console.wait(wanted).content
    assert isinstance(content, Status)
    return content.text


def streamed(console: Console, message: Message, *words: str, error: str | None = None) -> str:
    """Send a message 30 times a second, as a tracker does, until STATUS has these words (and this error name)."""
    over = threading.Event()

    def send() -> None:
        while not over.is_set():
            console.send(message)
            over.wait(1 / 30)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        return status_text(console, *words, error=error)
    finally:
        over.set()
        thread.join()


def word_on(depth: float, status: str) -> Message:
    return Message(Transform(turned(depth)), NAME, version=2, metadata={"TransformStatus": status})


def tip_of(session: Session) -> tuple[float, float]:
    newest = session.engine.snapshots.latest()
    assert newest is not None
    return newest.value.pose.tip


def goal_of(session: Session) -> tuple[float, float]:
    newest = session.engine.snapshots.latest()
    assert newest is not None
    return newest.value.command.tip


# --- status


@pytest.mark.parametrize(
    "word", ["INVALID", "MISSING", "OUT_OF_VIEW", "TOOL_OUT_OF_VOLUME", "REQ_TIMEOUT", "?"]
)
def test_a_transform_that_is_not_ok_holds_the_needle_and_status_says_so(word: str) -> None:
    with Session(make_stage(), QUICK) as session:
        console = Console(session.port)
        streamed(console, word_on(9.0, "OK"), "depth 9.0 mm", "echo 100 %", error="")
        lost = Message(Transform(np.eye(4)), NAME, version=2, metadata={"TransformStatus": word})
        said = streamed(console, lost, f"{NAME} is {word}", "stays where it was", error="Invalid")
        assert "echo" not in said
        time.sleep(0.1)
        streamed(console, lost, f"{NAME} is {word}", error="Invalid")
        assert goal_of(session) == pytest.approx(pose_at(9.0).tip)
        assert tip_of(session) == pytest.approx(pose_at(9.0).tip, abs=0.05)
        streamed(console, word_on(6.0, "OK"), "depth 6.0 mm", "echo", error="")
        console.close()


def test_a_tool_that_was_never_seen_moves_nothing() -> None:
    with Session(make_stage(), QUICK) as session:
        console = Console(session.port)
        streamed(
            console, word_on(9.0, "MISSING"), f"{NAME} is MISSING", "no tracked needle yet", error="Invalid"
        )
        assert tip_of(session) == (16.0, 0.0)
        console.close()


def test_pressed_switches_and_no_word_are_valid() -> None:
    assert all(is_valid(word) for word in ("", "OK", "ok ", "TOOL_OK", "SWITCH1_IS_ON", "TOOL_SWITCH3_IS_ON"))
    assert not any(
        is_valid(word) for word in ("INVALID", "MISSING", "UNKNOWN", "OUT_OF_VIEW", "SWITCH", "no")
    )


def test_pyigtl_status_in_metadata_is_heard() -> None:
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl, the second peer, is not installed")
    with Session(make_stage(), QUICK) as session:
        console = Console(session.port)
        streamed(console, word_on(8.0, "OK"), "depth 8.0 mm", error="")
        theirs = pyigtl.TransformMessage(turned(2.0), device_name=NAME, timestamp=1.0)
        theirs.header_version, theirs.metadata = 2, {"TransformStatus": "INVALID"}
        console._socket.sendall(theirs.pack())
        status_text(console, f"{NAME} is INVALID", "depth 8.0 mm", error="Invalid")
        console.close()


def test_the_needle_holds_while_another_transform_of_its_chain_goes_on() -> None:
    """A lost needle does not follow the patient's reference, which is still tracked."""
    tracking = Tracking(GRID, Naming())
    tracking.put("NeedleTipToTracker", turned(9.0), now=0.0)
    tracking.put("ReferenceToTracker", np.eye(4), now=0.0)
    held = tracking.locate(0.0).needle
    assert held is not None
    tracking.put("NeedleTipToTracker", turned(1.0), "MISSING", now=0.1)
    moved = np.eye(4)
    moved[:3, 3] = (5.0, 0.0, 0.0)
    tracking.put("ReferenceToTracker", moved, now=0.1)
    assert tracking.locate(0.1).needle == held
    assert tracking.locate(0.1).held


# --- silence


def test_silence_is_stale_said_once_in_the_log_and_said_again_when_it_ends(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "echospline.openigtlink")
    told: list[str] = []
    with Session(make_stage(), QUICK, tracked=told.append) as session:
        console = Console(session.port)
        message = Message(Transform(turned(9.0)), NAME)
        streamed(console, message, "depth 9.0", "echo 100 %", error="")
        said = status_text(console, f"stale: {NAME} has been silent for 1.", "depth 9.0", error="Stale")
        assert "echo" not in said
        assert tip_of(session) == pytest.approx(pose_at(9.0).tip, abs=0.01)
        streamed(console, message, "echo 100 %", error="")
        console.close()
    lines = [record.message for record in caplog.records]
    assert sum("stale" in line for line in lines) == 1
    assert sum("tracking is back" in line for line in lines) == 1
    assert len(told) == 2
    assert "silent" in told[0]
    assert told[1] == ""


def test_what_counts_as_silent_is_an_option() -> None:
    tracking = Tracking(GRID, Naming(), silence=2.0)
    tracking.put(NAME, turned(9.0), now=0.0)
    assert tracking.locate(1.9).fault == ""
    assert tracking.locate(2.1).fault == "Stale"
    with pytest.raises(InputError, match="silence"):
        SessionOptions(silence=0.0)


def test_a_setting_that_came_once_is_not_silent_while_the_tracker_goes_on() -> None:
    tracking = Tracking(GRID, Naming())
    tracking.put("NeedleTipToNeedle", np.eye(4), now=0.0)
    for k in range(100):
        tracking.put("NeedleToReference", turned(9.0), now=0.1 * k)
        assert tracking.locate(0.1 * k).fault == ""
    assert tracking.locate(10.6).about == "NeedleToReference"


# --- matrices


def scaled(m: np.ndarray) -> np.ndarray:
    out = m.copy()
    out[:3, :3] *= 1000.0
    return out


def mirrored(m: np.ndarray) -> np.ndarray:
    return m @ np.diag([1.0, 1.0, -1.0, 1.0])


def zeroed(m: np.ndarray) -> np.ndarray:
    out = m.copy()
    out[:3, :3] = 0.0
    return out


def skewed(m: np.ndarray) -> np.ndarray:
    out = m.copy()
    out[:3, 0] = (out[:3, 0] + out[:3, 1]) / np.sqrt(2)
    return out


def in_metres(m: np.ndarray) -> np.ndarray:
    out = m.copy()
    out[:3, 3] /= 1000.0
    return out


def in_micrometres(m: np.ndarray) -> np.ndarray:
    out = m.copy()
    out[:3, 3] = (2e4, 3e4, 0.0)
    return out


BAD = [
    (scaled, "no scale"),
    (mirrored, "mirrored"),
    (zeroed, "not seen"),
    (skewed, "perpendicular"),
    (in_micrometres, "are these micrometres"),
]


@pytest.mark.parametrize(("spoil", "reason"), BAD, ids=[f.__name__ for f, _ in BAD])
def test_a_matrix_that_no_tool_has_is_refused_once_and_the_stream_goes_on(
    spoil: Callable[[np.ndarray], np.ndarray], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    with Session(make_stage(), QUICK) as session:
        console = Console(session.port)
        streamed(console, Message(Transform(turned(9.0)), NAME), "depth 9.0 mm", error="")
        for k in range(10):
            console.send(Message(Transform(spoil(turned(2.0 + k))), NAME))
        status_text(console, f"{NAME} is refused", reason, "stays where it was", error="Refused")
        assert goal_of(session) == pytest.approx(pose_at(9.0).tip)
        streamed(console, Message(Transform(turned(5.0)), NAME), "depth 5.0 mm", error="")
        console.close()
    warned = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert len([record for record in warned if reason in record.message]) == 1
    assert not any(record.exc_info for record in caplog.records)


@pytest.mark.parametrize(("name", "of"), [(NAME, 1.0), ("NeedleToTracker", 3.0)])
def test_metres_are_suspected_until_a_distance_says_millimetres(name: str, of: float) -> None:
    tracking = Tracking(GRID, Naming())
    with pytest.raises(InputError, match="are these metres"):
        tracking.put(name, in_metres(turned(9.0)))
    tracking.put(name, in_metres(turned(9.5)))  # said once
    far, near = np.eye(4), np.eye(4)
    far[0, 3], near[0, 3] = 1.1 * of, 0.1
    tracking.put(name, far)
    tracking.put(name, near)  # mm by now
    np.testing.assert_array_equal(tracking.received.known()[name], near)
    Tracking(GRID, Naming()).put(name, np.eye(4))  # exactly at the origin: a default, not a unit


def test_the_images_own_transform_may_hold_its_spacing() -> None:
    tracking = Tracking(GRID, Naming())
    tracking.put("ImageToReference", PLANE.image_matrix(GRID))
    tracking.put("ImageToProbe", np.diag([0.5, 0.5, -0.5, 1.0]))
    tracking.put(NAME, turned(9.0))
    assert tracking.locate().trouble == ""


def test_a_calibration_that_scales_the_needle_is_said_and_nothing_is_raised() -> None:
    tracking = Tracking(GRID, Naming(calibration={"NeedleTipToNeedle": np.diag([0.0, 0.0, 0.0, 1.0])}))
    tracking.put("NeedleToReference", turned(9.0), now=0.0)
    located = tracking.locate(0.0)
    assert located.fault == "Refused"
    assert "NeedleTipToNeedle" in located.trouble
    assert located.needle is None


@settings(max_examples=300)
@given(
    arrays(np.float64, (4, 4), elements=st.floats(width=64)),
    st.sampled_from([NAME, "NeedleToTracker", "ReferenceToTracker", "ImageToReference", "a", "AToB"]),
    st.sampled_from(["", "OK", "INVALID", "\0"]),
    st.booleans(),
)
def test_no_transform_raises_anything_but_input_errors_or_moves_the_needle_to_nowhere(
    matrix: np.ndarray, name: str, status: str, affine: bool
) -> None:
    tracking = Tracking(GRID, Naming())
    tracking.put(NAME, turned(9.0))
    if affine:
        matrix[3] = (0, 0, 0, 1)
    with contextlib.suppress(InputError):
        tracking.put(name, matrix, status)
    needle = tracking.locate().needle
    assert isinstance(needle, TrackedNeedle)
    assert np.isfinite(needle.tip).all()
    assert np.linalg.norm(needle.direction) == pytest.approx(1.0)


@given(arrays(np.float64, (3, 3), elements=st.floats(-3, 3)))
def test_rigid_is_what_the_singular_values_call_rigid(axes: np.ndarray) -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    stretches = np.linalg.svd(axes, compute_uv=False)
    if rigid_fault(matrix)[0] == "":
        assert np.abs(stretches - 1.0).max() < 0.06
        assert np.linalg.det(axes) > 0
    else:
        assert np.abs(stretches - 1.0).max() > 0.002 or np.linalg.det(axes) < 0


# --- TDATA, QTDATA, QTRANS


def moving(kind: str, matrix: np.ndarray) -> Message:
    """The needle's pose as a tracker sends it in each of the three types."""
    if kind == "QTRANS":
        x, y, z = (float(v) for v in matrix[:3, 3])
        return Message(QuaternionTransform((x, y, z), quaternion_of(matrix)), NAME)
    tools = (Tool("Pointer", np.full((4, 4), np.nan)), Tool(NAME, matrix))
    return Message(TrackingData(tools) if kind == "TDATA" else QuaternionTrackingData(tools), "NDI")


@pytest.mark.parametrize("kind", ["TDATA", "QTDATA", "QTRANS"])
def test_the_needle_follows_every_type_that_trackers_send(kind: str) -> None:
    """A tool beside it that is out of sight does not keep it from doing so."""
    with Session(make_stage(), QUICK) as session:
        console = Console(session.port)
        console.send(moving(kind, turned(0.5)))
        streamed(console, moving(kind, turned(9.0)), "depth 9.0 mm", error="")
        assert goal_of(session) == pytest.approx(pose_at(9.0).tip, abs=1e-4)
        console.close()


def test_a_tool_alone_is_in_the_frame_of_its_tracker() -> None:
    with Session(make_stage(), QUICK) as session:
        console = Console(session.port)
        away = np.eye(4)
        away[:3, 3] = (100.0, 50.0, -900.0)
        tools = (Tool("Reference", away), Tool("NeedleTip", away @ turned(9.0)))
        streamed(console, Message(TrackingData(tools), "NDI"), "depth 9.0 mm", error="")
        console.close()


@pytest.mark.parametrize("kind", ["TDATA", "QTDATA", "QTRANS", "POSITION"])
def test_a_stream_starts_when_it_is_asked_for_and_stops_when_it_is_told(kind: str) -> None:
    with Session(make_stage(), QUICK) as session:
        console = Console(session.port)
        console.tip(pose_at(9.0))
        seen: list[str] = []

        def note(message: Message) -> bool:
            seen.append(message.type)
            return isinstance(message.content, Status) and "depth 9.0" in message.content.text

        console.wait(note)
        assert kind not in seen
        console.send(
            Message(Request(f"STT_{kind}", StartTracking(20).pack() if "DATA" in kind else b""), "me")
        )
        answer = console.wait(lambda m: m.type == f"RTS_{kind}")
        assert isinstance(answer.content, Request)
        assert answer.content.body == b"\0"
        message = console.wait(lambda m: m.type == kind)
        content = message.content
        if isinstance(content, TrackingData | QuaternionTrackingData):
            (tool,) = content.tools
            assert tool.name == "NeedleTip"
            matrix = tool.matrix
        else:
            matrix = content.matrix()  # type: ignore[attr-defined]
        np.testing.assert_allclose(matrix, turned(9.0), atol=1e-4)
        console.send(Message(Request(f"STP_{kind}"), "me"))
        console.wait(lambda m: m.type == f"RTS_{kind}")
        seen.clear()
        for _ in range(5):
            console.wait(lambda m: seen.append(m.type) or m.type == "IMAGE")  # type: ignore[func-returns-value]
        assert kind not in seen
        console.send(Message(Request(f"STT_{kind}", b"odd" if "DATA" in kind else b""), "me"))
        answer = console.wait(lambda m: m.type == f"RTS_{kind}")
        assert isinstance(answer.content, Request)
        assert answer.content.body == (b"\1" if "DATA" in kind else b"\0")
        console.close()


def test_the_shortest_time_between_two_messages_is_kept() -> None:
    with Session(make_stage(), QUICK) as session:  # 100 pictures a second
        console = Console(session.port)
        console.send(Message(Request("STT_TDATA", StartTracking(250).pack()), "me"))
        stamps = [console.wait(lambda m: m.type == "TDATA").timestamp for _ in range(4)]
        assert np.diff(stamps).min() > 0.2
        console.close()


async def lines(process: asyncio.subprocess.Process) -> list[dict[str, object]]:
    assert process.stdout is not None
    return [json.loads(line) async for line in process.stdout]


@pytest.mark.parametrize("kind", ["TDATA", "QTDATA"])
def test_the_c_library_starts_and_stops_our_stream(peer: Path, kind: str) -> None:
    async def scene() -> None:
        with Session(make_stage(), QUICK) as session:
            process = await start(peer, "follow", "127.0.0.1", session.port, kind, 3)
            got = await lines(process)
        assert [m for m in got if m["crc"] is not True] == []
        types = [m["type"] for m in got]
        assert types.count(kind) >= 3
        answers = [k for k, name in enumerate(types) if name == f"RTS_{kind}"]
        assert len(answers) == 2
        assert answers[0] < types.index(kind)
        assert answers[1] == len(types) - 1
        assert all(got[k]["status"] == 0 for k in answers)
        (tool,) = got[types.index(kind)]["tools"]  # type: ignore[misc]
        assert (tool["name"], tool["kind"]) == ("NeedleTip", 2)
        newest = make_stage().engine.snapshots.latest()
        assert newest is not None
        expected = PLANE.tip_matrix(newest.value.pose)
        if kind == "TDATA":
            np.testing.assert_allclose(tool["matrix"], expected, atol=1e-6)
        else:
            np.testing.assert_allclose(tool["position"], expected[:3, 3], atol=1e-6)
            np.testing.assert_allclose(tool["quaternion"], quaternion_of(expected), atol=1e-6)

    run(scene)


@pytest.mark.parametrize(
    ("program", "kind"),
    [
        ("TrackingData/TrackingDataServer.cxx", "TDATA"),
        ("QuaternionTrackingData/QuaternionTrackingDataServer.cxx", "QTDATA"),
    ],
)
def test_the_example_server_of_the_c_library_is_asked_and_streams(
    example: Callable[[str], Path], program: str, kind: str
) -> None:
    """It sends nothing before STT_."""
    inbox: list[Message] = []

    async def scene() -> None:
        there = free_port()
        process = await start(example(program), there)
        content = Request(f"STT_{kind}", StartTracking(20, "Tracker").pack())
        asking = Message(content, "echospline"), Message(Request(f"STP_{kind}"), "echospline")
        link = Link(lambda _, m: inbox.append(m), limits=LinkLimits(retry=0.05), asking=asking)
        link.connect("127.0.0.1", there)
        await until(lambda: len(inbox) >= 10)
        await link.close()
        process.kill()
        text = (await process.communicate())[1].decode()
        assert f"Received a STT_{kind} message" in text
        assert "Interval = 20 (ms)" in text
        contents = [m.content for m in inbox]
        assert all(isinstance(c, TrackingData | QuaternionTrackingData) for c in contents)
        for content in contents:
            for tool in content.tools:  # type: ignore[union-attr]
                assert np.isfinite(tool.matrix[:3, 3]).all()
                # the quaternions of this example have length 0.88, which is no rotation
                turns = kind == "TDATA"
                assert np.isfinite(tool.matrix[:3, :3]).all() == turns
                assert not turns or rigid_fault(tool.matrix)[0] == ""
        assert len(contents[0].tools) >= 3  # type: ignore[union-attr]

    run(scene)


def test_a_session_asks_the_servers_that_it_connects_to() -> None:
    asked: list[Message] = []

    async def scene() -> None:
        server = Link(lambda _, m: asked.append(m))
        server._take = lambda _, m: asked.append(m)  # type: ignore[method-assign]
        port = await server.serve("127.0.0.1", 0)
        options = SessionOptions(host="", connect=(("127.0.0.1", port),), ask="TDATA")

        def session() -> None:
            with Session(make_stage(), options) as one:
                until = time.monotonic() + 20
                while not asked and time.monotonic() < until:
                    one.wait(0.01)

        await asyncio.to_thread(session)
        await until(lambda: any(m.type == "STP_TDATA" for m in asked))
        await server.close()
        (first,) = (m for m in asked if m.type == "STT_TDATA")
        assert isinstance(first.content, Request)
        assert StartTracking.unpack(first.content.body) == StartTracking(5, "Tracker")  # 200 steps a second

    run(scene)
    with pytest.raises(InputError, match="stream is one of"):
        SessionOptions(ask="IMAGE")
