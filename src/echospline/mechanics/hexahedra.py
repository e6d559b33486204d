"""Elasticity in space on quadratic hexahedra: 27 nodes each, on lines along x, y and z that need not be evenly spaced.

Moduli are kPa, lengths mm and forces N. Nodes are the lines' points and the middles between them, x fastest; degrees of freedom are interleaved:
row ``3 i + c`` is component c of node i.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from echospline.errors import InputError, SolverError
from echospline.mechanics.finite_elements import MPA, lame
from echospline.mechanics.landmarks import SIDES, Clamps
from echospline.scene import Floats, Layer, SpatialGrid, Tissue

GAUSS = 3
"""Points per direction: exact for the energy of a cell of one modulus."""
FINE_GAUSS = 5
"""Points per direction in a cell of more than one modulus."""
MOST_NODES = 40_000
"""Of a mesh that is factored: fill-in grows with the 4/3rd power, and this many take gigabytes and minutes."""
SAME_LINE = 0.3
"""Share of a cell: an interface this close to a line of the mesh moves that line."""

Cells = NDArray[np.intp]
Box = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
"""First node and the one after the last, along x, y and z."""


def lines_for(grid: SpatialGrid, tissue: Tissue, cell: float) -> tuple[Floats, Floats, Floats]:
    """Lines of a mesh over the tissue, at most about ``cell`` mm apart; along y some lie on the interfaces of layers.

    Raises
    ------
    InputError
        If the cell is not positive, or would make more nodes than can be factored.
    """
    if not (np.isfinite(cell) and cell > 0):
        raise InputError(f"cell must be a positive number in mm; got {cell}")
    low, high = grid.corners
    lines = [np.linspace(a, b, max(1, round((b - a) / cell)) + 1) for a, b in zip(low, high, strict=True)]
    y = lines[1]
    for depth in sorted(
        {d for r in tissue.regions if isinstance(r.shape, Layer) for d in (r.shape.top, r.shape.bottom)}
    ):
        if not low[1] < depth < high[1]:
            continue
        nearest = int(np.abs(y - depth).argmin())
        if 0 < nearest < len(y) - 1 and abs(y[nearest] - depth) < SAME_LINE * cell:
            y[nearest] = depth
        else:
            y = np.unique(np.append(y, depth))
    lines[1] = y
    count = int(np.prod([2 * len(line) - 1 for line in lines]))
    if count > MOST_NODES:
        raise InputError(
            f"cells of {cell:g} mm make a mesh of {count} nodes; it can be factored up to {MOST_NODES}: take larger cells"
        )
    return lines[0], lines[1], lines[2]


class Hexahedra:
    """A block of tissue on quadratic hexahedra, held as clamps say, factored once.

    Parameters
    ----------
    lines : three ndarrays
        Where the cells' faces are along x, y and z, mm, ascending.
    tissue : Tissue
        E and nu, at the integration points.
    clamps : Clamps
        Clamped and sliding faces.

    Raises
    ------
    InputError
        If Poisson's ratio is not below 0.5.
    """

    def __init__(self, lines: tuple[Floats, Floats, Floats], tissue: Tissue, clamps: Clamps) -> None:
        self.lines, self.tissue, self.clamps = lines, tissue, clamps
        self.shape = tuple(2 * len(line) - 1 for line in lines)
        self.stiffness = self._assembled(tissue)
        self._plain: dict[float, sparse.csc_matrix] = {}

    @property
    def size(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    @cached_property
    def nodes(self) -> Floats:
        """All nodes in mm, shape (n, 3), x fastest."""
        x, y, z = (np.insert(line, range(1, len(line)), (line[1:] + line[:-1]) / 2) for line in self.lines)
        Z, Y, X = np.meshgrid(z, y, x, indexing="ij")
        return np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1)

    @cached_property
    def cells(self) -> Cells:
        """Nodes of every cell, shape (cells, 27), x fastest in both."""
        nx, ny, _ = self.shape
        k, j, i = (2 * np.arange(len(line) - 1) for line in self.lines[::-1])
        first = ((k[:, None, None] * ny + j[:, None]) * nx + i).ravel()
        c, b, a = np.meshgrid(range(3), range(3), range(3), indexing="ij")
        offsets = ((c * ny + b) * nx + a).ravel()
        cells: Cells = first[:, None] + offsets
        return cells

    @cached_property
    def extents(self) -> tuple[Floats, Floats]:
        """First corner and size of every cell, each of shape (cells, 3), mm."""
        Z, Y, X = np.meshgrid(*(line[:-1] for line in self.lines[::-1]), indexing="ij")
        dz, dy, dx = np.meshgrid(*(np.diff(line) for line in self.lines[::-1]), indexing="ij")
        first = np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1)
        return first, np.stack([dx.ravel(), dy.ravel(), dz.ravel()], axis=1)

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """Which components of which nodes are held, shape (n, 3)."""
        held = np.zeros((self.size, 3), dtype=bool)
        for face, (axis, _) in SIDES.items():
            on, kind = self.on(face), self.clamps.kind(face)
            if kind == "clamped":
                held[on] = True
            elif kind == "sliding":
                held[on, axis] = True
        return held

    def on(self, face: str) -> Cells:
        """Nodes on a face."""
        axis, side = SIDES[face]
        every = np.arange(self.size).reshape(self.shape[::-1])
        return every.take(-side, axis=2 - axis).ravel()

    def solve(self, loads: Floats, given: Floats | None = None) -> Floats:
        """Displacement (n, 3, k) in mm under loads (n, 3, k) in N; held components move as ``given`` (n, 3, k) says, or not at all."""
        k = loads.shape[2]
        u = np.zeros((3 * self.size, k))
        fixed = self.held.ravel()
        right = loads.reshape(-1, k)[self._order]
        if given is not None:
            u[fixed] = given.reshape(-1, k)[fixed]
            right = right - self._outer @ u[fixed]
        u[self._order] = self._factors.solve(np.ascontiguousarray(right))
        return u.reshape(self.size, 3, k)

    def at(self, values: Floats, points: Floats) -> Floats:
        """Values (n, ...) at nodes, interpolated at points (p, 3) in mm; beyond a face they go on as they are there."""
        index, weights = self.shares(points)
        out: Floats = np.einsum("pa,pa...->p...", weights, values[index])
        return out

    def point_loads(self, places: Floats, forces: Floats) -> Floats:
        """Nodal loads (n, 3, k) in N of forces (m, 3, k) in N at places (m, 3)."""
        index, weights = self.shares(places)
        loads = np.zeros((self.size, *forces.shape[1:]))
        np.add.at(loads, index, weights[:, :, None, None] * forces[:, None])
        return loads

    def integrated(self, body: Floats, gauss: int = FINE_GAUSS) -> Floats:
        """Nodal loads (n, 3) in N of a body force in N/mm^3 at `integration_points`, shape (cells, q, 3)."""
        N, _, w = _reference(gauss)
        volume = self.extents[1].prod(axis=1)[:, None] / 8.0
        per = np.einsum("qa,q,cqi->cai", N, w, body) * volume[:, :, None]
        loads = np.zeros((self.size, 3))
        np.add.at(loads, self.cells, per)
        return loads

    def integration_points(self, gauss: int, which: Cells | None = None) -> Floats:
        """Integration points of all or some cells, shape (cells, gauss^3, 3), mm."""
        xi = _rule(gauss)[0]
        first, size = self.extents
        if which is not None:
            first, size = first[which], size[which]
        return first[:, None] + size[:, None] * (xi + 1.0) / 2.0

    def difference(self, young: float, poisson: float) -> sparse.csr_matrix:
        """Stiffness less that of homogeneous tissue, N/mm: zero but in cells that differ from it."""
        if poisson not in self._plain:  # stiffness is proportional to E: one matrix serves every modulus
            self._plain[poisson] = self._assembled(Tissue(1.0, poisson))
        other = self._plain[poisson] * young
        less = (self.stiffness - other).tocsr()
        scale = abs(other).max()
        less.data[np.abs(less.data) < 1e-12 * scale] = 0.0
        less.eliminate_zeros()
        return less

    def strains(self, which: Cells, gauss: int) -> Iterator[tuple[int, Floats, Floats]]:
        """Of some cells one by one: index, derivatives of the shape functions (q, 27, 3) in 1/mm, and weights (q,) in mm^3."""
        _, dN, w = _reference(gauss)
        for cell in which:
            size = self.extents[1][cell]
            yield int(cell), dN * (2.0 / size), w * size.prod() / 8.0

    def moduli(self, points: Floats) -> tuple[Floats, Floats]:
        """Lamé's parameters at points (..., 3), N/mm^2."""
        return _lame_at(self.tissue, points)

    @cached_property
    def _order(self) -> NDArray[np.intp]:
        """Free degrees of freedom in the order of their elimination."""
        nodes = np.concatenate(list(_dissected(((0, self.shape[0]), (0, self.shape[1]), (0, self.shape[2])))))
        x, y, z = nodes.T
        every = 3 * ((z * self.shape[1] + y) * self.shape[0] + x)[:, None] + np.arange(3)
        order: NDArray[np.intp] = every.ravel()
        return order[~self.held.ravel()[order]]

    @cached_property
    def _outer(self) -> sparse.csr_matrix:
        """Stiffness between free and held degrees of freedom."""
        return self.stiffness.tocsr()[self._order][:, self.held.ravel()].tocsr()

    @cached_property
    def _factors(self) -> Any:
        inner = self.stiffness.tocsr()[self._order][:, self._order].tocsc()
        try:
            return splu(inner, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as singular:
            raise SolverError("the stiffness matrix is singular; check moduli and clamp a face") from singular

    def shares(self, points: Floats) -> tuple[Cells, Floats]:
        """Nodes of the cell of every point, and their shape functions there, each of shape (p, 27)."""
        cell = np.zeros(len(points), dtype=np.intp)
        one_way = []
        for k in (2, 1, 0):
            line = self.lines[k]
            i = np.clip(np.searchsorted(line, points[:, k], side="right") - 1, 0, len(line) - 2)
            cell = cell * (len(line) - 1) + i
            t = np.clip((points[:, k] - line[i]) / (line[i + 1] - line[i]), 0.0, 1.0)
            one_way.append(_quadratic(2.0 * t - 1.0)[0])
        weights = np.einsum("pc,pb,pa->pcba", *one_way).reshape(-1, 27)
        return self.cells[cell], weights

    def _assembled(self, tissue: Tissue) -> sparse.csc_matrix:
        """Stiffness matrix, N/mm."""
        first, size = self.extents
        points = self.integration_points(GAUSS)
        lam, mu = _lame_at(tissue, points)
        entries = np.zeros((len(first), 81, 81))
        mixed = np.zeros(len(first), dtype=bool)
        if not tissue.homogeneous:
            finer = _lame_at(tissue, self.integration_points(FINE_GAUSS))
            mixed = np.any([(m != m[:, :1]).any(axis=1) for m in finer], axis=0)
        _, same = np.unique(np.round(size, 9), axis=0, return_inverse=True)
        for kind in np.unique(same):
            for fine in (False, True):
                some = np.flatnonzero((same.ravel() == kind) & (mixed == fine))
                if not len(some):
                    continue
                volume, shear = _energies(size[some[0]], FINE_GAUSS if fine else GAUSS)
                at_points = (finer[0][some], finer[1][some]) if fine else (lam[some], mu[some])
                q = volume.shape[0]
                energy = at_points[0] @ volume.reshape(q, -1) + at_points[1] @ shear.reshape(q, -1)
                entries[some] = energy.reshape(-1, 81, 81)
        dofs = (3 * self.cells[:, :, None] + np.arange(3)).reshape(-1, 81)
        rows, columns = np.repeat(dofs, 81, axis=1).ravel(), np.tile(dofs, (1, 81)).ravel()
        K: sparse.csc_matrix = sparse.coo_matrix(
            (entries.ravel(), (rows, columns)), shape=(3 * self.size, 3 * self.size)
        ).tocsc()
        return K


def _dissected(box: Box) -> Iterator[NDArray[np.intp]]:
    """Nodes (i, j, k) of a lattice in nested dissection: both halves of the box, then the plane of nodes between them.

    Planes are those of cells' faces, whose nodes have even numbers. On such a lattice this is factored in a third of the time that minimum degree
    takes (A. George, SIAM J. Numer. Anal. 10, 1973).
    """
    lengths = [end - first for first, end in box]
    axis = int(np.argmax(lengths))
    if lengths[axis] <= 4:
        k, j, i = np.meshgrid(*(np.arange(*side) for side in box[::-1]), indexing="ij")
        yield np.stack([i.ravel(), j.ravel(), k.ravel()], axis=1)
        return
    first, end = box[axis]
    middle = (first + end) // 2
    middle -= middle % 2
    for side in ((first, middle), (middle + 1, end), (middle, middle + 1)):
        part = list(box)
        part[axis] = side
        if side == (middle, middle + 1):
            k, j, i = np.meshgrid(*(np.arange(*s) for s in part[::-1]), indexing="ij")
            yield np.stack([i.ravel(), j.ravel(), k.ravel()], axis=1)
        else:
            yield from _dissected((part[0], part[1], part[2]))


def _lame_at(tissue: Tissue, points: Floats) -> tuple[Floats, Floats]:
    young, poisson = tissue.at(points.reshape(-1, 3))
    lam, mu = lame(young, poisson, "strain")
    return MPA * lam.reshape(points.shape[:-1]), MPA * mu.reshape(points.shape[:-1])


def _quadratic(t: Floats) -> tuple[Floats, Floats]:
    """Shape functions of three nodes at -1, 0 and 1, and their derivatives, each of shape (n, 3)."""
    N = np.stack([t * (t - 1.0) / 2.0, 1.0 - t * t, t * (t + 1.0) / 2.0], axis=1)
    return N, np.stack([t - 0.5, -2.0 * t, t + 0.5], axis=1)


def _rule(gauss: int) -> tuple[Floats, Floats]:
    """Points (q, 3) and weights (q,) in the cube from -1 to 1, x fastest."""
    t, w = np.polynomial.legendre.leggauss(gauss)
    Z, Y, X = np.meshgrid(t, t, t, indexing="ij")
    weights: Floats = np.einsum("c,b,a->cba", w, w, w).ravel()
    return np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1), weights


