"""Where a volume's file stands: the motion from the scene's frame, to which the volume was turned, back to the file's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK

from echospline.errors import InputError
from echospline.io.volume_reading import along_frame
from echospline.scene import Floats, Volume, nearest_rigid

_ITK: Any = SimpleITK
"""SimpleITK, whose functions carry no types."""

LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
ROUNDED = 0.01
"""Deviation from a motion that rounded numbers of a header may cause; a slanted volume is turned, not skewed."""


def scene_to_file(path: str | Path, depth: str, volume: Volume) -> Floats:
    """Return the motion from the scene's frame to the coordinates that a volume's file gives its voxels, mm, shape (4, 4).

    For a volume that `reconstruct` or PLUS has made they are those of the tracker's reference frame; for most other files, LPS.

    Parameters
    ----------
    path : path
        As for `read_volume`.
    depth : {"x", "-x", "y", "-y", "z", "-z"}
        As for `read_volume`.
    volume : Volume
        What `read_volume` has made of both.

    Raises
    ------
    InputError
        If the file's directions are no rotation, or its spacing is not in mm.
    """
    reader = _ITK.ImageFileReader()
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise InputError(f"cannot read the place of {path}: {str(error).splitlines()[-1].strip()}") from None
    direction = np.array(reader.GetDirection()).reshape(3, 3)
    origin, spacing = np.array(reader.GetOrigin()), np.array(reader.GetSpacing())
    size = np.array(reader.GetSize())
    # The eight corners go through the same turns as the voxels, so that no rule is written twice.
    numbered = Volume(np.arange(8.0).reshape(2, 2, 2), tuple(spacing * (size - 1)), source=str(path))
    turned = along_frame(numbered, direction).with_depth(depth).voxels
    low, length = np.array(volume.origin), np.array(volume.size)
    columns = []
    for z, y, x in ((0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)):
        corner = int(turned[z, y, x])
        index = np.array([corner & 1, corner >> 1 & 1, corner >> 2]) * (size - 1)
        columns.append(origin + direction @ (index * spacing))
    first, *ends = columns
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([(end - first) / h for end, h in zip(ends, length, strict=True)])
    axes = matrix[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > ROUNDED or np.linalg.det(axes) < 0:
        raise InputError(
            f"{path} does not say where it stands: expected directions that are a rotation and spacing in mm; place it "
            "with a transform SceneToReference (--config) instead"
        )
    matrix[:3, 3] = first - axes @ low
    return nearest_rigid(matrix)
