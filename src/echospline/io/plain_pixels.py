"""Frames of volume files whose pixels are raw or deflated: one is read at a time, whatever the length of the file."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np

from echospline.errors import InputError
from echospline.scene import Pixels

_BLOCK = 2**20


@dataclass(frozen=True)
class Layout:
    """Place and form of the pixels.

    Parameters
    ----------
    path : Path
        The file that holds them.
    offset : int
        Of the first byte; in the inflated content when ``whole_packed``.
    frames, rows, columns, channels : int
        Columns fastest, frames slowest; with ``listed`` the frames are fastest.
    dtype : dtype
        With its byte order.
    packed : bool
        Whether they are deflated (zlib or gzip).
    whole_packed : bool
        Whether the whole file is, header and all (.nii.gz).
    listed : bool
        Whether the frames are the fastest axis.
    """

    path: Path
    offset: int
    frames: int
    rows: int
    columns: int
    channels: int
    dtype: np.dtype[Any]
    packed: bool = False
    whole_packed: bool = False
    listed: bool = False

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame."""
        return prod((self.rows, self.columns, self.channels)) * self.dtype.itemsize

    def read(self, frame: int | None) -> Iterator[Pixels]:
        """Yield the frames, or one of them, each (rows, columns[, 3]) as stored, in native byte order; a fourth channel is left out.

        Raises
        ------
        InputError
            If the file ends before its last pixel.
        """
        native = self.dtype.newbyteorder("=")
        if self.listed:
            stack = np.frombuffer(next(self._pieces(None, self.frame_bytes * self.frames)), self.dtype)
            stack = np.moveaxis(stack.reshape(self.rows, self.columns, self.frames), -1, 0)
            for picked in stack if frame is None else stack[frame : frame + 1]:
                yield picked.astype(native)
            return
        shape = (self.rows, self.columns, self.channels) if self.channels > 1 else (self.rows, self.columns)
        for piece in self._pieces(frame, self.frame_bytes):
            pixels = np.frombuffer(piece, self.dtype).reshape(shape).astype(native)
            yield pixels[..., :3] if self.channels == 4 else pixels

    def _pieces(self, frame: int | None, size: int) -> Iterator[bytes]:
        count = 1 if self.listed else self.frames
        with self.path.open("rb") as file:
            if self.packed:
                source: IO[bytes] | Inflated = Inflated(file, 0 if self.whole_packed else self.offset)
                source.read(self.offset if self.whole_packed else 0)
            else:
                source = file
                file.seek(self.offset + (frame or 0) * size)
            for i in range(count):
                if frame is not None and not self.packed and i > 0:
                    return
                piece = source.read(size)
                if len(piece) < size:
                    done = ((frame or 0) if not self.packed else 0) + i
                    raise InputError(
                        f"{self.path} declares {count * size} bytes of pixels but ends in number {done * size + len(piece)}: "
                        "it is cut short"
                    )
                if frame is None or not self.packed or i == frame:
                    yield piece
                if frame is not None and self.packed and i == frame:
                    return


class Inflated:
    """Reads a zlib or gzip stream, also one of several members, without ever holding more than was asked for."""

    def __init__(self, file: IO[bytes], offset: int) -> None:
        self._file = file
        file.seek(offset)
        self._inflater = zlib.decompressobj(wbits=32 + 15)
        self._pending = b""

    def read(self, size: int) -> bytes:
        """Return ``size`` bytes, fewer at the end.

        Raises
        ------
        zlib.error
            If the stream is damaged.
        """
        out = bytearray()
        while len(out) < size:
            if self._inflater.eof:
                self._pending = self._inflater.unused_data or self._file.read(_BLOCK)
                if not self._pending.startswith(b"\x1f\x8b"):
                    break
                self._inflater = zlib.decompressobj(wbits=32 + 15)
            if not self._pending:
                self._pending = self._file.read(_BLOCK)
                if not self._pending:
                    break
            out += self._inflater.decompress(self._pending, size - len(out))
            self._pending = self._inflater.unconsumed_tail
        return bytes(out)
