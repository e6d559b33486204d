"""The transducer: centre frequency, bandwidth and aperture, and the point spread function they give."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, log, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.scene.grid import Floats

FWHM = 2.0 * sqrt(2.0 * log(2.0))
"""Full width at half maximum of a Gaussian of unit standard deviation."""


@dataclass(frozen=True)
class Transducer:
    """A pulse-echo imaging system: Gaussian pulse along depth, Gaussian beam across it.

    Parameters
    ----------
    frequency : float
        Centre frequency f0, MHz.
    bandwidth : float
        Width of the two-way spectrum at half amplitude (-6 dB) as a share of f0.
    f_number : float
        Depth over aperture width; the beam is 0.886 lambda f_number wide at half amplitude.
    sampling : float
        Rate at which radio-frequency lines are sampled, MHz; ``snr`` is per such sample.
    snr : float
        Power of 0 dB speckle over power of electronic noise, dB, at mid-depth; infinite for none.
    attenuation : float
        dB / (cm MHz), one way. The time gain compensation undoes it, so its only effect is noise that grows with depth.
    focus : float, optional
        Depth of the transmit focus, mm: the beam widens away from it. Focused at every depth when not given.
    sound_speed : float
        mm/us.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    frequency: float = 5.0
    bandwidth: float = 0.6
    f_number: float = 2.0
    sampling: float = 40.0
    snr: float = 20.0
    attenuation: float = 0.0
    focus: float | None = None
    sound_speed: float = 1.54

    def __post_init__(self) -> None:
        positive = {
            "frequency": (self.frequency, "MHz"),
            "bandwidth": (self.bandwidth, "as a share of the frequency"),
            "f_number": (self.f_number, "(depth over aperture)"),
            "sampling": (self.sampling, "MHz"),
            "sound_speed": (self.sound_speed, "mm/us"),
        }
        for name, (value, unit) in positive.items():
            if not (isfinite(value) and value > 0):
                raise InputError(f"{name} must be a positive number {unit}; got {value}")
        if self.bandwidth >= 2.0:
            raise InputError(f"bandwidth is a share of the frequency below 2; got {self.bandwidth}")
        if self.sampling < 2.0 * self.frequency * (1.0 + self.bandwidth):
            raise InputError(
                f"sampling must be at least {2 * self.frequency * (1 + self.bandwidth):g} MHz "
                f"for this frequency and bandwidth; got {self.sampling}"
            )
        if not self.snr > float("-inf"):
            raise InputError(f"snr must be a number in dB (inf for no noise); got {self.snr}")
        if not (isfinite(self.attenuation) and self.attenuation >= 0):
            raise InputError(
                f"attenuation must be zero or a positive number in dB/(cm MHz); got {self.attenuation}"
            )
        if self.focus is not None and not (isfinite(self.focus) and self.focus > 0):
            raise InputError(f"focus must be a positive depth in mm; got {self.focus}")

    @property
    def wavelength(self) -> float:
        """Lambda in tissue, mm."""
        return self.sound_speed / self.frequency

    @property
    def carrier(self) -> float:
        """Cycles of the echo per mm of depth, 2 f0 / c."""
        return 2.0 * self.frequency / self.sound_speed

    @property
    def sigma_axial(self) -> float:
        """Standard deviation of the pulse envelope along depth, mm."""
        sigma_f = self.bandwidth * self.frequency / FWHM
        return self.sound_speed / 2.0 / (2.0 * pi * sigma_f)

    @property
    def sigma_lateral(self) -> float:
        """Standard deviation of the two-way beam at its focus, mm."""
        return 0.886 * self.wavelength * self.f_number / FWHM

    def beam(self, depth: ArrayLike) -> Floats:
        """Return the standard deviation of the two-way beam at depths in mm, mm.

        Away from a fixed focus the beam widens as a Gaussian beam does, by sqrt(1 + ((y - focus) / r)^2),
        with the Rayleigh range r = pi w^2 / lambda of a one-way waist w = 2 sigma (two-way amplitude
        exp(-2 x^2 / w^2)).
        """
        y = np.asarray(depth, dtype=np.float64)
        if self.focus is None:
            return np.full(y.shape, self.sigma_lateral)
        rayleigh = pi * (2.0 * self.sigma_lateral) ** 2 / self.wavelength
        widened: Floats = self.sigma_lateral * np.sqrt(1.0 + ((y - self.focus) / rayleigh) ** 2)
        return widened

    @property
    def cell(self) -> float:
        """Area of one resolution cell (half-amplitude widths), mm^2."""
        return FWHM**2 * self.sigma_axial * self.sigma_lateral


LINEAR = Transducer()
"""5 MHz linear array: speckle 0.23 x 0.55 mm (axial x lateral)."""

CONVEX = Transducer(frequency=3.5, f_number=3.5)
"""3.5 MHz abdominal array (ATL C5-2 like): speckle 0.32 x 1.4 mm, pictured on a rectangular grid."""

TRANSDUCERS = {"linear": LINEAR, "convex": CONVEX}
