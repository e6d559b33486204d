"""Arrays in Matlab files (version 5 through SciPy, version 7.3 through h5py) and HDF5: RF lines and channel data.

Axes are given in Matlab's order for Matlab files (which HDF5 stores reversed) and in the order of the file for HDF5. A cell is
named ``NAME{1}``, a field ``NAME.FIELD``. Links and pixels in other files are never followed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from math import isfinite, prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError, MissingExtraError
from echospline.io.kind import kind_of
from echospline.io.recording import LIMIT, MIB, decoding

MATLAB_AXES, HDF5_AXES = ("depth", "line", "frame"), ("frame", "depth", "line")
"""Order of axes where none is given: Matlab's users keep lines in columns and frames last; NumPy's frames first."""
_DEEPEST = 4
_MOST = 1000
"""Levels of groups and arrays that are listed; more is no recording."""
_RATES = ("fps", "framerate", "frame_rate")
_SAMPLING = ("fs", "f_s", "sampling_frequency", "samplingrate", "sampling_rate")
_V5_TYPES = {"double": "float64", "single": "float32", "logical": "bool"}


@dataclass(frozen=True)
class ArrayInfo:
    """Name, shape and element type of an array; ``hdf5`` says whether it is of a plain HDF5 file."""

    name: str
    shape: tuple[int, ...]
    type: str
    hdf5: bool = False

    @property
    def numeric(self) -> bool:
        """Whether its elements are numbers."""
        return re.fullmatch(r"u?int\d+|float\d+|complex\d+", self.type) is not None


@dataclass(frozen=True)
class LineCine:
    """RF lines, IQ lines or channel data, one frame in memory at a time (all of them with a Matlab file of version 5).

    Parameters
    ----------
    path : Path
        The file.
    info : ArrayInfo
        The array.
    axes : tuple of str
        Meaning of its axes longer than 1, of depth, line and frame.
    fps, sampling : float, optional
        Frames per second and samples per microsecond, where the file has a variable that says so.
    notes : tuple of str
        Conclusions of the reader.
    """

    path: Path
    info: ArrayInfo
    axes: tuple[str, ...]
    fps: float | None
    sampling: float | None
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return self._size("frame")

    @property
    def shape(self) -> tuple[int, int]:
        """(samples in depth, lines)."""
        return self._size("depth"), self._size("line")

    @property
    def complex(self) -> bool:
        """Whether the lines are complex: baseband (IQ)."""
        return self.info.type.startswith("complex")

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Yield the frames, shape (samples, lines)."""
        long = [i for i, n in enumerate(self.info.shape) if n > 1]
        order = {name: long[i] for i, name in enumerate(self.axes)}
        with decoding(self.path, "array"), _slices(self.path, self.info) as take:
            for k in range(len(self)):
                index: list[Any] = [0 if n == 1 else slice(None) for n in self.info.shape]
                if "frame" in order:
                    index[order["frame"]] = k
                frame = np.asarray(take(tuple(index)))
                kept = [name for name in self.axes if name != "frame"]
                if kept == ["line", "depth"]:
                    frame = frame.T
                if not np.isfinite(frame).all():
                    raise InputError(f"{self.path}: {self.info.name} holds values that are not finite")
                yield frame

    def _size(self, axis: str) -> int:
        long = [n for n in self.info.shape if n > 1]
        return long[self.axes.index(axis)] if axis in self.axes else 1


def list_arrays(path: str | Path) -> list[ArrayInfo]:
    """List the arrays of a Matlab or HDF5 file; no array is read, except to look into cells and structs of version 5.

    Raises
    ------
    InputError
        If the file is damaged.
    MissingExtraError
        If h5py is needed and not installed.
    """
    path = Path(path)
    with decoding(path, "array"):
        if kind_of(path)[1] == "Matlab 5":
            return _listed_v5(path)
        with _hdf5(path) as file:
            return list(_walked(file, "", "MATLAB" in kind_of(path)[1].upper(), 0))[:_MOST]


