"""NDARRAY: an array of numbers of up to 255 dimensions, and the protocol's names of number types."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError, ProtocolError

SCALARS: dict[int, str] = {
    2: "i1",
    3: "u1",
    4: "i2",
    5: "u2",
    6: "i4",
    7: "u4",
    10: "f4",
    11: "f8",
    13: "c16",
}
"""NumPy's name of each scalar type; images have no complex (13)."""


def scalar_code(array: NDArray[Any], what: str) -> int:
    """Return the scalar type of an array's numbers.

    Raises
    ------
    InputError
        If the protocol has none for them.
    """
    for code, name in SCALARS.items():
        if array.dtype.str[1:] == name:
            return code
    raise InputError(f"{what} holds 8, 16 or 32 bit integers or 32 or 64 bit floats; got {array.dtype}")


@dataclass(frozen=True, eq=False)
class NDArrayMessage:
    """NDARRAY: numbers with a shape, first axis slowest."""

    TYPE: ClassVar[str] = "NDARRAY"
    array: NDArray[Any]

    def pack(self) -> bytes:
        """Pack type, number of axes, lengths and big-endian numbers.

        Raises
        ------
        InputError
            If an axis is longer than 65535 or the protocol has no such type of number.
        """
        a = self.array
        if a.ndim < 1 or a.ndim > 255 or max(a.shape) > 0xFFFF:
            raise InputError(f"an NDARRAY has 1 to 255 axes of at most 65535; got shape {a.shape}")
        head = struct.pack(f">BB{a.ndim}H", scalar_code(a, "an NDARRAY"), a.ndim, *a.shape)
        return head + a.astype(a.dtype.newbyteorder(">"), copy=False).tobytes()

    @classmethod
    def unpack(cls, content: memoryview) -> NDArrayMessage:
        """Unpack an array."""
        if len(content) < 2 or len(content) < 2 + 2 * content[1] or content[1] == 0:
            raise ProtocolError(f"an NDARRAY of {len(content)} bytes ends inside its header or has no axis")
        name = SCALARS.get(content[0])
        if name is None:
            raise ProtocolError(f"the protocol has no scalar type {content[0]}")
        axes = content[1]
        shape = struct.unpack_from(f">{axes}H", content, 2)
        data = content[2 + 2 * axes :]
        if math.prod(shape) * np.dtype(name).itemsize != len(data):
            raise ProtocolError(f"an NDARRAY of shape {shape} and type {name} does not fit {len(data)} bytes")
        if axes > 64:
            raise ProtocolError(f"an NDARRAY is read with at most 64 axes; got {axes}")
        array = np.frombuffer(data, dtype=">" + name).reshape(shape)
        return cls(array.astype(array.dtype.newbyteorder("=")))
