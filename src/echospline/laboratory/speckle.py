"""Statistics of speckle that distinguish a real pattern from a stretched photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, stats

from echospline.errors import InputError
from echospline.scene import Floats


@dataclass(frozen=True)
class SpeckleStatistics:
    """First and second order statistics of an envelope.

    Parameters
    ----------
    snr : float
        Mean over standard deviation of the envelope; 1.913 for Rayleigh's distribution.
    distance : float
        Kolmogorov's distance to the Rayleigh distribution of the same mean power.
    lateral, axial : float
        Full width at half maximum of the envelope's autocovariance, mm.
    """

    snr: float
    distance: float
    lateral: float
    axial: float


def speckle_statistics(envelope: NDArray[np.generic], spacing: tuple[float, float]) -> SpeckleStatistics:
    """Compute statistics of a homogeneous piece of envelope, shape (rows, columns), spacing (lateral, depth) in mm.

    Raises
    ------
    InputError
        If the piece is smaller than 16 x 16 or constant.
    """
    e = np.asarray(envelope, dtype=np.float64)
    if e.ndim != 2 or min(e.shape) < 16 or e.std() == 0:
        raise InputError(f"speckle statistics need a varying piece of 16 x 16 samples or more; got {e.shape}")
    scale = np.sqrt(np.mean(e**2) / 2.0)
    distance = float(stats.kstest(e.ravel(), stats.rayleigh(scale=scale).cdf).statistic)
    covariance = _autocovariance(e)
    return SpeckleStatistics(
        float(e.mean() / e.std()),
        distance,
        _width(covariance[0], spacing[0]),
        _width(covariance[:, 0], spacing[1]),
    )


def correlation_coefficient(a: NDArray[np.generic], b: NDArray[np.generic]) -> float:
    """Compute Pearson's correlation of two pieces of one size."""
    return float(np.corrcoef(np.ravel(a).astype(float), np.ravel(b).astype(float))[0, 1])


def _autocovariance(e: Floats) -> Floats:
    """Compute the autocovariance at non-negative lags, 1 at lag 0; padded, so that nothing wraps around."""
    rows, columns = e.shape
    spectrum = fft.rfft2(e - e.mean(), s=(2 * rows, 2 * columns))
    total = fft.irfft2(np.abs(spectrum) ** 2, s=(2 * rows, 2 * columns))[:rows, :columns]
    pairs = np.outer(np.arange(rows, 0, -1), np.arange(columns, 0, -1))
    return np.asarray(total / pairs / (total[0, 0] / e.size), dtype=np.float64)


def _width(profile: Floats, spacing: float) -> float:
    """Return the full width at half maximum of a peak at lag 0, interpolated between samples."""
    below = np.flatnonzero(profile < 0.5)
    if len(below) == 0:
        return float("inf")
    k = int(below[0])
    return float(2.0 * spacing * (k - (0.5 - profile[k]) / (profile[k - 1] - profile[k])))
