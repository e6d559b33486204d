"""The live loop: one tissue model stepped at a fixed rate, newest command in, newest snapshot out, no queue."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from math import exp, hypot, isfinite
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from echospline.deformation import Deformation
from echospline.errors import InputError
from echospline.grid import Floats, as_points
from echospline.mechanics.model import TissueModel
from echospline.needle import ZERO_LENGTH, NeedlePose

log = logging.getLogger(__name__)

AnyModel = TissueModel[Any]
ModelFactory = Callable[[str], AnyModel]
"""Turns a model's name into a model; the outside gets it passed in and never imports a model itself."""

ARRIVED = 1e-4
"""mm; a needle that comes this near to where it is commanded is put exactly there."""

PAUSE = 0.5
"""s; commands further apart than this do not belong to one motion."""

T = TypeVar("T")


class Numbered(NamedTuple, Generic[T]):
    """A value beside its number in the order of arrival, the first being 1."""

    number: int
    value: T


class Slot(Generic[T]):
    """Holds the newest value and nothing else: a slow reader misses values, and never gets old ones.

    Every method may be called from any thread.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._newest: Numbered[T] | None = None
        self._callbacks: list[Callable[[], None]] = []

    def put(self, value: T) -> int:
        """Replace the value; returns its number."""
        with self._changed:
            number = 1 if self._newest is None else self._newest.number + 1
            self._newest = Numbered(number, value)
            callbacks, self._callbacks = self._callbacks, []
            self._changed.notify_all()
        for callback in callbacks:
            callback()
        return number

    def latest(self) -> Numbered[T] | None:
        """Return the newest value, or None before the first."""
        with self._changed:
            return self._newest

    def wait(self, newer_than: int = 0, timeout: float | None = None) -> Numbered[T] | None:
        """Wait for a value with a number above ``newer_than``; None if none came within ``timeout`` s."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_newer(newer_than), timeout)
            return self._newest if self._is_newer(newer_than) else None

    def call_when_newer(self, than: int, callback: Callable[[], None]) -> None:
        """Call ``callback`` once, as soon as there is a value with a number above ``than``.

        It runs in the thread that puts the value (or in this one, if the value is here already): keep it
        short. This is how an event loop waits without a thread of its own.
        """
        with self._changed:
            here = self._is_newer(than)
            if not here:
                self._callbacks.append(callback)
        if here:
            callback()

    def _is_newer(self, than: int) -> bool:
        return self._newest is not None and self._newest.number > than


