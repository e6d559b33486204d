"""Block structure of a GIF: number of frames and their delays, without decoding a pixel."""

from __future__ import annotations

from pathlib import Path
from typing import IO

_EXTENSION, _IMAGE, _TRAILER = 0x21, 0x2C, 0x3B
_CONTROL = 0xF9


def gif_delays(path: Path) -> list[float | None]:
    """Return the delay of every frame in ms, None where a frame declares none or 0.

    A file that ends early gives the frames whose pixels have begun, as decoders show them.

    Raises
    ------
    ValueError
        If a block is of no known kind.
    """
    delays: list[float | None] = []
    delay: float | None = None
    with path.open("rb") as file:
        start = file.read(13)
        _skip_palette(file, start[10] if len(start) == 13 else 0)
        while mark := file.read(1):
            if mark[0] == _TRAILER:
                break
            if mark[0] == _EXTENSION:
                label = file.read(1)
                first = _block(file)
                if label and label[0] == _CONTROL and len(first) >= 4:
                    delay = 10.0 * int.from_bytes(first[1:3], "little") or None
                while first:
                    first = _block(file)
            elif mark[0] == _IMAGE:
                descriptor = file.read(9)
                _skip_palette(file, descriptor[8] if len(descriptor) == 9 else 0)
                file.read(1)  # size of the first code
                delays.append(delay)
                delay = None
                while _block(file):
                    pass
            elif mark[0] != 0:  # stray zeros between blocks are common
                raise ValueError(f"a GIF block of kind {mark[0]:#x}")
    return delays


def _skip_palette(file: IO[bytes], flags: int) -> None:
    """Skip the table of colours that the flags declare."""
    if flags & 0x80:
        file.seek(3 << ((flags & 7) + 1), 1)


def _block(file: IO[bytes]) -> bytes:
    """Return the next sub-block; empty at the end of a chain or of the file."""
    size = file.read(1)
    return file.read(size[0]) if size else b""
