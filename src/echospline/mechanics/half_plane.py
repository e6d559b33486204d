"""Green's function of tissue under a free surface, clamped at anchors: one point force, its field everywhere.

`fundamental` is Kelvin's solution of plane elasticity plus, where there is a free surface, Melan's correction
that takes the traction off it (Melan 1932; in the form of Telles and Brebbia, Int. J. Solids Structures 17,
1981). `GreensFunction` holds anchors fast with forces of their own: the spline of `kernels.Elastic`, but driven by
forces instead of displacements, and with the surface where the probe's face leaves it free.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import lu_factor, lu_solve

from echospline.errors import InputError
from echospline.scene import Floats, as_points


def fundamental(
    points: Floats, sources: Floats, nu: float, radius: float, surface: float | None = None
) -> Floats:
    """Displacement by unit forces, times 8 pi mu (1 - nu).

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Where, mm; not above the surface.
    sources : ndarray, shape (m, 2)
        Where the forces act, mm; not above the surface.
    nu : float
        Poisson's ratio of plane strain; plane stress uses nu / (1 + nu) here.
    radius : float
        The force is spread over about this length, mm: r^2 becomes r^2 + radius^2.
    surface : float, optional
        Depth of the traction-free surface, mm; none: the plane has no end.

    Returns
    -------
    ndarray, shape (2 n, 2 m)
        Blocks [[xx, xy], [yx, yy]]: first the response's direction, then the force's. Fixed up to rigid motions.
    """
    a, eps2 = 3.0 - 4.0 * nu, radius * radius
    dx = points[:, 0, None] - sources[None, :, 0]
    dy = points[:, 1, None] - sources[None, :, 1]
    r2 = dx * dx + dy * dy + eps2
    log = -0.5 * a * np.log(r2)
    xx, yy, xy = log + dx * dx / r2, log + dy * dy / r2, dx * dy / r2
    if surface is None:
        return np.block([[xx, xy], [xy, yy]])
    y, c = points[:, 1, None] - surface, sources[None, :, 1] - surface
    Y = y + c  # depth below the image of the source
    R2 = dx * dx + Y * Y + eps2
    b = 8.0 * (1.0 - nu) ** 2 - a
    log = -0.5 * b * np.log(R2)
    bounce = 2.0 * c * y / R2
    xx += log + (a * dx * dx / R2) + bounce * (1.0 - 2.0 * dx * dx / R2)
    yy += log + (a * Y * Y / R2) - bounce * (1.0 - 2.0 * Y * Y / R2)
    shear = a * dx * dy / R2
    swap = 2.0 * bounce * Y * dx / R2 - 4.0 * (1.0 - nu) * (1.0 - 2.0 * nu) * np.arctan2(dx, Y)
    return np.block([[xx, xy + shear + swap], [xy + shear - swap, yy]])


def rigid_motions(points: Floats) -> Floats:
    """Shift in x, shift in y and rotation, shape (2 n, 3) in blocks."""
    one, zero = np.ones(len(points)), np.zeros(len(points))
    return np.block([[one, zero], [zero, one], [-points[:, 1], points[:, 0]]]).T


@dataclass(frozen=True)
class GreensFunction:
    """Field of point forces in homogeneous tissue that is held at anchors.

    Parameters
    ----------
    anchors : ndarray, shape (b, 2)
        Points that do not move, mm; two or more.
    young : float
        E, kPa.
    poisson : float
        nu.
    thickness : float
        mm.
    plane : {"stress", "strain"}
        Equation (19), or no strain across the plane.
    radius : float
        Over which a force is spread, mm.
    anchor_radius : float
        Over which an anchor's force is spread, mm. For anchors in a row, their spacing / (2 pi): the row then holds
        on average what a continuous clamp holds (the mean of ln |2 sin(pi x / spacing)| over a period is zero).
    surface : float, optional
        Depth of the free surface, mm.

    Raises
    ------
    InputError
        If anchors do not hold the tissue, or radius is not positive.
    """

    anchors: Floats
    young: float
    poisson: float
    thickness: float
    plane: str = "stress"
    radius: float = 0.4
    anchor_radius: float = 0.25
    surface: float | None = None

    def __post_init__(self) -> None:
        anchors = as_points(self.anchors, "anchors")
        if len(anchors) < 2:
            raise InputError(f"two or more anchors must hold the tissue; got {len(anchors)}")
        for radius in (self.radius, self.anchor_radius):
            if not (np.isfinite(radius) and radius > 0):
                raise InputError(f"radius of a force must be a positive number in mm; got {radius}")
        if self.plane == "strain" and not self.poisson < 0.5:
            raise InputError(f"Poisson's ratio in plane strain must be below 0.5; got {self.poisson}")

    @property
    def nu(self) -> float:
        """Poisson's ratio of the equivalent plane strain."""
        return self.poisson / (1.0 + self.poisson) if self.plane == "stress" else self.poisson

    @property
    def scale(self) -> float:
        """1 / (8 pi mu (1 - nu) thickness), mm/N."""
        mu = 1e-3 * self.young / (2.0 * (1.0 + self.poisson))
        return 1.0 / (8.0 * pi * mu * (1.0 - self.nu) * self.thickness)

    def projector(self, points: ArrayLike) -> Floats:
        """What the anchors' forces and the rigid motion do to points (n, 2), shape (2 n, 2 b + 3)."""
        p = self._below(points)
        border = np.hstack(
            [self._kernel(p, self.anchors, self.anchor_radius), rigid_motions(self._centred(p))]
        )
        solved: Floats = lu_solve(self._factors, border.T).T
        return solved

    def columns(self, points: ArrayLike, sources: ArrayLike, projector: Floats | None = None) -> Floats:
        """Displacement of points (n, 2) by unit forces at sources (m, 2), shape (2 n, 2 m) in blocks, mm/N.

        ``projector`` of the same points may be kept between calls: then the cost is one kernel evaluation and one
        product.
        """
        p, s = self._below(points), self._below(sources)
        M = self.projector(p) if projector is None else projector
        load = np.vstack([self._kernel(self.anchors, s, self.radius), rigid_motions(self._centred(s)).T])
        columns: Floats = self.scale * (self._kernel(p, s, self.radius) - M @ load)
        return columns

    @cached_property
    def _factors(self) -> Any:
        A = as_points(self.anchors, "anchors")
        R = rigid_motions(self._centred(A))
        L = np.block([[self._kernel(A, A, self.anchor_radius), R], [R.T, np.zeros((3, 3))]])
        return lu_factor(L)

    def _kernel(self, points: Floats, sources: Floats, radius: float) -> Floats:
        return fundamental(points, sources, self.nu, radius, self.surface)

    def _centred(self, points: Floats) -> Floats:
        # Rotations about the middle, in units of the scene's size, keep L well conditioned.
        low, high = np.min(self.anchors, axis=0), np.max(self.anchors, axis=0)
        centred: Floats = (points - (low + high) / 2) / max(float(np.max(high - low)), 1e-9)
        return centred

    def _below(self, points: ArrayLike) -> Floats:
        p = as_points(points)
        if self.surface is not None and (p[:, 1] < self.surface - 1e-9).any():
            raise InputError(
                f"there is no tissue above the surface at {self.surface:g} mm; got a point at {p[:, 1].min():g} mm"
            )
        return p
