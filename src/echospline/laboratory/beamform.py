"""From channel data to echoes: delay and sum for plane waves sent straight ahead by a linear array."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, pi

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from echospline.errors import InputError
from echospline.scene import Complexes, Echo, Floats, RegularGrid


@dataclass(frozen=True)
class LinearArray:
    """Recording parameters of channel data.

    Parameters
    ----------
    frequency : float
        Centre frequency, MHz.
    sampling : float
        Samples per microsecond (MHz); band-pass sampling below twice the frequency is allowed.
    pitch : float
        Distance between elements, mm; the array is centred on x = 0 at depth 0.
    start : float
        Time of the first sample after transmission, us.
    sound_speed : float
        mm/us.
    f_number : float
        Depth over width of the receiving aperture.
    """

    frequency: float
    sampling: float
    pitch: float
    start: float = 0.0
    sound_speed: float = 1.54
    f_number: float = 1.5

    def __post_init__(self) -> None:
        positive = (self.frequency, self.sampling, self.pitch, self.sound_speed, self.f_number)
        if not all(isfinite(v) and v > 0 for v in positive) or not isfinite(self.start):
            raise InputError(f"an array is described by positive finite numbers; got {self}")

    @property
    def carrier(self) -> float:
        """Cycles of the echo per mm of depth."""
        return 2.0 * self.frequency / self.sound_speed


def demodulate(rf: NDArray[np.generic], array: LinearArray, bandwidth: float = 0.4) -> Complexes:
    """Demodulate real channel data, shape (samples, elements), to baseband: shifted to zero, cut at ``bandwidth`` x frequency / 2.

    Raises
    ------
    InputError
        If the data are not a (samples, elements) array of real numbers.
    """
    if rf.ndim != 2 or np.iscomplexobj(rf):
        raise InputError(f"channel data are real numbers of shape (samples, elements); got shape {rf.shape}")
    t = array.start + np.arange(len(rf)) / array.sampling
    shifted = np.asarray(rf, dtype=np.float64) * np.exp(-2j * pi * array.frequency * t)[:, None]
    spectrum = fft.fft(shifted, axis=0)
    f = np.abs(fft.fftfreq(len(rf), 1.0 / array.sampling))
    edge = bandwidth * array.frequency / 2.0
    # a raised cosine over the outer half of the band: no ringing
    keep = 0.5 + 0.5 * np.cos(pi * np.clip(2.0 * f / edge - 1.0, 0.0, 1.0))
    return np.asarray(2.0 * fft.ifft(spectrum * keep[:, None], axis=0), dtype=np.complex64)


def delay_and_sum(iq: Complexes, array: LinearArray, grid: RegularGrid) -> Echo:
    """Focus channel baseband, shape (samples, elements), at every point of ``grid``.

    A plane wave reaches depth y at y / c and returns to an element at x_e after the distance to it; samples are
    interpolated after eightfold band-limited refinement, turned by their carrier and summed over the aperture.
    """
    n, elements = iq.shape
    refine = 8
    spectrum = fft.fft(iq, axis=0)
    padded = np.zeros((n * refine, elements), dtype=np.complex64)
    half = n // 2
    padded[:half], padded[-(n - half) :] = spectrum[:half], spectrum[half:]
    fine = np.asarray(fft.ifft(padded, axis=0) * refine, dtype=np.complex64)
    x_e = (np.arange(elements) - (elements - 1) / 2.0) * array.pitch
    x, y = np.meshgrid(grid.x, grid.y)
    total = np.zeros(x.shape, dtype=np.complex128)
    for e in range(elements):
        time = (y + np.hypot(x - x_e[e], y)) / array.sound_speed
        at = (time - array.start) * array.sampling * refine
        k = np.floor(at).astype(np.intp)
        ok = (np.abs(x - x_e[e]) <= y / (2.0 * array.f_number)) & (k >= 0) & (k < n * refine - 1)
        w, line, k = (at - np.floor(at))[ok], fine[:, e], k[ok]
        turn = np.exp(2j * pi * array.frequency * time[ok])
        total[ok] += ((1.0 - w) * line[k] + w * line[k + 1]) * turn
    baseband = total * np.exp(-2j * pi * array.carrier * y)
    return Echo(baseband.astype(np.complex64), grid, array.carrier)


def rigid_motion(points: Floats, displacement: Floats) -> tuple[Floats, float]:
    """Return the rotation and translation that fit a displacement best (Kabsch): its field (n, 2) mm and the angle in radians."""
    centre, moved = points.mean(axis=0), (points + displacement).mean(axis=0)
    p, q = points - centre, points + displacement - moved
    angle = float(np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p * q).sum()))
    c, s = np.cos(angle), np.sin(angle)
    field: Floats = p @ np.array([[c, s], [-s, c]]) + moved - points
    return field, angle
