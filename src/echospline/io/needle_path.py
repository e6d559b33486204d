"""A needle's path on disk: CSV rows of time, entry and tip, or the needle in a ``displacement.npz``."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from echospline.errors import InputError
from echospline.io.displacement import read_displacement
from echospline.io.kind import head
from echospline.scene import Insertion

COLUMNS = ("time_s", "entry_x_mm", "entry_y_mm", "tip_x_mm", "tip_y_mm")
LARGEST = 50_000_000
"""Bytes of a CSV file."""


def read_needle(path: str | Path) -> Insertion:
    """Read a needle's path.

    Parameters
    ----------
    path : str or Path
        CSV with the header ``time_s,entry_x_mm,entry_y_mm,tip_x_mm,tip_y_mm`` and ascending times, in the cine's own
        coordinates, separated by commas, semicolons (then a decimal comma is read too) or tabs; or a ``displacement.npz``.

    Raises
    ------
    InputError
        If the file is neither, or its numbers are not a path.
    """
    path = Path(path)
    if head(path).startswith(b"PK"):
        record = read_displacement(path)
        return Insertion(record.times, record.entry, record.tip)
    if path.stat().st_size > LARGEST:
        raise InputError(
            f"{path} has {path.stat().st_size} bytes; a needle's path is a CSV file of few lines"
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
        mark = _separator(text)
        rows = list(csv.reader(text.splitlines(), delimiter=mark))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"cannot read the needle's path {path}: {error}") from error
    rows = [r for r in rows if r and not r[0].lstrip().startswith("#")]
    if not rows or tuple(c.strip() for c in rows[0]) != COLUMNS:
        raise InputError(
            f"{path}: the first line must be {','.join(COLUMNS)}; got {','.join(rows[0]) if rows else ''}"
        )
    try:
        values = np.array([[_number(v, mark) for v in row] for row in rows[1:]], dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: every line holds five numbers: {error}") from error
    if values.ndim != 2 or values.shape[1] != len(COLUMNS):
        raise InputError(f"{path}: every line holds five numbers, and there are two lines or more")
    return Insertion(values[:, 0], values[:, 1:3], values[:, 3:5])


def _separator(text: str) -> str:
    """Return the mark between the names of the first line that is no comment."""
    lines = (line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    header = next(lines, "")
    return next((mark for mark in ";\t" if mark in header), ",")


def _number(text: str, mark: str) -> float:
    """Read a number; where semicolons part the columns, spreadsheets write 0,5 for 0.5."""
    return float(text.strip().replace(",", ".") if mark == ";" else text)
