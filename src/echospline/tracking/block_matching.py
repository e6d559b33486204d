"""Displacement from B-mode by matching blocks: normalised cross-correlation, interpolated between lines.

The classical method of elastography, in the manner of the paper's reference [23]: pictures are interpolated
before the search, so that the peak is sampled densely, and a parabola refines it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene import Floats
from echospline.tracking.signal import at_points, has_signal
from echospline.tracking.tracker import Frame, Motion, grey_pair, levelled


@dataclass(frozen=True)
class BlockMatching:
    """Exhaustive search of the block around every point.

    Parameters
    ----------
    window : (float, float)
        Block size (lateral, axial), mm.
    search : float
        Largest motion searched, each way, mm.
    interpolation : int
        Samples per pixel in the interpolated picture; 1 suffers from peak locking.
    """

    window: tuple[float, float] = (3.0, 3.0)
    search: float = 0.6
    interpolation: int = 4

    def __post_init__(self) -> None:
        if min(*self.window, self.search) <= 0 or self.interpolation < 1:
            raise InputError(
                f"block matching needs a positive window and search in mm and interpolation of 1 or more; got {self}"
            )

    def motion(self, before: Frame, after: Frame, points: Floats) -> Motion:
        """Measure the motion of the tissue at ``points`` (n, 2) mm; confidence is the height of the correlation's peak.

        Points without signal, points whose block or search area leaves the picture, and peaks at the border of the search, have
        confidence 0.
        """
        a, b, grid = grey_pair(*levelled(before, after))
        f = self.interpolation
        fine = np.asarray(grid.spacing) / f
        first, second = (
            cv2.resize(g, None, fx=f, fy=f, interpolation=cv2.INTER_CUBIC).astype(np.float32) for g in (a, b)
        )
        # pixel centres of the enlarged picture lie (f - 1) / 2 before those of the coarse one
        centre = np.rint(grid.to_index(points) * f + (f - 1) / 2.0).astype(int)
        half = np.maximum(np.rint(np.asarray(self.window) / 2.0 / fine).astype(int), 2)
        reach = np.maximum(np.ceil(self.search / fine).astype(int), 1)
        low, high = centre - half - reach, centre + half + reach + 1
        inside = (low >= 0).all(axis=1) & (high <= first.shape[::-1]).all(axis=1)
        u, confidence = np.zeros((len(points), 2)), np.zeros(len(points))
        for i in np.flatnonzero(inside):
            (x, y), (x0, y0), (x1, y1) = centre[i], low[i], high[i]
            block = first[y - half[1] : y + half[1] + 1, x - half[0] : x + half[0] + 1]
            if block.std() == 0.0:
                continue
            score = cv2.matchTemplate(second[y0:y1, x0:x1], block, cv2.TM_CCOEFF_NORMED)
            _, best, _, (jx, jy) = cv2.minMaxLoc(score)
            if not (0 < jx < score.shape[1] - 1 and 0 < jy < score.shape[0] - 1):
                continue
            shift = jx + _vertex(score[jy, jx - 1 : jx + 2]), jy + _vertex(score[jy - 1 : jy + 2, jx])
            u[i] = (shift - reach) * fine
            confidence[i] = max(best, 0.0)
        alive = at_points(has_signal(a, grid), grid, points) & at_points(
            has_signal(b, grid), grid, points + u
        )
        return Motion(u, np.where(alive, confidence, 0.0))


def _vertex(three: NDArray[np.generic]) -> float:
    """Return the offset of a parabola's top from the middle of three equidistant samples."""
    left, middle, right = (float(v) for v in three)
    curvature = left - 2.0 * middle + right
    return 0.5 * (left - right) / curvature if curvature < 0 else 0.0
