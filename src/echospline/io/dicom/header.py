"""Statements of a DICOM header about its pixels: times, lengths, aspect, rescale, window, and the meaning of the frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pydicom

from echospline.io.declared import Clock, Declared, Lengths
from echospline.io.dicom.regions import pixel_spacing

FRAME_TIME, FRAME_TIME_VECTOR = 0x00181063, 0x00181065
_VOLUME_CLASSES = {
    "1.2.840.10008.5.1.4.1.1.6.2": "Enhanced US Volume Storage",
    "1.2.840.10008.5.1.4.1.1.2.1": "Enhanced CT Image Storage",
    "1.2.840.10008.5.1.4.1.1.4.1": "Enhanced MR Image Storage",
    "1.2.840.10008.5.1.4.1.1.130": "Enhanced PET Image Storage",
}
"""Classes whose frames are slices."""


def declared(header: pydicom.Dataset, frames: int, region_spacing: tuple[float, float] | None) -> Declared:
    """Collect the statements of a header.

    Parameters
    ----------
    header : Dataset
        Without pixels.
    frames : int
        Number of frames.
    region_spacing : (lateral, depth), optional
        mm per pixel of the ultrasound region that is kept; it goes before Pixel Spacing.
    """
    lengths = []
    if region_spacing:
        lengths.append(Lengths(region_spacing, "its ultrasound region"))
    elif plain := pixel_spacing(header):
        lengths.append(Lengths(plain, "Pixel Spacing"))
    return Declared(
        aspect=_aspect(header),
        rescale=_rescale(header),
        lengths=tuple(lengths),
        clocks=_clocks(header, frames) if frames > 1 else (),
        volume=_volume(header, frames),
        window=_window(header),
    )


def _clocks(header: pydicom.Dataset, frames: int) -> tuple[Clock, ...]:
    """Return the sources of times, best first.

    Frame Increment Pointer (0028,0009) names the attribute that steps from frame to frame (PS3.3 C.7.6.6), so that one
    goes before the others; then Frame Time Vector, Frame Time (both ms), Cine Rate and the recommended rate (1/s).
    """
    found: dict[int, Clock] = {}
    vector = header.get("FrameTimeVector")
    if vector is not None:
        steps = np.array([_number(step) for step in np.atleast_1d(vector)]) / 1000.0
        if len(steps):
            steps[0] = 0.0
        fault = f"holds {len(steps)} steps for {frames} frames" if len(steps) != frames else ""
        found[FRAME_TIME_VECTOR] = Clock("Frame Time Vector", np.cumsum(steps), fault)
    if header.get("FrameTime") is not None:
        found[FRAME_TIME] = Clock("Frame Time", np.arange(frames) * _number(header.FrameTime) / 1000.0)
    pointed = {int(tag) for tag in np.atleast_1d(header.get("FrameIncrementPointer") or [])}
    order = sorted((FRAME_TIME_VECTOR, FRAME_TIME), key=lambda tag: tag not in pointed)
    clocks = [found[tag] for tag in order if tag in found]
    rates = (("CineRate", "Cine Rate"), ("RecommendedDisplayFrameRate", "Recommended Display Frame Rate"))
    for key, name in rates:
        rate = _number(header.get(key))
        # a rate of display is no statement about the recording where that has times of its own
        if rate > 0 and not (clocks and key.startswith("Recommended")):
            clocks.append(Clock(name, np.arange(frames) / rate))
    return tuple(clocks)


def _number(value: Any) -> float:
    """Return a value of a header as a number; NaN where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def _aspect(header: pydicom.Dataset) -> float | None:
    """Return width over height of a pixel from Pixel Aspect Ratio, which is written height first."""
    value = header.get("PixelAspectRatio")
    if value is None or len(np.atleast_1d(value)) != 2:
        return None
    vertical, horizontal = (_number(v) for v in value)
    return horizontal / vertical if vertical > 0 and horizontal > 0 else None


def _rescale(header: pydicom.Dataset) -> tuple[float, float]:
    slope, intercept = header.get("RescaleSlope"), header.get("RescaleIntercept")
    if slope is None and intercept is None:
        return 1.0, 0.0
    return (
        1.0 if slope is None else _number(slope),
        0.0 if intercept is None else _number(intercept),
    )


def _window(header: pydicom.Dataset) -> tuple[float, float] | None:
    """Return the first Window Center and Width as (low, high): from PS3.3 C.11.2.1.2."""
    centre, width = (
        _number(np.atleast_1d(header[key].value)[0])
        if key in header and np.size(header[key].value)
        else float("nan")
        for key in ("WindowCenter", "WindowWidth")
    )
    if not width > 1:
        return None
    return centre - 0.5 - (width - 1) / 2, centre - 0.5 + (width - 1) / 2


def _volume(header: pydicom.Dataset, frames: int) -> str:
    """Return why the frames are slices; empty when they are moments."""
    kind = str(header.get("SOPClassUID", ""))
    if kind in _VOLUME_CLASSES:
        return f"it is of class {_VOLUME_CLASSES[kind]}"
    positions = set()
    for item in header.get("PerFrameFunctionalGroupsSequence") or ():
        plane = (item.get("PlanePositionSequence") or [pydicom.Dataset()])[0]
        positions.add(tuple(_number(v) for v in plane.get("ImagePositionPatient") or ()))
    if frames > 1 and len(positions) == frames:
        return "each frame has its own Image Position (Patient)"
    return ""
