"""Headers of recorded sequences: MetaImage and NRRD fields, the per-frame fields ``Seq_Frame0000_...`` and the pixels."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.io.frame_fields import FRAME_FIELD, FrameFields
from echospline.scene import Floats, Pixels, frames_of

META_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2",
    "MET_INT": "i4", "MET_UINT": "u4", "MET_FLOAT": "f4", "MET_DOUBLE": "f8",
}  # fmt: skip
NRRD_TYPES = {
    "signed char": "i1", "int8": "i1", "uchar": "u1", "unsigned char": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "unsigned short": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "unsigned int": "u4",
    "uint32": "u4", "float": "f4", "double": "f8",
}  # fmt: skip
NRRD_NAMES = {"i1": "int8", "u1": "uint8", "i2": "int16", "u2": "uint16", "i4": "int32", "u4": "uint32", "f4": "float", "f8": "double"}  # fmt: skip

MAX_HEADER = 64 * 2**20
"""Bytes; a recording of half an hour at 30 frames per second with four tools has about 40 MiB of header."""
MAX_LINE = 2**16
MAX_FRAMES = 10**6


@dataclass(frozen=True)
class Header:
    """Content of a sequence's header.

    Parameters
    ----------
    shape : (n, rows, columns) or (n, rows, columns, 3)
        Of the pixels.
    dtype : dtype
        Of the pixels, with byte order.
    times : ndarray, shape (n,)
        Seconds.
    transforms : mapping of str to ndarray, shape (n, 4, 4)
        NaN where not valid.
    valid : ndarray, shape (n,), bool
        Frames with a good picture.
    spacing : (lateral, depth), optional
        mm per pixel.
    compressed : bool
        Whether the pixels are deflated (zlib or gzip).
    data : str
        Name of the file with the pixels; empty if they follow the header.
    flip_columns, flip_rows : bool
        Whether the picture is stored from the unmarked side, or from the far end.
    other : mapping of str to str
        All other fields.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    times: Floats
    transforms: Mapping[str, Floats]
    valid: NDArray[np.bool_]
    spacing: tuple[float, float] | None = None
    compressed: bool = False
    data: str = ""
    flip_columns: bool = False
    flip_rows: bool = False
    other: Mapping[str, str] = field(default_factory=dict)


def read_header(file: IO[bytes], path: Path) -> Header:
    """Read up to the pixels.

    Raises
    ------
    InputError
        If the header is not that of a MetaImage or NRRD sequence.
    """
    nrrd = file.read(4) == b"NRRD"
    file.seek(0)
    fields = _nrrd_fields(file, path) if nrrd else _meta_fields(file, path)
    frame_fields = {k: v for k, v in fields.items() if FRAME_FIELD.fullmatch(k)}
    top = {k: v for k, v in fields.items() if k not in frame_fields}
    try:
        form = _nrrd_form(top) if nrrd else _meta_form(top)
    except (KeyError, ValueError) as error:
        raise InputError(f"{path} is no sequence that echospline can read: {error}") from error
    count = form["shape"][0]
    if count > MAX_FRAMES or min(form["shape"]) < 1 or len(form["shape"]) not in (3, 4):
        raise InputError(
            f"{path} declares frames of shape {form['shape']}; a sequence has 1 to {MAX_FRAMES} pictures"
        )
    orientation = top.get(
        "ultrasound image orientation" if nrrd else "UltrasoundImageOrientation", "MF"
    ).strip()
    if orientation[:2] not in ("MF", "UF", "MN", "UN"):
        raise InputError(f"{path} has orientation {orientation}; a B-mode picture is MF, UF, MN or UN")
    times, transforms, valid = _frames(frame_fields, count, path)
    if nrrd and np.isnan(times).all():
        times = _index_values(top, count)
    if (missing := np.isnan(times) & valid).any():
        raise InputError(
            f"{path} has no time stamp for frame {int(np.argmax(missing))} (Seq_Frame..._Timestamp)"
        )
    if form["spacing"] is None:  # the frames' own, where PLUS's 1 1 stands in the header
        own = [f.spacing for f in FrameFields(frame_fields, count).lengths() if not f.shown]
        form["spacing"] = _known_spacing(list(own[0])) if own else None
    return Header(
        **form, times=times, transforms=transforms, valid=valid,
        flip_columns=orientation[0] == "U", flip_rows=orientation[1] == "N", other=top,
    )  # fmt: skip


