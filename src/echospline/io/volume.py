"""MetaImage, NRRD and NIfTI: a 2-D image, a cine or a volume along the third axis.

SimpleITK reads the headers of MetaImage and NRRD, and pixels in their rarer encodings. ITK's checks are incomplete (a header
may name any file of the machine as its pixels), so the header is read here as well and checked before ITK reads the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any, Literal

import numpy as np
import SimpleITK

from echospline.errors import InputError
from echospline.io.declared import Clock, Declared, Lengths, Turn, followed
from echospline.io.frame_fields import FrameFields, calibrations
from echospline.io.kind import Kind
from echospline.io.nifti import nifti
from echospline.io.plain_pixels import Layout
from echospline.io.recording import Recording, check_size, decoding
from echospline.scene import Pixels

_ITK: Any = SimpleITK
"""SimpleITK, whose functions carry no types."""
_HEADER_BYTES = 2**26
"""A text header longer than this is refused; PLUS writes some 500 bytes a frame and more with every tool."""
_READERS = {"metaimage": "MetaImageIO", "nrrd": "NrrdImageIO"}
_SECONDS = ("s", "sec", "second", "seconds", "ms", "us", "µs")
_TO_MM = {"mm": 1.0, "um": 1e-3, "µm": 1e-3, "cm": 10.0, "m": 1000.0}
_DTYPES = {
    name: np.dtype(name.removeprefix("Vector").lower())
    for base in (
        "UInt8",
        "Int8",
        "UInt16",
        "Int16",
        "UInt32",
        "Int32",
        "UInt64",
        "Int64",
        "Float32",
        "Float64",
    )
    for name in (base, f"Vector{base}")
}


def open_volume(path: Path, kind: Kind, format: str, limit: float, *, whole: bool) -> Recording:
    """Open a volume file.

    Axes are taken in the order of the file: the first is lateral, the second depth, the third (or, after axes of
    length one, the last) frames or slices: frames where the file says so (an axis of kind list or time, a unit of time,
    per-frame fields), else slices of a volume. ``UltrasoundImageOrientation`` of PLUS files is followed: with F or N
    first, the first axis is depth; U and N are flipped. Position and direction in space are left out: the image is its
    own frame.

    Parameters
    ----------
    path : Path
        The file.
    kind : {"metaimage", "nrrd", "nifti"}
        The reader.
    format : str
        Name for display.
    limit : float
        MiB of decoded pixels, of all frames or of one.
    whole : bool
        Whether all frames are needed. Frames in an encoding other than raw, zlib and gzip, and those of a list axis
        that comes first, always count together.

    Raises
    ------
    InputError
        If the file is damaged, too large, or no image or cine.
    """
    with decoding(path, format):
        if kind == "nifti":
            stored, said = nifti(path, format)
            count = stored.frames if whole else 1
            check_size(
                path, stored.rows, stored.columns, count, stored.channels * stored.dtype.itemsize, limit
            )
            return followed(stored, said)
        fields = _fields(path, kind)
        reader = _ITK.ImageFileReader()
        reader.SetImageIO(_READERS[kind])
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        size = tuple(int(n) for n in reader.GetSize())
        channels = int(reader.GetNumberOfComponents())
        type_name = _type_name(reader.GetPixelID())
        if type_name not in _DTYPES:
            raise InputError(
                f"{path} has pixels of type {type_name}; expected integers or floating point numbers"
            )
        dtype = _DTYPES[type_name]
        kinds = fields.get("kinds", "").lower().split() if kind == "nrrd" else []
        # ITK moves a list axis to the front of each pixel, wherever it is in the file
        listed = channels > 1 and "list" in kinds
        axes = [i for i, n in enumerate(size) if n > 1 or i < 2]
        if len(axes) > 3 or len(size) < 2 or (listed and len(axes) > 2):
            raise InputError(f"{path} has {len(size)} axes of {size}; expected an image (2) or a cine (3)")
        if channels not in (1, 3, 4) and not listed:
            raise InputError(
                f"{path} has {channels} values per pixel; expected 1 (grey), 3 (RGB) or 4 (RGBA)"
            )
        frames = channels if listed else size[axes[2]] if len(axes) == 3 else 1
        channels = 1 if listed else channels
        # channels or frames inside a pixel must be the fastest axis, or the only order that ITK knows is its own
        first = listed and kinds[0] == "list"
        own_order = first or (channels == 1 and (not listed or kinds[-1] == "list")) or kind == "metaimage"
        own_order = own_order or (len(kinds) > 0 and kinds[0] not in ("domain", "space"))
        shape = (frames, size[1], size[0], channels)
        layout = _layout(path, kind, fields, dtype, shape, first) if own_order else None
        counted = frames if whole or first or layout is None else 1
        check_size(path, size[1], size[0], counted, channels * dtype.itemsize, limit)
        _check_bytes(path, fields, prod((frames, size[1], size[0], channels)) * dtype.itemsize)
        said, notes = _declared(kind, fields, reader.GetSpacing(), frames, len(axes) == 3 and not listed)

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        with decoding(path, format):
            if layout is not None:
                yield from layout.read(frame)
                return
            stack = _stack(_ITK.GetArrayFromImage(reader.Execute()), size, frames, channels, listed)
            for pixels in stack if frame is None else stack[frame : frame + 1]:
                yield (
                    pixels[..., :3].astype(dtype, copy=False)
                    if channels == 4
                    else pixels.astype(dtype, copy=False)
                )

    if channels == 4:
        notes.append("transparency is left out")
    stored = Recording(
        path,
        format,
        size[1],
        size[0],
        frames,
        min(channels, 3),
        dtype,
        decode,
        single=frames == 1,
        notes=tuple(notes),
    )
    return followed(stored, said)


def _layout(
    path: Path,
    kind: Kind,
    fields: dict[str, str],
    dtype: np.dtype[Any],
    shape: tuple[int, int, int, int],
    listed: bool,
) -> Layout | None:
    """Return where the pixels are if they can be read frame by frame; None leaves them to ITK."""
    if fields["_encoding"] not in ("raw", "zlib", "gzip", "gz") or "_start" not in fields:
        return None
    if kind == "metaimage":
        msb = fields.get("binarydatabyteordermsb", fields.get("elementbyteordermsb", "false"))
        order: Literal["<", ">"] = ">" if msb.lower() in ("true", "1") else "<"
    else:
        order = ">" if fields.get("endian", "little").lower() == "big" else "<"
    frames, rows, columns, channels = shape
    return Layout(
        Path(fields["_pixels"]), int(fields["_start"]), frames, rows, columns, channels,
        dtype.newbyteorder(order), fields["_encoding"] != "raw", listed=listed,
    )  # fmt: skip


def _declared(
    kind: Kind, fields: dict[str, str], spacing: tuple[float, ...], frames: int, third: bool
) -> tuple[Declared, list[str]]:
    """Collect the statements of a MetaImage or NRRD header; ``third`` says that there is an axis after depth."""
    per_frame = FrameFields(fields, frames)
    notes = []
    letters = next((v for k, v in fields.items() if k.replace(" ", "") == "ultrasoundimageorientation"), "")
    turn = Turn.of_letters(letters)
    if letters and turn is None:
        notes.append(
            f"its ultrasound image orientation {letters!r} is none of MF, UF, MN, UN, FM, ...: not followed"
        )
    content = next((v for k, v in fields.items() if k.replace(" ", "") == "ultrasoundimagetype"), "")
    if content.startswith("RF"):
        notes.append(f"holds {content}, not B-mode")
    clocks = [clock for clock in (per_frame.clock(), _index_clock(fields, frames)) if clock]
    lengths = [
        found for key, value in fields.items()
        if re.fullmatch(r"imageto\w+transform", key) for found in calibrations(value, f"calibration {key}")
    ] + per_frame.lengths()  # fmt: skip
    lengths += _header_lengths(kind, fields, spacing)
    said = Declared(
        turn=turn or Turn(),
        turned_by=f"orientation {letters.strip()[:2]}",
        lengths=tuple(lengths),
        clocks=tuple(clocks),
        valid=per_frame.valid(),
        volume=_volume(kind, fields, spacing, bool(per_frame) or bool(clocks)) if third else "",
        rescale=_rescale(kind, fields),
    )
    return said, notes


def _volume(kind: Kind, fields: dict[str, str], spacing: tuple[float, ...], framed: bool) -> str:
    """Return why the third axis is a direction in space; empty when it is time."""
    kinds = fields.get("kinds", "").lower().split()
    if not framed and "list" in kinds and kind == "metaimage" and len({*spacing[:3]}) == 1 != spacing[0]:
        # PLUS has written reconstructed volumes so
        return "its third axis is called a list, but has no field per frame and the spacing of the other two"
    if framed or any(k in ("list", "time") for k in kinds):
        return ""
    units = re.findall(r'"([^"]*)"', fields.get("units", "")) if kind == "nrrd" else []
    if any(unit in _SECONDS for unit in units):
        return ""
    if sum(k in ("domain", "space") for k in kinds) >= 3 or fields.get("space dimension") == "3":
        return "its three axes are all of space"
    return "it has three axes, and nothing says that one of them is time"


def _rescale(kind: Kind, fields: dict[str, str]) -> tuple[float, float]:
    """Return MetaImage's ElementToIntensityFunctionSlope and Offset, which ITK does not apply."""
    if kind != "metaimage":
        return 1.0, 0.0
    try:
        slope = float(fields.get("elementtointensityfunctionslope", "1"))
        return slope, float(fields.get("elementtointensityfunctionoffset", "0"))
    except ValueError:
        return 1.0, 0.0


