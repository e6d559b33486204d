"""A slot that holds the newest value and no queue."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

T = TypeVar("T")


class Numbered(NamedTuple, Generic[T]):
    """A value with its number in the order of arrival, the first being 1."""

    number: int
    value: T


class Slot(Generic[T]):
    """Holds the newest value alone: a slow reader misses values and never gets old ones.

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

        It runs in the thread that puts the value (or in this one, if the value is already present): keep it
        short. An event loop can wait in this way without a thread of its own.
        """
        with self._changed:
            here = self._is_newer(than)
            if not here:
                self._callbacks.append(callback)
        if here:
            callback()

    def _is_newer(self, than: int) -> bool:
        return self._newest is not None and self._newest.number > than
