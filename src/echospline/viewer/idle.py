"""Connections that do nothing are closed: unfinished headers, bodies that nobody asked for, answers that nobody reads."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from typing import Any

HEADERS = 10.0
"""s; a connection without a request for so long is closed (uvicorn itself closes those that were silent for 5 s, but
a byte now and then keeps them open)."""
STALL = 20.0
"""s without a byte taken before a client that has bytes waiting for it counts as gone."""
PAUSE = 1.0
"""s between two looks."""


class Watch:
    """What a connection has done since the last look.

    Parameters
    ----------
    now : float
        s.
    """

    def __init__(self, now: float) -> None:
        self._cycle: object = None
        self._waiting = 0
        self._since = self._moved = now

    def is_gone(self, connection: Any, now: float) -> bool:
        """Look at a connection of uvicorn; returns whether it must be closed."""
        transport = connection.transport
        if transport is None:
            return False
        waiting = transport.get_write_buffer_size()
        if waiting == 0 or waiting != self._waiting:
            self._waiting, self._moved = waiting, now
        cycle = getattr(
            connection, "cycle", self
        )  # a web socket has none: its pings find out whether it lives
        served = cycle is not None and not getattr(cycle, "response_complete", False)
        # An answer may be complete for uvicorn while most of it waits to be taken.
        if served or waiting or cycle is not self._cycle:
            self._cycle, self._since = cycle, now
        return now - self._since > HEADERS or now - self._moved > STALL


async def close_idle(connections: Collection[Any]) -> None:
    """Look at uvicorn's connections once a second and close those that do nothing, until cancelled."""
    clock = asyncio.get_running_loop().time
    watches: dict[Any, Watch] = {}
    while True:
        await asyncio.sleep(PAUSE)
        now = clock()
        watches = {one: watches.get(one) or Watch(now) for one in list(connections)}
        for one, watch in watches.items():
            if watch.is_gone(one, now):
                one.transport.abort()
