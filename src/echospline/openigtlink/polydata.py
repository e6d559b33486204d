"""Points and meshes: POINT (named fiducials) and POLYDATA (points joined by lines and faces)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError, ProtocolError
from echospline.openigtlink.header import pack_name
from echospline.scene import Floats

_POINT = struct.Struct(">64s32s4B3ff20s")
_POLYDATA = struct.Struct(">10I")
_ATTRIBUTE = struct.Struct(">BBI")
Cells = Sequence[Sequence[int]] | NDArray[np.integer[Any]]
"""Cells by the indices of their points: tuples of any length, or an array (cells, corners)."""


@dataclass(frozen=True)
class Point:
    """One fiducial: position and radius in mm (RAS), colour as four bytes red, green, blue, opacity."""

    name: str
    position: tuple[float, float, float]
    radius: float = 0.0
    group: str = ""
    rgba: tuple[int, int, int, int] = (255, 255, 0, 255)
    owner: str = ""


@dataclass(frozen=True)
class Points:
    """POINT: fiducials."""

    TYPE: ClassVar[str] = "POINT"
    points: tuple[Point, ...]

    def pack(self) -> bytes:
        """Pack 136 bytes for each."""
        return b"".join(
            _POINT.pack(
                pack_name(p.name, 64, "point name"),
                pack_name(p.group, 32, "group name"),
                *p.rgba,
                *p.position,
                p.radius,
                pack_name(p.owner, 20, "owner name"),
            )
            for p in self.points
        )

    @classmethod
    def unpack(cls, content: memoryview) -> Points:
        """Unpack fiducials."""
        if len(content) % _POINT.size:
            raise ProtocolError(f"a POINT has a multiple of 136 bytes; got {len(content)}")
        points = []
        for name, group, r, g, b, a, x, y, z, radius, owner in _POINT.iter_unpack(content):
            if not np.isfinite((x, y, z, radius)).all():
                raise ProtocolError("a POINT must hold finite numbers; got NaN or infinity")
            points.append(Point(_text(name), (x, y, z), radius, _text(group), (r, g, b, a), _text(owner)))
        return cls(tuple(points))


@dataclass(frozen=True, eq=False)
class Attribute:
    """Numbers at the points (kind 0 to 4) or cells (16 to 20) of a mesh: scalars, vectors, normals, tensors, RGBA."""

    name: str
    kind: int
    values: NDArray[np.float32]
    """shape (n, components)"""


@dataclass(frozen=True, eq=False)
class PolyData:
    """POLYDATA: a mesh.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        mm, RAS.
    vertices, lines, polygons, strips : tuple of tuple of int, or ndarray of int, shape (cells, corners)
        Cells by the indices of their points.
    attributes : tuple of Attribute
        Values at points or cells, such as the displacement.
    """

    TYPE: ClassVar[str] = "POLYDATA"
    points: Floats
    vertices: Cells = ()
    lines: Cells = ()
    polygons: Cells = ()
    strips: Cells = ()
    attributes: tuple[Attribute, ...] = field(default=())

    def pack(self) -> bytes:
        """Pack counts, points, cells and attributes."""
        p = np.asarray(self.points)
        if p.ndim != 2 or p.shape[1] != 3:
            raise InputError(f"the points of a POLYDATA have shape (n, 3); got {p.shape}")
        kinds = [_pack_cells(c, len(p)) for c in (self.vertices, self.lines, self.polygons, self.strips)]
        counts = [n for count, data in kinds for n in (count, len(data))]
        heads, names, numbers = [], [], []
        for a in self.attributes:
            heads.append(_ATTRIBUTE.pack(a.kind, a.values.shape[1], len(a.values)))
            names.append(pack_name(a.name, 255, "attribute name") + b"\0")
            numbers.append(a.values.astype(">f4").tobytes())
        all_names = b"".join(names)
        if len(all_names) % 2:  # the protocol aligns the next part to an even byte
            all_names += b"\0"
        return b"".join(
            (
                _POLYDATA.pack(len(p), *counts, len(self.attributes)),
                p.astype(">f4").tobytes(),
                *(data for _, data in kinds),
                *heads,
                all_names,
                *numbers,
            )
        )

    @classmethod
    def unpack(cls, content: memoryview) -> PolyData:
        """Unpack a mesh."""
        if len(content) < _POLYDATA.size:
            raise ProtocolError(f"a POLYDATA has 40 bytes of header; got {len(content)} bytes")
        n, *cells, attributes = _POLYDATA.unpack_from(content)
        need = 12 * n + sum(cells[1::2]) + _ATTRIBUTE.size * attributes
        if need > len(content) - _POLYDATA.size:
            raise ProtocolError(f"a POLYDATA that counts {need} bytes brings {len(content) - _POLYDATA.size}")
        at = _POLYDATA.size + 12 * n
        points = np.frombuffer(content[_POLYDATA.size : at], dtype=">f4").reshape(n, 3).astype(np.float64)
        if not np.isfinite(points).all():
            raise ProtocolError("the points of a POLYDATA must be finite numbers")
        kinds: list[Cells] = []
        for count, size in zip(cells[::2], cells[1::2], strict=True):
            kinds.append(_unpack_cells(content[at : at + size], count, n))
            at += size
        vertices, lines, polygons, strips = kinds
        return cls(points, vertices, lines, polygons, strips, _unpack_attributes(content[at:], attributes))


def _text(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("utf-8", "replace")


def _pack_cells(cells: Cells, points: int) -> tuple[int, bytes]:
    if isinstance(cells, np.ndarray):
        named = cells.ravel()
        flat = np.insert(cells, 0, cells.shape[1], axis=1)
    else:
        named = np.array([i for cell in cells for i in cell], dtype=np.int64)
        flat = np.array([i for cell in cells for i in (len(cell), *cell)], dtype=np.int64)
    if named.size and not (named.min() >= 0 and named.max() < points):
        raise InputError(f"a cell of a POLYDATA names its points by 0 to {points - 1}")
    return len(cells), flat.astype(">u4").tobytes()


def _unpack_cells(data: memoryview, count: int, points: int) -> Cells:
    if len(data) % 4 or count > len(data) // 4:
        raise ProtocolError(f"{count} cells of a POLYDATA do not fit {len(data)} bytes")
    flat = np.frombuffer(data, dtype=">u4").tolist()
    cells, at = [], 0
    while at < len(flat):
        size = flat[at]
        cell = tuple(flat[at + 1 : at + 1 + size])
        if len(cell) != size or any(i >= points for i in cell):
            raise ProtocolError(
                "a cell of a POLYDATA ends after its bytes do or names a point that is not there"
            )
        cells.append(cell)
        at += 1 + size
    if len(cells) != count:
        raise ProtocolError(f"a POLYDATA counts {count} cells and brings {len(cells)}")
    return tuple(cells)


def _unpack_attributes(data: memoryview, count: int) -> tuple[Attribute, ...]:
    heads = [_ATTRIBUTE.unpack_from(data, i * _ATTRIBUTE.size) for i in range(count)]
    at, names = count * _ATTRIBUTE.size, []
    rest = bytes(data[at:])
    begin = 0
    for _ in range(count):
        end = rest.find(b"\0", begin, begin + 256)
        if end < 0:
            raise ProtocolError("the name of a POLYDATA attribute does not end")
        names.append(_text(rest[begin:end]))
        begin = end + 1
    begin += begin % 2
    attributes = []
    for (kind, components, n), name in zip(heads, names, strict=True):
        size = 4 * components * n
        if components < 1 or begin + size > len(rest):
            raise ProtocolError(
                f"the POLYDATA attribute {name!r} of {n} x {components} ends after the body does"
            )
        values = np.frombuffer(rest[begin : begin + size], dtype=">f4").reshape(n, components)
        attributes.append(Attribute(name, kind, values.astype(np.float32)))
        begin += size
    return tuple(attributes)
