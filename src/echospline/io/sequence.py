"""Recorded procedures: images with tracked transforms, in the formats of PLUS (.igs.mha) and 3D Slicer (.seq.nrrd)."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from echospline.atomic import appearing, part_of, writing
from echospline.errors import InputError
from echospline.io.sequence_header import Header, read_header, read_pixels, write_header
from echospline.scene import (
    AXIAL,
    Cine,
    Floats,
    ImagingPlane,
    Insertion,
    NeedlePose,
    Pixels,
    Reach,
    RegularGrid,
    SpatialPose,
    UltrasoundImage,
    frames_of,
    transform_between,
)

NEEDLE, ENTRY, IMAGE, REFERENCE = "NeedleTip", "NeedleEntry", "Image", "Reference"
"""Frames that echospline writes; NeedleEntry is the point where the shaft passes the skin, so that a reader need not guess it."""


@dataclass(frozen=True)
class Sequence:
    """Frames with their times and the transforms tracked with them.

    Parameters
    ----------
    frames : ndarray, shape (n, rows, columns) or (n, rows, columns, 3)
        In orientation MF: columns grow to the probe's marked side, rows away from the probe.
    times : ndarray, shape (n,)
        Seconds, as recorded.
    transforms : mapping of str to ndarray, shape (n, 4, 4)
        By name (``NeedleTipToReference``); NaN where the tracker lost the tool.
    valid : ndarray, shape (n,), bool
        Frames whose picture is good.
    spacing : (lateral, depth), optional
        mm per pixel, where the file has it.
    source : str
        Its origin.
    """

    frames: Pixels
    times: Floats
    transforms: Mapping[str, Floats]
    valid: NDArray[np.bool_]
    spacing: tuple[float, float] | None = None
    source: str = ""
    fields: Mapping[str, str] = field(default_factory=dict)
    """Other fields of the file's header."""

    def __len__(self) -> int:
        return len(self.frames)

    def known(self, index: int) -> dict[str, Floats]:
        """Return the transforms that were valid at one frame."""
        return {name: m[index] for name, m in self.transforms.items() if np.isfinite(m[index]).all()}

    def grid(self, spacing: tuple[float, float] | None = None) -> RegularGrid:
        """Return the pixel grid in mm; the spacing given, else the calibration's (Image to any frame), else the file's.

        Raises
        ------
        InputError
            If neither the caller nor the file gives a spacing.
        """
        rows, columns = self.frames.shape[1:3]
        found = spacing or self._calibrated() or self.spacing
        if found is None:
            raise InputError(
                f"{self.source or 'the sequence'} has no spacing: no transform from Image, and PLUS writes 1 1 "
                "for unknown; give --spacing LATERAL,DEPTH in mm per pixel"
            )
        return RegularGrid((columns, rows), found)

    def _calibrated(self) -> tuple[float, float] | None:
        for name, matrices in self.transforms.items():
            good = matrices[np.isfinite(matrices).all(axis=(1, 2))]
            if frames_of(name)[0] == IMAGE and len(good):
                lateral, depth = (float(h) for h in np.linalg.norm(good[0, :3, :2], axis=0))
                # the identity is the value of a transform that was never calibrated
                if (lateral, depth) != (1.0, 1.0):
                    return lateral, depth
        return None

    def cine(self, spacing: tuple[float, float] | None = None) -> Cine:
        """Return the good frames, with times from 0."""
        times = self.times[self.valid]
        return Cine(self.frames[self.valid], times - times[0], self.grid(spacing), self.source)

    def image(self, spacing: tuple[float, float] | None = None) -> UltrasoundImage:
        """Return the first good frame: tissue that the needle has not moved yet, if the recording began before it."""
        return UltrasoundImage(self.frames[np.argmax(self.valid)], self.grid(spacing), self.source)

    def insertion(
        self,
        needle: str = NEEDLE,
        *,
        spacing: tuple[float, float] | None = None,
        axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
        calibration: Mapping[str, Floats] | None = None,
        reach: Reach | None = None,
    ) -> Insertion:
        """Return the path of the needle in the imaging plane, times from the first good frame.

        Frames in which the tracker lost needle or probe are bridged by straight lines.

        Parameters
        ----------
        needle : str
            Frame at the needle's tip (``NeedleTip``, ``StylusTip``).
        spacing : (lateral, depth), optional
            mm per pixel, if the recording has none.
        axis : (x, y, z)
            Direction of insertion in that frame.
        calibration : mapping of str to ndarray, optional
            Fixed transforms that the recording lacks (``NeedleTipToNeedle``, ``ImageToProbe``).
        reach : Reach, optional
            Distances from the plane within which the needle counts.

        Raises
        ------
        InputError
            If no chain of transforms leads from the needle to the image in two frames or more.
        """
        grid, reach = self.grid(spacing), reach or Reach()
        start = self.times[self.valid][0]
        times: list[float] = []
        poses: list[NeedlePose] = []
        for i in np.flatnonzero(self.valid):
            known = {**(calibration or {}), **self.known(int(i))}
            pose = _pose(known, needle, axis, grid, reach)
            t = float(self.times[i] - start)
            if pose is not None and not (times and t <= times[-1]):
                times.append(t)
                poses.append(pose)
        if len(poses) < 2:
            raise InputError(
                f"{self.source or 'the sequence'} shows {needle} near the image in {len(poses)} of {len(self)} frames; "
                f"it takes two. It has {', '.join(sorted(self.transforms)) or 'no transforms'}; name the needle's "
                "frame or give the missing calibration"
            )
        return Insertion(
            np.array(times), np.array([p.entry for p in poses]), np.array([p.tip for p in poses])
        )


