"""Presence of signal: where a picture is one shade, black margins of a sector for example, there is no tissue to follow."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from echospline.scene import Floats, RegularGrid
from echospline.tracking.dense_flow import Grey

WINDOW = 0.6
"""mm; a third of the correlation's window: larger ones reach from tissue into the margin."""
LEAST = 6
"""Grey levels of 255 between the darkest and brightest pixel of the window; black that was coded as MP4 or JPEG varies by less."""


def has_signal(grey: Grey, grid: RegularGrid) -> NDArray[np.bool_]:
    """Return the pixels in whose neighbourhood the picture varies, shape (rows, columns)."""
    size = [max(3, round(WINDOW / h) | 1) for h in grid.spacing]
    kernel = np.ones((size[1], size[0]), np.uint8)
    high, low = cv2.dilate(grey, kernel), cv2.erode(grey, kernel)
    return np.asarray(high.astype(np.int16) - low >= LEAST)


def at_points(mask: NDArray[np.bool_], grid: RegularGrid, points: Floats) -> NDArray[np.bool_]:
    """Return a mask at the pixels nearest to points in mm; false outside."""
    index = np.rint(grid.to_index(points))
    columns, rows = grid.shape
    inside = ((index >= 0) & (index < (columns, rows))).all(axis=1)
    found = np.zeros(len(points), dtype=bool)
    x, y = index[inside].astype(int).T
    found[inside] = mask[y, x]
    return found
