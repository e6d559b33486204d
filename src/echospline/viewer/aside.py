"""Work beside the event loop, in daemon threads: none of it delays another request or the end of the program."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")
_running: set[threading.Thread] = set()


async def aside(function: Callable[..., T], *arguments: object) -> T:
    """Call a function in a thread of its own and wait for its result.

    ``asyncio.to_thread`` uses few threads, so that slow calls delay quick ones, and the interpreter waits for all of
    them when it ends. A call that is cancelled here goes on in its thread, without effect.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def settle(result: T | None, error: BaseException | None) -> None:
        if done.done():
            return
        if error is not None:
            done.set_exception(error)
        else:
            done.set_result(result)  # type: ignore[arg-type]  # the function's own result, where it raised nothing

    def run() -> None:
        result, error = None, None
        try:
            result = function(*arguments)
        except BaseException as raised:
            error = raised
        try:
            loop.call_soon_threadsafe(settle, result, error)
        except RuntimeError:  # the loop has ended meanwhile
            return
        finally:
            _running.discard(threading.current_thread())

    thread = threading.Thread(target=run, name="echospline-aside", daemon=True)
    _running.add(thread)
    thread.start()
    return await done


def unfinished(patience: float) -> bool:
    """Wait up to ``patience`` seconds for every call of `aside`; returns whether one goes on nevertheless.

    The interpreter cannot end safely while one does: it takes away what native code is using.
    """
    until = time.monotonic() + patience
    for thread in list(_running):
        thread.join(max(0.0, until - time.monotonic()))
    return any(thread.is_alive() for thread in list(_running))


class Ending:
    """Whether the server is ending: whoever waits for something long waits for this as well."""

    def __init__(self) -> None:
        self._begun = asyncio.Event()

    def begin(self) -> None:
        """End every wait of `first`."""
        self._begun.set()

    async def first(self, work: asyncio.Future[T], timeout: float | None) -> bool:
        """Wait until a work is done (true), or the time is up or the server ends (false)."""
        ending = asyncio.ensure_future(self._begun.wait())
        both: list[asyncio.Future[Any]] = [work, ending]
        try:
            done, _ = await asyncio.wait(both, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
        finally:
            ending.cancel()
        return work in done

    @property
    def begun(self) -> bool:
        """Whether it is ending."""
        return self._begun.is_set()