def _type_name(pixel_id: int) -> str:
    """Return the name of SimpleITK's pixel type, e.g. "UInt8" or "VectorUInt8"."""
    names = (name for name in dir(_ITK) if name.startswith("sitk") and getattr(_ITK, name) == pixel_id)
    return next((name.removeprefix("sitk") for name in names if name[4:] in _DTYPES), str(pixel_id))


def _stack(array: Any, size: tuple[int, ...], frames: int, channels: int, listed: bool) -> Pixels:
    """Return ITK's array as (frames, second axis, first axis[, channels])."""
    if listed:
        frames_last = array.reshape(size[1], size[0], -1)
        return np.moveaxis(frames_last, -1, 0)
    shape = (frames, size[1], size[0], channels) if channels > 1 else (frames, size[1], size[0])
    stack: Pixels = array.reshape(shape)
    return stack


def _fields(path: Path, kind: Kind) -> dict[str, str]:
    """Return the header as written, keys in lower case, with findings.

    ``_encoding`` is that of the pixels, ``_pixels`` their file, ``_start`` their first byte and ``_held`` the bytes of raw
    pixels; the last two are left out where only ITK can tell.
    """
    text, end, terminated = _header_text(path, kind)
    separator = "=" if kind == "metaimage" else ":"
    fields: dict[str, str] = {}
    for line in text.splitlines():
        key, found, value = line.partition(separator)
        if found and not line.startswith("#"):
            fields.setdefault(key.strip().lower(), value.lstrip("=").strip())
    if kind == "metaimage":
        where = fields.get("elementdatafile")
        if where is None:
            raise InputError(f"{path} ends before ElementDataFile: its header is cut short")
        detached = where.upper() != "LOCAL"
        packed = fields.get("compresseddata", "").lower() == "true"
        binary = fields.get("binarydata", "true").lower() == "true"
        fields["_encoding"] = "text" if not binary else "zlib" if packed else "raw"
    else:
        where = fields.get("data file", fields.get("datafile", ""))
        detached = bool(where)
        if not terminated and not detached:
            raise InputError(f"{path} ends before its pixels: its header is cut short")
        fields["_encoding"] = fields.get("encoding", "raw").lower()
    # ITK handles offsets and skips; where they are given, only ITK checks the length.
    plain = not any(
        fields.get(key, "0") not in ("0", "-1") for key in ("headersize", "byte skip", "line skip")
    )
    if detached:
        _check_neighbour(path, where)
        end, path = 0, path.parent / where
    fields["_pixels"] = str(path)
    if plain:
        fields["_start"] = str(end)
        if fields["_encoding"] == "raw":
            fields["_held"] = str(path.stat().st_size - end)
    return fields


