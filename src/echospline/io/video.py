"""MP4, MOV, AVI, MKV and WebM through PyAV, decoded one frame at a time."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np

from echospline.errors import InputError
from echospline.io.declared import Clock, Declared, Lengths, Turn, followed
from echospline.io.recording import Recording, check_size, decoding
from echospline.io.tag import tagged_spacing
from echospline.scene import Pixels

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
        stamps = [
            None if packet.pts is None else float(packet.pts * packet.time_base)
            for packet in container.demux(stream)
            if packet.size and not packet.is_discard
        ]
        packets = len(stamps)
        if packets < int(stream.frames) or packets == 0:
            raise InputError(f"{path} declares {stream.frames} frames but holds {packets}: it is cut short")
        check_size(path, rows, columns, packets, 1, limit)
        own = tagged_spacing(container.metadata.get("comment"))
        times, notes = _clock(stamps, stream)
        said = Declared(
            aspect=float(stream.sample_aspect_ratio) if stream.sample_aspect_ratio else None,
            lengths=(Lengths(own, "echospline's comment", shown=True),) if own else (),
            clocks=times,
        )
        said = _turned(said, path, format, notes)
        if (streams := len(container.streams.video)) > 1:
            notes.append(f"{streams} video streams: the first taken")

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

    if deep:
        notes.append("more than 8 bits per pixel, read as 8")
    stored = Recording(
        path, f"{format}, {name}", rows, columns, packets, 1 if grey else 3, np.dtype(np.uint8), decode,
        notes=tuple(notes),
    )  # fmt: skip
    return followed(stored, said)


def _opened(path: Path, format: str) -> Any:
    return av.open(str(path), format=_DEMUXERS[format], **_LENIENT)


def _clock(stamps: list[float | None], stream: Any) -> tuple[tuple[Clock, ...], list[str]]:
    """Return the packets' time stamps in order of display, else the stream's rate."""
    rate = stream.average_rate or stream.guessed_rate
    even = Clock("the stream's rate", np.arange(len(stamps)) / float(rate)) if rate else None
    if None not in stamps:
        shown = Clock("its time stamps", np.sort(np.array(stamps, dtype=np.float64)))
        # the rate is derived from the stamps or nominal: a second source only where they fail
        return (shown,) if even is None or _runs(shown) else (shown, even), []
    missing = f"lack that of packet {stamps.index(None)}"
    return (Clock("its time stamps", None, missing), *((even,) if even else ())), []


def _runs(clock: Clock) -> bool:
    return clock.seconds is not None and len(clock.seconds) > 0 and bool(np.ptp(clock.seconds) > 0)


def _turned(said: Declared, path: Path, format: str, notes: list[str]) -> Declared:
    """Follow the display matrix, which FFmpeg hands over with the first decoded frame; note fields of interlaced video."""
    try:
        with _opened(path, format) as container:
            picture = next(container.decode(video=0), None)
            matrix = None if picture is None else _display_matrix(picture)
            if picture is not None and picture.interlaced_frame:
                notes.append("interlaced: rows of two moments are in one frame")
    except (av.FFmpegError, OSError):  # a damaged first frame is reported when it is decoded for use
        return said
    if matrix is None:
        return said
    turn = Turn.of_matrix(*matrix)
    if turn is None:
        notes.append("its display matrix turns by no multiple of 90 degrees: not followed")
        return said
    return replace(said, turn=turn, turned_by="its display matrix")


def _display_matrix(picture: Any) -> tuple[float, float, float, float] | None:
    """Return (a, b, c, d) of the nine 16.16 numbers a b u, c d v, x y w."""
    for data in picture.side_data.keys():  # noqa: SIM118 - its iteration gives no entries
        if getattr(data.type, "name", "") == "DISPLAYMATRIX":
            a, b, _, c, d = struct.unpack_from("=5i", bytes(data))
            return a / 65536, b / 65536, c / 65536, d / 65536
    return None
