"""MetaImage, NRRD and NIfTI through SimpleITK: a 2-D image, or a cine along the third axis.

ITK's checks are incomplete (a NIfTI file cut in half is read as if it were whole, a header may name any file of the
machine as its pixels), so the header is read here as well and checked before ITK reads the file.
"""

from __future__ import annotations

import gzip
import re
import struct
from collections.abc import Iterator
from math import isfinite, prod
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK

from echospline.errors import InputError
from echospline.io.kind import Kind
from echospline.io.recording import Recording, check_size, decoding
from echospline.scene import Floats, Pixels

_ITK: Any = SimpleITK
"""SimpleITK, whose functions carry no types."""
_HEADER_BYTES = 2**22
"""A text header longer than this is refused; PLUS writes some 500 bytes a frame."""
_READERS = {"metaimage": "MetaImageIO", "nrrd": "NrrdImageIO", "nifti": "NiftiImageIO"}
_NIFTI_NAMES = (".nii", ".nii.gz", ".hdr", ".img")
_RAW = ("raw",)
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
    length one, the last) the frames. ``UltrasoundImageOrientation`` of PLUS files is followed: with F or N first, the
    first axis is depth; U and N are flipped. Position and direction in space are left out: the image is its own frame.

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
        Whether all frames are needed. A compressed volume always counts as a whole.

    Raises
    ------
    InputError
        If the file is damaged, too large, or no image or cine.
    """
    with decoding(path, format):
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
        tags = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()}
        listed = channels > 1 and kind == "nrrd" and fields.get("kinds", "").lower().startswith("list")
        axes = [i for i, n in enumerate(size) if n > 1 or i < 2]
        if len(axes) > 3 or len(size) < 2 or (listed and len(axes) > 2):
            raise InputError(f"{path} has {len(size)} axes of {size}; expected an image (2) or a cine (3)")
        if channels not in (1, 3) and not listed:
            raise InputError(f"{path} has {channels} values per pixel; expected 1 (grey) or 3 (RGB)")
        frames = channels if listed else size[axes[2]] if len(axes) == 3 else 1
        channels = 1 if listed else channels
        packed = bool(fields.get("_packed"))
        counted = frames if whole or packed or listed else 1
        check_size(path, size[1], size[0], counted, channels * dtype.itemsize, limit)
        _check_bytes(path, fields, prod(size) * int(reader.GetNumberOfComponents()) * dtype.itemsize)
        orientation, notes = _orientation(tags.get("UltrasoundImageOrientation", ""))
        spacing, doubt = _spacing(path, kind, fields, reader.GetSpacing())
        notes += doubt
        if tags.get("UltrasoundImageType", "").startswith("RF"):
            notes.append(f"holds {tags['UltrasoundImageType']}, not B-mode")
        times = _times(tags, fields, frames)
    rows, columns = (size[1], size[0]) if not orientation[0] else (size[0], size[1])
    if spacing and orientation[0]:
        spacing = spacing[::-1]

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        with decoding(path, format):
            if frame is not None and len(axes) == 3 and not listed:
                part = [0 if i in axes[:2] else 1 for i in range(len(size))]
                reader.SetExtractIndex([frame if i == axes[2] else 0 for i in range(len(size))])
                reader.SetExtractSize([0 if p else n for p, n in zip(part, size, strict=True)])
            else:
                reader.SetExtractIndex([])
                reader.SetExtractSize([])
            array = _ITK.GetArrayFromImage(reader.Execute())
            stack = _stack(array, size, frames if frame is None or len(axes) < 3 else 1, channels, listed)
            picked = stack if frame is None or listed is False else stack[frame : frame + 1]
        for pixels in picked:
            yield _turned(pixels, orientation).astype(dtype, copy=False)

    return Recording(
        path, format, rows, columns, frames, channels, dtype, decode,
        spacing=spacing, times=times, single=frames == 1, notes=tuple(notes),
    )  # fmt: skip


def _type_name(pixel_id: int) -> str:
    """Return the name of SimpleITK's pixel type, e.g. "UInt8" or "VectorUInt8"."""
    names = (name for name in dir(_ITK) if name.startswith("sitk") and getattr(_ITK, name) == pixel_id)
    return next((name.removeprefix("sitk") for name in names if name[4:] in _DTYPES), str(pixel_id))


def _stack(array: Any, size: tuple[int, ...], frames: int, channels: int, listed: bool) -> Pixels:
    """Return ITK's array as (frames, second axis, first axis[, 3])."""
    if listed:
        frames_last = array.reshape(size[1], size[0], -1)
        return np.moveaxis(frames_last, -1, 0)
    shape = (frames, size[1], size[0], 3) if channels == 3 else (frames, size[1], size[0])
    stack: Pixels = array.reshape(shape)
    return stack


def _turned(pixels: Pixels, orientation: tuple[bool, bool, bool]) -> Pixels:
    transposed, flip_lateral, flip_depth = orientation
    pixels = pixels.swapaxes(0, 1) if transposed else pixels
    return pixels[:: -1 if flip_depth else 1, :: -1 if flip_lateral else 1]


def _orientation(letters: str) -> tuple[tuple[bool, bool, bool], list[str]]:
    """Return (depth axis first, lateral flipped, depth flipped) from PLUS's letters M/U (marked side) and F/N (far, near)."""
    found = re.match(r"\s*([MU][FN]|[FN][MU])", letters)
    if not found:
        return (False, False, False), []
    pair = found[1]
    turn = (pair[0] in "FN", "U" in pair, "N" in pair)
    return turn, [f"turned from orientation {pair} to MF"] if any(turn) else []


