"""A clock that steps an engine in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol


class Stepped(Protocol):
    """What a pacer steps: an engine, in the plane or in space."""

    @property
    def period(self) -> float:
        """Time between steps, s."""
        ...

    def step(self) -> object:
        """Advance by one period."""
        ...


class Metronome:
    """Computes when the next step is due; time lost beyond a few periods is given up, not made up in a burst.

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
        """Return the seconds to sleep until the next step, 0 if it is due; each call counts one step."""
        self._due += self.period
        behind = (now - self._due) / self.period
        if behind > self.slack:
            self.missed += int(behind)
            self._due = now
        return max(0.0, self._due - now)


class Pacer:
    """Steps an engine by the clock in a thread of its own, until stopped; use it as a context."""

    def __init__(self, engine: Stepped, clock: Callable[[], float] = time.monotonic) -> None:
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
        """Start to step the engine."""
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