def _header_text(path: Path, kind: Kind) -> tuple[str, int, bool]:
    """Return the text header, the offset of its end, and whether it is complete."""
    with path.open("rb") as file:
        lines: list[str] = []
        while line := file.readline(_HEADER_BYTES):
            if file.tell() > _HEADER_BYTES:
                raise InputError(f"{path} has a header of more than {_HEADER_BYTES >> 20} MiB: it is damaged")
            if kind == "nrrd" and not line.strip():
                return "".join(lines), file.tell(), True
            lines.append(line.decode("latin-1"))
            if kind == "metaimage" and re.match(rb"\s*ElementDataFile\s*=", line):
                return "".join(lines), file.tell(), True
    return "".join(lines), 0, False


def _check_neighbour(path: Path, name: str) -> None:
    """Refuse a header that names pixels elsewhere: only a plain file in its own folder is accepted."""
    if (
        Path(name).name != name
        or re.search(r"[%*\x00-\x1f]|^LIST", name)
        or not (path.parent / name).is_file()
    ):
        raise InputError(
            f"{path} keeps its pixels in {name!r}; expected a file of that name beside it, in the same folder"
        )


def _check_bytes(path: Path, fields: dict[str, str], expected: int) -> None:
    """Refuse a file that holds fewer bytes than its header declares."""
    held = int(fields.get("_held", expected))
    if held < expected:
        raise InputError(
            f"{path} declares {expected} bytes of pixels but holds {max(held, 0)}: it is cut short"
        )


