"""The lattice of a picture's echoes: lines and samples in complex baseband, with the pulse and the beam that form it.

A beam steered by theta holds lateral frequencies about K sin(theta), with K = 2 f0 / c cycles per mm: its look is a band of the lattice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, isfinite, pi, radians, sin, sqrt, tan

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from echospline.errors import InputError
from echospline.laboratory.scattering import CELL, Complexes, Singles
from echospline.scene import FWHM, Floats, Probe, Transducer

Reals = NDArray[np.floating]
"""Coordinates in single or double precision."""

LINE, SAMPLE = 0.25, 0.11
"""mm; lattice of the echoes. LINE holds the lateral frequencies of beams steered by up to 15 degrees at 3.5 MHz."""
APERTURE = 30.0
"""mm; largest aperture: below f_number times this, the beam widens with depth."""
MARGIN = 3.0
"""mm beside the picture whose echoes reach into it."""
SIDE_LOBES, SIDE_LOBE_WIDTH = 0.012, 5.0
"""Share of the beam's amplitude in a wide pedestal, and its sigma in mm: it veils fluid and shadows."""
TRAIL, TRAIL_LENGTH = -53.0, 8.0
"""dB of the reverberation that trails every echo, and mm over which its amplitude falls to 1/e: shadows are not empty."""
WRAP = 0.8
"""mm at the lattice's end without echoes: Fourier transforms wrap the pulse around."""


