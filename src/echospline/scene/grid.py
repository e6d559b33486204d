"""A regular grid in the imaging plane: mesh nodes and pixel centres alike, with conversion between millimetres and indices."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.scene.number import is_number

Floats = NDArray[np.float64]
Edge = Literal["top", "bottom", "left", "right"]
EDGES: tuple[Edge, ...] = get_args(Edge)


def as_points(points: ArrayLike, name: str = "points", dimension: int = 2) -> Floats:
    """Check points and return them as an array.

    Parameters
    ----------
    points : array_like, shape (n, dimension) or (dimension,)
        (x lateral, y depth) in mm, in space (x lateral, y depth, z elevation).
    name : str
        Name of the points in an error message.
    dimension : int
        2 in the plane, 3 in space.

    Returns
    -------
    ndarray, shape (n, dimension), float64

    Raises
    ------
    InputError
        If the shape is another or a coordinate is not finite.
    """
    try:
        array = np.atleast_2d(np.asarray(points, dtype=np.float64))
    except (TypeError, ValueError):
        raise InputError(f"{name} must be numbers in mm; got {points!r}") from None
    if array.ndim != 2 or array.shape[1] != dimension:
        axes = "x lateral, y depth" + (", z elevation" if dimension == 3 else "")
        raise InputError(f"{name} must have shape (n, {dimension}), ({axes}) in mm; got {np.shape(points)}")
    if not np.isfinite(array).all():
        bad = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise InputError(f"{name} must be finite numbers in mm; got {tuple(array[bad])} at index {bad}")
    return array


@dataclass(frozen=True)
class RegularGrid:
    """Points at constant spacing: ``origin + (ix * spacing_x, iy * spacing_y)``.

    Parameters
    ----------
    shape : (nx, ny)
        Number of points along x (lateral) and y (depth), at least 1 each.
    spacing : (dx, dy)
        Distance between neighbours in mm, positive.
    origin : (x, y)
        Position in mm of the first point (top left); depth grows downwards.

    Raises
    ------
    InputError
        If shape, spacing or origin is not of this form.
    """

    shape: tuple[int, int]
    spacing: tuple[float, float]
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if len(self.shape) != 2 or not all(is_number(n) and int(n) == n and n >= 1 for n in self.shape):
            raise InputError(f"shape must be two positive integers (nx, ny); got {self.shape}")
        if len(self.spacing) != 2 or not all(is_number(h) and h > 0 for h in self.spacing):
            raise InputError(
                f"spacing must be two positive numbers in mm (lateral, depth); got {self.spacing}"
            )
        if len(self.origin) != 2 or not all(is_number(c) for c in self.origin):
            raise InputError(f"origin must be two finite numbers in mm (x, y); got {self.origin}")
        object.__setattr__(self, "shape", (int(self.shape[0]), int(self.shape[1])))
        object.__setattr__(self, "spacing", (float(self.spacing[0]), float(self.spacing[1])))
        object.__setattr__(self, "origin", (float(self.origin[0]), float(self.origin[1])))

    @classmethod
    def covering(cls, other: RegularGrid, shape: tuple[int, int]) -> RegularGrid:
        """Return the grid of ``shape`` (nx, ny) whose corner points are those of ``other`` (a mesh over an image)."""
        if len(shape) != 2 or not all(is_number(n) and int(n) == n and n >= 2 for n in shape):
            raise InputError(f"a mesh needs at least 2 x 2 nodes (NXxNY); got {shape}")
        x0, x1, y0, y1 = other.extent
        if x1 <= x0 or y1 <= y0:
            raise InputError(
                f"cannot lay a mesh over an image of {other.shape} pixels: it needs 2 x 2 or more"
            )
        return cls(shape, ((x1 - x0) / (shape[0] - 1), (y1 - y0) / (shape[1] - 1)), (x0, y0))

    @property
    def size(self) -> int:
        """Number of points."""
        return self.shape[0] * self.shape[1]

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """(x_first, x_last, y_first, y_last) in mm, from first to last point."""
        (nx, ny), (dx, dy), (x0, y0) = self.shape, self.spacing, self.origin
        return x0, x0 + (nx - 1) * dx, y0, y0 + (ny - 1) * dy

    @cached_property
    def x(self) -> Floats:
        """Lateral coordinates in mm, shape (nx,)."""
        return self.origin[0] + self.spacing[0] * np.arange(self.shape[0], dtype=np.float64)

    @cached_property
    def y(self) -> Floats:
        """Depths in mm, shape (ny,)."""
        return self.origin[1] + self.spacing[1] * np.arange(self.shape[1], dtype=np.float64)

    @cached_property
    def nodes(self) -> Floats:
        """All points in mm, shape (n, 2), x fastest: node ``iy * nx + ix``, so ``reshape(ny, nx, 2)`` is image-like."""
        nodes = np.stack(np.meshgrid(self.x, self.y), axis=-1).reshape(-1, 2)
        nodes.setflags(write=False)
        return nodes

    def to_index(self, points: ArrayLike) -> Floats:
        """Convert points in mm to fractional (ix, iy), shape (n, 2)."""
        index: Floats = (np.asarray(points, dtype=np.float64) - self.origin) / self.spacing
        return index

    def to_mm(self, index: ArrayLike) -> Floats:
        """Convert fractional indices (ix, iy) to positions in mm, shape (n, 2)."""
        points: Floats = np.asarray(index, dtype=np.float64) * self.spacing + self.origin
        return points

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Test which points in mm lie inside the extent, edges included, shape (n,)."""
        x0, x1, y0, y1 = self.extent
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        inside: NDArray[np.bool_] = (p[:, 0] >= x0) & (p[:, 0] <= x1) & (p[:, 1] >= y0) & (p[:, 1] <= y1)
        return inside

    def nearest(self, point: ArrayLike) -> int:
        """Return the index of the node nearest to one point in mm."""
        ij = np.clip(np.rint(self.to_index(point)), 0, np.subtract(self.shape, 1)).astype(int)
        return int(ij[1] * self.shape[0] + ij[0])

    def boundary(self, edges: Iterable[str]) -> NDArray[np.intp]:
        """Return the indices of the nodes on the named edges, ascending, each once.

        Parameters
        ----------
        edges : iterable of {"top", "bottom", "left", "right"}
            Top is the first row (the probe's face).

        Raises
        ------
        InputError
            If an edge has another name.
        """
        nx, ny = self.shape
        index = np.arange(self.size).reshape(ny, nx)
        lines = {"top": index[0], "bottom": index[-1], "left": index[:, 0], "right": index[:, -1]}
        chosen = list(edges)
        for edge in chosen:
            if edge not in lines:
                raise InputError(f"an edge is one of {', '.join(EDGES)}; got {edge!r}")
        if not chosen:
            return np.empty(0, dtype=np.intp)
        return np.unique(np.concatenate([lines[edge] for edge in chosen]))
