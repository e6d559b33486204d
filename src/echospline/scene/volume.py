"""A volume of ultrasound: voxels at constant spacing, with the frame that they stand in."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.scene.grid import Floats, as_points
from echospline.scene.space import SpatialGrid

Voxels = NDArray[np.generic]


@dataclass(frozen=True, eq=False)
class Volume:
    """Voxels on a lattice whose axes are those of their frame.

    Parameters
    ----------
    voxels : ndarray, shape (nz, ny, nx)
        Brightness, x fastest.
    spacing : (x, y, z)
        Distance between voxel centres, mm.
    origin : (x, y, z)
        Centre of the first voxel, mm.
    filled : ndarray of bool, shape (nz, ny, nx), optional
        Voxels that hold a measurement; all of them when not given.
    frame : str
        Name of the frame that the axes belong to (``Reference``).
    source : str
        Its origin.

    Raises
    ------
    InputError
        If the voxels are not a volume of numbers, or spacing and origin are not three numbers in mm.
    """

    voxels: Voxels
    spacing: tuple[float, float, float]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    filled: NDArray[np.bool_] | None = field(default=None, repr=False)
    frame: str = "Reference"
    source: str = ""

    def __post_init__(self) -> None:
        v = np.asarray(self.voxels)
        if v.ndim != 3 or 0 in v.shape or not (np.issubdtype(v.dtype, np.number) or v.dtype == bool):
            raise InputError(
                f"a volume has numbers in three axes (z, y, x); got {v.dtype} of shape {v.shape}"
            )
        if np.issubdtype(v.dtype, np.complexfloating):
            raise InputError("a volume holds brightness; got complex numbers")
        for name, positive in (("spacing", True), ("origin", False)):
            value = tuple(float(x) for x in getattr(self, name))
            if len(value) != 3 or not np.isfinite(value).all() or (positive and min(value) <= 0):
                what = "positive numbers" if positive else "numbers"
                raise InputError(
                    f"{name} of a volume is three {what} (x, y, z) in mm; got {getattr(self, name)}"
                )
            object.__setattr__(self, name, value)
        if self.filled is not None and self.filled.shape != v.shape:
            raise InputError(f"filled has one value per voxel, shape {v.shape}; got {self.filled.shape}")
        object.__setattr__(self, "voxels", v)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y and z."""
        nz, ny, nx = self.voxels.shape
        return nx, ny, nz

    @property
    def size(self) -> tuple[float, float, float]:
        """Extent from the first to the last voxel centre along x, y and z, mm."""
        x, y, z = ((n - 1) * h for n, h in zip(self.shape, self.spacing, strict=True))
        return x, y, z

    def mesh(self, nodes: tuple[int, int, int]) -> SpatialGrid:
        """Return a mesh for a tissue model: so many nodes along x, y and z, the first at the first voxel and the last at the last."""
        low = np.array(self.origin)
        return SpatialGrid.spanning(tuple(low), tuple(low + np.array(self.size)), nodes)

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Test which points (n, 3) in mm lie between the outermost voxel centres."""
        index = self._index(points)
        beyond = (index < -1e-9) | (index > np.subtract(self.shape, 1) + 1e-9)
        inside: NDArray[np.bool_] = ~np.logical_or.reduce(beyond, axis=1)
        return inside

    def sample(self, points: ArrayLike, outside: float = 0.0) -> Floats:
        """Interpolate the brightness at points (n, 3) in mm between eight voxels, shape (n,); ``outside`` beyond the volume."""
        inside = self.contains(points)
        last = np.subtract(self.shape, 1)
        index = np.clip(self._index(points), 0, last)
        cell = np.minimum(np.floor(index).astype(np.intp), np.maximum(last - 1, 0))
        share = index - cell
        value = np.zeros(len(index))
        for corner in np.ndindex(2, 2, 2):
            x, y, z = np.minimum(cell + corner, last).T
            weight = np.prod(np.where(corner, share, 1.0 - share), axis=1)
            value += weight * self.voxels[z, y, x]
        return np.where(inside, value, outside)

    def windowed(self, low: float, high: float) -> Volume:
        """Return 8-bit voxels: ``low`` becomes 0, ``high`` 255, beyond them they are cut.

        Raises
        ------
        InputError
            If high is not above low.
        """
        if not (np.isfinite([low, high]).all() and high > low):
            raise InputError(f"a window goes from a lower to a higher value; got {low} to {high}")
        scaled = np.clip(
            (self.voxels.astype(np.float32) - low) * np.float32(255.0 / (high - low)), 0.0, 255.0
        )
        return replace(self, voxels=np.rint(scaled).astype(np.uint8))

    def with_depth(self, axis: str) -> Volume:
        """Turn the volume so that its depth runs along y: the scene's frame, with the surface at y = 0.

        Parameters
        ----------
        axis : {"x", "-x", "y", "-y", "z", "-z"}
            The volume's axis along which depth grows.

        Returns
        -------
        Volume
            x and z stay right-handed with y; x begins at minus half its size, as does z.

        Raises
        ------
        InputError
            If the axis has another name.
        """
        turns = {  # for the new x, y and z: which old axis, and whether it is reversed
            "y": ((0, False), (1, False), (2, False)),
            "-y": ((0, True), (1, True), (2, False)),
            "z": ((0, False), (2, False), (1, True)),
            "-z": ((0, False), (2, True), (1, False)),
            "x": ((2, False), (0, False), (1, False)),
            "-x": ((2, True), (0, True), (1, False)),
        }
        if axis not in turns:
            raise InputError(f"depth runs along one of {', '.join(turns)}; got {axis!r}")
        turn = turns[axis]
        order = [2 - old for old, _ in turn[::-1]]
        flips = tuple(slice(None, None, -1 if flip else 1) for _, flip in turn[::-1])
        voxels = np.ascontiguousarray(self.voxels.transpose(order)[flips])
        filled = None if self.filled is None else np.ascontiguousarray(self.filled.transpose(order)[flips])
        sx, sy, sz = (self.spacing[old] for old, _ in turn)
        nz, _, nx = voxels.shape
        origin = (-0.5 * (nx - 1) * sx, 0.0, -0.5 * (nz - 1) * sz)
        return replace(self, voxels=voxels, filled=filled, spacing=(sx, sy, sz), origin=origin)

    def _index(self, points: ArrayLike) -> Floats:
        p = as_points(points, "points", 3)
        index: Floats = (p - np.array(self.origin)) / np.array(self.spacing)
        return index
