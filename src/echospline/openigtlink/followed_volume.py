"""A scene in space on a link: tracked probe and needle move the engine, the picture goes out with its place."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from threading import Event

import numpy as np

from echospline.live import SpatialSnapshot
from echospline.openigtlink.followed import ARRIVES
from echospline.openigtlink.image import Image
from echospline.openigtlink.message import Message
from echospline.openigtlink.outgoing import ORIENTATION, tip_messages
from echospline.openigtlink.pose import Transform
from echospline.openigtlink.stage import SessionOptions, SpatialStage
from echospline.openigtlink.text import NOT_READY, UNKNOWN_ERROR, Status
from echospline.openigtlink.tracking_space import SpatialLocated, SpatialTracking
from echospline.scene import Floats, ImagingPlane, SpatialPose, pose_in_space, tip_frame

log = logging.getLogger("echospline.openigtlink")

ALL_OUTSIDE = 0.999
"""Share of the picture outside the volume from which nothing is seen: rows at the very surface may count as inside."""
MENTIONED = 0.01
"""Share from which the STATUS gives it."""
LONGEST_WAIT = 0.5
"""s; without a new picture the STATUS goes out at least this often."""


class FollowedVolume:
    """A scene in space that follows transforms.

    Parameters
    ----------
    stage : SpatialStage
        What is simulated.
    options : SessionOptions
        Of the session; `Reach.thickness`, `Rates.mesh` and `Looks.echo` belong to the plane: thickness and echo are the engine's here.
    moved : callable, optional
        Called with the needle's pose, and whether tracking of it has just begun.
    placed : callable, optional
        Called with the probe's plane.
    """

    def __init__(
        self,
        stage: SpatialStage,
        options: SessionOptions,
        moved: Callable[[SpatialPose, bool], None] | None = None,
        placed: Callable[[ImagingPlane], None] | None = None,
    ) -> None:
        self.stage, self.options = stage, options
        self._moved, self._placed = moved, placed
        drawing = stage.engine.drawing
        self.grid = drawing.probe.grid
        low = np.array(drawing.volume.origin)
        self._box = low, low + np.array(drawing.volume.size)
        self._tracking = SpatialTracking(self.grid, stage.place, options.looks.naming, options.silence)
        self.located: SpatialLocated = self._tracking.locate()
        self._plane: ImagingPlane | None = None
        self._pose: SpatialPose | None = None
        self._away, self._blind = True, False
        self._sent, self._status_due = 0, 0.0

    def put(self, name: str, matrix: Floats, status: str, now: float) -> None:
        """Store a transform; see `Received.put`."""
        self._tracking.put(name, matrix, status, now)

    def locate(self, now: float) -> SpatialLocated:
        """Combine the newest transforms."""
        self.located = self._tracking.locate(now)
        return self.located

    def follow(self) -> None:
        """Move the engine's probe and needle to the tracked ones."""
        engine, located = self.stage.engine, self.located
        if located.plane is not None and located.plane is not self._plane and not located.probe_held:
            self._plane = located.plane
            engine.move_probe(located.plane)
            if self._placed is not None:
                self._placed(located.plane)
        if located.needle is None or located.needle_held:
            return
        pose = pose_in_space(located.needle, *self._box, self.options.reach)
        # A needle that is inserted when tracking begins was not pushed there in this step.
        appears, self._away = self._away and pose is not None and pose.depth > ARRIVES, pose is None
        pose = pose or engine.home
        if pose != self._pose or appears:
            self._pose = pose
            (engine.place if appears else engine.command)(pose.entry, pose.tip)
            if self._moved is not None:
                self._moved(pose, appears)

    def status(self) -> Status:
        """Describe needle, probe, model and faults."""
        return status_in_space(self._newest(), self.located)

    def messages(self, stop: Event) -> list[Message] | None:
        """Wait for the next picture and compose its messages, and STATUS where it is due."""
        wait = (
            min(LONGEST_WAIT, 1.0 / self.options.rates.status) if self.options.rates.status else LONGEST_WAIT
        )
        fresh = self.stage.engine.snapshots.wait(self._sent, wait)
        if stop.is_set():
            return None
        now, located = time.time(), self.located
        messages: list[Message] = []
        if fresh is not None:
            self._sent = fresh.number
            self._tell_blindness(fresh.value)
            messages += self._picture(fresh.value, located, now)
        if self.options.rates.status and now >= self._status_due:
            self._status_due = now + 1.0 / self.options.rates.status
            messages.append(Message(status_in_space(self._newest(), located), "echospline", now))
        return messages or None

    def _newest(self) -> SpatialSnapshot:
        newest = self.stage.engine.snapshots.latest()
        assert newest is not None  # an engine begins with one
        return newest.value

    def _picture(self, snapshot: SpatialSnapshot, located: SpatialLocated, now: float) -> list[Message]:
        """Build IMAGE with its place, ImageToReference, ProbeToReference and the needle."""
        looks = self.options.looks
        n = looks.naming
        plane = ImagingPlane(located.scene @ snapshot.plane.matrix)
        matrix = plane.image_matrix(self.grid)
        pixels = snapshot.drawn.image.pixels[None]
        messages = [
            Message(Image(pixels, matrix if looks.embed else np.eye(4)), n.image, now, metadata=ORIENTATION),
            Message(Transform(matrix), f"{n.image}To{n.reference}", now),
        ]
        probe = plane.matrix @ np.linalg.inv(self._tracking.picture_to_probe)
        messages.append(Message(Transform(probe), f"{n.probe}To{n.reference}", now))
        return messages + tip_messages(located.scene @ tip_frame(snapshot.pose), n, now)

    def _tell_blindness(self, snapshot: SpatialSnapshot) -> None:
        """Log once that the probe sees nothing of the volume, and once that it does again."""
        blind = snapshot.drawn.outside >= ALL_OUTSIDE
        if blind and not self._blind:
            log.warning("%s", _blindness(snapshot))
        elif self._blind and not blind:
            log.info("the probe sees the volume again")
        self._blind = blind


