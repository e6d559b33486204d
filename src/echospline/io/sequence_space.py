"""A recorded procedure in a scene in space: where its probe and needle were, one keyframe per recorded picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from echospline.errors import InputError
from echospline.io.sequence import ENTRY, IMAGE, NEEDLE, REFERENCE, Sequence
from echospline.scene import (
    Floats,
    ImagingPlane,
    PlanePath,
    Reach,
    RegularGrid,
    SpatialInsertion,
    SpatialPose,
    chain_between,
    frames_of,
    nearest_rigid,
    picture_plane,
    pose_in_space,
    rigid_fault,
)
from echospline.scene.space import as_triple

SCENE = "Scene"
SKEWED = 0.1
"""Cosine of the angle between columns and rows that a recording's calibration may have (5.7 degrees): one that was fitted without the
condition of right angles has some (the spine sweep of PLUS 2.8 degrees), and here pixels are put where it says."""
ARRIVES = 1.0
"""mm; a needle deeper than this in the first picture was not pushed there in it."""
UNEVEN = 0.5
"""Deviation of a picture's time from an even rate, in pictures, from which it is said."""


@dataclass(frozen=True, eq=False)
class SpatialRecording:
    """Paths of probe and needle in a scene, played at the recording's mean rate: picture k is at k / fps.

    Parameters
    ----------
    planes : PlanePath
        Of the probe: the middle of its face and its axes.
    insertion : SpatialInsertion
        Of the needle; of depth 0 throughout where the recording has none.
    pictures : ndarray of int, shape (n,)
        Which picture of the sequence each of the n is.
    pixels : ndarray, shape (2, 2)
        Shift in the probe's plane from one column, and from one row, to the next, mm, in its columns: diagonal where the calibration has no skew.
    times : ndarray, shape (n,)
        When they were recorded, s from the first.
    fps : float
        Mean rate.
    notes : tuple of str
        What was bridged or is missing.
    """

    planes: PlanePath
    insertion: SpatialInsertion
    pictures: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
    pixels: Floats
    times: Floats
    fps: float
    notes: tuple[str, ...]


def face_grid(
    sequence: Sequence,
    face: tuple[float, float] | None = None,
    spacing: tuple[float, float] | None = None,
    calibration: Mapping[str, Floats] | None = None,
) -> RegularGrid:
    """Return the pixels of a recording in the frame of the probe's picture, whose origin is the middle of the probe's face, mm.

    Parameters
    ----------
    sequence : Sequence
        The recording.
    face : (column, row), optional
        Pixel in the middle of the probe's face; the middle of the first row when not given.
    spacing : (lateral, depth), optional
        mm per pixel, if neither recording nor calibration has one.
    calibration : mapping of str to ndarray, optional
        Fixed transforms that the recording lacks; one from the picture has its spacing.

    Raises
    ------
    InputError
        If there is no spacing, or the face lies outside the picture.
    """
    if spacing is None:
        leading = [m for name, m in (calibration or {}).items() if frames_of(name)[0] == IMAGE]
        lengths = [tuple(float(h) for h in np.linalg.norm(m[:3, :2], axis=0)) for m in leading]
        spacing = next(((dx, dy) for dx, dy in lengths if min(dx, dy) > 0), None)
    grid = sequence.grid(spacing)
    columns, rows = grid.shape
    column, row = face or ((columns - 1) / 2, 0.0)
    if not (0 <= column <= columns - 1 and 0 <= row <= rows - 1):
        raise InputError(
            f"the middle of the probe's face is a pixel COLUMN,ROW of the picture, {columns} x {rows}; got {column:g},{row:g}"
        )
    dx, dy = grid.spacing
    return RegularGrid(grid.shape, grid.spacing, (-column * dx, -row * dy))


