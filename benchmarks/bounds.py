"""How well displacement can be measured at all: Cramer-Rao bounds for speckle of given spectrum, noise and window."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from echospline.scene import Echo, Transducer


def walker_trahey(probe: Transducer, window: float, rho: float = 1.0, snr: float | None = None) -> float:
    """Axial bound of one RF line in um (Walker and Trahey 1995): window in mm, rho the correlation of the pair."""
    f0, c = probe.frequency * 1e6, probe.sound_speed * 1e3  # Hz, m/s
    ratio = 10.0 ** ((probe.snr if snr is None else snr) / 20.0)
    t = 2.0 * window * 1e-3 / c
    b = probe.bandwidth
    spread = (1.0 / rho**2) * (1.0 + 1.0 / ratio**2) ** 2 - 1.0
    sigma = np.sqrt(3.0 / (2.0 * f0**3 * np.pi**2 * t * (b**3 + 12.0 * b)) * spread)
    return float(sigma * c / 2.0 * 1e6)


def plane(a, b, spacing: tuple[float, float], area: float, carrier: float = 0.0) -> tuple[float, float]:
    """Bound (axial, lateral) in um for a window of ``area`` mm^2, from the coherence of a pair without motion.

    J = 2 A times the integral over half the plane of (2 pi k)^2 C / (1 - C), the Fisher information of two
    Gaussian fields of squared coherence C(k); over the whole plane for complex fields, whose axial wave number
    is that of the carrier plus the baseband's. C is measured: cross-spectra of windowed patches, smoothed,
    with its bias (1 / number of independent estimates) taken off.
    """
    size = (min(64, a.shape[0] // 2), min(64, a.shape[1] // 2))
    taper = np.outer(np.hanning(size[0]), np.hanning(size[1]))
    saa = sbb = sab = 0.0
    count = 0
    for i in range(0, a.shape[0] - size[0] + 1, size[0] // 2):
        for j in range(0, a.shape[1] - size[1] + 1, size[1] // 2):
            p, q = (x[i : i + size[0], j : j + size[1]] for x in (a, b))
            fp, fq = (np.fft.fft2((x - x.mean()) * taper) for x in (p, q))
            saa, sbb, sab = saa + np.abs(fp) ** 2, sbb + np.abs(fq) ** 2, sab + fp * np.conj(fq)
            count += 1
    smooth = 3
    real = ndimage.uniform_filter(sab.real, smooth, mode="wrap") ** 2
    imaginary = ndimage.uniform_filter(sab.imag, smooth, mode="wrap") ** 2
    power = ndimage.uniform_filter(saa, smooth, mode="wrap") * ndimage.uniform_filter(
        sbb, smooth, mode="wrap"
    )
    bias = 1.0 / (count / 2.0 * smooth**2 / 2.0)
    c = np.clip((real + imaginary) / power - bias, 0.0, 0.9999)
    ky = np.fft.fftfreq(size[0], spacing[1])[:, None]
    kx = np.fft.fftfreq(size[1], spacing[0])[None, :]
    cell = 1.0 / (size[0] * spacing[1] * size[1] * spacing[0])
    half = 1.0 if carrier else 0.5
    weight = 2.0 * area * half * cell * c / (1.0 - c)
    j_axial = (weight * (2.0 * np.pi * (ky + carrier)) ** 2).sum()
    j_lateral = (weight * (2.0 * np.pi * kx) ** 2).sum()
    return float(1e3 / np.sqrt(j_axial)), float(1e3 / np.sqrt(j_lateral))


def of_echoes(a: Echo, b: Echo, area: float) -> tuple[float, float]:
    """Bound for complex echoes of tissue at rest."""
    return plane(a.iq, b.iq, a.grid.spacing, area, a.carrier)
