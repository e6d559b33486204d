"""A landmark that moves at every step: interpolation of its column inside a small patch around it.

The tip's column of G changes with every pose, and computing it afresh costs more than the whole remaining step. Seen
from far away it is a smooth function of the tip, so inside a square patch a polynomial in the tip's position carries it;
close by, where U(r) is rough, the difference between U and its interpolant is added exactly. The field's own residual
(the column less what the contacts already explain) is interpolated, not the column: that is small where contacts are
near, and so nothing cancels in single precision.
"""

from __future__ import annotations

import numpy as np

from echospline.scene import Floats

DEGREE = 3
"""Total degree of the interpolant: 10 points."""

HALF_WIDTH = 0.2
"""mm; half the side of a patch."""

NEAR = 20.0
"""Half-widths around the centre within which kernels are evaluated exactly."""

SMALLEST = 0.02
"""mm; a patch smaller than this is not worth building: the column is evaluated directly."""


def padua(degree: int) -> Floats:
    """Points of the square [-1, 1]^2 that determine a polynomial of that total degree well (Padua points).

    Caliari, De Marchi and Vianello, Bivariate polynomial interpolation on the square at new nodal sets, 2005.
    """
    return np.array(
        [
            (np.cos(i * np.pi / degree), np.cos(j * np.pi / (degree + 1)))
            for i in range(degree + 1)
            for j in range(degree + 2)
            if (i + j) % 2 == 0
        ]
    )


def chebyshev(points: Floats, degree: int) -> Floats:
    """Products of Chebyshev polynomials T_i(x) T_j(y), i + j <= degree, shape (n, (degree + 1)(degree + 2) / 2)."""

    def values(t: Floats) -> list[Floats]:
        T = [np.ones_like(t), t]
        for _ in range(degree - 1):
            T.append(2.0 * t * T[-1] - T[-2])
        return T

    X, Y = values(points[:, 0]), values(points[:, 1])
    return np.stack([X[i] * Y[j] for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


NODES = padua(DEGREE)
COEFFICIENTS = np.linalg.inv(chebyshev(NODES, DEGREE))

PARTS = 10
"""Steps that build a patch, a share of the points each."""

AHEAD = PARTS + 2
"""Steps before a tip leaves its patch that the next one is begun: one to begin, one to spare."""

LASTS = 6
"""Steps that a tip needs at least for half a width: a faster one costs less without patches, one row a step."""
