"""MP4 with H.264 in yuv420p, which every browser plays."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace

from echospline.atomic import second_part
from echospline.errors import InputError
from echospline.io.tag import spacing_tag
from echospline.scene import Pixels, RegularGrid

CLOCK = 90_000
"""Ticks per second: the usual clock of video, finer than any frame rate."""

_LIMITED = np.rint(16 + np.arange(256) * (219 / 255)).astype(np.uint8)
"""Grey 0..255 as luma 16..235, the range that players assume."""


class Mp4Encoder:
    """H.264 frames into a fragmented MP4, so that the file can be played at any moment.

    Finishing copies the packets into a plain MP4 with its index in front (no second encoding), so that a browser
    reads the duration and starts at once.

    Parameters
    ----------
    part : Path
        Temporary name.
    grid : RegularGrid
        Pixel centres, mm.
    colour : bool
        Whether frames are RGB.
    fps : float
        Nominal frames per second.
    """

    def __init__(self, part: Path, grid: RegularGrid, colour: bool, fps: float) -> None:
        self._part = part
        self._colour = colour
        columns, rows = grid.shape
        # 4:2:0 halves both directions: an odd row or column is shown twice at the far edge.
        self._pad = ((0, rows % 2), (0, columns % 2))
        self._container = av.open(
            str(part), "w", format="mp4",
            options={"movflags": "frag_keyframe+empty_moov+default_base_moof", "flush_packets": "1"},
        )  # fmt: skip
        self._container.metadata["comment"] = self._tag = spacing_tag(grid)
        rate = Fraction(fps).limit_denominator(1001)
        stream: Any = self._container.add_stream(
            "libx264", rate=rate, options={"crf": "12", "preset": "veryfast"}
        )
        stream.width, stream.height = columns + columns % 2, rows + rows % 2
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, CLOCK)
        stream.codec_context.gop_size = max(1, round(min(fps, 60)))
        # Without B-frames the first frame is shown at 0 s in every player, and a partial file lacks only a little.
        stream.codec_context.max_b_frames = 0
        stream.codec_context.color_range = ColorRange.MPEG
        stream.codec_context.colorspace = Colorspace.ITU709
        stream.codec_context.color_primaries = stream.codec_context.color_trc = 1  # BT.709
        self._stream = stream
        self._start: float | None = None
        self._ticks = -1

    def add(self, pixels: Pixels, time: float) -> None:
        """Encode one frame."""
        if self._start is None:
            self._start = time
        ticks = round((time - self._start) * CLOCK)
        if ticks <= self._ticks:
            raise InputError(f"MP4 keeps times to 1/{CLOCK} s; two frames are closer than that at {time} s")
        frame = self._frame(pixels)
        frame.pts, frame.time_base = ticks, Fraction(1, CLOCK)
        self._container.mux(self._stream.encode(frame))
        self._ticks = ticks

    def finish(self) -> Path:
        """Flush the encoder and lay the packets out as a plain MP4."""
        self._container.mux(self._stream.encode(None))
        self._container.close()
        with (
            second_part(self._part) as whole,
            av.open(str(self._part), format="mp4") as source,
            av.open(str(whole), "w", format="mp4", options={"movflags": "faststart"}) as target,
        ):
            target.metadata["comment"] = self._tag
            stream = target.add_stream_from_template(source.streams.video[0])
            for packet in source.demux(video=0):
                if packet.dts is not None:
                    packet.stream = stream
                    target.mux(packet)
        return whole

    def abandon(self) -> None:
        """Flush what was added; the fragments stay playable."""
        self._container.mux(self._stream.encode(None))
        self._container.close()

    def _frame(self, pixels: Pixels) -> av.VideoFrame:
        if self._colour:
            padded = np.pad(pixels, (*self._pad, (0, 0)), mode="edge")
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(padded, dtype=np.uint8), format="rgb24")
            return frame.reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
            )
        luma = _LIMITED[np.pad(pixels, self._pad, mode="edge")]
        chroma = np.full((luma.shape[0] // 2, luma.shape[1]), 128, dtype=np.uint8)
        return av.VideoFrame.from_ndarray(np.concatenate([luma, chroma]), format="yuv420p")
