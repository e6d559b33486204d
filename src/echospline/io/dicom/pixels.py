"""Pixels of a DICOM file: the choice of a decoder, inversion and palettes."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from pydicom.encaps import get_frame
from pydicom.pixels.processing import apply_color_lut
from pydicom.pixels.utils import iter_pixels
from pydicom.uid import (
    JPEG2000,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
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
from echospline.io.recording import MIB
from echospline.scene import Pixels

PILLOW = (JPEGBaseline8Bit, JPEGExtended12Bit, JPEG2000, JPEG2000Lossless)


GDCM = (JPEGLossless, JPEGLosslessSV1, JPEGLSLossless, JPEGLSNearLossless)
"""Transfer syntaxes by their decoder."""


_DEFLATE = 1032
"""The most that deflate can compress, so the most that a deflated file can hold per byte."""


PREAMBLE_MARK = b"DICM"


def read_dataset(path: Path, **options: Any) -> pydicom.Dataset:
    """Read a file, with or without preamble and meta information; without, the transfer syntax is that of its bytes."""
    found = pydicom.dcmread(path, force=True, **options)
    if not hasattr(found, "file_meta"):
        found.file_meta = pydicom.dataset.FileMetaDataset()
    if found.file_meta.get("TransferSyntaxUID") is None:
        implicit, little = found.original_encoding
        explicit = ExplicitVRLittleEndian if little else ExplicitVRBigEndian
        found.file_meta.TransferSyntaxUID = ImplicitVRLittleEndian if implicit else explicit
    return found


def raw_frames(path: Path, header: pydicom.Dataset, frame: int | None, mislabelled: bool) -> Iterator[Pixels]:
    """Return the frames as pydicom decodes them, read from the disk one by one.

    A deflated file, and one without preamble, is read as a whole. The decoder is named because pydicom prefers GDCM
    where that is installed (see `echospline.io.lossless`).
    """
    syntax = header.file_meta.TransferSyntaxUID
    options: dict[str, Any] = {"photometric_interpretation": "YBR_FULL"} if mislabelled else {}
    with path.open("rb") as file:
        bare = file.read(132)[128:] != PREAMBLE_MARK
    source: Any = read_dataset(path) if bare or syntax == DeflatedExplicitVRLittleEndian else path
    plugin = "pillow" if syntax in PILLOW else ""
    if frame is None and header.PhotometricInterpretation == "YBR_FULL_422" and not syntax.is_compressed:
        # pydicom 3.0 reads several such frames only one at a time: it expects the bytes of full chroma of all together
        for i in range(int(header.get("NumberOfFrames") or 1)):
            yield from iter_pixels(source, indices=[i], decoding_plugin=plugin, **options)
        return
    yield from iter_pixels(
        source, indices=None if frame is None else [frame], decoding_plugin=plugin, **options
    )


def coloured(indices: Pixels, header: pydicom.Dataset) -> Pixels:
    """Convert palette colours to 8-bit RGB; 16-bit entries carry their 8 bits in the upper byte, as displays read them."""
    colours: Any = apply_color_lut(indices, header)
    eight: Pixels = (colours >> 8 if colours.max(initial=0) > 255 else colours).astype(np.uint8)
    return eight


def check_deflated(path: Path, limit: float) -> None:
    """Refuse a deflated file that may inflate beyond the limit: pydicom inflates it whole."""
    with path.open("rb") as file:
        if file.read(132)[128:] != PREAMBLE_MARK:
            return
    meta = pydicom.filereader.read_file_meta_info(path)
    size = path.stat().st_size * _DEFLATE / MIB
    if meta.get("TransferSyntaxUID") == DeflatedExplicitVRLittleEndian and size > limit:
        raise InputError(
            f"{path} is deflated DICOM that may inflate to {size:,.0f} MiB, more than the limit of {limit:,.0f} MiB: "
            "raise the limit if the file is trusted"
        )


def check_decoder(path: Path, header: pydicom.Dataset) -> None:
    """Refuse a compression that cannot be decoded before any pixel is read."""
    syntax = header.file_meta.TransferSyntaxUID
    known = (*PILLOW, *GDCM, RLELossless, DeflatedExplicitVRLittleEndian)
    if syntax.is_compressed and (
        syntax not in known or (syntax == JPEGExtended12Bit and header.get("BitsStored") != 8)
    ):
        raise InputError(
            f"{path} is compressed as {syntax.name} with {header.get('BitsStored')} bits, for which there is no "
            "decoder: export it uncompressed"
        )
    if syntax in GDCM and find_spec("gdcm") is None:
        raise MissingExtraError("python-gdcm", "dicom", f"DICOM compressed as {syntax.name}")


def dtype_of(path: Path, header: pydicom.Dataset) -> np.dtype[Any]:
    """Return the type of the stored pixels."""
    bits = int(header.get("BitsAllocated", 8))
    if bits not in (8, 16, 32):
        raise InputError(f"{path} has {bits} bits per pixel; expected 8, 16 or 32")
    signed = int(header.get("PixelRepresentation", 0)) == 1
    return np.dtype(f"{'i' if signed else 'u'}{bits // 8}")


def upright(pixels: Pixels, stored: int) -> Pixels:
    """Invert MONOCHROME1, whose lowest value is white."""
    top = 2**stored - 1 if pixels.dtype.kind == "u" else -1
    inverted: Pixels = (top - pixels.astype(np.int64)).astype(pixels.dtype)
    return inverted


def is_mislabelled(path: Path, header: pydicom.Dataset) -> bool:
    """Test whether a picture labelled RGB holds JPEG frames in YCbCr, as JFIF frames always are.

    The JPEG File Interchange Format (1.02) has no RGB; pydicom goes by the label alone.
    """
    syntax = header.file_meta.TransferSyntaxUID
    if header.PhotometricInterpretation != "RGB" or syntax not in (JPEGBaseline8Bit, JPEGExtended12Bit):
        return False
    full = read_dataset(path, specific_tags=["PixelData", "NumberOfFrames"])
    frame = get_frame(full.PixelData, 0, number_of_frames=int(full.get("NumberOfFrames") or 1))
    return b"JFIF\x00" in frame[:32] and b"Adobe" not in frame[:1024]