def _pose(
    known: Mapping[str, Floats],
    needle: str,
    axis: tuple[float, float, float],
    grid: RegularGrid,
    reach: Reach,
) -> NeedlePose | None:
    # Any frame common to both serves: the plane is placed in it, and the needle is converted from it.
    for frame in sorted({f for name in known for f in frames_of(name)} - {IMAGE}):
        image = transform_between(known, IMAGE, frame)
        tip = transform_between(known, needle, frame)
        if image is None or tip is None:
            continue
        plane = ImagingPlane.of_image(image, grid)
        pose = plane.see(tip, axis).pose(grid, reach)
        entry = transform_between(known, ENTRY, frame) if needle == NEEDLE else None
        if pose is None or entry is None:
            return pose
        x, y, _ = plane.see(entry).tip
        return NeedlePose((x, y), pose.tip if pose.depth > 0 else plane.see(tip).tip[:2])
    return None


def read_sequence(path: str | Path, *, limit: float = 2048.0) -> Sequence:
    """Read a recording of PLUS or 3D Slicer.

    Parameters
    ----------
    path : path
        ``.mha``, ``.mhd`` or ``.nrrd``, pixels raw or compressed.
    limit : float
        MiB that the pixels may fill.

    Raises
    ------
    InputError
        If the file is not whole, not of this kind or too large.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    with path.open("rb") as file:
        header = read_header(file, path)
        pixels = read_pixels(file, path, header, limit)
    if not header.valid.any():
        raise InputError(f"{path} has no frame with a good picture (Seq_Frame..._ImageStatus = OK)")
    if header.flip_columns:
        pixels = pixels[:, :, ::-1]
    if header.flip_rows:
        pixels = pixels[:, ::-1]
    return Sequence(
        np.ascontiguousarray(pixels),
        header.times,
        header.transforms,
        header.valid,
        header.spacing,
        path.name,
        header.other,
    )


class SequenceWriter:
    """Writes a run frame by frame: pixels, time, image and needle transforms; use it as a context.

    The file gets its name only when it is whole; after an exception no file of that name is written or changed.

    Parameters
    ----------
    path : path
        ``NAME.igs.mha`` (PLUS, Slicer) or ``NAME.seq.nrrd`` (Slicer).
    grid : RegularGrid
        Pixels in mm.
    plane : ImagingPlane, optional
        Plane of the picture; Slicer's axial plane when not given. In space every frame has its own (`add`).

    Raises
    ------
    InputError
        If the name has another ending.
    """

    def __init__(self, path: str | Path, grid: RegularGrid, plane: ImagingPlane | None = None) -> None:
        self.path, self.grid = Path(path), grid
        self.plane = plane or ImagingPlane(AXIAL)
        if not self.path.name.lower().endswith((".mha", ".nrrd")):
            raise InputError(f"a sequence is written to NAME.igs.mha or NAME.seq.nrrd; got {self.path.name}")
        self._times: list[float] = []
        self._images: list[Floats] = []
        self._tips: list[Floats] = []
        self._entries: list[Floats] = []
        self._form: tuple[tuple[int, ...], np.dtype[np.generic]] | None = None
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._spool = part_of(self.path).open("x+b")

    def add(
        self, pixels: Pixels, time: float, pose: NeedlePose | SpatialPose, plane: ImagingPlane | None = None
    ) -> None:
        """Append one frame.

        Parameters
        ----------
        pixels : ndarray
            The picture.
        time : float
            s.
        pose : NeedlePose or SpatialPose
            The needle in the plane, or in space: then in the frame that planes lead to, Reference.
        plane : ImagingPlane, optional
            Plane of this picture; the writer's when not given.

        Raises
        ------
        InputError
            If the frame differs in shape or type from the first, does not fit the grid, or is not later.
        """
        pixels = np.asarray(pixels)
        form = (pixels.shape, pixels.dtype)
        if self._form is None:
            UltrasoundImage(pixels, self.grid)
            self._form = form
        if form != self._form:
            raise InputError(
                f"a frame must be {self._form[0]} {self._form[1]} as the first; got {form[0]} {form[1]}"
            )
        if self._times and not time > self._times[-1]:
            raise InputError(
                f"a frame must be later than the one before at {self._times[-1]} s; got {time} s"
            )
        self._times.append(float(time))
        plane = plane or self.plane
        spatial = isinstance(pose, SpatialPose)
        tip = pose.tip_matrix() if isinstance(pose, SpatialPose) else plane.tip_matrix(pose)
        entry = tip.copy()
        entry[:3, 3] = pose.entry if spatial else plane.lift(np.array([pose.entry]))[0]
        self._images.append(plane.image_matrix(self.grid))
        self._tips.append(tip)
        self._entries.append(entry)
        with writing(self.path):
            self._spool.write(np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).tobytes())

    def close(self) -> Path:
        """Join header and pixels and give the file its name.

        Raises
        ------
        InputError
            If there is no frame.
        """
        if self._form is None:
            self.abandon()
            raise InputError(f"{self.path} would have no frame")
        count = len(self._times)
        header = Header(
            shape=(count, *self._form[0]),
            dtype=self._form[1],
            times=np.array(self._times),
            transforms={
                f"{IMAGE}To{REFERENCE}": np.array(self._images),
                f"{NEEDLE}To{REFERENCE}": np.array(self._tips),
                f"{ENTRY}To{REFERENCE}": np.array(self._entries),
            },
            valid=np.ones(count, dtype=bool),
            spacing=self.grid.spacing,
        )
        try:
            with appearing(self.path) as part, part.open("xb") as file:
                file.write(write_header(header, self.path, self._images[0]))
                self._spool.seek(0)
                while block := self._spool.read(1 << 20):
                    file.write(block)
        finally:
            self.abandon()
        return self.path

    def abandon(self) -> None:
        """Remove the temporary file."""
        with suppress(OSError):  # what a full disk did not take is of no use
            self._spool.close()
        Path(self._spool.name).unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()
