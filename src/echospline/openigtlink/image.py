"""IMAGE: pixels with the matrix that places them in space; the protocol's position is the image *centre*."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError, ProtocolError
from echospline.openigtlink.ndarray import SCALARS, scalar_code
from echospline.scene import Floats, as_transform

_HEAD = struct.Struct(">HBBBB3H12f3H3H")
_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Image:
    """A picture or a volume in RAS space.

    Parameters
    ----------
    voxels : ndarray, shape (slices, rows, columns) or (slices, rows, columns, components)
        A B-mode frame is (1, depth, lateral).
    matrix : ndarray, shape (4, 4)
        Takes (column, row, slice, 1) to RAS mm; its columns carry the spacing and its last one is the
        position of the *first* voxel (the wire carries the centre: `pack` and `unpack` convert).
    """

    TYPE: ClassVar[str] = "IMAGE"
    voxels: NDArray[Any]
    matrix: Floats

    def __post_init__(self) -> None:
        v = self.voxels
        if (
            v.ndim not in (3, 4)
            or min(v.shape) < 1
            or max(v.shape[:3]) > 0xFFFF
            or (v.ndim == 4 and v.shape[3] > 255)
        ):
            raise InputError(
                f"an IMAGE has shape (slices, rows, columns[, components]), 1 to 65535 each; got {v.shape}"
            )
        object.__setattr__(self, "matrix", as_transform(self.matrix))

    @property
    def size(self) -> tuple[int, int, int]:
        """Voxels along (columns, rows, slices)."""
        slices, rows, columns = self.voxels.shape[:3]
        return columns, rows, slices

    def pack(self) -> bytes:
        """Pack 72 bytes of header and the voxels, little-endian, first axis (columns) fastest."""
        v = self.voxels
        code = scalar_code(v, "an IMAGE")
        if SCALARS[code] == "c16":
            raise InputError("an IMAGE holds real numbers; got complex ones")
        columns = np.column_stack((self.matrix[:3, :3], self.matrix[:3] @ centre(self.size)))
        components = v.shape[3] if v.ndim == 4 else 1
        head = _HEAD.pack(1, components, code, 2, 1, *self.size, *columns.T.ravel(), 0, 0, 0, *self.size)
        return head + v.astype(v.dtype.newbyteorder("<"), copy=False).tobytes()

    @classmethod
    def unpack(cls, content: memoryview) -> Image:
        """Unpack an image; LPS becomes RAS.

        Raises
        ------
        ProtocolError
            If the sizes do not fit the bytes, or the message holds only a part of a volume.
        """
        if len(content) < _HEAD.size:
            raise ProtocolError(f"an IMAGE has 72 bytes of header; got {len(content)} bytes")
        _, components, code, endian, space, *rest = _HEAD.unpack_from(content)
        size, numbers, offset, part = tuple(rest[:3]), rest[3:15], rest[15:18], tuple(rest[18:21])
        name = SCALARS.get(code)
        if name is None or name == "c16" or endian not in (1, 2) or space not in (1, 2) or components < 1:
            raise ProtocolError(
                f"an IMAGE with scalar type {code}, byte order {endian}, space {space} and {components} "
                "components is not of the protocol"
            )
        if any(offset) or part != size:
            raise ProtocolError(
                f"an IMAGE must bring the whole volume {size}; got the part {part} at {offset}"
            )
        data, bytes_each = content[_HEAD.size :], np.dtype(name).itemsize
        if min(size) < 1 or size[0] * size[1] * size[2] * components * bytes_each != len(data):
            raise ProtocolError(
                f"an IMAGE of {size} x {components} of type {name} does not fit {len(data)} bytes"
            )
        matrix = np.eye(4)
        matrix[:3] = np.array(numbers).reshape(4, 3).T
        if not np.isfinite(matrix).all():
            raise ProtocolError("the matrix of an IMAGE must hold finite numbers")
        matrix[:3, 3] = matrix[:3] @ (2 * np.eye(4)[3] - centre(size))  # centre -> first voxel
        shape = size[::-1] if components == 1 else (*size[::-1], components)
        voxels = np.frombuffer(data, dtype=("<" if endian == 2 else ">") + name).reshape(shape)
        return cls(voxels.astype(voxels.dtype.newbyteorder("=")), matrix if space == 1 else _LPS @ matrix)


def centre(size: tuple[int, int, int]) -> Floats:
    """Return the homogeneous index (column, row, slice, 1) of the middle of an image of ``size`` voxels."""
    return np.array([(n - 1) / 2 for n in size] + [1.0])
