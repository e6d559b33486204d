"""Any tissue in space that answers point forces: closed forms near each force, quadratic hexahedra for everything else.

Near a force elements are poor, so each force moves tissue as it would in a half space of its own modulus (`half_space.kelvinlet`), and the elements
solve for what that lacks: its displacement on held faces, its traction on free ones, and in tissue of another modulus the difference of
stresses. What remains is smooth but for a kink on interfaces. Coarse cells are Green's function with a live corrector, fine ones the
reference; neither is good within about 1.5 mm of an interface that a force is beside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy import sparse

from echospline.errors import InputError
from echospline.mechanics.finite_elements import MPA, lame
from echospline.mechanics.half_space import Top, gradient, kelvinlet, tractions
from echospline.mechanics.hexahedra import FINE_GAUSS, Cells, Hexahedra, lines_for
from echospline.mechanics.landmarks import SIDES, Clamps
from echospline.mechanics.response import SpatialColumn
from echospline.mechanics.space_response import ForceField, Forces, shear_modulus
from echospline.mechanics.spread import folding
from echospline.scene import Floats, SpatialGrid, Tissue, as_points

NEAR = 1.0
"""Of a cell's diagonal: a cell closer to a force than this is integrated point by point, one further away by its nodes."""
FACE_GAUSS = 4
"""Points per direction on a free or sliding face."""
KEPT = 3
"""Moduli whose difference from the tissue is kept: in tissue that differs everywhere each takes as much as the stiffness matrix."""
Material = tuple[float, float]
"""E in kPa and nu."""


@dataclass(frozen=True, eq=False)
class CorrectedField:
    """Displacement of tissue with regions under point forces, at any points.

    Parameters
    ----------
    near : tuple of ForceField
        Closed forms, one for each modulus.
    mesh : Hexahedra
        Elements, for what they lack.
    values : ndarray, shape (n, 3)
        At the mesh's nodes, mm.
    """

    near: tuple[ForceField, ...]
    mesh: Hexahedra
    values: Floats

    def __call__(self, points: Floats) -> Floats:
        """Displacement (n, 3) in mm at points (n, 3) in mm; above the surface it goes on as it is there."""
        p = np.asarray(points, dtype=np.float64)
        u = self.mesh.at(self.values, p)
        for field in self.near:
            u += field(p)
        return u


