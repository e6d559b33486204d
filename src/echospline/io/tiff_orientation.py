"""Orientation tags of a TIFF file, read and reset without its decoder.

Pillow 13 turns pages by their tag while it loads them, and mixes up width and height of those that lie on their side. So
the tags are read here, a copy in memory without them is decoded, and `echospline.io.declared` turns the pixels.
"""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path

_ORIENTATION, _SHORT = 274, 3
_MOST_PAGES = 100_000


def tiff_orientation(path: Path) -> tuple[int, tuple[int, ...]]:
    """Return the orientation (1 to 8; 1 is as stored) of the first page, and where every page's value lies in the file.

    Raises
    ------
    struct.error
        If a directory is cut short.
    """
    places: list[int] = []
    first = 1
    with path.open("rb") as file:
        start = file.read(16)
        order = "<" if start[:2] == b"II" else ">"
        big = struct.unpack(order + "H", start[2:4])[0] == 43
        count, entry, offset = ("Q", 20, "Q") if big else ("H", 12, "I")
        at = struct.unpack(order + offset, start[8:16] if big else start[4:8])[0]
        seen: set[int] = set()
        while at and at not in seen and len(seen) < _MOST_PAGES:
            seen.add(at)
            file.seek(at)
            size = struct.calcsize(count)
            (entries,) = struct.unpack(order + count, file.read(size))
            if entries > 65535:
                break
            table = file.read(entries * entry)
            for i in range(len(table) // entry):
                tag, kind = struct.unpack_from(order + "HH", table, i * entry)
                if tag == _ORIENTATION and kind == _SHORT:
                    value = i * entry + (12 if big else 8)
                    if len(seen) == 1:
                        (first,) = struct.unpack_from(order + "H", table, value)
                    places.append(at + size + value)
            step = struct.calcsize(offset)
            at = struct.unpack(order + offset, file.read(step).ljust(step, b"\0"))[0]
    return (first if 1 <= first <= 8 else 1), tuple(places)


def without_orientation(path: Path, places: tuple[int, ...]) -> BytesIO:
    """Return a copy of the file whose pages are all as stored."""
    content = bytearray(path.read_bytes())
    order = "<" if content[:2] == b"II" else ">"
    for place in places:
        if place + 2 <= len(content):
            struct.pack_into(order + "H", content, place, 1)
    return BytesIO(bytes(content))
