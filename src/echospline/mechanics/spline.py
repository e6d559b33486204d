"""Landmark splines: fit displacements at landmarks, evaluate them anywhere; equations (2) to (9), Algorithm 1.

The system matrix L (6) depends on the landmarks alone: `factor` once, `FactoredSpline.solve` per step. The spline
carries *displacements*. Equation (9) carries positions; the two agree, because the side conditions reproduce the
affine motions, the identity among them. Nothing here knows a needle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lu_factor, lu_solve
from scipy.spatial import cKDTree

from echospline.errors import InputError, SolverError
from echospline.mechanics.kernels import Apart, Kernel
from echospline.scene import Floats, as_points

RESIDUAL = 1e-7
"""mm; largest misfit at the landmarks, relative to displacements of 1 mm, before a solution is refused."""

FARTHEST = 1e9
"""mm; a coordinate beyond a thousand kilometres is a mistake, and its square might overflow."""


@dataclass(frozen=True)
class Spline:
    """A fitted field.

    Parameters
    ----------
    kernel : Kernel
        In conditioned coordinates (x - centre) / scale.
    landmarks : ndarray, shape (m, D)
        mm.
    weights : ndarray, shape (m c, D / c)
        w_i of equation (7), for the conditioned kernel.
    motion : ndarray, shape (p, D / c)
        Coefficients a_0, a_1, a_2 of the affine (or rigid) part, conditioned.
    centre : ndarray, shape (D,)
        mm.
    scale : float
        mm.
    """

    kernel: Kernel
    landmarks: Floats
    weights: Floats
    motion: Floats
    centre: Floats
    scale: float

    def __call__(self, points: ArrayLike) -> Floats:
        """Displacement at points (n, D) in mm, equation (9) less the identity, shape (n, D) mm."""
        x, s = self._conditioned(points), self._conditioned(self.landmarks)
        field = self.kernel.matrix(x, s) @ self.weights + self.kernel.polynomial(x) @ self.motion
        return _as_vectors(field, self.kernel.components)

    def gradient(self, points: ArrayLike) -> Floats:
        """Displacement gradient du_i/dx_j at points (n, D) in mm, shape (n, D, D)."""
        x, s = self._conditioned(points), self._conditioned(self.landmarks)
        by = self.kernel.gradient(x, s) @ self.weights + self.kernel.polynomial_gradient(x) @ self.motion
        columns = [_as_vectors(slope, self.kernel.components) for slope in by]
        gradient: Floats = np.stack(columns, axis=-1) / self.scale
        return gradient

    def energy(self) -> float:
        """Bending energy (1) (thin plate, per 16 pi or 8 pi in space, in conditioned units) or elastic energy: w' K w."""
        s = self._conditioned(self.landmarks)
        return float(np.sum(self.weights * (self.kernel.matrix(s, s) @ self.weights)))

    def _conditioned(self, points: ArrayLike) -> Floats:
        x = np.asarray(points, dtype=np.float64).reshape(-1, self.kernel.dimension)
        conditioned: Floats = (x - self.centre) / self.scale
        return conditioned