def paths_in_scene(
    sequence: Sequence,
    grid: RegularGrid,
    place: Floats,
    box: tuple[Floats, Floats],
    *,
    needle: str = NEEDLE,
    reference: str = REFERENCE,
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
    calibration: Mapping[str, Floats] | None = None,
    reach: Reach | None = None,
) -> SpatialRecording:
    """Return the paths of a recording's probe and needle in a scene.

    Pictures in which the tracker lost the probe or the needle are bridged: between those around them it goes straight.

    Parameters
    ----------
    sequence : Sequence
        The recording.
    grid : RegularGrid
        Its pixels in the picture's frame; see `face_grid`.
    place : ndarray, shape (4, 4)
        Scene to reference frame, mm, where no transform from the scene says so.
    box : (low, high)
        Corners of the volume in the scene, mm.
    needle, reference : str
        Frame at the needle's tip; frame in which the scene stands.
    axis : (x, y, z)
        Direction of insertion in the needle's frame.
    calibration : mapping of str to ndarray, optional
        Fixed transforms that the recording lacks.
    reach : Reach, optional
        Distance from the volume within which the needle counts.

    Raises
    ------
    InputError
        If no chain of transforms leads from the picture to the scene in two pictures or more, or one of its transforms is none that a rigid
        tool can have.
    """
    fixed = dict(calibration or {})
    good = np.flatnonzero(sequence.valid)
    found: dict[int, ImagingPlane] = {}
    poses: dict[int, SpatialPose] = {}
    pixels = np.eye(2)
    upward = 0
    for i in good:
        known = {**fixed, **sequence.known(int(i))}
        if not any(SCENE in frames_of(name) for name in known):
            known[f"{SCENE}To{reference}"] = place
        picture = _chained(known, IMAGE, SCENE, f"{sequence.source}, picture {i}")
        if picture is not None:
            plane = picture_plane(picture, grid, SKEWED)
            pixels = plane.matrix[:3, :2].T @ picture[:3, :2]
            found[int(i)] = plane
            upward += bool(plane.matrix[1, 1] < 0)
        pose = _needle_pose(known, needle, axis, box, reach or Reach(), f"{sequence.source}, picture {i}")
        if pose is not None:
            poses[int(i)] = pose
    if len(found) < 2:
        raise InputError(
            f"{sequence.source or 'the sequence'} has the place of its picture in {len(found)} of {len(good)} good pictures; it takes "
            f"two: a chain of transforms must lead from {IMAGE} to {reference}, and there are "
            f"{', '.join(sorted({*sequence.transforms, *fixed})) or 'none'}: give --config FILE.xml with ImageToProbe, or another "
            "--reference"
        )
    first, last = min(found), max(found)
    pictures = good[(good >= first) & (good <= last)]
    times = sequence.times[pictures] - sequence.times[first]
    if not (np.diff(times) > 0).all():
        raise InputError(f"{sequence.source or 'the sequence'} has times that do not ascend")
    fps = (len(pictures) - 1) / float(times[-1])
    at = {int(i): k / fps for k, i in enumerate(pictures)}
    tracked = [i for i in found if i in at]
    planes = PlanePath(np.array([at[i] for i in tracked]), tuple(found[i] for i in tracked))
    notes = []
    if len(tracked) < len(pictures):
        notes.append(f"the probe is bridged in {len(pictures) - len(tracked)} of {len(pictures)} pictures")
    if upward > len(found) / 2:
        notes.append(
            "the probe's beam points out of the skin in most pictures: say where the skin lies (--depth-axis), or where the volume stands (--place)"
        )
    seen = [i for i in poses if i in at]
    if not seen:
        notes.append(
            f"no transform leads from {needle} to {reference}: the recording has no needle, tissue stays at rest"
        )
    elif poses[seen[0]].depth > ARRIVES:
        notes.append(
            f"the needle is {poses[seen[0]].depth:.1f} mm deep when the recording begins: the tissue counts as at rest then, and it is pushed there "
            "within a picture"
        )
    if 0 < len(seen) < len(pictures):
        notes.append(f"the needle is bridged in {len(pictures) - len(seen)} of {len(pictures)} pictures")
    off = float(np.abs(times * fps - np.arange(len(pictures))).max())
    if off > UNEVEN:
        notes.append(
            f"pictures are played evenly at {fps:.3g} per second; the recorded times differ by up to {off / fps:.2g} s"
        )
    return SpatialRecording(planes, _path(poses, seen, at, box), pictures, pixels, times, fps, tuple(notes))


def _chained(known: Mapping[str, Floats], start: str, end: str, where: str) -> Floats | None:
    """Return the product of the transforms that lead from one frame to another; None where none do, or a tool on the way was not seen.

    Raises
    ------
    InputError
        If one of them, other than the picture's calibration, is none that a rigid tool can have.
    """
    found = chain_between(known, start, end)
    if found is None:
        return None
    for name in found[1]:
        kind, reason = rigid_fault(known[name]) if IMAGE not in frames_of(name) else ("", "")
        if kind == "empty":  # the zeros of a tracker that does not see the tool
            return None
        if kind:
            raise InputError(f"{where}, {name}: {reason}")
    return found[0]


def _needle_pose(
    known: Mapping[str, Floats],
    needle: str,
    axis: tuple[float, float, float],
    box: tuple[Floats, Floats],
    reach: Reach,
    where: str,
) -> SpatialPose | None:
    """Return the needle's pose; of depth 0 where it is far from the volume, None where it is not tracked."""
    tip = _chained(known, needle, SCENE, where)
    if tip is None:
        return None
    tracked = ImagingPlane(np.eye(4)).see(nearest_rigid(tip), axis)
    pose = pose_in_space(tracked, *box, reach)
    if pose is None:
        at = as_triple(np.clip(tracked.tip, *box) * [1.0, 0.0, 1.0], "entry")
        return SpatialPose(at, at)
    entry = _chained(known, ENTRY, SCENE, where) if needle == NEEDLE else None
    if entry is not None and pose.depth > 0:
        return SpatialPose(as_triple(entry[:3, 3], "entry"), pose.tip)
    return pose


def _path(
    poses: Mapping[int, SpatialPose], seen: list[int], at: Mapping[int, float], box: tuple[Floats, Floats]
) -> SpatialInsertion:
    """Return the needle's path; one keyframe, or none, becomes a needle that stands still."""
    if not seen:
        middle = np.array([(box[0] + box[1]) / 2 * [1.0, 0.0, 1.0]])
        return SpatialInsertion(np.array([0.0, max(at.values())]), middle, np.repeat(middle, 2, axis=0))
    times = [at[i] for i in seen]
    entries, tips = [poses[i].entry for i in seen], [poses[i].tip for i in seen]
    if times[0] > 0.0:  # times of the insertion begin with those of the probe
        times, entries, tips = [0.0, *times], [entries[0], *entries], [tips[0], *tips]
    if len(times) == 1:
        times, entries, tips = [0.0, max(at.values())], entries * 2, tips * 2
    return SpatialInsertion(np.array(times), np.array(entries), np.array(tips))
