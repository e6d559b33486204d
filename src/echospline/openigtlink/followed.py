"""A scene between a link's two sides: transforms come in and move it, pictures go out."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event
from typing import Protocol

from echospline.live import Metronome
from echospline.openigtlink.message import Message
from echospline.openigtlink.painter import Painter
from echospline.openigtlink.stage import AnyStage, SessionOptions, Stage
from echospline.openigtlink.status import status_of
from echospline.openigtlink.text import Status
from echospline.openigtlink.transforms import Located, Tracking
from echospline.scene import Floats, NeedlePose

ARRIVES = 1.0
"""mm; a needle that is first tracked deeper than this is placed there instead of pushed there."""


class Fault(Protocol):
    """What is wrong with the newest transforms; see `Located`."""

    @property
    def trouble(self) -> str:
        """Description; empty if there is none."""
        ...

    @property
    def fault(self) -> str:
        """Kind."""
        ...

    @property
    def about(self) -> str:
        """Name of the transform at fault."""
        ...

    @property
    def held(self) -> bool:
        """Whether something stays where it was."""
        ...


class Followed(Protocol):
    """A stage that follows transforms. `messages` belongs to the picture's thread, everything else to the link's."""

    @property
    def stage(self) -> AnyStage:
        """What is simulated."""
        ...

    @property
    def located(self) -> Fault:
        """The newest result of `locate`."""
        ...

    def put(self, name: str, matrix: Floats, status: str, now: float) -> None:
        """Store a transform; see `Received.put`."""
        ...

    def locate(self, now: float) -> Fault:
        """Combine the newest transforms."""
        ...

    def follow(self) -> None:
        """Move the engine to what was located."""
        ...

    def status(self) -> Status:
        """Describe scene and faults."""
        ...

    def messages(self, stop: Event) -> list[Message] | None:
        """Wait until messages are due (or for ``stop``) and compose them; None where there are none."""
        ...


class FollowedPlane:
    """A scene in the plane.

    Parameters
    ----------
    stage : Stage
        What is simulated.
    options : SessionOptions
        Of the session.
    moved : callable, optional
        Called with the needle's pose, and whether tracking of it has just begun.
    """

    def __init__(
        self, stage: Stage, options: SessionOptions, moved: Callable[[NeedlePose, bool], None] | None = None
    ) -> None:
        self.stage, self.options = stage, options
        self._moved, self._away = moved, True
        self._tracking = Tracking(stage.image.grid, options.looks.naming, options.silence)
        self.located: Located = self._tracking.locate()
        self._painter = Painter(options.looks, options.reach, options.rates)
        self._clock = Metronome(1.0 / options.rates.image, time.monotonic())

    def put(self, name: str, matrix: Floats, status: str, now: float) -> None:
        """Store a transform; see `Received.put`."""
        self._tracking.put(name, matrix, status, now)

    def locate(self, now: float) -> Located:
        """Combine the newest transforms."""
        self.located = self._tracking.locate(now)
        return self.located

    def follow(self) -> None:
        """Move the engine's needle to the tracked one."""
        needle = self.located.needle
        if needle is None or self.located.held:
            return
        engine, pose = self.stage.engine, needle.pose(self.stage.image.grid, self.options.reach)
        # A needle that is inserted when tracking begins was not pushed there in this step.
        appears, self._away = self._away and pose is not None and pose.depth > ARRIVES, pose is None
        pose = pose or engine.home
        (engine.place if appears else engine.command)(pose.entry, pose.tip)
        if self._moved is not None:
            self._moved(pose, appears)

    def status(self) -> Status:
        """Describe needle, model and faults."""
        newest = self.stage.engine.snapshots.latest()
        assert newest is not None  # an engine begins with one
        return status_of(newest.value, self.located, self.stage.image.grid, self.options.reach)

    def messages(self, stop: Event) -> list[Message] | None:
        """Wait for the next picture's time and compose what is due then."""
        if stop.wait(self._clock.wait(time.monotonic())):
            return None
        return self._painter.messages(self.stage, self.located)
