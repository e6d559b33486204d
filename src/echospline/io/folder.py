"""A cine as a folder of numbered pictures, a common form of recordings; ``times.csv`` in it is read too."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from echospline.errors import InputError
from echospline.io.declared import Clock, Declared, followed
from echospline.io.kind import PICTURES, kind_of
from echospline.io.recording import Recording, check_size, decoding
from echospline.io.still import open_picture
from echospline.scene import Pixels

_TABLE = "times.csv"
_MOST_TABLE = 2**24
"""Bytes of ``times.csv``; half a million frames fit."""


def open_folder(path: Path, limit: float, *, whole: bool) -> Recording:
    """Open a folder of pictures of one size, in the order of the numbers in their names.

    Parameters
    ----------
    path : Path
        The folder; other files are ignored.
    limit : float
        MiB of decoded pixels, of all frames or of one.
    whole : bool
        Whether all frames are needed.

    Raises
    ------
    InputError
        If there is no picture, one differs in size or type, or ``times.csv`` does not fit.
    """
    files = sorted(
        (f for f in path.iterdir() if f.suffix.lower() in PICTURES and f.is_file()), key=_by_number
    )
    if not files:
        raise InputError(
            f"{path} is a folder without pictures: name a file, or a folder of numbered pictures"
        )
    first = _opened(files[0], limit)
    size = first.channels * first.dtype.itemsize
    check_size(path, first.rows, first.columns, len(files) if whole else 1, size, limit)

    def decode(frame: int | None, colour: bool) -> Iterator[Pixels]:
        for file in files if frame is None else files[frame : frame + 1]:
            picture = _opened(file, limit)
            for name in ("rows", "columns", "channels", "dtype"):
                if getattr(picture, name) != getattr(first, name):
                    raise InputError(
                        f"{file} has {name} {getattr(picture, name)}, but {files[0].name} has {getattr(first, name)}: "
                        "keep the pictures of one cine in a folder of their own"
                    )
            yield from picture.decode(0, colour)

    stored = replace(
        first, path=path, format=f"folder of {first.format}", frames=len(files), decode=decode, single=False
    )
    # the pictures are turned and scaled already: their times alone are left to follow
    said = Declared(clocks=_clocks(path, len(files)))
    return replace(followed(stored, said), spacing=first.spacing, aspect=first.aspect)


def _opened(file: Path, limit: float) -> Recording:
    kind, name = kind_of(file)
    if kind != "picture":
        raise InputError(f"{file} is {name}, not the picture that its name says: take it out of the folder")
    recording = open_picture(file, name, limit)
    if not recording.single:
        raise InputError(f"{file} holds {recording.frames} frames; expected one: read it by itself")
    return recording


def _by_number(file: Path) -> tuple[list[tuple[int, str]], str]:
    """Sort frame_9 before frame_10."""
    parts = re.split(r"(\d+)", file.name)
    return [(int(p), "") if p.isdecimal() and p.isascii() else (-1, p) for p in parts], file.name


def _clocks(path: Path, frames: int) -> tuple[Clock, ...]:
    """Return the last column of ``times.csv``, s; nothing when there is no such file."""
    table = path / _TABLE
    if not table.is_file():
        return ()
    if table.stat().st_size > _MOST_TABLE:
        raise InputError(f"{table} has more than {_MOST_TABLE} bytes: it is no table of times")
    with decoding(table, "times.csv"):
        rows = np.loadtxt(table, delimiter=",", skiprows=1, ndmin=2)
    times = rows[:, -1] if len(rows) else np.empty(0)
    if len(times) != frames or not np.isfinite(times).all() or (np.diff(times) < 0).any():
        raise InputError(f"{table} must hold one ascending time in s for each of the {frames} pictures")
    return (Clock(_TABLE, times),)
