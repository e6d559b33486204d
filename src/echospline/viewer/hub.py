"""What reaches pages from outside: poses of a tracker, its state, and the turn of a phone; the newest wins, none is queued."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from echospline.scene import Floats, NeedlePose, SpatialPose

FASTEST = 1 / 60
"""s between two messages of one kind to a page; what comes sooner replaces what waits."""


@dataclass(eq=False)
class Listener:
    """A page, and what it has not been told yet: the newest of each kind.

    Parameters
    ----------
    key : str
        Under which a phone finds it; empty where it names none.
    """

    key: str = ""
    waiting: dict[str, str] = field(default_factory=dict)
    due: asyncio.Event = field(default_factory=asyncio.Event)

    def tell(self, kind: str, text: str) -> None:
        """Leave a message for it, in the place of an older one of its kind."""
        self.waiting.pop(kind, None)
        self.waiting[kind] = text
        self.due.set()

    async def heard(self) -> list[str]:
        """Wait for messages and take them, oldest first."""
        await self.due.wait()
        self.due.clear()
        messages = list(self.waiting.values())
        self.waiting.clear()
        return messages


class Hub:
    """The pages that listen, and whoever steers them. `steer`, `turn` and `announce` may be called from any thread."""

    def __init__(self) -> None:
        self.listeners: set[Listener] = set()
        self.tracker = ""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._appears = False
        self._tick: asyncio.TimerHandle | None = None
        self._newest: dict[str, str] = {}

    def enter(self, listener: Listener) -> None:
        """Add a page; it is told the tracker's state if there is something to tell."""
        self._loop = asyncio.get_running_loop()
        self.listeners.add(listener)
        if self.tracker:
            listener.tell("tracker", message(tracker=self.tracker))

    def leave(self, listener: Listener) -> None:
        """Remove a page."""
        self.listeners.discard(listener)

    def of_key(self, key: str) -> list[Listener]:
        """Return the pages of a key."""
        return [listener for listener in self.listeners if listener.key == key and key]

    def steer(self, pose: NeedlePose | SpatialPose, appears: bool) -> None:
        """Move the needle of every page; ``appears`` places it there, even if a later pose of the same moment says otherwise."""
        self._soon(self._steer, pose, appears)

    def turn(self, plane: Floats | Iterable[float]) -> None:
        """Move the plane of every page: 16 numbers of a matrix from plane to scene row by row, or x, y, z, yaw, pitch, roll (mm, degrees)."""
        self._soon(self._later, "plane", message(plane=[float(v) for v in plane]))

    def announce(self, text: str) -> None:
        """Say the state of the tracker; empty when it works."""
        self.tracker = text
        self._soon(self._announce, text)

    def _steer(self, pose: NeedlePose | SpatialPose, appears: bool) -> None:
        self._appears |= appears
        self._later(
            "needle",
            message(
                entry=list(map(float, pose.entry)), tip=list(map(float, pose.tip)), appears=self._appears
            ),
        )

    def _announce(self, text: str) -> None:
        for listener in self.listeners:
            listener.tell("tracker", message(tracker=text))

    def _later(self, kind: str, text: str) -> None:
        self._newest[kind] = text
        if self._tick is None:
            self._flush()

    def _flush(self) -> None:
        self._tick = None
        if not self._newest:
            return
        for listener in self.listeners:
            for kind, text in self._newest.items():
                listener.tell(kind, text)
        self._newest.clear()
        self._appears = False
        assert self._loop is not None  # `_soon` has run here
        self._tick = self._loop.call_later(FASTEST, self._flush)

    def _soon(self, function: Any, *arguments: object) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(function, *arguments)


def message(**content: object) -> str:
    """Write a message to a page."""
    return json.dumps(content, allow_nan=False)
