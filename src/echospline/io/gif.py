"""Animated GIF, frame by frame: with exact grey levels and delays that follow the frames' times."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image

from echospline.scene import Pixels, RegularGrid

TICK = 100
"""GIF counts delays in hundredths of a second."""
SHORTEST = 2
"""Hundredths of a second; browsers show shorter delays as ten, so frames at shorter intervals are left out."""


class GifEncoder:
    """GIF through FFmpeg's encoder, which streams (Pillow's collects all frames first).

    Grey frames use the palette of all 256 greys and are exact when read again; RGB frames get the 256 colours that fit
    each best. Frames less than 0.02 s after the one before are left out, so that the speed is right above 50 per second.

    Parameters
    ----------
    part : Path
        Temporary name.
    grid : RegularGrid
        Pixel centres, mm.
    colour : bool
        Whether frames are RGB.
    fps : float
        Nominal frames per second, which sets the duration of the last frame.
    """

    def __init__(self, part: Path, grid: RegularGrid, colour: bool, fps: float) -> None:
        self._part = part
        self._colour = colour
        last = max(SHORTEST, round(TICK / fps))
        self._container = av.open(
            str(part),
            "w",
            format="gif",
            options={"loop": "0", "final_delay": str(last), "flush_packets": "1"},
        )
        stream: Any = self._container.add_stream("gif", rate=TICK)
        stream.width, stream.height = grid.shape
        stream.pix_fmt = "pal8" if colour else "gray"
        stream.codec_context.time_base = Fraction(1, TICK)
        self._stream = stream
        self._start: float | None = None
        self._ticks = -SHORTEST

    def add(self, pixels: Pixels, time: float) -> None:
        """Encode one frame, unless it is too close in time to the one before."""
        if self._start is None:
            self._start = time
        ticks = round((time - self._start) * TICK)
        if ticks - self._ticks < SHORTEST:
            return
        frame = (
            _indexed(pixels)
            if self._colour
            else av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels, dtype=np.uint8), format="gray")
        )
        frame.pts, frame.time_base = ticks, Fraction(1, TICK)
        self._container.mux(self._stream.encode(frame))
        self._ticks = ticks

    def finish(self) -> Path:
        """Write the last frame and the trailer."""
        self.abandon()
        return self._part

    def abandon(self) -> None:
        """Write what was added and close."""
        self._container.mux(self._stream.encode(None))
        self._container.close()


def _indexed(pixels: Pixels) -> av.VideoFrame:
    """Convert RGB to indices into the 256 colours that fit this frame best."""
    image = Image.fromarray(pixels).quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    colours = np.array(image.getpalette("RGB"), dtype=np.uint8).reshape(-1, 3)
    palette = np.zeros((256, 4), dtype=np.uint8)
    palette[:, 0] = 255  # opaque; PyAV's order is alpha, red, green, blue
    palette[: len(colours), 1:] = colours
    indexed: Any = (np.asarray(image), palette)
    return av.VideoFrame.from_ndarray(indexed, format="pal8")
