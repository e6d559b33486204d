"""A deformation of the imaging plane: forward map on a mesh, its verified inverse, Jacobian and folding check.

The forward map x -> x + u(x) is bilinear in every cell of the mesh, as a graphics card draws it. The native core finds its
inverse cell by cell, where it is the root of a quadratic equation, so strong gradients and large motions need no starting
guess. A fixed point, the usual way, diverges once |grad u| reaches 1, which a push of 2 mm does while the map is still
one-to-one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.picture.native import Map, NativePicture, Report, blank
from echospline.scene import Floats, RegularGrid, as_points


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

    @classmethod
    def of(cls, report: Report) -> Folds | None:
        """Return the folds that the core has found; None without any."""
        if not report.folded_cells:
            return None
        return cls(report.folded_cells, report.smallest_jacobian, report.place)

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
        one_pixel = RegularGrid((1, 1), self.grid.spacing, self.grid.origin)
        return Folds.of(self._in_core(one_pixel).report())

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
        picture = self._in_core(image)
        x, y = picture.inverse()
        return InverseMap(image, x, y, picture.report().residual)

    def _in_core(self, image: RegularGrid) -> NativePicture:
        """Return a picture without pixels under this deformation."""
        picture = blank(image, self.grid)
        picture.deform(self.displacement)
        return picture
