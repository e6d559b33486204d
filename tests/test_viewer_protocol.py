"""The wire: golden bytes shared with the page, and what is refused."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echospline.errors import ProtocolError
from echospline.live import Command, LiveEngine, Snapshot
from echospline.mechanics import Elastic, ThinPlate
from echospline.mechanics.spline import factor
from echospline.scene import NeedlePose
from echospline.viewer import served_scene
from echospline.viewer.protocol import (
    COMMAND_BYTES,
    FRAME_HEADER_BYTES,
    SPLINE_HEAD,
    PoseCommand,
    decode_command,
    decode_frame,
    decode_request,
    encode_command,
    encode_frame,
)
from echospline.viewer.served_scene import PAGE_LOOK
from live_scene import MESH, models, scene

GOLDEN = json.loads((Path(__file__).parent / "golden" / "viewer.json").read_text())
SNAPSHOT = Snapshot(
    step=5,
    time=2.5,
    pose=NeedlePose((12.5, 0.0), (20.0, 10.0), -3.5),
    displacement=np.array([[0.0, 0.0], [0.0, 1.5]]),
    model="soft",
    command=Command((0.0, 0.0), (0.0, 0.0), 41, 1234.5),
    duration=0.00025,
    watched=np.empty((0, 2)),
)


@dataclass
class StoredSpline:
    kernel: object
    landmarks: np.ndarray
    weights: np.ndarray
    motion: np.ndarray
    centre: np.ndarray
    scale: float


ELASTIC = Elastic(nu=0.45, radius=0.125)
SPLINE = StoredSpline(
    ELASTIC,
    landmarks=np.array([[0.0, 25.0], [40.0, 5.0]]),
    weights=np.array([[0.25], [-0.25], [-0.125], [2.0]]),
    motion=np.array([[0.5], [-0.5], [0.25]]),
    centre=np.array([20.0, 15.0]),
    scale=20.0,
)


def golden(what):
    return [(entry["fields"], bytes.fromhex(entry["hex"])) for entry in GOLDEN if entry["what"] == what]


@pytest.mark.parametrize(("fields", "data"), golden("command"))
def test_commands_have_the_golden_bytes(fields, data):
    pose = fields["pose"] and tuple(fields["pose"])
    command = PoseCommand(fields["drawn"], fields["number"], fields["sent"], pose)
    assert encode_command(command) == data
    assert decode_command(data) == command


def test_frames_have_the_golden_bytes():
    plain, compared, spline = (data for _, data in golden("frame"))
    watched = replace(SNAPSHOT, frozen=True, watched=np.array([[5.0, 6.0]]))
    assert encode_frame(watched, 9) == plain
    reference = np.array([[0.0, 0.0], [0.0, 1.0]])
    assert encode_frame(replace(SNAPSHOT, reference=reference), 9) == compared
    offered = replace(SNAPSHOT, spline=lambda: SPLINE)
    sent = bytearray(encode_frame(offered, 9, recording=True))
    assert struct.unpack_from("<f", sent, FRAME_HEADER_BYTES + 4)[0] == pytest.approx(ELASTIC.coupling)
    struct.pack_into("<f", sent, FRAME_HEADER_BYTES + 4, 0.75)  # the golden file's coupling is a plain number
    assert bytes(sent) == spline


@pytest.mark.parametrize(("fields", "data"), golden("frame"))
def test_frames_are_read_from_the_golden_bytes(fields, data):
    frame = decode_frame(data)
    assert (frame.number, frame.command, frame.flags) == (9, 41, fields["flags"])
    assert (frame.entry, frame.tip) == (tuple(fields["entry"]), tuple(fields["tip"]))
    for name in ("watched", "displacement", "reference", "spline"):
        got, expected = getattr(frame, name), fields[name]
        assert (got is None) == (expected is None)
        if expected is not None:
            np.testing.assert_array_equal(got.ravel(), np.float32(expected))


@pytest.mark.parametrize("kernel", [ThinPlate(), ELASTIC], ids=["thin plate", "elastic"])
def test_a_spline_on_the_wire_is_the_same_field(kernel):
    """What the page's formula makes of the bytes, in float32, against the spline in float64."""
    rng = np.random.default_rng(2)
    landmarks = rng.uniform(0, 40, (30, 2))
    spline = factor(kernel, landmarks).solve(rng.normal(size=(30, 2)))
    wire = decode_frame(encode_frame(replace(SNAPSHOT, spline=lambda: spline), 1)).spline
    head, rows = wire[:SPLINE_HEAD], wire[SPLINE_HEAD:].reshape(-1, 4)
    components, coupling, radius, cx, cy, scale, *m = head
    points = rng.uniform(0, 40, (50, 2))
    x = ((points - (cx, cy)) / scale).astype(np.float32)
    d = x[:, None] - rows[None, :, :2]
    r2 = (d**2).sum(axis=2)
    if components == 1:
        u = np.array(m[:2]) + np.outer(x[:, 0], m[2:4]) + np.outer(x[:, 1], m[4:6])
        u = u + (r2 * np.log(np.where(r2 > 0, r2, 1))) @ rows[:, 2:]
    else:
        s = r2 + radius**2
        same = -(4 - 2 * coupling) * (np.log(s) + 1) - 4 * r2 / s
        along = 4 * coupling * (d * rows[None, :, 2:]).sum(axis=2) / s
        u = np.stack([m[0] - m[2] * x[:, 1], m[1] + m[2] * x[:, 0]], axis=1)
        u = u + same @ rows[:, 2:] + (along[:, :, None] * d).sum(axis=1)
    np.testing.assert_allclose(u, spline(points), atol=2e-4)


