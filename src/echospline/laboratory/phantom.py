"""The speckle phantom: point scatterers that move with the tissue, imaged anew in every frame.

A frame is the sum of a_i g(x - x_i, y - y_i) over the scatterers, g a Gaussian pulse on a carrier times a
Gaussian beam. Each scatterer keeps its amplitude a_i and is moved exactly; the picture is formed afterwards, so
speckle decorrelates under strain as it does in tissue. `Phantom.form` deposits the scatterers on a grid in
complex baseband, where the field is smooth, and convolves by Fourier transform; `exact` is the plain sum.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite, pi

import numpy as np
from numpy.typing import NDArray
from scipy import fft, sparse

from echospline.errors import InputError
from echospline.scene import Complexes, Echo, Floats, RegularGrid, Transducer, fourier_frequencies

Displacement = Callable[[Floats], Floats]
"""Reference points (n, 2) mm -> displacement (n, 2) mm."""

MARGIN = 3.5
"""Scatterers reach this many standard deviations of the point spread beyond the picture."""
SCATTERER_LIMIT = 20_000_000


@dataclass(frozen=True)
class Inclusion:
    """An ellipse of another echogenicity: centre and half axes (x, y) in mm, level in dB (-inf: no echo, a cyst)."""

    centre: tuple[float, float]
    half_axes: tuple[float, float]
    level: float

    def __post_init__(self) -> None:
        if not all(isfinite(v) for v in (*self.centre, *self.half_axes)) or min(self.half_axes) <= 0:
            raise InputError(
                f"an inclusion needs a finite centre and positive half axes in mm; got {self.centre}, {self.half_axes}"
            )
        _check_level(self.level)

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Test which points lie inside, shape (n,)."""
        inside: NDArray[np.bool_] = ((points - self.centre) ** 2 / np.square(self.half_axes)).sum(
            axis=1
        ) <= 1.0
        return inside


