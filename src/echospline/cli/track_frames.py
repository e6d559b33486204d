"""Frames for ``echospline track``: pictures, echoes, RF lines and channel data, read one at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from echospline import laboratory
from echospline.errors import InputError
from echospline.io import LIMIT, LineCine, head, kind_of, open_cine, open_echoes, open_lines
from echospline.scene import Echo, Floats, RegularGrid

if TYPE_CHECKING:
    from echospline.tracking import Frame


@dataclass(frozen=True)
class FileFrames:
    """The frames of a file, decoded while they are iterated.

    Parameters
    ----------
    times : ndarray, shape (frames,)
        s.
    grid : RegularGrid
        Of the pixels or samples, mm.
    notes : tuple of str
        Conclusions and doubts of the reader.
    make : callable
        Starts an iteration.
    sample_bytes : int
        Of one pixel or sample in memory.
    """

    times: Floats
    grid: RegularGrid
    notes: tuple[str, ...]
    make: Callable[[], Iterator[Frame]] = field(repr=False)
    sample_bytes: int = 8

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Frame]:
        return self.make()

    def mib(self, points: int) -> float:
        """Return what a track of so many points needs, MiB: some frames and their fields, and the track itself."""
        pixels = self.grid.size * (4 * self.sample_bytes + 20 * 4)
        return (pixels + 2 * 24 * points * len(self)) / 2**20


@dataclass(frozen=True)
class Lines:
    """Options that describe RF lines or channel data.

    Parameters
    ----------
    frequency : float
        Centre frequency, MHz.
    sound_speed : float
        mm/us.
    variable : str, optional
        Name of the array in a Matlab or HDF5 file.
    axes : tuple of str, optional
        Meaning of its axes.
    pitch : float, optional
        Distance of elements, mm: the array holds channel data of plane waves sent straight ahead.
    sampling : float, optional
        Samples per microsecond; the file's own where not given.
    start : float
        Time of the first sample after transmission, us; of channel data.
    """

    frequency: float
    sound_speed: float = 1.54
    variable: str | None = None
    axes: tuple[str, ...] | None = None
    pitch: float | None = None
    sampling: float | None = None
    start: float = 0.0

    @property
    def carrier(self) -> float:
        """Cycles per mm of depth."""
        return 2.0 * self.frequency / self.sound_speed


def open_frames(
    cine: str,
    *,
    spacing: Sequence[float] | None = None,
    fps: float | None = None,
    crop: Sequence[int] | None = None,
    lines: Lines | None = None,
    limit: float = LIMIT,
) -> FileFrames:
    """Open a cine of pictures, echoes or lines.

    Raises
    ------
    InputError
        If the file holds no cine, or lacks what is needed.
    """
    path = Path(cine)
    if not cine.startswith("sample:") and path.is_file():
        if head(path).startswith(b"PK"):
            echoes = open_echoes(path, limit=limit)
            return _checked(cine, FileFrames(echoes.times, echoes.grid, (), lambda: iter(echoes)))
        if kind_of(path)[0] == "arrays":
            if lines is None:
                raise InputError(f"{cine} holds arrays: give --rf MHZ, the centre frequency of its lines")
            return _checked(cine, _of_arrays(cine, spacing, fps, lines, limit))
    if lines is not None and (lines.variable or lines.axes or lines.pitch):
        raise InputError(
            f"--variable, --axes and --channels are for Matlab and HDF5 files; {cine} is neither"
        )
    if cine.startswith("sample:"):
        raise InputError(f"{cine} holds one image; tracking needs a cine of two frames or more")
    stream = open_cine(cine, spacing=spacing, fps=fps, region=crop, limit=limit)

    def pictures() -> Iterator[Frame]:
        for image in stream.images():
            yield image if lines is None else Echo.from_rf(image.pixels, stream.grid, lines.carrier)

    return _checked(cine, FileFrames(stream.times, stream.grid, stream.notes, pictures))


def _checked(cine: str, frames: FileFrames) -> FileFrames:
    if len(frames) < 2:
        raise InputError(f"{cine} holds one image; tracking needs a cine of two frames or more")
    return frames


def _of_arrays(
    cine: str, spacing: Sequence[float] | None, fps: float | None, lines: Lines, limit: float
) -> FileFrames:
    found = open_lines(cine, variable=lines.variable, axes=lines.axes, limit=limit)
    fps = fps or found.fps
    if fps is None or not fps > 0:
        raise InputError(
            f"{cine} ({found.info.name}) does not say its frame rate: give --fps in frames per second"
        )
    times: Floats = np.arange(len(found)) / fps
    if lines.pitch is not None:
        return _of_channels(cine, found, times, spacing, lines)
    sampling = lines.sampling or found.sampling
    depth = lines.sound_speed / 2.0 / sampling if sampling else None
    if spacing is None:
        hint = f"; its samples lie {depth:.6g} mm apart in depth" if depth else ""
        raise InputError(
            f"{cine} ({found.info.name}) does not say how far apart its lines are{hint}: give --spacing LAT,DEPTH in mm"
        )
    samples, count = found.shape
    grid = RegularGrid((count, samples), (spacing[0], spacing[1]))
    notes = found.notes
    if depth and abs(spacing[1] / depth - 1.0) > 0.02:
        notes = (
            *notes,
            f"spacing {spacing[1]:.6g} mm in depth contradicts its sampling rate, which makes it {depth:.6g} mm",
        )

    def echoes() -> Iterator[Frame]:
        if found.complex:
            for frame in found:
                yield Echo(np.asarray(frame, dtype=np.complex128), grid, lines.carrier)
        else:
            for real in _scaled(found):
                yield Echo.from_rf(real, grid, lines.carrier)

    return FileFrames(times, grid, notes, echoes, sample_bytes=16)


def _of_channels(
    cine: str, found: LineCine, times: Floats, spacing: Sequence[float] | None, lines: Lines
) -> FileFrames:
    """Focus channel data of plane waves sent straight ahead."""
    sampling = lines.sampling or found.sampling
    if sampling is None or lines.pitch is None:
        raise InputError(f"{cine} ({found.info.name}) does not say its sampling rate: give --sampling in MHz")
    if found.complex:
        raise InputError(f"{cine} ({found.info.name}) is complex; channel data are real numbers")
    array = laboratory.LinearArray(lines.frequency, sampling, lines.pitch, lines.start, lines.sound_speed)
    samples, elements = found.shape
    # half a pitch, and eight samples to the period of the echo: the tracker needs six
    dx, dy = spacing or (lines.pitch / 2.0, 1.0 / array.carrier / 8.0)
    width = (elements - 1) * lines.pitch
    top = max(lines.start * lines.sound_speed / 2.0, 0.0)
    bottom = (lines.start + samples / sampling) * lines.sound_speed / 2.0
    shape = (int(width / dx) + 1, int((bottom - top) / dy) + 1)
    grid = RegularGrid(shape, (dx, dy), (-width / 2.0, top))

    def echoes() -> Iterator[Frame]:
        for real in _scaled(found):
            yield laboratory.delay_and_sum(laboratory.demodulate(real, array), array, grid)

    notes = (
        *found.notes,
        f"{elements} elements of {lines.pitch:g} mm focused on {shape[0]} x {shape[1]} points, x = 0 below their middle",
    )
    return FileFrames(times, grid, notes, echoes, sample_bytes=16)


def _scaled(found: LineCine) -> Iterator[Floats]:
    """Yield frames of any unit (newtons, volts, counts) in units of the first one's largest value."""
    scale = 0.0
    for frame in found:
        values = np.asarray(frame, dtype=np.float64)
        scale = scale or float(np.abs(values).max(initial=0.0))
        yield values / scale if scale > 0 else values
