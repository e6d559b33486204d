"""Kernels of landmark splines: what one landmark does to a point elsewhere, in the plane and in space.

Two are here. `ThinPlate` is the paper's, equation (3): one scalar serves all components of the displacement (`Apart` is the same
where landmarks hold some components and leave others free). `Elastic` is the regularised fundamental solution of elasticity: a
matrix couples the components.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from echospline.errors import InputError
from echospline.scene import Floats

Dimension = Literal[2, 3]

TURNS = {2: ((0, 1),), 3: ((0, 1), (1, 2), (2, 0))}
"""Axes (a, b) of the plane in which each rigid rotation turns a towards b."""


class Kernel(Protocol):
    """What a spline needs to know of its kernel.

    Matrices are laid out in blocks: with c components, all x rows (columns) stand before all y rows (and those before z).
    D is the dimension.
    """

    @property
    def dimension(self) -> Dimension:
        """D: 2 in the plane, 3 in space."""
        ...

    @property
    def components(self) -> int:
        """c: 1 where one scalar serves all components alike, D where a D x D matrix couples them."""
        ...

    @property
    def length_power(self) -> int:
        """Power of length that the kernel's values carry (2: mm^2, 0: none)."""
        ...

    @property
    def per_spring(self) -> float:
        """Right side of the kernel's equation, over the point load: a spring of stiffness k adds this over k to K."""
        ...

    def scaled(self, length: float) -> Kernel:
        """Return the kernel for coordinates divided by ``length`` mm."""
        ...

    def apart(self) -> Kernel:
        """Return the same kernel with D components, for landmarks that hold some components and leave others free."""
        ...

    def matrix(self, points: Floats, sources: Floats) -> Floats:
        """Response at points (n, D) to unit weights at sources (m, D), shape (n c, m c)."""
        ...

    def gradient(self, points: Floats, sources: Floats) -> Floats:
        """Derivatives of `matrix` by the point's coordinates, shape (D, n c, m c)."""
        ...

    def polynomial(self, points: Floats) -> Floats:
        """Motions that cost no energy, shape (n c, p)."""
        ...

    def polynomial_gradient(self, points: Floats) -> Floats:
        """Derivatives of `polynomial` by the coordinates, shape (D, n c, p)."""
        ...


def _offsets(points: Floats, sources: Floats) -> tuple[Floats, Floats]:
    """Offsets (D, n, m) and squared distance r^2 (n, m) from every source to every point."""
    offset = points.T[:, :, None] - sources.T[:, None, :]
    return offset, (offset * offset).sum(axis=0)


def _log(r2: Floats) -> Floats:
    """Return ln r^2, and 0 where r = 0: every use multiplies it by a power of r that vanishes there."""
    return np.log(r2, out=np.zeros_like(r2), where=r2 > 0)


def _check(dimension: int) -> None:
    if dimension not in (2, 3):
        raise InputError(f"dimension of a kernel is 2 (plane) or 3 (space); got {dimension}")


@dataclass(frozen=True)
class ThinPlate:
    """U(r) = r^2 ln r^2, equation (3), with the affine motions of equation (5); in space -r.

    The biharmonic equation has the solution r in space. Its sign is turned so that K is positive definite beside the
    side conditions, as that of r^2 ln r^2 is; the field of a spline does not depend on it.

    Parameters
    ----------
    dimension : {2, 3}
        Plane or space.

    Raises
    ------
    InputError
        If the dimension is another.
    """

    dimension: Dimension = 2

    def __post_init__(self) -> None:
        _check(self.dimension)

    @property
    def components(self) -> int:
        """1: a scalar serves all components."""
        return 1

    @property
    def length_power(self) -> int:
        """mm^2 in the plane, mm in space."""
        return 2 if self.dimension == 2 else 1

    @property
    def per_spring(self) -> float:
        """16 pi in the plane, 8 pi in space."""
        return 16.0 * np.pi if self.dimension == 2 else 8.0 * np.pi

    def scaled(self, length: float) -> ThinPlate:
        """Return itself: a change of unit adds r^2 times a constant, which the side conditions turn affine, or only scales."""
        return self

    def apart(self) -> Apart:
        """Return the kernel that treats the components apart."""
        return Apart(self)

    def matrix(self, points: Floats, sources: Floats) -> Floats:
        """U(r), shape (n, m), equation (4)."""
        _, r2 = _offsets(points, sources)
        U: Floats = r2 * _log(r2) if self.dimension == 2 else -np.sqrt(r2)
        return U

    def gradient(self, points: Floats, sources: Floats) -> Floats:
        """dU/dx = 2 dx (ln r^2 + 1), in space -dx / r and 0 at the source itself, shape (D, n, m)."""
        offset, r2 = _offsets(points, sources)
        if self.dimension == 2:
            return offset * (2.0 * (_log(r2) + 1.0))
        r = np.sqrt(r2)
        return -offset * np.divide(1.0, r, out=np.zeros_like(r), where=r > 0)

    def polynomial(self, points: Floats) -> Floats:
        """Rows (1, x, y[, z]), the matrix R of equation (5), shape (n, D + 1)."""
        return np.column_stack([np.ones(len(points)), points])

    def polynomial_gradient(self, points: Floats) -> Floats:
        """Return the derivatives of R, shape (D, n, D + 1)."""
        D = self.dimension
        gradient = np.zeros((D, len(points), D + 1))
        for j in range(D):
            gradient[j, :, j + 1] = 1.0
        return gradient


