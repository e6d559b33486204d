"""The tissue model that the spline is compared with: finite elements under the same needle, section IV of the paper.

The needle acts by forces: a cutting force at the tip and friction along the shaft, as consistent nodal loads
wherever it lies. Between steps the tissue remembers only the loads that still act on it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from echospline.mechanics.finite_elements import (
    METHOD,
    Integration,
    Method,
    factor,
    interpolate,
    line_loads,
    point_loads,
    stiffness,
)
from echospline.mechanics.forces import NeedleForces, check_step, travelled
from echospline.mechanics.landmarks import Clamps
from echospline.scene import ZERO_LENGTH, Floats, NeedlePose, RegularGrid, Tissue


@dataclass(frozen=True)
class FEMState:
    """What the tissue remembers.

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


class FEMModel:
    """Linear plane elasticity, clamped along edges, under a needle's forces; factored once, solved per step.

    Parameters
    ----------
    grid : RegularGrid
        Nodes of the mesh.
    clamped : iterable of {"top", "bottom", "left", "right"}
        Edges held fast: the same along which the spline has its anchors.
    tissue : Tissue
        Moduli per region, thickness, plane stress or strain.
    forces : NeedleForces
        What the needle exerts.
    solver : {"cholmod", "superlu"}
        See `finite_elements.factor`; CHOLMOD where it is installed, else SuperLU. ``model.factored.method`` says which.
    clamped_points : array_like, shape (k, 2), optional
        Further points held fast, mm: the mesh nodes nearest to them.
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
        forces: NeedleForces | None = None,
        *,
        clamped_points: ArrayLike | None = None,
        solver: Method = METHOD,
        integration: Integration | None = None,
    ) -> None:
        self._grid = grid
        self.tissue = tissue or Tissue()
        self.forces = forces or NeedleForces()
        self.clamped = Clamps.of(grid, clamped, clamped_points).nodes
        young, poisson = self.tissue.in_cells(grid)
        if integration is None:
            integration = "selective" if self.tissue.plane == "strain" else "full"
        self.stiffness = stiffness(
            grid, young, poisson, self.tissue.thickness, self.tissue.plane, integration
        )
        self.factored = factor(self.stiffness, self.clamped, solver)

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self._grid

    def rest(self) -> FEMState:
        """Tissue that no needle has touched."""
        return FEMState(None, 0.0, np.zeros((self.grid.size, 2)), np.zeros((self.grid.size, 2)))

    def advance(self, state: FEMState, pose: NeedlePose, dt: float) -> FEMState:
        """Loads of the new pose and the displacement under them, equation (23).

        Raises
        ------
        InputError
            If dt is negative or not finite.
        """
        check_step(dt)
        travel = travelled(state.pose, pose)
        friction = self.forces.advance_friction(state.friction, self.friction_loads(pose), travel, dt)
        inside = pose.depth >= ZERO_LENGTH and bool(self.grid.contains(pose.tip)[0])
        tip = self.forces.advance_tip(state.tip, pose, travel, inside=inside)
        displacement = self.factored.solve(friction + self.tip_loads(pose, tip))
        return FEMState(pose, tip, friction, displacement)

    def displacement(self, state: FEMState) -> Floats:
        """Displacement of the nodes, shape (n, 2), mm."""
        return state.displacement

    def displacement_at(self, state: FEMState, points: ArrayLike) -> Floats:
        """Displacement of any reference points of the mesh, equation (22), shape (n, 2), mm.

        Raises
        ------
        InputError
            If a point lies outside the mesh: there is no tissue.
        """
        return interpolate(self.grid, state.displacement, points)

    def friction_loads(self, pose: NeedlePose) -> Floats:
        """Nodal loads (n, 2) in N of steady friction at this pose and speed."""
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
