"""A volume from a tracked sweep: every pixel is put where the probe was, and what lies between is filled.

Freehand three-dimensional ultrasound by pixel-based insertion (survey: Solberg, Lindseth, Torp, Blake and Nagelhus
Hernes, Ultrasound Med. Biol. 33, 2007): nearest or linear insertion, averaging where pixels meet, holes filled along
short lines between measured voxels.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene import Floats, Pixels, Volume, as_transform

Insertion = Literal["linear", "nearest"]

MOST_VOXELS = 512**3
"""A volume of more voxels is refused: eight bytes each for sum and weight are 2 GiB."""


def reconstruct(
    frames: Pixels,
    image_to_reference: Floats,
    spacing: float,
    *,
    insertion: Insertion = "linear",
    region: tuple[int, int, int, int] | None = None,
    fill: int = 9,
    progress: Callable[[int, int], None] | None = None,
) -> Volume:
    """Put the pixels of a sweep into a volume.

    Parameters
    ----------
    frames : ndarray, shape (n, rows, columns)
        Grey pictures.
    image_to_reference : ndarray, shape (n, 4, 4)
        Where (column, row, 0, 1) of every picture lies, mm.
    spacing : float
        Of the voxels, mm.
    insertion : {"linear", "nearest"}
        A pixel is shared by the eight voxels around it, or belongs to the nearest.
    region : (left, top, right, bottom), optional
        Pixels that hold tissue, the last two just outside; all when not given.
    fill : int
        Longest line of empty voxels between two measured ones, both counted, that is filled; 0 fills none.
    progress : callable, optional
        Called with (frames done, frames).

    Returns
    -------
    Volume
        uint8 where the frames are; ``filled`` says which voxels hold a value.

    Raises
    ------
    InputError
        If the frames have colours, the transforms are not one per frame, or the volume would be absurdly large.
    """
    pixels, matrices = _checked(frames, image_to_reference)
    if insertion not in get_args(Insertion):
        raise InputError(f"insertion is one of {', '.join(get_args(Insertion))}; got {insertion!r}")
    if not (np.isfinite(spacing) and spacing > 0):
        raise InputError(f"spacing of the voxels is a positive number in mm; got {spacing}")
    if fill < 0:
        raise InputError(f"fill is the length of a line in voxels, 0 or more; got {fill}")
    left, top, right, bottom = _region(region, pixels.shape)
    corners = np.array([(x, y, 0.0, 1.0) for x in (left, right - 1) for y in (top, bottom - 1)])
    ends = (matrices @ corners.T)[:, :3].transpose(0, 2, 1).reshape(-1, 3)
    low, high = ends.min(axis=0), ends.max(axis=0)
    counts = np.ceil((high - low) / spacing - 1e-9) + 1
    if counts.prod() > MOST_VOXELS:
        wide = " x ".join(f"{w:.0f}" for w in high - low)
        raise InputError(
            f"the sweep spans {wide} mm, {counts.prod():.3g} voxels of {spacing:g} mm; at most {MOST_VOXELS:.3g} can be made: "
            "give a larger spacing, or check the calibration and the transforms"
        )
    nx, ny, nz = (int(n) for n in counts)
    total, weight = np.zeros(nx * ny * nz), np.zeros(nx * ny * nz)
    grid = np.mgrid[top:bottom, left:right].reshape(2, -1)
    places = np.stack([grid[1], grid[0], np.zeros(grid.shape[1]), np.ones(grid.shape[1])])
    for k, (picture, matrix) in enumerate(zip(pixels, matrices, strict=True)):
        index = ((matrix[:3] @ places) - low[:, None]) / spacing
        values = picture[top:bottom, left:right].ravel().astype(np.float64)
        _insert(index, values, (nx, ny, nz), total, weight, insertion)
        if progress is not None:
            progress(k + 1, len(pixels))
    measured = (weight > 1e-6).reshape(nz, ny, nx)
    mean = np.divide(total, weight, out=total, where=weight > 1e-6).reshape(nz, ny, nx)
    mean[~measured] = 0.0
    filled = measured
    if fill > 1:
        mean, filled = _fill_lines(mean, measured, fill)
    whole = np.issubdtype(pixels.dtype, np.integer)
    voxels = np.rint(mean).astype(pixels.dtype) if whole else mean.astype(pixels.dtype)
    origin = (float(low[0]), float(low[1]), float(low[2]))
    return Volume(voxels, (spacing, spacing, spacing), origin, filled)


def _insert(
    index: Floats,
    values: Floats,
    shape: tuple[int, int, int],
    total: Floats,
    weight: Floats,
    insertion: Insertion,
) -> None:
    """Add a picture's values at voxel indices (3, m) to sum and weight."""
    nx, ny, nz = shape
    last = np.array([[nx - 1], [ny - 1], [nz - 1]])
    if insertion == "nearest":
        whole = np.clip(np.rint(index).astype(np.intp), 0, last)
        _add((whole[2] * ny + whole[1]) * nx + whole[0], values, np.ones_like(values), total, weight)
        return
    cell = np.clip(np.floor(index).astype(np.intp), 0, np.maximum(last - 1, 0))
    share = np.clip(index - cell, 0.0, 1.0)
    for corner in product((0, 1), repeat=3):
        w = np.prod([s if c else 1.0 - s for s, c in zip(share, corner, strict=True)], axis=0)
        x, y, z = np.minimum(cell + np.array(corner)[:, None], last)
        _add((z * ny + y) * nx + x, values, w, total, weight)


