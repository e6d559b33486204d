"""Spacing as a line of text, for formats without a field for it: written and read by echospline alone."""

from __future__ import annotations

import re
from math import isfinite

from echospline.scene import RegularGrid

_LINE = re.compile(r"echospline: pixels of ([0-9.e+-]{1,32}) mm lateral, ([0-9.e+-]{1,32}) mm depth")


def spacing_tag(grid: RegularGrid) -> str:
    """Return the line for a grid's spacing."""
    dx, dy = grid.spacing
    return f"echospline: pixels of {dx!r} mm lateral, {dy!r} mm depth"


def tagged_spacing(text: object) -> tuple[float, float] | None:
    """Return (lateral, depth) in mm from such a line; None from any other text."""
    found = _LINE.fullmatch(text) if isinstance(text, str) else None
    try:
        dx, dy = map(float, found.groups()) if found else (0.0, 0.0)
    except ValueError:
        return None
    return (dx, dy) if isfinite(dx) and isfinite(dy) and min(dx, dy) > 0 else None
