"""The tissue model between spline and finite elements: Green's function under the needle's forces.

Landmarks and kernels as in the spline, forces as in finite elements. Anchors hold the clamped edges; the tip's
force and the friction along the shaft act where the needle is, through the fundamental solution of elasticity
under a free surface. There is no mesh to solve and nothing to identify that a finite-element model would not
need too: Young's modulus, Poisson's ratio and forces.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.mechanics.forces import NeedleForces, check_step, travelled
GreensFunction = None  # noqa
from echospline.mechanics.landmarks import Clamps
from echospline.scene import ZERO_LENGTH, Floats, NeedlePose, RegularGrid, Tissue


@dataclass(frozen=True)
class GreenState:
    """What the tissue remembers.

    Attributes
    ----------
    pose : NeedlePose or None
        The last pose; None at rest.
    tip : float
        Force at the tip along the axis, N.
    friction : ndarray, shape (k,)
        Friction at the stations along the shaft, N/mm.
    columns : ndarray, shape (2 n, k)
        Displacement of the nodes by a unit axial force at each station, in blocks, mm/N.
    displacement : ndarray, shape (n, 2)
        Of the nodes, mm.
    """

    pose: NeedlePose | None
    tip: float
    friction: Floats
    columns: Floats
    displacement: Floats


class GreenModel:
    """Homogeneous elastic tissue under a needle's forces, by superposition of point forces.

    Parameters
    ----------
    grid : RegularGrid
        Nodes of the mesh on which the field is wanted.
    clamped : iterable of {"top", "bottom", "left", "right"}
        Edges that anchors hold. A top that is not clamped is a free surface; tissue goes on beyond any other
        edge that is not clamped.
    tissue : Tissue
        Homogeneous; E, nu, thickness, plane stress or strain.
    forces : NeedleForces
        What the needle exerts.
    clamped_points : array_like, shape (k, 2), optional
        Further anchors, mm.
    radius : float
        Over which a force is spread, mm; by default about the radius of an 18 gauge needle. The field near the
        tip depends on it, the field elsewhere does not.
    anchor_spacing : float
        Greatest distance between anchors, mm.
    station_spacing : float
        Distance along the shaft between the points that carry friction, mm.

    Raises
    ------
    InputError
        If the tissue has regions, or a number is out of its range.
    """

    def __init__(
        self,
        grid: RegularGrid,
        clamped: Iterable[str] = ("left", "right", "bottom"),
        tissue: Tissue | None = None,
        forces: NeedleForces | None = None,
        *,
        clamped_points: ArrayLike | None = None,
        radius: float = 0.4,
        anchor_spacing: float = 1.5,
        station_spacing: float = 1.0,
    ) -> None:
        self._grid = grid
        self.tissue = tissue or Tissue()
        self.forces = forces or NeedleForces()
        if not self.tissue.homogeneous:
            raise InputError(
                "Green's function is that of homogeneous tissue; for tissue with regions use finite elements (fem)"
            )
        if not (np.isfinite(station_spacing) and station_spacing > 0):
            raise InputError(f"station_spacing must be a positive number in mm; got {station_spacing}")
        edges = tuple(clamped)
        self.station_spacing = station_spacing
        self.green = GreensFunction(
            Clamps.of(grid, edges, clamped_points).anchors(anchor_spacing),
            self.tissue.young,
            self.tissue.poisson,
            self.tissue.thickness,
            self.tissue.plane,
            radius,
            anchor_spacing / (2.0 * np.pi),
            None if "top" in edges else grid.origin[1],
        )
        self._projector = self.green.projector(grid.nodes)

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self._grid

    def rest(self) -> GreenState:
        """Tissue that no needle has touched."""
        n = self.grid.size
        return GreenState(None, 0.0, np.zeros(0), np.zeros((2 * n, 0)), np.zeros((n, 2)))

    def advance(self, state: GreenState, pose: NeedlePose, dt: float) -> GreenState:
        """Forces of the new pose and the field under them.

        Raises
        ------
        InputError
            If dt is negative or not finite.
        """
        check_step(dt)
        travel = travelled(state.pose, pose)
        inside = pose.depth >= ZERO_LENGTH and bool(self.grid.contains(pose.tip)[0])
        tip = self.forces.advance_tip(state.tip, pose, travel, inside=inside)
        columns, covered, ahead = self._columns(state, pose, push=tip != 0)
        before = np.zeros((columns.shape[1], 1))
        kept = min(len(state.friction), len(before))
        before[:kept, 0] = state.friction[:kept]
        steady = np.full_like(before, self.forces.friction * pose.speed)
        friction = self.forces.advance_friction(before, steady, travel, dt)[:, 0]
        field = columns @ (friction * covered)
        if ahead is not None:
            field = field + ahead * tip
        return GreenState(pose, tip, friction, columns, _vectors(field))

    def displacement(self, state: GreenState) -> Floats:
        """Displacement of the nodes, shape (n, 2), mm."""
        return state.displacement

    def displacement_at(self, state: GreenState, points: ArrayLike) -> Floats:
        """Displacement of any reference points in the tissue, shape (n, 2), mm.

        Raises
        ------
        InputError
            If a point lies above the free surface.
        """
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        if state.pose is None or state.pose.depth < ZERO_LENGTH:
            return np.zeros(p.shape)
        sources, covered = self.stations(state.pose)
        forces = state.friction * covered
        if state.tip != 0:
            sources, forces = np.vstack([sources, state.pose.tip]), np.append(forces, state.tip)
        if not forces.any():
            return np.zeros(p.shape)
        axis = np.array(state.pose.axis)
        G = self.green.columns(p, sources)
        return _vectors(G @ np.concatenate([forces * axis[0], forces * axis[1]]))

    def stations(self, pose: NeedlePose) -> tuple[Floats, Floats]:
        """Points (k, 2) of the shaft that carry friction, mm, and the length (k,) in mm that each stands for."""
        h = self.station_spacing
        count = int(np.ceil(pose.depth / h - 1e-9)) if pose.depth >= ZERO_LENGTH else 0
        start = h * np.arange(count)
        points = np.asarray(pose.entry) + (start + h / 2)[:, None] * np.array(pose.axis)
        covered = np.clip(pose.depth - start, 0.0, h)
        inside = self.grid.contains(points) if count else np.zeros(0, dtype=bool)
        return self._held(points), np.where(inside, covered, 0.0)

    def _held(self, points: Floats) -> Floats:
        """Keep points outside the tissue, which carry no force, where the kernel is defined."""
        x0, x1, y0, y1 = self.grid.extent
        held: Floats = np.clip(points, (x0, y0), (x1, y1))
        return held

    def _columns(
        self, state: GreenState, pose: NeedlePose, *, push: bool
    ) -> tuple[Floats, Floats, Floats | None]:
        """Columns of the stations, the length each stands for, and the tip's column where it pushes.

        Columns of the last pose are kept while the axis is the same; all others come from one product.
        """
        points, covered = self.stations(pose)
        same = (
            state.pose is not None
            and state.pose.depth >= ZERO_LENGTH
            and state.pose.entry == pose.entry
            and np.allclose(state.pose.axis, pose.axis, rtol=0, atol=1e-12)
        )
        kept = min(state.columns.shape[1], len(points)) if same else 0
        wanted = np.vstack([points[kept:], pose.tip]) if push else points[kept:]
        fresh = self._axial(wanted, pose) if len(wanted) else np.zeros((len(state.columns), 0))
        ahead = fresh[:, -1] if push else None
        stations = state.columns[:, :kept]
        if kept < len(points):
            stations = np.hstack([stations, fresh[:, : len(points) - kept]])
        return stations, covered, ahead

    def _axial(self, sources: Floats, pose: NeedlePose) -> Floats:
        """Displacement of the nodes by unit forces along the axis at sources (k, 2), shape (2 n, k), mm/N."""
        G = self.green.columns(self.grid.nodes, sources, self._projector)
        k = len(sources)
        axial: Floats = G[:, :k] * pose.axis[0] + G[:, k:] * pose.axis[1]
        return axial


def _vectors(blocks: Floats) -> Floats:
    return np.ascontiguousarray(blocks.reshape(2, -1).T)
