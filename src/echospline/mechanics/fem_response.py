"""Finite elements as tissue that answers forces."""

from __future__ import annotations

import numpy as np

from echospline.errors import InputError
from echospline.mechanics.finite_elements import (
    Integration,
    Method,
    factor,
    interpolate,
    shape_functions,
    stiffness,
)
from echospline.mechanics.landmarks import Clamps
from echospline.scene import Floats, RegularGrid, Tissue


class FEMResponse:
    """Linear plane elasticity on the mesh, factored once: a `ForceResponse`.

    Parameters
    ----------
    grid : RegularGrid
        Nodes of the mesh.
    clamps : Clamps
        What holds the tissue.
    tissue : Tissue
        Moduli per region, thickness, plane stress or strain.
    solver : {"cholmod", "superlu"}
        See `finite_elements.factor`.
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
        clamps: Clamps,
        tissue: Tissue,
        *,
        solver: Method = "cholmod",
        integration: Integration | None = None,
    ) -> None:
        if clamps.sliding:
            raise InputError("finite elements do not know sliding edges yet; clamp the edge or leave it free")
        self._grid = grid
        young, poisson = tissue.in_cells(grid)
        if integration is None:
            integration = "selective" if tissue.plane == "strain" else "full"
        self.stiffness = stiffness(grid, young, poisson, tissue.thickness, tissue.plane, integration)
        self.factored = factor(self.stiffness, clamps.nodes, solver)

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self._grid

    def answer(self, places: Floats, forces: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Displacement under k load cases of point forces; see `ForceResponse.answer`."""
        nodes, weights = shape_functions(self.grid, places)
        loads = np.zeros((self.grid.size, 2, forces.shape[2]))
        np.add.at(loads, nodes, weights[:, :, None, None] * forces[:, None])
        mesh = self.factored.solve(loads)
        cases = mesh.shape[2]
        at = np.stack([interpolate(self.grid, mesh[..., i], points) for i in range(cases)], axis=-1)
        return mesh, at

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        return f"finite elements on {self.grid.size} nodes, factored once"
