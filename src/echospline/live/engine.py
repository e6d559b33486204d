"""The live loop: one tissue model stepped at a fixed rate, newest command in, newest snapshot out, no queue."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.live.motion import follow, insert_straight
from echospline.live.slot import Slot
from echospline.live.snapshot import Command, Snapshot
from echospline.mechanics.protocol import TissueModel
from echospline.picture import Deformation
from echospline.scene import Floats, NeedlePose, as_points

log = logging.getLogger(__name__)

AnyModel = TissueModel[Any]
ModelFactory = Callable[[str], AnyModel]
"""Builds the model of a name; passed in, so that the live loop and the front ends import no model."""


PAUSE = 0.5
"""s; commands further apart than this do not belong to one motion."""


@dataclass
class _Requests:
    """Requests since the last step, the newest of each kind."""

    command: Command | None = None
    place: NeedlePose | None = None
    reset: bool = False
    frozen: bool | None = None
    model: str | None = None
    compare: tuple[str | None] | None = None
    watch: Floats | None = None
    replay: deque[NeedlePose] | None = None


class LiveEngine:
    """One trainee's tissue and needle.

    `step` advances it by one period; its caller (a `Pacer`'s thread, a test) sets the clock. All
    other methods may be called from any thread; they take effect at the next step, the newest of a kind
    winning. A model that raises stops the engine, not the program: the snapshots carry the reason until a reset.

    Parameters
    ----------
    models : callable
        Model factory.
    name : str
        The first model.
    home : NeedlePose
        First pose of the needle, to which `reset` returns it; usually of zero depth.
    rate : float
        Steps per second.
    lag : float
        Time constant with which the needle follows its command, s; longer while commands come more rarely than
        that, or a slow screen would make a steady push a row of jolts. 0 follows at once.
    fastest : float
        Upper limit of the needle's speed, mm/s.

    Raises
    ------
    InputError
        If rate, lag or fastest is out of its range.
    """

    def __init__(
        self,
        models: ModelFactory,
        name: str,
        home: NeedlePose,
        *,
        rate: float = 120.0,
        lag: float = 0.02,
        fastest: float = 200.0,
    ) -> None:
        if not (isfinite(rate) and 0 < rate <= 2000):
            raise InputError(f"rate must be above 0 and at most 2000 steps per second; got {rate}")
        if not (isfinite(lag) and lag >= 0):
            raise InputError(f"lag must be zero or a positive number of s; got {lag}")
        if not fastest > 0:
            raise InputError(f"fastest must be a positive speed in mm/s; got {fastest}")
        self.snapshots: Slot[Snapshot] = Slot()
        self.period = 1.0 / rate
        self.home = home
        self._models, self._lag, self._fastest = models, lag, fastest
        self._lock = threading.Lock()
        self._requests = _Requests()
        self._observers: list[Callable[[Snapshot], None]] = []
        self._name, self._model = name, models(name)
        self._state: Any = self._model.rest()
        self._other: tuple[AnyModel, Any] | None = None
        self._pose = replace(home, speed=0.0)
        self._command = Command(home.entry, home.tip)
        self._waited = self._interval = 0
        self._watch: Floats = np.empty((0, 2))
        self._replay: deque[NeedlePose] = deque()
        self._replaying = False
        self._time, self._steps = 0.0, 0
        self._frozen = False
        self._failure: str | None = None
        self.snapshots.put(self._snapshot(0.0))

    @property
    def model(self) -> AnyModel:
        """The model in use (its grid, for one)."""
        return self._model

    def command(
        self, entry: tuple[float, float], tip: tuple[float, float], number: int = 0, sent: float = 0.0
    ) -> None:
        """Set the needle's goal, mm; the newest command wins.

        Raises
        ------
        InputError
            If a number is not finite.
        """
        NeedlePose(entry, tip)
        with self._lock:
            self._requests.command = Command(entry, tip, number, sent)

    def place(self, entry: tuple[float, float], tip: tuple[float, float]) -> None:
        """Put the needle here as if it had gone straight to this pose, mm: for a needle that is already inserted when tracking begins.

        Raises
        ------
        InputError
            If a number is not finite.
        """
        pose = NeedlePose(entry, tip)
        with self._lock:
            self._requests.place, self._requests.command = pose, Command(entry, tip)

    def reset(self) -> None:
        """Move the needle home and the tissue to rest; also end a replay and a failure."""
        with self._lock:
            asked = self._requests
            self._requests = _Requests(
                reset=True, frozen=False, model=asked.model, compare=asked.compare, watch=asked.watch
            )

    def freeze(self, on: bool) -> None:
        """Stop model time, or let it run again."""
        with self._lock:
            self._requests.frozen = on

    def switch(self, name: str) -> None:
        """Change the model and keep the pose; the new model starts from a straight insertion to it."""
        with self._lock:
            self._requests.model = name

    def compare(self, name: str | None) -> None:
        """Step a second model in the same pose, so that their difference can be shown; None stops it."""
        with self._lock:
            self._requests.compare = (name,)

    def watch(self, points: ArrayLike) -> None:
        """Report the deformed positions of these reference points, shape (k, 2) mm, in every snapshot."""
        checked = np.empty((0, 2)) if np.size(points) == 0 else as_points(points, "watched points")
        with self._lock:
            self._requests.watch = checked

    def replay(self, poses: Iterable[NeedlePose]) -> None:
        """Move the needle home and the tissue to rest, then use one recorded pose per step instead of commands."""
        with self._lock:
            self._requests.replay = deque(poses)

    def observe(self, callback: Callable[[Snapshot], None]) -> None:
        """Call ``callback`` with every snapshot, in the stepping thread (so that a recorder misses no step)."""
        with self._lock:
            self._observers = [*self._observers, callback]

    def unobserve(self, callback: Callable[[Snapshot], None]) -> None:
        """Stop calling ``callback``."""
        with self._lock:
            self._observers = [known for known in self._observers if known != callback]

    def step(self) -> Snapshot:
        """Advance by one period and publish the snapshot."""
        with self._lock:
            requests, self._requests = self._requests, _Requests()
            observers = self._observers
        started = time.perf_counter()
        try:
            self._take(requests)
            if not self._frozen and self._failure is None:
                self._advance()
            self._steps += 1
            snapshot = self._snapshot(time.perf_counter() - started)
        except Exception as error:  # a model may fail in any way; the server and its other clients go on
            log.exception("the model %s failed", self._name)
            self._failure = f"{type(error).__name__}: {error}"
            last = self.snapshots.latest()
            assert last is not None  # the constructor puts one
            snapshot = replace(
                last.value,
                step=self._steps,
                failure=self._failure,
                command=self._command,
                frozen=self._frozen,
            )
        for observer in observers:
            observer(snapshot)
        self.snapshots.put(snapshot)
        return snapshot

    def _take(self, requests: _Requests) -> None:
        self._waited += 1
        if requests.command is not None and not self._replay:
            self._command = requests.command
            # steps between commands; after a longer pause the next push begins afresh
            self._interval = self._waited if self._waited * self.period < PAUSE else 1
            self._waited = 0
        if requests.place is not None:
            self._pose, self._state = requests.place, insert_straight(self._model, requests.place)
            if self._other is not None:
                self._other = self._other[0], insert_straight(self._other[0], requests.place)
        if requests.frozen is not None:
            self._frozen = requests.frozen
        if requests.watch is not None:
            self._watch = requests.watch
        if requests.reset or requests.replay is not None:
            self._go_home()
            self._replay = requests.replay or deque()
            if requests.command is not None and requests.replay is None:
                self._command = requests.command
        if requests.model is not None and requests.model != self._name:
            model = self._models(requests.model)
            self._model, self._state = model, insert_straight(model, self._pose)
            self._name, self._failure = requests.model, None
        if requests.compare is not None:
            (name,) = requests.compare
            self._other = None
            if name is not None:
                other = self._models(name)
                self._other = other, insert_straight(other, self._pose)

    def _go_home(self) -> None:
        self._pose = replace(self.home, speed=0.0)
        self._command = Command(self.home.entry, self.home.tip, self._command.number, self._command.sent)
        self._state = self._model.rest()
        if self._other is not None:
            self._other = self._other[0], self._other[0].rest()
        self._time, self._failure = 0.0, None
        self._replay.clear()

    def _advance(self) -> None:
        self._replaying = bool(self._replay)
        if self._replay:
            pose = self._replay.popleft()
            self._command = replace(self._command, entry=pose.entry, tip=pose.tip)
        else:
            lag = max(self._lag, self._interval * self.period) if self._lag > 0 else 0.0
            pose = follow(self._pose, self._command, self.period, lag, self._fastest)
        self._state = self._model.advance(self._state, pose, self.period)
        if self._other is not None:
            model, state = self._other
            self._other = model, model.advance(state, pose, self.period)
        self._pose = pose
        self._time += self.period

    def _snapshot(self, duration: float) -> Snapshot:
        displacement = self._model.displacement(self._state)
        if not np.isfinite(displacement).all():
            raise ArithmeticError("the displacement is not finite")
        offered = getattr(self._model, "spline", None)
        watched = self._watch
        if len(watched):  # bilinear between nodes, as in the picture
            watched = Deformation(self._model.grid, displacement).forward(watched)
        return Snapshot(
            step=self._steps,
            time=self._time,
            pose=replace(self._pose, speed=0.0) if self._frozen else self._pose,
            displacement=displacement,
            model=self._name,
            command=self._command,
            duration=duration,
            watched=watched,
            reference=None if self._other is None else self._other[0].displacement(self._other[1]),
            frozen=self._frozen,
            replaying=self._replaying,
            failure=self._failure,
            spline=None if offered is None else partial(offered, self._state),
        )
