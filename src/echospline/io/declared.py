"""The statements of a container about its pixels, followed in one place.

A reader collects them in a `Declared`; `followed` applies them to the pixels as stored: orientation, pixel aspect, rescale,
spacing, times, validity of frames, and whether the third axis is time or space. A statement that cannot be followed
becomes a note of the recording.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from echospline.io.recording import Recording
from echospline.scene import Floats, Pixels

LENGTHS = (1e-4, 20.0)
"""Least and largest distance of pixels in mm that a picture of tissue can have; a value beyond is no length."""
INTERVALS = (1e-5, 3600.0)
"""Least and largest mean interval of frames in s; a clock beyond is none."""
DISAGREE = 0.02
"""Relative difference of two statements about one quantity that is worth a note."""


@dataclass(frozen=True)
class Turn:
    """Orientation of the shown picture: the stored axes exchanged first, then flipped."""

    transposed: bool = False
    flip_lateral: bool = False
    flip_depth: bool = False

    @classmethod
    def of_exif(cls, number: object) -> Self:
        """Return the turn of an EXIF or TIFF orientation, 1 to 8; no turn for any other value."""
        if not isinstance(number, int) or number not in _EXIF:
            return cls()
        return cls(*_EXIF[number])

    @classmethod
    def of_matrix(cls, a: float, b: float, c: float, d: float) -> Self | None:
        """Return the turn of a display matrix, (x, y) -> (a x + c y, b x + d y); None for any other angle."""
        size = max(abs(a), abs(b), abs(c), abs(d))
        if not (isfinite(size) and size > 0):
            return None
        a, b, c, d = (v / size for v in (a, b, c, d))
        if max(abs(b), abs(c)) < 1e-3 and min(abs(a), abs(d)) > 0.99:
            return cls(False, a < 0, d < 0)
        if max(abs(a), abs(d)) < 1e-3 and min(abs(b), abs(c)) > 0.99:
            return cls(True, c < 0, b < 0)
        return None

    @classmethod
    def of_letters(cls, letters: str) -> Self | None:
        """Return the turn to MF from letters of PLUS: M or U (marked side or not), F or N (far or near); None for others."""
        pair = letters.strip()[:2]
        if len(pair) != 2 or not ({*pair} & {*"MU"} and {*pair} & {*"FN"}):
            return None
        return cls(pair[0] in "FN", "U" in pair, "N" in pair)

    def __bool__(self) -> bool:
        return self.transposed or self.flip_lateral or self.flip_depth

    def of_pixels(self, stored: Pixels) -> Pixels:
        """Return a frame (rows, columns[, 3]) as it is shown."""
        shown = stored.swapaxes(0, 1) if self.transposed else stored
        return shown[:: -1 if self.flip_depth else 1, :: -1 if self.flip_lateral else 1]

    def named(self) -> str:
        """Describe the turn."""
        if self.transposed:
            turn = {(True, False): "90 degrees clockwise", (False, True): "90 degrees anticlockwise"}
            return turn.get((self.flip_lateral, self.flip_depth), "rows and columns exchanged")
        if self.flip_lateral and self.flip_depth:
            return "180 degrees"
        return "mirrored left to right" if self.flip_lateral else "mirrored top to bottom"


_EXIF = {
    1: (False, False, False), 2: (False, True, False), 3: (False, True, True), 4: (False, False, True),
    5: (True, False, False), 6: (True, True, False), 7: (True, True, True), 8: (True, False, True),
}  # fmt: skip


@dataclass(frozen=True)
class Lengths:
    """One statement about the distance of pixels.

    Parameters
    ----------
    spacing : (first, second)
        mm along the stored axes, or along the shown ones when ``shown``.
    source : str
        The field, for notes.
    shown : bool
        Whether it belongs to the picture after its turn (a calibration does).
    one_is_unknown : bool
        Whether 1 x 1 is the value that writers put where nothing is known.
    """

    spacing: tuple[float, float]
    source: str
    shown: bool = False
    one_is_unknown: bool = False


@dataclass(frozen=True)
class Clock:
    """One statement about the times of frames: seconds, shape (frames,), or the fault that leaves none."""

    source: str
    seconds: NDArray[np.floating[Any]] | None
    fault: str = ""


@dataclass(frozen=True)
class Declared:
    """All statements of a container; where several speak of one quantity, the first that is plausible is followed.

    Parameters
    ----------
    turn : Turn
        From stored to shown pixels.
    turned_by : str
        The field that says so.
    aspect : float, optional
        Width over height of a stored pixel.
    rescale : (slope, intercept)
        Value = slope * stored + intercept.
    lengths : tuple of Lengths
        Distances of pixels.
    clocks : tuple of Clock
        Times of frames.
    valid : ndarray, shape (frames,), bool, optional
        Frames that the container calls good.
    volume : str
        Why the third axis is a direction in space; empty when it is time.
    window : (low, high), optional
        Values that the container asks to be shown as black and white.
    """

    turn: Turn = Turn()
    turned_by: str = ""
    aspect: float | None = None
    rescale: tuple[float, float] = (1.0, 0.0)
    lengths: tuple[Lengths, ...] = ()
    clocks: tuple[Clock, ...] = ()
    valid: NDArray[np.bool_] | None = None
    volume: str = ""
    window: tuple[float, float] | None = None


def followed(stored: Recording, said: Declared) -> Recording:
    """Return the recording with the container's statements applied to it, and notes on every one that changes it.

    Parameters
    ----------
    stored : Recording
        Pixels as stored, without spacing and times.
    said : Declared
        The container's statements.
    """
    notes = list(stored.notes)
    valid = _checked_validity(said.valid, stored.frames, notes)
    if said.turn:
        notes.append(f"{said.turned_by or 'its orientation'} is followed: {said.turn.named()}")
    aspect = _shown_aspect(said, notes)
    spacing = _spacing(said, aspect, notes)
    times, untimed = (
        _times(said.clocks, stored.frames, valid, notes)
        if stored.frames > 1 and not said.volume
        else (None, "")
    )
    if said.volume and stored.frames > 1:
        notes.append(f"a volume of {stored.frames} slices, not a cine: {said.volume}")
    slope, intercept = said.rescale
    if not (isfinite(slope) and isfinite(intercept) and slope != 0):
        notes.append(f"its rescale slope {slope:g} and intercept {intercept:g} are no scale: not applied")
        slope, intercept = 1.0, 0.0
    dtype = stored.dtype
    if (slope, intercept) != (1.0, 0.0):
        dtype = np.dtype(np.float32 if dtype.itemsize <= 2 or dtype == np.dtype(np.float32) else np.float64)
        notes.append(
            f"rescaled as it says: {slope:g} x value {'-' if intercept < 0 else '+'} {abs(intercept):g}"
        )

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        for pixels in stored.decode(frame, colour):
            if (slope, intercept) == (1.0, 0.0):
                yield said.turn.of_pixels(pixels)
            else:
                yield said.turn.of_pixels((pixels.astype(np.float64) * slope + intercept).astype(dtype))

    rows, columns = stored.rows, stored.columns
    if said.turn.transposed:
        rows, columns = columns, rows
    return replace(
        stored, rows=rows, columns=columns, dtype=dtype, decode=decode, spacing=spacing, aspect=aspect, times=times,
        untimed=untimed, valid=valid, volume=bool(said.volume) and stored.frames > 1, window=_window(said.window),
        notes=tuple(notes),
    )  # fmt: skip


def aspect_note(aspect: float | None, spacing: tuple[float, float] | None) -> str:
    """Return the doubt about a spacing (lateral, depth) that contradicts the aspect of pixels; empty when it does not."""
    if aspect is None or spacing is None or abs(spacing[0] / spacing[1] / aspect - 1.0) <= DISAGREE:
        return ""
    return (
        f"spacing {spacing[0]:.6g} x {spacing[1]:.6g} mm contradicts the file, whose pixels are {aspect:.4g} times as wide "
        "as high"
    )


def _checked_validity(
    valid: NDArray[np.bool_] | None, frames: int, notes: list[str]
) -> NDArray[np.bool_] | None:
    if valid is None or valid.all():
        return None
    if not valid.any():
        notes.append("the file calls none of its frames good")
        return valid
    bad = np.flatnonzero(~valid)
    notes.append(
        f"{len(bad)} of {frames} frames are not good by the file's own status (the first is frame {bad[0]}): left out"
    )
    return valid


def _shown_aspect(said: Declared, notes: list[str]) -> float | None:
    aspect = said.aspect
    if aspect is None or not (isfinite(aspect) and 0.1 <= aspect <= 10.0):
        return None
    aspect = 1.0 / aspect if said.turn.transposed else aspect
    if abs(aspect - 1.0) > 1e-6:
        notes.append(f"its pixels are not square: the lateral spacing is {aspect:.6g} times that in depth")
    return aspect


def _spacing(said: Declared, aspect: float | None, notes: list[str]) -> tuple[float, float] | None:
    good: list[tuple[tuple[float, float], str]] = []
    for length in said.lengths:
        first, second = length.spacing
        if not all(isfinite(h) and LENGTHS[0] <= h <= LENGTHS[1] for h in (first, second)):
            notes.append(f"{length.source} {first:g} x {second:g} mm is no distance of pixels: passed over")
            continue
        if length.one_is_unknown and first == second == 1.0:
            if not good:
                notes.append(
                    f"{length.source} is exactly 1 x 1 mm, which writers put where nothing is known: not taken"
                )
            continue
        shown = (second, first) if said.turn.transposed and not length.shown else (first, second)
        good.append((shown, length.source))
    if not good:
        return None
    spacing, source = good[0]
    for other, name in good[1:]:
        if max(abs(a / b - 1.0) for a, b in zip(other, spacing, strict=True)) > DISAGREE:
            notes.append(
                f"{name} says {other[0]:.6g} x {other[1]:.6g} mm, {source} {spacing[0]:.6g} x {spacing[1]:.6g} mm: "
                "the latter taken"
            )
    if doubt := aspect_note(aspect, spacing):
        notes.append(doubt)
    return spacing


def _times(
    clocks: tuple[Clock, ...], frames: int, valid: NDArray[np.bool_] | None, notes: list[str]
) -> tuple[Floats | None, str]:
    good: list[tuple[Floats, str]] = []
    faults: list[str] = []
    if valid is not None and not valid.any():
        valid = None
    for clock in clocks:
        fault = clock.fault or _fault(clock.seconds, frames, valid)
        if fault:
            faults.append(f"{clock.source} {fault}")
        elif clock.seconds is not None:
            good.append((np.asarray(clock.seconds, dtype=np.float64), clock.source))
    if not good:
        return None, "; ".join(faults)
    notes += [f"{fault}: passed over" for fault in faults]
    times, source = good[0]
    kept = slice(None) if valid is None else valid
    times = times - times[kept][0]
    span = float(times[kept][-1])
    for other, name in good[1:]:
        length = float(other[kept][-1] - other[kept][0])
        if span > 0 and abs(length / span - 1.0) > DISAGREE:
            notes.append(f"{name} makes it {length:.6g} s long, {source} {span:.6g} s: the latter taken")
    return times, ""


def _fault(seconds: NDArray[np.floating[Any]] | None, frames: int, valid: NDArray[np.bool_] | None) -> str:
    """Return why these are no times of frames; empty when they are."""
    if seconds is None or np.shape(seconds) != (frames,):
        return f"gives {np.size(seconds) if seconds is not None else 'no'} times for {frames} frames"
    kept = np.asarray(seconds, dtype=np.float64)[slice(None) if valid is None else valid]
    if not np.isfinite(kept).all():
        return "holds a time that is no number"
    if (np.diff(kept) < 0).any():
        return "goes back in time"
    interval = float(kept[-1] - kept[0]) / (len(kept) - 1) if len(kept) > 1 else 1.0
    return "" if INTERVALS[0] <= interval <= INTERVALS[1] else f"puts its frames {interval:g} s apart"


def _window(window: tuple[float, float] | None) -> tuple[float, float] | None:
    if window is None or not (isfinite(window[0]) and isfinite(window[1]) and window[0] < window[1]):
        return None
    return window
