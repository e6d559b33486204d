"""An ultrasound image (pixels and the grid of their centres in mm) and a cine (frames and their times)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene.grid import Floats, RegularGrid

Pixels = NDArray[np.generic]


@dataclass(frozen=True)
class UltrasoundImage:
    """One B-mode image.

    Parameters
    ----------
    pixels : ndarray, shape (rows, columns) or (rows, columns, 3)
        [depth, lateral], grey, RGB or RGBA, any integer or float type; row 0 is the probe's face.
    grid : RegularGrid
        Pixel centres in mm; ``grid.shape == (columns, rows)``.
    source : str
        Origin of the picture (file, licence), for reports.
    notes : tuple of str
        Conclusions and doubts of its reader, one sentence each.

    Raises
    ------
    InputError
        If pixels and grid do not fit.
    """

    pixels: Pixels
    grid: RegularGrid
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check_pixels(self.pixels.shape, self.grid)

    @classmethod
    def from_array(cls, pixels: Pixels, spacing: tuple[float, float], source: str = "") -> UltrasoundImage:
        """Wrap an array; ``spacing`` is (lateral, depth) in mm and pixel [0, 0] lies at (0, 0) mm."""
        pixels = np.asarray(pixels)
        if pixels.ndim not in (2, 3):
            raise InputError(
                f"an image has shape (rows, columns) or (rows, columns, 3 or 4); got {pixels.shape}"
            )
        return cls(pixels, RegularGrid((pixels.shape[1], pixels.shape[0]), spacing), source)

    def windowed(self, low: float, high: float) -> UltrasoundImage:
        """Return the image in 8 bits: ``low`` becomes black, ``high`` white, values outside black or white.

        A note says what was done, and how many pixels lie outside.

        Raises
        ------
        InputError
            If low is not below high.
        """
        values: NDArray[Any] = self.pixels[..., :3] if self.pixels.ndim == 3 else self.pixels
        grey = shades(values, low, high)
        outside = float(((values < low) | (values > high)).mean())
        note = f"values {low:g} to {high:g} are shown as black to white in 8 bits"
        if outside > 0:
            note += f"; {outside:.2%} of the pixels lie outside and become black or white"
        return UltrasoundImage(grey, self.grid, f"{self.source}; {note}", (*self.notes, note))

    @property
    def spacing(self) -> tuple[float, float]:
        """(lateral, depth) in mm per pixel."""
        return self.grid.spacing


@dataclass(frozen=True)
class Cine:
    """Frames on one grid, with their times.

    Parameters
    ----------
    frames : ndarray, shape (frames, rows, columns) or (frames, rows, columns, 3)
        Each frame as in `UltrasoundImage`.
    times : ndarray, shape (frames,)
        Seconds, ascending.
    grid : RegularGrid
        Pixel centres in mm.
    source : str
        Origin of the recording.
    notes : tuple of str
        Conclusions and doubts of its reader, one sentence each.

    Raises
    ------
    InputError
        If frames, times and grid do not fit.
    """

    frames: Pixels
    times: Floats
    grid: RegularGrid
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.frames.ndim not in (3, 4) or len(self.frames) == 0:
            raise InputError(
                f"a cine has shape (frames, rows, columns[, 3]) and one frame or more; got {self.frames.shape}"
            )
        _check_pixels(self.frames.shape[1:], self.grid)
        times = np.asarray(self.times, dtype=np.float64)
        if times.shape != (len(self.frames),) or not np.isfinite(times).all() or (np.diff(times) < 0).any():
            raise InputError(
                f"times must be {len(self.frames)} ascending numbers in s, one per frame; got shape {times.shape}"
            )

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[UltrasoundImage]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> UltrasoundImage:
        """Return one frame as an image."""
        return UltrasoundImage(self.frames[index], self.grid, self.source, self.notes)


def shades(pixels: Pixels, low: float, high: float) -> NDArray[np.uint8]:
    """Convert pixels to 8-bit grey: ``low`` becomes 0, ``high`` 255, values outside 0 or 255.

    Raises
    ------
    InputError
        If low is not below high, or a value is not finite.
    """
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(f"window must be two pixel values, low before high; got {(low, high)}")
    shade = (np.asarray(pixels, dtype=np.float64) - low) * (255.0 / (high - low))
    if not np.isfinite(shade).all():
        raise InputError("a picture holds values that are not finite")
    return np.asarray(np.clip(np.rint(shade), 0, 255), dtype=np.uint8)


def _check_pixels(shape: tuple[int, ...], grid: RegularGrid) -> None:
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in (3, 4)):
        raise InputError(f"an image has shape (rows, columns) or (rows, columns, 3 or 4); got {shape}")
    if (shape[1], shape[0]) != grid.shape:
        raise InputError(
            f"an image of {shape[0]} rows and {shape[1]} columns needs a grid of shape "
            f"({shape[1]}, {shape[0]}); got {grid.shape}"
        )
