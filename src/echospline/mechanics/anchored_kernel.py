"""The kernel with the anchors already held: G(x, y), the field at x of a unit weight at y that no anchor feels.

    G(x, y) = U(x, y) - [U_xB  P_x] L_B^-1 [U_By  P_y]'

with U the spline's kernel, P its polynomial and L_B the system (6) of the anchors B alone. A spline through the anchors,
held at zero, and further landmarks C with displacements d is then G_:C w with G_CC w = d: no more than the landmarks that
move. Factored once per scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lu_factor, lu_solve

from echospline.errors import InputError
from echospline.mechanics.kernels import Kernel
from echospline.mechanics.spline import Spline, compliance
from echospline.scene import Floats, as_points


@dataclass(frozen=True)
class AnchoredKernel:
    """G for one set of anchors and one set of points to evaluate it at.

    Rows stand for sources and columns for points. With two components (c = 2) a
    row holds all x, then all y; sources are interleaved (x, y of the first, x, y of the second, ...).

    Parameters
    ----------
    kernel : Kernel
        In conditioned coordinates (x - centre) / scale.
    anchors, points : ndarray, shape (b, 2) and (n, 2)
        Conditioned.
    table : ndarray, shape (k, n c)
        [U_xB P_x]', what every row needs of the points.
    factors
        LU of L_B.
    centre, scale
        mm.
    kept : ndarray of bool, shape (b c + p,)
        Which components of which anchors are held (all x, then all y), and all motions; k of them.
    """

    kernel: Kernel
    anchors: Floats
    points: Floats
    table: Floats
    factors: Any
    centre: Floats
    scale: float
    kept: NDArray[np.bool_]

    @classmethod
    def factor(
        cls,
        kernel: Kernel,
        anchors: ArrayLike,
        points: Floats,
        stiffness: ArrayLike | None = None,
        held: NDArray[np.bool_] | None = None,
    ) -> AnchoredKernel:
        """Assemble and factor L_B.

        Parameters
        ----------
        kernel : Kernel
            `ThinPlate` or `Elastic`.
        anchors : array_like, shape (b, 2)
            mm.
        points : ndarray, shape (n, 2)
            Where rows are evaluated (the mesh nodes), mm.
        stiffness : array_like, shape (b,), optional
            As in `spline.factor`; infinite holds exactly.
        held : ndarray of bool, shape (b, 2), optional
            Which components each anchor holds; all when not given.

        Raises
        ------
        InputError
            If the anchors alone do not hold the tissue (they lie on one line).
        """
        fixed = as_points(anchors, "anchors", kernel.dimension)
        partly = held is not None and not held.all()
        kernel = kernel.apart() if partly else kernel
        c = kernel.components
        centre = 0.5 * (fixed.min(axis=0) + fixed.max(axis=0))
        scale = float(np.ptp(fixed, axis=0).max()) / 2 or 1.0
        B, x = (fixed - centre) / scale, (points - centre) / scale
        conditioned = kernel.scaled(scale)
        R = conditioned.polynomial(B)
        kept = np.ones(len(R) + R.shape[1], dtype=bool)
        if partly:
            kept[: len(R)] = np.asarray(held).T.ravel()
        singular = np.linalg.svd(R[kept[: len(R)]], compute_uv=False)
        if len(singular) < R.shape[1] or singular[-1] < 1e-9 * singular[0]:
            raise InputError(
                f"the {len(fixed)} anchors do not hold the tissue alone; clamp points off one line, "
                'or use the solver "refit"'
            )
        K = conditioned.matrix(B, B)
        if stiffness is not None:
            k = np.broadcast_to(np.asarray(stiffness, dtype=np.float64), (len(fixed),))
            if not (k > 0).all():
                raise InputError(f"every stiffness must be positive (or infinite); got {k.min()}")
            K = K + np.diag(np.tile(compliance(kernel, k) / scale**kernel.length_power, c))
        p = R.shape[1]
        L = np.block([[K, R], [R.T, np.zeros((p, p))]])[np.ix_(kept, kept)]
        every = np.hstack([conditioned.matrix(x, B), conditioned.polynomial(x)])
        table = np.ascontiguousarray(every.T[kept])
        factors = lu_factor(L, check_finite=False)
        return cls(conditioned, B, x, table, factors, centre, scale, kept)

    @property
    def components(self) -> int:
        """c: 1, or the dimension."""
        return self.kernel.components

    def conditioned(self, points: Floats) -> Floats:
        """Points in mm as (x - centre) / scale."""
        x: Floats = (points - self.centre) / self.scale
        return x

    def compliance(self, stiffness: Floats) -> Floats:
        """Diagonal that a stiffness adds, conditioned; 0 for an infinite one."""
        added: Floats = compliance(self.kernel, stiffness) / self.scale**self.kernel.length_power
        return added

    def coupling(self, sources: Floats) -> Floats:
        """L_B^-1 [U_By P_y]' for conditioned sources (m, 2), shape (k, m c), interleaved columns."""
        felt = self.felt_by(sources)
        held: Floats = lu_solve(self.factors, felt.T, check_finite=False)
        return held

    def between(self, points: Floats, sources: Floats) -> Floats:
        """G of conditioned points (n, 2) and sources (m, 2), both interleaved, shape (n c, m c)."""
        c = self.components
        direct = interleaved(interleaved(self.kernel.matrix(points, sources), c).T, c).T
        G: Floats = direct - self.felt_by(points) @ self.coupling(sources)
        return G

    def rows(self, sources: Floats) -> Floats:
        """G at all points for conditioned sources (m, 2), shape (m c, n c): one row per source component."""
        direct = interleaved(self.kernel.matrix(sources, self.points), self.components)
        rows: Floats = direct - self.coupling(sources).T @ self.table
        return rows

    def felt_by(self, sources: Floats) -> Floats:
        """[U_yB P_y] of conditioned sources (m, 2), shape (m c, k)."""
        felt = np.hstack([self.kernel.matrix(sources, self.anchors), self.kernel.polynomial(sources)])
        return np.ascontiguousarray(interleaved(felt[:, self.kept], self.components))

    def spline(self, sources: Floats, weights: Floats, coupling: Floats | None = None) -> Spline:
        """Return the field of weights (m c, 2 / c) at conditioned sources, anchors included, for any point.

        ``coupling`` is that of the sources, where it is known already.
        """
        c = self.components
        held = np.zeros((len(self.kept), weights.shape[1]))
        held[self.kept] = -(self.coupling(sources) if coupling is None else coupling) @ weights
        split = len(self.anchors) * c
        mobile = weights if c == 1 else blocks(weights)
        anchors = held[:split]
        every = (
            np.vstack([anchors, mobile])
            if c == 1
            else np.vstack(
                [anchors[: split // 2], mobile[: len(sources)], anchors[split // 2 :], mobile[len(sources) :]]
            )
        )
        landmarks = np.vstack([self.anchors, sources]) * self.scale + self.centre
        return Spline(self.kernel, landmarks, every, held[split:], self.centre, self.scale)


def interleaved(matrix: Floats, c: int) -> Floats:
    """Rows in blocks [all x, all y(, all z)] as rows (x, y(, z)) of one point after another."""
    if c == 1:
        return matrix
    n = len(matrix) // c
    rows: Floats = matrix.reshape(c, n, matrix.shape[1]).transpose(1, 0, 2).reshape(matrix.shape)
    return rows


def blocks(matrix: Floats) -> Floats:
    """Inverse of `interleaved` for two components."""
    n = len(matrix) // 2
    rows: Floats = matrix.reshape(n, 2, matrix.shape[1]).transpose(1, 0, 2).reshape(matrix.shape)
    return rows
