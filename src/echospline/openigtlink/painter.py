"""Pictures of a session, drawn again when the scene changes, and the messages that are due."""

from __future__ import annotations

import logging
import time

from echospline.errors import EchosplineError
from echospline.live import Snapshot
from echospline.openigtlink.message import Message
from echospline.openigtlink.outgoing import (
    Looks,
    draw,
    image_message,
    mesh_message,
    needle_messages,
    target_message,
)
from echospline.openigtlink.stage import Rates, Stage
from echospline.openigtlink.status import status_of
from echospline.openigtlink.transforms import Located
from echospline.picture import Drawing
from echospline.scene import Pixels, Reach, TrackedNeedle, Visible

log = logging.getLogger("echospline.openigtlink")


class Painter:
    """Draws the scene when it has changed and composes the messages that are due.

    Parameters
    ----------
    looks : Looks
        Names of frames, the needle's looks.
    reach : Reach
        Distances up to which the needle is seen.
    rates : Rates
        Rates of meshes and statuses.
    """

    def __init__(self, looks: Looks, reach: Reach, rates: Rates) -> None:
        self.looks, self.reach, self.rates = looks, reach, rates
        self._last: tuple[Stage, Snapshot, Visible | None] | None = None
        self._drawing: Drawing | None = None
        self._pixels: Pixels | None = None
        self._mesh_due = self._status_due = 0.0

    def messages(self, stage: Stage, located: Located) -> list[Message] | None:
        """Compose the messages of the newest snapshot; None where it cannot be drawn (the log says why)."""
        now = time.time()
        newest = stage.engine.snapshots.latest()
        assert newest is not None  # an engine begins with one
        snapshot, visible = newest.value, self._visible(stage, located.needle)
        grid = stage.engine.model.grid
        try:
            if self._pixels is None or self._last is None or _differs(self._last, (stage, snapshot, visible)):
                drawing = self._drawing
                if drawing is None or drawing.image is not stage.image or drawing.mesh != grid:
                    drawing = self._drawing = Drawing(stage.image, grid)
                self._pixels = draw(drawing, snapshot, visible, self.looks)
            self._last = (stage, snapshot, visible)
            messages = self._scene(stage, snapshot, located, self._pixels, now)
            if self.rates.mesh and now >= self._mesh_due:
                self._mesh_due = now + 1.0 / self.rates.mesh
                messages.append(mesh_message(snapshot, grid, located.plane, now))
        except EchosplineError as error:
            log.warning("no picture: %s", error)
            return None
        if self.rates.status and now >= self._status_due:
            self._status_due = now + 1.0 / self.rates.status
            status = status_of(snapshot, located, stage.image.grid, self.reach)
            messages.append(Message(status, "echospline", now))
        return messages

    def _visible(self, stage: Stage, needle: TrackedNeedle | None) -> Visible | None:
        """Return the visible piece; a needle without a tracker (a planned insertion, a page) lies in the plane."""
        if needle is None:
            return Visible(0.0, self.reach.shaft, 1.0)
        return needle.seen(stage.image.grid.extent[2], self.reach)

    def _scene(
        self, stage: Stage, snapshot: Snapshot, located: Located, pixels: Pixels, now: float
    ) -> list[Message]:
        looks = self.looks
        messages = image_message(pixels, stage.image.grid, located.plane, looks, now)
        messages += needle_messages(snapshot, located.plane, looks.naming, now)
        targets = target_message(snapshot, located.plane, looks.naming, now)
        return messages if targets is None else [*messages, targets]


def _differs(
    last: tuple[Stage, Snapshot, Visible | None], now: tuple[Stage, Snapshot, Visible | None]
) -> bool:
    (stage, snapshot, visible), (new_stage, new, new_visible) = last, now
    return (
        stage is not new_stage
        or visible != new_visible
        or snapshot.pose != new.pose
        or not (snapshot.displacement == new.displacement).all()
    )
