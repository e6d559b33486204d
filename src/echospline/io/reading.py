"""Read an ultrasound image or cine from a file of any supported format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.io.declared import aspect_note
from echospline.io.kind import READABLE, kind_of
from echospline.io.recording import LIMIT, MIB, Box, Recording, check_size, to_grey
from echospline.io.samples import IN_SPACE, SAMPLES, sample_image
from echospline.scene import Cine, Floats, Pixels, RegularGrid, UltrasoundImage

SAMPLE = "sample:"


@dataclass(frozen=True)
class CineStream:
    """A cine that is decoded while it is iterated, one frame in memory at a time.

    Parameters
    ----------
    grid : RegularGrid
        Pixel centres in mm, the same for every frame.
    frames : int
        Number of good frames; frames that the file itself calls bad are left out.
    source : str
        File, format and the reader's notes.
    notes : tuple of str
        Conclusions and doubts of the reader, one sentence each.
    times : ndarray, shape (frames,)
        Seconds since the first good frame.
    """

    grid: RegularGrid
    frames: int
    source: str
    notes: tuple[str, ...]
    times: Floats
    _recording: Recording
    _box: Box
    _colour: bool

    def __len__(self) -> int:
        return self.frames

    def images(self) -> Iterator[UltrasoundImage]:
        """Yield the frames as images."""
        return (image for _, image in self)

    def __iter__(self) -> Iterator[tuple[float, UltrasoundImage]]:
        """Yield (time in s since the first frame, image)."""
        pixels = _good(self._recording, self._colour)
        for time, frame in zip(self.times, pixels, strict=True):
            part = _cropped(self._recording.path, frame, self._box, self._colour)
            yield float(time), UltrasoundImage(part, self.grid, self.source, self.notes)


def read(
    path: str | Path,
    *,
    spacing: Sequence[float] | None = None,
    frame: int | None = None,
    region: Sequence[int] | None = None,
    fps: float | None = None,
    colour: bool = False,
    limit: float = LIMIT,
) -> UltrasoundImage | Cine:
    """Read a file into an image, or into a cine when it holds several frames.

    Parameters
    ----------
    path : str or Path
        PNG, JPEG, TIFF, BMP, GIF, DICOM, MHA/MHD, NRRD, NIfTI, MP4, AVI, MOV, MKV or WebM, identified by content;
        a folder of numbered pictures; or ``"sample:calf"``, the image that ships with the package.
    spacing : (lateral, depth), optional
        mm per pixel; needed where the file has none, and preferred to the file's.
    frame : int, optional
        Read this frame alone, counted from 0 (-1 is the last), as an image.
    region : (left, top, right, bottom), optional
        Pixels of the file to keep, right and bottom just outside; by default a DICOM file's own
        2-D tissue region, else everything.
    fps : float, optional
        Frames per second; needed where a file of several frames has none, and preferred to the file's.
    colour : bool
        Keep RGB; by default colour becomes grey (luma of ITU-R BT.601).
    limit : float
        MiB of decoded pixels beyond which a file is refused before it is decoded.

    Returns
    -------
    UltrasoundImage or Cine
        Pixel [0, 0] of the region lies at (0, 0) mm.

    Raises
    ------
    InputError
        If the file is missing, damaged, too large, of no known kind, or lacks spacing or frame times.
    """
    if str(path).startswith(SAMPLE):
        return _sample(str(path).removeprefix(SAMPLE), spacing, region)
    recording = open_recording(path, limit, whole=frame is None)
    box = _checked_box(recording, region)
    grid, notes = _grid(recording, box, spacing)
    if recording.single or frame is not None:
        return _one(recording, _checked_frame(recording, frame or 0), box, grid, notes, colour)
    times = _times(recording, fps, "or --frame to take one")
    return Cine(_gather(recording, box, colour, limit), times, grid, _source(recording, notes), notes)


def read_image(
    path: str | Path,
    *,
    spacing: Sequence[float] | None = None,
    frame: int | None = None,
    region: Sequence[int] | None = None,
    colour: bool = False,
    limit: float = LIMIT,
) -> UltrasoundImage:
    """Read one image; of a cine the first good frame unless ``frame`` gives another; parameters as for `read`.

    Raises
    ------
    InputError
        As for `read`; also if the file is a volume and no slice is named.
    """
    return choose_image(path, spacing=spacing, frame=frame, region=region, colour=colour, limit=limit)[0]


def choose_image(
    path: str | Path,
    *,
    spacing: Sequence[float] | None = None,
    frame: int | None = None,
    region: Sequence[int] | None = None,
    colour: bool = False,
    limit: float = LIMIT,
) -> tuple[UltrasoundImage, int, tuple[float, float] | None]:
    """Read one image as `read_image` does; returns it, the number of its frame, and the window that the file asks for."""
    if str(path).startswith(SAMPLE):
        return _sample(str(path).removeprefix(SAMPLE), spacing, region), 0, None
    recording = open_recording(path, limit, whole=False)
    if frame is None and recording.frames > 1 and recording.volume:
        raise _is_volume(
            recording,
            "give --frame, the number of a slice from 0, or take the whole as a scene in space "
            "where the command has --view (--view longitudinal, --depth-axis y)",
        )
    box = _checked_box(recording, region)
    grid, notes = _grid(recording, box, spacing)
    chosen = 0 if frame is None else _checked_frame(recording, frame)
    if frame is None and recording.frames > 1:
        chosen = int(_kept(recording)[0])
        if chosen:
            notes = (*notes, f"frame {chosen} taken, the first good one")
    image = _one(recording, chosen, box, grid, notes, colour)
    return image, chosen, recording.window


def open_cine(
    path: str | Path,
    *,
    spacing: Sequence[float] | None = None,
    region: Sequence[int] | None = None,
    fps: float | None = None,
    colour: bool = False,
    limit: float = LIMIT,
) -> CineStream:
    """Open a cine of any length and decode it while it is iterated; parameters as for `read`.

    The limit applies to one frame, not to all of them.
    """
    recording = open_recording(path, limit, whole=False)
    box = _checked_box(recording, region)
    grid, notes = _grid(recording, box, spacing)
    times = _times(recording, fps)
    return CineStream(grid, len(times), _source(recording, notes), notes, times, recording, box, colour)


def open_recording(path: str | Path, limit: float = LIMIT, *, whole: bool = True) -> Recording:
    """Read and check a file's header; no pixel is decoded yet.

    Parameters
    ----------
    path : str or Path
        The file.
    limit : float
        MiB of decoded pixels.
    whole : bool
        Whether the limit is for all frames together or for each.

    Raises
    ------
    InputError
        If the file is missing, damaged, too large or of no known kind.
    """
    if not str(path).strip():
        raise InputError("expected a file or folder; got an empty name")
    path = Path(path)
    if not (isfinite(limit) and limit > 0):
        raise InputError(f"limit must be a positive number of MiB; got {limit}")
    if path.is_dir():
        from echospline.io.folder import open_folder  # noqa: PLC0415

        return open_folder(path, limit, whole=whole)
    kind, name = kind_of(path)
    # The readers' libraries are large: each is imported when a file of its kind is opened.
    header_limit = limit if whole else float("inf")
    if kind in ("picture", "gif"):
        from echospline.io.still import open_picture  # noqa: PLC0415

        recording = open_picture(path, name, header_limit)
    elif kind == "dicom":
        from echospline.io.dicom import open_dicom  # noqa: PLC0415

        recording = open_dicom(path, header_limit)
    elif kind in ("metaimage", "nrrd", "nifti"):
        from echospline.io.volume import open_volume  # noqa: PLC0415

        recording = open_volume(path, kind, name, limit, whole=whole)
    elif kind == "video":
        from echospline.io.video import open_video  # noqa: PLC0415

        recording = open_video(path, name, header_limit)
    elif kind == "arrays":
        raise InputError(
            f"{path} ({name}) holds arrays, not pictures; expected {READABLE}: RF lines are read by "
            "`echospline track FILE --rf MHZ` (open_lines)"
        )
    elif kind == "displacement":
        raise InputError(
            f"{path} holds arrays (npz), not pictures; expected {READABLE}: use read_displacement"
        )
    else:
        raise InputError(f"{path} is {name}, which holds no pictures; expected {READABLE}")
    check_size(
        path, recording.rows, recording.columns, 1, recording.channels * recording.dtype.itemsize, limit
    )
    return recording


def _sample(name: str, spacing: Sequence[float] | None, region: Sequence[int] | None) -> UltrasoundImage:
    if name not in SAMPLES:
        if name in IN_SPACE:
            raise InputError(f"{SAMPLE}{name} is a volume; expected a picture: {SAMPLE}{', '.join(SAMPLES)}")
        raise InputError(
            f"there is no sample {name!r}; expected one of: {', '.join(SAMPLES)}, or in space {', '.join(IN_SPACE)}"
        )
    image = sample_image(name)
    if spacing is not None or region is not None:
        raise InputError(f"{SAMPLE}{name} has a spacing and a region of its own: give neither")
    return image


def _checked_box(recording: Recording, region: Sequence[int] | None) -> Box:
    whole = (0, 0, recording.columns, recording.rows)
    if region is None:
        return recording.region or whole
    if len(region) != 4 or any(int(edge) != edge for edge in region):
        raise InputError(
            f"region must be four whole numbers LEFT,TOP,RIGHT,BOTTOM in pixels; got {tuple(region)}"
        )
    left, top, right, bottom = (int(edge) for edge in region)
    if not (0 <= left < right <= recording.columns and 0 <= top < bottom <= recording.rows):
        raise InputError(
            f"region must lie inside the {recording.columns} x {recording.rows} pixels of {recording.path} with "
            f"LEFT < RIGHT and TOP < BOTTOM; got {(left, top, right, bottom)}"
        )
    return left, top, right, bottom


def _grid(
    recording: Recording, box: Box, spacing: Sequence[float] | None
) -> tuple[RegularGrid, tuple[str, ...]]:
    """Return the grid of the box, and the reader's notes with the doubts about the spacing taken."""
    found = tuple(spacing) if spacing is not None else recording.spacing_of(box)
    if found is None:
        doubted = (note for note in recording.notes if "1 x 1 mm" in note or "no distance of pixels" in note)
        why = next((f": {note}" for note in doubted), "")
        raise InputError(
            f"{recording.path} ({recording.format}) does not say how large its pixels are{why}: "
            "give --spacing LAT,DEPTH in mm per pixel (spacing=(lateral, depth) in Python)"
        )
    shape = (box[2] - box[0], box[3] - box[1])
    if len(found) != 2:
        raise InputError(f"spacing must be two positive numbers in mm (lateral, depth); got {found}")
    dx, dy = found
    grid = RegularGrid(shape, (dx, dy))
    doubt = aspect_note(recording.aspect, grid.spacing) if spacing is not None else ""
    return grid, (*recording.notes, *((doubt,) if doubt else ()))