def _reference(gauss: int) -> tuple[Floats, Floats, Floats]:
    """Shape functions (q, 27), their derivatives (q, 27, 3) and weights (q,) in the cube from -1 to 1."""
    xi, w = _rule(gauss)
    (X, dX), (Y, dY), (Z, dZ) = (_quadratic(xi[:, k]) for k in range(3))

    def product(z: Floats, y: Floats, x: Floats) -> Floats:
        p: Floats = np.einsum("qc,qb,qa->qcba", z, y, x).reshape(-1, 27)
        return p

    return product(Z, Y, X), np.stack([product(Z, Y, dX), product(Z, dY, X), product(dZ, Y, X)], axis=2), w


def _energies(size: Floats, gauss: int) -> tuple[Floats, Floats]:
    """What lambda and mu at each integration point add to the stiffness of a cell, each of shape (q, 81, 81)."""
    _, dN, w = _reference(gauss)
    g = dN * (2.0 / size)
    w = w * size.prod() / 8.0
    volume = np.einsum("q,qai,qbj->qaibj", w, g, g)
    shear = np.einsum("q,qaj,qbi->qaibj", w, g, g)
    shear += np.einsum("q,qak,qbk,ij->qaibj", w, g, g, np.eye(3))
    return volume.reshape(len(w), 81, 81), shear.reshape(len(w), 81, 81)