@dataclass(frozen=True)
class Layer:
    """Tissue from depth ``top`` to ``bottom`` (mm) of another echogenicity, dB."""

    top: float
    bottom: float
    level: float

    def __post_init__(self) -> None:
        if not self.top < self.bottom:
            raise InputError(
                f"a layer needs top above bottom, depths in mm; got {self.top} and {self.bottom}"
            )
        _check_level(self.level)

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Test which points lie inside, shape (n,)."""
        inside: NDArray[np.bool_] = (points[:, 1] >= self.top) & (points[:, 1] < self.bottom)
        return inside


@dataclass(frozen=True)
class Scatterers:
    """Point scatterers: reference positions (n, 2) in mm and amplitudes (n,), unit mean square at 0 dB."""

    positions: Floats
    amplitudes: Floats
    density: float
    """Scatterers per mm^2."""

    @classmethod
    def random(
        cls,
        extent: tuple[float, float, float, float],
        density: float,
        seed: int,
        regions: Sequence[Inclusion | Layer] = (),
    ) -> Scatterers:
        """Scatter uniformly over ``extent`` (x0, x1, y0, y1) mm; later regions lie over earlier ones."""
        x0, x1, y0, y1 = extent
        n = round(density * (x1 - x0) * (y1 - y0))
        if not 0 < n <= SCATTERER_LIMIT:
            raise InputError(
                f"the phantom would hold {n} scatterers ({density:g} per mm^2); choose 1 to {SCATTERER_LIMIT}"
            )
        rng = np.random.default_rng(seed)
        positions = rng.uniform((x0, y0), (x1, y1), (n, 2))
        # equal amplitudes: at the same number per cell, their speckle is more developed than with random ones
        amplitudes = rng.choice((-1.0, 1.0), n)
        level = np.zeros(n)
        for region in regions:
            level[region.contains(positions)] = region.level
        return cls(positions, amplitudes * 10.0 ** (level / 20.0), density)

    def replaced(self, share: float, seed: int) -> Scatterers:
        """Return the set with a share (0 to 1) of amplitudes drawn again: those that moved out of the imaging plane."""
        if not 0.0 <= share <= 1.0:
            raise InputError(f"the share of replaced scatterers lies between 0 and 1; got {share}")
        rng = np.random.default_rng(seed)
        n = round(share * len(self.amplitudes))
        chosen = rng.permutation(len(self.amplitudes))[:n]
        # a permutation among the chosen keeps the level of homogeneous tissue and destroys the pattern
        amplitudes = self.amplitudes.copy()
        amplitudes[chosen] = np.abs(amplitudes[chosen]) * rng.choice((-1.0, 1.0), n)
        return Scatterers(self.positions, amplitudes, self.density)


@dataclass(frozen=True)
class Phantom:
    """Tissue of point scatterers under a probe.

    Parameters
    ----------
    probe : Transducer
        Gives the point spread and the noise.
    grid : RegularGrid
        Pixel centres of the picture, mm.
    seed : int
        Of the scatterers; noise takes a seed per frame.
    per_cell : float
        Scatterers per resolution cell; 10 or more give fully developed speckle.
    regions : sequence of Inclusion or Layer
        Echogenicity, later ones over earlier ones.

    Raises
    ------
    InputError
        If the numbers are out of range or the phantom would be too large.
    """

    probe: Transducer
    grid: RegularGrid
    seed: int = 0
    per_cell: float = 12.0
    regions: tuple[Inclusion | Layer, ...] = ()
    reserve: float = 2.0
    """Tissue beyond the picture, mm, that may move into it."""
    echogenicity: Callable[[Floats], Floats] | None = None
    """Level in dB at points (n, 2) mm, on top of the regions."""
    scatterers: Scatterers = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (isfinite(self.per_cell) and self.per_cell > 0):
            raise InputError(f"per_cell must be a positive number of scatterers; got {self.per_cell}")
        if not (isfinite(self.reserve) and self.reserve >= 0):
            raise InputError(f"reserve must be zero or a positive length in mm; got {self.reserve}")
        x0, x1, y0, y1 = self.lattice.extent
        r = self.reserve
        scatterers = Scatterers.random(
            (x0 - r, x1 + r, y0 - r, y1 + r), self.per_cell / self.probe.cell, self.seed, self.regions
        )
        if self.echogenicity is not None:
            level = np.asarray(self.echogenicity(scatterers.positions), dtype=np.float64)
            scatterers = replace(scatterers, amplitudes=scatterers.amplitudes * 10.0 ** (level / 20.0))
        object.__setattr__(self, "scatterers", scatterers)

    @cached_property
    def samples(self) -> RegularGrid:
        """Grid of the echo samples: the picture's, divided finely enough for the baseband signal."""
        sx, sy = self.probe.sigma_lateral, self.probe.sigma_axial
        fx, fy = (
            int(np.ceil(h / limit)) for h, limit in zip(self.grid.spacing, (0.5 * sx, 0.6 * sy), strict=True)
        )
        (nx, ny), (dx, dy) = self.grid.shape, self.grid.spacing
        return RegularGrid(((nx - 1) * fx + 1, (ny - 1) * fy + 1), (dx / fx, dy / fy), self.grid.origin)

    @cached_property
    def lattice(self) -> RegularGrid:
        """The samples' grid with a margin on every side and a size that transforms fast."""
        (nx, ny), (dx, dy), (x0, y0) = self.samples.shape, self.samples.spacing, self.samples.origin
        widest = float(self.probe.beam(self.samples.y).max())
        mx, my = (int(np.ceil(MARGIN * s / h)) for s, h in ((widest, dx), (self.probe.sigma_axial, dy)))
        shape = fft.next_fast_len(nx + 2 * mx), fft.next_fast_len(ny + 2 * my)
        return RegularGrid(shape, (dx, dy), (x0 - mx * dx, y0 - my * dy))

    def moved(self, displacement: Displacement | None) -> Floats:
        """Move the scatterers by ``displacement``, mm; beyond the picture the value at its edge continues."""
        positions = self.scatterers.positions
        if displacement is None:
            return positions
        x0, x1, y0, y1 = self.grid.extent
        u = np.asarray(displacement(np.clip(positions, (x0, y0), (x1, y1))), dtype=np.float64)
        if u.shape != positions.shape or not np.isfinite(u).all():
            raise InputError(
                f"a displacement of {len(positions)} points must be finite and (n, 2) mm; got {u.shape}"
            )
        return positions + u

    def form(
        self,
        displacement: Displacement | None = None,
        noise_seed: int | None = None,
        replaced: float = 0.0,
        steering: float = 0.0,
    ) -> Echo:
        """Image the moved scatterers by convolution.

        Parameters
        ----------
        displacement : callable, optional
            Reference points (n, 2) mm -> displacement (n, 2) mm; tissue at rest when not given.
        noise_seed : int, optional
            Seed of this frame's noise (and of the replaced scatterers); no noise when not given.
        replaced : float
            Share of the scatterers that has left the imaging plane since the reference.
        steering : float
            Angle of the beams in degrees: turns the carrier, not the envelope of the point spread. Envelopes of
            several angles have different speckle; their mean is a compounded picture.

        Returns
        -------
        Echo
            Mean power 1 for speckle of 0 dB.
        """
        kept = self.scatterers.replaced(replaced, (noise_seed or 0) + 1) if replaced else self.scatterers
        return self.formed_at(self.moved(displacement), noise_seed, steering, kept)

    def formed_at(
        self,
        positions: Floats,
        noise_seed: int | None = None,
        steering: float = 0.0,
        scatterers: Scatterers | None = None,
    ) -> Echo:
        """Form as `form` does with the scatterers at given positions (n, 2) mm, so that several angles share one motion."""
        scatterers = scatterers or self.scatterers
        p, lattice = positions, self.lattice
        k, theta = self.probe.carrier, np.radians(steering)
        spread = deposit(p, scatterers.amplitudes, lattice, (k * np.sin(theta), k * np.cos(theta)))
        kx = fourier_frequencies(lattice.shape[0], lattice.spacing[0])
        ky = fourier_frequencies(lattice.shape[1], lattice.spacing[1])
        # the hat function of the deposit multiplies the spectrum by sinc^2; dividing it out leaves only its aliases
        beam = self.probe.beam(lattice.y)[:, None]
        lateral = np.exp(-2.0 * (pi * beam * kx) ** 2) / np.sinc(kx * lattice.spacing[0]) ** 2
        axial = np.exp(-2.0 * (pi * self.probe.sigma_axial * ky) ** 2) / np.sinc(ky * lattice.spacing[1]) ** 2
        blurred = fft.ifft(
            fft.fft(spread, axis=1, workers=-1) * lateral.astype(np.float32), axis=1, workers=-1
        )
        blurred = fft.ifft(
            fft.fft(blurred, axis=0, workers=-1) * axial.astype(np.float32)[:, None], axis=0, workers=-1
        )
        rows, columns = _inside(self.samples, lattice)
        iq = blurred[rows, columns] * self._gain[:, None]
        if noise_seed is not None:
            iq = iq + self.noise(noise_seed)
        return Echo(np.asarray(iq, dtype=np.complex64), self.samples, self.probe.carrier)

    def exact(self, points: Floats, displacement: Displacement | None = None) -> Complexes:
        """Sum over all scatterers at points (n, 2) mm without noise: the slow reference, shape (n,) complex."""
        p, a = self.moved(displacement), self.scatterers.amplitudes
        out = np.empty(len(points), dtype=np.complex128)
        sy, k = self.probe.sigma_axial, self.probe.carrier
        dx, dy = self.lattice.spacing
        for i, (x, y) in enumerate(points):
            near = np.abs(p[:, 1] - y) < 7.0 * sy
            sx = self.probe.beam(p[near, 1])
            g = np.exp(-0.5 * ((x - p[near, 0]) / sx) ** 2 - 0.5 * ((y - p[near, 1]) / sy) ** 2)
            g /= 2.0 * pi * sx * sy / (dx * dy)
            out[i] = (a[near] * g * np.exp(-2j * pi * k * p[near, 1])).sum()
        gain = np.interp(points[:, 1], self.samples.y, self._gain)
        return out * gain

    def noise(self, seed: int) -> Complexes:
        """Draw the electronic noise of one frame, shape of the samples, at the level of ``probe.snr``."""
        shape = self.samples.shape[::-1]
        rng = np.random.default_rng((seed, 7919))
        # white noise of RF lines spreads over sampling / 2; the baseband samples carry c / (2 dy) of it
        band = self.probe.sound_speed / (2.0 * self.samples.spacing[1]) / (self.probe.sampling / 2.0)
        mid = float(np.mean(self.samples.extent[2:]))
        loss = 2.0 * self.probe.attenuation * self.probe.frequency * (self.samples.y - mid) / 10.0
        sigma = np.sqrt(band / 2.0) * 10.0 ** ((loss - self.probe.snr) / 20.0)
        white = rng.standard_normal((*shape, 2), dtype=np.float32).view(np.complex64)[..., 0]
        return np.asarray(white * sigma[:, None].astype(np.float32))

    @cached_property
    def _gain(self) -> Floats:
        """Scale the mean power of 0 dB speckle to 1: density times the integral of the squared point spread."""
        dx, dy = self.lattice.spacing
        beam = self.probe.beam(self.samples.y)
        power = self.scatterers.density * (dx * dy) ** 2 / (4.0 * pi * beam * self.probe.sigma_axial)
        gain: Floats = 1.0 / np.sqrt(power)
        return gain