def status_in_space(snapshot: SpatialSnapshot, located: SpatialLocated) -> Status:
    """Describe a scene in space as STATUS.

    Parameters
    ----------
    snapshot : SpatialSnapshot
        The scene.
    located : SpatialLocated
        Scene, probe and needle by the newest transforms.
    """
    if snapshot.failure:
        what = f"{snapshot.model} failed: {snapshot.failure}; reset to go on"
        return Status(UNKNOWN_ERROR, 0, "ModelFailed", what)
    state = "frozen" if snapshot.frozen else "playing" if snapshot.replaying else "live"
    x, y, z = snapshot.pose.tip
    away = snapshot.pose.seen_from(snapshot.plane)[1][2]
    told = (
        f"{snapshot.model}, {state}; tip {x:.1f} {y:.1f} {z:.1f} mm, depth {snapshot.pose.depth:.1f} mm, "
        f"{away:+.1f} mm from the plane"
    )
    if located.fault:
        return Status(NOT_READY, 0, located.fault, f"{located.trouble}: {told}")
    outside = snapshot.drawn.outside
    if outside >= ALL_OUTSIDE:
        return Status(NOT_READY, 0, "Outside", f"{_blindness(snapshot)}: {told}")
    if outside >= MENTIONED:
        told += f"; {100 * outside:.0f} % of the picture is outside the volume"
    if snapshot.drawn.folds:
        told += f"; {snapshot.drawn.folds}"
    tracked = (("needle", located.needle), ("probe", located.plane))
    missing = [name for name, one in tracked if one is None]
    return Status(text=f"{told}; no tracked {' and no tracked '.join(missing)} yet" if missing else told)


def _blindness(snapshot: SpatialSnapshot) -> str:
    x, y, z = snapshot.plane.matrix[:3, 3]
    return (
        f"the probe's picture lies outside the volume and is black: its frame is at {x:.0f} {y:.0f} {z:.0f} mm of the scene, whose skin "
        "is y = 0"
    )
