"""Kernels of landmark splines: what one landmark does to a point elsewhere.

Two are here. `ThinPlate` is the paper's, equation (3): one scalar serves both components of the displacement.
`Elastic` is the regularised fundamental solution of plane elasticity: a 2 x 2 matrix couples them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from echospline.errors import InputError
from echospline.scene import Floats


class Kernel(Protocol):
    """What a spline needs to know of its kernel.

    Matrices are laid out in blocks: with two components, all x rows (columns) stand before all y rows.
    """

    @property
    def components(self) -> int:
        """c: 1 where one scalar serves x and y alike, 2 where a 2 x 2 matrix couples them."""
        ...

    @property
    def length_power(self) -> int:
        """Power of length that the kernel's values carry (2: mm^2, 0: none)."""
        ...

    def scaled(self, length: float) -> Kernel:
        """Return the kernel for coordinates divided by ``length`` mm."""
        ...

    def matrix(self, points: Floats, sources: Floats) -> Floats:
        """Response at points (n, 2) to unit weights at sources (m, 2), shape (n c, m c)."""
        ...

    def gradient(self, points: Floats, sources: Floats) -> Floats:
        """Derivatives of `matrix` by the point's x and y, shape (2, n c, m c)."""
        ...

    def polynomial(self, points: Floats) -> Floats:
        """Motions that cost no energy, shape (n c, p)."""
        ...

    def polynomial_gradient(self, points: Floats) -> Floats:
        """Derivatives of `polynomial` by x and y, shape (2, n c, p)."""
        ...


def _offsets(points: Floats, sources: Floats) -> tuple[Floats, Floats, Floats]:
    """Offsets dx, dy and squared distance r^2 from every source to every point, each (n, m)."""
    dx = points[:, 0, None] - sources[None, :, 0]
    dy = points[:, 1, None] - sources[None, :, 1]
    return dx, dy, dx * dx + dy * dy


def _log(r2: Floats) -> Floats:
    """Return ln r^2, and 0 where r = 0: every use multiplies it by a power of r that vanishes there."""
    return np.log(r2, out=np.zeros_like(r2), where=r2 > 0)


@dataclass(frozen=True)
class ThinPlate:
    """U(r) = r^2 ln r^2, equation (3), with the affine motions of equation (5)."""

    components: int = 1
    length_power: int = 2

    def scaled(self, length: float) -> ThinPlate:
        """Return itself: a change of unit adds r^2 times a constant, which the side conditions turn affine."""
        return self

    def matrix(self, points: Floats, sources: Floats) -> Floats:
        """U(r), shape (n, m), equation (4)."""
        _, _, r2 = _offsets(points, sources)
        return r2 * _log(r2)

    def gradient(self, points: Floats, sources: Floats) -> Floats:
        """dU/dx = 2 dx (ln r^2 + 1), shape (2, n, m)."""
        dx, dy, r2 = _offsets(points, sources)
        slope = 2.0 * (_log(r2) + 1.0)
        return np.stack([dx * slope, dy * slope])

    def polynomial(self, points: Floats) -> Floats:
        """Rows (1, x, y), the matrix R of equation (5), shape (n, 3)."""
        return np.column_stack([np.ones(len(points)), points])

    def polynomial_gradient(self, points: Floats) -> Floats:
        """Return the derivatives of R, shape (2, n, 3)."""
        gradient = np.zeros((2, len(points), 3))
        gradient[0, :, 1] = gradient[1, :, 2] = 1.0
        return gradient


