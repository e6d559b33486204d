"""``echoes.npz``: complex baseband frames with their grid and carrier, written frame by frame and checked when read."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from echospline.atomic import give_name, part_of, writing
from echospline.errors import InputError
from echospline.io.recording import LIMIT, MIB, decoding
from echospline.scene import Echo, EchoCine, Floats, RegularGrid

KEYS = ("iq", "times", "spacing", "origin", "carrier")


class EchoWriter:
    """Writes a known number of frames to ``echoes.npz``; holds one at a time.

    The file has a temporary name until it is whole.

    Parameters
    ----------
    path : Path
        Ends in ``.npz``.
    frames : int
        Number of frames.
    grid : RegularGrid
        Of the samples.
    carrier : float
        Cycles per mm.
    """

    def __init__(self, path: str | Path, frames: int, grid: RegularGrid, carrier: float) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() != ".npz" or frames < 1:
            raise InputError(f"echoes are written as .npz, one frame or more; got {self.path.name}, {frames}")
        self._frames, self._grid, self._carrier = frames, grid, carrier
        self._times: list[float] = []
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._part = part_of(self.path)
            self._zip = zipfile.ZipFile(self._part, "x", zipfile.ZIP_STORED, allowZip64=True)
            self._member: IO[bytes] = self._zip.open("iq.npy", "w", force_zip64=True)
            np.lib.format.write_array_header_1_0(
                self._member, {"descr": "<c8", "fortran_order": False, "shape": (frames, *grid.shape[::-1])}
            )

    def add(self, echo: Echo, time: float) -> None:
        """Write one frame; time in s."""
        if echo.grid != self._grid or echo.carrier != self._carrier or len(self._times) >= self._frames:
            raise InputError(f"{self.path.name} takes {self._frames} frames of one grid and carrier")
        with writing(self.path):
            self._member.write(np.ascontiguousarray(echo.iq, dtype="<c8").tobytes())
        self._times.append(time)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with writing(self.path):
            self._member.close()
            if kind is None and len(self._times) == self._frames:
                for name, value in (
                    ("times", self._times), ("spacing", self._grid.spacing), ("origin", self._grid.origin),
                    ("carrier", self._carrier),
                ):  # fmt: skip
                    with self._zip.open(f"{name}.npy", "w") as member:
                        np.lib.format.write_array(member, np.asarray(value, dtype="<f8"), allow_pickle=False)
            self._zip.close()
            if kind is None:
                if len(self._times) != self._frames:
                    raise InputError(f"{self.path.name} got {len(self._times)} of {self._frames} frames")
                give_name(self._part, self.path)


@dataclass(frozen=True)
class EchoStream:
    """Frames of an ``echoes.npz``, read while they are iterated, one in memory at a time.

    Parameters
    ----------
    path : Path
        The file.
    times : ndarray, shape (frames,)
        s.
    grid : RegularGrid
        Of the samples.
    carrier : float
        Cycles per mm.
    dtype : dtype
        Of the samples.
    """

    path: Path
    times: Floats
    grid: RegularGrid
    carrier: float
    dtype: np.dtype[Any]

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Echo]:
        """Yield the frames."""
        lines, rows = self.grid.shape
        size = lines * rows * self.dtype.itemsize
        with (
            decoding(self.path, "echoes.npz"),
            zipfile.ZipFile(self.path) as archive,
            archive.open("iq.npy") as member,
        ):
            np.lib.format.read_magic(member)
            np.lib.format.read_array_header_1_0(member, max_header_size=4096)
            for _ in self.times:
                held = member.read(size)
                if len(held) < size:
                    raise InputError(f"{self.path}: iq ends before its last frame: it is cut short")
                yield Echo(
                    np.frombuffer(held, dtype=self.dtype).reshape(rows, lines), self.grid, self.carrier
                )


def open_echoes(path: str | Path, *, limit: float = LIMIT) -> EchoStream:
    """Open ``echoes.npz``; nothing is unpickled, nothing is allocated before its size is known.

    Parameters
    ----------
    path : str or Path
    limit : float
        MiB that one frame may fill.

    Raises
    ------
    InputError
        If the file is no such record, damaged or too large.
    """
    path = Path(path)
    with decoding(path, "echoes.npz"), zipfile.ZipFile(path) as archive:
        missing = [k for k in KEYS if f"{k}.npy" not in archive.namelist()]
        if missing:
            raise InputError(
                f"{path} lacks {', '.join(missing)}; expected an echoes.npz with {', '.join(KEYS)}"
            )
        arrays: dict[str, Floats] = {}
        shape: tuple[int, ...] = ()
        dtype: np.dtype[Any] = np.dtype(np.complex64)
        for name in KEYS:
            info = archive.getinfo(f"{name}.npy")
            with archive.open(info) as member:
                np.lib.format.read_magic(member)
                declared, fortran, kind = np.lib.format.read_array_header_1_0(member, max_header_size=4096)
                held = info.file_size - member.tell()
                if (
                    fortran
                    or kind.kind != ("c" if name == "iq" else "f")
                    or prod(declared) * kind.itemsize != held
                ):
                    raise InputError(
                        f"{path}: {name} declares shape {declared} of {kind} but holds {held} bytes"
                    )
                if name == "iq":
                    shape, dtype = declared, kind
                elif held > 8 * 10_000_000:
                    raise InputError(f"{path}: {name} fills {held / MIB:,.0f} MiB: it is damaged")
                else:
                    arrays[name] = np.frombuffer(member.read(held), dtype=kind).reshape(declared)
    if (
        len(shape) != 3
        or arrays["spacing"].shape != (2,)
        or arrays["origin"].shape != (2,)
        or arrays["carrier"].shape != ()
        or arrays["times"].shape != shape[:1]
        or min(shape) < 1
    ):
        raise InputError(
            f"{path}: echoes have iq (frames, rows, lines), times (frames,), spacing (2,), origin (2,), one carrier"
        )
    frame = prod(shape[1:]) * dtype.itemsize / MIB
    if frame > limit:
        raise InputError(
            f"{path}: a frame fills {frame:,.0f} MiB, more than the limit of {limit:,.0f} MiB: raise it"
        )
    rows, lines = shape[1:]
    (dx, dy), (x0, y0) = arrays["spacing"].tolist(), arrays["origin"].tolist()
    grid = RegularGrid((lines, rows), (dx, dy), (x0, y0))
    times = np.asarray(arrays["times"], dtype=np.float64)
    return EchoStream(path, times, grid, float(arrays["carrier"]), dtype)


def read_echoes(path: str | Path, *, limit: float = LIMIT) -> EchoCine:
    """Read ``echoes.npz`` as a whole; parameters as for `open_echoes`.

    Parameters
    ----------
    path : str or Path
    limit : float
        MiB that the frames may fill.

    Raises
    ------
    InputError
        If the file is no such record, damaged or too large.
    """
    stream = open_echoes(path, limit=limit)
    lines, rows = stream.grid.shape
    size = len(stream) * rows * lines * stream.dtype.itemsize / MIB
    if size > limit:
        raise InputError(
            f"{path}: iq fills {size:,.0f} MiB, more than the limit of {limit:,.0f} MiB: raise it"
        )
    iq = np.empty((len(stream), rows, lines), dtype=stream.dtype)
    for i, echo in enumerate(stream):
        iq[i] = echo.iq
    return EchoCine(iq, stream.times, stream.grid, stream.carrier)
