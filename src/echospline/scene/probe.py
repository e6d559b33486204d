"""A probe as a hand holds it: the shape of its picture and the thickness of its slice; its place is an `ImagingPlane`.

The frame of the picture: x lateral from the middle of the probe's face, y depth from there, z across the slice, mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import cos, floor, isfinite, radians, sin
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene.grid import Floats, RegularGrid

MOST_PIXELS = 4096
"""Columns or rows of a picture."""


@dataclass(frozen=True)
class Probe:
    """Shape of a probe's picture and of its beam across the slice.

    Parameters
    ----------
    shape : {"linear", "curved"}
        A linear array sees a rectangle, a curved one a sector.
    width : float
        Of a linear array's face, mm.
    radius : float
        Of a curved array's face, mm.
    opening : float
        Angle of its sector, degrees, below 180.
    depth : float
        Of the picture, mm.
    pixel : float
        Size of a pixel, mm.
    elevation : float
        Half-thickness of the slice at its focus: sigma of the echo's amplitude across it, mm; 0 is an infinitely thin slice.
    elevation_depth : float
        Depth of that focus, mm.
    element_height : float
        Height of the array across the slice, mm: the slice is thicker off its focus.

    Raises
    ------
    InputError
        If a number is out of its range, or the picture would have too many pixels.
    """

    shape: Literal["linear", "curved"] = "linear"
    width: float = 40.0
    radius: float = 60.0
    opening: float = 60.0
    depth: float = 40.0
    pixel: float = 0.1
    elevation: float = 0.75
    elevation_depth: float = 18.0
    element_height: float = 5.0

    def __post_init__(self) -> None:
        if self.shape not in ("linear", "curved"):
            raise InputError(f"shape of a probe is linear or curved; got {self.shape!r}")
        limits = {
            "width": (1.0, 500.0, "mm"),
            "radius": (1.0, 500.0, "mm"),
            "opening": (1.0, 179.0, "degrees"),
            "depth": (1.0, 500.0, "mm"),
            "pixel": (0.005, 10.0, "mm"),
            "elevation": (0.0, 100.0, "mm"),
            "elevation_depth": (0.1, 1000.0, "mm"),
            "element_height": (0.0, 200.0, "mm"),
        }
        for name, (low, high, unit) in limits.items():
            value = getattr(self, name)
            if not (isfinite(value) and low <= value <= high):
                raise InputError(f"{name} of a probe must lie from {low:g} to {high:g} {unit}; got {value}")
        if max(self._pixels) > MOST_PIXELS:
            columns, rows = self._pixels
            raise InputError(
                f"the probe's picture would have {columns} x {rows} pixels of {self.pixel:g} mm; at most {MOST_PIXELS} "
                "each: give larger pixels or a smaller depth"
            )

    @property
    def half_width(self) -> float:
        """Largest lateral distance that the picture shows, mm."""
        if self.shape == "linear":
            return self.width / 2
        return (self.radius + self.depth) * sin(radians(min(self.opening, 179.0)) / 2)

    @property
    def top(self) -> float:
        """Depth of the picture's first row, mm: a curved face recedes from its middle."""
        return 0.0 if self.shape == "linear" else self.radius * (cos(radians(self.opening) / 2) - 1.0)

    @property
    def _pixels(self) -> tuple[int, int]:
        columns = 2 * floor(self.half_width / self.pixel + 1e-9) + 1
        return columns, floor((self.depth - self.top) / self.pixel + 1e-9) + 1

    @cached_property
    def grid(self) -> RegularGrid:
        """Pixel centres of the picture; the middle column is x = 0."""
        columns, rows = self._pixels
        return RegularGrid(
            (columns, rows), (self.pixel, self.pixel), (-(columns // 2) * self.pixel, self.top)
        )

    @property
    def apex(self) -> tuple[float, float] | None:
        """Where a curved array's beams cross, mm; None for a linear one."""
        return None if self.shape == "linear" else (0.0, -self.radius)

    def sees(self, points: Floats) -> NDArray[np.bool_]:
        """Test which points (n, 2) of the picture's plane the beams reach, shape (n,)."""
        x, y = points.T
        half = 1e-9 + self.pixel / 2
        inside: NDArray[np.bool_]
        if self.shape == "linear":
            inside = (np.abs(x) <= self.width / 2 + half) & (y >= -half) & (y <= self.depth + half)
            return inside
        r, angle = np.hypot(x, y + self.radius), np.arctan2(np.abs(x), y + self.radius)
        inside = (r >= self.radius - half) & (r <= self.radius + self.depth + half)
        inside &= angle <= radians(self.opening) / 2 + 1e-9
        return inside

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """Pixels that the beams reach, shape (rows, columns)."""
        mask = self.sees(self.grid.nodes).reshape(self.grid.shape[::-1])
        mask.setflags(write=False)
        return mask

    def thickness(self, depth: Floats) -> Floats:
        """Sigma of the slice across its plane at depths (mm), mm: that of the needle's echo.

        It widens from its focus as the beam of an array of this height does.
        """
        off = (
            (np.maximum(depth, 0.0) - self.elevation_depth)
            * self.element_height
            / (2.5 * self.elevation_depth)
        )
        sigma: Floats = np.hypot(off, self.elevation)
        return sigma if self.elevation > 0 else np.zeros_like(sigma)
