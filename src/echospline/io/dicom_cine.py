"""Write frames as a multi-frame ultrasound object: its frame time, and the size of its pixels in its region."""

from __future__ import annotations

from datetime import datetime
from importlib.metadata import version
from io import BytesIO
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

MOST_SIDE, MOST_BYTES = 65_535, 2**32 - 2
CENTIMETRE, TISSUE, PLANE = 3, 1, 1
"""Codes of a region: its units, its data (tissue), its format (2-D)."""


def dicom_cine(
    frames: NDArray[np.uint8],
    rate: float,
    spacing: tuple[float, float] | None,
    *,
    title: str = "",
    when: datetime | None = None,
) -> bytes:
    """Return frames as a DICOM file, uncompressed (explicit VR, little endian).

    Parameters
    ----------
    frames : (n, rows, columns) or (n, rows, columns, 3) ndarray of uint8
        Grey, or red, green and blue.
    rate : float
        Frames per second.
    spacing : (lateral, depth) or None
        Size of a pixel, mm; None where the pixels show no plane of constant scale.
    title : str
        Series description.
    when : datetime, optional
        Date and time of study and content; now when not given.

    Raises
    ------
    InputError
        If there are no frames, or more than a file holds; if rate or spacing is not positive.
    """
    from pydicom.dataset import FileDataset, FileMetaDataset  # noqa: PLC0415 - io is loaded without it
    from pydicom.sequence import Sequence  # noqa: PLC0415
    from pydicom.uid import (  # noqa: PLC0415
        ExplicitVRLittleEndian,
        UltrasoundMultiFrameImageStorage,
        generate_uid,
    )

    _check(frames, rate, spacing)
    n, rows, columns = frames.shape[:3]
    when = when or datetime.now()
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = UltrasoundMultiFrameImageStorage
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    meta.ImplementationVersionName = f"ECHOSPLINE {version('echospline')}"[:16]
    d = FileDataset("", {}, file_meta=meta, preamble=bytes(128))
    d.SOPClassUID, d.SOPInstanceUID = UltrasoundMultiFrameImageStorage, meta.MediaStorageSOPInstanceUID
    d.StudyInstanceUID, d.SeriesInstanceUID = generate_uid(), generate_uid()
    d.SpecificCharacterSet = "ISO_IR 192"
    d.PatientName, d.PatientID, d.PatientBirthDate, d.PatientSex = "Simulated", "simulated", "", ""
    d.StudyID, d.AccessionNumber, d.ReferringPhysicianName = "", "", ""
    d.StudyDate = d.ContentDate = when.strftime("%Y%m%d")
    d.StudyTime = d.ContentTime = when.strftime("%H%M%S")
    d.Modality, d.Manufacturer, d.ManufacturerModelName = "US", "echospline", "simulated ultrasound"
    d.SoftwareVersions = version("echospline")
    d.SeriesDescription = "".join(c for c in title if c.isprintable() and c != "\\")[:64]
    d.SeriesNumber, d.InstanceNumber = 1, 1
    d.ImageType = ["DERIVED", "SECONDARY", "", "0001"]  # the last: a picture of a plane
    d.LossyImageCompression, d.BurnedInAnnotation = "00", "NO"
    colour = frames.ndim == 4
    d.SamplesPerPixel = 3 if colour else 1
    d.PhotometricInterpretation = "RGB" if colour else "MONOCHROME2"
    if colour:
        d.PlanarConfiguration = 0
    d.NumberOfFrames, d.Rows, d.Columns = n, rows, columns
    d.BitsAllocated, d.BitsStored, d.HighBit, d.PixelRepresentation = 8, 8, 7, 0
    d.FrameIncrementPointer = 0x00181063
    d.FrameTime = float(f"{1000.0 / rate:.6g}")
    d.CineRate = max(1, round(rate))
    if spacing is not None:
        d.SequenceOfUltrasoundRegions = Sequence([_region(rows, columns, spacing)])
    pixels = np.ascontiguousarray(frames).tobytes()
    d.add_new(0x7FE00010, "OB", pixels + bytes(len(pixels) % 2))
    out = BytesIO()
    d.save_as(out, enforce_file_format=True)
    return out.getvalue()


def _region(rows: int, columns: int, spacing: tuple[float, float]) -> Dataset:
    from pydicom.dataset import Dataset  # noqa: PLC0415 - as above

    region = Dataset()
    region.RegionSpatialFormat, region.RegionDataType, region.RegionFlags = PLANE, TISSUE, 0
    region.RegionLocationMinX0, region.RegionLocationMinY0 = 0, 0
    region.RegionLocationMaxX1, region.RegionLocationMaxY1 = columns - 1, rows - 1
    region.PhysicalUnitsXDirection = region.PhysicalUnitsYDirection = CENTIMETRE
    region.PhysicalDeltaX, region.PhysicalDeltaY = spacing[0] / 10.0, spacing[1] / 10.0
    return region


def _check(frames: NDArray[np.uint8], rate: float, spacing: tuple[float, float] | None) -> None:
    shape = frames.shape
    if frames.dtype != np.uint8 or len(shape) not in (3, 4) or (len(shape) == 4 and shape[3] != 3):
        raise InputError(
            f"frames for DICOM must be uint8 of shape (n, rows, columns) or (n, rows, columns, 3); got {frames.dtype} of {shape}"
        )
    if min(shape) < 1 or max(shape[1:3]) > MOST_SIDE or frames.nbytes > MOST_BYTES:
        raise InputError(f"a DICOM file holds one frame or more, up to 4 GiB in all; got shape {shape}")
    if not (isfinite(rate) and 0 < rate <= 1000):
        raise InputError(f"rate must be frames per second, above 0 and at most 1000; got {rate}")
    if spacing is not None and not all(isfinite(s) and s > 0 for s in spacing):
        raise InputError(f"spacing must be two positive sizes of a pixel in mm; got {spacing}")
