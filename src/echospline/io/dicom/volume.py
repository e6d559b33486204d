"""Volumes in DICOM: frames that are slices, each with its place in the frame of reference (PS3.3 A.59, C.7.6.16.2.21 and 22)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.io.dicom.opening import open_dicom, quiet
from echospline.io.dicom.pixels import read_dataset
from echospline.io.recording import Recording, decoding
from echospline.scene import Floats

EVEN = 0.01
"""Of the spacing of slices, by which the places of slices may be uneven or aside."""
UNIT = 1e-3
"""By which directions may miss unit length and right angles: they are written with four digits and more."""
_PLACES = (
    ("PlanePositionVolumeSequence", "ImagePositionVolume"),
    ("PlanePositionSequence", "ImagePositionPatient"),
)
_TURNS = (
    ("PlaneOrientationVolumeSequence", "ImageOrientationVolume"),
    ("PlaneOrientationSequence", "ImageOrientationPatient"),
)
_LENGTHS = (("PixelMeasuresSequence", "PixelSpacing"),)


def open_dicom_volume(
    path: Path, limit: float
) -> tuple[Recording, NDArray[np.intp], tuple[float, float, float], Floats]:
    """Open an enhanced DICOM file whose frames are the slices of one volume.

    Parameters
    ----------
    path : Path
        The file.
    limit : float
        MiB of decoded pixels.

    Returns
    -------
    recording : Recording
        Its frames in the order of the file.
    order : ndarray of int, shape (frames,)
        Frames from the first slice to the last.
    spacing : (x, y, z)
        Between columns, rows and slices, mm.
    direction : ndarray, shape (3, 3)
        Columns: unit vectors along a row, down a column and from slice to slice, in the file's frame of reference.

    Raises
    ------
    InputError
        If the file is damaged or too large, or its frames are not slices at even distances, one per place.
    """
    recording = open_dicom(path, limit)
    with decoding(path, "DICOM"), quiet():
        header = read_dataset(path, stop_before_pixels=True)
        frames = list(header.get("PerFrameFunctionalGroupsSequence") or ())
        shared = (list(header.get("SharedFunctionalGroupsSequence") or ()) or [pydicom.Dataset()])[0]
        if not frames:
            raise InputError(
                f"{path} does not say where its frames lie (Per-frame Functional Groups): a volume is an Enhanced US Volume, or MetaImage, NRRD "
                "or NIfTI; a cine is a picture of the plane"
            )
        if len(frames) != recording.frames:
            raise InputError(
                f"{path} holds {recording.frames} frames but says where {len(frames)} lie: it is damaged"
            )
        places = _same_frame(path, frames, shared, _PLACES, 3, "position")
        turns = _same_frame(path, frames, shared, _TURNS, 6, "orientation")
        lengths = _same_frame(path, frames, shared, _LENGTHS, 2, "pixel spacing")
        for name, values in (("orientation", turns), ("pixel spacing", lengths)):
            if np.ptp(values, axis=0).max() > UNIT:
                raise InputError(f"{path} has slices of different {name}; a volume has one for all")
        row, column = turns[0, :3], turns[0, 3:]
        if max(abs(row @ row - 1), abs(column @ column - 1), abs(row @ column)) > UNIT:
            raise InputError(
                f"{path} has an orientation of {turns[0].tolist()}; expected two unit vectors at right angles: it is damaged"
            )
        if not lengths[0].min() > 0:
            raise InputError(
                f"{path} has a pixel spacing of {lengths[0].tolist()} mm; expected two positive lengths"
            )
        normal = np.cross(row, column)
        order = np.argsort(places @ normal, kind="stable")
        gap = _gap(path, places[order], normal)
    spacing = float(lengths[0, 1]), float(lengths[0, 0]), gap  # DICOM names the distance of rows first
    return recording, order, spacing, np.stack([row, column, normal], axis=1)


def _gap(path: Path, places: Floats, normal: Floats) -> float:
    """Return the distance between slices, mm, from their places in order."""
    if len(places) < 2:
        raise InputError(f"{path} has one slice; a volume has two or more")
    gaps = np.diff(places @ normal)
    gap = float((places[-1] - places[0]) @ normal) / len(gaps)
    if gaps.min() < EVEN * max(gap, 1e-6):
        raise InputError(
            f"{path} has several frames at one place: volumes at several moments, or several kinds of data; write one volume to a file"
        )
    if np.abs(gaps - gap).max() > EVEN * gap:
        raise InputError(
            f"{path} has slices {gaps.min():.3g} to {gaps.max():.3g} mm apart; a volume has even slices: resample it"
        )
    aside = places - places[0] - np.outer((places - places[0]) @ normal, normal)
    if np.linalg.norm(aside, axis=1).max() > EVEN * gap * len(gaps):
        raise InputError(
            f"{path} has slices that are shifted aside or turned against each other, as a fan is; a volume has one lattice: scan-convert it"
        )
    return gap


def _same_frame(
    path: Path,
    frames: list[pydicom.Dataset],
    shared: pydicom.Dataset,
    names: tuple[tuple[str, str], ...],
    count: int,
    what: str,
) -> Floats:
    """Return one statement of every frame, shape (frames, count), by the first name by which all frames have it."""
    for sequence, element in names:
        found = [_stated(frame, sequence, element) or _stated(shared, sequence, element) for frame in frames]
        if all(found):
            break
    else:
        raise InputError(
            f"{path} does not state the {what} of every frame ({names[0][1]}): it is no volume, or damaged"
        )
    if any(len(values) != count for values in found):
        raise InputError(
            f"{path} states a {what} of {min(map(len, found))} numbers; expected {count}: it is damaged"
        )
    numbers = np.array(found, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise InputError(f"{path} states a {what} that is not finite: it is damaged")
    return numbers


def _stated(group: pydicom.Dataset, sequence: str, element: str) -> list[float]:
    """Return the numbers of an element in the first item of a sequence; empty where it is not there."""
    items: Any = group.get(sequence)
    value = items[0].get(element) if items else None
    return [] if value is None else [float(v) for v in np.atleast_1d(value)]


def slices(recording: Recording, order: NDArray[np.intp]) -> Iterator[NDArray[np.generic]]:
    """Yield the pixels of the slices in their order."""
    every = list(recording.decode(None, False))
    for index in order:
        yield every[int(index)]
