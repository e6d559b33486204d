"""Frames of an animated GIF or PNG, counted by their headers alone: nothing is decoded."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_GIF_HEAD = struct.Struct("<6sHHBBB")
_GIF_IMAGE = struct.Struct("<HHHHB")
_CHUNK = struct.Struct(">I4s")
_FCTL = struct.Struct(">IIIIIHHBB")
EXTENSION, IMAGE, GRAPHIC_CONTROL = 0x21, 0x2C, 0xF9


def gif_delays(path: Path) -> list[float | None]:
    """Return the time for which each frame is shown, ms; None where the file gives none.

    A file that is cut short ends with its last whole frame header.
    """
    with _mapped(path) as data:
        return list(_gif_delays(data))


def png_delays(path: Path) -> list[float | None]:
    """Return the time for which each frame of an animated PNG is shown, ms; empty for a still one."""
    with _mapped(path) as data:
        return list(_png_delays(data))


def _gif_delays(data: bytes | mmap.mmap) -> Iterator[float | None]:
    if len(data) < _GIF_HEAD.size:
        return
    at = _GIF_HEAD.size + _table(data[10])
    delay: float | None = None
    while at + 1 < len(data):
        if data[at] == EXTENSION:
            if data[at + 1] == GRAPHIC_CONTROL and at + 6 < len(data):
                delay = 10.0 * int.from_bytes(data[at + 4 : at + 6], "little")
            at = _blocks_end(data, at + 2)
        elif data[at] == IMAGE and at + _GIF_IMAGE.size < len(data):
            yield delay
            delay = None
            at = _blocks_end(data, at + 1 + _GIF_IMAGE.size + _table(data[at + _GIF_IMAGE.size]) + 1)
        elif data[at] == 0:  # stray zeros between blocks are common
            at += 1
        else:  # the trailer, or nothing that belongs to a GIF
            return


def _table(flags: int) -> int:
    """Return the bytes of a colour table by its flags."""
    return 3 * 2 ** ((flags & 7) + 1) if flags & 0x80 else 0


def _blocks_end(data: bytes | mmap.mmap, at: int) -> int:
    """Return where a chain of blocks ends; each begins with its length, an empty one ends the chain."""
    while at < len(data) and data[at]:
        at += data[at] + 1
    return at + 1


def _png_delays(data: bytes | mmap.mmap) -> Iterator[float | None]:
    at = 8
    while at + _CHUNK.size <= len(data):
        length, name = _CHUNK.unpack_from(data, at)
        if name == b"fcTL" and length == _FCTL.size and at + _CHUNK.size + length <= len(data):
            *_, over, under, _, _ = _FCTL.unpack_from(data, at + _CHUNK.size)
            yield 1000.0 * over / (under or 100)  # 0 stands for 100, by the specification
        at += _CHUNK.size + length + 4


@contextmanager
def _mapped(path: Path) -> Iterator[bytes | mmap.mmap]:
    """Map a file that is not empty; the system reads what is looked at."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        yield data
