"""A deformation of the imaging plane: forward map on a mesh, its verified inverse, Jacobian and folding check.

The forward map x -> x + u(x) is bilinear in every cell of the mesh, as a graphics card draws it. Its inverse is found
cell by cell: every pixel under a deformed cell is traced back by Newton's method in that cell, so strong gradients
and large motions need no starting guess. A fixed point, the usual way, diverges once |grad u| reaches 1, which a push
of 2 mm does while the map is still one-to-one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.scene import Floats, RegularGrid, as_points

Map = NDArray[np.float32]
CHECK_EVERY = 8
"""Rows and columns between pixels at which an inverse map is composed with the forward map."""


@dataclass(frozen=True)
class Folds:
    """Where a deformation turns the tissue inside out.

    Parameters
    ----------
    cells : int
        Mesh cells in which the Jacobian determinant is not positive somewhere.
    worst : float
        Smallest Jacobian determinant, at most 0.
    place : (x, y)
        Where that is, in the undeformed tissue, mm.
    """

    cells: int
    worst: float
    place: tuple[float, float]

    def __str__(self) -> str:
        x, y = self.place
        return f"{self.cells} mesh cells fold (Jacobian {self.worst:.2f} at x = {x:.1f}, y = {y:.1f} mm)"


@dataclass(frozen=True)
class InverseMap:
    """For every pixel of the deformed image, where it comes from.

    Parameters
    ----------
    grid : RegularGrid
        Pixel centres.
    x, y : ndarray, shape (rows, columns), float32
        Reference position as a pixel index (column, row); NaN where no tissue comes to lie.
        Up to half a pixel beyond the first and last.
    residual : float
        Largest distance in pixels between a pixel and the forward map of where it comes from, at every eighth
        row and column.
    """

    grid: RegularGrid
    x: Map
    y: Map
    residual: float

    @cached_property
    def outside(self) -> NDArray[np.bool_]:
        """Pixels that no tissue covers, shape (rows, columns)."""
        return np.isnan(self.x)


@dataclass(frozen=True)
class Deformation:
    """The map x -> x + u(x), with u given at the nodes of a mesh and bilinear between them.

    Parameters
    ----------
    grid : RegularGrid
        The mesh, 2 x 2 nodes or more.
    displacement : ndarray, shape (n, 2)
        Deformed minus reference at the nodes, mm.

    Raises
    ------
    InputError
        If the shapes do not fit or a displacement is not finite.
    """

    grid: RegularGrid
    displacement: Floats

    def __post_init__(self) -> None:
        u = as_points(self.displacement, "displacement")
        if len(u) != self.grid.size or min(self.grid.shape) < 2:
            raise InputError(
                f"a deformation needs one displacement per node of a mesh of 2 x 2 or more; "
                f"got {len(u)} for {self.grid.shape[0]} x {self.grid.shape[1]} nodes"
            )
        object.__setattr__(self, "displacement", u)

    @cached_property
    def _u(self) -> Floats:
        """Displacement as (ny, nx, 2)."""
        return np.ascontiguousarray(self.displacement.reshape(self.grid.shape[1], self.grid.shape[0], 2))

    def forward(self, points: ArrayLike) -> Floats:
        """Where reference points (n, 2) in mm come to lie, shape (n, 2) mm; NaN outside the mesh."""
        p = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        index = self.grid.to_index(p)
        last = np.subtract(self.grid.shape, 2)
        inside = np.asarray(((index >= -1e-9) & (index <= last + 1 + 1e-9)).all(axis=1))
        index = np.where(inside[:, None], index, 0.0)
        cell = np.clip(np.floor(index).astype(int), 0, last)
        (s, t), (i, j), u = (index - cell).T[..., None], cell.T, self._u
        between = (1 - t) * ((1 - s) * u[j, i] + s * u[j, i + 1]) + t * (
            (1 - s) * u[j + 1, i] + s * u[j + 1, i + 1]
        )
        deformed: Floats = np.where(inside[:, None], p + between, np.nan)
        return deformed

    @cached_property
    def jacobian(self) -> Floats:
        """Determinant of the deformation gradient at the four corners of every cell, shape (ny - 1, nx - 1, 4).

        In a bilinear cell the determinant is linear along each side, so its extremes are at the corners, and the
        check for folding is exact. Corners: top left, top right, bottom left, bottom right.
        """
        dx, dy = self.grid.spacing
        p = self._u + self.grid.nodes.reshape(self._u.shape)
        across, down = np.diff(p, axis=1) / dx, np.diff(p, axis=0) / dy

        def det(a: Floats, b: Floats) -> Floats:
            determinant: Floats = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
            return determinant

        top, bottom, left, right = across[:-1], across[1:], down[:, :-1], down[:, 1:]
        return np.stack([det(top, left), det(top, right), det(bottom, left), det(bottom, right)], axis=-1)

    @cached_property
    def folds(self) -> Folds | None:
        """Where the map folds; None where it is one-to-one in every cell."""
        least = self.jacobian.min(axis=-1)
        if least.min() > 0:
            return None
        j, i, corner = np.unravel_index(int(self.jacobian.argmin()), self.jacobian.shape)
        x, y = self.grid.to_mm([int(i) + int(corner) % 2, int(j) + int(corner) // 2])
        return Folds(int((least <= 0).sum()), float(least.min()), (float(x), float(y)))

    def inverse(self, image: RegularGrid) -> InverseMap:
        """Trace every pixel back to the reference.

        Parameters
        ----------
        image : RegularGrid
            Pixel centres, mm.

        Returns
        -------
        InverseMap
            With its residual: the composition of both maps against the identity.
        """
        nx, ny = image.shape
        # reference and deformed nodes in pixel units
        reference = image.to_index(self.grid.nodes).reshape(self._u.shape)
        deformed = reference + self._u / image.spacing
        x, y = np.full((ny, nx), np.nan, np.float32), np.full((ny, nx), np.nan, np.float32)
        _trace_back(np.ascontiguousarray(reference), np.ascontiguousarray(deformed), x, y)
        first, step = reference[0, 0], reference[1, 1] - reference[0, 0]
        residual = _composed(np.ascontiguousarray(self._u / image.spacing), first, step, x, y, CHECK_EVERY)
        return InverseMap(image, x, y, float(residual))


@njit(cache=True, nogil=True)
def _composed(u: Any, first: Any, step: Any, x: Any, y: Any, every: Any) -> Any:
    """Largest distance between a pixel and the forward map of where it comes from; all in pixel units."""
    ny, nx, _ = u.shape
    worst = 0.0
    for row in range(0, x.shape[0], every):
        for column in range(0, x.shape[1], every):
            fx, fy = (x[row, column] - first[0]) / step[0], (y[row, column] - first[1]) / step[1]
            if not (0.0 <= fx <= nx - 1 and 0.0 <= fy <= ny - 1):
                continue  # no tissue, or the half pixel beyond the mesh
            i, j = min(int(fx), nx - 2), min(int(fy), ny - 2)
            s, t = fx - i, fy - j
            again_x = x[row, column] + (1 - t) * ((1 - s) * u[j, i, 0] + s * u[j, i + 1, 0])
            again_y = y[row, column] + (1 - t) * ((1 - s) * u[j, i, 1] + s * u[j, i + 1, 1])
            again_x += t * ((1 - s) * u[j + 1, i, 0] + s * u[j + 1, i + 1, 0])
            again_y += t * ((1 - s) * u[j + 1, i, 1] + s * u[j + 1, i + 1, 1])
            worst = max(worst, np.hypot(again_x - column, again_y - row))
    return worst


@njit(cache=True, nogil=True)
def _trace_back(reference: Any, deformed: Any, x: Any, y: Any) -> None:
    """Fill x, y (rows, columns) with reference pixel indices, from nodes (ny, nx, 2) in pixel units."""
    rows, columns = x.shape
    ny, nx, _ = deformed.shape
    slack = 1e-7
    for j in range(ny - 1):
        for i in range(nx - 1):
            ax, ay = deformed[j, i, 0], deformed[j, i, 1]
            bx, by = deformed[j, i + 1, 0] - ax, deformed[j, i + 1, 1] - ay
            cx, cy = deformed[j + 1, i, 0] - ax, deformed[j + 1, i, 1] - ay
            ex, ey = deformed[j + 1, i + 1, 0] - ax, deformed[j + 1, i + 1, 1] - ay
            dx, dy = ex - bx - cx, ey - by - cy
            rx, ry = reference[j, i, 0], reference[j, i, 1]
            wx, wy = reference[j, i + 1, 0] - rx, reference[j + 1, i, 1] - ry
            # a pixel has an area: at the mesh's own edge the tissue reaches half a pixel beyond the last centres
            s0 = -0.5 / wx if i == 0 else -slack
            s1 = 1 + 0.5 / wx if i == nx - 2 else 1 + slack
            t0 = -0.5 / wy if j == 0 else -slack
            t1 = 1 + 0.5 / wy if j == ny - 2 else 1 + slack
            low_x, high_x, low_y, high_y = np.inf, -np.inf, np.inf, -np.inf
            for s in (s0, s1):
                for t in (t0, t1):
                    qx, qy = ax + s * bx + t * cx + s * t * dx, ay + s * by + t * cy + s * t * dy
                    low_x, high_x = min(low_x, qx), max(high_x, qx)
                    low_y, high_y = min(low_y, qy), max(high_y, qy)
            first_row, last_row = max(0, int(np.ceil(low_y))), min(rows - 1, int(np.floor(high_y)))
            first, last = max(0, int(np.ceil(low_x))), min(columns - 1, int(np.floor(high_x)))
            for row in range(first_row, last_row + 1):
                s, t = 0.5, 0.5
                for column in range(first, last + 1):
                    px, py = column - ax, row - ay
                    # Newton, from where the pixel before was found: quadratic, one or two rounds in a sound cell
                    missed = True
                    for _ in range(20):
                        fx = px - s * (bx + t * dx) - t * cx
                        fy = py - s * (by + t * dy) - t * cy
                        if fx * fx + fy * fy < 1e-10:
                            missed = False
                            break
                        jsx, jsy = bx + t * dx, by + t * dy
                        jtx, jty = cx + s * dx, cy + s * dy
                        det = jsx * jty - jsy * jtx
                        if det == 0.0:
                            break
                        scale = 1.0 / det
                        s += (fx * jty - fy * jtx) * scale
                        t += (jsx * fy - jsy * fx) * scale
                        if not (-1e3 < s < 1e3 and -1e3 < t < 1e3):
                            break
                    if missed:
                        s, t = 0.5, 0.5
                    elif s0 <= s <= s1 and t0 <= t <= t1:
                        x[row, column] = rx + s * wx
                        y[row, column] = ry + t * wy
