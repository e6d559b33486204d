"""NIfTI-1 and NIfTI-2 in one file, plain or compressed: header and frames, without another library.

Source: the header layouts nifti1.h and nifti2.h of the NIfTI Data Format Working Group.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from echospline.errors import InputError
from echospline.io.declared import Clock, Declared, Lengths
from echospline.io.plain_pixels import Inflated, Layout
from echospline.io.recording import Recording, decoding
from echospline.scene import Pixels

_TYPES = {
    2: ("u1", 1), 4: ("i2", 1), 8: ("i4", 1), 16: ("f4", 1), 64: ("f8", 1), 128: ("u1", 3), 256: ("i1", 1),
    512: ("u2", 1), 768: ("u4", 1), 1024: ("i8", 1), 1280: ("u8", 1),
}  # fmt: skip
"""Element type and values per pixel of each datatype code."""
_TO_MM = {1: 1000.0, 2: 1.0, 3: 1e-3}
_TO_S = {8: 1.0, 16: 1e-3, 24: 1e-6}
"""Units of xyzt_units: m, mm, um; s, ms, us."""
_LARGEST_OFFSET = 2**26
"""Bytes of header and extensions before the pixels; more is damage."""


def nifti(path: Path, format: str) -> tuple[Recording, Declared]:
    """Read a header; returns the pixels as stored, and the statements about them.

    Raises
    ------
    InputError
        If it is half of a pair, of a pixel type without a grey or RGB meaning, cut short, or has four axes.
    """
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
        file.seek(0)
        start = Inflated(file, 0).read(540) if packed else file.read(540)
    h = _header(path, start)
    size = [max(1, n) for n in h["dim"][1 : 1 + max(0, min(7, h["dim"][0]))]] + [1, 1]
    columns, rows, slices, moments = (*size, 1, 1)[:4]
    if any(n > 1 for n in size[4:]) or (slices > 1 and moments > 1):
        raise InputError(f"{path} has axes of {tuple(size)}; expected an image (2) or a cine (3)")
    if h["datatype"] not in _TYPES:
        raise InputError(
            f"{path} has pixels of NIfTI's type {h['datatype']}; expected integers, floating point numbers or RGB"
        )
    code, channels = _TYPES[h["datatype"]]
    dtype: np.dtype[Any] = np.dtype(h["order"] + code)
    frames = max(slices, moments)
    if not 0 <= h["offset"] <= _LARGEST_OFFSET:
        raise InputError(f"{path} puts its pixels at byte {h['offset']}: its header is damaged")
    layout = Layout(
        path, h["offset"], frames, rows, columns, channels, dtype, packed=packed, whole_packed=packed
    )
    if not packed and (held := path.stat().st_size - h["offset"]) < layout.frame_bytes * frames:
        raise InputError(
            f"{path} declares {layout.frame_bytes * frames} bytes of pixels but holds {max(held, 0)}: it is cut short"
        )

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        with decoding(path, format):
            yield from layout.read(frame)

    recording = Recording(
        path, format, rows, columns, frames, channels, dtype.newbyteorder("="), decode, single=frames == 1
    )
    return recording, _declared(h, frames, slices)


def _declared(h: dict[str, Any], frames: int, slices: int) -> Declared:
    scale = _TO_MM.get(h["units"] & 0x07, 1.0)
    # lengths are stored in 32 bits: 0.1 is stored as 0.10000000149 and means 0.1
    first, second = (abs(float(str(np.float32(v)))) * scale for v in h["pixdim"][1:3])
    slope, intercept = float(h["slope"]), float(h["intercept"])
    if slope == 0 or not isfinite(slope):  # by definition: no scale
        slope, intercept = 1.0, 0.0
    clocks = []
    step = float(str(np.float32(h["pixdim"][4]))) * _TO_S.get(h["units"] & 0x38, 0.0)
    if slices == 1 and frames > 1 and step > 0:
        clocks.append(Clock("pixdim[4]", np.arange(frames) * step))
    return Declared(
        rescale=(slope, intercept),
        lengths=(Lengths((first, second), "pixdim", one_is_unknown=True),),
        clocks=tuple(clocks),
        volume="its third axis is one of space, by the definition of NIfTI" if slices > 1 else "",
        window=(h["cal_min"], h["cal_max"]) if h["cal_max"] > h["cal_min"] else None,
    )


def _header(path: Path, start: bytes) -> dict[str, Any]:
    """Return the fields that are used, of either version and byte order."""
    if start[344:348] == b"n+1\x00" and len(start) >= 348:
        order = "<" if start[:4] == b"\x5c\x01\x00\x00" else ">"
        at = {"dim": ("8h", 40), "datatype": ("h", 70), "pixdim": ("8f", 76), "offset": ("f", 108), "slope": ("f", 112),
              "intercept": ("f", 116), "units": ("B", 123), "cal_max": ("f", 124), "cal_min": ("f", 128)}  # fmt: skip
    elif start[4:8] == b"n+2\x00" and len(start) >= 540:
        order = "<" if start[:4] == b"\x1c\x02\x00\x00" else ">"
        at = {"dim": ("8q", 16), "datatype": ("h", 12), "pixdim": ("8d", 104), "offset": ("q", 168), "slope": ("d", 176),
              "intercept": ("d", 184), "cal_max": ("d", 192), "cal_min": ("d", 200), "units": ("i", 500)}  # fmt: skip
    else:
        raise InputError(
            f"{path} is half of a NIfTI pair (.hdr and .img), or cut short; expected one whole file: convert it to .nii"
        )
    found: dict[str, Any] = {"order": order}
    for name, (form, place) in at.items():
        values = struct.unpack_from(order + form, start, place)
        found[name] = values if len(values) > 1 else values[0]
    if not isfinite(found["offset"]):
        raise InputError(f"{path} puts its pixels at byte {found['offset']}: its header is damaged")
    found["offset"] = int(found["offset"])
    return found
