"""How arrays of a pack are written shorter, without loss: what their neighbours or their mirror images tell is left out.

All of it is integers and signs, so that every reader finds the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

NEIGHBOURS = ((0, 0, 1), (0, 1, 0), (0, 1, 1), (1, 0, 0), (1, 0, 1), (1, 1, 0), (1, 1, 1))
"""Steps back along z, y and x to the voxels that predict one, in the order of their weights."""
LARGEST_WEIGHT = 32767
"""In 256ths; a prediction stays within 32 bits."""
SAMPLE = 1_000_000
"""Voxels from which weights are estimated."""

Bytes = NDArray[np.uint8]
Mirrors = Sequence[tuple[Sequence[int], Sequence[int]]]
"""Rows and columns, each the list of where its images are, from 1, negative where the sign changes."""


def weights_of(voxels: Bytes) -> list[int]:
    """Return weights of the neighbours that predict voxels (nz, ny, nx) best, in 256ths."""
    every = -(-voxels.size // SAMPLE)  # of the planes along z, with the one before
    padded = np.pad(voxels, ((1, 0), (1, 0), (1, 0)))
    planes = np.arange(0, voxels.shape[0], every)
    before = [
        padded[planes + 1 - z, 1 - y : padded.shape[1] - y, 1 - x : padded.shape[2] - x].ravel()
        for z, y, x in NEIGHBOURS
    ]
    X = np.array(before, dtype=np.float64)  # its products are whole numbers, and exact in any order
    found = np.linalg.lstsq(X @ X.T, X @ voxels[planes].ravel(), rcond=None)[0]
    # a weight beyond the bound would predict worse, not wrong: what is left is written whatever was predicted
    return [int(w) for w in np.clip(np.rint(256 * found), -LARGEST_WEIGHT, LARGEST_WEIGHT)]


def residuals(voxels: Bytes, weights: Sequence[int]) -> Bytes:
    """Return what is left of voxels (nz, ny, nx) when their neighbours have predicted them, modulo 256."""
    padded = np.pad(voxels, ((1, 0), (1, 0), (1, 0)))
    left = np.empty_like(voxels)
    for k in range(len(voxels)):
        sums = np.zeros(voxels.shape[1:], np.int32)
        for (z, y, x), weight in zip(NEIGHBOURS, weights, strict=True):
            sums += (
                np.int32(weight) * padded[k + 1 - z, 1 - y : padded.shape[1] - y, 1 - x : padded.shape[2] - x]
            )
        left[k] = voxels[k] - _predicted(sums)
    return left


def from_residuals(left: Bytes, weights: Sequence[int]) -> Bytes:
    """Return the voxels of `residuals`.

    The voxels of one x + y + z need only those before it, and are found together; rows along x are taken in the order of their y + z,
    so that those that take part are always neighbours in memory.
    """
    nz, ny, nx = left.shape
    z, y = (a.ravel() for a in np.indices((nz, ny), dtype=np.int32))
    order = np.argsort(z + y, kind="stable")
    z, y = z[order], y[order]
    start, rows = z + y, len(order)
    at = (z * ny + y) * nx - start
    place = np.full(
        (nz + 1, ny + 1), rows, np.int32
    )  # the last row is of zeros, and stands beside the volume
    place[z + 1, y + 1] = np.arange(rows, dtype=np.int32)
    beside = {(a, b): place[z + 1 - a, y + 1 - b] for a, b in ((0, 1), (1, 0), (1, 1))}
    voxels, source = np.empty(left.size, np.uint8), left.ravel()
    recent = np.zeros((4, rows + 1), np.int32)  # voxels of this and of the last three sums, by row
    for t in range(nx + ny + nz - 2):
        low, high = np.searchsorted(start, (t - nx + 1, t + 1))
        sums = np.zeros(high - low, np.int32)
        for (a, b, c), weight in zip(NEIGHBOURS, weights, strict=True):
            before = recent[(t - a - b - c) % 4]
            sums += np.int32(weight) * (before[beside[a, b][low:high]] if a or b else before[low:high])
        where = at[low:high] + t
        found = source[where] + _predicted(sums)
        voxels[where] = recent[t % 4, low:high] = found
    return voxels.reshape(left.shape)


def _predicted(sums: NDArray[np.int32]) -> Bytes:
    held: Bytes = np.clip((sums + 128) >> 8, 0, 255).astype(np.uint8)
    return held


def kept(mirrors: Mirrors) -> NDArray[np.bool_]:
    """Return which entries of a table are written, flat: those of which no mirror has an image earlier in it."""
    own = np.arange(_size(mirrors[0]))
    written = np.ones(len(own), dtype=bool)
    for mirror in mirrors:
        written &= _images(*mirror)[0] >= own
    return written


def from_kept(values: NDArray[Any], mirrors: Mirrors) -> NDArray[Any]:
    """Return the table, flat, whose entries `kept` are values: the others are earlier ones, by the first mirror that says so."""
    own = np.arange(_size(mirrors[0]))
    source, sign = own.copy(), np.ones(len(own), np.int8)
    for mirror in mirrors:
        image, turned = _images(*mirror)
        new = (source == own) & (image < own)
        source[new], sign[new] = image[new], turned[new]
    table = np.zeros(len(own), values.dtype)
    table[source == own] = values
    while (following := source[source]).tobytes() != source.tobytes():
        sign *= sign[source]
        source = following
    return np.where(sign < 0, -table[source], table[source])


def _size(mirror: tuple[Sequence[int], Sequence[int]]) -> int:
    return len(mirror[0]) * len(mirror[1])


def _images(rows: Sequence[int], columns: Sequence[int]) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
    """Index of every entry's image in the flat table, and its sign."""
    r, c = np.array(rows, dtype=np.int64)[:, None], np.array(columns, dtype=np.int64)
    image = (np.abs(r) - 1) * len(columns) + np.abs(c) - 1
    return image.ravel(), (np.sign(r) * np.sign(c)).astype(np.int8).ravel()
