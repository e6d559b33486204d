"""The method of fundamental solutions: closed forms plus what the edges and the interfaces of the tissue do.

The field of a needle's forces is that of the closed form below the top (`half_plane`), in every region with the region's own
moduli, plus the field of point forces that stand outside each region. These are chosen, by least squares, such that the
conditions on the other edges hold (no displacement, no traction, or one component of each) and that displacement and traction
agree on both sides of every interface. The decomposition is made once; there is no mesh, and the field is known at any point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from echospline.errors import InputError
from echospline.mechanics.half_plane import HalfPlane
from echospline.mechanics.landmarks import SIDES, Clamps
from echospline.scene import EDGES, Circle, Floats, Layer, RegularGrid, Tissue, as_points

Kind = Literal["clamped", "sliding", "free"]

ACROSS, ACROSS_REGIONS = 20, 15
"""Spacings of the forces outside the edges in the shorter side of the tissue (1.5 and 2 mm for 30): homogeneous, and with regions,
whose interfaces cost set-up time. Fewer double the residual, more the set-up."""

AROUND = 16
"""Spacings in the whole outline at most, in those of the shorter side: flat tissue gets a coarser spacing, and its residual shows
whether that is enough."""

OUTSIDE = 2.0
"""Distance of the forces from their edge, in their spacings. Nearer, the field between them ripples; farther, the system is ill
conditioned."""

ROWS = 2.5
"""Conditions per force. One for one lets the field between the conditions go astray by up to 40 %; with two, they all stand where
the ripple of a row of forces crosses zero."""

INTERFACE = 1.0 / 30.0
"""Spacing of forces along an interface, in the shorter side of the tissue (1 mm for 30)."""

THIN = 3
"""Forces along each side of a band at least."""

THINNEST = 2.0
"""Least thickness of a band in the spacing along interfaces: conditions on its sides would be too few to balance it."""

FEWEST, MOST = 24, 72
"""Forces along a round interface, on each side."""

INNER, OUTER = 1.5, 2.25
"""Distance of the forces inside and outside a round interface from it, in their spacings."""

WEIGHT = 0.2
"""Length that turns a traction over the shear modulus into a displacement in the least squares, in the shorter side of the tissue."""

PIN = 10.0
"""Weight of the displacement of a clamped point, of which there are few, beside that of a condition on an edge."""

NEAREST = 0.75
"""Least distance of a force from an edge or interface, in the spacing of the forces outside the edges."""

RANK = 1e-9
"""Pivots below this share of the largest are left out: their strengths would be huge and cancel each other."""

SMOOTH = 1e-3
"""Accuracy to which the field of one force outside the edges is interpolated from a Chebyshev lattice on fine meshes. That of all
of them is better than 1e-4 but for a cell or two at a corner under a free top (4e-4), where the residual is larger."""

MANY = 600
"""Unknowns of tissue with regions at most: more would take longer to set up than a live solve."""

LARGEST = 2.5e8
"""Bytes of the matrix from forces along interfaces to mesh nodes at most."""


class UnsuitedError(InputError):
    """The tissue is none that this method can represent; the message says why."""


@dataclass(frozen=True)
class Body:
    """A part of the tissue of one material.

    Attributes
    ----------
    base : HalfPlane
        The closed form under the needle's forces: this material below the top.
    outside : HalfPlane
        The closed form of the forces outside this part: with the image where the part touches the top, else without end.
    sources : ndarray, shape (m, 2)
        Places of the forces outside this part, mm.
    """

    base: HalfPlane
    outside: HalfPlane
    sources: Floats


@dataclass(frozen=True)
class Piece:
    """A piece of an edge or of an interface, where conditions hold.

    Attributes
    ----------
    points, between : ndarray, shape (n, 2)
        Where the conditions are asked for, and where they are checked, mm.
    normals, normals_between : ndarray, shape (n, 2)
        Unit normals there, out of the first body.
    bodies : tuple of int
        The part of the tissue; two of them at an interface.
    kind : {"clamped", "sliding", "free"}
        Of an edge.
    axis : int
        Direction of the normal of an edge that slides: 0 is x, 1 is y.
    """

    points: Floats
    normals: Floats
    between: Floats
    normals_between: Floats
    bodies: tuple[int, ...]
    kind: Kind = "free"
    axis: int = 0

    @property
    def moves(self) -> bool:
        """Whether a condition speaks of displacement."""
        return len(self.bodies) == 2 or self.kind != "free"

    @property
    def pulls(self) -> bool:
        """Whether a condition speaks of traction."""
        return len(self.bodies) == 2 or self.kind != "clamped"


@dataclass(frozen=True)
class Partition:
    """The tissue in parts: straight bands from top to bottom, and round parts inside them.

    Attributes
    ----------
    depths : ndarray, shape (bands + 1,)
        Where bands begin and end, mm.
    circles : tuple of Circle
        Round parts; their bodies come after the bands.
    """

    depths: Floats
    circles: tuple[Circle, ...] = ()

    def locate(self, points: Floats) -> NDArray[np.intp]:
        """Return the index of the body at points (n, 2)."""
        body = np.clip(
            np.searchsorted(self.depths, points[:, 1], side="right") - 1, 0, len(self.depths) - 2
        ).astype(np.intp)
        for q, circle in enumerate(self.circles):
            body[circle.contains(points)] = len(self.depths) - 1 + q
        return body

    def distance(self, points: Floats) -> Floats:
        """Distance from points (n, 2) to the nearest interface, mm, shape (n,); infinite where there is none."""
        nearest = np.full(len(points), np.inf)
        for depth in self.depths[1:-1]:
            nearest = np.minimum(nearest, np.abs(points[:, 1] - depth))
        for circle in self.circles:
            nearest = np.minimum(nearest, np.abs(np.hypot(*(points - circle.centre).T) - circle.radius))
        return nearest


@dataclass(frozen=True)
class Residual:
    """How well the conditions hold between the points at which they were asked for.

    Attributes
    ----------
    mean, worst : float
        Mean difference to the condition as a share of the mean displacement, over forces all over the tissue, and
        under the worst of them.
    """

    mean: float
    worst: float


class BoundaryForces:
    """Tissue of one or a few materials in a rectangle that answers point forces; a `ForceResponse`.

    Parameters
    ----------
    grid : RegularGrid
        The mesh; its extent is the tissue.
    clamps : Clamps
        What holds the tissue.
    tissue : Tissue
        Homogeneous, or with straight layers and round lesions.
    radius : float
        Over which a force is spread, mm.

    Attributes
    ----------
    partition : Partition
        The parts of the tissue.
    bodies : tuple of Body
        One per part.
    pieces : tuple of Piece
        Edges and interfaces with their conditions.
    order : ndarray of int
        Unknowns that the least squares keep, best first.
    spacing : float
        Distance between forces outside an edge, mm.
    weight : float
        Length that turns a traction into a displacement, over the shear modulus and thickness, mm^2/N.
    residual : Residual
        How well the conditions hold.

    Raises
    ------
    UnsuitedError
        If the tissue has other regions, or regions that cross or touch each other or an edge.
    InputError
        If a number is out of its range.
    """

    def __init__(self, grid: RegularGrid, clamps: Clamps, tissue: Tissue, radius: float = 0.4) -> None:
        if not (np.isfinite(radius) and radius > 0):
            raise InputError(f"radius of a force must be a positive number in mm; got {radius}")
        x0, x1, y0, y1 = grid.extent
        if not (x1 > x0 and y1 > y0):
            raise InputError(f"tissue needs a mesh of 2 x 2 nodes or more; got {grid.shape}")
        self._grid, self.clamps, self.tissue, self.radius = grid, clamps, tissue, radius
        short = min(x1 - x0, y1 - y0)
        self.partition, moduli = divide(tissue, grid)
        across = ACROSS if len(moduli) == 1 else ACROSS_REGIONS
        self.spacing = max(short, 2.0 * (x1 - x0 + y1 - y0) / AROUND) / across
        self.bodies, self.pieces = lay_out(self, moduli, short * INTERFACE)
        rigid = {"free": 3, "sliding": 1, "clamped": 0, None: 3}
        self._counts = [2 * len(b.sources) + rigid[b.outside.top] for b in self.bodies]
        self._refuse_large()
        # The softest band, for a traction missed there moves it most; a softer lesion must not outweigh everything else.
        self.weight = (
            WEIGHT * short / min(b.base.stiffness for b in self.bodies[: len(self.partition.depths) - 1])
        )
        self._solution, self.order = self._decomposed()
        self._held = self._holds(grid.nodes)
        self.residual = self._checked()

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self._grid

    def answer(self, places: Floats, forces: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Displacement of the mesh nodes and of points under load cases; see `ForceResponse.answer`."""
        s, p = inside(self.grid, places, "places of forces"), inside(self.grid, points, "points")
        F = load_cases(s, forces)
        c = self._strengths(s, F)
        nodes = self.grid.nodes
        mesh = self._base(nodes, s, F) + self._nodes.field(c)
        at = self._base(p, s, F) + self._columns(p) @ c
        k = F.shape[1]
        mesh, at = mesh.reshape(len(nodes), 2, k), at.reshape(len(p), 2, k)
        mesh[self._held], at[self._holds(p)] = 0.0, 0.0
        return mesh, at

    @property
    def pin_radius(self) -> float:
        """Radius of the blob whose centre yields to a force as a rigid pin of ``radius`` does, mm.

        Far from it both are the same force; at the rim of a pin the mean displacement is (3 - 4 nu) ln(1 / r) + 1 / 2, at the
        centre of a blob (3 - 4 nu) ln(1 / e) + 2 (1 - nu).
        """
        nu = self.bodies[0].base.nu
        return self.radius * float(np.exp((1.5 - 2.0 * nu) / (3.0 - 4.0 * nu)))

    @property
    def factors(self) -> tuple[Floats, Floats]:
        """Factors right (unknowns, rank) and left (rank, rows): strengths are -right left conditions, rows condition by condition.

        At an interface a condition has four rows: displacement along x and y, then traction.
        """
        right, left = self._solution
        order, first = [], 0
        for piece in self.pieces:
            n = len(piece.points)
            rows = np.arange(first, first + (4 if len(piece.bodies) == 2 else 2) * n)
            order.append(rows.reshape(-1, n, 2).transpose(1, 0, 2).ravel())
            first += len(rows)
        order.append(np.arange(first, left.shape[1]))
        return right, left[:, np.concatenate(order)]

    @property
    def nearest(self) -> float:
        """Distance of a force from an edge or an interface below which the conditions there cannot follow it, mm."""
        return NEAREST * self.spacing

    def clearance(self, places: Floats) -> Floats:
        """Distance of places (m, 2) from the edges that forces outside represent and from the interfaces, mm, shape (m,).

        A free or a sliding top is exact, and no edge here.
        """
        x0, x1, y0, y1 = self.grid.extent
        x, y = places.T
        gaps = [x - x0, x1 - x, y1 - y, self.partition.distance(places)]
        if self.clamps.kind("top") == "clamped":
            gaps.append(y - y0)
        nearest: Floats = np.min(gaps, axis=0)
        return nearest

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved, and its residual."""
        parts = len(self.bodies)
        what = (
            "the closed form for homogeneous tissue"
            if parts == 1
            else f"the closed form in {parts} regions, matched along their interfaces"
        )
        count = sum(len(b.sources) for b in self.bodies)
        return (
            f"{what}, with {count} forces outside; residual {100 * self.residual.mean:.2g} % of the mean displacement"
            f" ({100 * self.residual.worst:.2g} % under the worst force)"
        )

    # -- set-up ----------------------------------------------------------------------------------------------------

    def _holds(self, points: Floats) -> NDArray[np.bool_]:
        """Which components of points are held because they lie on an edge, shape (n, 2).

        There the conditions hold but for the residual, most of which is at the corners; the displacement is zero.
        """
        x0, x1, y0, y1 = self.grid.extent
        held = np.zeros((len(points), 2), dtype=bool)
        for edge in (*self.clamps.edges, *self.clamps.sliding):
            axis, side = SIDES[edge]
            on = np.abs(points[:, axis] - ((x0, x1), (y0, y1))[axis][side]) <= 1e-9 * max(x1 - x0, y1 - y0)
            held[on, axis] = True
            if edge in self.clamps.edges:
                held[on] = True
        return held

    def _refuse_large(self) -> None:
        """Refuse regions that would take longer to set up than a live solve, or whose matrix is too large."""
        unknowns = sum(self._counts)
        if len(self.bodies) > 1 and unknowns > MANY:
            raise UnsuitedError(f"its edges and interfaces need {unknowns} unknowns, more than {MANY}")
        if len(self.bodies) > 1 and 16 * self.grid.size * unknowns > LARGEST:
            raise UnsuitedError(
                f"{self.grid.size} mesh nodes beside interfaces need more than {LARGEST / 1e6:.0f} MB"
            )

    def _decomposed(self) -> tuple[tuple[Floats, Floats], NDArray[np.intp]]:
        """Least squares of the conditions as two factors: by QR with pivoting, two to three times as fast as singular values.

        Besides the factors, the unknowns that are kept.
        """
        Q, R, order = qr(self._conditions(check=False), mode="economic", pivoting=True, check_finite=False)
        size = np.abs(np.diag(R))
        rank = int((size > RANK * size[0]).sum())
        right = np.zeros((R.shape[1], rank))
        right[order[:rank]] = solve_triangular(R[:rank, :rank], np.eye(rank), check_finite=False)
        return (right, np.ascontiguousarray(Q[:, :rank].T)), order[:rank]

    def _conditions(self, check: bool) -> Floats:
        """What unit strengths do to the conditions, shape (rows, unknowns)."""
        blocks = []
        for piece in self.pieces:
            rows = []
            for q in piece.bodies:
                points, normals = _where(piece, check)
                u = self._own(q, points) if piece.moves else None
                t = self.weight * self._own_traction(q, points, normals) if piece.pulls else None
                rows.append(self._placed(q, _combine(piece, u, t)))
            blocks.append(rows[0] if len(rows) == 1 else rows[0] - rows[1])
        M = np.vstack(blocks)
        pins = self.clamps.points
        if len(pins):
            M = np.hstack([M, self._loaded(pins, check, self.pin_radius)])
            M = np.vstack([M, PIN * self._columns(pins)])
        return M

    def _loaded(self, places: Floats, check: bool = False, radius: float | None = None) -> Floats:
        """What unit forces at places inside the tissue do to the conditions on pieces, shape (rows, 2 m)."""
        blocks, radius = [], radius or self.radius
        for piece in self.pieces:
            points, normals = _where(piece, check)
            rows = []
            for q in piece.bodies:
                base = self.bodies[q].base
                u = base.displacement(points, places, radius) if piece.moves else None
                t = self.weight * base.traction(points, normals, places, radius) if piece.pulls else None
                rows.append(_combine(piece, u, t))
            blocks.append(rows[0] if len(rows) == 1 else rows[0] - rows[1])
        return np.vstack(blocks)

    def _strengths(self, places: Floats, forces: Floats) -> Floats:
        """Strengths of the forces outside, and of the clamped points, under load cases (2 m, k)."""
        load = self._loaded(places) @ forces
        if len(self.clamps.points):
            load = np.vstack([load, PIN * self._base(self.clamps.points, places, forces)])
        right, left = self._solution
        strengths: Floats = -(right @ (left @ load))
        return strengths

    def _base(self, points: Floats, places: Floats, forces: Floats, radius: float | None = None) -> Floats:
        """Closed form at points under load cases (2 m, k), shape (2 n, k)."""
        radius = radius or self.radius
        if len(self.bodies) == 1:
            return _summed(self.bodies[0].base, points, places, forces, radius)
        field = np.zeros((len(points), 2, forces.shape[1]))
        where = self.partition.locate(points)
        for q in np.unique(where):
            own = where == q
            u = _summed(self.bodies[q].base, points[own], places, forces, radius)
            field[own] = u.reshape(-1, 2, forces.shape[1])
        return field.reshape(2 * len(points), forces.shape[1])

    def _own(self, q: int, points: Floats) -> Floats:
        """Displacement by unit strengths of body q at points in it or on its boundary."""
        body = self.bodies[q]
        x0, x1, y0, y1 = self.grid.extent
        rigid = body.outside.rigid_motions(
            points, np.array([(x0 + x1) / 2, (y0 + y1) / 2]), max(x1 - x0, y1 - y0)
        )
        return np.hstack([body.outside.displacement(points, body.sources), rigid])

    def _own_traction(self, q: int, points: Floats, normals: Floats) -> Floats:
        body = self.bodies[q]
        T = body.outside.traction(points, normals, body.sources)
        return np.hstack([T, np.zeros((len(T), self._counts[q] - T.shape[1]))])

    def _placed(self, q: int, block: Floats) -> Floats:
        """Put columns of body q among those of all bodies."""
        counts = self._counts
        M = np.zeros((len(block), sum(counts)))
        M[:, sum(counts[:q]) : sum(counts[: q + 1])] = block
        return M

    def _columns(self, points: Floats) -> Floats:
        """Displacement of points by unit strengths, shape (2 n, unknowns)."""
        if len(self.bodies) == 1:
            G = self._own(0, points)
        else:
            G = np.zeros((2 * len(points), sum(self._counts)))
            where = self.partition.locate(points)
            for q in np.unique(where):
                rows = np.flatnonzero(where == q)
                G[(2 * rows[:, None] + (0, 1)).ravel()] = self._placed(q, self._own(q, points[rows]))
        pins = self.clamps.points
        if not len(pins):
            return G
        return np.hstack([G, self._base(points, pins, np.eye(2 * len(pins)), self.pin_radius)])

    @cached_property
    def _nodes(self) -> _Dense | _Lattice:
        """Return what takes strengths to the field at the mesh nodes."""
        if len(self.bodies) > 1:
            return _Dense(self._columns(self.grid.nodes))
        x0, x1, y0, y1 = self.grid.extent
        x, y = (_chebyshev(low, high, OUTSIDE * self.spacing) for low, high in ((x0, x1), (y0, y1)))
        if len(x) * len(y) > 0.6 * self.grid.size:
            return _Dense(self._columns(self.grid.nodes))
        pins = self.clamps.points
        own = self._base(self.grid.nodes, pins, np.eye(2 * len(pins)), self.pin_radius) if len(pins) else None
        lattice = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=1)
        along = _interpolation(x, self.grid.x), _interpolation(y, self.grid.y)
        return _Lattice(*along, self._own(0, lattice), own)

    def _checked(self) -> Residual:
        """Check conditions between their rows under forces in x and y all over the tissue."""
        x0, x1, y0, y1 = self.grid.extent
        u, v = (np.arange(4) + 0.5) / 4, (np.arange(3) + 0.5) / 3
        places = np.stack([a.ravel() for a in np.meshgrid(x0 + u * (x1 - x0), y0 + v * (y1 - y0))], axis=1)
        places = places[self.clearance(places) >= self.nearest]
        F = np.eye(2 * len(places))
        c = self._strengths(places, F)
        M = self._conditions(check=True)[: -2 * len(self.clamps.points) or None]
        missed = np.abs(M @ c + self._loaded(places, check=True)).mean(axis=0)
        # Points between the forces: a force's own blob would make the mean displacement depend on its radius.
        at = places + np.array([0.37 * (x1 - x0) / 4, 0.29 * (y1 - y0) / 3])
        moved = np.hypot(
            *(self._base(at, places, F) + self._columns(at) @ c).reshape(len(at), 2, -1).transpose(1, 0, 2)
        )
        share = missed / moved.mean(axis=0)
        return Residual(float(share.mean()), float(share.max()))


@dataclass(frozen=True)
class _Dense:
    """Strengths to mesh nodes by one matrix."""

    columns: Floats

    def field(self, strengths: Floats) -> Floats:
        product: Floats = self.columns @ strengths
        return product


@dataclass(frozen=True)
class _Lattice:
    """Strengths to mesh nodes by way of a Chebyshev lattice: forces outside make a smooth field."""

    along_x: Floats
    along_y: Floats
    columns: Floats
    pins: Floats | None

    def field(self, strengths: Floats) -> Floats:
        own = self.columns.shape[1]
        k = strengths.shape[1]
        coarse = (self.columns @ strengths[:own]).reshape(self.along_y.shape[1], self.along_x.shape[1], 2 * k)
        rows = np.tensordot(self.along_y, coarse, axes=(1, 0))  # mesh rows, lattice columns
        fine: Floats = np.matmul(self.along_x, rows).reshape(-1, k)
        return fine if self.pins is None else fine + self.pins @ strengths[own:]


def inside(grid: RegularGrid, points: Floats, name: str) -> Floats:
    """Check that points lie in the tissue, up to rounding, and return them."""
    if np.size(points) == 0:
        return np.zeros((0, 2))
    p = as_points(points, name)
    x0, x1, y0, y1 = grid.extent
    slack = 1e-9 * max(x1 - x0, y1 - y0)
    out = (p < (x0 - slack, y0 - slack)).any(axis=1) | (p > (x1 + slack, y1 + slack)).any(axis=1)
    if out.any():
        where = tuple(float(c) for c in p[np.flatnonzero(out)[0]])
        raise InputError(
            f"{name} must lie in the tissue, x {x0:g} to {x1:g} mm and y {y0:g} to {y1:g} mm; got {where}"
        )
    return p


def load_cases(places: Floats, forces: Floats) -> Floats:
    """Check forces (m, 2, k) in N and return them as (2 m, k)."""
    f = np.asarray(forces, dtype=np.float64)
    if f.ndim != 3 or f.shape[:2] != (len(places), 2) or not np.isfinite(f).all():
        raise InputError(f"forces must be finite numbers in N of shape ({len(places)}, 2, k); got {f.shape}")
    return f.reshape(2 * len(places), f.shape[2])


def divide(tissue: Tissue, grid: RegularGrid) -> tuple[Partition, list[tuple[float, float]]]:
    """Divide the tissue into bands and round parts; return them and (E, nu) of every part.

    Raises
    ------
    UnsuitedError
        If it cannot be so divided.
    """
    x0, x1, y0, y1 = grid.extent
    if tissue.homogeneous:
        return Partition(np.array([y0, y1])), [(tissue.young, tissue.poisson)]
    circles: list[Circle] = []
    cuts = {y0, y1}
    for region in tissue.regions:
        shape = region.shape
        if isinstance(shape, Layer):
            cuts |= {float(d) for d in (shape.top, shape.bottom) if y0 < d < y1}
        elif isinstance(shape, Circle):
            circles.append(shape)
        else:
            raise UnsuitedError(
                f"a region is a {type(shape).__name__.lower()}, neither a straight layer nor round"
            )
    background = Tissue(
        tissue.young, tissue.poisson, [r for r in tissue.regions if isinstance(r.shape, Layer)]
    )
    depths = np.array(sorted(cuts))
    middle = (depths[1:] + depths[:-1]) / 2
    young, poisson = background.at(np.stack([np.full(len(middle), (x0 + x1) / 2), middle], axis=1))
    moduli = list(zip(young.tolist(), poisson.tolist(), strict=True))
    begins = [0] + [i for i in range(1, len(moduli)) if moduli[i] != moduli[i - 1]]
    depths, moduli = depths[[*begins, len(depths) - 1]], [moduli[i] for i in begins]
    round_parts, round_moduli = [], []
    for circle in circles:
        (cx, cy), r = circle.centre, circle.radius
        own = tuple(float(v[0]) for v in tissue.at([circle.centre]))
        band = int(np.searchsorted(depths, cy, side="right")) - 1
        if not (0 <= band < len(moduli) and own != moduli[band]):
            continue  # what is left of it, if anything, is found below
        room = min(cx - r - x0, x1 - cx - r, cy - r - depths[band], depths[band + 1] - cy - r)
        if room <= 0:
            raise UnsuitedError("a round region crosses an edge or a layer")
        round_parts.append(circle)
        round_moduli.append((own[0], own[1]))
    for i, a in enumerate(round_parts):
        for b in round_parts[:i]:
            if np.hypot(*np.subtract(a.centre, b.centre)) <= a.radius + b.radius:
                raise UnsuitedError("two round regions touch or overlap")
    partition, moduli = Partition(depths, tuple(round_parts)), moduli + round_moduli
    lines = [np.linspace(low, high, 60) for low, high in ((x0, x1), (y0, y1))]
    points = np.stack([a.ravel() for a in np.meshgrid(*lines)], axis=1)
    points = points[partition.distance(points) > 1e-9 * (y1 - y0)]
    told, built = np.stack(tissue.at(points), axis=1), np.array(moduli)[partition.locate(points)]
    if (told != built).any():
        raise UnsuitedError("regions lie on top of each other")
    return partition, moduli


def lay_out(
    scene: BoundaryForces, moduli: Sequence[tuple[float, float]], fine: float
) -> tuple[tuple[Body, ...], tuple[Piece, ...]]:
    """Place forces outside every part of the tissue and conditions along its edges and interfaces."""
    x0, x1, y0, y1 = scene.grid.extent
    partition, spacing = scene.partition, scene.spacing
    kinds: dict[str, Kind] = {edge: scene.clamps.kind(edge) for edge in EDGES}
    top, off, depths = kinds["top"], OUTSIDE * spacing, partition.depths
    ringed = top == "clamped"
    bands = len(depths) - 1
    if bands > 1 and np.diff(depths).min() < THINNEST * fine:
        raise UnsuitedError(f"a layer is thinner than {THINNEST * fine:.2g} mm")
    pieces, sources = [], []
    for q in range(bands):
        first, last = q == 0, q == bands - 1
        step = min(spacing, (depths[q + 1] - depths[q]) / THIN)  # along the sides of this band
        beside = OUTSIDE * step
        upper = (y0 - off if ringed else y0) if first else depths[q] - OUTSIDE * fine
        lower = y1 + off if last else depths[q + 1] + OUTSIDE * fine
        side = _middles(upper, lower, step)
        own = [np.stack([np.full(len(side), x), side], axis=1) for x in (x0 - beside, x1 + beside)]
        for depth, gap in ((upper, spacing if first else fine), (lower, spacing if last else fine)):
            if depth != y0 or not first:
                line = _middles(x0 - beside, x1 + beside, gap)
                own.append(np.stack([line, np.full(len(line), depth)], axis=1))
        sources.append(own)
        for edge, x in (("left", x0), ("right", x1)):
            line = _middles(depths[q], depths[q + 1], step / ROWS)
            pieces.append(_straight(line, x, 0, -1.0 if edge == "left" else 1.0, (q,), kinds[edge]))
        if first and ringed:
            pieces.append(_straight(_middles(x0, x1, spacing / ROWS), y0, 1, -1.0, (q,), top))
        if last:
            pieces.append(_straight(_middles(x0, x1, spacing / ROWS), y1, 1, 1.0, (q,), kinds["bottom"]))
        else:
            pieces.append(_straight(_middles(x0, x1, fine / ROWS), depths[q + 1], 1, 1.0, (q, q + 1), "free"))
    for i, circle in enumerate(partition.circles):
        count = _round_count(circle.radius, fine)
        step = 2 * np.pi * circle.radius / count
        band = int(np.searchsorted(depths, circle.centre[1], side="right")) - 1
        sources[band].append(_ring(circle, circle.radius - min(INNER * step, 0.7 * circle.radius), count)[0])
        sources.append([_ring(circle, circle.radius + OUTER * step, count)[0]])
        points, out = _ring(circle, circle.radius, round(ROWS * count))
        between, out_between = _ring(circle, circle.radius, round(ROWS * count), 0.0)
        pieces.append(Piece(points, -out, between, -out_between, (band, bands + i)))
    bodies = []
    for q, (young, poisson) in enumerate(moduli):
        base = HalfPlane.of(scene.tissue, young, poisson, top, y0)
        outside = base if q == 0 and not ringed else HalfPlane.of(scene.tissue, young, poisson, None)
        bodies.append(Body(base, outside, np.vstack(sources[q])))
    return tuple(bodies), tuple(pieces)


def _where(piece: Piece, check: bool) -> tuple[Floats, Floats]:
    return (piece.between, piece.normals_between) if check else (piece.points, piece.normals)


def _combine(piece: Piece, u: Floats | None, t: Floats | None) -> Floats:
    """Rows of a piece from displacement and weighted traction."""
    if t is None or u is None:
        return np.vstack([rows for rows in (u, t) if rows is not None])
    if len(piece.bodies) == 2:
        return np.vstack([u, t])
    mixed = t.copy()
    mixed[piece.axis :: 2] = u[piece.axis :: 2]
    return mixed


def _summed(base: HalfPlane, points: Floats, places: Floats, forces: Floats, radius: float) -> Floats:
    """Field of load cases (2 m, k) at points, in blocks of points that stay in the cache, shape (2 n, k)."""
    field = np.zeros((2 * len(points), forces.shape[1]))
    block = max(1, 20000 // max(1, len(places)))
    for start in range(0, len(points), block):
        K = base.displacement(points[start : start + block], places, radius)
        field[2 * start : 2 * (start + block)] = K @ forces
    return field


def _middles(low: float, high: float, step: float) -> Floats:
    """Middles of equal intervals about ``step`` long."""
    count = max(2, round((high - low) / step))
    return low + (np.arange(count) + 0.5) / count * (high - low)


def _straight(line: Floats, at: float, axis: int, sign: float, bodies: tuple[int, ...], kind: Kind) -> Piece:
    """Piece of a line at a coordinate of ``axis``."""
    between = (line[1:] + line[:-1]) / 2

    def points(along: Floats) -> Floats:
        p = np.empty((len(along), 2))
        p[:, axis], p[:, 1 - axis] = at, along
        return p

    normal = np.zeros(2)
    normal[axis] = sign
    return Piece(
        points(line),
        np.tile(normal, (len(line), 1)),
        points(between),
        np.tile(normal, (len(between), 1)),
        bodies,
        kind,
        axis,
    )


def _round_count(radius: float, fine: float) -> int:
    return int(np.clip(round(2 * np.pi * radius / fine), FEWEST, MOST))


def _ring(circle: Circle, radius: float, count: int, shift: float = 0.5) -> tuple[Floats, Floats]:
    """Points on a circle and the outward normals there."""
    angle = (np.arange(count) + shift) / count * 2 * np.pi
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(circle.centre) + radius * out, out


def _chebyshev(low: float, high: float, distance: float) -> Floats:
    """Points between which the field of forces at ``distance`` is interpolated to `SMOOTH`.

    The force beside the middle of an edge counts: as a function along that edge its field has poles at i times the distance.
    """
    reach = 2.0 * distance / (high - low)
    count = int(np.ceil(-np.log(SMOOTH) / np.log(reach + np.sqrt(1.0 + reach * reach))))
    points: Floats = (low + high) / 2 - (high - low) / 2 * np.cos(np.pi * np.arange(count + 1) / count)
    return points


def _interpolation(points: Floats, wanted: Floats) -> Floats:
    """Barycentric weights from Chebyshev points to those wanted, shape (wanted, points)."""
    w = (-1.0) ** np.arange(len(points))
    w[[0, -1]] *= 0.5
    gap = wanted[:, None] - points[None]
    hit = np.abs(gap) < 1e-12 * (points[-1] - points[0])
    terms = w / np.where(hit, 1.0, gap)
    A: Floats = terms / terms.sum(axis=1, keepdims=True)
    rows = hit.any(axis=1)
    A[rows] = hit[rows]
    return A
