"""Finite elements in space for tests: quadratic hexahedra of scikit-fem that correct a known field.

Near a point force elements are poor, so they solve for what the closed form lacks: minus its displacement on clamped faces, minus its
traction on free ones. That is smooth, and a few thousand nodes know it to some tenths of a percent (mesh halved: see the test).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementHex2, ElementVector, FacetBasis, LinearForm, MeshHex
from skfem.helpers import ddot, dot, sym_grad, trace

AXES = {"left": (0, 0), "right": (0, 1), "top": (1, 0), "bottom": (1, 1), "front": (2, 0), "back": (2, 1)}


class Corrected:
    """A block of elastic tissue; E in kPa, lengths in mm, forces in N."""

    def __init__(self, low, high, kinds: Mapping[str, str], young: float, nu: float, cell: float) -> None:
        lines = [np.linspace(a, b, max(2, round((b - a) / cell) + 1)) for a, b in zip(low, high, strict=True)]
        mesh = MeshHex.init_tensor(*lines)
        self.kinds, self.nu, self.mu = kinds, nu, 1e-3 * young / (2 * (1 + nu))
        lam = 2 * self.mu * nu / (1 - 2 * nu)
        self.basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)
        mu = self.mu

        @BilinearForm
        def energy(u, v, w):
            return 2 * mu * ddot(sym_grad(u), sym_grad(v)) + lam * trace(sym_grad(u)) * trace(sym_grad(v))

        self.K = energy.assemble(self.basis).tocsc()
        ends = np.array([low, high])
        self.faces = {
            face: mesh.facets_satisfying(
                lambda x, k=k, s=s: np.abs(x[k] - ends[s, k]) < 1e-9, boundaries_only=True
            )
            for face, (k, s) in AXES.items()
        }
        held = np.zeros(self.K.shape[0], dtype=bool)
        for face, kind in kinds.items():
            dofs = self.basis.get_dofs(self.faces[face])
            if kind == "free":
                continue
            index = dofs.all()
            component = self._component[index]
            wanted = range(3) if kind == "clamped" else [AXES[face][0]]
            held[index[np.isin(component, list(wanted))]] = True
        self.held = held
        self.solver = splu(
            self.K[~held][:, ~held],
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    @property
    def _component(self) -> np.ndarray:
        return np.arange(self.basis.N) % 3

    def correct(self, moves: Callable, pulls: Callable, points: np.ndarray) -> np.ndarray:
        """Field at points (n, 3): the closed form ``moves(p)`` plus what the faces do; ``pulls(p, n)`` is its traction over mu."""
        load = np.zeros(self.basis.N)
        for face, kind in self.kinds.items():
            if kind == "clamped":
                continue
            axis, side = AXES[face]
            facets = FacetBasis(self.basis.mesh, self.basis.elem, facets=self.faces[face], intorder=6)
            x = np.asarray(facets.global_coordinates())
            flat = x.reshape(3, -1).T
            normal = np.zeros_like(flat)
            normal[:, axis] = 1.0 if side else -1.0
            t = -self.mu * pulls(flat, normal)
            if kind == "sliding":
                t[:, axis] = 0.0
            traction = np.ascontiguousarray(t.T).reshape(x.shape)

            @LinearForm
            def work(v, w, traction=traction):
                return dot(traction, v)

            load += work.assemble(facets)
        given = np.zeros(self.basis.N)
        places = self.basis.doflocs.T
        base = moves(places[self.held])
        given[self.held] = -base[np.arange(len(base)), self._component[self.held]]
        rhs = load - self.K @ given
        w = given.copy()
        w[~self.held] = self.solver.solve(rhs[~self.held])
        probe = self.basis.probes(points.T)
        return moves(points) + (probe @ w).reshape(3, -1).T
