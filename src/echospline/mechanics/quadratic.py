"""Plane elasticity on quadratic triangles, factored once: a live solve for tissue of any regions; SciPy alone.

The cells of the mesh are rectangles cut into two triangles of six nodes each; lines of the mesh stand on straight, upright or
level interfaces. Where an interface crosses a triangle, the triangle has a mean of the moduli. A needle's force is
spread over the same blob as in the closed form, as consistent loads of twelve points.
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from echospline.errors import InputError, SolverError
from echospline.mechanics.boundary_forces import inside, load_cases
from echospline.mechanics.landmarks import SIDES, Clamps
from echospline.scene import Floats, Layer, Polygon, RegularGrid, Tissue

CELLS = 2700
"""Cells of the mesh, 60 x 45 for 40 x 30 mm (0.67 mm): 22 000 unknowns. Twice as many halve the error and take three times the set-up."""

SAMPLES = 4
"""Moduli of a triangle are the mean over the middles of SAMPLES^2 equal parts of it."""

RINGS = (0.393, 1.0)
"""Radii of six points each that stand for the blob, in its radius: within them lie a quarter and three quarters of the force."""

LINES = 40
"""Straight interfaces along x or y that get mesh lines at most; a labels image has as many as pixels, and gets none."""


class QuadraticSolve:
    """Tissue of any regions in a rectangle that answers point forces by a back-substitution; a `ForceResponse`.

    Parameters
    ----------
    grid : RegularGrid
        The mesh; its extent is the tissue.
    clamps : Clamps
        What holds the tissue. A clamped point is a pin of the blob's radius.
    tissue : Tissue
        Any.
    radius : float
        Over which a force is spread, mm.

    Attributes
    ----------
    x, y : ndarray
        Lines between the cells, mm.
    held : ndarray of bool, shape (2 nodes,)
        Components of the triangles' nodes that do not move.
    moduli : ndarray, shape (triangles, 2)
        Lamé parameters times the thickness, N/mm.

    Raises
    ------
    InputError
        If a number is out of its range.
    SolverError
        By `answer`, if the stiffness matrix is singular.
    """

    def __init__(self, grid: RegularGrid, clamps: Clamps, tissue: Tissue, radius: float = 0.4) -> None:
        if not (np.isfinite(radius) and radius > 0):
            raise InputError(f"radius of a force must be a positive number in mm; got {radius}")
        x0, x1, y0, y1 = grid.extent
        if not (x1 > x0 and y1 > y0):
            raise InputError(f"tissue needs a mesh of 2 x 2 nodes or more; got {grid.shape}")
        if (
            tissue.plane == "strain"
            and not max(tissue.poisson, *(r.poisson for r in tissue.regions), 0) < 0.5
        ):
            raise InputError("Poisson's ratio in plane strain must be below 0.5")
        self._grid, self.clamps, self.radius = grid, clamps, radius
        self.step = float(np.sqrt((x1 - x0) * (y1 - y0) / CELLS))
        upright, level = straight_interfaces(tissue, grid.extent)
        self.x, self.y = _lines(x0, x1, upright, self.step), _lines(y0, y1, level, self.step)
        self.held = self._holds(clamps)
        self.moduli = self._lame(tissue)

    @cached_property
    def _nodes(self) -> Any:
        return self._located(self.grid.nodes)

    @cached_property
    def _factors(self) -> Any:
        free = ~self.held
        K = self._stiffness()
        try:
            return splu(
                K[free][:, free].tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as singular:
            raise SolverError("the stiffness matrix is singular; check moduli and clamp") from singular

    @property
    def grid(self) -> RegularGrid:
        """The mesh on which the displacement is wanted; the triangles' own is another."""
        return self._grid

    def answer(self, places: Floats, forces: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Displacement of the mesh nodes and of points under load cases; see `ForceResponse.answer`."""
        s, p = inside(self.grid, places, "places of forces"), inside(self.grid, points, "points")
        k = np.shape(forces)[2] if np.ndim(forces) == 3 else 0
        f = load_cases(s, forces).reshape(len(s), 2 * k)
        u = np.zeros((2 * self._count, k))
        if len(s) and k:
            load = (self._spread(s).T @ f).reshape(2 * self._count, k)
            u[~self.held] = self._factors.solve(np.ascontiguousarray(load[~self.held]))
        u = u.reshape(self._count, 2 * k)
        mesh, at = self._nodes @ u, self._located(p) @ u
        return mesh.reshape(self.grid.size, 2, k), at.reshape(len(p), 2, k)

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        return (
            f"a live solve on {2 * (len(self.x) - 1) * (len(self.y) - 1)} quadratic triangles, {self.step:.2g} mm, "
            f"{2 * self._count} unknowns, factored once"
        )

    @property
    def _count(self) -> int:
        return (2 * len(self.x) - 1) * (2 * len(self.y) - 1)

    def _holds(self, clamps: Clamps) -> NDArray[np.bool_]:
        """Which components of which nodes do not move, shape (2 nodes,)."""
        x, y = _with_middles(self.x), _with_middles(self.y)
        held = np.zeros((len(y), len(x), 2), dtype=bool)
        for edge in clamps.edges:
            _edge(held, edge)[...] = True
        for edge in clamps.sliding:
            _edge(held, edge)[..., SIDES[edge][0]] = True
        for p in clamps.points:
            distance = np.hypot(x[None] - p[0], y[:, None] - p[1])
            held[distance <= max(self.radius, distance.min())] = True
        return held.reshape(-1)

    def _triangles(self) -> NDArray[np.intp]:
        """Nodes of every triangle: three corners, then the middles of sides 12, 23 and 31; two triangles per cell, x fastest."""
        across = 2 * len(self.x) - 1
        i, j = np.meshgrid(2 * np.arange(len(self.x) - 1), 2 * np.arange(len(self.y) - 1))
        first = (j * across + i).ravel()
        turned = ((i + j) // 2 % 2 == 1).ravel()
        halves = []
        for straight, other in (
            (((0, 0), (2, 0), (2, 2)), ((0, 0), (2, 0), (0, 2))),
            (((0, 0), (2, 2), (0, 2)), ((2, 0), (2, 2), (0, 2))),
        ):
            offsets = [
                [b * across + a for a, b in (*c, *(_middle(c[k], c[(k + 1) % 3]) for k in range(3)))]
                for c in (straight, other)
            ]
            halves.append(first[:, None] + np.array(offsets)[turned.astype(int)])
        return np.stack(halves, axis=1).reshape(-1, 6)

    def _corners(self, triangles: NDArray[np.intp]) -> Floats:
        x, y = _with_middles(self.x), _with_middles(self.y)
        places = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=1)
        corners: Floats = places[triangles[:, :3]]
        return corners

    def _lame(self, tissue: Tissue) -> Floats:
        """Lamé parameters of the triangles times the thickness, N/mm, shape (triangles, 2)."""
        moduli: Floats = (
            1e-3 * tissue.thickness * np.stack(_moduli(tissue, self._corners(self._triangles())), axis=1)
        )
        return moduli

    def _stiffness(self) -> Any:
        """Assemble the stiffness matrix, N/mm."""
        triangles = self._triangles()
        corners = self._corners(triangles)
        lam, mu = self.moduli.T
        edges = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)
        double = (corners[:, 1, 0] - corners[:, 0, 0]) * (corners[:, 2, 1] - corners[:, 0, 1]) - (
            corners[:, 2, 0] - corners[:, 0, 0]
        ) * (corners[:, 1, 1] - corners[:, 0, 1])
        slope = (
            np.stack([edges[..., 1], -edges[..., 0]], axis=-1) / double[:, None, None]
        )  # of area coordinates
        Ke = np.zeros((len(triangles), 6, 2, 6, 2))
        weight = np.abs(double) / 6.0
        for q in np.eye(3) / 2 + 1 / 6:  # three points integrate a quadratic exactly
            g = np.matmul(_slopes(q), slope)
            outer = g[:, :, :, None, None] * g[:, None, None, :, :]  # e a i b k
            volume = (weight * lam)[:, None, None, None, None] * outer
            cross = (weight * mu)[:, None, None, None, None] * outer.transpose(0, 1, 4, 3, 2)
            Ke += volume + cross
            alike = (weight * mu)[:, None, None] * (g @ g.transpose(0, 2, 1))
            for i in (0, 1):
                Ke[:, :, i, :, i] += alike
        unknowns = (2 * triangles[:, :, None] + np.arange(2)).reshape(len(triangles), 12)
        rows, columns = np.repeat(unknowns, 12, axis=1).ravel(), np.tile(unknowns, (1, 12)).ravel()
        return sparse.csr_matrix((Ke.ravel(), (rows, columns)), shape=(2 * self._count, 2 * self._count))

    def _spread(self, places: Floats) -> Any:
        """Shape functions of forces spread over a blob, sparse (m, nodes); what would stick out of the tissue stays at its edge."""
        angle = np.arange(6) * np.pi / 3
        ring = np.concatenate(
            [
                r * np.stack([np.cos(angle + turn), np.sin(angle + turn)], axis=1)
                for r, turn in zip(RINGS, (0.0, np.pi / 6), strict=True)
            ]
        )
        x0, x1, y0, y1 = self.grid.extent
        points = np.clip((places[:, None] + self.radius * ring).reshape(-1, 2), (x0, y0), (x1, y1))
        N = self._located(points)
        mean = sparse.kron(sparse.eye_array(len(places)), np.full((1, len(ring)), 1.0 / len(ring)))
        return (mean @ N).tocsr()

    def _located(self, points: Floats) -> Any:
        """Shape functions at points, sparse (n, nodes)."""
        i = np.clip(np.searchsorted(self.x, points[:, 0], side="right") - 1, 0, len(self.x) - 2)
        j = np.clip(np.searchsorted(self.y, points[:, 1], side="right") - 1, 0, len(self.y) - 2)
        s = np.clip((points[:, 0] - self.x[i]) / (self.x[i + 1] - self.x[i]), 0.0, 1.0)
        t = np.clip((points[:, 1] - self.y[j]) / (self.y[j + 1] - self.y[j]), 0.0, 1.0)
        turned = (i + j) % 2 == 1
        second = np.where(turned, s + t > 1, t > s)
        triangle = self._triangles()[2 * (j * (len(self.x) - 1) + i) + second]
        one = np.select([turned & ~second, turned & second, ~second], [1 - s - t, 1 - t, 1 - s], 1 - t)
        two = np.select([turned & ~second, turned & second, ~second], [s, s + t - 1, s - t], s)
        L = np.stack([one, two, 1 - one - two], axis=1)
        L[np.abs(L) < 1e-12] = 0.0  # rounding: a point on an edge has no share of the nodes off it
        values = np.concatenate([L * (2 * L - 1), 4 * L * np.roll(L, -1, axis=1)], axis=1)
        rows = np.repeat(np.arange(len(points)), 6)
        return sparse.csr_matrix((values.ravel(), (rows, triangle.ravel())), shape=(len(points), self._count))


def straight_interfaces(
    tissue: Tissue, extent: tuple[float, float, float, float]
) -> tuple[list[float], list[float]]:
    """Places inside the extent of upright and of level interfaces, mm, each list ascending."""
    upright, level = set(), set()
    for region in tissue.regions:
        if isinstance(region.shape, Layer):
            level |= {region.shape.top, region.shape.bottom}
        elif isinstance(region.shape, Polygon):
            a = np.asarray(region.shape.vertices, dtype=np.float64)
            b = np.roll(a, -1, axis=0)
            upright |= {float(p[0]) for p, q in zip(a, b, strict=True) if p[0] == q[0]}
            level |= {float(p[1]) for p, q in zip(a, b, strict=True) if p[1] == q[1]}
    x0, x1, y0, y1 = extent
    inner = sorted(x for x in upright if x0 < x < x1), sorted(y for y in level if y0 < y < y1)
    return inner if max(map(len, inner)) <= LINES else ([], [])


def _moduli(tissue: Tissue, corners: Floats) -> tuple[Floats, Floats]:
    """Lamé parameters of triangles (n, 3, 2), kPa."""
    middles = _parts(SAMPLES if not tissue.homogeneous else 1)
    points = np.einsum("sc,eck->esk", middles, corners).reshape(-1, 2)
    E, nu = (v.reshape(len(corners), -1) for v in tissue.at(points))
    mu = E / (2 * (1 + nu))
    lam = E * nu / ((1 + nu) * (1 - 2 * nu)) if tissue.plane == "strain" else E * nu / (1 - nu**2)
    return np.exp(np.log(lam).mean(axis=1)) if (lam > 0).all() else lam.mean(axis=1), np.exp(
        np.log(mu).mean(axis=1)
    )


def _parts(count: int) -> Floats:
    """Area coordinates of the middles of count^2 equal parts of a triangle, shape (count^2, 3)."""
    middles = []
    for i in range(count):
        for j in range(count - i):
            middles.append((i + 1 / 3, j + 1 / 3))
            if i + j < count - 1:
                middles.append((i + 2 / 3, j + 2 / 3))
    first = np.array(middles) / count
    return np.column_stack([first, 1.0 - first.sum(axis=1)])


def _slopes(q: Floats) -> Floats:
    """Derivatives of the six shape functions by the three area coordinates at area coordinates q, shape (6, 3)."""
    a, b, c = 4.0 * q
    return np.array(
        [[a - 1, 0, 0], [0, b - 1, 0], [0, 0, c - 1], [b, a, 0], [0, c, b], [c, 0, a]], dtype=np.float64
    )


def _middle(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
    return (a[0] + b[0]) // 2, (a[1] + b[1]) // 2


def _edge(nodes: NDArray[np.bool_], edge: str) -> NDArray[np.bool_]:
    """Nodes [y, x] on an edge, a view."""
    axis, side = SIDES[edge]
    return nodes[:, -side] if axis == 0 else nodes[-side]


def _lines(low: float, high: float, fixed: list[float], step: float) -> Floats:
    """Mesh lines about ``step`` apart, some of them fixed."""
    kept = [low]
    for line in [*fixed, high]:
        if line - kept[-1] > 1e-6 * step:
            kept.append(line)
    pieces = [np.linspace(a, b, max(1, round((b - a) / step)) + 1)[:-1] for a, b in pairwise(kept)]
    lines: Floats = np.append(np.concatenate(pieces), high)
    return lines


def _with_middles(lines: Floats) -> Floats:
    """Lines and the middles between them."""
    both = np.empty(2 * len(lines) - 1)
    both[::2], both[1::2] = lines, (lines[1:] + lines[:-1]) / 2
    return both