def open_lines(
    path: str | Path,
    *,
    variable: str | None = None,
    axes: Sequence[str] | None = None,
    limit: float = LIMIT,
) -> LineCine:
    """Open an array of lines as a cine.

    Parameters
    ----------
    path : str or Path
        Matlab or HDF5 file.
    variable : str, optional
        Name of the array; needed where several could be meant.
    axes : sequence of {"depth", "line", "frame"}, optional
        Meaning of the axes, in the order of the file, those of length 1 left out.
    limit : float
        MiB of one frame, or of the whole array of a Matlab file of version 5.

    Raises
    ------
    InputError
        If the array is not found, not numeric, or its axes do not fit.
    MissingExtraError
        If h5py is needed and not installed.
    """
    path = Path(path)
    found = list_arrays(path)
    info = _chosen(path, found, variable)
    long = [n for n in info.shape if n > 1]
    usual = [a for a in (HDF5_AXES if info.hdf5 else MATLAB_AXES) if len(long) == 3 or a != "frame"]
    named = tuple(axes) if axes is not None else tuple(usual)
    if len(named) != len(long) or len({*named}) != len(named) or {*named} - {"frame"} != {"depth", "line"}:
        raise InputError(
            f"{path}: {info.name} has axes of {' x '.join(map(str, info.shape))}; expected depth, line and frame, or depth and "
            f"line, in the order of the file (those of length 1 left out); got {','.join(named)}: give --axes"
        )
    old = kind_of(path)[1] == "Matlab 5"
    frames = long[named.index("frame")] if "frame" in named else 1
    held = prod(info.shape) * _item_bytes(info.type) / MIB / (1 if old else frames)
    if held > limit:
        what = "the array of a Matlab file of version 5" if old else "one frame"
        raise InputError(
            f"{path}: {info.name} needs {held:,.0f} MiB for {what}, more than the limit of {limit:,.0f} MiB: "
            + ("save it with -v7.3, or raise the limit" if old else "raise the limit")
        )
    rate, sampling = _scalar(path, found, _RATES), _scalar(path, found, _SAMPLING)
    if sampling is not None and sampling > 1e4:  # Hz, as Field II has it; MHz otherwise
        sampling /= 1e6
    note = f"{info.name} is read as {', '.join(named)}"
    if info.type.startswith("complex"):
        note += "; complex, so taken as baseband (IQ)"
    return LineCine(path, info, named, rate, sampling, (note,))


def _chosen(path: Path, found: list[ArrayInfo], variable: str | None) -> ArrayInfo:
    fits = [a for a in found if a.numeric and sum(n > 1 for n in a.shape) in (2, 3)]
    names = ", ".join(f"{a.name} ({' x '.join(map(str, a.shape))} {a.type})" for a in (fits or found)[:12])
    if variable is not None:
        for info in found:
            if info.name in (variable, f"{variable}{{1}}"):
                if not info.numeric:
                    raise InputError(f"{path}: {variable} holds {info.type}, not numbers; it has {names}")
                return info
        raise InputError(f"{path} has no array {variable!r}; it has {names or 'none'}: give --variable NAME")
    if len(fits) == 1:
        return fits[0]
    what = "several arrays that could be lines" if fits else "no array of two or three axes"
    raise InputError(f"{path} has {what}: {names or 'none'}; give --variable NAME")


def _item_bytes(name: str) -> int:
    return int(np.dtype(name).itemsize)


def _scalar(path: Path, found: list[ArrayInfo], names: tuple[str, ...]) -> float | None:
    """Return the value of a variable of one number by one of its usual names, at the top or one level below."""
    for info in found:
        if info.name.lower().rsplit(".", 1)[-1] in names and info.numeric and prod(info.shape) == 1:
            with _slices(path, info) as take:
                value = float(np.real(np.ravel(take(tuple(0 for _ in info.shape)))[0]))
            return value if isfinite(value) and value > 0 else None
    return None


@contextmanager
def _slices(path: Path, info: ArrayInfo) -> Iterator[Any]:
    """Open an array; the value takes an index in the array's own order of axes."""
    if kind_of(path)[1] == "Matlab 5":
        value = _inside(_loaded(path, info.name), info.name)
        yield lambda index: value[index]
        return
    with _hdf5(path) as file:
        data = _reached(file, info.name)
        if info.hdf5:
            yield lambda index: _complex(data[index])
        else:
            yield lambda index: _complex(data[tuple(reversed(index))]).T


def _loaded(path: Path, name: str) -> Any:
    from scipy.io import loadmat  # noqa: PLC0415 - large

    root = re.split(r"[.{]", name, maxsplit=1)[0]
    return loadmat(path, variable_names=[root], squeeze_me=False, struct_as_record=True)[root]


