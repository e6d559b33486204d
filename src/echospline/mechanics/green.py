"""The tissue model between spline and finite elements: Green's function under the needle's forces.

The tip's force and the friction along the shaft act where the needle is, and the field of each is `green_response`: closed forms
for homogeneous tissue, layers and round lesions, a live solve for any other. There is nothing to identify that a finite-element
model would not need too: Young's modulus, Poisson's ratio and forces.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.mechanics.force_model import ForceModel, ForceState
from echospline.mechanics.forces import (
    Forces,
    NeedleForces,
    NeedleLoad,
    ViscousForces,
    check_step,
    travelled,
)
from echospline.mechanics.green_response import GreenMethod, GreenResponse, green_response
from echospline.mechanics.landmarks import Clamps
from echospline.scene import ZERO_LENGTH, Floats, NeedlePose, RegularGrid, Tissue


@dataclass(frozen=True)
class GreenState:
    """What the tissue remembers under the viscous law.

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


State = GreenState | ForceState


class GreenModel:
    """Elastic tissue under a needle's forces, by superposition of point forces.

    Parameters
    ----------
    grid : RegularGrid
        Nodes of the mesh on which the field is wanted; its extent is the tissue.
    clamped : iterable of {"top", "bottom", "left", "right"}
        Edges that do not move.
    tissue : Tissue
        Moduli per region, thickness, plane stress or strain.
    forces : NeedleForces or ViscousForces
        What the needle exerts: the law that sticks and slips, or the paper's.
    sliding : iterable of {"top", "bottom", "left", "right"}
        Edges that move along themselves alone; any other is free.
    clamped_points : array_like, shape (k, 2), optional
        Points that do not move, mm: pins of ``radius``.
    radius : float
        Over which a force is spread, mm; by default about the radius of an 18 gauge needle. The field near the
        tip depends on it, the field elsewhere does not.
    method : {"auto", "boundary", "regions", "solve"}
        See `green_response`.
    station_spacing : float
        Of the viscous law: distance along the shaft between the points that carry friction, mm.

    Attributes
    ----------
    response : GreenResponse
        What answers forces; its `describe` tells how. Where forces go beyond its limits, `warnings.warn` gives the sentence of
        `GreenResponse.warnings`, each once per model.

    Raises
    ------
    InputError
        If nothing holds the tissue, the method cannot represent it, or a number is out of its range.
    """

    def __init__(
        self,
        grid: RegularGrid,
        clamped: Iterable[str] = ("left", "right", "bottom"),
        tissue: Tissue | None = None,
        forces: Forces | None = None,
        *,
        sliding: Iterable[str] = (),
        clamped_points: ArrayLike | None = None,
        radius: float = 0.4,
        method: GreenMethod = "auto",
        station_spacing: float = 1.0,
    ) -> None:
        self._grid = grid
        self.tissue, self.forces = tissue or Tissue(), forces or NeedleForces()
        if not (np.isfinite(station_spacing) and station_spacing > 0):
            raise InputError(f"station_spacing must be a positive number in mm; got {station_spacing}")
        self.station_spacing = station_spacing
        clamps = Clamps.of(grid, clamped, clamped_points, sliding)
        self.response: GreenResponse = green_response(grid, clamps, self.tissue, radius=radius, method=method)
        self.needle = (
            ForceModel(self.response, self.forces) if isinstance(self.forces, NeedleForces) else None
        )
        self._warned: set[str] = set()
        self._made = partial(
            GreenModel, grid, clamps.edges, self.tissue, self.forces, clamped_points=clamps.points,
            sliding=clamps.sliding, radius=radius, method=method, station_spacing=station_spacing,
        )  # fmt: skip

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the model was made of."""
        return self._made, ()

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self._grid

    def rest(self) -> State:
        """Tissue that no needle has touched."""
        if self.needle is not None:
            return self.needle.rest()
        n = self.grid.size
        return GreenState(None, 0.0, np.zeros(0), np.zeros((2 * n, 0)), np.zeros((n, 2)))

    def advance(self, state: State, pose: NeedlePose, dt: float) -> State:
        """Forces of the new pose and the field under them.

        Raises
        ------
        InputError
            If dt is negative or not finite, or the state is of the other law.
        """
        check_step(dt)
        if self.needle is not None and isinstance(state, ForceState):
            after = self.needle.advance(state, pose, dt)
            moved_on = len(after.track) != len(state.track)
            if moved_on and after.load.tip > 0 and self.grid.contains(pose.tip)[0]:
                self._warn(np.array([pose.tip]), after.load.tip * np.array([pose.axis]))
            return after
        law = self.forces
        if not isinstance(law, ViscousForces) or not isinstance(state, GreenState):
            raise InputError("this state belongs to a model with the other law of forces")
        travel = travelled(state.pose, pose)
        inside = pose.depth >= ZERO_LENGTH and bool(self.grid.contains(pose.tip)[0])
        tip = law.advance_tip(state.tip, pose, travel, inside=inside)
        columns, covered, ahead = self._columns(state, pose, push=tip != 0)
        before = np.zeros((columns.shape[1], 1))
        kept = min(len(state.friction), len(before))
        before[:kept, 0] = state.friction[:kept]
        steady = np.full_like(before, law.friction * pose.speed)
        friction = law.advance_friction(before, steady, travel, dt)[:, 0]
        field = columns @ (friction * covered)
        if ahead is not None:
            field = field + ahead * tip
            self._warn(np.array([pose.tip]), tip * np.array([pose.axis]))
        return GreenState(pose, tip, friction, columns, _vectors(field))

    def displacement(self, state: State) -> Floats:
        """Displacement of the nodes, shape (n, 2), mm."""
        return state.displacement

    def displacement_at(self, state: State, points: ArrayLike) -> Floats:
        """Displacement of any reference points in the tissue, shape (n, 2), mm.

        Raises
        ------
        InputError
            If a point lies outside the tissue.
        """
        if isinstance(state, ForceState):
            if self.needle is None:
                raise InputError("this state belongs to a model with the other law of forces")
            return self.needle.displacement_at(state, points)
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        if state.pose is None or state.pose.depth < ZERO_LENGTH:
            return np.zeros(p.shape)
        sources, covered = self.stations(state.pose)
        forces = state.friction * covered
        if state.tip != 0:
            sources, forces = np.vstack([sources, state.pose.tip]), np.append(forces, state.tip)
        if not forces.any():
            return np.zeros(p.shape)
        loads = forces[:, None, None] * np.array(state.pose.axis)[:, None]
        at: Floats = self.response.answer(sources, loads, p)[1][:, :, 0]
        return at

    def needle_load(self, state: State) -> NeedleLoad:
        """Return the needle's forces on the tissue."""
        if isinstance(state, ForceState):
            return state.load
        if state.pose is None:
            return NeedleLoad()
        return NeedleLoad(state.tip, float(state.friction @ self.stations(state.pose)[1]))

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved, and how far that is to be trusted."""
        return self.response.describe()

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
        k = len(sources)
        unit = np.eye(k)[:, None, :] * np.array(pose.axis)[:, None]
        mesh = self.response.answer(sources, unit, np.zeros((0, 2)))[0]
        return mesh.transpose(1, 0, 2).reshape(-1, k)

    def _warn(self, places: Floats, forces: Floats) -> None:
        """Say once per model what goes beyond the limits of the response."""
        for kind, sentence in self.response.warnings(places, forces).items():
            if kind not in self._warned:
                self._warned.add(kind)
                warnings.warn(sentence, stacklevel=3)


def _vectors(blocks: Floats) -> Floats:
    return np.ascontiguousarray(blocks.reshape(2, -1).T)