@dataclass(frozen=True, eq=False)
class BeamLattice:
    """Lines and samples of a picture's echoes, with pulse and beam.

    Parameters
    ----------
    probe : Probe
    transducer : Transducer
    looks : tuple of float
        Angles of the beams, rad.
    lines : ndarray, shape (lines,)
        mm along the probe's face (an arc's length for a curved array), 0 in its middle.
    depths : ndarray, shape (samples,)
        mm from the face.
    sigma : ndarray, shape (samples,)
        Of the two-way beam in the picture's plane, mm.
    """

    probe: Probe
    transducer: Transducer
    looks: tuple[float, ...]
    lines: Floats
    depths: Floats
    sigma: Floats

    @classmethod
    def of(cls, probe: Probe, transducer: Transducer, looks: Sequence[float]) -> BeamLattice:
        """Lay out the lattice of a probe's picture; ``looks`` in degrees.

        Raises
        ------
        InputError
            If the slice has no thickness, a look is steered by more than the lattice holds, or a sector is too deep for its radius.
        """
        if probe.elevation <= 0:
            raise InputError(
                "a plane is imaged anew from the scatterers of its slice: elevation of the probe must be above 0 mm; got 0"
            )
        sigma_k = 1.0 / (2.0 * pi * transducer.sigma_lateral)
        steepest = (0.5 / LINE - 2.0 * sigma_k) / transducer.carrier
        if len(looks) == 0 or not all(isfinite(a) and sin(radians(abs(a))) < steepest for a in looks):
            raise InputError(
                f"looks are one angle or more below {np.degrees(np.arcsin(min(steepest, 1.0))):.0f} degrees; got {tuple(looks)}"
            )
        face = probe.width if probe.shape == "linear" else probe.radius * radians(probe.opening)
        if probe.shape == "curved" and probe.depth > 4.0 * probe.radius:
            raise InputError(
                f"a curved array images to 4 times its radius of {probe.radius:g} mm; got a depth of {probe.depth:g} mm"
            )
        count = fft.next_fast_len(ceil((face + 2 * MARGIN) / LINE) + 1)
        lines = (np.arange(count) - (count - 1) / 2) * LINE
        depths = np.arange(fft.next_fast_len(ceil((probe.depth + 2.0) / SAMPLE))) * SAMPLE
        f_number = np.maximum(transducer.f_number, depths / APERTURE)
        sigma = 0.886 * transducer.wavelength * f_number / FWHM
        return cls(probe, transducer, tuple(radians(a) for a in looks), lines, depths, sigma)

    @property
    def shape(self) -> tuple[int, int]:
        """Samples and lines."""
        return len(self.depths), len(self.lines)

    @property
    def carrier(self) -> float:
        """Cycles of the echo per mm."""
        return self.transducer.carrier

    @property
    def inner(self) -> tuple[slice, int]:
        """Lines without the margin, and number of samples."""
        face = (
            self.probe.width
            if self.probe.shape == "linear"
            else self.probe.radius * radians(self.probe.opening)
        )
        inside = np.flatnonzero(np.abs(self.lines) <= face / 2 + LINE)
        return slice(inside[0], inside[-1] + 1), ceil(self.probe.depth / SAMPLE) + 1

    @cached_property
    def weight(self) -> Singles:
        """Factor that gives scatterers of rms 1, one per cell, speckle of rms 1, for every sample."""
        sz = np.sqrt(self.slice_variance(self.depths))
        across = LINE * self.spread(self.depths)
        power = (
            across**2 * sqrt(pi) * self.transducer.sigma_axial / (4 * pi * self.sigma * sz) / np.prod(CELL)
        )
        weight: Singles = (1.0 / np.sqrt(power)).astype(np.float32)
        return weight

    def spread(self, d: Reals) -> Reals:
        """Return how much wider lines lie at range d than at the face."""
        return (
            1.0 + np.maximum(d, 0.0) / self.probe.radius if self.probe.shape == "curved" else np.ones_like(d)
        )

    def slice_variance(self, d: Reals) -> Reals:
        """Return the square of the slice's sigma at range d, mm^2: `Probe.thickness` squared, in the type of ``d``."""
        p = self.probe
        off = (np.maximum(d, 0.0) - p.elevation_depth) * (p.element_height / (2.5 * p.elevation_depth))
        variance: Reals = off * off + p.elevation**2
        return variance

    def beam(self, u: Reals, v: Reals) -> tuple[Reals, Reals, Reals]:
        """Return line (mm along the face), range (mm) and angle of the line (rad) of points of the plane."""
        if self.probe.shape == "linear":
            return u, v, np.zeros_like(u)
        r = self.probe.radius
        angle = np.arctan2(u, v + r)
        return r * angle, np.hypot(u, v + r) - r, angle

    def place(self, q: Reals, d: Reals) -> tuple[Reals, Reals]:
        """Invert `beam`: return the points of the plane on line q at range d."""
        if self.probe.shape == "linear":
            u, v = np.broadcast_arrays(q, d)
            return u, v
        r = self.probe.radius
        return (r + d) * np.sin(q / r), (r + d) * np.cos(q / r) - r

    def lean(self, d: Reals, look: float) -> Reals:
        """Return how far a steered beam has left its line at range d, mm along the face."""
        r = self.probe.radius
        lean: Reals = tan(look) * (d if self.probe.shape == "linear" else r * np.log1p(d / r))
        return lean

    def deposited(self, q: Reals, d: Reals, real: Singles, imag: Singles) -> Complexes:
        """Share echoes between the four samples about each; return the sums."""
        samples, lines = self.shape
        fq = (q - np.float32(self.lines[0])) * np.float32(1.0 / LINE)
        fd = d * np.float32(1.0 / SAMPLE)
        last = samples - 1 - round(WRAP / SAMPLE)
        inside = np.flatnonzero((fq >= 0) & (fq < lines - 1) & (fd >= 0) & (fd < last))
        fq, fd, real, imag = fq[inside], fd[inside], real[inside], imag[inside]
        i, j = fq.astype(np.intp), fd.astype(np.intp)
        fq -= i
        fd -= j
        first = j * lines + i
        size = samples * lines
        echoes = np.zeros(size, dtype=np.complex64)
        for down, row_share in ((0, 1 - fd), (1, fd)):
            for right, share in ((0, row_share * (1 - fq)), (1, row_share * fq)):
                beyond = down * lines + right
                echoes.real[beyond:] += np.bincount(first, real * share, size)[: size - beyond]
                echoes.imag[beyond:] += np.bincount(first, imag * share, size)[: size - beyond]
        return echoes.reshape(self.shape)

    def steering(self, look: float) -> Complexes:
        """Return the phase over the lattice that a steered beam follows: faces are added in phase for every look."""
        across = self.spread(self.depths if self.probe.shape == "curved" else np.zeros(1))
        cycles = (self.carrier * sin(look)) * across[:, None] * self.lines
        phase = ((cycles - np.floor(cycles)) * (2.0 * pi)).astype(np.float32)
        # `with_beam` undoes the deposit's triangle at the steered frequencies; these echoes were shared out at the lower ones.
        triangle = np.sinc((self.carrier * sin(look) * LINE) * across).astype(np.float32) ** 2
        steering: Complexes = (np.cos(phase) + np.complex64(1j) * np.sin(phase)) * triangle[:, None]
        return steering

    def with_pulse(self, echoes: Complexes) -> Complexes:
        """Apply the pulse along depth, of peak 1; the deposit's triangle is undone."""
        sigma = self.transducer.sigma_axial
        k = fft.fftfreq(self.shape[0], SAMPLE)
        gain = (
            np.exp(-2.0 * (pi * sigma * k) ** 2) / np.sinc(k * SAMPLE) ** 2 * (sqrt(2 * pi) * sigma / SAMPLE)
        )
        spectrum = fft.fft(echoes, axis=0, overwrite_x=True)
        spectrum *= gain[:, None].astype(np.float32)
        shaped: Complexes = fft.ifft(spectrum, axis=0, overwrite_x=True)
        return shaped

    def with_trail(self, echoes: Complexes) -> Complexes:
        """Return the reverberation that follows every echo: a decaying random series, the same for every line."""
        rows = fft.next_fast_len(self.shape[0] + round(4 * TRAIL_LENGTH / SAMPLE))
        delay = np.arange(round(4 * TRAIL_LENGTH / SAMPLE)) * SAMPLE
        series = np.random.default_rng(3).standard_normal((2, len(delay))) * np.exp(-delay / TRAIL_LENGTH)
        series[:, delay < 1.5] = 0.0  # the echo's own pulse
        kernel = fft.fft((series[0] + 1j * series[1]) * (10.0 ** (TRAIL / 20.0) / sqrt(2.0)), rows)
        spectrum = fft.fft(echoes, rows, axis=0)
        spectrum *= kernel[:, None].astype(np.complex64)
        trail: Complexes = fft.ifft(spectrum, axis=0, overwrite_x=True)[: self.shape[0]]
        return trail

    def with_beam(self, echoes: Complexes, look: float) -> Complexes:
        """Apply a beam steered by ``look``, rad: a band of lateral frequencies about carrier sin(look), of unit sum."""
        across = self.spread(self.depths)[:, None].astype(np.float32)
        k = fft.fftfreq(self.shape[1], LINE).astype(np.float32)[None, :]
        # Lines lie wider at depth: frequencies per mm of tissue fall.
        off = k / across - np.float32(self.carrier * sin(look))
        off -= np.round(off * (LINE * across)) / (LINE * across)  # the lattice's frequencies repeat
        off *= off
        band = np.exp(off * (-2.0 * (pi * self.sigma) ** 2).astype(np.float32)[:, None])
        band *= np.float32(1.0 - SIDE_LOBES)
        band += np.float32(SIDE_LOBES) * np.exp(off * np.float32(-2.0 * (pi * SIDE_LOBE_WIDTH) ** 2))
        band /= np.sinc(k * np.float32(LINE)) ** 2
        spectrum = fft.fft(echoes, axis=1, overwrite_x=True)
        spectrum *= band
        shaped: Complexes = fft.ifft(spectrum, axis=1, overwrite_x=True)
        return shaped
