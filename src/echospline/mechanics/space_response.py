"""Elastic tissue in space that answers point forces: closed forms, and forces outside its faces that make the faces what they are.

The closed form (`half_space.kelvinlet`) knows the surface, free or under a probe. What the other faces do is smooth inside the tissue, and
is made by point forces a little outside them whose strengths are least squares over rows of points on the faces: the method of fundamental
solutions (G. Fairweather and A. Karageorghis, Adv. Comput. Math. 9, 1998). No mesh is needed, and the field is known at every point.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from echospline import _native as core
from echospline._native import space
from echospline.errors import InputError
from echospline.mechanics.half_space import Top, gradient, kelvinlet, tractions
from echospline.mechanics.landmarks import SIDES, Clamps
from echospline.mechanics.response import SpatialColumn
from echospline.mechanics.spread import folding
from echospline.scene import Floats, SpatialGrid, Tissue, as_points

Kind = Literal["clamped", "sliding", "free"]

TOPS = {None: space.SpaceTop.TOP_NONE, "free": space.SpaceTop.TOP_FREE, "sliding": space.SpaceTop.TOP_SLIDING}
SPACING = 0.19
"""Distance between boundary forces, and of them from the faces, as a share of the edge of a cube as large as the tissue."""
ROWS = 0.44
"""Distance between the rows' points as a share of that between forces: equal spacing fails."""
PROLONGED = 0.5
"""Boundary forces reach this share of their spacing beyond the edges of a face."""
LATTICE = 0.45
"""Spacing of the lattice that carries what the faces do, as a share of the boundary forces': adds some tenths of a percent."""
TRACTION = 10.0
"""mm; what a traction over mu is multiplied by to weigh as much as a displacement."""


@dataclass(frozen=True, eq=False)
class Forces:
    """Point forces in space.

    Parameters
    ----------
    places, forces : ndarray, shape (m, 3)
        mm and N.
    radii : ndarray, shape (m,)
        Over which each is spread, mm.
    """

    places: Floats
    forces: Floats
    radii: Floats


@dataclass(frozen=True, eq=False)
class Lattice:
    """A smooth displacement on a lattice; between its points cubic convolution.

    Parameters
    ----------
    spacing, origin : ndarray, shape (3,)
        mm.
    values : ndarray, shape (nz, ny, nx, 3)
        mm.
    """

    spacing: Floats
    origin: Floats
    values: Floats


@dataclass(frozen=True, eq=False)
class ForceField:
    """Displacement of homogeneous tissue in space under point forces, at any points.

    Parameters
    ----------
    needle : Forces
        Inside the tissue.
    young, poisson : float
        E (kPa) and nu.
    top : {"free", "sliding"} or None
        What the surface y = 0 is.
    smooth : Lattice, optional
        What the faces do.
    """

    needle: Forces
    young: float
    poisson: float
    top: Top | None
    smooth: Lattice | None = None

    def __call__(self, points: Floats) -> Floats:
        """Displacement (n, 3) in mm at points (n, 3) in mm; above the surface it goes on as it is there.

        Raises
        ------
        InputError
            If the core refuses a number.
        """
        return displacement(points, self.needle, self.young, self.poisson, self.top, self.smooth)

    def in_core(self) -> tuple[space.ForceField, list[Floats]]:
        """Return the field as the core takes it, and the arrays that it points to: keep them as long as it is used."""
        return in_core(self.needle, self.young, self.poisson, self.top, self.smooth)


def in_core(
    f: Forces, young: float, poisson: float, top: Top | None, smooth: Lattice | None
) -> tuple[space.ForceField, list[Floats]]:
    """Return a field as the core takes it, and the arrays that it points to."""
    o = space.ForceField(struct_size=ctypes.sizeof(space.ForceField), top=TOPS[top], poisson=poisson)
    o.shear_modulus, o.force_count = shear_modulus(young, poisson), len(f.places)
    arrays = [np.ascontiguousarray(v, dtype=np.float64) for v in (f.places, f.forces, f.radii)]
    o.places, o.forces, o.radii = (v.ctypes.data for v in arrays)
    if smooth is not None:
        values = np.ascontiguousarray(smooth.values, dtype=np.float64)
        arrays.append(values)
        o.lattice = values.ctypes.data
        o.lattice_shape[:], o.lattice_spacing[:] = values.shape[2::-1], [float(h) for h in smooth.spacing]
        o.lattice_origin[:] = [float(v) for v in smooth.origin]
    return o, arrays


