"""The tissue model that the spline is compared with: finite elements under the same needle, section IV of the paper.

The needle acts by forces: those of a needle that sticks, slips and cuts (`ForceModel`), or the paper's: a cutting force at the tip
and viscous friction along the shaft, as consistent nodal loads wherever it lies. Between steps the tissue remembers the loads alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.mechanics.fem_response import FEMResponse
from echospline.mechanics.finite_elements import (
    METHOD,
    Integration,
    Method,
    interpolate,
    line_loads,
    point_loads,
)
from echospline.mechanics.force_model import ForceModel, ForceState
from echospline.mechanics.forces import (
    Forces,
    NeedleForces,
    NeedleLoad,
    ViscousForces,
    check_step,
    travelled,
)
from echospline.mechanics.landmarks import Clamps
from echospline.scene import ZERO_LENGTH, Floats, NeedlePose, RegularGrid, Tissue


@dataclass(frozen=True)
class FEMState:
    """What the tissue remembers under the viscous law.

    Attributes
    ----------
    pose : NeedlePose or None
        The last pose; None at rest.
    tip : float
        Force at the tip along the axis, N.
    friction : ndarray, shape (n, 2)
        Nodal loads of friction, N.
    displacement : ndarray, shape (n, 2)
        Of the nodes, mm.
    """

    pose: NeedlePose | None
    tip: float
    friction: Floats
    displacement: Floats


State = FEMState | ForceState


class FEMModel:
    """Linear plane elasticity whose edges are clamped, slide or are free, under a needle's forces; factored once.

    Parameters
    ----------
    grid : RegularGrid
        Nodes of the mesh.
    clamped : iterable of {"top", "bottom", "left", "right"}
        Edges held fast: the same along which the spline has its anchors.
    sliding : iterable of the same names
        Edges along which the tissue slides without friction: they hold the displacement across themselves.
    tissue : Tissue
        Moduli per region, thickness, plane stress or strain.
    forces : NeedleForces or ViscousForces
        What the needle exerts: the law that sticks and slips, or the paper's.
    clamped_points : array_like, shape (k, 2), optional
        Further points held fast, mm: the mesh nodes nearest to them.
    solver : {"cholmod", "superlu"}
        See `finite_elements.factor`; CHOLMOD where it is installed, else SuperLU. ``model.factored.method`` says which.
    integration : {"full", "selective"}, optional
        See `finite_elements.stiffness`; by default selective where plane strain would lock, else full.

    Raises
    ------
    InputError
        If the mesh, the clamp or a modulus does not make a solvable system.
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
        solver: Method = METHOD,
        integration: Integration | None = None,
    ) -> None:
        self.tissue, self.forces = tissue or Tissue(), forces or NeedleForces()
        clamps = Clamps.of(grid, clamped, clamped_points, sliding)
        self.clamped = clamps.nodes
        self.response = FEMResponse(grid, clamps, self.tissue, solver=solver, integration=integration)
        self.stiffness, self.factored = self.response.stiffness, self.response.factored
        self.needle = (
            ForceModel(self.response, self.forces) if isinstance(self.forces, NeedleForces) else None
        )
        self._made = partial(
            FEMModel, grid, clamps.edges, self.tissue, self.forces, clamped_points=clamps.points,
            sliding=clamps.sliding, solver=solver, integration=integration,
        )  # fmt: skip

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the model was made of."""
        return self._made, ()

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self.response.grid

    def rest(self) -> State:
        """Tissue that no needle has touched."""
        if self.needle is not None:
            return self.needle.rest()
        return FEMState(None, 0.0, np.zeros((self.grid.size, 2)), np.zeros((self.grid.size, 2)))

    def advance(self, state: State, pose: NeedlePose, dt: float) -> State:
        """Loads of the new pose and the displacement under them, equation (23).

        Raises
        ------
        InputError
            If dt is negative or not finite, or the state is of the other law.
        """
        check_step(dt)
        if self.needle is not None and isinstance(state, ForceState):
            return self.needle.advance(state, pose, dt)
        law = self.forces
        if not isinstance(law, ViscousForces) or not isinstance(state, FEMState):
            raise InputError("this state belongs to a model with the other law of forces")
        travel = travelled(state.pose, pose)
        friction = law.advance_friction(state.friction, self.friction_loads(pose), travel, dt)
        inside = pose.depth >= ZERO_LENGTH and bool(self.grid.contains(pose.tip)[0])
        tip = law.advance_tip(state.tip, pose, travel, inside=inside)
        displacement = self.factored.solve(friction + self.tip_loads(pose, tip))
        return FEMState(pose, tip, friction, displacement)

    def displacement(self, state: State) -> Floats:
        """Displacement of the nodes, shape (n, 2), mm."""
        return state.displacement

    def displacement_at(self, state: State, points: ArrayLike) -> Floats:
        """Displacement of any reference points of the mesh, equation (22), shape (n, 2), mm.

        Raises
        ------
        InputError
            If a point lies outside the mesh: there is no tissue.
        """
        return interpolate(self.grid, state.displacement, points)

    def needle_load(self, state: State) -> NeedleLoad:
        """Return the needle's forces on the tissue."""
        if isinstance(state, ForceState):
            return state.load
        if state.pose is None:
            return NeedleLoad()
        return NeedleLoad(state.tip, float(np.sum(state.friction @ np.array(state.pose.axis))))

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved, and how far that is to be trusted."""
        return self.response.describe()

    def loads(self, state: State) -> Floats:
        """Nodal loads (n, 2) in N that act on the tissue in a state."""
        if isinstance(state, FEMState):
            return (
                state.friction
                if state.pose is None
                else state.friction + self.tip_loads(state.pose, state.tip)
            )
        total = np.zeros((self.grid.size, 2))
        for answered, force in zip(state.track, state.forces, strict=True):
            station = answered.station
            if len(station.points):
                total += point_loads(self.grid, station.points, station.weights[:, None] * force)
        return total

    def friction_loads(self, pose: NeedlePose) -> Floats:
        """Nodal loads (n, 2) in N of the viscous law's steady friction at this pose and speed."""
        if not isinstance(self.forces, ViscousForces):
            raise InputError("steady friction in proportion to speed is that of ViscousForces alone")
        return self.shaft_loads(pose, self.forces.friction * pose.speed)

    def shaft_loads(self, pose: NeedlePose, force_per_mm: float) -> Floats:
        """Nodal loads (n, 2) in N of a force per length (N/mm) along the axis, on all of the shaft in the tissue."""
        if pose.depth < ZERO_LENGTH or force_per_mm == 0:
            return np.zeros((self.grid.size, 2))
        return line_loads(self.grid, pose.entry, pose.tip, force_per_mm * np.array(pose.axis))

    def tip_loads(self, pose: NeedlePose, force: float) -> Floats:
        """Nodal loads (n, 2) in N of a force (N) at the tip along the axis; none where the tip is out of the tissue."""
        if force == 0 or pose.depth < ZERO_LENGTH or not self.grid.contains(pose.tip)[0]:
            return np.zeros((self.grid.size, 2))
        return point_loads(self.grid, pose.tip, force * np.array(pose.axis))
