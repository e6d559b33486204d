"""A cine as a folder of numbered PNG files with ``times.csv``."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from echospline.errors import InputError
from echospline.io.tag import spacing_tag
from echospline.scene import Pixels, RegularGrid

_OURS = re.compile(r"frame_\d{5,}\.png|times\.csv|\.unfinished\.png")


class FramesEncoder:
    """Writes ``frame_00000.png`` and so on into a temporary folder; each file appears whole.

    Parameters
    ----------
    part : Path
        Temporary folder, which is not there yet.
    grid : RegularGrid
        Pixel centres, mm; the spacing goes into each file's comment.
    final : Path
        The folder that it will replace.

    Raises
    ------
    InputError
        If the folder to be replaced holds anything but frames.
    """

    def __init__(self, part: Path, grid: RegularGrid, final: Path) -> None:
        check_ours(final)
        part.mkdir()
        self._part = part
        self._note = PngInfo()
        self._note.add_text("Comment", spacing_tag(grid))
        self._count = 0
        self._times = (part / "times.csv").open("w", encoding="ascii", newline="\n")
        self._times.write("frame,time_s\n")

    def add(self, pixels: Pixels, time: float) -> None:
        """Write one PNG, then its line in ``times.csv``."""
        unfinished = self._part / ".unfinished.png"
        Image.fromarray(np.ascontiguousarray(pixels)).save(
            unfinished, format="PNG", compress_level=1, pnginfo=self._note
        )
        os.replace(unfinished, self._part / f"frame_{self._count:05d}.png")
        self._times.write(f"{self._count},{time!r}\n")
        self._times.flush()
        self._count += 1

    def finish(self) -> Path:
        """Close ``times.csv``."""
        self._times.close()
        return self._part

    def abandon(self) -> None:
        """Close ``times.csv``; the frames stay."""
        self._times.close()


def check_ours(folder: Path) -> None:
    """Refuse to replace a folder that holds anything but frames.

    Raises
    ------
    InputError
        If it is a file or holds other files.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file; expected a folder for frames or a name that is free")
    stranger = (
        next((f.name for f in folder.iterdir() if not _OURS.fullmatch(f.name)), None)
        if folder.is_dir()
        else None
    )
    if stranger is not None:
        raise InputError(
            f"{folder} holds {stranger!r}, which is no frame: give the name of a new folder for the frames"
        )