def _header_lengths(kind: Kind, fields: dict[str, str], found: tuple[float, ...]) -> list[Lengths]:
    """Return the distances of the header itself, mm, as ITK reads them; nothing where it has none."""
    keys = {"metaimage": ("elementspacing", "elementsize"), "nrrd": ("spacings", "space directions")}[kind]
    named = {"elementspacing": "ElementSpacing", "elementsize": "ElementSize"}
    key = next((key for key in keys if key in fields), None)
    if key is None:
        return []
    unit = (
        re.findall(r'"([^"]*)"', fields.get("space units", fields.get("units", ""))) if kind == "nrrd" else []
    )
    if unit and unit[0] not in ("", "mm") and unit[0] not in _TO_MM:
        raise InputError(
            f"{fields['_pixels']} gives its lengths in {unit[0]!r}; expected {', '.join(_TO_MM)}: give --spacing LAT,DEPTH"
        )
    known = bool(unit and unit[0])
    scale = _TO_MM[unit[0]] if known else 1.0
    first, second = (float(h) * scale for h in found[:2])
    return [Lengths((first, second), named.get(key, key), one_is_unknown=True)]


def _index_clock(fields: dict[str, str], frames: int) -> Clock | None:
    """Return 3D Slicer's index of a sequence, s."""
    index = next((value for key, value in fields.items() if re.fullmatch(r"axis \d index values", key)), "")
    if not index or len(index.split()) != frames:
        return None
    try:
        return Clock("the sequence's index", np.array([float(v) for v in index.split()]))
    except ValueError:
        return None
