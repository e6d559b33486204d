"""DICOM B-mode, single and multi-frame: spacing and tissue region from its ultrasound regions, pixels through pydicom."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from math import ceil, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from pydicom.encaps import get_frame
from pydicom.pixels.processing import apply_color_lut
from pydicom.pixels.utils import iter_pixels
from pydicom.uid import (
    JPEG2000,
    UID,
    DeflatedExplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGBaseline8Bit,
    JPEGExtended12Bit,
    JPEGLossless,
    JPEGLosslessSV1,
    JPEGLSLossless,
    JPEGLSNearLossless,
    RLELossless,
)

from echospline.errors import InputError, MissingExtraError
from echospline.grid import Floats
from echospline.image import Pixels
from echospline.io.lossless import lossless_frames
from echospline.io.recording import MIB, Box, Recording, Region, check_size, decoding, quietly

_CENTIMETRE = 3
"""Code of cm in Physical Units X/Y Direction (0018,6024/6026)."""
_SPATIAL = {1: "2-D", 2: "M-mode", 3: "spectral", 4: "wave form", 5: "graphics"}
_DATA = {1: "tissue", 2: "colour flow", 3: "PW Doppler", 4: "CW Doppler", 0x0A: "ECG", 0x12: "colour bar"}
_PILLOW = (JPEGBaseline8Bit, JPEGExtended12Bit, JPEG2000, JPEG2000Lossless)
_GDCM = (JPEGLossless, JPEGLosslessSV1, JPEGLSLossless, JPEGLSNearLossless)
"""Transfer syntaxes by who decodes them."""
_MOST_SHRUNK = 8
"""How many times smaller than its own regions a picture is taken to be."""
_DEFLATE = 1032
"""The most that deflate can compress, so the most that a deflated file can hold per byte."""
_DEFERRED = 2**16
"""Elements longer than this (private data, mostly) stay on the disk."""


def open_dicom(path: Path, limit: float) -> Recording:
    """Open a DICOM file.

    Parameters
    ----------
    path : Path
        With the DICM mark at byte 128.
    limit : float
        MiB of decoded pixels.

    Raises
    ------
    InputError
        If the file is damaged, too large or holds no picture.
    MissingExtraError
        If its compression needs the extra ``dicom``.
    """
    with decoding(path, "DICOM"), _quiet():
        _check_deflated(path, limit)
        header = pydicom.dcmread(path, stop_before_pixels=True, defer_size=_DEFERRED)
        missing = [
            name for name in ("Rows", "Columns", "PhotometricInterpretation") if header.get(name) is None
        ]
        if missing:
            raise InputError(
                f"{path} is DICOM without {' and '.join(missing)}: it holds no picture (a report?)"
            )
        rows, columns, frames = int(header.Rows), int(header.Columns), int(header.get("NumberOfFrames") or 1)
        colours = str(header.PhotometricInterpretation)
        channels = 3 if colours.startswith(("RGB", "YBR", "PALETTE")) else 1
        if channels == 1 and not colours.startswith("MONOCHROME"):
            raise InputError(
                f"{path} has pixels of kind {colours}; expected MONOCHROME, RGB, YBR or PALETTE COLOR"
            )
        palette = colours.startswith("PALETTE")
        stored_dtype = _dtype(path, header)
        dtype = np.dtype(np.uint8) if palette else stored_dtype
        check_size(path, rows, columns, frames, channels * dtype.itemsize, limit)
        _check_decoder(path, header)
        regions, notes = _regions(header, rows, columns)
        tissue = _tissue(regions)
        notes += _doubts(header, regions, tissue, (0, 0, columns, rows))
        times = _times(header, frames)
        mislabelled = _mislabelled(path, header)
        if mislabelled:
            notes.append("labelled RGB but its JPEG frames hold YCbCr: converted")
        syntax = header.file_meta.TransferSyntaxUID
        stored = int(header.get("BitsStored") or dtype.itemsize * 8)
        spacing = tissue.spacing if tissue else _pixel_spacing(header)

    def shown(frame: int | None) -> Iterator[Pixels]:
        shape = (rows, columns, 3) if channels == 3 and not palette else (rows, columns)
        if syntax in _GDCM:
            raws = lossless_frames(path, shape, stored_dtype, frame, syntax.name)
        else:
            raws = _raw_frames(path, syntax, frame, mislabelled)
        for raw in raws:
            if palette:
                yield _coloured(raw, header)
            else:
                yield _upright(raw, stored) if colours == "MONOCHROME1" else raw

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        count = 0
        with decoding(path, "DICOM"):
            for pixels in quietly(shown(frame), _quiet):
                if pixels.shape[:2] != (rows, columns):
                    raise InputError(
                        f"{path} declares {columns} x {rows} pixels but a frame has {pixels.shape[1::-1]}"
                    )
                yield pixels.astype(dtype, copy=False)
                count += 1
            if frame is None and count != frames:
                raise InputError(f"{path} declares {frames} frames but holds {count}: it is cut short")

    return Recording(
        path, f"DICOM, {syntax.name}", rows, columns, frames, channels, dtype, decode,
        spacing=spacing, region=tissue.box if tissue else None,
        regions=regions, times=times, single=frames == 1, notes=tuple(notes),
    )  # fmt: skip


def _raw_frames(path: Path, syntax: UID, frame: int | None, mislabelled: bool) -> Iterator[Pixels]:
    """Frames as pydicom decodes them, read from the disk one by one (a deflated file only as a whole).

    The decoder is named, for pydicom would prefer GDCM where that is installed (see `echospline.io.lossless`).
    """
    options: dict[str, Any] = {"photometric_interpretation": "YBR_FULL"} if mislabelled else {}
    source: Any = pydicom.dcmread(path) if syntax == DeflatedExplicitVRLittleEndian else path
    plugin = "pillow" if syntax in _PILLOW else ""
    return iter_pixels(source, indices=None if frame is None else [frame], decoding_plugin=plugin, **options)


def _coloured(indices: Pixels, header: pydicom.Dataset) -> Pixels:
    """Palette colours as 8-bit RGB; 16-bit entries carry their 8 bits in the upper byte, as displays take them."""
    colours: Any = apply_color_lut(indices, header)
    eight: Pixels = (colours >> 8 if colours.max(initial=0) > 255 else colours).astype(np.uint8)
    return eight


@contextmanager
def _quiet() -> Iterator[None]:
    """Pydicom warns and logs every oddity of a header; those that matter here become notes or errors."""
    logger = logging.getLogger("pydicom")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _check_deflated(path: Path, limit: float) -> None:
    """Pydicom inflates a deflated file whole, so its size must be bounded before."""
    meta = pydicom.filereader.read_file_meta_info(path)
    size = path.stat().st_size * _DEFLATE / MIB
    if meta.get("TransferSyntaxUID") == DeflatedExplicitVRLittleEndian and size > limit:
        raise InputError(
            f"{path} is deflated DICOM that may inflate to {size:,.0f} MiB, more than the limit of {limit:,.0f} MiB: "
            "raise the limit if the file is trusted"
        )


def _check_decoder(path: Path, header: pydicom.Dataset) -> None:
    """Refuse what cannot be decoded before any pixel is wanted."""
    syntax = header.file_meta.TransferSyntaxUID
    known = (*_PILLOW, *_GDCM, RLELossless, DeflatedExplicitVRLittleEndian)
    if syntax.is_compressed and (
        syntax not in known or (syntax == JPEGExtended12Bit and header.get("BitsStored") != 8)
    ):
        raise InputError(
            f"{path} is compressed as {syntax.name} with {header.get('BitsStored')} bits, for which there is no "
            "decoder: export it uncompressed"
        )
    if syntax in _GDCM and find_spec("gdcm") is None:
        raise MissingExtraError("python-gdcm", "dicom", f"DICOM compressed as {syntax.name}")


def _dtype(path: Path, header: pydicom.Dataset) -> np.dtype[Any]:
    bits = int(header.get("BitsAllocated", 8))
    if bits not in (8, 16, 32):
        raise InputError(f"{path} has {bits} bits per pixel; expected 8, 16 or 32")
    signed = int(header.get("PixelRepresentation", 0)) == 1
    return np.dtype(f"{'i' if signed else 'u'}{bits // 8}")


def _upright(pixels: Pixels, stored: int) -> Pixels:
    """MONOCHROME1, whose lowest value is white, the other way round."""
    top = 2**stored - 1 if pixels.dtype.kind == "u" else -1
    inverted: Pixels = (top - pixels.astype(np.int64)).astype(pixels.dtype)
    return inverted


def _regions(header: pydicom.Dataset, rows: int, columns: int) -> tuple[tuple[Region, ...], list[str]]:
    """Ultrasound regions (0018,6011) in pixels of this picture.

    Who shrinks a picture often keeps the regions of the large one: when they reach beyond the picture both ways, the
    smallest whole factor that makes them fit is undone. When they do so one way only, the picture was cut there, and
    the spacing holds. A note says which was taken.
    """
    found = []
    for item in header.get("SequenceOfUltrasoundRegions") or ():
        edges = [item.get(f"RegionLocation{name}") for name in ("MinX0", "MinY0", "MaxX1", "MaxY1")]
        if any(edge is None for edge in edges):
            continue
        x0, y0, x1, y1 = (int(edge) for edge in edges)
        content = f"{_SPATIAL.get(item.get('RegionSpatialFormat'), 'other')} {_DATA.get(item.get('RegionDataType'), 'data')}"
        if 0 <= x0 <= x1 and 0 <= y0 <= y1:
            found.append(Region((x0, y0, x1 + 1, y1 + 1), _region_spacing(item), content))
    if not found:
        return (), []
    # The last column is often given as the number of columns: one too many is no other matrix.
    across = max((r.box[2] - 1) / columns for r in found)
    down = max((r.box[3] - 1) / rows for r in found)
    notes = []
    factor = 1
    if min(across, down) > 1:
        factor = ceil(max(across, down))
        if factor > _MOST_SHRUNK:
            return (), [
                f"its ultrasound regions reach {max(across, down):.0f} times beyond the picture: not used"
            ]
        notes.append(
            f"its ultrasound regions are for a picture {factor} times as large ({columns * factor} x {rows * factor}): "
            f"boxes divided and spacing multiplied by {factor}"
        )
    elif max(across, down) > 1:
        side = "right" if across > 1 else "bottom"
        notes.append(
            f"its ultrasound regions reach beyond the {side} edge: the picture was cut there, spacing kept"
        )
    return tuple(r for r in (_shrunk(r, factor, rows, columns) for r in found) if r), notes


def _doubts(
    header: pydicom.Dataset, regions: tuple[Region, ...], tissue: Region | None, whole: Box
) -> list[str]:
    notes = []
    if sum(r.spacing is not None for r in regions) > 1 and tissue:
        notes.append(f"{len(regions)} regions: {tissue.content} at {tissue.box} taken")
    if tissue and tissue.box == whole:
        notes.append(
            "its region is the whole picture, margins and text included: give a region to cut them off"
        )
    if header.get("Modality", "US") not in ("US", "IVUS"):
        notes.append(f"modality {header.Modality}, not ultrasound")
    return notes


def _shrunk(region: Region, factor: int, rows: int, columns: int) -> Region | None:
    """Return the part of a region inside this picture, whole pixels only; None when there is none."""
    left, top, right, bottom = region.box
    box: Box = (
        ceil(left / factor), ceil(top / factor), min(right // factor, columns), min(bottom // factor, rows)
    )  # fmt: skip
    if box[0] >= box[2] or box[1] >= box[3]:
        return None
    spacing = region.spacing and (region.spacing[0] * factor, region.spacing[1] * factor)
    return replace(region, box=box, spacing=spacing)


def _region_spacing(item: pydicom.Dataset) -> tuple[float, float] | None:
    """Mm per pixel from Physical Delta X/Y, which are in cm when the units' code is 3."""
    units = (item.get("PhysicalUnitsXDirection"), item.get("PhysicalUnitsYDirection"))
    deltas = (item.get("PhysicalDeltaX"), item.get("PhysicalDeltaY"))
    if units != (_CENTIMETRE, _CENTIMETRE) or None in deltas:
        return None
    # The sign tells which way the physical axis points, not how large a pixel is.
    dx, dy = (round(abs(float(delta)) * 10.0, 12) for delta in deltas)
    return (dx, dy) if isfinite(dx) and isfinite(dy) and min(dx, dy) > 0 else None