def _inside(value: Any, name: str) -> NDArray[Any]:
    """Follow ``.field`` and ``{i}`` from a variable of version 5."""
    for field, cell in re.findall(r"\.(\w+)|\{(\d+)\}", name):
        value = value[field].flat[0] if field else value.ravel(order="F")[int(cell) - 1]
    return np.asarray(value)


def _listed_v5(path: Path) -> list[ArrayInfo]:
    from scipy.io import whosmat  # noqa: PLC0415 - large

    found: list[ArrayInfo] = []
    for name, shape, kind in whosmat(path):
        if kind in ("cell", "struct"):
            found += _walked_v5(_loaded(path, name), name, 0)
        else:
            found.append(ArrayInfo(name, tuple(shape), _V5_TYPES.get(kind, kind)))
    return found[:_MOST]


def _walked_v5(value: Any, name: str, depth: int) -> Iterator[ArrayInfo]:
    array = np.asarray(value)
    if array.dtype.names and array.size == 1 and depth < _DEEPEST:
        for field in array.dtype.names:
            yield from _walked_v5(array[field].flat[0], f"{name}.{field}", depth + 1)
    elif array.dtype == object and depth < _DEEPEST:
        for i, item in enumerate(array.ravel(order="F")[:_MOST]):
            yield from _walked_v5(item, f"{name}{{{i + 1}}}", depth + 1)
    else:
        yield ArrayInfo(name, array.shape, "text" if array.dtype.kind in "US" else str(array.dtype))


@contextmanager
def _hdf5(path: Path) -> Iterator[Any]:
    try:
        h5py = import_module("h5py")
    except ImportError as missing:
        raise MissingExtraError(
            "h5py", "matlab", f"{path}: reading HDF5 (Matlab 7.3 files are such)"
        ) from missing
    with h5py.File(path, "r") as file:
        yield file


def _walked(group: Any, prefix: str, matlab: bool, depth: int) -> Iterator[ArrayInfo]:
    """List the data sets below a group; links to other files are passed over."""
    h5py = import_module("h5py")
    for name in list(group)[:_MOST]:
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        full = f"{prefix}.{name}" if prefix else name
        if isinstance(item, h5py.Group):
            if depth < _DEEPEST:
                yield from _walked(item, full, matlab, depth + 1)
        elif isinstance(item, h5py.Dataset):
            yield from _of_dataset(item, full, matlab, depth)


def _of_dataset(data: Any, name: str, matlab: bool, depth: int) -> Iterator[ArrayInfo]:
    h5py = import_module("h5py")
    if data.shape is None or data.external or data.is_virtual:
        return
    if h5py.check_ref_dtype(data.dtype) is not None:
        if depth < _DEEPEST and data.size <= _MOST:
            for i, reference in enumerate(data[()].ravel()):
                target = data.file[reference] if reference else None
                if isinstance(target, h5py.Dataset):
                    yield from _of_dataset(target, f"{name}{{{i + 1}}}", matlab, depth + 1)
        return
    kind = data.dtype
    if kind.names == ("real", "imag"):
        text = "complex128" if kind["real"].itemsize == 8 else "complex64"
    elif data.attrs.get("MATLAB_class") in (b"char", "char"):
        text = "text"
    else:
        text = str(kind.newbyteorder("=")) if kind.kind in "iufc" else "other"
    shape = tuple(int(n) for n in data.shape)
    yield ArrayInfo(name, shape[::-1] if matlab else shape, text, hdf5=not matlab)


def _reached(file: Any, name: str) -> Any:
    """Return the data set of a listed name; every step is checked as in the listing."""
    h5py = import_module("h5py")
    item: Any = file
    for field, cell in re.findall(r"([^.{}]+)|\{(\d+)\}", name):
        if field:
            if not isinstance(item.get(field, getlink=True), h5py.HardLink):
                raise InputError(
                    f"{file.filename} keeps {name} in another file: only its own arrays are read"
                )
            item = item[field]
        else:
            item = file[item[()].ravel()[int(cell) - 1]]
    return item


def _complex(values: Any) -> NDArray[Any]:
    """Return Matlab's pairs (real, imag) as complex numbers; other values unchanged."""
    array = np.asarray(values)
    if array.dtype.names == ("real", "imag"):
        return np.asarray(array["real"] + 1j * array["imag"])
    return array