def deposit(
    points: Floats, amplitudes: Floats, grid: RegularGrid, wave: tuple[float, float] = (0.0, 0.0)
) -> Complexes:
    """Share amplitudes times exp(-2 pi i wave . p) among the four grid points around each point p (bilinear).

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        mm; those outside the grid are dropped.
    amplitudes : ndarray, shape (n,)
    grid : RegularGrid
    wave : (float, float)
        Cycles per mm along (x, y).

    Returns
    -------
    ndarray, shape (ny, nx), complex64
    """
    nx, ny = grid.shape
    gx, gy = (points - grid.origin).T / np.reshape(grid.spacing, (2, 1))
    inside = (gx >= 0.0) & (gy >= 0.0) & (gx < nx - 1) & (gy < ny - 1)
    if not inside.all():
        points, amplitudes, gx, gy = points[inside], amplitudes[inside], gx[inside], gy[inside]
    n = len(points)
    ix, iy = gx.astype(np.int32), gy.astype(np.int32)
    # single precision from here on: positions in a cell, and angles without their whole turns
    fx, fy = (gx - ix).astype(np.float32), (gy - iy).astype(np.float32)
    turns = wave[0] * points[:, 0] + wave[1] * points[:, 1]
    angle = (2.0 * pi * (turns - np.rint(turns))).astype(np.float32)
    a = amplitudes.astype(np.float32)
    echoes = np.column_stack([a * np.cos(angle), -a * np.sin(angle)])
    first = iy * nx + ix
    corners = np.column_stack([first, first + 1, first + nx, first + nx + 1])
    shares = np.column_stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    # a column for each point, with its four shares
    starts = np.arange(0, 4 * n + 1, 4, dtype=np.int32)
    bilinear = sparse.csc_array((shares.ravel(), corners.ravel(), starts), shape=(nx * ny, n))
    out: Complexes = (bilinear @ echoes).view(np.complex64).reshape(ny, nx)
    return out


def _inside(small: RegularGrid, large: RegularGrid) -> tuple[slice, slice]:
    ix, iy = np.rint(large.to_index(small.origin)).astype(int)
    return slice(iy, iy + small.shape[1]), slice(ix, ix + small.shape[0])


def _check_level(level: float) -> None:
    if np.isnan(level) or level == float("inf"):
        raise InputError(f"an echogenicity is a level in dB (-inf for none); got {level}")
