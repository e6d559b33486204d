"""Finite elements as tissue that answers forces: factored once, a back-substitution per set of load cases."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from echospline.errors import InputError
from echospline.mechanics.cut_cells import elements_of
from echospline.mechanics.finite_elements import (
    METHOD,
    Integration,
    Method,
    factor,
    shape_functions,
    stiffness,
)
from echospline.mechanics.landmarks import Clamps
from echospline.scene import Floats, RegularGrid, Tissue, as_points


class FEMResponse:
    """Linear plane elasticity on bilinear quadrilaterals with edges clamped, sliding or free (a `ForceResponse`).

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

    Attributes
    ----------
    stiffness : scipy.sparse.csc_matrix, shape (2 n, 2 n)
        N/mm.
    factored : FactoredStiffness
        Ready to solve.

    Raises
    ------
    InputError
        If the mesh, what holds it, or a modulus does not make a solvable system.
    """

    def __init__(
        self,
        grid: RegularGrid,
        clamps: Clamps,
        tissue: Tissue,
        *,
        solver: Method = METHOD,
        integration: Integration | None = None,
    ) -> None:
        self._grid, self.clamps, self.tissue = grid, clamps, tissue
        refuse_loose(grid, clamps)
        self.integration: Integration = integration or ("selective" if tissue.plane == "strain" else "full")
        made = elements_of(tissue, grid)
        self.stiffness = stiffness(
            grid, made.young, made.poisson, tissue.thickness, tissue.plane, self.integration, made[2:]
        )
        self.factored = factor(self.stiffness, clamps.held, solver)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the response was made of; a copy factors anew."""
        made = partial(FEMResponse, solver=self.factored.method, integration=self.integration)
        return made, (self.grid, self.clamps, self.tissue)

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self._grid

    def answer(self, places: Floats, forces: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Displacement under k load cases; see `ForceResponse.answer`."""
        where, wanted = as_points(places), as_points(points)
        f = np.asarray(forces, dtype=np.float64)
        if f.ndim != 3 or f.shape[:2] != (len(where), 2):
            raise InputError(f"forces must have shape ({len(where)}, 2, k) in N; got {f.shape}")
        spread = shape_matrix(self.grid, where)
        k = f.shape[2]
        mesh = self.factored.solve((spread.T @ f.reshape(len(where), 2 * k)).reshape(self.grid.size, 2, k))
        at = shape_matrix(self.grid, wanted) @ mesh.reshape(self.grid.size, 2 * k)
        return mesh, at.reshape(len(wanted), 2, k)

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved, and how far that is to be trusted."""
        nx, ny = self.grid.shape
        dx, dy = self.grid.spacing
        return (
            f"finite elements: {nx} x {ny} nodes, bilinear quadrilaterals of {dx:.3g} x {dy:.3g} mm, plane {self.tissue.plane}, "
            f"factored once ({self.factored.method}); cells of 1 mm are within 0.5 % of the mean displacement in homogeneous "
            "tissue and 4 % with lesions and layers (docs/fem.md), less so within one cell of a point force"
        )


def shape_matrix(grid: RegularGrid, points: Floats) -> sparse.csr_matrix:
    """Shape functions (22) of all nodes at points, shape (k, n): interpolates fields, and transposed spreads forces."""
    nodes, weights = shape_functions(grid, points)
    rows = np.repeat(np.arange(len(nodes)), 4)
    return sparse.csr_matrix((weights.ravel(), (rows, nodes.ravel())), shape=(len(nodes), grid.size))


def refuse_loose(grid: RegularGrid, clamps: Clamps) -> None:
    """Refuse tissue that its mesh nodes, as held, let shift or turn: two clamped points may lie at one node."""
    held: NDArray[np.bool_] = clamps.held
    x, y = ((grid.nodes - grid.nodes.mean(axis=0)) / np.ptp(grid.nodes, axis=0).max()).T
    one, zero = np.ones(len(x)), np.zeros(len(x))
    motions = np.vstack([np.stack([one, zero, -y], 1)[held[:, 0]], np.stack([zero, one, x], 1)[held[:, 1]]])
    if np.linalg.matrix_rank(motions, tol=1e-6) < 3:
        edges = [f"the {edge} edge slides" for edge in clamps.sliding]
        nodes = len(clamps.nodes)
        edges += [f"clamped points reach {nodes} mesh node{'s'[: nodes != 1]}"] if len(clamps.points) else []
        raise InputError(
            f"the mesh can still shift or turn as a whole ({'; '.join(edges) or 'nothing is held'}): clamp one edge, for example "
            "the bottom, or move clamped points further apart than the mesh's spacing"
        )
