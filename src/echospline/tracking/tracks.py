"""Tracked motion on disk: ``.npz`` with the keys of ``displacement.npz`` and ``confidence``, or ``.mha`` vectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK

from echospline.atomic import appearing
from echospline.errors import InputError
from echospline.io import (
    LIMIT,
    MIB,
    DisplacementRecord,
    decoding,
    head,
    is_spatial_record,
    read_displacement,
    read_spatial_displacement,
)
from echospline.scene import Floats, NeedlePose, RegularGrid
from echospline.tracking.tracker import Track

sitk: Any = SimpleITK  # untyped

ABSENT = NeedlePose((0.0, 0.0), (0.0, 0.0), 0.0)
"""A needle of zero length: it touches nothing."""


@dataclass(frozen=True)
class TrackRecord:
    """Displacement, needle and confidence (frames, n): 1 where the file has none (a simulation), 0 where tissue left the slice (in space)."""

    motion: DisplacementRecord
    confidence: Floats


def write_track(path: str | Path, track: Track, poses: Sequence[NeedlePose] | None = None) -> None:
    """Write tracked motion.

    Parameters
    ----------
    path : str or Path
        ``.npz``; or ``.mha``: an image (x, y, frame) of 32-bit vectors (lateral mm, axial mm, confidence) whose
        header stores times and needle, for points on a regular grid.
    track : Track
    poses : sequence of NeedlePose, optional
        The needle in every frame.

    Raises
    ------
    InputError
        If the suffix is another, or the points of an ``.mha`` are no regular grid.
    """
    path = Path(path)
    poses = [ABSENT] * len(track.times) if poses is None else list(poses)
    record = DisplacementRecord(
        track.points, track.displacement, np.asarray(track.times, dtype=np.float64),
        np.array([p.tip for p in poses]), np.array([p.entry for p in poses]), np.array([p.speed for p in poses]),
    )  # fmt: skip
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".mha"):
        raise InputError(f"tracked motion is written as .npz or .mha; got {path.name!r}")
    with appearing(path) as part:
        if suffix == ".npz":
            arrays = {
                k: getattr(record, k) for k in ("points", "displacement", "times", "tip", "entry", "speed")
            }
            with part.open("wb") as file:
                np.savez(file, **arrays, confidence=track.confidence)
        else:
            named = part.with_name(part.name + ".mha")  # SimpleITK goes by the ending
            try:
                sitk.WriteImage(_vectors(record, track.confidence), str(named))
                named.replace(part)
            finally:
                named.unlink(missing_ok=True)


def read_track(path: str | Path, *, limit: float = LIMIT) -> TrackRecord:
    """Read tracked or simulated motion, ``.npz`` or ``.mha``; sizes are checked before anything is allocated.

    Raises
    ------
    InputError
        If the file is neither, damaged or too large.
    """
    path = Path(path)
    if head(path).startswith(b"PK"):
        record = read_displacement(path, limit=limit)
        with decoding(path, "track"), np.load(path, allow_pickle=False) as archive:
            if is_spatial_record(path):  # tissue that left the slice is not to be found in the picture
                valid = read_spatial_displacement(path, limit=limit).picture_valid
                return TrackRecord(record, valid.reshape(len(record), -1).astype(np.float64))
            if "confidence" not in archive.files:
                return TrackRecord(record, np.ones(record.displacement.shape[:2]))
            confidence = _confidence(archive, path, record.displacement.shape[:2])
        return TrackRecord(record, confidence)
    return _read_vectors(path, limit)


def _confidence(archive: np.lib.npyio.NpzFile, path: Path, shape: tuple[int, ...]) -> Floats:
    held = archive.zip.getinfo("confidence.npy").file_size if archive.zip is not None else 0
    if not 0 < held <= 8 * int(np.prod(shape)) + 4096:
        raise InputError(f"{path}: confidence holds {held} bytes; expected shape {shape}")
    confidence = np.asarray(archive["confidence"], dtype=np.float64)
    return _checked(confidence, path, shape)


def _checked(confidence: Floats, path: Path, shape: tuple[int, ...]) -> Floats:
    if confidence.shape != shape or not ((confidence >= 0) & (confidence <= 1)).all():
        raise InputError(
            f"{path}: confidence must have shape {shape} and lie in 0 to 1; got shape {confidence.shape}"
        )
    return confidence


def _vectors(record: DisplacementRecord, confidence: Floats) -> Any:
    grid = record.grid()
    nx, ny = grid.shape
    frames = len(record)
    values = np.concatenate([record.displacement, confidence[..., None]], axis=2).astype(np.float32)
    image = sitk.GetImageFromArray(values.reshape(frames, ny, nx, 3), isVector=True)
    step = float(np.median(np.diff(record.times))) if frames > 1 else 1.0
    image.SetSpacing((*grid.spacing, step))
    image.SetOrigin((*grid.origin, float(record.times[0])))
    for name in ("times", "tip", "entry", "speed"):
        image.SetMetaData(name, " ".join(f"{v:.9g}" for v in np.ravel(getattr(record, name))))
    return image


def _read_vectors(path: Path, limit: float) -> TrackRecord:
    with decoding(path, "track"):
        reader = sitk.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        size = reader.GetSize()
        if reader.GetDimension() != 3 or reader.GetNumberOfComponents() != 3:
            raise InputError(
                f"{path} is no track: expected an image (x, y, frame) of 3-vectors; got size {size}"
            )
        held = float(np.prod(size, dtype=np.float64)) * 12 / MIB
        if held > limit:
            raise InputError(
                f"{path} declares {held:,.0f} MiB, more than the limit of {limit:,.0f} MiB: raise it"
            )
        image = reader.Execute()
        values = np.asarray(sitk.GetArrayFromImage(image), dtype=np.float64)
        frames, ny, nx, _ = values.shape
        (dx, dy, dt), (x0, y0, t0) = image.GetSpacing(), image.GetOrigin()
        kept = {
            k: np.array(image.GetMetaData(k).split(), dtype=np.float64)
            for k in ("times", "tip", "entry", "speed")
            if image.HasMetaDataKey(k)
        }
    grid = RegularGrid((nx, ny), (dx, dy), (x0, y0))
    flat = values.reshape(frames, nx * ny, 3)
    zeros = np.zeros(2 * frames)
    if any(
        len(kept.get(k, zeros[:n])) != n
        for k, n in (("times", frames), ("tip", 2 * frames), ("entry", 2 * frames), ("speed", frames))
    ):
        raise InputError(f"{path}: times, tip, entry and speed of its header do not fit {frames} frames")
    motion = DisplacementRecord(
        grid.nodes.copy(),
        np.ascontiguousarray(flat[..., :2]),
        kept.get("times", t0 + dt * np.arange(frames)),
        kept.get("tip", zeros).reshape(frames, 2),
        kept.get("entry", zeros).reshape(frames, 2),
        kept.get("speed", np.zeros(frames)),
    )
    # 32-bit rounding may make a confidence of 1 exceed 1
    confidence = np.minimum(flat[..., 2], 1.0) if flat[..., 2].max(initial=0.0) < 1.0 + 1e-6 else flat[..., 2]
    return TrackRecord(motion, _checked(confidence, path, (frames, nx * ny)))