def _add(places: NDArray[np.intp], values: Floats, w: Floats, total: Floats, weight: Floats) -> None:
    first = int(places.min())
    total_part = np.bincount(places - first, w * values)
    total[first : first + len(total_part)] += total_part
    weight[first : first + len(total_part)] += np.bincount(places - first, w)


def _fill_lines(values: Floats, filled: NDArray[np.bool_], longest: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Fill empty voxels that lie on a short line between two measured ones, in any of the 13 directions.

    On each line the value is linear between its ends; lines are averaged with the inverse of their length.
    """
    reach = longest - 1
    padded = np.pad(values, reach)
    known = np.pad(filled, reach)
    flat, have = padded.ravel(), known.ravel()
    empty = np.flatnonzero(np.pad(~filled, reach))
    ny, nx = padded.shape[1:]
    total, weight = np.zeros(len(empty)), np.zeros(len(empty))
    for dz, dy, dx in product((-1, 0, 1), repeat=3):
        if (dz, dy, dx) <= (0, 0, 0):
            continue  # the opposite direction belongs to the same line
        step = (dz * ny + dy) * nx + dx
        far = np.full((2, len(empty)), longest, dtype=np.int64)
        end = np.zeros((2, len(empty)))
        for side, sign in enumerate((1, -1)):
            for s in range(1, reach):
                at = empty + sign * s * step
                hit = have[at] & (far[side] == longest)
                far[side][hit] = s
                end[side][hit] = flat[at[hit]]
        length = far.sum(axis=0)
        good = (far < longest).all(axis=0) & (length <= reach)
        w = 1.0 / length[good]
        total[good] += w * (end[0][good] * far[1][good] + end[1][good] * far[0][good]) / length[good]
        weight[good] += w
    done = weight > 0
    flat[empty[done]] = total[done] / weight[done]
    have[empty[done]] = True
    inner = (slice(reach, -reach),) * 3
    return padded[inner], known[inner]


def _checked(frames: Pixels, image_to_reference: Floats) -> tuple[Pixels, Floats]:
    pixels = np.asarray(frames)
    if pixels.ndim != 3 or 0 in pixels.shape:
        raise InputError(f"frames are grey pictures (n, rows, columns); got shape {pixels.shape}")
    matrices = np.asarray(image_to_reference, dtype=np.float64)
    if matrices.shape != (len(pixels), 4, 4):
        raise InputError(
            f"every frame has a transform, shape ({len(pixels)}, 4, 4); got {matrices.shape}: leave out frames without one"
        )
    return pixels, np.stack([as_transform(m) for m in matrices])


def _region(region: tuple[int, int, int, int] | None, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    rows, columns = shape[1:3]
    left, top, right, bottom = region or (0, 0, columns, rows)
    if not (0 <= left < right <= columns and 0 <= top < bottom <= rows):
        raise InputError(
            f"region is (left, top, right, bottom) within {columns} x {rows} pixels; got {(left, top, right, bottom)}"
        )
    return left, top, right, bottom
