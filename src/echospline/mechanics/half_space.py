"""Point forces in elastic space and half space: the closed forms that everything in three dimensions is built on.

x lateral, y depth, z elevation; the surface is y = 0 and tissue lies below it (y > 0). A force is spread over about a
length, the *radius*, as the Kelvinlet of F. de Goes and D. L. James (ACM Trans. Graphics 36, 2017) spreads it; the
image that makes the surface what it is stays a point's, for the source lies deeper than its radius.

- ``top=None``: the space has no end (Kelvin 1848).
- ``top="free"``: no traction on the surface (R. D. Mindlin, Physics 7, 1936).
- ``top="sliding"``: a frictionless face over the whole surface: skin under a probe. The mirrored force, its normal part turned
  round, holds the normal displacement at zero and shears nothing.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene import Floats

Top = Literal["free", "sliding"]


def kelvinlet(
    points: NDArray[Any], sources: Floats, nu: float, radius: float = 0.0, top: Top | None = None
) -> NDArray[Any]:
    """Displacement by unit forces, times 16 pi mu (1 - nu).

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Where, mm; complex numbers give derivatives (see `gradient`).
    sources : ndarray, shape (m, 3)
        Where the forces act, mm; with a top, below it.
    nu : float
        Poisson's ratio.
    radius : float
        Over which a force is spread, mm; 0 is a point.
    top : {"free", "sliding"}, optional
        What the surface y = 0 is.

    Returns
    -------
    ndarray, shape (n, 3, m, 3)
        First the response's direction, then the force's; mm per N after division by 16 pi mu (1 - nu), mu in N/mm^2.
    """
    a = 3.0 - 4.0 * nu
    d = points[:, None, :] - sources[None, :, :]
    c, y = sources[None, :, 1], points[:, 1, None]
    K = _spread(d, a, nu, radius)
    if top is None:
        return K
    mirrored = sources * np.array([1.0, -1.0, 1.0])
    D = points[:, None, :] - mirrored[None, :, :]
    if top == "sliding":
        K += _spread(D, a, nu, radius) * np.array([1.0, -1.0, 1.0])
        return K
    if top != "free":
        raise InputError(f"the top of a half space is free or sliding; got {top!r}")
    return _add_mindlin(K, D, d[..., 1], c, y, a, nu)


def _spread(d: NDArray[Any], a: float, nu: float, radius: float) -> NDArray[Any]:
    """Kelvinlet: [a / R + 2 (1 - nu) e^2 / R^3] f + d (d . f) / R^3 with R^2 = |d|^2 + e^2."""
    R2 = (d * d).sum(axis=-1) + radius * radius
    i1 = 1.0 / np.sqrt(R2)
    i3 = i1 / R2
    K = d[:, :, :, None] * d[:, :, None, :] * i3[:, :, None, None]
    direct = a * i1 + 2.0 * (1.0 - nu) * radius**2 * i3
    for i in range(3):
        K[:, :, i, i] += direct
    return np.ascontiguousarray(K.transpose(0, 2, 1, 3))


def _add_mindlin(
    K: NDArray[Any],
    D: NDArray[Any],
    dy: NDArray[Any],
    c: NDArray[Any],
    y: NDArray[Any],
    a: float,
    nu: float,
) -> NDArray[Any]:
    """Add what frees the surface: Mindlin's image at the mirrored source.

    With R the distance from the image, Y the depth below it, q = 1 / (R + Y), k = 4 (1 - nu)(1 - 2 nu) and h the horizontal
    part (x, z) of the distance.
    """
    Y = D[..., 1]
    R = np.sqrt((D * D).sum(axis=-1))
    j1 = 1.0 / R
    j3, k = j1**3, 4.0 * (1.0 - nu) * (1.0 - 2.0 * nu)
    j5, q, cy = j3 * j1**2, 1.0 / (R + Y), c * y
    A = j1 + 2.0 * cy * j3 + k * q
    B = a * j3 - 6.0 * cy * j5 - k * j1 * q * q
    s = a * dy * j3
    t = 6.0 * cy * Y * j5 - k * j1 * q
    for i in (0, 2):
        K[:, i, :, i] += A
        for j in (0, 2):
            K[:, i, :, j] += B * D[..., i] * D[..., j]
        K[:, i, :, 1] += D[..., i] * (s + t)
        K[:, 1, :, i] += D[..., i] * (s - t)
    K[:, 1, :, 1] += (8.0 * (1.0 - nu) ** 2 - a) * j1 + (a * Y * Y - 2.0 * cy) * j3 + 6.0 * cy * Y * Y * j5
    return K


def gradient(
    points: Floats, sources: Floats, nu: float, radius: float = 0.0, top: Top | None = None
) -> Floats:
    """Derivatives of `kelvinlet` with respect to the points, shape (n, 3, m, 3, 3): the last axis is the direction, 1/mm.

    Exact to rounding: the formulas hold for complex coordinates, and the imaginary part of a step of 1e-20 mm is the derivative.
    """
    step = 1e-20
    parts = [kelvinlet(points + 1j * step * unit, sources, nu, radius, top).imag / step for unit in np.eye(3)]
    return np.stack(parts, axis=-1)


def tractions(gradients: Floats, normals: Floats, nu: float) -> Floats:
    """Tractions on surfaces from displacement gradients, in units of mu.

    Parameters
    ----------
    gradients : ndarray, shape (n, 3, m, 3, 3)
        From `gradient`.
    normals : ndarray, shape (n, 3)
        Outward unit normals.
    nu : float
        Poisson's ratio.

    Returns
    -------
    ndarray, shape (n, 3, m, 3)
    """
    trace = np.einsum("nimji->nmj", gradients)
    shear = np.einsum("nimjk,nk->nimj", gradients, normals) + np.einsum("nkmji,nk->nimj", gradients, normals)
    pressure = 2.0 * nu / (1.0 - 2.0 * nu) * np.einsum("nmj,ni->nimj", trace, normals)
    traction: Floats = shear + pressure
    return traction
