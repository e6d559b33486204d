"""Read an ultrasound image or cine from a file of any supported format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from echospline.errors import InputError
from echospline.io.kind import READABLE, kind_of
from echospline.io.recording import LIMIT, MIB, Box, Recording, check_size, to_grey
from echospline.io.samples import SAMPLES, sample_image
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
        Number of frames.
    source : str
        File, format and the reader's notes.
    """

    grid: RegularGrid
    frames: int
    source: str
    _recording: Recording
    _box: Box
    _times: Floats | None
    _fps: float | None
    _colour: bool

    def __iter__(self) -> Iterator[tuple[float, UltrasoundImage]]:
        """Yield (time in s since the first frame, image)."""
        for i, pixels in enumerate(self._recording.decode(None, self._colour)):
            time = (
                i / self._fps if self._fps else float(self._times[i]) if self._times is not None else float(i)
            )
            yield (
                time,
                UltrasoundImage(
                    _cropped(self._recording.path, pixels, self._box, self._colour), self.grid, self.source
                ),
            )


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
    grid = _grid(recording, box, spacing)
    source = _source(recording)
    if recording.single or frame is not None:
        index = _checked_frame(recording, frame or 0)
        pixels = next(recording.decode(index, colour))
        return UltrasoundImage(_cropped(recording.path, pixels, box, colour), grid, source)
    frames = _gather(recording, box, colour, limit)
    return Cine(frames, _times(recording, fps, len(frames)), grid, source)


def read_image(
    path: str | Path,
    *,
    spacing: Sequence[float] | None = None,
    frame: int = 0,
    region: Sequence[int] | None = None,
    colour: bool = False,
    limit: float = LIMIT,
) -> UltrasoundImage:
    """Read one image, of a cine the first unless ``frame`` gives another; parameters as for `read`."""
    found = read(path, spacing=spacing, frame=frame, region=region, colour=colour, limit=limit)
    if isinstance(found, Cine):
        raise InputError(f"{path} holds a cine; expected an image: give a frame number")
    return found


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
    if fps is None and recording.times is None and recording.frames != 1:
        raise _no_times(recording)
    return CineStream(
        _grid(recording, box, spacing), recording.frames, _source(recording),
        recording, box, recording.times, _checked_fps(fps), colour,
    )  # fmt: skip


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
        raise InputError(f"there is no sample {name!r}; expected one of: {', '.join(SAMPLES)}")
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


def _grid(recording: Recording, box: Box, spacing: Sequence[float] | None) -> RegularGrid:
    found = tuple(spacing) if spacing is not None else recording.spacing_of(box)
    if found is None:
        raise InputError(
            f"{recording.path} ({recording.format}) does not say how large its pixels are: "
            "give --spacing LAT,DEPTH in mm per pixel (spacing=(lateral, depth) in Python)"
        )
    shape = (box[2] - box[0], box[3] - box[1])
    if len(found) != 2:
        raise InputError(f"spacing must be two positive numbers in mm (lateral, depth); got {found}")
    dx, dy = found
    return RegularGrid(shape, (dx, dy))


def _source(recording: Recording) -> str:
    return "; ".join((f"{recording.path.name} ({recording.format})", *recording.notes))


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


def _no_times(recording: Recording) -> InputError:
    return InputError(
        f"{recording.path} holds {recording.frames} frames but not their times: give --fps in frames per second, "
        "or --frame to take one"
    )


def _times(recording: Recording, fps: float | None, count: int) -> Floats:
    fps = _checked_fps(fps)
    if fps is not None:
        return np.arange(count) / fps
    if recording.times is None:
        raise _no_times(recording)
    return recording.times[:count]


def _cropped(path: Path, pixels: Pixels, box: Box, colour: bool) -> Pixels:
    left, top, right, bottom = box
    part = pixels[top:bottom, left:right]
    if part.dtype.kind == "f" and not np.isfinite(part).all():
        raise InputError(f"{path} holds values that are not finite (NaN or infinity): replace them first")
    return np.ascontiguousarray(part if colour else to_grey(part))


def _gather(recording: Recording, box: Box, colour: bool, limit: float) -> Pixels:
    """Decode all frames into one array; a file that differs from its header is refused."""
    frames: Pixels | None = None
    count = 0
    for pixels in recording.decode(None, colour):
        part = _cropped(recording.path, pixels, box, colour)
        if (count + 1) * part.nbytes > limit * MIB:
            raise InputError(
                f"{recording.path} holds more than {limit:,.0f} MiB of pixels: take one frame, open it with "
                "open_cine, or raise the limit"
            )
        if frames is None:
            frames = np.empty((recording.frames, *part.shape), part.dtype)
        if count == len(frames) or part.shape != frames.shape[1:]:
            raise InputError(f"{recording.path} holds other frames than it declares: it is damaged")
        frames[count] = part
        count += 1
    if frames is None or count < len(frames):
        raise InputError(
            f"{recording.path} declares {recording.frames} frames but holds {count}: it is cut short"
        )
    return frames
