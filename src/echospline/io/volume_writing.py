"""A volume as a MetaImage file (.mha), compressed, as 3D Slicer and PLUS read it."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from echospline.atomic import appearing
from echospline.errors import InputError
from echospline.io.metaimage import ELEMENT_TYPES
from echospline.scene import Volume


def write_volume(path: str | Path, volume: Volume) -> Path:
    """Write a volume; the file gets its name when it is whole.

    Parameters
    ----------
    path : path
        ``NAME.mha``.
    volume : Volume
        Its axes are those of its frame, so the file's directions are 1 0 0, 0 1 0 and 0 0 1.

    Raises
    ------
    InputError
        If the name has another ending, MetaImage has no such voxel type, or the disk refuses.
    """
    path = Path(path)
    if path.suffix.lower() != ".mha":
        raise InputError(f"a volume is written to NAME.mha; got {path.name}")
    voxels = np.ascontiguousarray(volume.voxels)
    if voxels.dtype.name not in ELEMENT_TYPES:
        raise InputError(f"MetaImage holds voxels of {', '.join(ELEMENT_TYPES)}; got {voxels.dtype}")
    data = zlib.compress(voxels.astype(voxels.dtype.newbyteorder("<"), copy=False).tobytes(), 6)
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CompressedData = True",
        f"CompressedDataSize = {len(data)}",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        f"Offset = {_numbers(volume.origin)}",
        "CenterOfRotation = 0 0 0",
        f"ElementSpacing = {_numbers(volume.spacing)}",
        f"DimSize = {' '.join(str(n) for n in volume.shape)}",
        "Kinds = domain domain domain",
        f"ElementType = {ELEMENT_TYPES[voxels.dtype.name]}",
        "ElementDataFile = LOCAL",
    ]
    with appearing(path) as part:
        part.write_bytes(("\n".join(lines) + "\n").encode("ascii") + data)
    return path


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(repr(float(v)) for v in values)
