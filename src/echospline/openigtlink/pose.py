"""Pose of a tool: TRANSFORM (a 4 x 4 matrix), POSITION and QTRANS (a point and a quaternion)."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from echospline.errors import ProtocolError
from echospline.scene import Floats, as_transform

_COLUMNS = struct.Struct(">12f")


@dataclass(frozen=True, eq=False)
class Transform:
    """TRANSFORM: maps column vectors of the frame named first to the one named second (``NeedleToReference``).

    Parameters
    ----------
    matrix : ndarray, shape (4, 4)
        Last row 0 0 0 1; translation in mm, RAS.
    """

    TYPE: ClassVar[str] = "TRANSFORM"
    matrix: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", as_transform(self.matrix))

    def pack(self) -> bytes:
        """Pack 48 bytes: the columns, without the last row."""
        return self.matrix[:3].T.astype(">f4").tobytes()

    @classmethod
    def unpack(cls, content: memoryview) -> Transform:
        """Unpack a matrix of 48 bytes."""
        if len(content) != _COLUMNS.size:
            raise ProtocolError(f"a TRANSFORM has 48 bytes; got {len(content)}")
        matrix = np.eye(4)
        matrix[:3] = np.frombuffer(content, dtype=">f4").reshape(4, 3).T
        if not np.isfinite(matrix).all():
            raise ProtocolError("a TRANSFORM must hold finite numbers; got NaN or infinity")
        return cls(matrix)


@dataclass(frozen=True, eq=False)
class Position:
    """POSITION: a point in mm and a unit quaternion (x, y, z, w).

    Peers may leave the quaternion out (12 bytes) or its w (24 bytes); the rest follows from its length 1.
    """

    TYPE: ClassVar[str] = "POSITION"
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    def pack(self) -> bytes:
        """Pack 28 bytes."""
        return struct.pack(">7f", *self.position, *self.quaternion)

    @classmethod
    def unpack(cls, content: memoryview) -> Position:
        """Unpack 12, 24 or 28 bytes."""
        if len(content) not in (12, 24, 28):
            raise ProtocolError(f"a {cls.TYPE} has 12, 24 or 28 bytes; got {len(content)}")
        values = [float(v) for v in np.frombuffer(content, dtype=">f4")]
        if not np.isfinite(values).all():
            raise ProtocolError(f"a {cls.TYPE} must hold finite numbers; got NaN or infinity")
        x, y, z = values[3:6] or (0.0, 0.0, 0.0)
        w = values[6] if len(values) == 7 else max(0.0, 1.0 - x * x - y * y - z * z) ** 0.5
        return cls((values[0], values[1], values[2]), (x, y, z, w))

    def matrix(self) -> Floats:
        """Return the pose as a 4 x 4 matrix.

        Raises
        ------
        ProtocolError
            If the quaternion is not a rotation (its length is not 1 within a thousandth).
        """
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_of(self.quaternion)
        matrix[:3, 3] = self.position
        return matrix


@dataclass(frozen=True, eq=False)
class QuaternionTransform(Position):
    """QTRANS: the name that POSITION had in version 1 of the protocol; some trackers still send it."""

    TYPE: ClassVar[str] = "QTRANS"


def rotation_of(quaternion: tuple[float, float, float, float]) -> Floats:
    """Return the 3 x 3 rotation of a unit quaternion (x, y, z, w).

    Raises
    ------
    ProtocolError
        If its length is not 1 within a thousandth.
    """
    x, y, z, w = quaternion
    length = (x * x + y * y + z * z + w * w) ** 0.5
    if not abs(length - 1.0) <= 1e-3:
        raise ProtocolError(f"the quaternion of a pose has length 1; got {length:.4g}")
    x, y, z, w = x / length, y / length, z / length, w / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(matrix: Floats) -> tuple[float, float, float, float]:
    """Return the unit quaternion (x, y, z, w >= 0) of the rotation in a 4 x 4 or 3 x 3 matrix.

    The largest of the four components is computed first and divides the others, so that none loses its digits.
    """
    r = np.asarray(matrix, dtype=np.float64)
    traces = np.array([r[0, 0] - r[1, 1] - r[2, 2], r[1, 1] - r[0, 0] - r[2, 2],
                       r[2, 2] - r[0, 0] - r[1, 1], r[0, 0] + r[1, 1] + r[2, 2]])  # fmt: skip
    largest = int(np.argmax(traces))
    q = np.empty(4)
    if largest == 3:
        q[:] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + traces[3]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        q[i], q[j], q[k], q[3] = 1 + traces[i], r[j, i] + r[i, j], r[k, i] + r[i, k], r[k, j] - r[j, k]
    q *= (-1.0 if q[3] < 0 else 1.0) / np.linalg.norm(q)
    return float(q[0]), float(q[1]), float(q[2]), float(q[3])