@dataclass(frozen=True)
class Apart:
    """A thin plate per component of the displacement, each with anchors of its own.

    Where all landmarks hold every component this gives the numbers of `ThinPlate`, at D^2 times the work.

    Parameters
    ----------
    plate : ThinPlate
        The scalar kernel.
    """

    plate: ThinPlate

    @property
    def dimension(self) -> Dimension:
        """That of the plate."""
        return self.plate.dimension

    @property
    def components(self) -> int:
        """D."""
        return self.plate.dimension

    @property
    def length_power(self) -> int:
        """That of the plate."""
        return self.plate.length_power

    @property
    def per_spring(self) -> float:
        """That of the plate."""
        return self.plate.per_spring

    def scaled(self, length: float) -> Apart:
        """Return itself, as the plate does."""
        return self

    def apart(self) -> Apart:
        """Return itself."""
        return self

    def matrix(self, points: Floats, sources: Floats) -> Floats:
        """U(r) for every component, no component acting on another, shape (D n, D m)."""
        return self._each(self.plate.matrix(points, sources))

    def gradient(self, points: Floats, sources: Floats) -> Floats:
        """Derivatives of `matrix` by the coordinates, shape (D, D n, D m)."""
        return np.stack([self._each(by) for by in self.plate.gradient(points, sources)])

    def polynomial(self, points: Floats) -> Floats:
        """Affine motions of every component, shape (D n, D (D + 1))."""
        return self._each(self.plate.polynomial(points))

    def polynomial_gradient(self, points: Floats) -> Floats:
        """Return the derivatives of the affine motions, shape (D, D n, D (D + 1))."""
        return np.stack([self._each(by) for by in self.plate.polynomial_gradient(points)])

    def _each(self, block: Floats) -> Floats:
        """Blocks along a diagonal, one per component."""
        blocks: Floats = np.kron(np.eye(self.dimension), block).astype(np.float64, copy=False)
        return blocks