def _tissue(regions: tuple[Region, ...]) -> Region | None:
    """Largest 2-D region with lengths; tissue before colour flow before others."""
    order = {"2-D tissue": 2, "2-D colour flow": 1}

    def rank(region: Region) -> tuple[int, int]:
        left, top, right, bottom = region.box
        return order.get(region.content, 0), (right - left) * (bottom - top)

    return max((r for r in regions if r.spacing and r.content.startswith("2-D")), key=rank, default=None)


def _pixel_spacing(header: pydicom.Dataset) -> tuple[float, float] | None:
    """(lateral, depth) from Pixel Spacing, whose order is rows (depth) first."""
    shared = header.get("SharedFunctionalGroupsSequence") or [pydicom.Dataset()]
    measures = shared[0].get("PixelMeasuresSequence") or [pydicom.Dataset()]
    value = header.get("PixelSpacing") or measures[0].get("PixelSpacing")
    if value is None or len(value) != 2:
        return None
    depth, lateral = float(value[0]), float(value[1])
    return (lateral, depth) if isfinite(lateral) and isfinite(depth) and min(lateral, depth) > 0 else None


def _times(header: pydicom.Dataset, frames: int) -> Floats | None:
    """Seconds since the first frame from Frame Time Vector, Frame Time (both ms) or a rate."""
    vector = header.get("FrameTimeVector")
    if vector is not None and len(np.atleast_1d(vector)) == frames:
        steps = np.array([float(step) for step in np.atleast_1d(vector)]) / 1000.0
        steps[0] = 0.0
        ascending: Floats = np.cumsum(steps)
        return ascending if np.isfinite(steps).all() and (steps >= 0).all() else None
    interval = header.get("FrameTime")
    rate = header.get("CineRate") or header.get("RecommendedDisplayFrameRate")
    seconds = float(interval) / 1000.0 if interval else 1.0 / float(rate) if rate else 0.0
    even: Floats = np.arange(frames, dtype=np.float64) * seconds
    return even if isfinite(seconds) and seconds > 0 else None


def _mislabelled(path: Path, header: pydicom.Dataset) -> bool:
    """Whether a picture labelled RGB holds JPEG frames in YCbCr, as JFIF frames always are.

    The JPEG File Interchange Format (1.02) has no RGB; pydicom goes by the label alone.
    """
    syntax = header.file_meta.TransferSyntaxUID
    if header.PhotometricInterpretation != "RGB" or syntax not in (JPEGBaseline8Bit, JPEGExtended12Bit):
        return False
    full = pydicom.dcmread(path, specific_tags=["PixelData", "NumberOfFrames"])
    frame = get_frame(full.PixelData, 0, number_of_frames=int(full.get("NumberOfFrames") or 1))
    return b"JFIF\x00" in frame[:32] and b"Adobe" not in frame[:1024]
