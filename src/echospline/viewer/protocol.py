"""Protocol of page and server, version 1: little-endian binary for commands and frames, small JSON for requests.

Page to server, every time a frame was drawn or the needle moved: a *command* of 36 bytes. Server to page,
only when an earlier frame was drawn: a *frame*, which is a header of 68 bytes, the positions of the watched
points, and the field: either the displacement of every mesh node (any model), or the landmarks and
weights of a spline, which the page evaluates where it draws (1.7 kB for 105 landmarks, whatever the mesh).
Everything else (reset, model, exercise) is a JSON *request* of at most 4096 bytes.

`static/protocol.js` is the same in JavaScript; tests compare both with the same golden bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from math import isfinite
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from echospline.errors import ProtocolError
from echospline.live import Snapshot

VERSION = 1
COMMAND, FRAME = 1, 2

FROZEN, REPLAYING, FAILED, HAS_REFERENCE, SPLINE, RECORDING = 1, 2, 4, 8, 16, 32
"""Flags of a frame."""
HAS_POSE = 1
"""Flag of a command: it moves the needle, and does not only report what was drawn."""

_COMMAND = struct.Struct("<BBHIIdffff")
_FRAME = struct.Struct("<BBHIIIddffffffffHH")
COMMAND_BYTES, FRAME_HEADER_BYTES = _COMMAND.size, _FRAME.size
REQUEST_BYTES = 4096
"""Longest JSON request."""

MAX_LENGTH = 1000.0
"""mm; no coordinate or depth of a command lies beyond it."""


@dataclass(frozen=True, slots=True)
class PoseCommand:
    """Report of the page after drawing a frame or moving the needle.

    Parameters
    ----------
    drawn : int
        Number of the newest frame that was drawn, 0 before the first.
    number : int
        Of this command, ascending.
    sent : float
        The page's clock, ms; returned in the frame that shows the command.
    pose : (entry x, entry y, angle, depth) or None
        mm, mm, degrees from +x towards depth, mm; None for a report only.
    """

    drawn: int
    number: int
    sent: float
    pose: tuple[float, float, float, float] | None


def encode_command(command: PoseCommand) -> bytes:
    """Encode a command (the page's side; used by tests and the load benchmark)."""
    flags, pose = (0, (0.0, 0.0, 0.0, 0.0)) if command.pose is None else (HAS_POSE, command.pose)
    return _COMMAND.pack(VERSION, COMMAND, flags, command.drawn, command.number, command.sent, *pose)


def decode_command(data: bytes) -> PoseCommand:
    """Read a command.

    Raises
    ------
    ProtocolError
        If length, version, kind, flags or a number is invalid.
    """
    if len(data) != COMMAND_BYTES:
        raise ProtocolError(f"a command has {COMMAND_BYTES} bytes; got {len(data)}")
    version, kind, flags, drawn, number, sent, *pose = _COMMAND.unpack(data)
    if version != VERSION:
        raise ProtocolError(f"this server speaks protocol version {VERSION}; got {version}: reload the page")
    if kind != COMMAND or flags & ~HAS_POSE:
        raise ProtocolError(f"a command has kind {COMMAND} and flags 0 or 1; got {kind} and {flags}")
    if not isfinite(sent) or not all(isfinite(v) and abs(v) <= MAX_LENGTH for v in pose):
        raise ProtocolError(f"a pose must be finite and within {MAX_LENGTH:g} mm; got {tuple(pose)}")
    if pose[3] < 0:
        raise ProtocolError(f"a depth must be zero or more; got {pose[3]:g} mm")
    x, y, angle, depth = pose
    return PoseCommand(drawn, number, sent, (x, y, angle, depth) if flags else None)


class SplineLike(Protocol):
    """The part of a fitted spline that is sent, in conditioned coordinates (x - centre) / scale."""

    kernel: Any
    landmarks: NDArray[np.float64]
    weights: NDArray[np.float64]
    motion: NDArray[np.float64]
    centre: NDArray[np.float64]
    scale: float


def encode_frame(snapshot: Snapshot, number: int, *, recording: bool = False, nodes: bool = False) -> bytes:
    """Encode a frame.

    Parameters
    ----------
    snapshot : Snapshot
        The scene.
    number : int
        Of the frame, ascending from 1 for each client.
    recording : bool
        Whether an exercise is being recorded.
    nodes : bool
        Send node displacements even where the model offers a spline; where two models are compared this is
        always so.
    """
    reference = snapshot.reference
    largest = _largest(snapshot.displacement)
    difference = 0.0 if reference is None else _largest(snapshot.displacement - reference)
    flags = (
        FROZEN * snapshot.frozen
        | REPLAYING * snapshot.replaying
        | FAILED * (snapshot.failure is not None)
        | HAS_REFERENCE * (reference is not None)
        | SPLINE * (snapshot.spline is not None and reference is None and not nodes)
        | RECORDING * recording
    )
    if snapshot.spline is not None and flags & SPLINE:
        count, field = _spline_bytes(snapshot.spline())
    else:
        count, field = len(snapshot.displacement), snapshot.displacement.astype("<f4").tobytes()
        if reference is not None:
            field += reference.astype("<f4").tobytes()
    pose, command = snapshot.pose, snapshot.command
    header = _FRAME.pack(
        VERSION, FRAME, flags, number, command.number, count, command.sent, snapshot.time,
        *pose.entry, *pose.tip, pose.speed, 1e3 * snapshot.duration, largest, difference,
        len(snapshot.watched), 0,
    )  # fmt: skip
    return header + snapshot.watched.astype("<f4").tobytes() + field


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame as the page reads it (for tests and the load benchmark); fields as in `encode_frame`."""

    number: int
    flags: int
    command: int
    sent: float
    time: float
    entry: tuple[float, float]
    tip: tuple[float, float]
    speed: float
    duration: float
    largest: float
    difference: float
    watched: NDArray[np.float32]
    displacement: NDArray[np.float32] | None
    reference: NDArray[np.float32] | None
    spline: NDArray[np.float32] | None


def decode_frame(data: bytes) -> Frame:
    """Read a frame.

    Raises
    ------
    ProtocolError
        If it is not a whole frame of this version.
    """
    if len(data) < FRAME_HEADER_BYTES or data[0] != VERSION or data[1] != FRAME:
        raise ProtocolError(
            f"a frame begins with {VERSION}, {FRAME} and has {FRAME_HEADER_BYTES} bytes or more"
        )
    _, _, flags, number, command, count, sent, time, *floats, k, _ = _FRAME.unpack_from(data)
    ex, ey, tx, ty, speed, duration, largest, difference = floats
    per_item = 4 if flags & SPLINE else 4 if flags & HAS_REFERENCE else 2
    head = SPLINE_HEAD if flags & SPLINE else 0
    expected = FRAME_HEADER_BYTES + 4 * (2 * k + head + per_item * count)
    if len(data) != expected:
        raise ProtocolError(f"this frame must have {expected} bytes; got {len(data)}")
    values = np.frombuffer(data, "<f4", offset=FRAME_HEADER_BYTES)
    watched, field = values[: 2 * k].reshape(k, 2), values[2 * k :]
    nodes = None if flags & SPLINE else field[: 2 * count].reshape(count, 2)
    reference = field[2 * count :].reshape(count, 2) if flags & HAS_REFERENCE else None
    return Frame(
        number, flags, command, sent, time, (ex, ey), (tx, ty), speed, duration / 1e3, largest, difference,
        watched, nodes, reference, field if flags & SPLINE else None,
    )  # fmt: skip


SPLINE_HEAD = 12
"""float32 values before the landmarks: components, coupling, radius, centre x y, scale, motion 6."""


def _spline_bytes(spline: Any) -> tuple[int, bytes]:
    """Return the number of landmarks and their bytes: head, then (x, y, weight x, weight y) per landmark, all in conditioned coordinates."""
    head = np.zeros(SPLINE_HEAD)
    if spline is None:  # nothing is displaced
        head[[0, 5]] = 1.0
        return 0, head.astype("<f4").tobytes()
    field: SplineLike = spline
    m, c, kernel = len(field.landmarks), field.kernel.components, field.kernel
    shape = getattr(kernel, "coupling", 0.0), getattr(kernel, "radius", 0.0)
    head[:6] = (c, *shape, *field.centre, field.scale)
    head[6 : 6 + field.motion.size] = field.motion.ravel()
    rows = np.empty((m, 4))
    rows[:, :2] = (field.landmarks - field.centre) / field.scale
    rows[:, 2:] = field.weights if c == 1 else field.weights.reshape(2, m).T
    return m, np.concatenate([head, rows.ravel()]).astype("<f4").tobytes()


def _largest(displacement: NDArray[np.float64]) -> float:
    if len(displacement) == 0:
        return 0.0
    return float(np.sqrt((displacement * displacement).sum(axis=1).max()))


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Reset(_Request):
    """Take the needle out and the tissue to rest."""

    do: Literal["reset"]


class Freeze(_Request):
    """Stop model time, or let it run."""

    do: Literal["freeze"]
    on: bool


class SwitchModel(_Request):
    """Change the model and keep the pose."""

    do: Literal["model"]
    name: str = Field(max_length=40)


class Compare(_Request):
    """Step a second model with the first; null stops it."""

    do: Literal["compare"]
    name: str | None = Field(max_length=40)


class StartExercise(_Request):
    """Reset, place the targets and record."""

    do: Literal["start"]
    exercise: str = Field(max_length=80)
    trainee: str = Field(default="", max_length=80)


class FinishExercise(_Request):
    """End the recording; ``keep`` scores and stores it."""

    do: Literal["finish"]
    keep: bool = True


class Replay(_Request):
    """Show a stored session again."""

    do: Literal["replay"]
    session: int = Field(ge=1, le=2**53)


Request = Annotated[
    Reset | Freeze | SwitchModel | Compare | StartExercise | FinishExercise | Replay,
    Field(discriminator="do"),
]
_REQUESTS: TypeAdapter[Request] = TypeAdapter(Request)


def decode_request(text: str) -> Request:
    """Read a JSON request.

    Raises
    ------
    ProtocolError
        If it is too long, no JSON or none of the requests.
    """
    if len(text.encode("utf-8", "surrogatepass")) > REQUEST_BYTES:
        raise ProtocolError(f"a request has at most {REQUEST_BYTES} bytes; got {len(text)}")
    try:
        return _REQUESTS.validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "request"
        raise ProtocolError(f"not a request: {where}: {first['msg']}") from error
