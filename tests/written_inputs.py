"""Small files as scanners, editors and other programs write them, made by hand so that no reader of ours is involved."""

from __future__ import annotations

import fractions
import gzip
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import ExplicitVRLittleEndian, generate_uid
from scipy.ndimage import gaussian_filter

ROWS, COLUMNS, FRAMES = 48, 80, 10


def speckle(frames: int = FRAMES) -> np.ndarray:
    """Grey frames that move down by one pixel each, shape (frames, 48, 80)."""
    grey = gaussian_filter(np.random.default_rng(0).normal(size=(ROWS, COLUMNS)), 1.5)
    grey = ((grey - grey.min()) / (grey.max() - grey.min()) * 255).astype(np.uint8)
    return np.stack([np.roll(grey, i, 0) for i in range(frames)])


STACK = speckle()
_ONE, _LOW = 65536, 0xFFFFFFFF


def video(
    path: Path,
    *,
    matrix: tuple[int, ...] | None = None,
    aspect: tuple[int, int] | None = None,
    frames: np.ndarray = STACK,
) -> Path:
    """MP4 with a display matrix (a, b, c, d) in its track header, or pixels that are not square."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
        stream.time_base = fractions.Fraction(1, 90000)
        if aspect:
            stream.codec_context.sample_aspect_ratio = fractions.Fraction(*aspect)
        for i, grey in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.repeat(grey[..., None], 3, 2), format="rgb24")
            frame.pts, frame.time_base = 3000 * i, fractions.Fraction(1, 90000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    if matrix:
        content = bytearray(path.read_bytes())
        at = content.find(b"tkhd") + 44
        a, b, c, d = (v * _ONE & _LOW for v in matrix)
        struct.pack_into(">9I", content, at, a, b, 0, c, d, 0, 0, 0, 0x40000000)
        path.write_bytes(content)
    return path


def sequence(
    path: Path,
    *,
    spacing: str = "0.1 0.1 1",
    fields: tuple[str, ...] = (),
    top: tuple[str, ...] = (),
    kinds: str | None = "domain domain list",
    data: str = "LOCAL",
    digits: int = 4,
    stamp: Callable[[int], float | None] = lambda i: 1.5e9 + 0.05 * i,
    status: Callable[[int], str] = lambda i: "OK",
    stack: np.ndarray = STACK,
) -> Path:
    """MetaImage sequence with the per-frame fields of PLUS."""
    frames, rows, columns = stack.shape
    lines = [
        "ObjectType = Image", "NDims = 3", "BinaryData = True", "BinaryDataByteOrderMSB = False", "CompressedData = False",
        f"DimSize = {columns} {rows} {frames}", *([f"Kinds = {kinds}"] if kinds else []), "ElementType = MET_UCHAR",
        "Offset = 0 0 0", "TransformMatrix = 1 0 0 0 1 0 0 0 1", "UltrasoundImageOrientation = MFA",
        f"ElementSpacing = {spacing}", *top,
    ]  # fmt: skip
    identity = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
    for i in range(frames):
        p = f"Seq_Frame{i:0{digits}d}_"
        lines += [f"{p}ProbeToReferenceTransform = {identity}", f"{p}ProbeToReferenceTransformStatus = OK"]
        lines += [f"{p}ImageStatus = {status(i)}", *(p + field for field in fields)]
        if (time := stamp(i)) is not None:
            lines.append(f"{p}Timestamp = {time:.6f}")
    head = "\n".join([*lines, f"ElementDataFile = {data}", ""]).encode()
    path.write_bytes(head + (stack.tobytes() if data == "LOCAL" else b""))
    return path


def volume_header(path: Path, *extra: str, spacing: str = "0.5 0.5 0.5", stack: np.ndarray = STACK) -> Path:
    """MetaImage of three axes without a word on what the third one is, unless ``extra`` says it."""
    frames, rows, columns = stack.shape
    lines = [
        "ObjectType = Image", "NDims = 3", "BinaryData = True", "BinaryDataByteOrderMSB = False",
        f"DimSize = {columns} {rows} {frames}", f"ElementSpacing = {spacing}", "ElementType = MET_UCHAR", *extra,
        "ElementDataFile = LOCAL", "",
    ]  # fmt: skip
    path.write_bytes("\n".join(lines).encode() + stack.tobytes())
    return path


def nifti(
    path: Path,
    *,
    slope: float = 1.0,
    intercept: float = 0.0,
    units: int = 2,
    time: float | None = None,
    stack: np.ndarray = STACK,
    order: str = "<",
) -> Path:
    """NIfTI-1; with ``time`` the frames are moments on the fourth axis, so far apart in the units' time."""
    frames, rows, columns = stack.shape
    h = bytearray(352)
    struct.pack_into(order + "i", h, 0, 348)
    dim = (3, columns, rows, frames, 1, 1, 1, 1) if time is None else (4, columns, rows, 1, frames, 1, 1, 1)
    struct.pack_into(order + "8h", h, 40, *dim)
    struct.pack_into(
        order + "2h", h, 70, {"u1": 2, "i2": 4, "f4": 16}[stack.dtype.str[1:]], 8 * stack.itemsize
    )
    struct.pack_into(order + "8f", h, 76, 1, 0.1, 0.2, 1, time or 1, 1, 1, 1)
    struct.pack_into(order + "3f", h, 108, 352, slope, intercept)
    struct.pack_into("B", h, 123, units)
    h[344:348] = b"n+1\0"
    content = bytes(h) + stack.astype(stack.dtype.newbyteorder(order)).tobytes()
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)
    return path


