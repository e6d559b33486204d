"""An ultrasound image (pixels and the grid of their centres in mm) and a cine (frames and their times)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

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


def _check_pixels(shape: tuple[int, ...], grid: RegularGrid) -> None:
    if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in (3, 4)):
        raise InputError(f"an image has shape (rows, columns) or (rows, columns, 3 or 4); got {shape}")
    if (shape[1], shape[0]) != grid.shape:
        raise InputError(
            f"an image of {shape[0]} rows and {shape[1]} columns needs a grid of shape "
            f"({shape[1]}, {shape[0]}); got {grid.shape}"
        )