def displacement(
    points: Floats, f: Forces, young: float, poisson: float, top: Top | None, smooth: Lattice | None = None
) -> Floats:
    """Sum closed forms in the core, single precision; shape (n, 3), mm. Above a surface tissue moves as on it.

    Raises
    ------
    InputError
        If the core refuses a number.
    """
    p = np.ascontiguousarray(points, dtype=np.float64)
    o, _kept = in_core(f, young, poisson, top, smooth)
    u = np.empty_like(p)
    status = space.library().echospline_force_field_at(ctypes.byref(o), p.ctypes.data, len(p), u.ctypes.data)
    if status != core.Status.OK:
        text: bytes = space.library().echospline_status_text(status)
        raise InputError(
            f"the field of {len(f.places)} forces at {len(p)} points cannot be summed ({text.decode()}): forces lie below the "
            "surface, and every number is finite and below 1e6 mm"
        )
    return u


class SpaceResponse:
    """Homogeneous tissue, a block held at its faces, answering point forces.

    Parameters
    ----------
    grid : SpatialGrid
        Its corners are the block's; the top is y = 0.
    clamps : Clamps
        Faces that are clamped or slide. A top that is neither is a free surface.
    tissue : Tissue
        Homogeneous; E and nu.
    radius : float
        Over which a force of the needle is spread, mm. Tissue folds where a force exceeds about 10 E e^2.

    Raises
    ------
    InputError
        If the tissue has regions or is incompressible, points are clamped, or the surface is not y = 0.
    """

    def __init__(self, grid: SpatialGrid, clamps: Clamps, tissue: Tissue, *, radius: float = 0.7) -> None:
        if not tissue.homogeneous:
            raise InputError(
                "the closed form in space is that of homogeneous tissue; for tissue with regions use finite elements (fem)"
            )
        if not -1 < tissue.poisson < 0.5:
            raise InputError(
                f"Poisson's ratio in space must lie in (-1, 0.5); got {tissue.poisson}: take 0.49 for nearly incompressible tissue"
            )
        if len(clamps.points):
            raise InputError("points cannot be clamped in space by green; clamp a face, or use elastic")
        if not (np.isfinite(radius) and radius > 0):
            raise InputError(f"radius of a force must be a positive number in mm; got {radius}")
        low, _ = grid.corners
        kinds: dict[str, Kind] = {face: clamps.kind(face) for face in SIDES}
        self.top: Top | None = None
        if kinds["top"] == "free" or kinds["top"] == "sliding":
            self.top = "free" if kinds["top"] == "free" else "sliding"
            if abs(low[1]) > 1e-6:
                raise InputError(f"the surface of tissue in space is y = 0; the mesh begins at {low[1]:g} mm")
        self.grid, self.clamps, self.tissue, self.radius, self.kinds = grid, clamps, tissue, radius, kinds
        self._solve = self._least_squares()

    @property
    def mu(self) -> float:
        """Shear modulus, N/mm^2."""
        return shear_modulus(self.tissue.young, self.tissue.poisson)

    @property
    def middle(self) -> Floats:
        """Middle of the block, mm."""
        low, high = self.grid.corners
        middle: Floats = (low + high) / 2
        return middle

    @cached_property
    def spacing(self) -> float:
        """Distance between boundary forces, mm."""
        low, high = self.grid.corners
        return float(SPACING * np.prod(high - low) ** (1 / 3))

    @cached_property
    def sources(self) -> Floats:
        """Places of the boundary forces, shape (m, 3) mm."""
        return np.concatenate([self._face(face, self.spacing, self.spacing) for face in self._faces])

    @cached_property
    def rows(self) -> dict[str, Floats]:
        """Points on every face at which its condition is asked for, mm."""
        return {face: self._face(face, ROWS * self.spacing, 0.0) for face in self._faces}

    @property
    def _faces(self) -> tuple[str, ...]:
        return tuple(face for face in SIDES if face != "top" or self.top is None)

    @property
    def _scale(self) -> float:
        return 1.0 / (16.0 * np.pi * self.mu * (1.0 - self.tissue.poisson))

    def field(self, places: Floats, forces: Floats) -> ForceField:
        """Return the field under point forces of the needle.

        Parameters
        ----------
        places, forces : ndarray, shape (m, 3)
            mm and N.

        Raises
        ------
        InputError
            If a place lies outside the tissue.
        """
        p, f = as_points(places, "places", 3), as_points(forces, "forces", 3)
        if not self.grid.contains(p).all():
            where = tuple(float(c) for c in p[np.flatnonzero(~self.grid.contains(p))[0]])
            raise InputError(f"forces act inside the tissue; got one at {where} mm")
        p = self._below(p)
        return self._summed(p, f, self._answers(p, f[..., None])[:, 0])

    def column(self, places: Floats, weights: Floats) -> SpatialColumn:
        """Answer unit forces along x, y and z that are spread over places (m, 3) in mm by weights (m,); see `SpatialResponse`."""
        p = as_points(places, "places", 3) if len(places) else np.zeros((0, 3))
        if not self.grid.contains(p).all():
            raise InputError(
                f"forces act inside the tissue; got places from {p.min(axis=0)} to {p.max(axis=0)} mm"
            )
        p = self._below(p)
        return SpatialColumn(p, weights, self._answers(p, weights[:, None, None] * np.eye(3)))

    def column_at(self, column: SpatialColumn, points: Floats) -> Floats:
        """Displacement of points (p, 3) in mm by unit forces, shape (p, 3, 3), mm/N; see `SpatialResponse`."""
        young, poisson = self.tissue.young, self.tissue.poisson
        u = np.zeros((len(points), 3, 3))
        if not len(column.places):
            return u
        count = 3 * len(self.sources)
        for k, unit in enumerate(np.eye(3)):
            every = Forces(
                np.concatenate([column.places, self.sources]),
                np.concatenate([column.weights[:, None] * unit, column.made[:count, k].reshape(-1, 3)]),
                np.concatenate([
                    np.full(len(column.places), self.radius), np.full(len(self.sources), 1e-3 * self.spacing)
                ]),
            )  # fmt: skip
            u[:, :, k] = ForceField(every, young, poisson, self.top)(points)
        u += rigid_motions(points - self.middle)[:, :, self._allowed()] @ column.made[count:]
        return u

    def field_of(self, columns: Sequence[SpatialColumn], forces: Floats) -> ForceField:
        """Field under forces (k, 3) in N, one for each column; see `SpatialResponse`."""
        loaded = [(c, f) for c, f in zip(columns, forces, strict=True) if len(c.places) and f.any()]
        answer = np.zeros(self._solve.shape[0])
        for column, f in loaded:
            answer += column.made @ f
        places = np.concatenate([np.zeros((0, 3)), *(c.places for c, _ in loaded)])
        loads = np.concatenate([np.zeros((0, 3)), *(np.outer(c.weights, f) for c, f in loaded)])
        return self._summed(*merged(places, loads), answer)

    def warnings(self, columns: Sequence[SpatialColumn], forces: Floats) -> dict[str, str]:
        """Say where forces (k, 3) in N of the columns are more than tissue bears without |grad u| above 1."""
        return folding(self.tissue, self.radius, columns, forces)

    def _answers(self, p: Floats, forces: Floats) -> Floats:
        """Boundary forces (N) and motions (mm) that hold the faces under k load cases (m, 3, k) at p, shape (M, k)."""
        nu, shape = self.tissue.poisson, (3 * len(p), forces.shape[2])
        f = self._scale * forces.reshape(shape)

        def moves(c: Floats) -> Floats:
            return kelvinlet(c, p, nu, self.radius, self.top).reshape(len(c), 3, -1) @ f

        def pulls(c: Floats, n: Floats) -> Floats:
            t = tractions(gradient(c, p, nu, self.radius, self.top), n, nu)
            return t.reshape(len(c), 3, -1) @ f

        answers: Floats = self._solve @ self._conditions(moves, pulls)
        return answers

    def _summed(self, places: Floats, forces: Floats, answer: Floats) -> ForceField:
        """Field of forces of the needle, and of what the faces answer to them."""
        m = 3 * len(self.sources)
        outer = Forces(
            self.sources, answer[:m].reshape(-1, 3), np.full(len(self.sources), 1e-3 * self.spacing)
        )
        spacing, origin, shape, points = self._lattice
        values = displacement(points, outer, self.tissue.young, self.tissue.poisson, self.top)
        values += rigid_motions(points - self.middle)[:, :, self._allowed()] @ answer[m:]
        needle = Forces(places, forces, np.full(len(places), self.radius))
        smooth = Lattice(spacing, origin, values.reshape(*shape[::-1], 3))
        return ForceField(needle, self.tissue.young, self.tissue.poisson, self.top, smooth)

    def answer(self, places: Floats, forces: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Displacement of the mesh (n, 3, k) and of points (p, 3, k) in mm under k load cases (m, 3, k) in N at places (m, 3)."""
        every = np.concatenate([self.grid.nodes, points])
        fields = [self.field(places, forces[:, :, k])(every) for k in range(forces.shape[2])]
        u = np.stack(fields, axis=2) if fields else np.zeros((len(every), 3, 0))
        return u[: self.grid.size], u[self.grid.size :]

    def at(self, places: Floats, forces: Floats, points: Floats) -> Floats:
        """Displacement of points (p, 3, k) in mm under k load cases, without the mesh."""
        fields = [self.field(places, forces[:, :, k])(points) for k in range(forces.shape[2])]
        return np.stack(fields, axis=2) if fields else np.zeros((len(points), 3, 0))

    def tables(self) -> dict[str, int | float | Floats | NDArray[np.uint32]]:
        """Return what the core needs to answer in this response's place, named as in ``echospline_spatial_options``; arrays are flat."""
        faces = [np.full(len(points), _bit(face), dtype=np.uint32) for face, points in self.rows.items()]
        spacing, origin, shape, _ = self._lattice
        low, high = self.grid.corners
        return {
            "low": low,
            "high": high,
            "top": int(TOPS[self.top]),
            "clamped": sum(_bit(face) for face, kind in self.kinds.items() if kind == "clamped"),
            "sliding": sum(_bit(face) for face, kind in self.kinds.items() if kind == "sliding"),
            "poisson": self.tissue.poisson,
            "shear_modulus": self.mu,
            "radius": self.radius,
            "source_radius": 1e-3 * self.spacing,
            "traction_length": TRACTION,
            "sources": self.sources.ravel(),
            "conditions": np.concatenate(list(self.rows.values())).ravel(),
            "condition_faces": np.concatenate(faces),
            "answers": self._solve.ravel(),
            "lattice_shape": np.array(shape, dtype=np.uint32),
            "lattice_spacing": spacing,
            "lattice_origin": origin,
        }

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        surface = {
            None: "in space without a surface",
            "free": "under a free surface",
            "sliding": "under a probe's face",
        }[self.top]
        return f"closed form {surface} and {len(self.sources)} forces outside the faces"

    def _least_squares(self) -> Floats:
        """Return the matrix from conditions that the needle violates to boundary forces (N) and motions."""
        nu = self.tissue.poisson
        count = 3 * len(self.sources)
        matrix = self._conditions(
            lambda c: (self._scale * kelvinlet(c, self.sources, nu, 0.0, self.top)).reshape(len(c), 3, count),
            lambda c, n: (
                self._scale
                * tractions(gradient(c, self.sources, nu, 0.0, self.top), n, nu).reshape(len(c), 3, count)
            ),
        )
        allowed = self._allowed()
        shifts = self._conditions(
            lambda c: rigid_motions(c - self.middle)[:, :, allowed],
            lambda c, n: np.zeros((len(c), 3, len(allowed))),
        )
        # columns of one size: a force of 1 N moves little, a shift of 1 mm much
        size = np.abs(matrix).max()
        U, s, Vt = np.linalg.svd(np.hstack([matrix / size, shifts]), full_matrices=False)
        kept = s > 1e-8 * s[0]
        solution: Floats = -(Vt[kept].T / s[kept]) @ U[:, kept].T
        solution[:count] /= size
        return solution

    def _conditions(
        self, moves: Callable[[Floats], Floats], pulls: Callable[[Floats, Floats], Floats]
    ) -> Floats:
        """Stack what every face must hold at zero, given displacements and tractions over mu at its points, (n, 3[, k])."""
        stacked = []
        for face, points in self.rows.items():
            axis, side = SIDES[face]
            kind = self.kinds[face]
            normal = np.zeros((len(points), 3))
            normal[:, axis] = 1.0 if side else -1.0
            if kind == "clamped":
                rows = moves(points)
            elif kind == "free":
                rows = TRACTION * pulls(points, normal)
            else:
                rows = TRACTION * pulls(points, normal)
                rows[:, axis] = moves(points)[:, axis]
            stacked.append(rows.reshape(3 * len(points), *rows.shape[2:]))
        return np.concatenate(stacked)

    def _moves(self, points: Floats, places: Floats, forces: Floats) -> Floats:
        K = kelvinlet(points, places, self.tissue.poisson, self.radius, self.top)
        u: Floats = self._scale * np.einsum("nimj,mj->ni", K, forces)
        return u

    def _pulls(self, points: Floats, normals: Floats, places: Floats, forces: Floats) -> Floats:
        nu = self.tissue.poisson
        T = tractions(gradient(points, places, nu, self.radius, self.top), normals, nu)
        t: Floats = self._scale * np.einsum("nimj,mj->ni", T, forces)
        return t

    def _below(self, places: Floats) -> Floats:
        """Keep forces at least their radius below a surface: the image is that of a point."""
        if self.top is None:
            return places
        deep = places.copy()
        deep[:, 1] = np.maximum(deep[:, 1], self.radius)
        return deep

    def _allowed(self) -> list[int]:
        """Rigid motions that the surface of the closed form allows."""
        return [0, 2, 4] if self.top == "sliding" else list(range(6))

    @cached_property
    def _lattice(self) -> tuple[Floats, Floats, tuple[int, int, int], Floats]:
        """Spacing, origin, shape and points of a lattice over the block and one cell beyond it on every side."""
        low, high = self.grid.corners
        cells = np.maximum(np.ceil((high - low) / (LATTICE * self.spacing)), 2).astype(int)
        spacing = (high - low) / cells
        first = low - spacing
        x, y, z = (first[k] + spacing[k] * np.arange(cells[k] + 3) for k in range(3))
        Z, Y, X = np.meshgrid(z, y, x, indexing="ij")
        points = np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1)
        return spacing, first, (len(x), len(y), len(z)), points

    def _face(self, face: str, spacing: float, out: float) -> Floats:
        """Points in a face, about ``spacing`` apart, moved out by ``out`` and prolonged by half as much beyond its edges.

        Under a free surface they stand closer the shallower they are: where it meets a clamped face the stress is singular.
        """
        axis, side = SIDES[face]
        low, high = self.grid.corners
        lines = []
        for k in range(3):
            if k == axis:
                lines.append(np.array([high[k] + out if side else low[k] - out]))
                continue
            first, last = float(low[k] - PROLONGED * out), float(high[k] + PROLONGED * out)
            under = k == 1 and self.top is not None
            if under:
                first = float(low[k])  # nothing above a surface
            count = max(2, round((last - first) / spacing))
            share = (np.arange(count) + 0.5) / count
            lines.append(first + (share**2 if under and self.top == "free" else share) * (last - first))
        Z, Y, X = np.meshgrid(*lines[::-1], indexing="ij")
        return np.stack([X.ravel(), Y.ravel(), Z.ravel()], axis=1)


