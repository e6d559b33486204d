"""Large deformation of neo-Hookean tissue on the finite elements' mesh: a reference to compute with, not a model to steer by.

The stored energy per reference volume is W = mu / 2 (I1 - 3 - 2 ln J) + lambda / 2 (ln J)^2 with the Lamé parameters of
linear elasticity (Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, section 6.4.3), so that both agree under
small loads. Total Lagrangian: loads are nodal forces that keep their size and direction. In plane strain the stretch out of the plane is 1;
in plane stress it is the one that leaves no stress there.

With F the deformation gradient, G a shape function's reference gradient and g = F^-T G its spatial one, all of it is
    force      mu F G - p g
    tangent    mu (G . G') I + p g' (x) g + h g (x) g'
where p and h depend on the stretch alone (`_plane_stress`, `_change_of_area`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from echospline.errors import InputError, SolverError
from echospline.mechanics.cut_cells import elements_of
from echospline.mechanics.fem_response import refuse_loose
from echospline.mechanics.finite_elements import (
    METHOD,
    MPA,
    Method,
    element_centres,
    element_nodes,
    factor,
    lame,
)
from echospline.mechanics.landmarks import Clamps
from echospline.scene import Floats, RegularGrid, Tissue

TOLERANCE = 1e-10
"""Residual of equilibrium as a share of the loads; a larger one leaves more of Newton's error in the displacement."""
ITERATIONS = 25
"""Newton's steps for an increment of load; one that needs more is halved."""
SMALLEST = 1 / 256
"""Least increment as a share of the load; below it the tissue has no equilibrium nearby."""
HALF = 1 / np.sqrt(12.0)
"""Distance of Gauss's two points from the middle of an element, as a share of it."""
DESCENT = 1e-4
"""Share of the energy that a step must save of the one that its slope promises (Armijo's condition)."""


@dataclass(frozen=True)
class Equilibrium:
    """Loads and the displacement that balances them.

    Attributes
    ----------
    loads : ndarray, shape (n, 2)
        Nodal forces, N.
    displacement : ndarray, shape (n, 2)
        mm.
    """

    loads: Floats
    displacement: Floats


class _Points(NamedTuple):
    """Where elements are integrated: gradients (q, 4, 2) of the shape functions in 1/mm and the area of a point, mm^2."""

    gradients: Floats
    area: float