@dataclass(frozen=True)
class FactoredSpline:
    """The factors of L (6) for one set of landmarks; `solve` costs two triangular solves.

    ``kept`` are the rows of the unknowns (weights, then motions) that the system has: all, unless a landmark leaves a component free.
    """

    kernel: Kernel
    landmarks: Floats
    centre: Floats
    scale: float
    system: Floats
    factors: Any
    kept: NDArray[np.bool_]

    def solve(self, displacements: ArrayLike) -> Spline:
        """Fit displacements at the landmarks, equations (7) and (8).

        Parameters
        ----------
        displacements : array_like, shape (m, D)
            Target minus source of each landmark, mm; a component that the landmark leaves free is not read.

        Returns
        -------
        Spline

        Raises
        ------
        InputError
            If the shape is another or a number is not finite.
        SolverError
            If the landmarks lie so that L cannot be solved to `RESIDUAL`.
        """
        m, c, D = len(self.landmarks), self.kernel.components, self.kernel.dimension
        d = as_points(displacements, "displacements", D)
        if len(d) != m:
            raise InputError(
                f"one displacement per landmark is needed: {m} landmarks, {len(d)} displacements"
            )
        V = np.vstack([_as_blocks(d, c), np.zeros((len(self.kept) - m * c, D // c))])
        solution, asked = np.zeros_like(V), V[self.kept]
        solution[self.kept] = lu_solve(self.factors, asked, check_finite=False)
        misfit = float(np.abs(self.system @ solution[self.kept] - asked).max())
        if not misfit <= RESIDUAL * max(1.0, float(np.abs(d).max())):
            raise SolverError(
                f"the spline misses its landmarks by {misfit:.1e} mm: two of the {m} landmarks lie too close "
                "together; thin them out or give them a finite stiffness"
            )
        return Spline(
            self.kernel, self.landmarks, solution[: m * c], solution[m * c :], self.centre, self.scale
        )


def factor(
    kernel: Kernel,
    landmarks: ArrayLike,
    stiffness: ArrayLike | None = None,
    held: NDArray[np.bool_] | None = None,
) -> FactoredSpline:
    """Assemble and factor L, equation (6).

    Parameters
    ----------
    kernel : Kernel
        `ThinPlate` or `Elastic`.
    landmarks : array_like, shape (m, D)
        Source points (rest positions), mm; D is the kernel's dimension.
    stiffness : array_like, shape (m,), optional
        How firmly each landmark holds its displacement (Rohr et al. 2001): the spline minimises
        sum k |d - u|^2 + energy. Infinite (the default) interpolates. Thin plate: 1/mm^2 (1/mm in space), beside the
        bending energy (1). Elastic: relative to the shear modulus (mm in space).
    held : ndarray of bool, shape (m, D), optional
        Which components of its displacement each landmark determines; all when not given. One that it leaves free takes no
        force there: the spline slides over it.

    Returns
    -------
    FactoredSpline

    Raises
    ------
    InputError
        If landmarks are too few, on one line (in space: in one plane), coincident or not finite, or a stiffness is not
        positive.
    """
    kernel, held = _apart(kernel, held)
    points, x, centre, scale = condition(kernel, landmarks, held)
    m, c = len(points), kernel.components
    conditioned = kernel.scaled(scale)
    K = conditioned.matrix(x, x)
    R = conditioned.polynomial(x)
    if stiffness is not None:
        k = np.broadcast_to(np.asarray(stiffness, dtype=np.float64), (m,))
        if not (k > 0).all():
            raise InputError(f"every stiffness must be positive (or infinite); got {k.min()}")
        K = K + np.diag(np.tile(compliance(kernel, k) / scale**kernel.length_power, c))
    p = R.shape[1]
    L = np.block([[K, R], [R.T, np.zeros((p, p))]])
    kept = np.ones(len(L), dtype=bool)
    if held is not None:
        kept[: m * c] = held.T.ravel()
        L = L[np.ix_(kept, kept)]
    return FactoredSpline(conditioned, points, centre, scale, L, lu_factor(L, check_finite=False), kept)


def condition(
    kernel: Kernel, landmarks: ArrayLike, held: NDArray[np.bool_] | None = None
) -> tuple[Floats, Floats, Floats, float]:
    """Check landmarks, and shift and scale them for a solve.

    Parameters
    ----------
    kernel : Kernel
        `ThinPlate` or `Elastic`.
    landmarks : array_like, shape (m, D)
        mm.
    held : ndarray of bool, shape (m, D), optional
        As in `factor`.

    Returns
    -------
    points, x : ndarray, shape (m, D)
        The landmarks in mm, and as (points - centre) / scale.
    centre : ndarray, shape (D,)
        mm.
    scale : float
        mm.

    Raises
    ------
    InputError
        If landmarks are too few, on one line (in space: in one plane), coincident or not finite.
    """
    kernel, held = _apart(kernel, held)
    D, c = kernel.dimension, kernel.components
    points = as_points(landmarks, "landmarks", D)
    m = len(points)
    need = D + 1 if c == 1 else D
    if m < need:
        raise InputError(f"a spline needs at least {need} landmarks; got {m}")
    if np.abs(points).max() > FARTHEST:
        raise InputError(f"landmarks must lie within {FARTHEST:g} mm; got one at {np.abs(points).max():g} mm")
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    scale = float(np.ptp(points, axis=0).max()) / 2 or 1.0
    x = (points - centre) / scale
    _refuse_degenerate(kernel, points, x, held)
    return points, x, centre, scale


def _apart(kernel: Kernel, held: NDArray[np.bool_] | None) -> tuple[Kernel, NDArray[np.bool_] | None]:
    """Return the kernel with D components, and what is held, where some landmark leaves a component free; else None for that."""
    return (kernel, None) if held is None or held.all() else (kernel.apart(), held)


def compliance(kernel: Kernel, stiffness: Floats) -> Floats:
    """Return the diagonal that a stiffness adds to K in unconditioned mm: 16 pi / k (8 pi / k for the thin plate in space).

    A kernel solves an equation whose right side is `Kernel.per_spring` times the point load, so a spring of stiffness k
    between target and field adds that over k.
    """
    added: Floats = kernel.per_spring / stiffness
    return added


def _refuse_degenerate(kernel: Kernel, points: Floats, x: Floats, held: NDArray[np.bool_] | None) -> None:
    pairs = cKDTree(x).query_pairs(1e-9)
    if pairs:
        i, j = min(pairs)
        raise InputError(
            f"landmarks {i} and {j} coincide at ({', '.join(f'{x:g}' for x in points[i])}) mm; keep one of them"
        )
    motions = kernel.polynomial(x)
    if held is not None:
        motions = motions[held.T.ravel()]
    singular = np.linalg.svd(motions, compute_uv=False)
    if len(singular) < motions.shape[1] or singular[-1] < 1e-9 * singular[0]:
        plate = kernel.components == 1 or isinstance(kernel, Apart)
        flat = "in one plane" if kernel.dimension == 3 and plate else "on one line"
        flat = flat if held is None else f"{flat} in some direction"
        raise InputError(
            f"the {len(points)} landmarks lie {flat}, so a spline is not determined; add one beside it"
        )


def _as_blocks(vectors: Floats, c: int) -> Floats:
    """(m, D) vectors as the right-hand side of a kernel with c components."""
    return vectors if c == 1 else vectors.T.reshape(-1, 1)


def _as_vectors(blocks: Floats, c: int) -> Floats:
    """Inverse of `_as_blocks`."""
    return blocks if c == 1 else np.ascontiguousarray(blocks.reshape(c, -1).T)
