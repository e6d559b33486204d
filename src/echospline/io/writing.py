"""Write a cine frame by frame; only a complete file has its final name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from math import isfinite
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np

from echospline.atomic import give_name, part_of, writing
from echospline.errors import InputError
from echospline.scene import Pixels, RegularGrid, is_number, shades

FORMATS = (".mp4", ".gif", ".mha")


TRANSPARENT = ("png", "mha")
"""Formats of `output.formats` that hold opacity."""


def needs_window(formats: Iterable[str], dtype: np.dtype[np.generic], *, transparent: bool = False) -> bool:
    """Test whether a format of `output.formats` cannot hold pixels of a type, so that they need a window.

    MP4 and GIF hold 8 bits, PNG 8 and 16 (8 with opacity), the others any type.
    """
    if dtype == np.dtype(np.uint8):
        return False
    deep = dtype == np.dtype(np.uint16) and not transparent
    return any(name in ("mp4", "gif") or (name == "png" and not deep) for name in formats)


class Encoder(Protocol):
    """Turns checked frames into the bytes of one format, under a temporary name."""

    def add(self, pixels: Pixels, time: float) -> None:
        """Write one frame; time in s."""

    def finish(self) -> Path:
        """Complete the file and return its (still temporary) path."""

    def abandon(self) -> None:
        """Close open files and keep the partial file."""


class CineWriter:
    """Writes frames one by one to one file or folder and keeps none in memory.

    Until `close`, the file is called ``NAME.xxxxxxxx.part``, which no other writer uses; `close` completes it and renames it in
    one step. If the ``with`` block ends with an exception, or the process dies, it remains under that name with the frames so
    far, readable, and an earlier file NAME is unchanged.

    Parameters
    ----------
    path : Path
        Final name.
    grid : RegularGrid
        Pixel centres of every frame, mm.
    encoder : callable
        ``encoder(part, grid, channels, dtype)`` opens the temporary file.
    types : tuple of dtype
        Pixel types the format holds; empty for any.
    window : (low, high), optional
        Pixel values shown as black and white, for pixels of other types.
    transparent : bool
        Whether the format holds a fourth channel, opacity.
    """

    def __init__(
        self,
        path: Path,
        grid: RegularGrid,
        encoder: Callable[[Path, RegularGrid, int, np.dtype[np.generic]], Encoder],
        types: tuple[np.dtype[np.generic], ...] = (),
        window: tuple[float, float] | None = None,
        *,
        transparent: bool = False,
    ) -> None:
        self.path = path
        self.grid = grid
        self.count = 0
        self._open, self._types, self._window = encoder, types, window
        self._part = part_of(path)
        self._channels = (3, 4) if transparent else (3,)
        self._encoder: Encoder | None = None
        self._last = -np.inf
        self._form: tuple[tuple[int, ...], np.dtype[np.generic]] | None = None
        self._closed = False

    def add(self, pixels: Pixels, time: float) -> None:
        """Write one frame.

        Parameters
        ----------
        pixels : ndarray, shape (rows, columns) or (rows, columns, 3)
            Grey or RGB (RGBA in `TRANSPARENT` formats), of one shape and type for all frames.
        time : float
            s; later than the frame before.

        Raises
        ------
        InputError
            If the frame does not fit the grid, the format or the frames before.
        """
        if self._closed:
            raise InputError(f"{self.path} is closed: no frame can be added")
        pixels = np.asarray(pixels)
        form = (pixels.shape, pixels.dtype)
        rows_columns = (self.grid.shape[1], self.grid.shape[0])
        shapes = (rows_columns, *((*rows_columns, n) for n in self._channels))
        if pixels.shape not in shapes or self._form not in (None, form):
            expected = f"{self._form[0]} {self._form[1]}" if self._form else " or ".join(map(str, shapes))
            raise InputError(
                f"a frame of {self.path.name} must be {expected}; got {pixels.shape} {pixels.dtype}"
            )
        if not isfinite(time) or time <= self._last:
            raise InputError(
                f"a frame of {self.path.name} must be later than the one before at {self._last} s; got {time} s"
            )
        pixels = self._fitting(pixels)
        if self._encoder is None:
            self._form = form
            with writing(self.path):
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._encoder = self._open(
                    self._part, self.grid, pixels.shape[2] if pixels.ndim == 3 else 1, pixels.dtype
                )
        with writing(self.path):
            self._encoder.add(pixels, float(time))
        self._last = float(time)
        self.count += 1

    def close(self) -> None:
        """Complete the file and give it its final name; a second call does nothing.

        Raises
        ------
        InputError
            If no frame was added or the file cannot be written.
        """
        if self._closed:
            return
        self._closed = True
        if self._encoder is None:
            raise InputError(f"no frame was added to {self.path}: a cine needs one or more")
        with writing(self.path):
            give_name(self._encoder.finish(), self.path)
            self._part.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        elif not self._closed:
            self._closed = True
            if self._encoder is not None:
                # the error on its way says what is wrong: a full disk takes no trailer either
                with suppress(OSError, ValueError, RuntimeError):
                    self._encoder.abandon()

    def _fitting(self, pixels: Pixels) -> Pixels:
        if not self._types or (pixels.dtype in self._types and self._window is None):
            return pixels
        if self._window is None:
            raise InputError(
                f"{self.path.name} holds pixels of {', '.join(str(t) for t in self._types)}; got {pixels.dtype}: "
                "give window=(low, high), the values shown as black and white"
            )
        return shades(pixels, *self._window)


def open_writer(
    path: str | Path, grid: RegularGrid, fps: float = 30.0, *, window: tuple[float, float] | None = None
) -> CineWriter:
    """Open a cine for writing; the name's suffix chooses the format.

    Parameters
    ----------
    path : str or Path
        ``.mp4`` (H.264, plays in browsers), ``.gif``, ``.mha`` (sequence for ITK, 3D Slicer, PLUS), or a name
        without suffix: a folder of numbered PNG files with ``times.csv``.
    grid : RegularGrid
        Pixel centres of every frame, mm.
    fps : float
        Nominal frames per second; each frame's own time decides; this sets only the duration of the last one.
    window : (low, high), optional
        Pixel values shown as black and white. Needed for pixels other than 8-bit in MP4 and GIF (8 and 16-bit
        in PNG); values outside are shown as black or white.

    Raises
    ------
    InputError
        If the suffix is another, or fps or window is out of range.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if not (is_number(fps) and fps > 0):
        raise InputError(f"fps must be a positive number of frames per second; got {fps}")
    if window is not None and not (len(window) == 2 and np.isfinite(window).all() and window[0] < window[1]):
        raise InputError(f"window must be two pixel values, low before high; got {window}")
    byte = np.dtype(np.uint8)
    # The encoders' libraries are large: each is imported when a file of its kind is written.
    if suffix == ".mp4":
        from echospline.io.mp4 import Mp4Encoder  # noqa: PLC0415

        return CineWriter(path, grid, lambda p, g, c, t: Mp4Encoder(p, g, c > 1, fps), (byte,), window)
    if suffix == ".gif":
        from echospline.io.gif import GifEncoder  # noqa: PLC0415

        return CineWriter(path, grid, lambda p, g, c, t: GifEncoder(p, g, c > 1, fps), (byte,), window)
    if suffix == ".mha":
        from echospline.io.metaimage import MetaImageEncoder  # noqa: PLC0415

        return CineWriter(
            path, grid, lambda p, g, c, t: MetaImageEncoder(p, g, c, t, fps), (), window, transparent=True
        )
    if suffix == "":
        from echospline.io.frames import FramesEncoder  # noqa: PLC0415

        return CineWriter(
            path,
            grid,
            lambda p, g, c, t: FramesEncoder(p, g, path),
            (byte, np.dtype(np.uint16)),
            window,
            transparent=True,
        )
    raise InputError(
        f"a cine is written as {', '.join(FORMATS)} or to a folder of PNG files (no suffix); got {path.name!r}"
    )