@dataclass(frozen=True)
class Elastic:
    """Regularised fundamental solution of elasticity (Kelvin), with rigid motions; 16 pi mu goes into the weights.

    Plane: with phi = s ln s, s = r^2 + radius^2, the field of a force f is -(lap(phi) I - c grad grad(phi)) f with
    c = 1 / (2 (1 - nu)) (Papkovich and Neuber's form; elastic body splines: Davis et al. 1997).

    Space: the regularised Kelvinlet (de Goes and James 2017), with r_e = sqrt(r^2 + radius^2) and
    c = 1 / (1 - nu): ((4 - c) / r_e + 2 radius^2 / r_e^3) f + c x (x . f) / r_e^3.

    Parameters
    ----------
    nu : float
        Poisson's ratio of the tissue, 0 <= nu <= 0.5, in plane strain below 0.5.
    radius : float
        Regularisation length, mm, positive.
    plane : {"stress", "strain"}
        Plane stress uses nu / (1 + nu) in the plane-strain solution. In space it has no meaning.
    dimension : {2, 3}
        Plane or space.

    Raises
    ------
    InputError
        If nu or radius is out of its range, or plane or dimension is another.
    """

    nu: float = 0.45
    radius: float = 1.0
    plane: Literal["stress", "strain"] = "stress"
    dimension: Dimension = 2

    def __post_init__(self) -> None:
        _check(self.dimension)
        if self.plane not in ("stress", "strain"):
            raise InputError(f'plane is "stress" or "strain"; got {self.plane!r}')
        strain = self.dimension == 2 and self.plane == "strain"
        if not (0.0 <= self.nu < 0.5 if strain else 0.0 <= self.nu <= 0.5):
            where = f" in plane {self.plane}" if self.dimension == 2 else ""
            raise InputError(
                f"nu (Poisson's ratio) must lie in [0, 0.5{')' if strain else ']'}{where}; got {self.nu}"
            )
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise InputError(
                f"radius of the elastic kernel must be a positive number in mm; got {self.radius}"
            )

    @property
    def components(self) -> int:
        """D: a matrix couples the components."""
        return self.dimension

    @property
    def length_power(self) -> int:
        """None in the plane, 1 / mm in space."""
        return 0 if self.dimension == 2 else -1

    @property
    def per_spring(self) -> float:
        """16 pi."""
        return 16.0 * np.pi

    @property
    def coupling(self) -> float:
        """c = 1 / (2 (1 - nu)), with the effective nu of plane stress; in space 1 / (1 - nu)."""
        if self.dimension == 3:
            return 1.0 / (1.0 - self.nu)
        nu = self.nu / (1.0 + self.nu) if self.plane == "stress" else self.nu
        return 1.0 / (2.0 * (1.0 - nu))

    def scaled(self, length: float) -> Elastic:
        """Return the kernel for coordinates divided by ``length``; the constant or factor that this adds does no work."""
        return replace(self, radius=self.radius / length)

    def apart(self) -> Elastic:
        """Return itself: it has D components."""
        return self

    def matrix(self, points: Floats, sources: Floats) -> Floats:
        """Field of unit forces, (own I + both x x') per point and source, shape (D n, D m)."""
        offset, r2 = _offsets(points, sources)
        own, both = self._parts(r2)
        D = self.dimension
        return np.block(
            [[both * offset[a] * offset[b] + (own if a == b else 0.0) for b in range(D)] for a in range(D)]
        )

    def gradient(self, points: Floats, sources: Floats) -> Floats:
        """Derivatives of `matrix` by the coordinates, shape (D, D n, D m)."""
        offset, r2 = _offsets(points, sources)
        _, both = self._parts(r2)
        own_slope, both_slope = self._slopes(r2)
        D = self.dimension

        def entry(a: int, b: int, k: int) -> Floats:
            # the product rule for both x_a x_b; d/dx_k of a function of r^2 is 2 x_k times its slope
            by: Floats = 2.0 * both_slope * offset[k] * offset[a] * offset[b]
            if a == b:
                by += 2.0 * own_slope * offset[k]
            if a == k:
                by += both * offset[b]
            if b == k:
                by += both * offset[a]
            return by

        return np.stack([np.block([[entry(a, b, k) for b in range(D)] for a in range(D)]) for k in range(D)])

    def _parts(self, r2: Floats) -> tuple[Floats, Floats]:
        """Functions of r^2 that stand before I and before x x'."""
        c, e2 = self.coupling, self.radius**2
        s = r2 + e2
        if self.dimension == 2:
            return -(4.0 - 2.0 * c) * (np.log(s) + 1.0) - 4.0 * r2 / s, 4.0 * c / s
        p = 1.0 / np.sqrt(s)
        return (4.0 - c) * p + 2.0 * e2 * p**3, c * p**3

    def _slopes(self, r2: Floats) -> tuple[Floats, Floats]:
        """Derivatives of `_parts` by r^2."""
        c, e2 = self.coupling, self.radius**2
        s = r2 + e2
        if self.dimension == 2:
            return -(4.0 - 2.0 * c) / s - 4.0 * e2 / s**2, -4.0 * c / s**2
        p = 1.0 / np.sqrt(s)
        return -0.5 * (4.0 - c) * p**3 - 3.0 * e2 * p**5, -1.5 * c * p**5

    def polynomial(self, points: Floats) -> Floats:
        """Rigid motions: shifts, then rotations, shape (D n, 3) in the plane and (D n, 6) in space."""
        n, D = len(points), self.dimension
        motions = np.zeros((D, n, D + len(TURNS[D])))
        for a in range(D):
            motions[a, :, a] = 1.0
        for j, (a, b) in enumerate(TURNS[D], start=D):
            motions[a, :, j], motions[b, :, j] = -points[:, b], points[:, a]
        return motions.reshape(D * n, motions.shape[2])

    def polynomial_gradient(self, points: Floats) -> Floats:
        """Return the derivatives of the rigid motions, shape (D, D n, p)."""
        n, D = len(points), self.dimension
        gradient = np.zeros((D, D, n, D + len(TURNS[D])))
        for j, (a, b) in enumerate(TURNS[D], start=D):
            gradient[b, a, :, j], gradient[a, b, :, j] = -1.0, 1.0
        return gradient.reshape(D, D * n, gradient.shape[3])
