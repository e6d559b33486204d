"""The grain of a recorded picture: its speckle measured where the tissue is even, and new speckle of the same kind.

What a scanner does to an envelope (compounding, filters, its grey map) is not in the file, so nothing of it is assumed: the
shape of the speckle's autocorrelation and the distribution of its grey values are measured, synthetic speckle is measured
by the same steps, and its parameters are corrected until both agree. Whatever bias the steps have is then the same on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from echospline.errors import InputError
from echospline.scene import Floats

Mask = NDArray[np.bool_]

LOOKS = 3
"""Envelopes averaged, as compounding scanners do; the grey values' own distribution is fitted afterwards."""
EVEN = 0.25
"""Share of the tissue, that of the least variance, in which speckle is measured: the rest may hold structures."""
QUANTILES = np.concatenate([[0.002], np.linspace(0.01, 0.99, 48), [0.998]])
LEAST_PIXELS = 400
"""Fewer pixels of tissue around a body are too few to measure its speckle: some 20 x 20."""
LEAST_CONTRAST = 0.8
"""Grey levels (standard deviation); a picture whose tissue varies less shows no speckle."""
ROUNDS = 4
"""Corrections of the autocorrelation's shape; each is some ten per cent of the one before."""
NARROW, WIDE = 1.3, 2.5
"""Standard deviations of the window of the local mean, in widths of the speckle: the wide one measures better, where the tissue is even."""
STRUCTURED = 1.15
"""The wide window is given up where it shows more variance than speckle explains, by this factor: fibres, not grain."""
LEVEL_UP_TO = 0.35
"""Autocorrelation down to which the shape is fitted; below, the local mean that was taken off prevails."""


