"""MP4, MOV, AVI, MKV and WebM through PyAV, decoded one frame at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np

from echospline.errors import InputError
from echospline.io.recording import Recording, check_size, decoding
from echospline.io.tag import tagged_spacing
from echospline.scene import Floats, Pixels

_DEMUXERS = {"MP4": "mov", "QuickTime": "mov", "AVI": "avi", "Matroska": "matroska", "WebM": "matroska"}
"""The one demuxer tried for each format: others of FFmpeg's follow references to other files."""
_LENIENT: dict[str, Any] = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}
"""Before PyAV 19 a comment in another encoding would make the whole file unreadable."""
_SMALLEST_GUARD = 2**22
"""Pixels a decoder may always use: some start with a default size and change to the stream's afterwards."""


def open_video(path: Path, format: str, limit: float) -> Recording:
    """Open a video. Its packets are counted and timed once; none is decoded.

    Parameters
    ----------
    path : Path
        The file.
    format : {"MP4", "QuickTime", "AVI", "Matroska", "WebM"}
        Its container.
    limit : float
        MiB of decoded grey pixels.

    Raises
    ------
    InputError
        If the file is damaged, cut short, too large or holds no video.
    """
    with decoding(path, format), _opened(path, format) as container:
        if not container.streams.video:
            raise InputError(f"{path} is {format} without a video stream: it is no cine, or cut short")
        stream = container.streams.video[0]
        codec = stream.codec_context
        rows, columns, name = int(codec.height), int(codec.width), codec.name
        grey = str(codec.pix_fmt or "").startswith("gray")
        deep = bool(codec.format and any(c.bits > 8 for c in codec.format.components))
        check_size(path, rows, columns, max(1, int(stream.frames)), 1, limit)
        times, packets = _timed(container, stream)
        if packets < int(stream.frames) or packets == 0:
            raise InputError(f"{path} declares {stream.frames} frames but holds {packets}: it is cut short")
        check_size(path, rows, columns, packets, 1, limit)
        spacing = tagged_spacing(container.metadata.get("comment"))

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        count = 0
        with decoding(path, format), _opened(path, format) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            stream.codec_context.options = {"max_pixels": str(max(2 * rows * columns, _SMALLEST_GUARD))}
            for picture in container.decode(video=0):
                if picture.is_corrupt or (picture.height, picture.width) != (rows, columns):
                    raise InputError(f"{path} is damaged at frame {count}: copy it again")
                if frame is None or frame == count:
                    yield picture.to_ndarray(format="rgb24" if colour and not grey else "gray")
                count += 1
                if frame is not None and frame < count:
                    return
            if frame is not None or count < packets:
                raise InputError(
                    f"{path} holds {packets} frames but only {count} can be decoded: it is damaged"
                )

    notes = ["more than 8 bits per pixel, read as 8"] if deep else []
    return Recording(
        path, f"{format}, {name}", rows, columns, packets, 1 if grey else 3, np.dtype(np.uint8), decode,
        spacing=spacing, times=times, notes=tuple(notes),
    )  # fmt: skip


def _opened(path: Path, format: str) -> Any:
    return av.open(str(path), format=_DEMUXERS[format], **_LENIENT)


def _timed(container: Any, stream: Any) -> tuple[Floats | None, int]:
    """Return the times of the frames in s since the first, from their packets, and how many packets are shown."""
    stamps: list[float | None] = [
        None if packet.pts is None else float(packet.pts * packet.time_base)
        for packet in container.demux(stream)
        if packet.size and not packet.is_discard
    ]
    known = sorted(stamp for stamp in stamps if stamp is not None)
    if len(known) == len(stamps) > 0:
        times: Floats = np.array(known) - known[0]
        return times, len(stamps)
    rate = stream.average_rate or stream.guessed_rate
    even: Floats | None = np.arange(len(stamps), dtype=np.float64) / float(rate) if rate else None
    return even, len(stamps)