def _lines(file: IO[bytes], path: Path) -> Iterator[str]:
    while file.tell() < MAX_HEADER:
        line = file.readline(MAX_LINE)
        if not line.endswith(b"\n"):
            break
        yield line.decode("utf-8", "replace").rstrip("\r\n")
    raise InputError(f"{path}: the header does not end (or has a line beyond {MAX_LINE} bytes)")


def _meta_fields(file: IO[bytes], path: Path) -> dict[str, str]:
    fields: dict[str, str] = {}
    for line in _lines(file, path):
        key, equals, value = line.partition("=")
        if not equals:
            raise InputError(f"{path} is neither MetaImage nor NRRD: {line[:60]!r} is no field of a header")
        fields[key.strip()] = value.strip()
        if key.strip() == "ElementDataFile":
            return fields
    raise AssertionError  # _lines raises first


def _nrrd_fields(file: IO[bytes], path: Path) -> dict[str, str]:
    fields: dict[str, str] = {}
    for line in _lines(file, path):
        if not line:
            return fields
        if line.startswith(("#", "NRRD")):
            continue
        key, colon, value = line.partition(":")
        if not colon:
            raise InputError(f"{path}: {line[:60]!r} is no field of an NRRD header")
        fields[key.strip()] = value.removeprefix("=").strip()
    raise AssertionError  # _lines raises first


def _meta_form(top: Mapping[str, str]) -> dict[str, Any]:
    if top.get("ObjectType") != "Image":
        raise ValueError(f"ObjectType must be Image; got {top.get('ObjectType')}")
    sizes = [int(n) for n in top["DimSize"].split()]
    channels = int(top.get("ElementNumberOfChannels", "1"))
    element = top["ElementType"]
    if element not in META_TYPES:
        raise ValueError(f"ElementType must be one of {', '.join(META_TYPES)}; got {element}")
    order = (
        ">" if top.get("BinaryDataByteOrderMSB", top.get("ElementByteOrderMSB", "False")) == "True" else "<"
    )
    spacing = [float(s) for s in top.get("ElementSpacing", "1 1").split()[:2]]
    local = top["ElementDataFile"] == "LOCAL"
    return {
        "shape": _shape(sizes, channels),
        "dtype": np.dtype(order + META_TYPES[element]),
        "spacing": _known_spacing(spacing),
        "compressed": top.get("CompressedData", "False") == "True",
        "data": "" if local else top["ElementDataFile"],
    }


def _nrrd_form(top: Mapping[str, str]) -> dict[str, Any]:
    kinds, sizes = top["kinds"].split(), [int(n) for n in top["sizes"].split()]
    if len(kinds) != len(sizes):
        raise ValueError(f"kinds {kinds} and sizes {sizes} differ in number")
    time = [i for i, k in enumerate(kinds) if k in ("list", "time")]
    colour = [i for i, k in enumerate(kinds) if k in ("vector", "RGB-color", "3-color")]
    space = [i for i, k in enumerate(kinds) if k in ("domain", "space")]
    if len(time) > 1 or len(colour) > 1 or [*colour, *space, *time] != list(range(len(kinds))):
        raise ValueError(f"kinds must be [vector] domain domain [domain] list; got {' '.join(kinds)}")
    if top["type"] not in NRRD_TYPES:
        raise ValueError(f"type {top['type']} is not one of {', '.join(NRRD_TYPES)}")
    if top["encoding"] not in ("raw", "gzip", "gz"):
        raise ValueError(f"encoding must be raw or gzip; got {top['encoding']}")
    directions = re.findall(r"\(([^()]*)\)", top.get("space directions", ""))
    spacing = [math.hypot(*(float(v) for v in d.split(","))) for d in directions[:2]]
    return {
        "shape": _shape([sizes[i] for i in [*space, *time]], sizes[colour[0]] if colour else 1),
        "dtype": np.dtype((">" if top.get("endian") == "big" else "<") + NRRD_TYPES[top["type"]]),
        "spacing": _known_spacing(spacing),
        "compressed": top["encoding"] != "raw",
        "data": top.get("data file", top.get("datafile", "")),
    }


