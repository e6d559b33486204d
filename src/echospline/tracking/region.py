"""Points at which displacement is measured: a grid over the picture, a fixed region, or one ahead of the tip."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene import Floats, NeedlePose, RegularGrid


def grid_over(
    extent: tuple[float, float, float, float], spacing: float, box: Sequence[float] | None = None
) -> RegularGrid:
    """Return the grid of ``spacing`` mm inside an extent (x0, x1, y0, y1), or inside ``box`` (x0, y0, x1, y1) of it.

    Raises
    ------
    InputError
        If the box does not lie in the extent or holds no 2 x 2 points.
    """
    x0, x1, y0, y1 = extent
    if box is not None:
        if len(box) != 4 or not (x0 <= box[0] < box[2] <= x1 and y0 <= box[1] < box[3] <= y1):
            raise InputError(
                f"the region is X0,Y0,X1,Y1 in mm inside of {x0:g},{y0:g},{x1:g},{y1:g}; got {list(box)}"
            )
        x0, y0, x1, y1 = box
    if not (isfinite(spacing) and spacing > 0):
        raise InputError(f"the spacing of the points must be a positive length in mm; got {spacing}")
    nx, ny = (int((b - a) / spacing + 1e-9) + 1 for a, b in ((x0, x1), (y0, y1)))
    if min(nx, ny) < 2 or nx * ny > 4_000_000:
        raise InputError(f"points {spacing:g} mm apart make {nx} x {ny} of them; choose 2 x 2 to 4 million")
    # centred, so that the margins are equal
    origin = x0 + ((x1 - x0) - (nx - 1) * spacing) / 2, y0 + ((y1 - y0) - (ny - 1) * spacing) / 2
    return RegularGrid((nx, ny), (spacing, spacing), origin)


def region_ahead(
    pose: NeedlePose,
    distance: float = 4.0,
    size: tuple[float, float] = (2.0, 3.0),
    shape: tuple[int, int] = (10, 20),
) -> Floats:
    """Return the points of the paper's region of interest: 200 in 2 x 3 mm, ``distance`` mm ahead of the tip to its centre.

    Raises
    ------
    InputError
        If the needle has no direction yet.
    """
    if pose.depth <= 0:
        raise InputError("a region ahead of the tip needs a needle that is in the tissue")
    centre = np.asarray(pose.tip) + distance * np.asarray(pose.axis)
    (w, h), (nx, ny) = size, shape
    grid = RegularGrid(shape, (w / (nx - 1), h / (ny - 1)), (centre[0] - w / 2, centre[1] - h / 2))
    return grid.nodes


def inside_ahead(
    points: Floats, pose: NeedlePose, distance: float = 4.0, size: tuple[float, float] = (2.0, 3.0)
) -> NDArray[np.bool_]:
    """Test which points lie in the region ahead of the tip, shape (n,); none for a needle without direction."""
    if pose.depth <= 0:
        return np.zeros(len(points), dtype=np.bool_)
    centre = np.asarray(pose.tip) + distance * np.asarray(pose.axis)
    near = np.abs(points - centre) <= np.asarray(size) / 2.0 + 1e-9
    return np.asarray(near.all(axis=1))