def merged(places: Floats, loads: Floats) -> tuple[Floats, Floats]:
    """Add up forces (m, 3) that act in one place (m, 3), as every second of a straight track does.

    A station's hat has four places, half a spacing apart; its last two are the first two of the next one, two places later in the row.
    """
    again = np.zeros(len(places), dtype=bool)
    again[2:] = (np.abs(places[2:] - places[:-2]) < 1e-9).all(axis=1)
    total = loads.copy()
    for i in np.flatnonzero(again)[::-1]:
        total[i - 2] += total[i]
    return places[~again], total[~again]


def _bit(face: str) -> int:
    """Bit of a face in the core."""
    axis, side = SIDES[face]
    return 1 << (2 * axis + int(side))


def shear_modulus(young: float, poisson: float) -> float:
    """Shear modulus in N/mm^2 from E in kPa and nu."""
    return 1e-3 * young / (2.0 * (1.0 + poisson))


def rigid_motions(points: Floats) -> Floats:
    """Three shifts and three turns at points (n, 3), shape (n, 3, 6)."""
    motions = np.zeros((len(points), 3, 6))
    motions[:, :, :3] = np.eye(3)
    for k, unit in enumerate(np.eye(3)):
        motions[:, :, 3 + k] = np.cross(unit, points)
    return motions


def block(
    size: Iterable[float], kinds: Mapping[str, Kind], shape: tuple[int, int, int] = (9, 8, 7)
) -> tuple[SpatialGrid, Clamps]:
    """Return the mesh and clamps of a block of tissue: ``size`` (x, y, z) mm, x and z about 0, its surface at y = 0."""
    x, y, z = size
    grid = SpatialGrid.spanning((-x / 2, 0.0, -z / 2), (x / 2, y, z / 2), shape)
    clamped = [face for face, kind in kinds.items() if kind == "clamped"]
    return grid, Clamps.of(grid, clamped, sliding=[face for face, kind in kinds.items() if kind == "sliding"])