def _source(recording: Recording, notes: tuple[str, ...]) -> str:
    return "; ".join((f"{recording.path.name} ({recording.format})", *notes))


def _one(
    recording: Recording,
    frame: int,
    box: Box,
    grid: RegularGrid,
    notes: tuple[str, ...],
    colour: bool,
) -> UltrasoundImage:
    if recording.valid is not None and not recording.valid[frame]:
        notes = (*notes, f"frame {frame} was asked for, which the file itself does not call good")
    pixels = _cropped(recording.path, next(recording.decode(frame, colour)), box, colour)
    return UltrasoundImage(pixels, grid, _source(recording, notes), notes)


def _kept(recording: Recording) -> NDArray[np.intp]:
    if len(recording.kept) == 0:
        raise InputError(
            f"{recording.path} calls none of its {recording.frames} frames good: record it again, or give --frame to take "
            "one all the same"
        )
    return recording.kept


def _good(recording: Recording, colour: bool) -> Iterator[Pixels]:
    """Decode the good frames."""
    kept = set(_kept(recording).tolist())
    return (pixels for i, pixels in enumerate(recording.decode(None, colour)) if i in kept)


def _checked_frame(recording: Recording, frame: int) -> int:
    if not -recording.frames <= frame < recording.frames:
        raise InputError(
            f"{recording.path} has {recording.frames} frames, counted from 0; got frame {frame}: "
            f"give 0 to {recording.frames - 1}"
        )
    return frame % recording.frames


