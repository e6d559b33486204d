"""A file whose header has been read and checked and whose pixels are decoded frame by frame."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline.errors import EchosplineError, InputError
from echospline.scene import Floats, Pixels

Box = tuple[int, int, int, int]
"""(left, top, right, bottom) in pixels of the file; right and bottom lie just outside."""

LIMIT = 2048.0
"""Default limit of a reader, MiB of decoded pixels."""

MIB = 2**20
_ITK_PREFIX = re.compile(r"(?s)^.*itk::?ERROR: \w+\(0x[0-9a-f]+\): |^.*ITK ERROR: \w+\(0x[0-9a-f]+\): ")
"""Source lines and addresses that ITK puts before its message."""
LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in grey: ITU-R BT.601, the matrix of DICOM's YBR_FULL too."""


@dataclass(frozen=True)
class Region:
    """A part of the picture that the file itself describes (a DICOM ultrasound region).

    Parameters
    ----------
    box : (left, top, right, bottom)
        Pixels of the file, right and bottom just outside.
    spacing : (lateral, depth) or None
        mm per pixel; None where the region has no lengths (a spectrum, an M-mode trace).
    content : str
        Its content, e.g. "2-D tissue".
    """

    box: Box
    spacing: tuple[float, float] | None
    content: str


@dataclass(frozen=True)
class Recording:
    """The declared properties of a file, and access to its pixels.

    Parameters
    ----------
    path : Path
        The file.
    format : str
        Name of the format, for display.
    rows, columns : int
        Size of one frame.
    frames : int
        Number of frames.
    channels : int
        1 (grey) or 3 (RGB).
    dtype : dtype
        Of the decoded pixels.
    decode : callable
        ``decode(None, colour)`` yields every frame, ``decode(i, colour)`` frame i alone, each
        (rows, columns) or (rows, columns, 3); without ``colour`` a decoder may give grey where that is quicker.
    spacing : (lateral, depth), optional
        mm per pixel, where the file has it.
    region : Box, optional
        The part that shows tissue; the whole frame when None.
    regions : tuple of Region
        All regions the file describes.
    times : ndarray, shape (frames,), optional
        Seconds since the first frame, where the file has them.
    single : bool
        Whether the file is a still image (then one frame is read as an image, not as a cine).
    notes : tuple of str
        Conclusions and doubts of the reader, one sentence each.
    aspect : float, optional
        Width over height of a pixel, where the file says it.
    untimed : str
        Why the file's own times were of no use; empty where it has none or they were.
    valid : ndarray, shape (frames,), bool, optional
        Frames that the file calls good; all of them when None.
    volume : bool
        Whether the third axis is a direction in space, so that "frames" are slices.
    window : (low, high), optional
        Values that the file asks to be shown as black and white.
    """

    path: Path
    format: str
    rows: int
    columns: int
    frames: int
    channels: int
    dtype: np.dtype[Any]
    decode: Callable[[int | None, bool], Iterator[Pixels]] = field(repr=False)
    spacing: tuple[float, float] | None = None
    region: Box | None = None
    regions: tuple[Region, ...] = ()
    times: Floats | None = None
    single: bool = False
    notes: tuple[str, ...] = ()
    aspect: float | None = None
    untimed: str = ""
    valid: NDArray[np.bool_] | None = None
    volume: bool = False
    window: tuple[float, float] | None = None

    @property
    def decoded_mib(self) -> float:
        """MiB of all decoded frames together."""
        return self.rows * self.columns * self.channels * self.dtype.itemsize * self.frames / MIB

    @property
    def kept(self) -> NDArray[np.intp]:
        """Numbers of the good frames, ascending."""
        return np.arange(self.frames) if self.valid is None else np.flatnonzero(self.valid)

    def spacing_of(self, box: Box) -> tuple[float, float] | None:
        """Return the spacing in mm of the region that holds a box's centre; the file's own outside of all."""
        x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
        for region in self.regions:
            left, top, right, bottom = region.box
            if region.spacing and left <= x < right and top <= y < bottom:
                return region.spacing
        return self.spacing


def check_size(path: Path, rows: int, columns: int, frames: int, bytes_per_pixel: int, limit: float) -> None:
    """Refuse a declared size beyond ``limit`` (MiB) before anything is allocated.

    Raises
    ------
    InputError
        If the size is not positive or too large.
    """
    if min(rows, columns, frames) < 1:
        raise InputError(
            f"{path} declares {frames} frames of {columns} x {rows} pixels; expected one or more of each: "
            "the file is damaged"
        )
    size = rows * columns * frames * bytes_per_pixel / MIB
    if size > limit:
        raise InputError(
            f"{path} declares {frames} x {columns} x {rows} pixels = {size:,.0f} MiB, more than the limit of "
            f"{limit:,.0f} MiB: take one frame, or raise the limit if the file is trusted"
        )


def to_grey(pixels: Pixels) -> Pixels:
    """Return the luma of an RGB frame in its own type, rounded; a grey frame unchanged."""
    if pixels.ndim == 2:
        return pixels
    kind = np.float32 if pixels.dtype.itemsize == 1 else np.float64
    grey: Pixels = pixels.astype(kind) @ LUMA.astype(kind)
    return (np.rint(grey) if np.issubdtype(pixels.dtype, np.integer) else grey).astype(pixels.dtype)


@contextmanager
def decoding(path: Path, what: str) -> Iterator[None]:
    """Turn any error of a decoder on a damaged file into one sentence.

    Decoders raise struct.error, KeyError, EOFError, SyntaxError and a dozen exceptions of
    their own on damaged bytes, so every Exception is caught; echospline's own errors pass.
    """
    try:
        yield
    except EchosplineError:
        raise
    except MemoryError:
        raise InputError(
            f"{path} needs more memory than there is: take one frame or a smaller file"
        ) from None
    except Exception as error:
        reason = " ".join(_ITK_PREFIX.sub("", str(error)).split())[:160] or type(error).__name__
        raise InputError(
            f"{path} is damaged or cut short: expected a whole {what} file, but its decoder says: {reason}"
        ) from error


def quietly(frames: Iterator[Pixels], quiet: Callable[[], AbstractContextManager[None]]) -> Iterator[Pixels]:
    """Decode each frame inside ``quiet`` and yield it outside, where the caller's warnings apply."""
    while True:
        with quiet():
            pixels = next(frames, None)
        if pixels is None:
            return
        yield pixels