def test_a_frame_of_nodes_is_rounded_to_float32_and_no_further():
    live = LiveEngine(models, "soft", NeedlePose((20.0, 0.0), (20.0, 0.0)), lag=0.0, fastest=1e9)
    live.command((20.0, 0.0), (21.0, 9.0))
    snapshot = live.step()
    frame = decode_frame(encode_frame(snapshot, 3))
    np.testing.assert_array_equal(frame.displacement, snapshot.displacement.astype(np.float32))
    assert len(frame.displacement) == MESH.size
    assert frame.largest == pytest.approx(np.hypot(*snapshot.displacement.T).max(), rel=1e-6)


# --- what is refused


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda b: b[:-1], "36 bytes"),
        (lambda b: b + b"\0", "36 bytes"),
        (lambda b: b"", "36 bytes"),
        (lambda b: b"\x02" + b[1:], "version 1"),
        (lambda b: b[:1] + b"\x02" + b[2:], "kind"),
        (lambda b: b[:2] + b"\xff\xff" + b[4:], "flags"),
        (lambda b: b[:20] + struct.pack("<f", np.nan) + b[24:], "finite"),
        (lambda b: b[:28] + struct.pack("<f", np.inf) + b[32:], "finite"),
        (lambda b: b[:24] + struct.pack("<f", -np.inf) + b[28:], "finite"),
        (lambda b: b[:20] + struct.pack("<f", 1e30) + b[24:], "within"),
        (lambda b: b[:12] + struct.pack("<d", np.nan) + b[20:], "finite"),
        (lambda b: b[:32] + struct.pack("<f", -1.0) + b[36:], "depth"),
    ],
)
def test_a_malformed_command_is_refused_with_a_reason(change, match):
    with pytest.raises(ProtocolError, match=match):
        decode_command(change(golden("command")[0][1]))


@given(st.binary(max_size=80))
def test_any_bytes_are_a_command_or_refused(data):
    try:
        command = decode_command(data)
    except ProtocolError:
        return
    assert len(data) == COMMAND_BYTES
    assert command.pose is None or np.isfinite(command.pose).all()


@given(st.binary(min_size=FRAME_HEADER_BYTES, max_size=200))
def test_any_bytes_are_a_frame_or_refused_without_allocating(data):
    with pytest.raises(ProtocolError):
        decode_frame(b"\x01\x02\x00\x00" + data[4:12] + b"\xff\xff\xff\x7f" + data[16:])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no json",
        "[]",
        "null",
        "{}",
        '{"do": "shutdown"}',
        '{"do": "freeze"}',
        '{"do": "freeze", "on": "yes"}',
        '{"do": "freeze", "on": true, "more": 1}',
        '{"do": "model", "name": 7}',
        '{"do": "model", "name": "' + "x" * 41 + '"}',
        '{"do": "replay", "session": -1}',
        '{"do": "replay", "session": 1e300}',
        '{"do": "reset", "x": "' + "y" * 5000 + '"}',
        "[" * 3000,
        '{"do": "start", "exercise": "a", "trainee": "' + "\\ud800" * 100 + '"}',
    ],
)
def test_a_malformed_request_is_refused(text):
    with pytest.raises(ProtocolError):
        decode_request(text)


def test_requests_are_read():
    assert decode_request('{"do": "compare", "name": null}').name is None
    assert decode_request('{"do": "start", "exercise": "a"}').trainee == ""
    assert decode_request('{"do": "finish"}').keep is True


def test_the_page_gets_every_number_of_the_needle_that_its_renderer_reads():
    static = Path(served_scene.__file__).parent / "static"
    read = set(re.findall(r"\becho\??\.(\w+)", (static / "renderer.js").read_text()))
    assert read == {*PAGE_LOOK, "diameter", "apex"}
    assert set(scene().describe()["needle"]["echo"]) == read