def _fields(path: Path, kind: Kind) -> dict[str, str]:
    """Return the header as written, keys in lower case, with its findings ``_packed``, ``_held`` or ``_offset`` (bytes)."""
    if kind == "nifti":
        return _nifti_fields(path)
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
        fields["_packed"] = "yes" if fields.get("compresseddata", "").lower() == "true" else ""
        detached = where.upper() != "LOCAL"
        raw = not fields["_packed"] and fields.get("binarydata", "true").lower() == "true"
    else:
        where = fields.get("data file", fields.get("datafile", ""))
        detached = bool(where)
        if not terminated and not detached:
            raise InputError(f"{path} ends before its pixels: its header is cut short")
        fields["_packed"] = "" if fields.get("encoding", "raw").lower() in _RAW else "yes"
        raw = not fields["_packed"]
    # ITK handles offsets and skips; where they are given, only ITK checks the length.
    plain = not any(
        fields.get(key, "0") not in ("0", "-1") for key in ("headersize", "byte skip", "line skip")
    )
    if detached:
        _check_neighbour(path, where)
        end, path = 0, path.parent / where
    if raw and plain:
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
    if Path(name).name != name or re.search(r"[%*\s]|^LIST", name) or not (path.parent / name).is_file():
        raise InputError(
            f"{path} keeps its pixels in {name!r}; expected a file of that name beside it, in the same folder"
        )


def _nifti_fields(path: Path) -> dict[str, str]:
    """Return the byte counts of a NIfTI file: ITK reads a truncated file without an error."""
    if not path.name.lower().endswith(_NIFTI_NAMES):
        raise InputError(f"{path} is NIfTI by its content; its name must end with .nii or .nii.gz: rename it")
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    if packed != path.name.lower().endswith(".gz"):
        raise InputError(
            f"{path} is {'' if packed else 'not '}compressed, against its name: rename it to .nii{'.gz' if packed else ''}"
        )
    with gzip.open(path) if packed else path.open("rb") as file:
        start = file.read(540)
    if start[344:348] == b"n+1\x00":
        order = "<" if start[:4] == b"\x5c\x01\x00\x00" else ">"
        offset = int(struct.unpack(order + "f", start[108:112])[0])
    elif start[4:8] == b"n+2\x00":
        order = "<" if start[:4] == b"\x1c\x02\x00\x00" else ">"
        offset = int(struct.unpack(order + "q", start[168:176])[0])
    else:
        raise InputError(
            f"{path} is half of a NIfTI pair (.hdr and .img); expected one file: convert it to .nii"
        )
    return {"_packed": "yes" if packed else "", "_offset": str(offset)}


def _check_bytes(path: Path, fields: dict[str, str], expected: int) -> None:
    """Refuse a file that holds fewer bytes than its header declares."""
    held = int(fields["_held"]) if "_held" in fields else expected
    if "_offset" in fields:
        held = _length(path, int(fields["_offset"]) + expected, bool(fields["_packed"])) - int(
            fields["_offset"]
        )
    if held < expected:
        raise InputError(
            f"{path} declares {expected} bytes of pixels but holds {max(held, 0)}: it is cut short"
        )


def _length(path: Path, enough: int, packed: bool) -> int:
    """Count the bytes in a file, inflated if compressed, up to ``enough``."""
    if not packed:
        return path.stat().st_size
    count = 0
    with gzip.open(path) as file:
        while count < enough and (block := file.read(2**20)):
            count += len(block)
    return count


def _spacing(
    path: Path, kind: Kind, fields: dict[str, str], found: tuple[float, ...]
) -> tuple[tuple[float, float] | None, list[str]]:
    """Return (first, second axis) in mm, and notes on doubtful values."""
    keys = {
        "metaimage": ("elementspacing", "elementsize"),
        "nrrd": ("spacings", "space directions"),
        "nifti": (),
    }[kind]
    if keys and not any(key in fields for key in keys):
        return None, []
    unit = (
        re.findall(r'"([^"]*)"', fields.get("space units", fields.get("units", ""))) if kind == "nrrd" else []
    )
    if unit and unit[0] not in ("", "mm") and unit[0] not in _TO_MM:
        raise InputError(
            f"{path} gives its lengths in {unit[0]!r}; expected {', '.join(_TO_MM)}: give --spacing LAT,DEPTH"
        )
    scale = _TO_MM[unit[0]] if unit and unit[0] else 1.0
    # NIfTI stores 32-bit lengths: 0.1 is stored as 0.10000000149 and means 0.1.
    first, second = (float(str(np.float32(h))) if kind == "nifti" else float(h) * scale for h in found[:2])
    if not (isfinite(first) and isfinite(second) and min(first, second) > 0):
        return None, [f"its spacing {found[:2]} is no length"]
    doubt = ["spacing of exactly 1 x 1 mm, which often means unknown"] if first == second == 1.0 else []
    return (first, second), doubt


def _times(tags: dict[str, str], fields: dict[str, str], frames: int) -> Floats | None:
    """Return the seconds since the first frame: PLUS's time stamps, or 3D Slicer's index of a sequence."""
    stamps = [tags.get(f"Seq_Frame{i:04d}_Timestamp") for i in range(frames)]
    if all(stamp is None for stamp in stamps):
        index = next(
            (value for key, value in fields.items() if re.fullmatch(r"axis \d index values", key)), ""
        )
        stamps = list(index.split()) if len(index.split()) == frames else []
    try:
        times = np.array([float(stamp) for stamp in stamps if stamp is not None])
    except ValueError:
        return None
    if len(times) != frames or frames < 2 or not np.isfinite(times).all() or (np.diff(times) < 0).any():
        return None
    since: Floats = times - times[0]
    return since