@dataclass(frozen=True)
class Grain:
    """Speckle of a picture, its autocorrelation about exp(-h' A h / 2) at a lag h.

    Parameters
    ----------
    shape : ndarray, shape (D, D)
        A in 1/pixel^2, axes in the order of the array.
    values : ndarray, shape (50,)
        Quantiles of the grey value about its local mean, at `QUANTILES`.
    field : ndarray, shape (D, D)
        The same form for the complex field that gives such speckle.
    drawn : ndarray, shape (50,)
        Quantiles of the synthetic level, dB, that correspond to ``values``.
    """

    shape: Floats
    values: Floats
    field: Floats
    drawn: Floats

    def speckle(self, shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
        """Draw new speckle: grey values about a mean of 0, of the measured distribution and autocorrelation."""
        level = _level(shape, self.field, rng)
        grey: Floats = np.interp(level, self.drawn, self.values)
        return np.asarray(grey - grey.mean(), dtype=np.float64)

    def width(self, direction: Floats) -> Floats:
        """Return the full width at half maximum along unit vectors (..., D) in the array's axes, pixels."""
        curvature = np.einsum("...i,ij,...j->...", direction, self.shape, direction)
        width: Floats = 2.0 * np.sqrt(2.0 * np.log(2.0) / np.maximum(curvature, 1e-9))
        return width


def grain_of(grey: Floats, tissue: Mask, seed: int) -> Grain:
    """Measure the speckle of a picture or a volume.

    Parameters
    ----------
    grey : ndarray
        Grey values, in the plane or in space.
    tissue : ndarray of bool
        Pixels that are tissue and unclipped.
    seed : int
        Of the synthetic speckle that it is compared with.

    Raises
    ------
    InputError
        If there is too little tissue, or it shows no speckle.
    """
    if tissue.sum() < LEAST_PIXELS:
        raise InputError(
            f"only {int(tissue.sum())} pixels of tissue lie around it; speckle cannot be measured in fewer than {LEAST_PIXELS}"
        )
    if (spread := _measured(grey, tissue, np.full(grey.ndim, 4.0))[2]) < LEAST_CONTRAST:
        raise InputError(
            f"the tissue around it varies by {spread:.2g} grey levels: no speckle that a body could be given; "
            f"expected {LEAST_CONTRAST:g} or more"
        )
    wide = np.full(grey.ndim, 4.0)
    for _ in range(2):
        wide = _window(_measured(grey, tissue, wide)[0], NARROW, grey.shape)
    narrow = _fitted(grey, tissue, wide, seed)
    wide = _window(narrow.shape, WIDE, grey.shape)
    expected = narrow.speckle(grey.shape, np.random.default_rng((seed, 32)))
    if _measured(grey, tissue, wide)[2] > STRUCTURED * _measured(expected, tissue, wide)[2]:
        return narrow
    return _fitted(grey, tissue, wide, seed)


def _window(form: Floats, widths: float, shape: tuple[int, ...]) -> Floats:
    """Return the window of the local mean in multiples of the speckle's width, pixels."""
    one = 2.355 / np.sqrt(np.maximum(np.diag(form), 1e-4))
    return np.clip(widths * one, 2.0, np.maximum(np.array(shape) / 6.0, 2.0))


def _fitted(grey: Floats, tissue: Mask, wide: Floats, seed: int) -> Grain:
    """Find the field whose speckle, measured in the same way, has the form that the picture's has."""
    shape, values, _ = _measured(grey, tissue, wide)
    field = shape / 2.0  # of an envelope's logarithm, nearly: the correlation of a complex field squared
    for _ in range(ROUNDS):
        found, _, _ = _measured(_level(grey.shape, field, np.random.default_rng((seed, 31))), tissue, wide)
        field = _positive(field + 0.5 * (shape - found), field)
    _, drawn, _ = _measured(_level(grey.shape, field, np.random.default_rng((seed, 31))), tissue, wide)
    return Grain(shape, values, field, drawn)


def _positive(wanted: Floats, before: Floats) -> Floats:
    """Return the first positive definite form on the way back from ``wanted`` to ``before``."""
    least = 0.05 * float(np.linalg.eigvalsh(before)[0])
    for share in (1.0, 0.5, 0.25):
        form = before + share * (wanted - before)
        if np.linalg.eigvalsh(form)[0] > least:
            return form
    return before


def _level(shape: tuple[int, ...], form: Floats, rng: np.random.Generator) -> Floats:
    """Draw the level, dB, of a mean of `LOOKS` envelopes of dense scatterers, whose field has the correlation exp(-h' B h / 2).

    Many scatterers in a resolution cell make white complex noise; the point spread is the Gaussian whose
    autocorrelation is the field's.
    """
    size = [fft.next_fast_len(n + 8) for n in shape]
    turns = np.meshgrid(*(2.0 * np.pi * np.fft.fftfreq(n) for n in size), indexing="ij", sparse=True)
    inverse = np.linalg.inv(form)
    exponent: Floats = np.zeros(size)
    for i, a in enumerate(turns):
        for j, b in enumerate(turns):
            exponent = exponent + inverse[i, j] * a * b
    spread = np.exp(-0.25 * exponent).astype(np.float32)
    total = np.zeros(shape)
    inner = tuple(slice(0, n) for n in shape)
    for _ in range(LOOKS):
        white = rng.standard_normal((*size, 2), dtype=np.float32).view(np.complex64)[..., 0]
        total += np.abs(fft.ifftn(fft.fftn(white) * spread)[inner])
    return np.asarray(20.0 * np.log10(total / total.mean() + 1e-9), dtype=np.float64)


def _measured(grey: Floats, tissue: Mask, wide: Floats) -> tuple[Floats, Floats, float]:
    """Measure form, quantiles and standard deviation of what is left when the local mean is taken off."""
    rest = np.where(tissue, grey - local_mean(grey, tissue, wide), 0.0)
    variance = local_mean(rest**2, tissue, wide)
    even = tissue & (variance <= np.quantile(variance[tissue], EVEN))
    inside = rest[even]
    return _form(rest, even), np.quantile(inside, QUANTILES), float(inside.std())


def local_mean(values: Floats, where: Mask, sigma: Floats) -> Floats:
    """Return the mean over a Gaussian window of the values at some pixels alone; everywhere the nearest there is."""
    weight = ndimage.gaussian_filter(where.astype(np.float64), sigma, mode="nearest", truncate=3.0)
    total = ndimage.gaussian_filter(np.where(where, values, 0.0), sigma, mode="nearest", truncate=3.0)
    far = weight < 1e-3
    mean: Floats = np.divide(total, weight, out=np.zeros_like(total), where=~far)
    if far.any() and not far.all():
        nearest = ndimage.distance_transform_edt(far, return_distances=False, return_indices=True)
        mean = mean[tuple(nearest)]
    return mean


def _form(rest: Floats, where: Mask) -> Floats:
    """Fit exp(-h' A h / 2) to the autocorrelation of masked values near lag 0."""
    reach = [min(24, n // 2) for n in rest.shape]
    size = [fft.next_fast_len(n + r, real=True) for n, r in zip(rest.shape, reach, strict=True)]
    inside = np.where(where, rest - rest[where].mean(), 0.0)
    power = fft.irfftn(np.abs(fft.rfftn(inside, size)) ** 2, size)
    pairs = fft.irfftn(np.abs(fft.rfftn(where.astype(np.float64), size)) ** 2, size)
    around = np.ix_(*(np.arange(-r, r + 1) for r in reach))
    correlation = power[around] / np.maximum(pairs[around], 1.0)
    correlation = correlation / correlation[tuple(reach)]
    peak, _ = ndimage.label(correlation > LEVEL_UP_TO)
    near = peak == peak[tuple(reach)]
    lags = np.stack(np.nonzero(near), axis=-1) - np.array(reach)
    value = -2.0 * np.log(np.minimum(correlation[near], 1.0))
    d = rest.ndim
    pairs_of = [(i, j) for i in range(d) for j in range(i, d)]
    columns = np.stack([(1.0 if i == j else 2.0) * lags[:, i] * lags[:, j] for i, j in pairs_of], axis=-1)
    weight = correlation[near]
    found = np.linalg.lstsq(columns * weight[:, None], value * weight, rcond=None)[0]
    form = np.zeros((d, d))
    for (i, j), v in zip(pairs_of, found, strict=True):
        form[i, j] = form[j, i] = v
    if not (np.isfinite(form).all() and np.linalg.eigvalsh(form)[0] > 1e-6):
        # speckle finer than a pixel along some axis: no lag to fit; white there
        form = np.diag(np.clip(np.diag(form), 1e-3, None)) if np.isfinite(form).all() else np.eye(d)
        form = np.where(np.eye(d, dtype=bool) & (form <= 1e-3), 2.0, form)
    return form
