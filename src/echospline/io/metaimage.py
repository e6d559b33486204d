"""A cine as a MetaImage sequence (.mha): frames along the third axis, a time stamp each, as PLUS and 3D Slicer write them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from echospline.atomic import second_part
from echospline.errors import InputError
from echospline.scene import Pixels, RegularGrid

ELEMENT_TYPES = {
    "int8": "MET_CHAR", "uint8": "MET_UCHAR", "int16": "MET_SHORT", "uint16": "MET_USHORT",
    "int32": "MET_INT", "uint32": "MET_UINT", "float32": "MET_FLOAT", "float64": "MET_DOUBLE",
}  # fmt: skip


class MetaImageEncoder:
    """Streams raw frames after a header whose frame count is always right, so that a partial file can be read.

    Finishing writes a new header with every frame's time stamp and copies the pixels after it.

    Parameters
    ----------
    part : Path
        Temporary name.
    grid : RegularGrid
        Pixel centres, mm.
    channels : int
        Values per pixel: 1 (grey), 3 (RGB) or 4 (RGB and opacity).
    dtype : dtype
        Of the pixels.
    fps : float
        Nominal frames per second.

    Raises
    ------
    InputError
        If MetaImage has no such pixel type.
    """

    def __init__(
        self, part: Path, grid: RegularGrid, channels: int, dtype: np.dtype[np.generic], fps: float
    ) -> None:
        if dtype.name not in ELEMENT_TYPES:
            raise InputError(f"MetaImage holds pixels of {', '.join(ELEMENT_TYPES)}; got {dtype}")
        self._part, self._grid, self._channels = part, grid, channels
        self._dtype = dtype.newbyteorder("<")
        self._interval = 1.0 / fps
        self._times: list[float] = []
        self._file = part.open("wb")
        self._file.write(self._header(stamps=False))

    def add(self, pixels: Pixels, time: float) -> None:
        """Append one frame and count it."""
        self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(pixels, dtype=self._dtype).data)
        self._times.append(time)
        self._file.seek(0)
        self._file.write(self._header(stamps=False))

    def finish(self) -> Path:
        """Write header, time stamps and pixels into a whole file."""
        self._file.close()
        with second_part(self._part) as whole, self._part.open("rb") as source, whole.open("wb") as target:
            target.write(self._header(stamps=True))
            source.seek(len(self._header(stamps=False)))
            shutil.copyfileobj(source, target, 2**20)
        return whole

    def abandon(self) -> None:
        """Close; the header counts the frames written."""
        self._file.close()

    def _header(self, *, stamps: bool) -> bytes:
        (nx, ny), (dx, dy), (x, y) = self._grid.shape, self._grid.spacing, self._grid.origin
        count = len(self._times)
        interval = (self._times[-1] - self._times[0]) / (count - 1) if count > 1 else self._interval
        lines = [
            "ObjectType = Image",
            "NDims = 3",
            "BinaryData = True",
            "BinaryDataByteOrderMSB = False",
            "CompressedData = False",
            "TransformMatrix = 1 0 0 0 1 0 0 0 1",
            f"Offset = {x!r} {y!r} 0",
            "CenterOfRotation = 0 0 0",
            # Lateral and depth in mm; the third number is the frame interval in s.
            f"ElementSpacing = {dx!r} {dy!r} {interval:<24.17g}",
            f"DimSize = {nx} {ny} {count:<20d}",
            "Kinds = domain domain list",
            f"ElementNumberOfChannels = {self._channels}",
            f"ElementType = {ELEMENT_TYPES[self._dtype.name]}",
            "UltrasoundImageOrientation = MFA",
            "UltrasoundImageType = BRIGHTNESS",
        ]
        for i, time in enumerate(self._times if stamps else ()):
            lines += [f"Seq_Frame{i:04d}_Timestamp = {time!r}", f"Seq_Frame{i:04d}_ImageStatus = OK"]
        return "\n".join([*lines, "ElementDataFile = LOCAL\n"]).encode("ascii")