def _shape(sizes: list[int], channels: int) -> tuple[int, ...]:
    if channels not in (1, 3):
        raise ValueError(f"pixels are grey or RGB; got {channels} channels")
    if len(sizes) == 4 and sizes[2] == 1:
        sizes = [*sizes[:2], sizes[3]]
    if len(sizes) == 2:
        sizes = [*sizes, 1]
    if len(sizes) != 3:
        raise ValueError(f"frames are two-dimensional; got sizes {sizes}")
    columns, rows, count = sizes
    return (count, rows, columns) if channels == 1 else (count, rows, columns, 3)


def _known_spacing(spacing: list[float]) -> tuple[float, float] | None:
    # PLUS writes 1 1 for every picture: that is no spacing
    if len(spacing) < 2 or spacing == [1.0, 1.0] or not all(math.isfinite(s) and s > 0 for s in spacing):
        return None
    return spacing[0], spacing[1]


def _frames(
    fields: Mapping[str, str], count: int, path: Path
) -> tuple[Floats, dict[str, Floats], NDArray[np.bool_]]:
    times, valid = np.full(count, np.nan), np.ones(count, dtype=bool)
    transforms: dict[str, Floats] = {}
    lost: list[tuple[str, int]] = []
    for key, value in fields.items():
        match = FRAME_FIELD.fullmatch(key)
        assert match is not None  # the caller has chosen these types
        frame, name = int(match[1]), match[2]
        if frame >= count:
            raise InputError(f"{path}: {key} is beyond the last frame {count - 1}")
        if name == "Timestamp":
            times[frame] = _numbers(value, 1, key, path)[0]
        elif name in ("ImageStatus", "Status"):
            valid[frame] = value == "OK"
        elif name.endswith("TransformStatus"):
            if value != "OK":
                lost.append((name.removesuffix("TransformStatus"), frame))
        elif name.endswith("Transform"):
            tool = name.removesuffix("Transform")
            frames_of(tool)
            if tool not in transforms:
                if len(transforms) >= 100:
                    raise InputError(f"{path} has more than 100 transforms")
                transforms[tool] = np.full((count, 4, 4), np.nan)
            transforms[tool][frame] = np.reshape(_numbers(value, 16, key, path), (4, 4))
    for tool, frame in lost:
        if tool in transforms:
            transforms[tool][frame] = np.nan
    return times, transforms, valid


def _numbers(value: str, count: int, key: str, path: Path) -> list[float]:
    try:
        numbers = [float(v) for v in value.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(v) for v in numbers):
        raise InputError(
            f"{path}: {key} must be {count} finite number{'s' if count > 1 else ''}; got {value[:60]!r}"
        )
    return numbers


def _index_values(top: Mapping[str, str], count: int) -> Floats:
    """Return the times of a sequence that only Slicer has written."""
    values = next((v.split() for k, v in top.items() if re.fullmatch(r"axis \d index values", k)), [])
    try:
        times = np.array([float(v) for v in values])
    except ValueError:
        times = np.empty(0)
    return times if len(times) == count and np.isfinite(times).all() else np.full(count, np.nan)


def read_pixels(file: IO[bytes], path: Path, header: Header, limit: float) -> Pixels:
    """Read the pixels after the header, or in the file that it names.

    Raises
    ------
    InputError
        If there are fewer bytes than declared, or more than ``limit`` MiB.
    """
    size = math.prod(header.shape) * header.dtype.itemsize
    if size > limit * 2**20:
        raise InputError(
            f"{path} declares {size / 2**20:.0f} MiB of pixels; at most {limit:.0f} MiB are read"
        )
    if header.data:
        if Path(header.data).name != header.data:
            raise InputError(f"{path} names its pixels {header.data!r}: only a file beside it is read")
        beside = path.with_name(header.data)
        if not beside.is_file():
            raise InputError(f"{path} keeps its pixels in {beside.name}, which is not there")
        with beside.open("rb") as other:
            raw = _inflated(other, size) if header.compressed else other.read(size)
    else:
        raw = _inflated(file, size) if header.compressed else file.read(size)
    if len(raw) != size:
        raise InputError(f"{path} declares {size} bytes of pixels and has {len(raw)}; it is not whole")
    pixels = np.frombuffer(raw, dtype=header.dtype).reshape(header.shape)
    return pixels.astype(header.dtype.newbyteorder("="))


