"""Neo-Hookean tissue under a needle: the forces of the linear finite-element model on a material that may deform much."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from echospline.mechanics.fem import FEMModel
from echospline.mechanics.finite_elements import METHOD, Method, interpolate
from echospline.mechanics.forces import NeedleLoad
from echospline.mechanics.neo_hookean import Equilibrium, NeoHookean
from echospline.scene import Floats, NeedlePose, RegularGrid


@dataclass(frozen=True)
class NeoHookeanState:
    """What the tissue remembers.

    Attributes
    ----------
    linear : state of a FEMModel
        Of the linear model, which the needle's forces come from.
    equilibrium : Equilibrium
        Those forces and the displacement that balances them.
    """

    linear: Any
    equilibrium: Equilibrium


class NeoHookeanModel:
    """The needle's forces, as a linear model has them, on neo-Hookean tissue; quasi-static, for truth computed offline.

    The forces act at the same material points, in the same directions as in the linear model, so that any difference between
    both is one of material and geometry. A step takes a few factorisations.

    Parameters
    ----------
    linear : FEMModel
        Mesh, what holds it, tissue and the needle's law.
    solver : {"cholmod", "superlu"}
        See `finite_elements.factor`.

    Raises
    ------
    InputError
        If Poisson's ratio is negative.
    """

    def __init__(self, linear: FEMModel, *, solver: Method = METHOD) -> None:
        self.linear = linear
        response = linear.response
        self.material = NeoHookean(response.grid, response.clamps, response.tissue, solver=solver)

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self.material.grid

    def rest(self) -> NeoHookeanState:
        """Tissue that no needle has touched."""
        zero = np.zeros((self.grid.size, 2))
        return NeoHookeanState(self.linear.rest(), Equilibrium(zero, zero))

    def advance(self, state: NeoHookeanState, pose: NeedlePose, dt: float) -> NeoHookeanState:
        """Loads of the new pose and the displacement that balances them.

        Raises
        ------
        InputError
            If dt is negative or not finite.
        SolverError
            If the tissue finds no equilibrium; the sentence says how much load it carried.
        """
        linear = self.linear.advance(state.linear, pose, dt)
        return NeoHookeanState(linear, self.material.solve(self.linear.loads(linear), state.equilibrium))

    def displacement(self, state: NeoHookeanState) -> Floats:
        """Displacement of the nodes, shape (n, 2), mm."""
        return state.equilibrium.displacement

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        return f"neo-Hookean tissue, Newton's method on {self.linear.describe()}"

    def needle_load(self, state: NeoHookeanState) -> NeedleLoad:
        """Return the needle's forces on the tissue: those of the linear model, which act here too."""
        return self.linear.needle_load(state.linear)

    def displacement_at(self, state: NeoHookeanState, points: ArrayLike) -> Floats:
        """Displacement of any reference points of the mesh, equation (22), shape (n, 2), mm."""
        return interpolate(self.grid, state.equilibrium.displacement, points)