def dicom(path: Path, *, frames: int = FRAMES, bare: bool = False, **tags: Any) -> Path:
    """Ultrasound multi-frame DICOM with one region of 0.1 mm; ``bare`` leaves out preamble and meta information."""
    d, meta = Dataset(), FileMetaDataset()
    meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.3.1"
    meta.MediaStorageSOPInstanceUID, meta.TransferSyntaxUID = generate_uid(), ExplicitVRLittleEndian
    d.file_meta, d.SOPClassUID, d.SOPInstanceUID = (
        meta,
        meta.MediaStorageSOPClassUID,
        meta.MediaStorageSOPInstanceUID,
    )
    d.Modality, d.Rows, d.Columns, d.SamplesPerPixel = "US", ROWS, COLUMNS, 1
    d.PhotometricInterpretation, d.BitsAllocated, d.BitsStored, d.HighBit = "MONOCHROME2", 8, 8, 7
    d.PixelRepresentation, d.NumberOfFrames, d.PixelData = 0, frames, STACK[:frames].tobytes()
    region = Dataset()
    region.RegionSpatialFormat, region.RegionDataType, region.RegionFlags = 1, 1, 0
    region.RegionLocationMinX0, region.RegionLocationMinY0 = 0, 0
    region.RegionLocationMaxX1, region.RegionLocationMaxY1 = COLUMNS - 1, ROWS - 1
    region.PhysicalUnitsXDirection = region.PhysicalUnitsYDirection = 3
    region.PhysicalDeltaX = region.PhysicalDeltaY = 0.01
    d.SequenceOfUltrasoundRegions = Sequence([region])
    for name, value in tags.items():
        setattr(d, name, value)
    if bare:
        del d.file_meta
        d.preamble = None
        d.save_as(path, implicit_vr=True, little_endian=True, enforce_file_format=False)
    else:
        d.save_as(path, enforce_file_format=True)
    return path


def ybr_422(frames: np.ndarray) -> bytes:
    """Pixels of YBR_FULL_422 without colour: two luma values, then the shared chroma."""
    packed = np.full((*frames.shape[:2], frames.shape[2] // 2, 4), 128, np.uint8)
    packed[..., 0], packed[..., 1] = frames[:, :, 0::2], frames[:, :, 1::2]
    return packed.tobytes()


def oriented(path: Path, orientation: int, pixels: np.ndarray = STACK[0]) -> Path:
    """Picture with an EXIF or TIFF orientation."""
    exif = Image.Exif()
    exif[274] = orientation
    options = {"quality": 95} if path.suffix == ".jpg" else {}
    Image.fromarray(pixels).save(path, exif=exif, **options)
    return path


SHOWN: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda a: a, 2: lambda a: a[:, ::-1], 3: lambda a: np.rot90(a, 2), 4: lambda a: a[::-1],
    5: lambda a: a.T, 6: lambda a: np.rot90(a, -1), 7: lambda a: np.rot90(a, 2).T, 8: lambda a: np.rot90(a, 1),
}  # fmt: skip
"""The picture that each of the eight orientations means (TIFF 6.0, tag 274)."""


def matlab_7_3(
    path: Path, arrays: dict[str, np.ndarray], cells: dict[str, list[np.ndarray]] | None = None
) -> Path:
    """Matlab 7.3: HDF5 behind 512 bytes of text, axes reversed, complex numbers as pairs, cells as references."""
    import h5py  # noqa: PLC0415 - needed by some tests alone

    with h5py.File(path, "w", userblock_size=512) as file:

        def store(where: Any, name: str, array: np.ndarray) -> Any:
            values = np.ascontiguousarray(np.atleast_2d(array).T)
            if np.iscomplexobj(values):
                pairs = np.empty(values.shape, np.dtype([("real", "<f8"), ("imag", "<f8")]))
                pairs["real"], pairs["imag"] = values.real, values.imag
                values = pairs
            data = where.create_dataset(name, data=values)
            data.attrs["MATLAB_class"] = np.bytes_("double" if array.dtype.kind in "fc" else str(array.dtype))
            return data

        for name, array in arrays.items():
            store(file, name, array)
        for name, items in (cells or {}).items():
            held = file.require_group("#refs#")
            references = [store(held, f"{name}{i}", item).ref for i, item in enumerate(items)]
            data = file.create_dataset(name, (1, len(items)), dtype=h5py.ref_dtype)
            data[0] = references
            data.attrs["MATLAB_class"] = np.bytes_("cell")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + b"\0" * 8 + b"\0\2IM")
    return path