@dataclass(frozen=True, slots=True)
class Command:
    """Where the needle shall go.

    Parameters
    ----------
    entry, tip : (x, y)
        n_s and n_t, mm.
    number : int
        Chosen by the sender and returned in every snapshot that this command has reached.
    sent : float
        The sender's clock, returned as it came (for latency).
    """

    entry: tuple[float, float]
    tip: tuple[float, float]
    number: int = 0
    sent: float = 0.0


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The scene after one step.

    Parameters
    ----------
    step : int
        Steps so far, frozen ones included.
    time : float
        Model time since the last reset, s.
    pose : NeedlePose
        The needle, its speed derived from its motion.
    displacement : ndarray, shape (n, 2)
        Of the mesh nodes, mm.
    model : str
        Name of the model that answered.
    command : Command
        The newest command that this step has taken.
    duration : float
        What the step took, s.
    watched : ndarray, shape (k, 2)
        Deformed positions of the watched points, mm.
    reference : ndarray, shape (n, 2), or None
        Displacement by the model compared with, in the same pose, mm.
    frozen : bool
        Whether time stands still.
    replaying : bool
        Whether the pose comes from a recording.
    failure : str or None
        What ended the model, if something did; a reset starts it again.
    spline : callable or None
        Returns the field as a spline (landmarks, weights, motion, centre, scale, kernel), or None where nothing is
        displaced; there if the model offers it. It may cost as much as a step: call it when it is needed.
    """

    step: int
    time: float
    pose: NeedlePose
    displacement: Floats
    model: str
    command: Command
    duration: float
    watched: Floats
    reference: Floats | None = None
    frozen: bool = False
    replaying: bool = False
    failure: str | None = None
    spline: Callable[[], object] | None = None


def follow(pose: NeedlePose, command: Command, dt: float, lag: float, fastest: float) -> NeedlePose:
    """Move the needle towards its command as a hand does, without jumps.

    Commands come at the rate of a screen or a tracker, steps at another; taken as they come, the speed of (15)
    would flicker between zero and a multiple of the true one. A first-order lag smooths it.

    Parameters
    ----------
    pose : NeedlePose
        Before the step.
    command : Command
        Where to go.
    dt : float
        Length of the step, s.
    lag : float
        Time constant, s; 0 goes there at once.
    fastest : float
        Upper limit of the speed of tip and entry, mm/s.

    Returns
    -------
    NeedlePose
        After the step; its speed is the axial speed of the tip relative to the entry, mm/s.
    """
    share = 1.0 - exp(-dt / lag) if lag > 0 else 1.0
    entry = _towards(pose.entry, command.entry, share, fastest * dt)
    tip = _towards(pose.tip, command.tip, share, fastest * dt)
    moved = NeedlePose(entry, tip)
    axis = moved.axis if moved.depth > ZERO_LENGTH else pose.axis
    along = (
        (tip[0] - entry[0]) - (pose.tip[0] - pose.entry[0]),
        (tip[1] - entry[1]) - (pose.tip[1] - pose.entry[1]),
    )
    return replace(moved, speed=(along[0] * axis[0] + along[1] * axis[1]) / dt)


def _towards(
    start: tuple[float, float], goal: tuple[float, float], share: float, longest: float
) -> tuple[float, float]:
    dx, dy = goal[0] - start[0], goal[1] - start[1]
    distance = hypot(dx, dy)
    step = min(share * distance, longest)
    if distance - step < ARRIVED:
        return goal
    return (start[0] + dx * step / distance, start[1] + dy * step / distance)


def insert_straight(model: AnyModel, pose: NeedlePose, speed: float = 10.0, stride: float = 0.5) -> object:
    """State of a model whose needle went straight to a pose: what a model switched to starts from.

    Parameters
    ----------
    model : TissueModel
        Any.
    pose : NeedlePose
        Where the needle is.
    speed : float
        Of the insertion, mm/s.
    stride : float
        Length of one step, mm.
    """
    state = model.rest()
    depth, axis = pose.depth, pose.axis
    steps = int(np.ceil(depth / stride))
    for k in range(1, steps + 1):
        s = depth * k / steps
        tip = (pose.entry[0] + s * axis[0], pose.entry[1] + s * axis[1])
        state = model.advance(state, NeedlePose(pose.entry, tip, speed), depth / steps / speed)
    return state


@dataclass
class _Requests:
    """What was asked for since the last step: the newest of each kind."""

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

    `step` advances it by one period; who calls it (a `Pacer`'s thread, a test) decides the clock. All
    other methods may be called from any thread; they take effect at the next step, the newest of a kind
    winning. A model that raises stops the engine, not the program: the snapshot says why, until a reset.

    Parameters
    ----------
    models : callable
        Model factory.
    name : str
        The model to begin with.
    home : NeedlePose
        Where the needle begins and where `reset` takes it; usually of zero depth.
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
        """Say where the needle shall go, mm; the newest command wins.

        Raises
        ------
        InputError
            If a number is not finite.
        """
        NeedlePose(entry, tip)
        with self._lock:
            self._requests.command = Command(entry, tip, number, sent)

    def place(self, entry: tuple[float, float], tip: tuple[float, float]) -> None:
        """Put the needle here as if it had gone straight to this pose, mm: a tracker first sees it inserted.

        Raises
        ------
        InputError
            If a number is not finite.
        """
        pose = NeedlePose(entry, tip)
        with self._lock:
            self._requests.place, self._requests.command = pose, Command(entry, tip)

    def reset(self) -> None:
        """Take the needle home and the tissue to rest; also ends a replay and a failure."""
        with self._lock:
            asked = self._requests
            self._requests = _Requests(
                reset=True, frozen=False, model=asked.model, compare=asked.compare, watch=asked.watch
            )

    def freeze(self, on: bool) -> None:
        """Let time stand still, or run again."""
        with self._lock:
            self._requests.frozen = on

    def switch(self, name: str) -> None:
        """Change the model and keep the pose; the new model's needle went there straight."""
        with self._lock:
            self._requests.model = name

    def compare(self, name: str | None) -> None:
        """Step a second model in the same pose, so that their difference can be shown; None ends it."""
        with self._lock:
            self._requests.compare = (name,)

    def watch(self, points: ArrayLike) -> None:
        """Report where these reference points, shape (k, 2) mm, move to."""
        checked = np.empty((0, 2)) if np.size(points) == 0 else as_points(points, "watched points")
        with self._lock:
            self._requests.watch = checked

    def replay(self, poses: Iterable[NeedlePose]) -> None:
        """Take the needle home and the tissue to rest, then one recorded pose per step instead of commands."""
        with self._lock:
            self._requests.replay = deque(poses)

    def observe(self, callback: Callable[[Snapshot], None]) -> None:
        """Call ``callback`` with every snapshot, in the stepping thread (a recorder misses no step)."""
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
        except Exception as error:  # a model may fail in any way; the server and its other clients live on
            log.exception("the model %s failed", self._name)
            self._failure = f"{type(error).__name__}: {error}"
            last = self.snapshots.latest()
            assert last is not None  # the constructor put one
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
        if len(watched):  # as the picture shows them: bilinear between nodes
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


class Metronome:
    """Says when the next step is due; time lost beyond a few periods is given up, not made up in a burst.

    Parameters
    ----------
    period : float
        Between steps, s.
    now : float
        The clock at the first step, s.
    slack : int
        Periods that may be made up.
    """

    def __init__(self, period: float, now: float, slack: int = 4) -> None:
        self.period, self.slack = period, slack
        self.missed = 0
        """Steps given up so far."""
        self._due = now

    def wait(self, now: float) -> float:
        """Seconds to sleep until the next step, 0 if it is due; each call counts one step."""
        self._due += self.period
        behind = (now - self._due) / self.period
        if behind > self.slack:
            self.missed += int(behind)
            self._due = now
        return max(0.0, self._due - now)


class Pacer:
    """Steps an engine by the clock in a thread of its own, until stopped; use it as a context."""

    def __init__(self, engine: LiveEngine, clock: Callable[[], float] = time.monotonic) -> None:
        self.engine, self._clock = engine, clock
        self._stop = threading.Event()
        self._metronome = Metronome(engine.period, clock())
        self._thread = threading.Thread(target=self._run, name="echospline-engine", daemon=True)

    @property
    def missed(self) -> int:
        """Steps that were given up because the machine was busy."""
        return self._metronome.missed

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin to step."""
        self._metronome = Metronome(self.engine.period, self._clock())
        self._thread.start()

    def stop(self, timeout: float = 5.0) -> None:
        """End the thread and wait for it."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout)

    def __enter__(self) -> Pacer:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _run(self) -> None:
        while not self._stop.is_set():
            self.engine.step()
            self._stop.wait(self._metronome.wait(self._clock()))
