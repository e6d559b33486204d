"""Ultrasound regions of a DICOM header: boxes, spacing, and the one that shows tissue."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, isfinite

import pydicom

from echospline.io.recording import Box, Region

_CENTIMETRE = 3
"""Code of cm in Physical Units X/Y Direction (0018,6024/6026)."""


_SPATIAL = {1: "2-D", 2: "M-mode", 3: "spectral", 4: "wave form", 5: "graphics"}


_DATA = {1: "tissue", 2: "colour flow", 3: "PW Doppler", 4: "CW Doppler", 0x0A: "ECG", 0x12: "colour bar"}


_MOST_SHRUNK = 8
"""Largest factor by which a picture may be smaller than its regions; regions beyond it are not used."""


def regions_of(header: pydicom.Dataset, rows: int, columns: int) -> tuple[tuple[Region, ...], list[str]]:
    """Return the ultrasound regions (0018,6011) in pixels of this picture.

    A picture that was shrunk often keeps the regions of the large one: when they reach beyond the picture both ways, the
    smallest whole factor that makes them fit is undone. When they do so one way only, the picture was cut there, and
    the spacing holds. A note records the choice.
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
    # The last column is often given as the number of columns: one too many does not mean another matrix.
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


def doubts(
    header: pydicom.Dataset, regions: tuple[Region, ...], tissue: Region | None, whole: Box
) -> list[str]:
    """List what is doubtful about the regions, one sentence each."""
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
    """Return mm per pixel from Physical Delta X/Y, which are in cm when the units' code is 3."""
    units = (item.get("PhysicalUnitsXDirection"), item.get("PhysicalUnitsYDirection"))
    deltas = (item.get("PhysicalDeltaX"), item.get("PhysicalDeltaY"))
    if units != (_CENTIMETRE, _CENTIMETRE) or None in deltas:
        return None
    # The sign gives the direction of the physical axis, not how large a pixel is.
    dx, dy = (round(abs(float(delta)) * 10.0, 12) for delta in deltas)
    return (dx, dy) if isfinite(dx) and isfinite(dy) and min(dx, dy) > 0 else None


def tissue_of(regions: tuple[Region, ...]) -> Region | None:
    """Return the largest 2-D region with lengths; tissue before colour flow before others."""
    order = {"2-D tissue": 2, "2-D colour flow": 1}

    def rank(region: Region) -> tuple[int, int]:
        left, top, right, bottom = region.box
        return order.get(region.content, 0), (right - left) * (bottom - top)

    return max((r for r in regions if r.spacing and r.content.startswith("2-D")), key=rank, default=None)


def pixel_spacing(header: pydicom.Dataset) -> tuple[float, float] | None:
    """Return (lateral, depth) from Pixel Spacing, whose order is rows (depth) first."""
    shared = header.get("SharedFunctionalGroupsSequence") or [pydicom.Dataset()]
    measures = shared[0].get("PixelMeasuresSequence") or [pydicom.Dataset()]
    value = header.get("PixelSpacing") or measures[0].get("PixelSpacing")
    if value is None or len(value) != 2:
        return None
    depth, lateral = float(value[0]), float(value[1])
    return (lateral, depth) if isfinite(lateral) and isfinite(depth) and min(lateral, depth) > 0 else None
