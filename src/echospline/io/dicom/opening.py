"""DICOM B-mode, single and multi-frame: spacing and tissue region from its ultrasound regions, pixels through pydicom."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from echospline.errors import InputError
from echospline.io.declared import followed
from echospline.io.dicom.header import declared
from echospline.io.dicom.pixels import (
    GDCM,
    PREAMBLE_MARK,
    check_decoder,
    check_deflated,
    coloured,
    dtype_of,
    is_mislabelled,
    raw_frames,
    read_dataset,
    upright,
)
from echospline.io.dicom.regions import doubts, regions_of, tissue_of
from echospline.io.kind import head
from echospline.io.lossless import lossless_frames
from echospline.io.recording import Recording, check_size, decoding, quietly
from echospline.scene import Pixels

_DEFERRED = 2**16
"""Elements longer than this (private data, mostly) are not loaded."""


def open_dicom(path: Path, limit: float) -> Recording:
    """Open a DICOM file.

    Parameters
    ----------
    path : Path
        With the DICM mark at byte 128, or without its preamble.
    limit : float
        MiB of decoded pixels.

    Raises
    ------
    InputError
        If the file is damaged, too large or without a picture.
    MissingExtraError
        If its compression needs the extra ``dicom``.
    """
    with decoding(path, "DICOM"), quiet():
        check_deflated(path, limit)
        header = read_dataset(path, stop_before_pixels=True, defer_size=_DEFERRED)
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
        stored_dtype = dtype_of(path, header)
        dtype = np.dtype(np.uint8) if palette else stored_dtype
        check_size(path, rows, columns, frames, channels * dtype.itemsize, limit)
        check_decoder(path, header)
        regions, notes = regions_of(header, rows, columns)
        tissue = tissue_of(regions)
        notes += doubts(header, regions, tissue, (0, 0, columns, rows))
        said = declared(header, frames, tissue.spacing if tissue else None)
        mislabelled = is_mislabelled(path, header)
        if mislabelled:
            notes.append("labelled RGB but its JPEG frames hold YCbCr: converted")
        syntax = header.file_meta.TransferSyntaxUID
        bits = int(header.get("BitsStored") or dtype.itemsize * 8)
        if PREAMBLE_MARK not in head(path)[128:132]:
            notes.append("DICOM without its preamble: read all the same")

    def shown(frame: int | None) -> Iterator[Pixels]:
        shape = (rows, columns, 3) if channels == 3 and not palette else (rows, columns)
        if syntax in GDCM:
            raws = lossless_frames(path, shape, stored_dtype, frame, syntax.name)
        else:
            raws = raw_frames(path, header, frame, mislabelled)
        for raw in raws:
            if palette:
                yield coloured(raw, header)
            else:
                yield upright(raw, bits) if colours == "MONOCHROME1" else raw

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        count = 0
        with decoding(path, "DICOM"):
            for pixels in quietly(shown(frame), quiet):
                if pixels.shape[:2] != (rows, columns):
                    raise InputError(
                        f"{path} declares {columns} x {rows} pixels but a frame has {pixels.shape[1::-1]}"
                    )
                yield pixels.astype(dtype, copy=False)
                count += 1
            if frame is None and count != frames:
                raise InputError(f"{path} declares {frames} frames but holds {count}: it is cut short")

    stored = Recording(
        path, f"DICOM, {syntax.name}", rows, columns, frames, channels, dtype, decode,
        region=tissue.box if tissue else None, regions=regions, single=frames == 1, notes=tuple(notes),
    )  # fmt: skip
    return followed(stored, said)


@contextmanager
def quiet() -> Iterator[None]:
    """Silence pydicom, which warns and logs every oddity of a header; those that matter become notes or errors."""
    logger = logging.getLogger("pydicom")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
