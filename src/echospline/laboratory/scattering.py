"""What a block of tissue sends back: scatterers, one per cell and stored in bricks, and the faces between tissues."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError

Singles = NDArray[np.float32]
Complexes = NDArray[np.complex64]

CELL = (0.55, 0.2, 1.0)
"""mm (x, y, z), one scatterer each: about eight in the smallest resolution cell of `ABDOMINAL`; fewer bring the envelope off Rayleigh."""
BRICK = (4, 16, 2)
"""Cells (x, y, z) that are stored together, so that a slab is found without testing every scatterer."""


@dataclass(frozen=True, eq=False)
class Scattering:
    """One scatterer per cell of a block, in bricks.

    Parameters
    ----------
    points : ndarray, shape (3, bricks, cells), float32
        x, y and z, mm.
    amplitudes : ndarray, shape (bricks, cells), float32
        0 dB is an rms of 1.
    bricks : (nx, ny, nz)
        Number of bricks; x fastest.
    low : (x, y, z)
        Lowest corner of the block, mm.
    size : (x, y, z)
        Of a brick, mm.
    """

    points: Singles
    amplitudes: Singles
    bricks: tuple[int, int, int]
    low: tuple[float, float, float]
    size: tuple[float, float, float]

    @classmethod
    def of_levels(
        cls, levels: NDArray[np.floating], low: Sequence[float], seed: int, cell: Sequence[float] = CELL
    ) -> Scattering:
        """Draw scatterers: each anywhere in its cell, with a strength from a quarter to one and either sign.

        One per cell comes closer to Rayleigh's distribution than as many strewn ones (SNR of the envelope 1.87 there).
        Of equal strength they overshoot (1.94), of strengths from 0 to 1 they fall short (1.88); Rayleigh is 1.91.

        Parameters
        ----------
        levels : ndarray, shape (nz, ny, nx)
            dB for each cell; whole numbers of bricks along each axis.
        low : (x, y, z)
            Lowest corner, mm.
        seed : int
        cell : (x, y, z)
            Size of a cell, mm.

        Raises
        ------
        InputError
            If the cells do not fill whole bricks.
        """
        if levels.ndim != 3 or any(n % b or n == 0 for n, b in zip(levels.shape[::-1], BRICK, strict=True)):
            raise InputError(
                f"levels have (z, y, x) cells in multiples of {BRICK[::-1]}; got shape {levels.shape}"
            )
        nz, ny, nx = levels.shape
        bx, by, bz = BRICK
        bricks = (nx // bx, ny // by, nz // bz)
        rng = np.random.default_rng((seed, 1))
        sorted_levels = _bricked(np.asarray(levels, dtype=np.float32), bricks)
        amplitudes = np.exp(sorted_levels * np.float32(log(10.0) / 20.0))
        strength = rng.uniform(-0.75, 0.75, sorted_levels.shape).astype(np.float32)
        strength += np.copysign(np.float32(0.25), strength)
        amplitudes *= strength / np.float32(sqrt(0.4375))  # mean square of strengths from 1/4 to 1
        points = np.empty((3, *sorted_levels.shape), dtype=np.float32)
        k, j, i = np.ogrid[:nz, :ny, :nx]
        for axis, index in enumerate((i, j, k)):
            whole = np.broadcast_to(index.astype(np.float32), levels.shape)
            points[axis] = _bricked(whole, bricks)
            points[axis] += rng.random(sorted_levels.shape, np.float32)
            points[axis] *= np.float32(cell[axis])
            points[axis] += np.float32(low[axis])
        x, y, z = (float(c) * b for c, b in zip(cell, BRICK, strict=True))
        return cls(points, amplitudes, bricks, (float(low[0]), float(low[1]), float(low[2])), (x, y, z))


def _bricked(cells: Singles, bricks: tuple[int, int, int]) -> Singles:
    """Sort (nz, ny, nx) cells into (bricks, cells)."""
    (bx, by, bz), (x, y, z) = BRICK, bricks
    parts = cells.reshape(z, bz, y, by, x, bx).transpose(0, 2, 4, 1, 3, 5)
    return np.ascontiguousarray(parts).reshape(x * y * z, bx * by * bz)


@dataclass(frozen=True, eq=False)
class Faces:
    """Interfaces between tissues: reflecting points, one per column of cells that an interface crosses.

    Parameters
    ----------
    points : ndarray, shape (n, 3), float32
        mm.
    amplitudes : ndarray, shape (n,), complex64
        Of a face square to the beam; 1 is the rms of 0 dB speckle.
    normals : ndarray, shape (n, 3), float32
        Unit vectors.
    powers : ndarray, shape (n,), float32
        Exponent of the cosine between normal and beam: smooth faces shine only square to it.
    cell : (x, z)
        Size of a column, mm.
    """

    points: Singles
    amplitudes: Complexes
    normals: Singles
    powers: Singles
    cell: tuple[float, float] = (CELL[0], CELL[2])

    @classmethod
    def none(cls) -> Faces:
        """Return no face at all."""
        empty = np.zeros((0, 3), dtype=np.float32)
        return cls(empty, np.zeros(0, dtype=np.complex64), empty, empty[:, 0])
