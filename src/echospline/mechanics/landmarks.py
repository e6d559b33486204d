"""Where a scene's landmarks may stand: anchors that stay, and the lattice of nodes that the needle can touch."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.scene import EDGES, Floats, RegularGrid, as_points


@dataclass(frozen=True)
class Clamps:
    """What is held fast: whole edges of the mesh, and single points.

    Parameters
    ----------
    grid : RegularGrid
        The mesh.
    edges : tuple of {"top", "bottom", "left", "right"}
        Clamped edges.
    points : ndarray, shape (k, 2)
        Further clamped points, mm.
    """

    grid: RegularGrid
    edges: tuple[str, ...] = ("left", "right", "bottom")
    points: Floats = field(default_factory=lambda: np.empty((0, 2)))

    @classmethod
    def of(cls, grid: RegularGrid, edges: Iterable[str], points: ArrayLike | None = None) -> Clamps:
        """Check and keep what is clamped.

        Raises
        ------
        InputError
            If an edge has another name or a point lies outside the mesh.
        """
        names = tuple(edges)
        for name in names:
            if name not in EDGES:
                raise InputError(f"an edge is one of {', '.join(EDGES)}; got {name!r}")
        held = (
            np.empty((0, 2))
            if points is None or np.size(points) == 0
            else as_points(points, "clamped points")
        )
        if not grid.contains(held).all():
            raise InputError("every clamped point must lie inside the mesh")
        return cls(grid, names, held)

    @cached_property
    def nodes(self) -> NDArray[np.intp]:
        """Clamped mesh nodes (the nearest ones for points), ascending: what finite elements hold."""
        nearest = [self.grid.nearest(p) for p in self.points]
        return np.unique(np.concatenate([self.grid.boundary(self.edges), np.array(nearest, dtype=np.intp)]))

    def anchors(self, spacing: float) -> Floats:
        """Anchor landmarks along the clamped edges, at most ``spacing`` mm apart, shape (b, 2) mm."""
        x0, x1, y0, y1 = self.grid.extent
        ends = {
            "top": ((x0, y0), (x1, y0)),
            "bottom": ((x0, y1), (x1, y1)),
            "left": ((x0, y0), (x0, y1)),
            "right": ((x1, y0), (x1, y1)),
        }
        lines = []
        for edge in self.edges:
            a, b = (np.array(end) for end in ends[edge])
            gaps = max(1, int(np.ceil(float(np.hypot(*(b - a))) / spacing - 1e-9)))
            lines.append(a + np.linspace(0.0, 1.0, gaps + 1)[:, None] * (b - a))
        every = np.vstack([*lines, self.points])
        _, first = np.unique(np.round(every / 1e-6), axis=0, return_index=True)
        distinct: Floats = every[np.sort(first)]
        return distinct

    def clearance(self, point: tuple[float, float]) -> float:
        """Distance in mm from a point to what is clamped; 0 on it and beyond it; infinite when nothing is."""
        x0, x1, y0, y1 = self.grid.extent
        to_edge = {
            "top": point[1] - y0,
            "bottom": y1 - point[1],
            "left": point[0] - x0,
            "right": x1 - point[0],
        }
        distances = [to_edge[edge] for edge in self.edges]
        distances += [float(np.hypot(p[0] - point[0], p[1] - point[1])) for p in self.points]
        return max(0.0, min(distances, default=float("inf")))


def contact_lattice(clamps: Clamps, spacing: float) -> NDArray[np.intp]:
    """Mesh nodes that may become contacts: every one, or every second, third ..., about ``spacing`` apart.

    A contact stands for the tissue around it. On a fine mesh (a node per pixel) every node within delta of the shaft
    would be thousands; the lattice keeps their number that of the tissue, not that of the picture.

    Parameters
    ----------
    clamps : Clamps
        Clamped nodes are left out.
    spacing : float
        mm; 0 takes every node, as the paper does.

    Returns
    -------
    ndarray of int, shape (k,)
        Ascending node indices.
    """
    grid = clamps.grid
    nx, ny = grid.shape
    lines = []
    for n, h in zip((nx, ny), grid.spacing, strict=True):
        stride = max(1, round(spacing / h))
        lines.append(np.arange((n - 1) % stride // 2, n, stride, dtype=np.intp))
    lattice = (lines[1][:, None] * nx + lines[0][None, :]).ravel()
    return np.setdiff1d(lattice, clamps.nodes)
