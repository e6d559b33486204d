"""A volume of ultrasound from MetaImage, NRRD, NIfTI or DICOM, turned so that its depth runs along y and its surface is y = 0."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product
from math import degrees, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK

from echospline.errors import InputError
from echospline.io.kind import kind_of
from echospline.io.recording import LIMIT, Recording, decoding
from echospline.io.volume import open_volume
from echospline.scene import Floats, Volume
from echospline.scene.volume import Voxels

_ITK: Any = SimpleITK
"""SimpleITK, whose functions carry no types."""


def read_volume(path: str | Path, depth: str = "y", *, limit: float = LIMIT) -> Volume:
    """Read a volume and turn it into the scene's frame.

    The file's directions are followed where they swap or reverse axes, so that ``depth`` names an axis of the frame that the
    file stands in (LPS, or DICOM's volume frame of reference). A slanted volume keeps its own axes: the nearest of the frame name them, and ``source`` gives the angle.

    Parameters
    ----------
    path : path
        .mha, .mhd, .nrrd, .nhdr, .nii, .nii.gz or enhanced DICOM (Enhanced US Volume): grey voxels in three axes.
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
    return read_volume_and_axis(path, depth, limit=limit)[0]


def read_volume_and_axis(path: str | Path, depth: str = "y", *, limit: float = LIMIT) -> tuple[Volume, str]:
    """Read a volume as `read_volume` does, and say in words along which axis of its file depth runs: "the second, backwards"."""
    path = Path(path)
    kind, format = kind_of(path)
    if kind == "dicom":
        volume, direction = _of_dicom(path, limit)
        return along_frame(volume, direction).with_depth(depth), _axis_of_file(direction, depth)
    if kind not in ("metaimage", "nrrd", "nifti"):
        raise InputError(f"{path} is {format}; a volume is read from MetaImage, NRRD, NIfTI or DICOM")
    recording = open_volume(path, kind, format, limit, whole=True)
    if not recording.volume and recording.frames > 1:
        raise InputError(
            f"{path} is a cine, whose third axis is time; expected a volume: of a tracked sweep `echospline reconstruct` makes one"
        )
    _check(path, recording)
    with decoding(path, format):
        reader = _ITK.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        lengths = np.array([float(h) for h in reader.GetSpacing()])
        flat, size = np.array(reader.GetDirection()), reader.GetSize()
    if len(size) != 3:
        raise InputError(f"{path} has axes of {tuple(size)}; expected a volume of three")
    voxels = np.stack(list(recording.decode(None, False)))
    _check_finite(path, voxels)
    spacing = _spacing(path, recording.spacing, lengths, turned=any("turned" in n for n in recording.notes))
    volume = Volume(voxels, spacing, source=path.name)
    direction = flat.reshape(3, 3)
    return along_frame(volume, direction).with_depth(depth), _axis_of_file(direction, depth)


def _of_dicom(path: Path, limit: float) -> tuple[Volume, Floats]:
    """Read the slices of an enhanced DICOM file, and the directions of its axes in its frame of reference."""
    # pydicom takes longer to load than every other reader together: only for its files
    from echospline.io.dicom import open_dicom_volume, slices  # noqa: PLC0415

    recording, order, spacing, direction = open_dicom_volume(path, limit)
    _check(path, recording)
    voxels = np.stack(list(slices(recording, order)))
    _check_finite(path, voxels)
    return Volume(voxels, spacing, source=path.name), direction


def _check(path: Path, recording: Recording) -> None:
    """Refuse what is no volume of grey voxels."""
    if recording.channels != 1:
        raise InputError(f"{path} is in colour; a volume has one value per voxel: convert it to grey")
    if recording.frames < 2 or min(recording.rows, recording.columns) < 2:
        raise InputError(
            f"{path} has {recording.columns} x {recording.rows} x {recording.frames} voxels; "
            "a volume has 2 or more along each of three axes"
        )


def _check_finite(path: Path, voxels: Voxels) -> None:
    """Refuse voxels that are no numbers."""
    if np.issubdtype(voxels.dtype, np.floating) and not np.isfinite(voxels).all():
        raise InputError(f"{path} has voxels that are not finite numbers: replace them before use")


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
    """Swap and reverse axes so that each lies along the nearest one of the frame that directions (3, 3) refer to.

    What was right-handed stays so: however far the volume is slanted, it is turned and never mirrored.
    """
    if not np.isfinite(direction).all():
        raise InputError(f"{volume.source} has directions that are not finite numbers: {direction.tolist()}")
    order, signs = _nearest_axes(direction)
    along = np.array([sign * direction[k, order[k]] for k, sign in enumerate(signs)])
    voxels = volume.voxels.transpose([2 - a for a in order[::-1]])
    voxels = voxels[tuple(slice(None, None, -1 if s < 0 else 1) for s in signs[::-1])]
    x, y, z = (volume.spacing[a] for a in order)
    slant = degrees(float(np.arccos(np.clip(along.min(), -1.0, 1.0))))
    told = f" (slanted by {slant:.1f} degrees to its frame)" if slant > 0.1 else ""
    return replace(
        volume, voxels=np.ascontiguousarray(voxels), spacing=(x, y, z), source=volume.source + told
    )


def _axis_of_file(direction: Floats, depth: str) -> str:
    """Return in words which axis of the file depth runs along."""
    order, signs = _nearest_axes(direction)
    k = "xyz".index(depth[-1])
    forwards = (signs[k] > 0) != depth.startswith("-")
    return ("the first", "the second", "the third")[order[k]] + ("" if forwards else ", backwards")


def _nearest_axes(direction: Floats) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return, for x, y and z of the frame, which axis of the file lies along it and whether forwards (1) or backwards (-1).

    Of the 24 ways with the hand of ``direction`` it is that of the smallest turn; the first of them where several are as small.
    """
    hand = -1 if np.linalg.det(direction) < 0 else 1
    ways = [
        (order, signs)
        for order in permutations(range(3))
        for signs in product((1, -1), repeat=3)
        if np.linalg.det(np.eye(3)[list(order)] * signs) * hand > 0
    ]
    return max(
        ways,
        key=lambda way: round(
            float(sum(s * direction[k, a] for k, (a, s) in enumerate(zip(*way, strict=True)))), 9
        ),
    )
