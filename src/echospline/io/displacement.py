"""``displacement.npz``: the ground truth of a simulated cine, written frame by frame, read with every size checked."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from math import isfinite, prod
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import numpy as np
from numpy.typing import ArrayLike

from echospline.atomic import give_name, part_of, second_part, writing
from echospline.errors import InputError
from echospline.io.displacement_space import RANKS as KEYS_IN_SPACE
from echospline.io.displacement_space import SpatialDisplacementRecord
from echospline.io.kind import head
from echospline.io.recording import LIMIT, MIB, decoding
from echospline.scene import Floats, NeedlePose, RegularGrid, as_points

KEYS = ("points", "displacement", "times", "tip", "entry", "speed")
LOADS = ("tip_force_N", "friction_N", "side_force_N", "torque_N_mm", "cut_mm")
"""The needle's forces, recorded where the model knows them; files without them are whole."""
_HEADER = 128
"""Bytes of a .npy header, fixed so that the number of frames can be filled in at the end."""
_BLOCK = 2**20


@dataclass(frozen=True)
class DisplacementRecord:
    """Displacement of mesh nodes while a needle moved.

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Nodes at rest, (x, y) mm.
    displacement : ndarray, shape (frames, n, 2)
        Deformed minus rest, mm.
    times : ndarray, shape (frames,)
        s.
    tip, entry : ndarray, shape (frames, 2)
        n_t and n_s, mm.
    speed : ndarray, shape (frames,)
        Signed axial speed, mm/s.
    loads : mapping of ndarray, shape (frames,)
        The needle's forces by the names of `LOADS`; empty where none were recorded.

    Raises
    ------
    InputError
        If shapes do not fit, a number is not finite or times do not ascend.
    """

    points: Floats
    displacement: Floats
    times: Floats
    tip: Floats
    entry: Floats
    speed: Floats
    loads: Mapping[str, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, frames = len(self.points), len(self.times)
        shapes = {
            "points": (n, 2), "displacement": (frames, n, 2), "times": (frames,),
            "tip": (frames, 2), "entry": (frames, 2), "speed": (frames,),
        }  # fmt: skip
        shapes |= dict.fromkeys(self.loads, (frames,))
        for name, shape in shapes.items():
            array = self.loads[name] if name in self.loads else getattr(self, name)
            if array.shape != shape:
                raise InputError(f"{name} must have shape {shape}; got {array.shape}")
            if not np.isfinite(array).all():
                raise InputError(f"{name} holds a number that is not finite")
        if (np.diff(self.times) <= 0).any():
            raise InputError("times must ascend strictly")

    def __len__(self) -> int:
        return len(self.times)

    def pose(self, frame: int) -> NeedlePose:
        """Return the needle at one frame."""
        (ex, ey), (tx, ty) = self.entry[frame], self.tip[frame]
        return NeedlePose((float(ex), float(ey)), (float(tx), float(ty)), float(self.speed[frame]))

    def grid(self) -> RegularGrid:
        """Return the regular grid whose nodes the points are.

        Raises
        ------
        InputError
            If they are no regular grid, x fastest.
        """
        nx = int(np.argmax(self.points[:, 1] != self.points[0, 1])) or len(self.points)
        ny = len(self.points) // nx
        first, last = self.points[0], self.points[-1]
        spacing = [(last[i] - first[i]) / (n - 1) if n > 1 else 1.0 for i, n in enumerate((nx, ny))]
        if nx * ny == len(self.points) and min(spacing) > 0:
            grid = RegularGrid((nx, ny), (spacing[0], spacing[1]), (float(first[0]), float(first[1])))
            if np.allclose(grid.nodes, self.points, rtol=0, atol=1e-6 * max(spacing)):
                return grid
        raise InputError(f"the {len(self.points)} points are not the nodes of a regular grid, x fastest")


class DisplacementWriter:
    """Writes ``displacement.npz`` frame by frame: fields go to the disk at once, only times and poses are kept.

    Memory grows by a few hundred bytes a frame. Until `close`, the fields are in ``NAME.xxxxxxxx.part``, a plain ``.npy`` array whose header
    is updated after every frame, so that a killed run leaves its fields readable (``numpy.load``).

    Parameters
    ----------
    path : str or Path
        Final name, ending in ``.npz``.
    points : array_like, shape (n, 2)
        Nodes at rest, mm.

    Raises
    ------
    InputError
        If the name or the points are not of this form, or the file cannot be written.
    """

    def __init__(self, path: str | Path, points: ArrayLike) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() != ".npz":
            raise InputError(f"a displacement record is written as .npz; got {self.path.name!r}")
        self._points = as_points(points).copy()
        self._rows: list[tuple[float, float, float, float, float, float]] = []
        self._loads: list[tuple[float, ...]] = []
        self._closed = False
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._part = part_of(self.path)
            self._file = self._part.open("xb")
            self._file.write(self._header())

    def add(
        self, displacement: ArrayLike, time: float, pose: NeedlePose, load: Mapping[str, float] | None = None
    ) -> None:
        """Write one frame.

        Parameters
        ----------
        displacement : array_like, shape (n, 2)
            mm.
        time : float
            s; later than the frame before.
        pose : NeedlePose
            The needle at that time.
        load : mapping, optional
            The needle's forces by the names of `LOADS`; for every frame or for none.

        Raises
        ------
        InputError
            If the field has another shape, is not finite, or the time does not ascend.
        """
        if self._closed:
            raise InputError(f"{self.path} is closed: no frame can be added")
        field = np.ascontiguousarray(displacement, dtype="<f8")
        if field.shape != self._points.shape:
            raise InputError(f"displacement must have shape {self._points.shape} in mm; got {field.shape}")
        if not np.isfinite(field).all():
            raise InputError(f"displacement at {time} s holds a number that is not finite")
        if not isfinite(time) or (self._rows and time <= self._rows[-1][0]):
            raise InputError(f"times must ascend strictly; got {time} s after {self._rows[-1:]}")
        numbers = tuple(float(load[name]) for name in LOADS) if load else ()
        if self._loads and len(numbers) != len(self._loads[0]):
            raise InputError("the needle's forces are recorded for every frame or for none")
        if not all(map(isfinite, numbers)):
            raise InputError(f"a force of the needle at {time} s is not finite")
        with writing(self.path):
            self._loads.append(numbers)
            self._file.seek(0, os.SEEK_END)
            self._file.write(field.data)
            self._rows.append((float(time), *pose.tip, *pose.entry, pose.speed))
            self._file.seek(0)
            self._file.write(self._header())

    def close(self) -> None:
        """Write everything into the final file; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 6)
        small = {"points": self._points, "times": rows[:, 0], "tip": rows[:, 1:3], "entry": rows[:, 3:5],
                 "speed": rows[:, 5]}  # fmt: skip
        loads = np.array(self._loads, dtype=np.float64).reshape(len(rows), -1)
        small |= dict(zip(LOADS, loads.T, strict=False))
        with writing(self.path):
            self._file.close()
            with (
                second_part(self._part) as whole,
                zipfile.ZipFile(whole, "w", zipfile.ZIP_STORED, allowZip64=True) as archive,
            ):
                for name in ("displacement", *small):
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                        if name == "displacement":
                            with self._part.open("rb") as fields:
                                while block := fields.read(_BLOCK):
                                    member.write(block)
                        else:
                            buffer = BytesIO()
                            np.save(buffer, np.ascontiguousarray(small[name]), allow_pickle=False)
                            member.write(buffer.getvalue())
            give_name(whole, self.path)
            self._part.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        elif not self._closed:
            self._closed = True
            with suppress(OSError):  # the error on its way says what is wrong
                self._file.close()

    def _header(self) -> bytes:
        """Return a .npy header (format 1.0) of fixed length for the frames so far."""
        shape = (len(self._rows), *self._points.shape)
        text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}"
        fill = _HEADER - 10
        return b"\x93NUMPY\x01\x00" + fill.to_bytes(2, "little") + text.ljust(fill - 1).encode() + b"\n"


def read_displacement(path: str | Path, *, limit: float = LIMIT) -> DisplacementRecord:
    """Read a displacement record; nothing is unpickled, nothing is allocated before its size is known.

    Parameters
    ----------
    path : str or Path
        ``displacement.npz``.
    limit : float
        MiB that the arrays may fill together.

    Raises
    ------
    InputError
        If the file is no such record, damaged or too large.

    Returns
    -------
    DisplacementRecord
        Of a run in space: the motion that its picture shows, and the needle projected onto its plane, in the cine's coordinates.
    """
    path = Path(path)
    if is_spatial_record(path):
        flat = read_spatial_displacement(path, limit=limit).in_plane()
        points, displacement, times, tip, entry, speed = (flat[name] for name in KEYS)
        return DisplacementRecord(points, displacement, times, tip, entry, speed)
    shapes = displacement_shapes(path)
    size = sum(prod(shape) * 8 for shape in shapes.values()) / MIB
    if size > limit:
        raise InputError(
            f"{path} declares arrays of {size:,.0f} MiB, more than the limit of {limit:,.0f} MiB: raise it"
        )
    with decoding(path, "displacement.npz"), zipfile.ZipFile(path) as archive:
        arrays = {name: _array(archive, path, name) for name in shapes}
    loads = {name: arrays.pop(name) for name in LOADS if name in arrays}
    return DisplacementRecord(**arrays, loads=loads)


def is_spatial_record(path: str | Path) -> bool:
    """Return whether a file is the displacement record of a run in space: it holds the pose of a plane."""
    path = Path(path)
    if not head(path).startswith(b"PK"):
        return False
    with decoding(path, "displacement.npz"), zipfile.ZipFile(path) as archive:
        return {"kind.npy", "plane.npy", "picture_points.npy"} <= set(archive.namelist())


def read_spatial_displacement(path: str | Path, *, limit: float = LIMIT) -> SpatialDisplacementRecord:
    """Read the displacement record of a run in space; nothing is unpickled, nothing is allocated before its size is known.

    Raises
    ------
    InputError
        If the file is no such record, damaged or too large.
    """
    path = Path(path)
    if not is_spatial_record(path):
        raise InputError(f"{path} is no displacement.npz of a run in space")
    with decoding(path, "displacement.npz"), zipfile.ZipFile(path) as archive:
        shapes = {name: _declared(archive, path, name, KEYS_IN_SPACE)[0] for name in KEYS_IN_SPACE}
        size = sum(prod(shape) * 8 for shape in shapes.values()) / MIB
        if size > limit:
            raise InputError(
                f"{path} declares arrays of {size:,.0f} MiB, more than the limit of {limit:,.0f} MiB: raise it"
            )
        arrays = {name: _array(archive, path, name) for name in shapes}
    valid = arrays.pop("picture_valid") > 0
    return SpatialDisplacementRecord(**arrays, picture_valid=valid)


def displacement_shapes(path: str | Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes that a displacement record declares, checked against the bytes it holds; no array is read.

    Raises
    ------
    InputError
        If the file is no such record or damaged.
    """
    path = Path(path)
    if not head(path).startswith(b"PK"):
        raise InputError(f"{path} is no zip archive; expected a displacement.npz")
    with decoding(path, "displacement.npz"), zipfile.ZipFile(path) as archive:
        names = {member.removesuffix(".npy") for member in archive.namelist()}
        return {
            name: _declared(archive, path, name)[0] for name in (*KEYS, *(n for n in LOADS if n in names))
        }


def _declared(
    archive: zipfile.ZipFile, path: Path, name: str, expected: Iterable[str] = KEYS
) -> tuple[tuple[int, ...], np.dtype[np.generic], bool]:
    """Return the shape, type and order in a member's header; refused unless they account for the member's size."""
    if f"{name}.npy" not in archive.namelist():
        raise InputError(f"{path} lacks the array {name!r}; expected {', '.join(expected)}")
    with archive.open(f"{name}.npy") as member:
        shape, fortran, dtype, start = _npy_header(member)
    flags = name == "picture_valid"
    if (dtype.kind != "b") if flags else (dtype.kind != "f" or dtype.itemsize not in (4, 8)):
        kind = "true or false" if flags else "32 or 64-bit floating point numbers"
        raise InputError(f"{path}: {name} must hold {kind}; got {dtype}")
    held = archive.getinfo(f"{name}.npy").file_size - start
    if prod(shape) * dtype.itemsize != held:
        raise InputError(
            f"{path}: {name} declares shape {shape} of {dtype} but holds {held} bytes: it is damaged"
        )
    return shape, dtype, fortran


def _npy_header(member: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[np.generic], int]:
    version = np.lib.format.read_magic(member)
    reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = reader(member, max_header_size=4096)
    return shape, fortran, dtype, member.tell()


def _array(archive: zipfile.ZipFile, path: Path, name: str) -> Floats:
    shape, dtype, fortran = _declared(archive, path, name)
    with archive.open(f"{name}.npy") as member:
        _npy_header(member)
        data = member.read(prod(shape) * dtype.itemsize)
    array = np.frombuffer(data, dtype=dtype).reshape(shape, order="F" if fortran else "C")
    return np.ascontiguousarray(array, dtype=np.float64)
