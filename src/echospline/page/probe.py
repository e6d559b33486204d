"""Whether the tip of a needle in space was in the picture of the probe, step by step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echospline.page.pack import ProbePart
from echospline.scene import Floats, probe_plane

SIGMAS, LEAST = 2.0, 0.5
"""A tip is in the slice up to so many sigma of its thickness off the plane, and up to so many mm where it is thinner."""


def in_picture(probe: ProbePart, planes: Floats, tip: Floats) -> NDArray[np.bool_]:
    """Return at which steps the tip was in the picture, shape (n,).

    Parameters
    ----------
    probe : ProbePart
        Of the pack.
    planes : (k, 7) ndarray
        Where it was held: rows of step, x, y, z (mm), yaw, pitch, roll (degrees), each from its step on; the first is 0.
    tip : (n, 3) ndarray
        mm.
    """
    seen = np.zeros(len(tip), dtype=np.bool_)
    ends = [*planes[1:, 0].astype(int).tolist(), len(tip)]
    for row, end in zip(planes, ends, strict=True):
        begin = int(row[0])
        matrix = probe_plane(row[1:4], *row[4:7].tolist()).matrix
        local = (tip[begin:end] - matrix[:3, 3]) @ matrix[:3, :3]
        seen[begin:end] = _shown(probe, local)
    return seen


def _shown(probe: ProbePart, local: Floats) -> NDArray[np.bool_]:
    """Test places (n, 3) in the frame of the plane: lateral, depth, off the plane, mm."""
    x, y, off = local.T
    (dx, dy), (x0, y0) = probe.spacing, probe.origin
    inside: NDArray[np.bool_]
    if probe.shape == "linear":
        inside = (x >= x0 - dx / 2) & (x <= x0 + (probe.columns - 0.5) * dx)
        inside &= (y >= y0 - dy / 2) & (y <= y0 + (probe.rows - 0.5) * dy)
    else:
        half = 1e-9 + dx / 2
        r, angle = np.hypot(x, y + probe.radius), np.arctan2(np.abs(x), y + probe.radius)
        inside = (r >= probe.radius - half) & (r <= probe.radius + probe.depth + half)
        inside &= angle <= np.radians(probe.opening / 2) + 1e-9
    depth = np.maximum(y, 0.0)
    spread = (depth - probe.elevation_depth) * probe.element_height / (2.5 * probe.elevation_depth)
    sigma = np.hypot(spread, probe.elevation) if probe.elevation > 0 else np.zeros_like(y)
    inside &= np.abs(off) <= np.maximum(SIGMAS * sigma, LEAST)
    return inside
