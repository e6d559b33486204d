"""Tools of a tracker: TDATA (matrices), QTDATA (quaternions), and the start and end of their stream (STT_, STP_)."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from echospline.errors import InputError, ProtocolError
from echospline.openigtlink.header import pack_name, unpack_name
from echospline.openigtlink.pose import quaternion_of, rotation_of
from echospline.scene import Floats, frames_of

TRACKER, SIX, THREE, FIVE = 1, 2, 3, 4
"""Kinds of tools: the tracker itself; tools of which six, three (the tip) or five coordinates (tip and axis) are known."""
STREAMED_ON_REQUEST = ("TDATA", "QTDATA", "QTRANS", "POSITION")
"""Types that are sent to the peers that asked for them by STT_ alone."""
TRACKER_FRAME = "Tracker"
"""Frame of a tool whose name is no <From>To<To>: the tracker's own, by the name that PLUS gives it."""

_TDATA = struct.Struct(">20sBx12f")
_QTDATA = struct.Struct(">20sBx7f")
_START = struct.Struct(">i32s")


@dataclass(frozen=True, eq=False)
class Tool:
    """One tracked tool.

    Parameters
    ----------
    name : str
        At most 20 ASCII characters: a transform (``NeedleToTracker``, as PLUS sends it) or the tool alone (``Needle``).
    matrix : ndarray, shape (4, 4)
        From the tool to the tracker, mm; as received, so it may hold anything.
    kind : int
        1 to 4, see `TRACKER`.
    """

    name: str
    matrix: Floats
    kind: int = SIX


@dataclass(frozen=True, eq=False)
class TrackingData:
    """TDATA: any number of tools, 70 bytes each."""

    TYPE: ClassVar[str] = "TDATA"
    tools: tuple[Tool, ...]

    def pack(self) -> bytes:
        """Pack names, kinds and the columns of the matrices."""
        return b"".join(
            _TDATA.pack(_name(tool), tool.kind, *(float(v) for v in tool.matrix[:3].T.ravel()))
            for tool in self.tools
        )

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        """Unpack the tools; numbers that are not finite are kept, because they speak of their own tool alone."""
        return cls(tuple(_tool(*row) for row in _elements(cls.TYPE, _TDATA, content)))


@dataclass(frozen=True, eq=False)
class QuaternionTrackingData:
    """QTDATA: any number of tools, 50 bytes each; their rotation is a unit quaternion."""

    TYPE: ClassVar[str] = "QTDATA"
    tools: tuple[Tool, ...]

    def pack(self) -> bytes:
        """Pack names, kinds, positions and quaternions (x, y, z, w)."""
        return b"".join(
            _QTDATA.pack(
                _name(tool), tool.kind, *(float(v) for v in tool.matrix[:3, 3]), *quaternion_of(tool.matrix)
            )
            for tool in self.tools
        )

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        """Unpack the tools; a quaternion that is no rotation becomes a matrix of NaN, which its receiver refuses."""
        return cls(tuple(_quaternion_tool(*row) for row in _elements(cls.TYPE, _QTDATA, content)))


@dataclass(frozen=True)
class StartTracking:
    """Content of STT_TDATA and STT_QTDATA.

    Parameters
    ----------
    resolution : int
        Shortest time between two messages, ms; 0 for as fast as they come.
    coordinates : str
        Name of the coordinate frame, at most 32 ASCII characters.
    """

    resolution: int = 0
    coordinates: str = ""

    def pack(self) -> bytes:
        """Pack 36 bytes."""
        return _START.pack(self.resolution, pack_name(self.coordinates, 32, "coordinate frame"))

    @classmethod
    def unpack(cls, content: bytes) -> Self:
        """Unpack 36 bytes; none at all (some peers send an empty body) means as fast as they come.

        Raises
        ------
        ProtocolError
            If there are others, or the time is negative.
        """
        if not content:
            return cls()
        if len(content) != _START.size:
            raise ProtocolError(f"the start of tracking data has {_START.size} bytes; got {len(content)}")
        resolution, coordinates = _START.unpack(content)
        if resolution < 0:
            raise ProtocolError(f"the time between tracking data is 0 ms or more; got {resolution}")
        return cls(resolution, unpack_name(coordinates, "coordinate frame"))


def transform_name(tool: Tool) -> str:
    """Return the name of a tool's transform: its own if that is <From>To<To>, else ``<tool>ToTracker``."""
    try:
        frames_of(tool.name)
    except InputError:
        return f"{tool.name}To{TRACKER_FRAME}"
    return tool.name


def _name(tool: Tool) -> bytes:
    if not 1 <= tool.kind <= 4:
        raise InputError(f"a tool is of kind 1 to 4; got {tool.kind}")
    return pack_name(tool.name, 20, "tool's name")


def _elements(kind: str, layout: struct.Struct, content: memoryview) -> list[tuple[str, int, list[float]]]:
    if len(content) % layout.size:
        raise ProtocolError(f"a {kind} has a multiple of {layout.size} bytes; got {len(content)}")
    rows = []
    for raw, tool, *numbers in layout.iter_unpack(content):
        name = unpack_name(raw, "tool's name")
        if not name:
            raise ProtocolError(f"every tool of a {kind} has a name; got an empty one")
        rows.append((name, int(tool), numbers))
    return rows


def _tool(name: str, kind: int, numbers: list[float]) -> Tool:
    matrix = np.eye(4)
    matrix[:3] = np.reshape(numbers, (4, 3)).T
    return Tool(name, matrix, kind)


def _quaternion_tool(name: str, kind: int, numbers: list[float]) -> Tool:
    matrix = np.eye(4)
    x, y, z, w = numbers[3:]
    try:
        matrix[:3, :3] = rotation_of((x, y, z, w))
    except ProtocolError:
        matrix[:3, :3] = np.nan
    matrix[:3, 3] = numbers[:3]
    return Tool(name, matrix, kind)
