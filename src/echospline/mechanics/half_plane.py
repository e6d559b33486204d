"""Closed forms of plane elasticity: the field of a force below a top that is free, slides or is clamped.

Kelvin's solution of a force in the plane, spread over a small blob, plus an image of the force above the top. The image
is exact for a point force: Melan's (1932) where the top is free, the mirrored force where it slides, and where it
is clamped the one that follows in the same way from the potentials of Kolosov and Muskhelishvili. With z = x + i y (y the depth
below the top), z0 the place of the force F = F_x + i F_y, c its depth, w = z - conj(z0) and kappa = 3 - 4 nu, the image is

    phi = (kappa F ln w + 2 i c conj(F) / w + e^2 conj(F) / w^2) / b,    b = -1 (free) or kappa (clamped),
    2 mu u = kappa phi - 2 i y conj(phi') + b F conj(ln w),

up to the factor 1 / (2 pi (1 + kappa)); it comes from asking that phi + z conj(phi') + conj(psi) (no traction) or kappa phi -
z conj(phi') - conj(psi) (no displacement) of force and image together vanish on y = 0. The term with e^2 is the image of the
blob's own second moment, e^2 / 4 times the Laplacian of the field.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import pi
from typing import Literal

import numpy as np

from echospline.errors import InputError
from echospline.scene import Floats, Tissue

Top = Literal["free", "sliding", "clamped"]

SHALLOWEST = 1.0
"""Least depth of a force below a free or clamped top, in radii of its blob; shallower, the blob would stick out of the tissue
and the image, which is that of a point, would have its pole at the surface."""


@dataclass(frozen=True)
class HalfPlane:
    """Homogeneous tissue below a straight top, or without end.

    Parameters
    ----------
    young : float
        E, kPa.
    poisson : float
        nu.
    thickness : float
        Across the plane, mm.
    plane : {"stress", "strain"}
        Equation (19), or no strain across the plane.
    top : {"free", "sliding", "clamped"}, optional
        What the surface is; none: the plane has no end.
    surface : float
        Depth of the top, mm.
    """

    young: float
    poisson: float
    thickness: float
    plane: Literal["stress", "strain"] = "stress"
    top: Top | None = None
    surface: float = 0.0

    def __post_init__(self) -> None:
        if self.plane == "strain" and not self.poisson < 0.5:
            raise InputError(f"Poisson's ratio in plane strain must be below 0.5; got {self.poisson}")

    @classmethod
    def of(
        cls, tissue: Tissue, young: float, poisson: float, top: Top | None, surface: float = 0.0
    ) -> HalfPlane:
        """Return tissue of one modulus, of the thickness and plane of a slab with regions."""
        return cls(young, poisson, tissue.thickness, tissue.plane, top, surface)

    @property
    def nu(self) -> float:
        """Poisson's ratio of the equivalent plane strain."""
        return self.poisson / (1.0 + self.poisson) if self.plane == "stress" else self.poisson

    @property
    def stiffness(self) -> float:
        """Shear modulus times thickness, N/mm."""
        return 1e-3 * self.young / (2.0 * (1.0 + self.poisson)) * self.thickness

    @property
    def scale(self) -> float:
        """1 / (8 pi mu (1 - nu) thickness), mm/N."""
        return 1.0 / (8.0 * pi * self.stiffness * (1.0 - self.nu))

    def displacement(self, points: Floats, sources: Floats, radius: float = 0.0) -> Floats:
        """Displacement by unit forces.

        Parameters
        ----------
        points : ndarray, shape (n, 2)
            Where, mm; not above the top.
        sources : ndarray, shape (m, 2)
            Where the forces act, mm; not above the top.
        radius : float
            e, mm: the force is spread with the density 2 e^4 / (pi (r^2 + e^2)^3). 0 is a point force.

        Returns
        -------
        ndarray, shape (2 n, 2 m), mm/N
            Interleaved on both sides; fixed up to a rigid motion that the top allows.
        """
        K = np.empty((len(points), 2, len(sources), 2))
        dx, y, c = self._places(points, sources, radius)
        xx, yy, xy = self._kelvin(dx, y - c, radius)
        yx = xy
        if self.top == "sliding":
            mirrored = self._kelvin(dx, y + c, radius)
            xx, yy, xy, yx = xx + mirrored[0], yy - mirrored[1], xy - mirrored[2], yx + mirrored[2]
        elif self.top is not None:
            image = self._image(dx, y, c, radius)
            xx, yy, xy, yx = xx + image[0], yy + image[1], xy + image[2], yx + image[3]
        s = self.scale
        K[:, 0, :, 0], K[:, 1, :, 1], K[:, 0, :, 1], K[:, 1, :, 0] = s * xx, s * yy, s * xy, s * yx
        return K.reshape(2 * len(points), 2 * len(sources))

    def traction(self, points: Floats, normals: Floats, sources: Floats, radius: float = 0.0) -> Floats:
        """Traction times thickness by unit forces.

        Parameters
        ----------
        points : ndarray, shape (n, 2)
            Where, mm; not above the top.
        normals : ndarray, shape (n, 2)
            Unit normals, out of the tissue that the traction pulls.
        sources : ndarray, shape (m, 2)
            Where the forces act, mm; not above the top.
        radius : float
            As for `displacement`.

        Returns
        -------
        ndarray, shape (2 n, 2 m), 1/mm
            N per mm of boundary per N, interleaved on both sides.
        """
        dx, y, c = self._places(points, sources, radius)
        T = self._kelvin_traction(dx, y - c, normals, radius)
        if self.top == "sliding":
            T = T + self._kelvin_traction(dx, y + c, normals, radius) * np.array([1.0, -1.0])
        elif self.top is not None:
            T = T + self._image_traction(dx, y, c, normals, radius)
        return T.reshape(2 * len(points), 2 * len(sources))

    def rigid_motions(self, points: Floats, centre: Floats, size: float) -> Floats:
        """Motions as a whole that the top allows, shape (2 n, r), each as large as the field of 1 N.

        Shift in x, shift in y and rotation about ``centre`` where the top is free or absent; a shift in x alone where it slides;
        none where it is clamped. ``size`` in mm makes the rotation a displacement.
        """
        R = np.zeros((len(points), 2, 3))
        R[:, 0, 0] = R[:, 1, 1] = 1.0
        R[:, 0, 2], R[:, 1, 2] = -(points[:, 1] - centre[1]) / size, (points[:, 0] - centre[0]) / size
        kept = {"free": 3, "sliding": 1, "clamped": 0, None: 3}[self.top]
        return self.scale * R[:, :, :kept].reshape(2 * len(points), kept)

    @cached_property
    def steepest(self) -> float:
        """Largest |grad u| (spectral norm) under a blob, times E e thickness / F: what says when a force folds tissue."""
        q = np.linspace(0.0, 4.0, 81)
        dx, dy = (a.ravel()[:, None] for a in np.meshgrid(q, q))
        G = self._kelvin_gradient(dx, dy, 1.0)[:, 0, :, :, 0]
        largest = float(np.linalg.norm(G, 2, axis=(1, 2)).max())
        return largest * self.scale * 1e-3 * self.young * self.thickness

    def _places(self, points: Floats, sources: Floats, radius: float) -> tuple[Floats, Floats, Floats]:
        """Distance along x (n, m), depth of the points (n, 1) and of the sources (1, m) below the top."""
        dx = points[:, 0, None] - sources[None, :, 0]
        y, c = points[:, 1, None] - self.surface, sources[None, :, 1] - self.surface
        if self.top in ("free", "clamped"):
            c = np.maximum(c, SHALLOWEST * radius)
        return dx, y, c

    def _kelvin(self, dx: Floats, dy: Floats, radius: float) -> tuple[Floats, Floats, Floats]:
        """Return xx, yy and xy of a blob in the endless plane, times 8 pi mu (1 - nu)."""
        e2 = radius * radius
        inverse = 1.0 / (dx * dx + dy * dy + e2)
        diagonal = 0.5 * (3.0 - 4.0 * self.nu) * np.log(inverse)
        if e2:
            diagonal += (2.0 * (1.0 - self.nu) * e2) * inverse
        x = dx * inverse
        return diagonal + dx * x, diagonal + dy * dy * inverse, dy * x

    def _image(
        self, dx: Floats, y: Floats, c: Floats, radius: float
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return xx, yy, xy and yx of the image above a free or clamped top: the module's formula in real numbers."""
        a = 3.0 - 4.0 * self.nu
        Y = y + c
        inverse = 1.0 / (dx * dx + Y * Y)
        x, d = dx * inverse, Y * inverse  # 1 / w = x - i d
        even, odd = x * x - d * d, 2.0 * x * d  # 1 / w^2 = even - i odd
        cy = 2.0 * c * y
        if self.top == "free":
            b = -1.0
            log = 0.25 * (a * a + 1.0) * np.log(inverse)
            both, turn = (
                a * dx * (y - c) * inverse,
                4.0 * (1.0 - self.nu) * (1.0 - 2.0 * self.nu) * np.arctan2(dx, Y),
            )
            swap = cy * odd - turn
            xx, yy = log + a * dx * x - cy * even, log + a * Y * d - cy * even
        else:
            b = a
            log = -0.5 * a * np.log(inverse)
            both, swap = -(y - c) * x, -(cy / a) * odd
            xx, yy = log - dx * x + (cy / a) * even, log - Y * d + (cy / a) * even
        xy, yx = both + swap, both - swap
        if radius:
            share = radius * radius / (2.0 * b)
            up, side = (
                4.0 * y * (even * d + odd * x),
                4.0 * y * (even * x - odd * d),
            )  # 4 y Im, 4 y Re of w^3 / |w|^6
            xx, yy = xx + share * (a * even - up), yy - share * (a * even + up)
            xy, yx = xy - share * (a * odd + side), yx - share * (a * odd - side)
        return xx, yy, xy, yx

    def _kelvin_gradient(self, dx: Floats, dy: Floats, radius: float) -> Floats:
        """Derivative along k of component i by force j in the endless plane, shape (n, m, i, k, j), unscaled."""
        e2, unit = radius * radius, np.eye(2)
        d = np.stack([dx, np.broadcast_to(dy, dx.shape)], axis=-1)
        q = 1.0 / ((d * d).sum(axis=-1) + e2)
        along = -(3.0 - 4.0 * self.nu) * q - 4.0 * (1.0 - self.nu) * e2 * q * q
        G: Floats = np.einsum("nm,nmk,ij->nmikj", along, d, unit)
        G += np.einsum("nm,ik,nmj->nmikj", q, unit, d) + np.einsum("nm,jk,nmi->nmikj", q, unit, d)
        G -= np.einsum("nm,nmi,nmj,nmk->nmikj", 2.0 * q * q, d, d, d)
        return G

    def _kelvin_traction(self, dx: Floats, dy: Floats, normals: Floats, radius: float) -> Floats:
        """Traction of a blob in the endless plane, shape (n, 2, m, 2): Hooke's law of `_kelvin_gradient`, written out."""
        e2, n = radius * radius, normals.T[:, :, None]
        d = np.broadcast_arrays(dx, dy)
        q = 1.0 / (d[0] * d[0] + d[1] * d[1] + e2)
        along = -(3.0 - 4.0 * self.nu) * q - 4.0 * (1.0 - self.nu) * e2 * q * q
        lam = 2.0 * self.nu / (1.0 - 2.0 * self.nu)  # over mu
        volume = 2.0 * q + lam * (along + q + 2.0 * e2 * q * q)
        dn = d[0] * n[0] + d[1] * n[1]
        T = np.empty((len(normals), 2, q.shape[1], 2))
        for i in (0, 1):
            for j in (0, 1):
                t = (along + q) * n[j] * d[i] + volume * n[i] * d[j] - 4.0 * q * q * dn * d[i] * d[j]
                T[:, i, :, j] = t + (along + q) * dn if i == j else t
        return T * (self.scale * self.stiffness)

    def _image_traction(self, dx: Floats, y: Floats, c: Floats, normals: Floats, radius: float) -> Floats:
        """Traction of the image, shape (n, 2, m, 2): 2 Re(phi') n - (z conj(phi'') + conj(psi')) conj(n)."""
        a, e2 = 3.0 - 4.0 * self.nu, radius * radius
        b = -1.0 if self.top == "free" else a
        n = (normals[:, 0] + 1j * normals[:, 1])[:, None]
        w = np.reciprocal((dx + 1j * (y + c)).astype(np.complex128))
        T = np.empty((len(normals), 2, dx.shape[1], 2))
        for j, F in enumerate((1.0, 1j)):
            G = complex(F).conjugate()
            first = (a * F * w - 2j * c * G * w**2 - 2.0 * e2 * G * w**3) / b
            second = (-a * F * w**2 + 4j * c * G * w**3 + 6.0 * e2 * G * w**4) / b
            t = 2.0 * first.real * n + (
                np.conj(first) + b * F * np.conj(w) - 2j * y * np.conj(second)
            ) * np.conj(n)
            T[:, 0, :, j], T[:, 1, :, j] = t.real, t.imag
        traction: Floats = T / (2.0 * pi * (1.0 + a))
        return traction