def _checked_fps(fps: float | None) -> float | None:
    if fps is not None and not (isfinite(fps) and fps > 0):
        raise InputError(f"fps must be a positive number of frames per second; got {fps}")
    return fps


def _is_volume(recording: Recording, remedy: str) -> InputError:
    why = next((note for note in recording.notes if note.startswith("a volume of")), "a volume")
    return InputError(f"{recording.path} holds {why}: {remedy}")


def _times(recording: Recording, fps: float | None, otherwise: str = "") -> Floats:
    """Return the seconds of the good frames since the first of them; ``otherwise`` names a second remedy."""
    fps = _checked_fps(fps)
    kept = _kept(recording)
    if fps is not None:
        return np.asarray((kept - kept[0]) / fps, dtype=np.float64)
    if recording.frames == 1:
        return np.zeros(1)
    also = f", {otherwise}" if otherwise else ""
    if recording.volume:
        raise _is_volume(recording, f"give --fps in frames per second if its third axis is time{also}")
    if recording.times is None:
        why = f"no usable frame times ({recording.untimed})" if recording.untimed else "not their times"
        raise InputError(
            f"{recording.path} holds {recording.frames} frames but {why}: give --fps in frames per second{also}"
        )
    since: Floats = recording.times[kept] - recording.times[kept[0]]
    return since


def _cropped(path: Path, pixels: Pixels, box: Box, colour: bool) -> Pixels:
    left, top, right, bottom = box
    part = pixels[top:bottom, left:right]
    if part.dtype.kind == "f" and not np.isfinite(part).all():
        raise InputError(f"{path} holds values that are not finite (NaN or infinity): replace them first")
    return np.ascontiguousarray(part if colour else to_grey(part))


def _gather(recording: Recording, box: Box, colour: bool, limit: float) -> Pixels:
    """Decode all good frames into one array; a file that differs from its header is refused."""
    frames: Pixels | None = None
    wanted = len(_kept(recording))
    count = 0
    for pixels in _good(recording, colour):
        part = _cropped(recording.path, pixels, box, colour)
        if (count + 1) * part.nbytes > limit * MIB:
            raise InputError(
                f"{recording.path} holds more than {limit:,.0f} MiB of pixels: take one frame, open it with "
                "open_cine, or raise the limit"
            )
        if frames is None:
            frames = np.empty((wanted, *part.shape), part.dtype)
        if count == len(frames) or part.shape != frames.shape[1:]:
            raise InputError(f"{recording.path} holds other frames than it declares: it is damaged")
        frames[count] = part
        count += 1
    if frames is None or count < len(frames):
        raise InputError(f"{recording.path} declares {wanted} frames but holds {count}: it is cut short")
    return frames