def _inflated(file: IO[bytes], size: int) -> bytes:
    """Inflate at most ``size`` bytes of a zlib or gzip stream, whatever its length."""
    inflater, out = zlib.decompressobj(wbits=32 + 15), bytearray()
    try:
        while len(out) < size and (block := file.read(1 << 16)):
            out += inflater.decompress(block, size - len(out))
            while inflater.unconsumed_tail and len(out) < size:
                out += inflater.decompress(inflater.unconsumed_tail, size - len(out))
    except zlib.error as error:
        raise InputError(f"compressed pixels are damaged: {error}") from error
    return bytes(out)


def write_header(header: Header, path: Path, image_to_reference: Floats) -> bytes:
    """Write the header of raw pixels that follow it, MetaImage or NRRD by the path's suffix.

    Parameters
    ----------
    header : Header
        Its content.
    path : Path
        Name of the file.
    image_to_reference : ndarray, shape (4, 4)
        Position of the first frame, RAS; NRRD stores it, as LPS.
    """
    lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ image_to_reference
    frames = _frame_fields(header)
    code = header.dtype.str[1:]
    count, rows, columns, *colour = header.shape
    if path.name.lower().endswith(".mha"):
        element = next(name for name, c in META_TYPES.items() if c == code)
        dx, dy = header.spacing or (1.0, 1.0)
        lines = [
            "ObjectType = Image", "NDims = 3", "AnatomicalOrientation = RAI", "BinaryData = True",
            "BinaryDataByteOrderMSB = False", "CenterOfRotation = 0 0 0", "CompressedData = False",
            f"DimSize = {columns} {rows} {count}", f"ElementNumberOfChannels = {3 if colour else 1}",
            f"ElementSpacing = {dx!r} {dy!r} 1", f"ElementType = {element}", "Kinds = domain domain list",
            "Offset = 0 0 0", "TransformMatrix = 1 0 0 0 1 0 0 0 1",
            "UltrasoundImageOrientation = MF", "UltrasoundImageType = BRIGHTNESS",
            *(f"{key} = {value}" for key, value in frames), "ElementDataFile = LOCAL",
        ]  # fmt: skip
        return "\n".join([*lines, ""]).encode("ascii")
    axes = [f"({','.join(repr(float(v)) for v in lps[:3, i])})" for i in range(3)]
    times = " ".join(repr(float(t)) for t in header.times)
    lines = [
        "NRRD0005", "# Complete NRRD file format specification at:", "# http://teem.sourceforge.net/nrrd/format.html",
        f"type: {NRRD_NAMES[code]}", f"dimension: {5 if colour else 4}", "space: left-posterior-superior",
        f"sizes: {'3 ' if colour else ''}{columns} {rows} 1 {count}",
        f"space directions: {'none ' if colour else ''}{' '.join(axes)} none",
        f"kinds: {'vector ' if colour else ''}domain domain domain list",
        f"labels: {chr(34) * 2 + ' ' if colour else ''}\"\" \"\" \"\" \"time\"",
        "endian: little", "encoding: raw",
        f"space origin: ({','.join(repr(float(v)) for v in lps[:3, 3])})",
        f"DataNodeClassName:=vtkMRML{'Vector' if colour else 'Scalar'}VolumeNode",
        f"axis {4 if colour else 3} index type:=numeric", f"axis {4 if colour else 3} index values:={times}",
        "ultrasound image orientation:=MF", "ultrasound image type:=BRIGHTNESS",
        *(f"{key}:={value}" for key, value in frames),
    ]  # fmt: skip
    return "\n".join([*lines, "", ""]).encode("ascii")


def _frame_fields(header: Header) -> list[tuple[str, str]]:
    fields = []
    for i, time in enumerate(header.times):
        for name, matrices in header.transforms.items():
            good = bool(np.isfinite(matrices[i]).all())
            numbers = matrices[i] if good else np.eye(4)
            fields.append(
                (f"Seq_Frame{i:04d}_{name}Transform", " ".join(repr(float(v)) for v in numbers.ravel()))
            )
            fields.append((f"Seq_Frame{i:04d}_{name}TransformStatus", "OK" if good else "INVALID"))
        fields.append((f"Seq_Frame{i:04d}_Timestamp", repr(float(time))))
        fields.append((f"Seq_Frame{i:04d}_ImageStatus", "OK" if header.valid[i] else "INVALID"))
    return fields
