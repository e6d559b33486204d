"""A volume of ultrasound from MetaImage, NRRD or NIfTI, turned so that its depth runs along y and its surface is y = 0."""

from __future__ import annotations

from dataclasses import replace
from math import degrees, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK

from echospline.errors import InputError
from echospline.io.kind import kind_of
from echospline.io.recording import LIMIT, decoding
from echospline.io.volume import open_volume
from echospline.scene import Floats, Volume

_ITK: Any = SimpleITK
"""SimpleITK, whose functions carry no types."""


def read_volume(path: str | Path, depth: str = "y", *, limit: float = LIMIT) -> Volume:
    """Read a volume and turn it into the scene's frame.

    The file's directions are followed where they swap or reverse axes, so that ``depth`` names an axis of the frame that the
    file stands in (LPS). A slanted volume keeps its own axes: the nearest of the frame name them, and ``source`` gives the angle.

    Parameters
    ----------
    path : path
        .mha, .mhd, .nrrd, .nhdr, .nii or .nii.gz: grey voxels in three axes.
    depth : {"x", "-x", "y", "-y", "z", "-z"}
        Axis along which depth grows.
    limit : float
        MiB of voxels.

    Returns
    -------
    Volume
        In the file's own type; x lateral, y depth from 0, z elevation, x and z centred.

    Raises
    ------
    InputError
        If the file is damaged, too large, in colour or no volume, or a voxel is not a finite number.
    """
    path = Path(path)
    kind, format = kind_of(path)
    if kind not in ("metaimage", "nrrd", "nifti"):
        raise InputError(f"{path} is {format}; a volume is read from MetaImage, NRRD or NIfTI")
    recording = open_volume(path, kind, format, limit, whole=True)
    if recording.channels != 1:
        raise InputError(f"{path} is in colour; a volume has one value per voxel: convert it to grey")
    if recording.frames < 2 or min(recording.rows, recording.columns) < 2:
        raise InputError(
            f"{path} has {recording.columns} x {recording.rows} x {recording.frames} voxels; "
            "a volume has 2 or more along each of three axes"
        )
    with decoding(path, format):
        reader = _ITK.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        lengths = np.array([float(h) for h in reader.GetSpacing()])
        flat, size = np.array(reader.GetDirection()), reader.GetSize()
    if len(size) != 3:
        raise InputError(f"{path} has axes of {tuple(size)}; expected a volume of three")
    voxels = np.stack(list(recording.decode(None, False)))
    if np.issubdtype(voxels.dtype, np.floating) and not np.isfinite(voxels).all():
        raise InputError(f"{path} has voxels that are not finite numbers: replace them before use")
    spacing = _spacing(path, recording.spacing, lengths, turned=any("turned" in n for n in recording.notes))
    volume = Volume(voxels, spacing, source=path.name)
    return along_frame(volume, flat.reshape(3, 3)).with_depth(depth)


def _spacing(
    path: Path, plane: tuple[float, float] | None, lengths: Floats, *, turned: bool
) -> tuple[float, float, float]:
    """Return mm along the three axes; a unit that holds for the first two holds for the third."""
    if plane is None:
        plane = (1.0, 1.0) if turned else (float(lengths[0]), float(lengths[1]))
    scale = plane[0] * plane[1] / (lengths[0] * lengths[1])
    third = float(lengths[2]) * float(np.sqrt(scale))
    # NIfTI stores 32-bit lengths: 0.1 is stored as 0.10000000149 and means 0.1.
    third = float(str(np.float32(third)))
    if not (isfinite(third) and third > 0):
        raise InputError(
            f"{path} has a spacing of {third} mm along its third axis; expected a positive length"
        )
    return plane[0], plane[1], third


def along_frame(volume: Volume, direction: Floats) -> Volume:
    """Swap and reverse axes so that each lies along the nearest one of the frame that directions (3, 3) refer to."""
    if not np.isfinite(direction).all():
        raise InputError(f"{volume.source} has directions that are not finite numbers: {direction.tolist()}")
    axes = np.argmax(np.abs(direction), axis=0)  # for x, y and z of the file: which axis of the frame
    if sorted(axes) != [0, 1, 2]:
        axes = np.arange(3)
    order = np.argsort(axes)  # for each axis of the frame: which of the file
    signs = np.array([direction[k, order[k]] for k in range(3)])
    voxels = volume.voxels.transpose([2 - int(a) for a in order[::-1]])
    voxels = voxels[tuple(slice(None, None, -1 if s < 0 else 1) for s in signs[::-1])]
    x, y, z = (volume.spacing[int(a)] for a in order)
    slant = degrees(float(np.arccos(np.clip(np.abs(signs).min(), -1.0, 1.0))))
    told = f" (slanted by {slant:.1f} degrees to its frame)" if slant > 0.1 else ""
    return replace(
        volume, voxels=np.ascontiguousarray(voxels), spacing=(x, y, z), source=volume.source + told
    )
