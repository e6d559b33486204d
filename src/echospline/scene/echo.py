"""Beamformed echoes: complex baseband (IQ) lines with their grid, and RF, envelope and B-mode derived from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite, pi

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene.grid import Floats, RegularGrid
from echospline.scene.image import UltrasoundImage

Complexes = NDArray[np.complexfloating]


@dataclass(frozen=True)
class Display:
    """Log compression of an envelope to grey.

    Parameters
    ----------
    dynamic_range : float
        dB between black and white.
    top : float
        Level of white, dB above the mean power of speckle of 0 dB.
    """

    dynamic_range: float = 60.0
    top: float = 18.0

    def __post_init__(self) -> None:
        if not (isfinite(self.dynamic_range) and self.dynamic_range > 0 and isfinite(self.top)):
            raise InputError(
                f"dynamic_range must be positive and top finite, dB; got {self.dynamic_range} and {self.top}"
            )

    def grey(self, envelope: NDArray[np.generic]) -> NDArray[np.uint8]:
        """Compress an envelope to 8-bit grey; levels outside the range become black or white, as on a scanner."""
        with np.errstate(divide="ignore"):
            level = 20.0 * np.log10(np.asarray(envelope, dtype=np.float32))
        shown = 255.0 * (1.0 + (level - self.top) / self.dynamic_range)
        return np.asarray(np.rint(np.clip(shown, 0.0, 255.0)), dtype=np.uint8)

    def envelope(self, grey: NDArray[np.generic]) -> Floats:
        """Invert `grey`: return the amplitude of 8-bit grey (0 to 255)."""
        level = (np.asarray(grey, dtype=np.float64) / 255.0 - 1.0) * self.dynamic_range + self.top
        amplitude: Floats = 10.0 ** (level / 20.0)
        return amplitude


@dataclass(frozen=True)
class Echo:
    """One frame of beamformed echoes.

    Parameters
    ----------
    iq : ndarray, shape (rows, lines), complex
        Analytic signal times exp(-2 pi i carrier y): depth y down the rows, one column a line.
    grid : RegularGrid
        Positions of the samples in mm; ``grid.shape == (lines, rows)``.
    carrier : float
        Cycles per mm of depth, 2 f0 / c.

    Raises
    ------
    InputError
        If samples, grid and carrier do not fit.
    """

    iq: Complexes
    grid: RegularGrid
    carrier: float

    def __post_init__(self) -> None:
        if not np.iscomplexobj(self.iq) or self.iq.shape != self.grid.shape[::-1]:
            raise InputError(
                f"echoes are complex samples of shape (rows, lines) = {self.grid.shape[::-1]}; "
                f"got {self.iq.dtype} of shape {self.iq.shape}"
            )
        if not (isfinite(self.carrier) and self.carrier > 0):
            raise InputError(f"carrier must be a positive number of cycles per mm; got {self.carrier}")

    @classmethod
    def from_rf(cls, rf: NDArray[np.generic], grid: RegularGrid, carrier: float) -> Echo:
        """Demodulate real beamformed lines, shape (rows, lines).

        Raises
        ------
        InputError
            If the carrier lies beyond the Nyquist limit of the axial spacing.
        """
        if np.iscomplexobj(rf) or np.ndim(rf) != 2:
            raise InputError(f"RF lines are real numbers of shape (rows, lines); got shape {np.shape(rf)}")
        if carrier * grid.spacing[1] >= 0.5:
            raise InputError(
                f"a carrier of {carrier:g} cycles/mm needs RF samples closer than {0.5 / carrier:.4f} mm in depth; "
                f"got {grid.spacing[1]:g} mm"
            )
        from scipy import signal  # noqa: PLC0415  (SciPy's signals take longer to load than all else)

        analytic = signal.hilbert(np.asarray(rf, dtype=np.float32), axis=0)
        turn = np.exp(-2j * pi * carrier * grid.y).astype(np.complex64)
        return cls(analytic * turn[:, None], grid, carrier)

    def rf(self, sampling: float, sound_speed: float = 1.54) -> tuple[Floats, RegularGrid]:
        """Return real lines sampled at ``sampling`` MHz and the grid of their samples (band-limited interpolation)."""
        spacing = sound_speed / 2.0 / sampling
        if self.carrier * spacing >= 0.5:
            raise InputError(
                f"sampling must exceed {self.carrier * sound_speed:g} MHz for this carrier; got {sampling}"
            )
        (lines, rows), (dx, dy), (x0, y0) = self.grid.shape, self.grid.spacing, self.grid.origin
        factor = int(np.ceil(dy / spacing))
        from scipy import signal  # noqa: PLC0415  (as above)

        fine = signal.resample(self.iq, rows * factor, axis=0)[: (rows - 1) * factor + 1]
        n = int(np.floor((rows - 1) * dy / spacing)) + 1
        out = RegularGrid((lines, n), (dx, spacing), (x0, y0))
        at = (out.y - y0) / (dy / factor)
        k = np.minimum(at.astype(int), len(fine) - 2)
        w = (at - k)[:, None]
        baseband = (1.0 - w) * fine[k] + w * fine[k + 1]
        return np.real(baseband * np.exp(2j * pi * self.carrier * out.y)[:, None]), out

    def envelope(self) -> Floats:
        """Return the magnitude, shape (rows, lines)."""
        return np.abs(self.iq)

    def b_mode(self, display: Display | None = None, grid: RegularGrid | None = None) -> UltrasoundImage:
        """Return the log-compressed picture on ``grid``, which must be a sub-lattice of the samples (or their own grid)."""
        display = display or Display()
        grid = grid or self.grid
        rows, lines = _sub_lattice(self.grid, grid)
        return UltrasoundImage(display.grey(np.abs(self.iq[rows, lines])), grid)


@dataclass(frozen=True)
class EchoCine:
    """Frames of echoes on one grid, with their times; ``iq`` has shape (frames, rows, lines)."""

    iq: Complexes
    times: Floats
    grid: RegularGrid
    carrier: float

    def __post_init__(self) -> None:
        if self.iq.ndim != 3 or len(self.iq) == 0 or len(self.iq) != len(np.atleast_1d(self.times)):
            raise InputError(
                f"an echo cine has shape (frames, rows, lines) and one time per frame; "
                f"got {self.iq.shape} and {np.size(self.times)} times"
            )
        Echo(self.iq[0], self.grid, self.carrier)

    def __len__(self) -> int:
        return len(self.iq)

    def __iter__(self) -> Iterator[Echo]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Echo:
        """Return one frame."""
        return Echo(self.iq[index], self.grid, self.carrier)


def band_limited(iq: Complexes, factor: int, axis: int = 0) -> Complexes:
    """Refine samples ``factor`` times along an axis by zero-padding their spectrum."""
    if factor <= 1:
        return iq
    from scipy import signal  # noqa: PLC0415  (as above)

    return np.asarray(signal.resample(iq, iq.shape[axis] * factor, axis=axis))


def fourier_frequencies(n: int, spacing: float) -> Floats:
    """Return the frequencies of an n-point transform in cycles per mm."""
    return np.asarray(np.fft.fftfreq(n, spacing), dtype=np.float64)


def _sub_lattice(fine: RegularGrid, coarse: RegularGrid) -> tuple[slice, slice]:
    """Return the slices (rows, columns) that pick the points of ``coarse`` out of ``fine``."""
    step = np.divide(coarse.spacing, fine.spacing)
    start = fine.to_index(coarse.origin)
    whole = np.rint(np.concatenate([step, start])).astype(int)
    last = whole[2:] + whole[:2] * np.subtract(coarse.shape, 1)
    if (
        np.abs(np.concatenate([step, start]) - whole).max() > 1e-6
        or (whole < [1, 1, 0, 0]).any()
        or (last >= np.asarray(fine.shape)).any()
    ):
        raise InputError(
            f"a picture's pixels must lie on the echo samples: pixels {coarse.spacing} mm from {coarse.origin}, "
            f"samples {fine.spacing} mm from {fine.origin}"
        )
    columns, rows = (slice(int(whole[2 + i]), int(last[i]) + 1, int(whole[i])) for i in (0, 1))
    return rows, columns