@dataclass(frozen=True)
class Elastic:
    """Regularised fundamental solution of plane elasticity (Kelvin), with rigid motions.

    With phi = s ln s, s = r^2 + radius^2, the field of a force f is
    -(lap(phi) I - c grad grad(phi)) f with c = 1 / (2 (1 - nu)) (Papkovich and Neuber's form; elastic body
    splines: Davis et al. 1997; regularised Kelvinlets: de Goes and James 2017). The factor 1 / (16 pi mu)
    goes into the weights.

    Parameters
    ----------
    nu : float
        Poisson's ratio of the tissue, 0 <= nu <= 0.5, in plane strain below 0.5.
    radius : float
        Regularisation length, mm, positive.
    plane : {"stress", "strain"}
        Plane stress uses nu / (1 + nu) in the plane-strain solution.

    Raises
    ------
    InputError
        If nu or radius is out of its range.
    """

    nu: float = 0.45
    radius: float = 1.0
    plane: Literal["stress", "strain"] = "stress"
    components: int = 2
    length_power: int = 0

    def __post_init__(self) -> None:
        if not (0.0 <= self.nu <= 0.5 if self.plane == "stress" else 0.0 <= self.nu < 0.5):
            closing = "]" if self.plane == "stress" else ")"
            raise InputError(
                f"nu (Poisson's ratio) must lie in [0, 0.5{closing} in plane {self.plane}; got {self.nu}"
            )
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise InputError(
                f"radius of the elastic kernel must be a positive number in mm; got {self.radius}"
            )
        if self.plane not in ("stress", "strain"):
            raise InputError(f'plane is "stress" or "strain"; got {self.plane!r}')

    @property
    def coupling(self) -> float:
        """c = 1 / (2 (1 - nu)), with the effective nu of plane stress."""
        nu = self.nu / (1.0 + self.nu) if self.plane == "stress" else self.nu
        return 1.0 / (2.0 * (1.0 - nu))

    def scaled(self, length: float) -> Elastic:
        """Return the kernel for coordinates divided by ``length``; the constant that this adds does no work."""
        return Elastic(self.nu, self.radius / length, self.plane)

    def matrix(self, points: Floats, sources: Floats) -> Floats:
        """-(lap(phi) I - c grad grad(phi)), shape (2 n, 2 m)."""
        dx, dy, r2 = _offsets(points, sources)
        s = r2 + self.radius**2
        c = self.coupling
        isotropic = -(4.0 - 2.0 * c) * (np.log(s) + 1.0) - 4.0 * r2 / s
        return np.block(
            [
                [isotropic + 4.0 * c * dx * dx / s, 4.0 * c * dx * dy / s],
                [4.0 * c * dx * dy / s, isotropic + 4.0 * c * dy * dy / s],
            ]
        )

    def gradient(self, points: Floats, sources: Floats) -> Floats:
        """Derivatives of `matrix` by x and y, shape (2, 2 n, 2 m)."""
        dx, dy, r2 = _offsets(points, sources)
        s = r2 + self.radius**2
        c = self.coupling

        def by(offset: Floats, ex: float, ey: float) -> Floats:
            # d/dx of ln s is 2 dx / s; of r^2 / s is 2 dx radius^2 / s^2; of a b / s by the product rule
            iso = -(4.0 - 2.0 * c) * 2.0 * offset / s - 8.0 * offset * self.radius**2 / s**2
            xx = 4.0 * c * (2.0 * ex * dx / s - 2.0 * dx * dx * offset / s**2)
            yy = 4.0 * c * (2.0 * ey * dy / s - 2.0 * dy * dy * offset / s**2)
            xy = 4.0 * c * ((ex * dy + ey * dx) / s - 2.0 * dx * dy * offset / s**2)
            return np.block([[iso + xx, xy], [xy, iso + yy]])

        return np.stack([by(dx, 1.0, 0.0), by(dy, 0.0, 1.0)])

    def polynomial(self, points: Floats) -> Floats:
        """Rigid motions: shift in x, shift in y, rotation, shape (2 n, 3)."""
        one, zero = np.ones(len(points)), np.zeros(len(points))
        return np.vstack(
            [np.column_stack([one, zero, -points[:, 1]]), np.column_stack([zero, one, points[:, 0]])]
        )

    def polynomial_gradient(self, points: Floats) -> Floats:
        """Return the derivatives of the rigid motions, shape (2, 2 n, 3)."""
        n = len(points)
        gradient = np.zeros((2, 2 * n, 3))
        gradient[0, n:, 2] = 1.0
        gradient[1, :n, 2] = -1.0
        return gradient
