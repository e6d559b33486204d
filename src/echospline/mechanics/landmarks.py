"""Where a scene's landmarks may stand: anchors that stay, and the lattice of nodes that the needle can touch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, isfinite
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.scene import EDGES, Floats, as_points

SIDES = {"left": (0, 0), "right": (0, 1), "top": (1, 0), "bottom": (1, 1), "front": (2, 0), "back": (2, 1)}
"""Axis, and 0 where its coordinate is least or 1 where it is greatest, of every edge (plane) or face (space)."""

ALONG = 1e9
"""mm; a sliding edge further away than this along the needle is not ahead of it: the needle runs along the edge."""


class Mesh(Protocol):
    """Points at constant spacing, x fastest, in the plane (`RegularGrid`) or in space: D numbers each."""

    @property
    def shape(self) -> Sequence[int]:
        """Number of points along x, y (and z)."""
        ...

    @property
    def spacing(self) -> Sequence[float]:
        """Distance between neighbours, mm."""
        ...

    @property
    def origin(self) -> Sequence[float]:
        """First point, mm."""
        ...

    @property
    def nodes(self) -> Floats:
        """All points in mm, shape (n, D)."""
        ...

    def nearest(self, point: ArrayLike) -> int:
        """Index of the node nearest to one point in mm."""
        ...


MOST_ANCHORS = 1500
"""Anchors of a scene at most, on clamped and sliding edges together: their system is a full matrix, and 1500 take seconds to factor."""


@dataclass(frozen=True)
class Anchors:
    """Landmarks that stay: places, and which components of the displacement each of them holds at zero.

    Parameters
    ----------
    places : ndarray, shape (b, D)
        mm.
    held : ndarray of bool, shape (b, D)
        All components on a clamped edge, the normal one alone on a sliding edge.
    """

    places: Floats
    held: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.places)


@dataclass(frozen=True)
class Clamps:
    """What holds the tissue: edges of the mesh (faces in space) that are clamped or slide, and clamped points.

    A clamped edge does not move. A sliding edge moves along itself alone, without friction: skin under a probe,
    or a table that is oiled. Any other edge is free.

    Parameters
    ----------
    grid : Mesh
        The mesh.
    edges : tuple of {"top", "bottom", "left", "right"}, in space also {"front", "back"}
        Clamped edges or faces.
    points : ndarray, shape (k, D)
        Further clamped points, mm.
    sliding : tuple of the same names
        Edges or faces that slide.
    """

    grid: Mesh
    edges: tuple[str, ...] = ("left", "right", "bottom")
    points: Floats = field(default_factory=lambda: np.empty((0, 2)))
    sliding: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        grid: Mesh,
        edges: Iterable[str],
        points: ArrayLike | None = None,
        sliding: Iterable[str] = (),
    ) -> Clamps:
        """Check and keep what holds the tissue.

        Raises
        ------
        InputError
            If an edge has another name or is named twice, a point lies outside the mesh, or tissue so held could
            still move as a whole.
        """
        names, slide, D = tuple(edges), tuple(sliding), len(grid.shape)
        known = EDGES if D == 2 else tuple(SIDES)
        for name in (*names, *slide):
            if name not in known:
                raise InputError(f"an edge is one of {', '.join(known)}; got {name!r}")
        for name in slide:
            if name in names:
                raise InputError(
                    f"an edge is clamped, sliding or free; the {name} edge is said to be both clamped and sliding"
                )
        held = (
            np.empty((0, D))
            if points is None or np.size(points) == 0
            else as_points(points, "clamped points", D)
        )
        low, high = _extent(grid)
        if not ((held >= low) & (held <= high)).all():
            raise InputError("every clamped point must lie inside the mesh")
        clamps = cls(grid, tuple(dict.fromkeys(names)), held, tuple(dict.fromkeys(slide)))
        clamps._refuse_loose()
        return clamps

    @cached_property
    def nodes(self) -> NDArray[np.intp]:
        """Clamped mesh nodes (the nearest ones for points), ascending: what finite elements hold in every direction."""
        held = [np.array([self.grid.nearest(p) for p in self.points], dtype=np.intp)]
        held += [self._on(edge) for edge in self.edges]
        return np.unique(np.concatenate(held))

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """Which components of the displacement of which mesh nodes are held at zero, shape (n, D)."""
        held = np.zeros((int(np.prod(self.grid.shape)), len(self.grid.shape)), dtype=bool)
        held[self.nodes] = True
        for edge in self.sliding:
            held[self._on(edge), SIDES[edge][0]] = True
        return held

    def kind(self, edge: str) -> Literal["clamped", "sliding", "free"]:
        """Return what an edge is."""
        return "clamped" if edge in self.edges else "sliding" if edge in self.sliding else "free"

    def _on(self, edge: str) -> NDArray[np.intp]:
        """Mesh nodes on an edge."""
        axis, side = SIDES[edge]
        index = _indices(self.grid)
        return index.take(-side, axis=index.ndim - 1 - axis).ravel()

    def _refuse_loose(self) -> None:
        """Refuse tissue that could move as a whole: some shift or turn that nothing holds."""
        if self.edges:  # one clamped edge holds everything
            return
        D = len(self.grid.shape)
        low, high = _extent(self.grid)
        rows = []
        for point in self.points:
            rows += [_motions(point - low, axis) for axis in range(D)]
        for edge in self.sliding:
            axis, side = SIDES[edge]
            for corner in _product([np.array([0.0, w]) for w in np.delete(high - low, axis)]):
                rows.append(_motions(np.insert(corner, axis, side * (high - low)[axis]), axis))
        motions = _motions(np.zeros(D), 0).size
        size = float((high - low).max()) or 1.0
        scaled = np.array(rows).reshape(-1, motions) / np.r_[np.ones(D), np.full(motions - D, size)]
        if np.linalg.matrix_rank(scaled, tol=1e-6) == motions:
            return
        said = [f"sliding: {', '.join(self.sliding)}"] if self.sliding else []
        said += (
            [f"{len(self.points)} clamped point{'s'[: len(self.points) != 1]}"] if len(self.points) else []
        )
        loose = [
            f"slide along {'xyz'[axis]}"
            for axis in range(D)
            if np.linalg.matrix_rank(np.vstack([scaled, np.eye(motions)[axis]]), tol=1e-6)
            > np.linalg.matrix_rank(scaled, tol=1e-6)
        ]
        raise InputError(
            f"what holds the tissue ({'; '.join(said) or 'no edge'}) leaves it free to {' and '.join(loose) or 'turn'}: clamp one "
            f"edge, for example {'the bottom' if 'bottom' not in self.sliding else 'the bottom instead of letting it slide'}"
        )

    def anchors(self, spacing: float, *, affine: bool = False) -> Anchors:
        """Anchor landmarks along the clamped and the sliding edges, at most ``spacing`` mm apart; then the clamped points.

        In a face they form a lattice, ``spacing`` mm apart along each direction.

        Parameters
        ----------
        spacing : float
            mm.
        affine : bool
            Whether every affine motion is free of energy, as it is for a thin plate. Anchors of one component along one
            edge alone leave it free to tilt about that edge. A second row, one spacing outside the mesh, then holds its slope.

        Raises
        ------
        InputError
            If the anchors would be too many, or a component that no edge holds is left free by the clamped points.
        """
        low, high = _extent(self.grid)
        rows = [(edge, 0.0, self._holds(edge)) for edge in (*self.edges, *self.sliding)]
        if affine:
            for edge in (*self.edges, *self.sliding):
                slope = self._holds(edge) & self._tilts_about(edge, spacing)
                if slope.any():
                    rows.append((edge, spacing, slope))
        gaps = np.maximum(1.0, np.ceil((high - low) / spacing - 1e-9)) + 1.0
        count = len(self.points) + sum(np.prod(np.delete(gaps, SIDES[edge][0])) for edge, _, _ in rows)
        if count > MOST_ANCHORS:
            size = " x ".join(f"{width:g}" for width in high - low)
            raise InputError(
                f"anchors {spacing:g} mm apart along what is held may be {MOST_ANCHORS} at most; a mesh of {size} mm needs "
                f"{count:.0f}: check the image's spacing in mm, or raise anchor_spacing"
            )
        if affine:
            self._refuse_tilting()
        every, held = [], []
        for edge, outside, components in rows:
            axis, side = SIDES[edge]
            lines = [_line(a, b, spacing) for a, b in zip(low, high, strict=True)]
            end = high[axis] + outside if side else low[axis] - outside
            lines[axis] = np.array([end])
            every.append(_product(lines))
            held.append(np.broadcast_to(components, every[-1].shape))
        landmarks = np.vstack([*every, self.points])
        components = np.vstack([*held, np.ones(self.points.shape, dtype=bool)])
        _, first, same = np.unique(np.round(landmarks / 1e-6), axis=0, return_index=True, return_inverse=True)
        together = np.zeros((len(first), len(low)), dtype=bool)
        np.logical_or.at(together, same.ravel(), components)
        order = np.argsort(first)
        return Anchors(landmarks[first[order]], together[order])

    def clearance(self, point: Sequence[float], axis: Sequence[float] | Floats) -> float:
        """Distance in mm over which a needle can push; 0 at what is held and beyond it; infinite where nothing is.

        It is the distance from the tip to what is clamped. A sliding edge stops no more than the part of a push along its
        normal, so the distance to it counts along the needle: for a needle at right angles to the edge it is that to a
        clamped one, and for a needle along the edge it is infinite. The normal part of the push then fades with a slope
        that does not depend on the angle.

        Parameters
        ----------
        point : sequence of float
            The tip, mm.
        axis : sequence of float
            Unit vector from entry to tip, or zeros.
        """
        low, high = _extent(self.grid)
        distances = []
        for edge in (*self.edges, *self.sliding):
            d, side = SIDES[edge]
            gap = float(high[d] - point[d] if side else point[d] - low[d])
            if edge in self.sliding and gap > 0:
                steep = abs(float(axis[d]))
                gap = gap / steep if gap < ALONG * steep else inf
            distances.append(gap)
        distances += [float(np.linalg.norm(p - point)) for p in self.points]
        return max(0.0, float(min(distances, default=inf)))

    def _holds(self, edge: str) -> NDArray[np.bool_]:
        """Components that a clamped or sliding edge holds."""
        held = np.full(len(self.grid.shape), edge in self.edges)
        held[SIDES[edge][0]] = True
        return held

    def _tilts_about(self, edge: str, spacing: float) -> NDArray[np.bool_]:
        """Components that no other edge holds, and no clamped point further than one spacing from this one."""
        low, high = _extent(self.grid)
        axis, side = SIDES[edge]
        others = [self._holds(other) for other in (*self.edges, *self.sliding) if other != edge]
        reach = np.abs(self.points[:, axis] - (high if side else low)[axis]) if len(self.points) else []
        alone: NDArray[np.bool_] = ~np.any(others, axis=0) if others else np.ones(len(low), dtype=bool)
        return alone & (not np.any(np.asarray(reach) > spacing))

    def _refuse_tilting(self) -> None:
        """Refuse a component that clamped points alone hold, on one line (in space: in one plane)."""
        held = [self._holds(edge) for edge in (*self.edges, *self.sliding)]
        alone = ~np.any(held, axis=0) if held else np.ones(len(self.grid.shape), dtype=bool)
        if not alone.any():
            return
        low, high = _extent(self.grid)
        motions = np.column_stack([np.ones(len(self.points)), (self.points - low) / (high - low).max()])
        if np.linalg.matrix_rank(motions, tol=1e-6) == motions.shape[1]:
            return
        D, axis = len(low), int(np.flatnonzero(alone)[0])
        edges = [name for name, (d, _) in SIDES.items() if d == axis]
        raise InputError(
            f"no edge holds the {'xyz'[axis]} direction, and {len(self.points)} clamped "
            f"point{'s'[: len(self.points) != 1]} on one {'line' if D == 2 else 'plane'} do not determine a thin plate there: "
            f"let the {edges[0]} or {edges[1]} edge slide, clamp an edge, clamp more points, or use the elastic kernel"
        )


def strides(grid: Mesh, spacing: float) -> list[int]:
    """Return from which node to which along each axis the lattice goes: about ``spacing`` mm, in space not more, for shafts lie between its rows."""
    whole = round if len(grid.shape) == 2 else lambda share: int(share + 1e-9)
    return [max(1, whole(spacing / h)) for h in grid.spacing]


def contact_lattice(clamps: Clamps, spacing: float) -> NDArray[np.intp]:
    """Mesh nodes that may become contacts: every one, or every second, third ..., about ``spacing`` apart.

    A contact stands for the tissue around it. On a fine mesh (a node per pixel) every node within delta of the shaft
    would be thousands; the lattice keeps their number that of the tissue, not that of the picture.

    Parameters
    ----------
    clamps : Clamps
        Nodes of which any component is held are left out.
    spacing : float
        mm; 0 takes every node, as the paper does.

    Returns
    -------
    ndarray of int, shape (k,)
        Ascending node indices.
    """
    grid, lines = clamps.grid, []
    for n, stride in zip(grid.shape, strides(grid, spacing), strict=True):
        lines.append(np.arange((n - 1) % stride // 2, n, stride, dtype=np.intp))
    lattice = _indices(grid)[np.ix_(*lines[::-1])].ravel()
    free: NDArray[np.intp] = lattice[~clamps.held[lattice].any(axis=1)]
    return free


def join_gap(grid: Mesh, lattice: NDArray[np.intp]) -> float:
    """Distance from the tip within which no node joins, mm: a quarter of the smallest between lines of the lattice."""
    nodes = grid.nodes[lattice]
    gaps = [float(np.diff(np.unique(np.round(x, 9))).min(initial=inf)) for x in nodes.T]
    least = min(gaps)
    return 0.25 * (least if isfinite(least) else min(grid.spacing))


def _motions(place: Floats, axis: int) -> Floats:
    """Component along an axis of the rigid motions at a place: D shifts, then the turn (plane) or three turns (space)."""
    turns = (
        [np.array([-place[1], place[0]])]
        if len(place) == 2
        else [np.cross(unit, place) for unit in np.eye(3)]
    )
    motions: Floats = np.concatenate([np.eye(len(place))[axis], [turn[axis] for turn in turns]])
    return motions


def _extent(grid: Mesh) -> tuple[Floats, Floats]:
    """First and last point, mm."""
    low = np.array(grid.origin, dtype=np.float64)
    return low, low + np.subtract(grid.shape, 1) * np.array(grid.spacing)


def _indices(grid: Mesh) -> NDArray[np.intp]:
    """Node indices with the axes reversed, [(z,) y, x]."""
    return np.arange(np.prod(grid.shape), dtype=np.intp).reshape(tuple(grid.shape)[::-1])


def _line(a: float, b: float, spacing: float) -> Floats:
    """Return numbers from a to b, evenly and at most ``spacing`` apart."""
    gaps = max(1, int(np.ceil((b - a) / spacing - 1e-9)))
    line: Floats = a + np.linspace(0.0, 1.0, gaps + 1) * (b - a)
    return line


def _product(lines: Sequence[Floats]) -> Floats:
    """Points whose coordinates are all choices from one line per axis, x fastest, shape (n, D)."""
    axes = np.meshgrid(*lines[::-1], indexing="ij")[::-1]
    return np.stack(axes, axis=-1).reshape(-1, len(lines))
