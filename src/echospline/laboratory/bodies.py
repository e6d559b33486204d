"""Bodies that a picture or a volume can be given: lesions and vessels, round or tubular, by their echo.

A body is a value: its place and shape in mm and how bright it shows. `imaged` puts it into a picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene import Floats

Echogenicity = Literal["hypoechoic", "anechoic", "hyperechoic"]


@dataclass(frozen=True)
class Round:
    """A disc in the plane or a ball in space.

    Parameters
    ----------
    centre : (x, y) or (x, y, z)
        mm.
    radius : float
        mm.
    """

    centre: tuple[float, ...]
    radius: float

    def __post_init__(self) -> None:
        _check((self.centre,), self.radius, "a round body")

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner of the box around it, mm."""
        c = np.asarray(self.centre, dtype=np.float64)
        return c - self.radius, c + self.radius

    def distance(self, points: Floats) -> Floats:
        """Return the distance of points (..., D) to the surface, mm; negative inside."""
        away: Floats = np.linalg.norm(points - np.asarray(self.centre), axis=-1) - self.radius
        return away


@dataclass(frozen=True)
class Tube:
    """A vessel: everything within ``radius`` of the line from ``start`` to ``end``, so its ends are round.

    Parameters
    ----------
    start, end : (x, y) or (x, y, z)
        mm; they may lie outside the picture.
    radius : float
        mm.
    """

    start: tuple[float, ...]
    end: tuple[float, ...]
    radius: float

    def __post_init__(self) -> None:
        _check((self.start, self.end), self.radius, "a tube")
        if self.start == self.end:
            raise InputError(f"a tube goes from one point to another, mm; both are {self.start}")

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest corner of the box around it, mm."""
        ends = np.array([self.start, self.end], dtype=np.float64)
        return ends.min(axis=0) - self.radius, ends.max(axis=0) + self.radius

    def distance(self, points: Floats) -> Floats:
        """Return the distance of points (..., D) to the surface, mm; negative inside."""
        a = np.asarray(self.start, dtype=np.float64)
        along = np.asarray(self.end, dtype=np.float64) - a
        t = np.clip((points - a) @ along / (along @ along), 0.0, 1.0)
        away: Floats = np.linalg.norm(points - a - t[..., None] * along, axis=-1) - self.radius
        return away


BodyShape = Round | Tube


@dataclass(frozen=True)
class Body:
    """A structure with an echo of its own.

    Parameters
    ----------
    shape : Round or Tube
        Its place; the outline is the outer side of its wall.
    contrast : float
        Level of its speckle against that of the surrounding tissue, dB.
    wall : float, optional
        Level of its wall against the surrounding tissue where the beam meets it squarely, dB; a wall along the beam hardly
        shows. No wall of its own when not given.
    enhancement : float
        Tissue behind it is brighter by this for each mm of beam inside it, dB/mm; negative: a shadow.
    haze : float, optional
        Level of the reverberations behind its near wall against the surrounding tissue, dB; none when not given.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    shape: BodyShape
    contrast: float
    wall: float | None = None
    enhancement: float = 0.0
    haze: float | None = None

    def __post_init__(self) -> None:
        ranges = {"contrast": (self.contrast, -80, 40), "enhancement": (self.enhancement, -20, 10)}
        ranges |= {
            name: (value, -80, 40)
            for name, value in (("wall", self.wall), ("haze", self.haze))
            if value is not None
        }
        for name, (value, low, high) in ranges.items():
            if not low <= value <= high:  # also refuses nan
                raise InputError(f"{name} of a body lies between {low} and {high} dB; got {value}")

    @classmethod
    def of(cls, echo: Echogenicity, shape: BodyShape, contrast: float | None = None) -> Body:
        """Return a body as such structures commonly show: a lesion, a vessel full of blood, a bright lesion.

        Parameters
        ----------
        echo : {"hypoechoic", "anechoic", "hyperechoic"}
            9 dB darker; without echo, with walls and enhancement; 8 dB brighter. Plausible levels, set by eye.
        shape : Round or Tube
            Its place.
        contrast : float, optional
            In place of the common one, dB.
        """
        if echo not in get_args(Echogenicity):
            raise InputError(f"echo is one of {', '.join(get_args(Echogenicity))}; got {echo!r}")
        if echo == "anechoic":
            return cls(shape, -45.0 if contrast is None else contrast, 9.0, 1.2, -17.0)
        if echo == "hypoechoic":
            return cls(shape, -9.0 if contrast is None else contrast, None, 0.2)
        return cls(shape, 8.0 if contrast is None else contrast)


def _check(points: tuple[tuple[float, ...], ...], radius: float, what: str) -> None:
    """Refuse points that are not two or three numbers, and a radius that is not positive."""
    sizes: set[int] = {len(point) for point in points}
    finite: NDArray[np.bool_] = np.array([isfinite(v) for point in points for v in point])
    if len(sizes) != 1 or not sizes <= {2, 3} or not finite.all():
        raise InputError(f"{what} lies at (x, y) or (x, y, z) in mm; got {', '.join(map(str, points))}")
    if not (isfinite(radius) and radius > 0):
        raise InputError(f"radius of {what} is a positive number of mm; got {radius}")
