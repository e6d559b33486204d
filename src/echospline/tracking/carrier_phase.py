"""Refinement of tracked axial motion by the phase of the carrier, where RF or IQ echoes are available.

The analytic echo of tissue that moved by u satisfies B(p + u) = A(p). Around an estimate u' = u + e, the windowed
product of B(p + u') with the conjugate of A(p) has the phase 2 pi k e of the axial error e. Laterally there is no
carrier: a least-squares match of the complex echoes was tried and was less accurate than the flow it started from.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import cv2
import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene import FWHM, Complexes, Echo, RegularGrid

Field = NDArray[np.float32]
"""Displacement in mm of every sample, shape (rows, lines, 2)."""


@dataclass(frozen=True)
class CarrierPhase:
    """Axial correction of an estimate within a quarter of a wavelength of the truth.

    Parameters
    ----------
    window : float
        Full width at half maximum of the Gaussian window, mm.
    iterations : int
        Each starts from the result of the one before; the second removes most of the error due to strain.
    """

    window: float = 1.5
    iterations: int = 2

    def __post_init__(self) -> None:
        if not self.window > 0 or self.iterations < 1:
            raise InputError(f"the window is a positive width in mm and iterations at least 1; got {self}")

    def refine(self, before: Echo, after: Echo, estimate: Field) -> tuple[Field, NDArray[np.float32]]:
        """Refine the displacement (mm) of every sample of ``before``.

        Returns
        -------
        displacement : ndarray, shape (rows, lines, 2)
            mm; the lateral part unchanged.
        coherence : ndarray, shape (rows, lines)
            Magnitude of the normalised complex correlation, 0 to 1.
        """
        (dx, dy), sigma = before.grid.spacing, self.window / FWHM

        def average(x: NDArray[np.floating]) -> NDArray[np.float32]:
            single = np.ascontiguousarray(x, dtype=np.float32)
            return np.asarray(cv2.GaussianBlur(single, (0, 0), sigma / dx, sigmaY=sigma / dy))

        a = np.asarray(before.iq, dtype=np.complex64)
        u = np.array(estimate, dtype=np.float32)
        power_a = average(np.abs(a) ** 2)
        for _ in range(self.iterations):
            b = taken_back(after, before.grid, u)
            product = b * np.conj(a)
            re, im = average(product.real), average(product.imag)
            u[..., 1] -= np.arctan2(im, re) / np.float32(2.0 * pi * before.carrier)
        power = np.sqrt(power_a * average(np.abs(b) ** 2))
        coherence = np.divide(np.hypot(re, im), power, out=np.zeros_like(power), where=power > 0)
        return u, coherence


def taken_back(after: Echo, grid: RegularGrid, u: Field) -> Complexes:
    """Return the baseband of ``after`` taken back by ``u``: that of B(p + u(p)) at the samples p of ``grid``."""
    at = after.grid.to_index(grid.nodes.reshape(*grid.shape[::-1], 2) + u).astype(np.float32)
    x, y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    real, imaginary = (
        cv2.remap(
            np.ascontiguousarray(part, np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
        for part in (after.iq.real, after.iq.imag)
    )
    turn = np.exp(2j * pi * after.carrier * u[..., 1]).astype(np.complex64)
    return np.asarray((real + 1j * imaginary) * turn)
