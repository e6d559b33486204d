"""Sessions as a page exports them: one JSON, read by models that refuse whatever is no session."""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from echospline.errors import InputError
from echospline.page.exercise import Exercise
from echospline.scene import Floats

LARGEST = 256 * 2**20
"""Bytes of a file."""
MOST_STEPS = 1_800_000
"""Half an hour at a thousand steps a second."""
MOST_SESSIONS, MOST_EVENTS = 10_000, 10_000
PLACES = 1e6
"""mm, mm/s; no needle is further away or faster."""

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Text = Annotated[str, Field(max_length=200)]


class Table(BaseModel):
    """A table of a session; unknown keys and numbers that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SceneName(Table):
    """The scene of a session: its title and the SHA-256 of its pack."""

    title: Text
    pack: Digest


class RecordedSession(Table):
    """One recorded exercise: what the hand did at every step of the engine, and the page's score of it."""

    format: Literal[1]
    kind: Literal["echospline session"]
    version: Annotated[str, Field(min_length=1, max_length=40)]
    core: Digest
    scene: SceneName
    model: Annotated[str, Field(min_length=1, max_length=40)]
    exercise: Exercise
    examination: bool = False
    trainee: Annotated[str, Field(max_length=80)]
    attempt: int = Field(ge=0, le=1_000_000)
    started: Annotated[str, Field(max_length=40)]
    rate: float = Field(ge=10, le=2000)
    ended: Literal["finished", "reset", "time"]
    steps: int = Field(ge=0, le=MOST_STEPS)
    poses: str
    planes: str | None = None
    events: list[tuple[Annotated[int, Field(ge=0, le=MOST_STEPS)], Annotated[str, Field(max_length=40)]]] = (
        Field([], max_length=MOST_EVENTS)
    )
    score: dict[Annotated[str, Field(max_length=40)], bool | int | float | None] | None = None

    @field_validator("started")
    @classmethod
    def _is_a_time(cls, text: str) -> str:
        try:
            datetime.fromisoformat(text)
        except ValueError:
            raise ValueError("expected a time as ISO 8601 has it") from None
        return text

    @property
    def when(self) -> str:
        """Start in UTC, ISO 8601, whole seconds."""
        at = datetime.fromisoformat(self.started)
        at = at.replace(tzinfo=UTC) if at.tzinfo is None else at.astimezone(UTC)
        return at.isoformat(timespec="seconds")

    @cached_property
    def digest(self) -> str:
        """SHA-256 of what was recorded, which names this session wherever it is stored; the score is left out.

        Values that nobody set are left out too, so that a version that knows more of them gives the same name, and the start is
        that of `when`, so that a session that was stored and exported again is the same one.
        """
        told = {
            **self.model_dump(mode="json", exclude={"score"}, exclude_defaults=True),
            "started": self.when,
        }
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()

    def rows(self, dimension: int) -> Floats:
        """Return the poses, shape (steps, 2 D + 1): entry, tip (mm), speed (mm/s).

        Raises
        ------
        InputError
            If they have another length, or a number is not finite or beyond all needles.
        """
        return _numbers(self.poses, self.steps, 2 * dimension + 1, "poses")

    def plane_rows(self) -> Floats:
        """Return where the probe was: rows of step, x, y, z (mm), yaw, pitch, roll (degrees), shape (k, 7).

        Raises
        ------
        InputError
            If the rows are damaged, or their steps do not ascend from 0.
        """
        rows = _numbers(self.planes or "", None, 7, "planes")
        steps = rows[:, 0]
        if (
            (steps != np.floor(steps)).any()
            or (np.diff(steps) <= 0).any()
            or (steps < 0).any()
            or (len(steps) and steps[0] != 0)
        ):
            raise InputError("planes of a session begin at step 0 and ascend by whole steps")
        return rows


def _numbers(text: str, rows: int | None, columns: int, what: str) -> Floats:
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise InputError(f"{what} of a session are not base64") from None
    size = 8 * columns
    if len(data) % size or (rows is not None and len(data) != rows * size):
        expected = f"{rows} rows" if rows is not None else "whole rows"
        raise InputError(
            f"{what} of a session must be {expected} of {columns} numbers; got {len(data)} bytes"
        )
    numbers: Floats = np.frombuffer(data, "<f8").reshape(-1, columns).astype(np.float64)
    if not (np.abs(numbers) <= PLACES).all():  # not-a-number is refused as well
        raise InputError(f"{what} of a session hold numbers that are not finite or beyond {PLACES:g}")
    return numbers


def read_sessions(path: Path) -> list[RecordedSession]:
    """Read a file of one session or several.

    Raises
    ------
    InputError
        If it cannot be read, or is no such file.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST:
            raise InputError(f"{path} has {size} bytes; a file of sessions has at most {LARGEST}")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read the sessions {path}: {error.strerror}") from error
    return parsed_sessions(data, str(path))


def parsed_sessions(data: bytes, origin: str) -> list[RecordedSession]:
    """Read sessions from JSON.

    Parameters
    ----------
    data : bytes
        UTF-8.
    origin : str
        For messages.

    Raises
    ------
    InputError
        If it is no session and no list of sessions.
    """
    try:
        tree: Any = json.loads(data.decode("utf-8-sig"), parse_constant=_no_constant)
    except (ValueError, RecursionError):
        raise InputError(f"{origin} is no JSON: export the sessions from the page again") from None
    kind = tree.get("kind") if isinstance(tree, dict) else None
    if kind == "echospline session":
        given = [tree]
    elif kind == "echospline sessions" and isinstance(tree.get("sessions"), list):
        if tree.get("format") != 1:
            raise InputError(
                f"{origin} has sessions of format {str(tree.get('format'))[:20]}; this version reads format 1"
            )
        given = tree["sessions"]
    else:
        raise InputError(f"{origin} holds no sessions of echospline: expected what a page exports")
    if len(given) > MOST_SESSIONS:
        raise InputError(f"{origin} has {len(given)} sessions; at most {MOST_SESSIONS} are read at once")
    return [_session(one, f"{origin}, session {k + 1}") for k, one in enumerate(given)]


def _session(tree: Any, origin: str) -> RecordedSession:
    try:
        return RecordedSession.model_validate_json(json.dumps(tree), strict=True)
    except RecursionError:
        raise InputError(f"{origin} is damaged: tables inside tables without end") from None
    except ValidationError as error:
        fault = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(name)[:40] for name in fault["loc"])
        words = fault["msg"].removeprefix("Value error, ").splitlines()[0][:200]
        raise InputError(f"{origin} is damaged: {where}: {words}") from None


def _no_constant(name: str) -> float:
    raise ValueError(name)
