"""The live loop in space: needle and probe are moved, the tissue answers, and each step makes the picture under the probe.

One thread steps. It makes a picture per period, or as many as the machine reaches: a step advances the model by the time that has passed
since the last one, so that a slow machine shows fewer pictures and no slower needle. The newest pose of needle and probe wins.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import numpy as np

from echospline.errors import InputError
from echospline.live.motion import follow_in_space, insert_straight_in_space
from echospline.live.slot import Slot
from echospline.mechanics.protocol import SpatialTissueModel
from echospline.picture import NeedleEcho
from echospline.picture.slices import SliceDrawing, SliceDrawn
from echospline.scene import Floats, ImagingPlane, PlanePath, SpatialInsertion, SpatialPose
from echospline.scene.space import Triple

log = logging.getLogger(__name__)

AnySpatialModel = SpatialTissueModel[Any]

LONGEST = 0.1
"""s; a step that comes later than this after the last one advances no further, or a needle would jump after a pause."""
IDLE = 0.2
"""s between steps while nothing moves: the picture would be the same."""
STILL = 1e-3
"""mm; tissue whose places in the picture all move less than this between two steps is still."""
ARRIVED = 1e-4
"""mm; a needle this close to its command has reached it."""


@dataclass(frozen=True, slots=True)
class SpatialSnapshot:
    """The scene in space after one step.

    Parameters
    ----------
    step : int
        Steps so far, frozen ones included.
    time : float
        Model time since the last reset, s.
    pose : SpatialPose
        The needle, its speed derived from its motion.
    plane : ImagingPlane
        Where the probe is: the picture's frame to the scene's, mm.
    drawn : SliceDrawn
        The picture, with its folds and the share of it that lies outside the volume.
    model : str
        Name of the model.
    duration : float
        Processing time of the step, s.
    frozen, replaying : bool
        Whether model time is stopped, and whether poses come from a path.
    failure : str or None
        The error that stopped the model, if any; a reset starts it again.
    """

    step: int
    time: float
    pose: SpatialPose
    plane: ImagingPlane
    drawn: SliceDrawn
    model: str
    duration: float = 0.0
    frozen: bool = False
    replaying: bool = False
    failure: str | None = None


@dataclass
class _Requests:
    """Requests since the last step, the newest of each kind."""

    command: SpatialPose | None = None
    place: SpatialPose | None = None
    plane: ImagingPlane | None = None
    reset: bool = False
    frozen: bool | None = None
    model: str | None = None
    path: tuple[SpatialInsertion, PlanePath | None] | None = None

    @property
    def any(self) -> bool:
        return self != _Requests()


class SpatialEngine:
    """One needle and one probe in a volume.

    `step` advances and draws; its caller (a `Pacer`'s thread, a test) sets the pace. All other methods may be called from any thread; they
    take effect at the next step, the newest of a kind winning. A model that raises stops the engine, not the program: the
    snapshots carry the reason until a reset.

    Parameters
    ----------
    models : callable
        Builds the model of a name.
    name : str
        The first model.
    drawing : SliceDrawing
        Draws the volume.
    plane : ImagingPlane
        Where the probe is first.
    home : SpatialPose
        First pose of the needle, to which `reset` returns it; usually of zero depth.
    echo : NeedleEcho, optional
        The needle's looks; not drawn when not given.
    rate : float
        Steps, and so pictures, per second at most.
    lag : float
        Time constant with which the needle follows its command, s; 0 follows at once. The plane follows at once.
    fastest : float
        Upper limit of the needle's speed, mm/s.
    clock : callable
        Seconds.

    Raises
    ------
    InputError
        If rate, lag or fastest is out of its range.
    """

    def __init__(
        self,
        models: Callable[[str], AnySpatialModel],
        name: str,
        drawing: SliceDrawing,
        plane: ImagingPlane,
        home: SpatialPose,
        *,
        echo: NeedleEcho | None = None,
        rate: float = 25.0,
        lag: float = 0.02,
        fastest: float = 200.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not (isfinite(rate) and 0 < rate <= 1000):
            raise InputError(f"rate must be above 0 and at most 1000 pictures per second; got {rate}")
        if not (isfinite(lag) and lag >= 0):
            raise InputError(f"lag must be zero or a positive number of s; got {lag}")
        if not fastest > 0:
            raise InputError(f"fastest must be a positive speed in mm/s; got {fastest}")
        self.snapshots: Slot[SpatialSnapshot] = Slot()
        self.period = 1.0 / rate
        self.drawing, self.home, self.first_plane = drawing, home, plane
        self._models, self._echo, self._lag, self._fastest, self._clock = models, echo, lag, fastest, clock
        self._lock = threading.Lock()
        self._requests = _Requests()
        self._name, self._model = name, models(name)
        self._state: Any = self._model.rest()
        self._pose, self._plane = replace(home, speed=0.0), plane
        self._command = home
        self._path: tuple[SpatialInsertion, PlanePath | None] | None = None
        self._played = 0.0
        self._time, self._steps, self._stepped = 0.0, 0, clock()
        self._frozen = self._still = False
        self._failure: str | None = None
        self.snapshots.put(self._snapshot(0.0))

    @property
    def model(self) -> AnySpatialModel:
        """The model in use."""
        return self._model

    def command(self, entry: Triple, tip: Triple) -> None:
        """Set the needle's goal, (x, y, z) in mm; the newest command wins.

        Raises
        ------
        InputError
            If a number is not finite.
        """
        pose = SpatialPose(entry, tip)
        with self._lock:
            self._requests.command = pose

    def place(self, entry: Triple, tip: Triple) -> None:
        """Put the needle here as if it had gone straight to this pose, mm: for one that is already inserted when tracking begins.

        Raises
        ------
        InputError
            If a number is not finite.
        """
        pose = SpatialPose(entry, tip)
        with self._lock:
            self._requests.place = self._requests.command = pose

    def move_probe(self, plane: ImagingPlane) -> None:
        """Put the probe here: its matrix takes the picture's frame to the scene's, mm; the newest plane wins."""
        with self._lock:
            self._requests.plane = plane

    def reset(self) -> None:
        """Move the needle home and the tissue to rest; also end a path and a failure. The probe stays."""
        with self._lock:
            asked = self._requests
            self._requests = _Requests(reset=True, frozen=False, model=asked.model, plane=asked.plane)

    def freeze(self, on: bool) -> None:
        """Stop model time, or let it run again; the probe moves meanwhile."""
        with self._lock:
            self._requests.frozen = on

    def switch(self, name: str) -> None:
        """Change the model and keep the pose; the new model starts from a straight insertion to it."""
        with self._lock:
            self._requests.model = name

    def play(self, insertion: SpatialInsertion, planes: PlanePath | None = None) -> None:
        """Move the needle home and the tissue to rest, then let it (and the probe, if given) follow a path instead of commands."""
        with self._lock:
            self._requests.path = insertion, planes

    def step(self) -> SpatialSnapshot:
        """Advance by the time since the last step, draw, and publish the snapshot; while nothing moves, every `IDLE` s alone."""
        with self._lock:
            requests, self._requests = self._requests, _Requests()
        now = self._clock()
        elapsed = now - self._stepped
        last = self.snapshots.latest()
        assert last is not None  # the constructor puts one
        if self._still and elapsed < IDLE and not requests.any:
            return last.value
        self._stepped = now
        started = time.perf_counter()
        try:
            self._take(requests)
            before = self._pose
            if not self._frozen and self._failure is None and elapsed > 0:
                self._advance(min(elapsed, LONGEST))
            self._steps += 1
            snapshot = self._snapshot(started)
            self._still = self._rests(last.value, snapshot, before)
        except Exception as error:  # a model may fail in any way; the link and its peers go on
            failure = f"{type(error).__name__}: {error}"
            if failure != self._failure:
                log.exception("the model %s failed", self._name)
            self._failure = failure
            snapshot = replace(
                last.value, step=self._steps, failure=self._failure, frozen=self._frozen, replaying=False
            )
        self.snapshots.put(snapshot)
        return snapshot

    def _rests(self, last: SpatialSnapshot, now: SpatialSnapshot, before: SpatialPose) -> bool:
        """Test whether another step would show the same picture."""
        if self._path is not None or now.plane is not last.plane or now.failure != last.failure:
            return False
        moved = np.abs(np.subtract([before.entry, before.tip], [now.pose.entry, now.pose.tip])).max()
        goal = self._command
        gap = np.abs(np.subtract([goal.entry, goal.tip], [now.pose.entry, now.pose.tip])).max()
        tissue = np.abs(now.drawn.lattice - last.drawn.lattice).max()
        return bool(self._frozen or (moved < ARRIVED and gap < ARRIVED and tissue < STILL))

    def _take(self, requests: _Requests) -> None:
        if requests.plane is not None:
            self._plane = requests.plane
        if requests.command is not None and self._path is None:
            self._command = requests.command
        if requests.place is not None and self._path is None:
            self._pose, self._state = (
                requests.place,
                insert_straight_in_space(self._model, requests.place),
            )
        if requests.frozen is not None:
            self._frozen = requests.frozen
        if requests.reset or requests.path is not None:
            self._go_home()
            self._path = requests.path
            if requests.command is not None and requests.path is None:
                self._command = requests.command
        if requests.model is not None and requests.model != self._name:
            model = self._models(requests.model)
            self._model, self._state = model, insert_straight_in_space(model, self._pose)
            self._name, self._failure = requests.model, None

    def _go_home(self) -> None:
        self._pose = replace(self.home, speed=0.0)
        self._command = self.home
        self._state = self._model.rest()
        self._time, self._played, self._path, self._failure = 0.0, 0.0, None, None

    def _advance(self, dt: float) -> None:
        if self._path is not None:
            insertion, planes = self._path
            self._played += dt
            first = float(insertion.times[0])
            pose = insertion.pose(first + self._played)
            self._command = pose
            if planes is not None:
                self._plane = planes.at(first + self._played)
            longest = max(insertion.times[-1], -np.inf if planes is None else planes.times[-1])
            if self._played >= float(longest) - first:
                self._path = None
        else:
            pose = follow_in_space(self._pose, self._command, dt, self._lag, self._fastest)
        self._state = self._model.advance(self._state, pose, dt)
        self._pose = pose
        self._time += dt

    def _snapshot(self, started: float) -> SpatialSnapshot:
        pose = replace(self._pose, speed=0.0) if self._frozen else self._pose
        field: Callable[[Floats], Floats] = self._model.field(self._state)
        drawn = self.drawing.draw(self._plane, field, pose, self._echo)
        if not np.isfinite(drawn.lattice).all():
            raise ArithmeticError("the displacement is not finite")
        return SpatialSnapshot(
            self._steps,
            self._time,
            pose,
            self._plane,
            drawn,
            self._name,
            time.perf_counter() - started if started else 0.0,
            self._frozen,
            self._path is not None,
            self._failure,
        )