class NeoHookean:
    """Neo-Hookean tissue whose edges are clamped, slide or are free: nodal forces in, displacement out.

    Parameters
    ----------
    grid : RegularGrid
        Nodes of the mesh.
    clamps : Clamps
        What holds the tissue.
    tissue : Tissue
        Moduli per region, thickness, plane stress or strain; Poisson's ratio not negative. A cell that a boundary crosses is
        neo-Hookean by its mean compliance; what a laminate has beyond that (`cut_cells`) acts on Green's strain.
    solver : {"cholmod", "superlu"}
        See `finite_elements.factor`.

    Raises
    ------
    InputError
        If the mesh, what holds it, or a modulus does not make a solvable system.
    """

    def __init__(self, grid: RegularGrid, clamps: Clamps, tissue: Tissue, *, solver: Method = METHOD) -> None:
        refuse_loose(grid, clamps)
        self.grid, self.clamps, self.tissue, self.solver = grid, clamps, tissue, solver
        self._elements = element_nodes(grid)
        made = elements_of(tissue, grid)
        if (made.poisson < 0).any():
            raise InputError(
                f"neo-Hookean tissue needs Poisson's ratios of 0 or more; got {made.poisson.min():g}"
            )
        lam, mu = lame(made.young, made.poisson, tissue.plane)
        scale = MPA * tissue.thickness
        self._lam, self._mu, self._poisson = scale * lam, scale * mu, made.poisson
        self._cut, self._excess = made.cells, scale * made.excess
        self._full = _points(grid, np.array([0.5 - HALF, 0.5 + HALF]))
        self._centre = _points(grid, np.array([0.5]))
        self._corners = _points(grid, np.array([0.0, 1.0]))
        dofs = (2 * self._elements[:, :, None] + np.arange(2)).reshape(len(self._elements), 8)
        self._rows, self._columns = np.repeat(dofs, 8, axis=1).ravel(), np.tile(dofs, (1, 8)).ravel()
        self._free = ~clamps.held

    def solve(self, loads: ArrayLike, before: Equilibrium | None = None) -> Equilibrium:
        """Find the displacement that balances nodal forces, from an equilibrium nearby.

        Newton's method with a line search on the energy; where it fails, the load is raised in smaller increments.

        Parameters
        ----------
        loads : array_like, shape (n, 2)
            N; those on held components go into what holds them.
        before : Equilibrium, optional
            Where to start; tissue at rest when not given.

        Raises
        ------
        SolverError
            If no equilibrium is found beyond some load; the sentence says which, and where an element is next to invert.
        """
        target = np.asarray(loads, dtype=np.float64)
        if target.shape != (self.grid.size, 2) or not np.isfinite(target).all():
            raise InputError(
                f"loads must be ({self.grid.size}, 2) finite numbers in N; got shape {target.shape}"
            )
        start = before or Equilibrium(np.zeros_like(target), np.zeros_like(target))
        u, reached, step = start.displacement, 0.0, 1.0
        scale = max(
            np.linalg.norm(target[self._free]),
            np.linalg.norm(start.loads[self._free]),
            1e-3 * TOLERANCE * self._mu.max(),
        )
        while reached < 1.0:
            share = min(1.0, reached + step)
            found = self._newton(start.loads + share * (target - start.loads), u, TOLERANCE * float(scale))
            if found is not None:
                u, reached, step = found, share, 2 * step
            elif step > SMALLEST:
                step /= 2
            else:
                raise SolverError(self._stuck(start.loads + reached * (target - start.loads), target, u))
        return Equilibrium(target, u)

    def energy(self, displacement: Floats) -> float:
        """Strain energy in N mm; infinite where an element is turned inside out at a corner, and so somewhere."""
        if not (_det(self._gradient(displacement, self._corners)) > 0).all():
            return float("inf")
        total = 0.0
        for points, law in self._parts():
            F = self._gradient(displacement, points)
            J = _det(F)
            total += points.area * float(law(F, J)[0].sum())
        if len(self._cut):
            strain, _, _ = self._excess_strain(displacement)
            total += self._full.area / 2 * float(np.einsum("eqi,eij,eqj->", strain, self._excess, strain))
        return total

    def forces(self, displacement: Floats) -> Floats:
        """Nodal forces (n, 2) in N that hold the tissue in a displacement (n, 2) in mm."""
        per_element = np.zeros((len(self._elements), 4, 2))
        for points, law in self._parts():
            F = self._gradient(displacement, points)
            J = _det(F)
            _, mu, p, _ = law(F, J)
            G = points.gradients
            spatial = np.einsum("qnj,eqji->eqni", G, _inverse(F, J))
            per_element += points.area * (
                np.einsum("eq,eqij,qnj->eni", mu, F, G) - np.einsum("eq,eqni->eni", p, spatial)
            )
        if len(self._cut):
            strain, B, _ = self._excess_strain(displacement)
            per_element[self._cut] += self._full.area * np.einsum(
                "eqinc,eij,eqj->enc", B, self._excess, strain
            )
        total = np.zeros((self.grid.size, 2))
        np.add.at(total, self._elements, per_element)
        return total

    def tangent(self, displacement: Floats) -> Any:
        """Derivative of `forces`, a sparse matrix (2 n, 2 n) in N/mm."""
        K = np.zeros((len(self._elements), 4, 2, 4, 2))
        eye = np.eye(2)
        for points, law in self._parts():
            F = self._gradient(displacement, points)
            J = _det(F)
            _, mu, p, h = law(F, J)
            G = points.gradients
            g = np.einsum("qnj,eqji->eqni", G, _inverse(F, J))
            K += points.area * (
                np.einsum("eq,qnj,qmj,ik->enimk", mu, G, G, eye, optimize=True)
                + np.einsum("eq,eqmi,eqnk->enimk", p, g, g)
                + np.einsum("eq,eqni,eqmk->enimk", h, g, g)
            )
        if len(self._cut):
            strain, B, G = self._excess_strain(displacement)
            stress = np.einsum("eij,eqj->eqi", self._excess, strain)
            S = stress[..., [[0, 2], [2, 1]]]
            K[self._cut] += self._full.area * (
                np.einsum("eqinc,eij,eqjmd->encmd", B, self._excess, B, optimize=True)
                + np.einsum("qni,eqij,qmj,cd->encmd", G, S, G, eye, optimize=True)
            )
        n = 2 * self.grid.size
        return sparse.csc_matrix((K.ravel(), (self._rows, self._columns)), shape=(n, n))

    def _newton(self, loads: Floats, u: Floats, tolerance: float) -> Floats | None:
        """Balance loads from a displacement; None where that fails."""
        free = self._free
        potential = self.energy(u) - float((loads * u).sum())
        for _ in range(ITERATIONS):
            residual = np.where(free, loads - self.forces(u), 0.0)
            if np.linalg.norm(residual) <= tolerance:
                return u
            try:
                step = factor(self.tangent(u), ~free, self.solver).solve(residual)
            except (
                SolverError
            ):  # beyond what is stable: a smaller increment stays on the branch that begins at rest
                return None
            slope = float((residual * step).sum())
            if not slope > 0:
                return None
            rounding = 1e-13 * (abs(potential) + float(np.abs(loads * u).sum()))
            share = 1.0
            while True:
                trial = u + share * step
                value = self.energy(trial) - float((loads * trial).sum())
                if value <= potential - DESCENT * share * slope + rounding:
                    break
                share /= 2
                if share < 1e-6:
                    return None
            u, potential = trial, value
        return None

    def _parts(self) -> list[tuple[_Points, Any]]:
        """Points of integration and the law there: (energy, mu, p, h) of F and J, each of shape (elements, q)."""
        if self.tissue.plane == "stress":
            return [(self._full, self._plane_stress)]
        return [(self._full, self._change_of_shape), (self._centre, self._change_of_area)]

    def _plane_stress(self, F: Floats, J: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Plane stress: with a the square of the stretch out of the plane, S = mu (I - a C^-1)."""
        nu, mu = self._poisson[:, None], np.broadcast_to(self._mu[:, None], J.shape)
        a = thickening(J, nu)
        volume = np.log(J) + np.log(a) / 2
        energy = mu / 2 * ((F**2).sum(axis=(-1, -2)) + a - 3 - (a + 1) * volume)
        return energy, mu, mu * a, 2 * mu * a * nu / ((1 - 2 * nu) * a + nu)

    def _change_of_shape(self, F: Floats, J: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Plane strain, the part with mu: S = mu (I - C^-1)."""
        mu = np.broadcast_to(self._mu[:, None], J.shape)
        return mu / 2 * ((F**2).sum(axis=(-1, -2)) - 2 - 2 * np.log(J)), mu, mu, np.zeros_like(J)

    def _change_of_area(self, F: Floats, J: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Plane strain, the part with lambda, at the centre alone so that nothing locks: S = lambda ln J C^-1."""
        lam = np.broadcast_to(self._lam[:, None], J.shape)
        return lam / 2 * np.log(J) ** 2, np.zeros_like(J), -lam * np.log(J), lam

    def _gradient(self, displacement: Floats, points: _Points) -> Floats:
        """Deformation gradient (elements, q, 2, 2)."""
        F: Floats = np.eye(2) + np.einsum("eni,qnj->eqij", displacement[self._elements], points.gradients)
        return F

    def _excess_strain(self, displacement: Floats) -> tuple[Floats, Floats, Floats]:
        """Green's strain (c, q, 3) of cut cells, its derivative (c, q, 3, 4, 2) by the nodes, and the gradients (q, 4, 2)."""
        G = self._full.gradients
        F = self._gradient(displacement, self._full)[self._cut]
        E = (np.einsum("eqki,eqkj->eqij", F, F) - np.eye(2)) / 2
        strain = np.stack([E[..., 0, 0], E[..., 1, 1], 2 * E[..., 0, 1]], axis=-1)
        by_node = np.einsum("eqci,qnj->eqijnc", F, G)  # F_ci G_nj
        B = np.stack(
            [by_node[:, :, 0, 0], by_node[:, :, 1, 1], by_node[:, :, 0, 1] + by_node[:, :, 1, 0]], axis=2
        )
        return strain, B, G

    def _stuck(self, reached: Floats, target: Floats, u: Floats) -> str:
        least = _det(self._gradient(u, self._corners)).min(axis=1)
        x, y = element_centres(self.grid)[least.argmin()]
        got, asked = (float(np.hypot(*f.sum(axis=0))) for f in (reached, target))
        return (
            f"neo-Hookean tissue finds no equilibrium beyond {got:.4g} N of the {asked:.4g} N asked for: the element at ({x:.1f}, {y:.1f}) mm is "
            f"left with {100 * least.min():.0f} % of its area there; lower the force, take stiffer or thicker tissue or a coarser mesh"
        )


def thickening(area: Floats, poisson: ArrayLike) -> Floats:
    """Square of the stretch out of the plane that leaves no stress there, in plane stress.

    It is the root a of (1 - 2 nu) (a - 1) + nu (2 ln J + ln a) = 0, where J is the change of area in the plane: Newton's method in ln a,
    which converges from any side because the function is convex and rises.
    """
    nu = np.broadcast_to(np.asarray(poisson, dtype=np.float64), area.shape)
    known = 2 * nu * np.log(area)
    log = -known / (1 - nu)  # the answer of linear elasticity
    for _ in range(50):
        a = np.exp(log)
        step = ((1 - 2 * nu) * (a - 1) + known + nu * log) / ((1 - 2 * nu) * a + nu)
        log = log - step
        if np.abs(step).max(initial=0.0) < 1e-14:
            break
    root: Floats = np.exp(log)
    return root


def _points(grid: RegularGrid, places: Floats) -> _Points:
    """Points of an element at some places (0 to 1) along x and y, all of one weight."""
    dx, dy = grid.spacing
    s, t = (c.ravel() for c in np.meshgrid(places, places))
    along_x = np.stack([-(1 - t), 1 - t, t, -t], axis=1) / dx
    along_y = np.stack([-(1 - s), -s, s, 1 - s], axis=1) / dy
    return _Points(np.stack([along_x, along_y], axis=-1), dx * dy / len(places) ** 2)


def _det(F: Floats) -> Floats:
    J: Floats = F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]
    return J


def _inverse(F: Floats, J: Floats) -> Floats:
    rows: list[NDArray[np.float64]] = [F[..., 1, 1], -F[..., 0, 1], -F[..., 1, 0], F[..., 0, 0]]
    inverse: Floats = np.stack(rows, axis=-1).reshape(F.shape) / J[..., None, None]
    return inverse
