"""The check sum of an OpenIGTLink body: CRC-64 of ECMA-182 (polynomial 0x42F0E1EBA9EA3693, no reflection, start 0)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

POLYNOMIAL = 0x42F0E1EBA9EA3693
WIDTH = 16
"""Bytes handled in one step of the loop ("slicing by 16"); each needs a table of its own."""

Tables = NDArray[np.uint64]
Loop = Callable[[NDArray[np.uint8], Tables], Any]


def crc64(data: bytes | bytearray | memoryview) -> int:
    """Check sum of ``data``, 0 <= value < 2**64.

    The first call in a process compiles (half a second, kept on disk afterwards); `warm_up` moves that
    time out of a running link.
    """
    loop, tables = _compiled()
    return int(loop(np.frombuffer(data, dtype=np.uint8), tables))


def warm_up() -> None:
    """Compile the loop now."""
    crc64(b"")


@cache
def _compiled() -> tuple[Loop, Tables]:
    # numba takes half a second to import: it is imported only when a link is opened.
    import numba  # noqa: PLC0415

    return numba.njit(_loop, nogil=True, cache=True), _tables()


def _tables() -> Tables:
    """Build the tables, shape (WIDTH, 256): table k holds the check sum of each byte followed by k zero bytes."""
    first = []
    for byte in range(256):
        value = byte << 56
        for _ in range(8):
            value = (value << 1) ^ (POLYNOMIAL if value >> 63 else 0)
            value &= 0xFFFFFFFFFFFFFFFF
        first.append(value)
    tables = np.empty((WIDTH, 256), dtype=np.uint64)
    tables[0] = first
    for k in range(1, WIDTH):
        high = (tables[k - 1] >> np.uint64(56)).astype(np.intp)
        tables[k] = (tables[k - 1] << np.uint64(8)) ^ tables[0][high]
    return tables


def _loop(data: NDArray[np.uint8], tables: Tables) -> Any:
    crc = np.uint64(0)
    i, whole = 0, data.size - data.size % 16
    while i < whole:
        # the sixteen look-ups do not wait for each other: that is the whole gain over byte by byte
        value = np.uint64(0)
        for k in range(8):
            value ^= tables[15 - k, data[i + k] ^ np.uint8((crc >> np.uint64(56 - 8 * k)) & np.uint64(255))]
        for k in range(8, 16):
            value ^= tables[15 - k, data[i + k]]
        crc = value
        i += 16
    while i < data.size:
        crc = tables[0, np.uint8(crc >> np.uint64(56)) ^ data[i]] ^ (crc << np.uint64(8))
        i += 1
    return crc