class SpatialFEMResponse:
    """A block of tissue with or without regions, answering point forces.

    Parameters
    ----------
    grid : SpatialGrid
        Its corners are those of the tissue.
    clamps : Clamps
        Faces that are clamped or slide. A top that is neither is a free surface.
    tissue : Tissue
        E and nu with regions: spheres, boxes, layers, labels of a volume.
    cell : float
        Greatest size of a cell, about, mm.
    radius : float
        Over which a force of the needle is spread, mm.
    least : float
        Modulus in kPa that the closed form near a force has at least; elements correct what it is too much. A force in fluid, whose
        own closed form is steeper than elements can correct, then moves what is about the fluid.

    Raises
    ------
    InputError
        If tissue is incompressible, points are clamped, the surface is not y = 0, or cells are too many.
    """

    def __init__(
        self,
        grid: SpatialGrid,
        clamps: Clamps,
        tissue: Tissue,
        *,
        cell: float = 3.5,
        radius: float = 0.7,
        least: float = 0.0,
    ) -> None:
        ratios = [tissue.poisson, *(region.poisson for region in tissue.regions)]
        if not max(ratios) < 0.5:
            raise InputError(
                f"Poisson's ratio in space must lie in (-1, 0.5); got {max(ratios)}: take 0.49 for nearly incompressible tissue"
            )
        if len(clamps.points):
            raise InputError(
                "points cannot be clamped in space by finite elements; clamp a face, or use elastic"
            )
        if not (np.isfinite(radius) and radius > 0):
            raise InputError(f"radius of a force must be a positive number in mm; got {radius}")
        kind = clamps.kind("top")
        self.top: Top | None = None if kind == "clamped" else kind
        low, _ = grid.corners
        if self.top is not None and abs(low[1]) > 1e-6:
            raise InputError(f"the surface of tissue in space is y = 0; the mesh begins at {low[1]:g} mm")
        self.grid, self.clamps, self.tissue, self.radius, self.cell = grid, clamps, tissue, radius, cell
        self.least = least
        self.mesh = Hexahedra(lines_for(grid, tissue, cell), tissue, clamps)
        self._less: dict[Material, sparse.csr_matrix] = {}
        self.mesh.solve(np.zeros((self.mesh.size, 3, 1)))  # factors now

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the response was made of; a copy factors anew."""
        made = partial(SpatialFEMResponse, cell=self.cell, radius=self.radius, least=self.least)
        return made, (self.grid, self.clamps, self.tissue)

    def column(self, places: Floats, weights: Floats) -> SpatialColumn:
        """Answer unit forces along x, y and z that are spread over places (m, 3) in mm by weights (m,); see `SpatialResponse`."""
        p = as_points(places, "places", 3) if len(places) else np.zeros((0, 3))
        if not self.grid.contains(p).all():
            raise InputError(
                f"forces act inside the tissue; got places from {p.min(axis=0)} to {p.max(axis=0)} mm"
            )
        if self.top is not None:  # the image is that of a point: it stays a radius above the surface
            p = p.copy()
            p[:, 1] = np.maximum(p[:, 1], self.radius)
        n = self.mesh.size
        loads, given = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
        for material, some in self._materials(p).items():
            moves = self._moves(self.mesh.nodes, p[some], weights[some], material)
            given -= moves
            loads -= self._jumps(material, p[some], weights[some], moves)
            loads -= self._pulls(p[some], weights[some], material)
        return SpatialColumn(p, weights, self.mesh.solve(loads, given).reshape(3 * n, 3))

    def column_at(self, column: SpatialColumn, points: Floats) -> Floats:
        """Displacement of points (p, 3) in mm by unit forces, shape (p, 3, 3), mm/N; see `SpatialResponse`."""
        u = self.mesh.at(column.made.reshape(-1, 3, 3), points)
        for material, some in self._materials(column.places).items():
            u += self._moves(points, column.places[some], column.weights[some], material)
        return u

    def field_of(self, columns: Sequence[SpatialColumn], forces: Floats) -> Callable[[Floats], Floats]:
        """Field under forces (k, 3) in N, one for each column; see `SpatialResponse`."""
        values = np.zeros(3 * self.mesh.size)
        places, loads = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for column, f in zip(columns, forces, strict=True):
            if f.any():
                values += column.made @ f
                places.append(column.places)
                loads.append(np.outer(column.weights, f))
        where, f = np.concatenate(places), np.concatenate(loads)
        near = tuple(
            ForceField(
                Forces(where[some], f[some], np.full(len(some), self.radius)), young, poisson, self.top
            )
            for (young, poisson), some in self._materials(where).items()
        )
        return CorrectedField(near, self.mesh, values.reshape(-1, 3))

    def warnings(self, columns: Sequence[SpatialColumn], forces: Floats) -> dict[str, str]:
        """Say where forces (k, 3) in N of the columns are more than tissue bears without |grad u| above 1."""
        return folding(self.tissue, self.radius, columns, forces)

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        cells = " x ".join(str(len(line) - 1) for line in self.mesh.lines)
        size = max(float(np.diff(line).max()) for line in self.mesh.lines)
        return f"closed forms near the needle and {cells} quadratic hexahedra of {size:.2g} mm or less for the rest, factored once"

    def _materials(self, places: Floats) -> dict[Material, Cells]:
        """Of which E and nu the closed form near each place is: those of the tissue there, but for ``least``."""
        if not len(places):
            return {}
        young, poisson = self.tissue.at(places)
        near = np.stack([np.maximum(young, self.least), poisson], axis=1)
        material, which = np.unique(near, axis=0, return_inverse=True)
        return {
            (float(E), float(nu)): np.flatnonzero(which.ravel() == k) for k, (E, nu) in enumerate(material)
        }

    def _scale(self, material: Material) -> float:
        return 1.0 / (16.0 * np.pi * shear_modulus(*material) * (1.0 - material[1]))

    def _moves(self, points: Floats, places: Floats, weights: Floats, material: Material) -> Floats:
        """Displacement (n, 3, 3) in mm at points by unit forces in a half space of one modulus."""
        p = points
        if self.top is not None and (points[:, 1] < 0).any():
            p = np.maximum(points, [-np.inf, 0.0, -np.inf])
        K = kelvinlet(p, places, material[1], self.radius, self.top)
        moves: Floats = self._scale(material) * np.einsum("nimk,m->nik", K, weights)
        return moves

    def _slopes(self, points: Floats, places: Floats, weights: Floats, material: Material) -> Floats:
        """Displacement gradient (n, 3, 3, 3) of the same: [component, force, direction]."""
        G = gradient(points, places, material[1], self.radius, self.top)
        slopes: Floats = self._scale(material) * np.einsum("nimkd,m->nikd", G, weights)
        return slopes

    def _jumps(self, material: Material, places: Floats, weights: Floats, moves: Floats) -> Floats:
        """Nodal loads (n, 3, 3) of the stresses by which tissue of another modulus differs, in the closed form's strain."""
        n = self.mesh.size
        if self.tissue.homogeneous:
            return np.zeros((n, 3, 3))
        if material not in self._less:
            while len(self._less) >= KEPT:
                self._less.pop(next(iter(self._less)))
            self._less[material] = self.mesh.difference(*material)
        less = self._less[material]
        u = moves.reshape(3 * n, 3)
        loads: Floats = (less @ u).reshape(n, 3, 3)
        # cells near a force: what the nodes said is replaced by integration
        lam0, mu0 = (MPA * float(m) for m in lame(*material, "strain"))
        first, size = self.mesh.extents
        gap = np.maximum(np.maximum(first[:, None] - places, places - (first + size)[:, None]), 0.0)
        near = np.linalg.norm(gap, axis=2).min(axis=1) < NEAR * np.linalg.norm(size, axis=1)
        where = self.mesh.integration_points(FINE_GAUSS, np.flatnonzero(near))
        lam, mu = self.mesh.moduli(where)
        differs = ((lam != lam0) | (mu != mu0)).any(axis=1)
        where, lam, mu = where[differs], lam[differs] - lam0, mu[differs] - mu0
        if not len(where):
            return loads
        exact = self._slopes(where.reshape(-1, 3), places, weights, material)
        exact = exact.reshape(*where.shape[:2], 3, 3, 3)
        which = np.flatnonzero(near)[differs]
        for i, (cell, dN, w) in enumerate(self.mesh.strains(which, FINE_GAUSS)):
            nodes = self.mesh.cells[cell]
            nodal = np.einsum("qad,aik->qikd", dN, moves[nodes])
            slope = exact[i] - nodal
            trace = np.einsum("qiki->qk", slope)
            stress = mu[i][:, None, None, None] * (slope + slope.transpose(0, 3, 2, 1))
            stress[:, range(3), :, range(3)] += (lam[i][:, None] * trace)[None]
            loads[nodes] += np.einsum("q,qikd,qad->aik", w, stress, dN)
        return loads

    def _pulls(self, places: Floats, weights: Floats, material: Material) -> Floats:
        """Nodal loads (n, 3, 3) of the closed form's traction on faces that are free or slide; its own surface has none."""
        loads = np.zeros((self.mesh.size, 3, 3))
        mu = shear_modulus(*material)
        for face, (points, normals, index, shares) in self._loose.items():
            G = gradient(points, places, material[1], self.radius, self.top)
            t = (
                mu
                * self._scale(material)
                * np.einsum("nimk,m->nik", tractions(G, normals, material[1]), weights)
            )
            if self.clamps.kind(face) == "sliding":
                t[:, SIDES[face][0]] = 0.0
            np.add.at(loads, index, shares[:, :, None, None] * t[:, None])
        return loads

    @cached_property
    def _loose(self) -> dict[str, tuple[Floats, Floats, Cells, Floats]]:
        """Of every face that is free or slides, but for the top: integration points, normals, and nodes with shares of a traction."""
        found = {}
        t, w = np.polynomial.legendre.leggauss(FACE_GAUSS)
        low, high = self.grid.corners
        for face, (axis, side) in SIDES.items():
            if self.clamps.kind(face) == "clamped" or face == "top":
                continue
            lines, weights = [], []
            for k in range(3):
                if k == axis:
                    lines.append(np.array([high[k] if side else low[k]]))
                    weights.append(np.ones(1))
                    continue
                a, h = self.mesh.lines[k][:-1, None], np.diff(self.mesh.lines[k])[:, None]
                lines.append((a + h * (t + 1.0) / 2.0).ravel())
                weights.append((h / 2.0 * w).ravel())
            Z, Y, X = np.meshgrid(*lines[::-1], indexing="ij")
            points = np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1)
            area = np.einsum("c,b,a->cba", *weights[::-1]).ravel()
            normals = np.zeros_like(points)
            normals[:, axis] = 1.0 if side else -1.0
            index, shares = self.mesh.shares(points)
            found[face] = points, normals, index, area[:, None] * shares
        return found
