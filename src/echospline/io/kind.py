"""The kind of a file, by its first bytes; the suffix of its name is not used."""

from __future__ import annotations

import os
import re
import stat
import struct
import zlib
from pathlib import Path
from typing import Literal

from echospline.errors import InputError

Kind = Literal[
    "picture", "gif", "dicom", "metaimage", "nrrd", "nifti", "video", "displacement", "toml", "arrays"
]

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Suffixes of the pictures of a cine that is a folder."""

HEAD = 4096
"""Bytes read; every signature below lies within them."""

_PICTURES = {
    b"\x89PNG\r\n\x1a\n": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"II*\x00": "TIFF",
    b"MM\x00*": "TIFF",
    b"II+\x00": "TIFF",
    b"MM\x00+": "TIFF",
    b"BM": "BMP",
}
_ARRAYS = {b"MATLAB 5.0": "Matlab 5", b"MATLAB 7.3": "Matlab 7.3 (HDF5)", b"\x89HDF\r\n\x1a\n": "HDF5"}
_STRANGERS = {
    b"%PDF": "a PDF document",
    b"PK\x03\x04": "a zip archive",
    b"\x93NUMPY": "a single NumPy array",
    b"BZh": "a bzip2 archive",
    b"7z\xbc\xaf": "a 7-zip archive",
    b"<!DOCTYPE": "a web page",
    b"<html": "a web page",
    b"<?xml": "an XML file",
    b"<svg": "an SVG drawing",
}
READABLE = "PNG, JPEG, TIFF, GIF, DICOM, MHA/MHD, NRRD, NIfTI, MP4, AVI, MOV, MKV or WebM"


def head(path: Path) -> bytes:
    """Return the first bytes of a file after the checks that every file must pass.

    Raises
    ------
    InputError
        If the file is missing, a folder, not a plain file, empty or not readable.
    """
    try:
        info = path.stat()
        if stat.S_ISDIR(info.st_mode):
            raise InputError(f"expected a file; {path} is a folder: name one file inside it")
        if not stat.S_ISREG(info.st_mode):
            raise InputError(
                f"expected a plain file; {path} is a device, a pipe or a socket: copy it to a file"
            )
        if info.st_size == 0:
            raise InputError(f"{path} is empty (0 bytes): copy or record it again")
        with path.open("rb") as file:
            return file.read(HEAD)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"there is no file {path}: check the name (now in folder {os.getcwd()})") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot read {path}: {reason}; check its name and permissions") from None


def kind_of(path: Path) -> tuple[Kind, str]:
    """Identify a file's kind and format by its content.

    Returns
    -------
    kind : str
        The reader for it.
    format : str
        The format's usual name, for display.

    Raises
    ------
    InputError
        If the file cannot be read or is of no known kind.
    """
    start = head(path)
    start = start.removeprefix(b"\xef\xbb\xbf")  # a byte-order mark before text
    found = _by_magic(start) or _by_structure(start, path)
    if found:
        return found
    stranger = next((name for magic, name in _STRANGERS.items() if start.startswith(magic)), None)
    what = f"is {stranger}" if stranger else f"begins with {str(start[:8])[1:]}, which no known format does"
    raise InputError(f"{path} {what}; expected {READABLE}")


def _by_magic(start: bytes) -> tuple[Kind, str] | None:
    # First DICOM: its free 128 bytes before the mark may hold a TIFF header.
    if start[128:132] == b"DICM":
        return "dicom", "DICOM"
    for magic, name in _PICTURES.items():
        if start.startswith(magic):
            return "picture", name
    for magic, name in _ARRAYS.items():
        if start.startswith(magic):
            return "arrays", name
    if start[:6] in (b"GIF87a", b"GIF89a"):
        return "gif", "GIF"
    return ("nrrd", "NRRD") if start.startswith(b"NRRD0") else None


def _by_structure(start: bytes, path: Path) -> tuple[Kind, str] | None:
    video = _video(start)
    if _is_bare_dicom(start):
        return "dicom", "DICOM"
    kinds: tuple[tuple[bool, Kind, str], ...] = (
        (
            _is_nifti(start) or (start.startswith(b"\x1f\x8b") and _is_nifti(_inflated(start))),
            "nifti",
            "NIfTI",
        ),
        (video is not None, "video", video or ""),
        (_is_metaimage(start), "metaimage", "MetaImage"),
        (start.startswith(b"PK\x03\x04") and b".npy" in start[:200], "displacement", "NumPy archive (npz)"),
        (path.suffix.lower() == ".toml" and b"\x00" not in start, "toml", "TOML"),
    )
    return next(((kind, name) for holds, kind, name in kinds if holds), None)


def _video(start: bytes) -> str | None:
    if start[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
        return "QuickTime" if start[8:12] == b"qt  " or start[4:8] != b"ftyp" else "MP4"
    if start[:4] == b"RIFF" and start[8:12] == b"AVI ":
        return "AVI"
    if start[:4] == b"\x1a\x45\xdf\xa3":
        return "WebM" if b"webm" in start[:64] else "Matroska"
    return None


def _is_bare_dicom(start: bytes) -> bool:
    """Test for DICOM without its preamble: two elements in a row of group 0002 or 0008, little or big endian."""
    if len(start) < 16:
        return False
    for order in ("<", ">"):
        group, element = struct.unpack_from(order + "HH", start)
        if group not in (0x0002, 0x0008) or element > 0x3000:
            continue
        kind, short, (long,) = (
            start[4:6],
            struct.unpack_from(order + "H", start, 6)[0],
            struct.unpack_from(order + "I", start, 4),
        )
        explicit = kind.isalpha() and kind.isupper()
        if explicit and kind in _LONG:
            continue
        after = 8 + (short if explicit else long)
        if after + 4 > len(start):
            continue
        following, later = struct.unpack_from(order + "HH", start, after)
        if following in (group, 0x0008) and (following, later) > (group, element):
            return True
    return False


_LONG = (b"OB", b"OW", b"OF", b"OD", b"OL", b"SQ", b"UC", b"UN", b"UR", b"UT")
"""Value representations with a 32-bit length; none of them begins a file."""


def _is_metaimage(start: bytes) -> bool:
    """Test for a MetaImage header: lines ``Key = value`` with NDims and DimSize among the first."""
    return re.search(rb"^\s*NDims\s*=", start, re.MULTILINE) is not None and b"\x00" not in start[:40]


def _is_nifti(start: bytes) -> bool:
    return start[344:348] in (b"n+1\x00", b"ni1\x00") or start[4:8] in (b"n+2\x00", b"ni2\x00")


def _inflated(start: bytes) -> bytes:
    """Return the first bytes inside a gzip file; empty when it is damaged."""
    try:
        return zlib.decompressobj(wbits=31).decompress(start, HEAD)
    except zlib.error:
        return b""
