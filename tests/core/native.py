"""Pictures of the compiled core for tests and benchmarks, through the package's binding."""

from __future__ import annotations

import ctypes as c
import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline import _native

HERE = Path(__file__).resolve().parents[2]
OK, NULL_POINTER, WRONG_SIZE, WRONG_VALUE, FAILED_HANDLE = 0, 1, 2, 3, 8
AUTO, EXACT, PULL = 0, 1, 2
TYPES = {"uint8": 0, "uint16": 1, "int16": 2, "float32": 3}
SHAFT, BEVEL, TAIL, SHADOW = 1, 2, 4, 8


def library_path() -> Path | None:
    """Return where the library is: ECHOSPLINE_LIBRARY, or the package; None without one."""
    given = os.environ.get("ECHOSPLINE_LIBRARY")
    if given:
        return Path(given)
    names = ("libechospline.so", "libechospline.dylib", "echospline.dll")
    found = [p for name in names for p in (HERE / "src/echospline/_native").glob(f"**/{name}")]
    return found[0] if found else None


PictureOptions, Needle, Report = _native.PictureOptions, _native.Needle, _native.PictureReport
NUMBERS = [name for name, kind in Needle._fields_ if kind is c.c_double]


@cache
def library() -> Any:
    """Load the library once, as the package declares it."""
    return _native.load(path) if (path := library_path()) else _native.library()


def levels() -> list[int]:
    """Return the processor levels that can be used here."""
    return [level for level in range(1, 6) if library().echospline_level_available(level)]


def fill(target: Any, values: dict[str, Any]) -> Any:
    """Set fields of a struct; sequences fill arrays from their start."""
    for name, value in values.items():
        if np.ndim(value):
            for k, v in enumerate(value):
                getattr(target, name)[k] = v
        else:
            setattr(target, name, value)
    return target


def needle(entry: Any, tip: Any, **values: Any) -> Any:
    """Return a needle with the default looks."""
    n = Needle(struct_size=c.sizeof(Needle))
    library().echospline_needle_defaults(c.byref(n))
    return fill(n, {"entry": entry, "tip": tip, **values})


def options(columns: int, rows: int, mesh_shape: tuple[int, int], **values: Any) -> Any:
    """Return options of a picture whose mesh covers its pixel centres."""
    o = PictureOptions(struct_size=c.sizeof(PictureOptions))
    library().echospline_picture_defaults(c.byref(o))
    spacing = values.get("spacing", (0.2, 0.2))
    cover = [
        max(n - 1, 1) * d / (m - 1) for n, m, d in zip((columns, rows), mesh_shape, spacing, strict=True)
    ]
    first = {
        "columns": columns,
        "rows": rows,
        "mesh_shape": mesh_shape,
        "spacing": spacing,
        "mesh_spacing": cover,
    }
    return fill(o, {**first, **values})


class Picture:
    """A picture handle; failures raise ValueError with the handle's message."""

    def __init__(self, pixels: NDArray[Any], mesh_shape: tuple[int, int], **values: Any) -> None:
        self.pixels = np.ascontiguousarray(pixels)
        rows, columns = self.shape = pixels.shape[:2]
        kinds = {"pixel_type": TYPES[pixels.dtype.name], "channels": 3 if pixels.ndim == 3 else 1}
        self.options = options(columns, rows, mesh_shape, **kinds, **values)
        self.handle = c.c_void_p()
        self.transparent = self.options.border == 1
        self.expect(
            library().echospline_picture_create(
                c.byref(self.options), self.pixels.ctypes.data, c.byref(self.handle)
            )
        )

    def __del__(self) -> None:
        library().echospline_picture_destroy(self.handle)

    def expect(self, status: int) -> None:
        """Raise unless a call went well."""
        if status:
            raise ValueError(self.message)

    @property
    def message(self) -> str:
        """What the handle last complained about."""
        text: bytes = library().echospline_picture_message(self.handle)
        return text.decode()

    @property
    def nodes(self) -> NDArray[np.float64]:
        """Mesh nodes (n, 2), mm."""
        o = self.options
        x, y = (o.mesh_origin[k] + np.arange(o.mesh_shape[k]) * o.mesh_spacing[k] for k in (0, 1))
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def deform(self, displacement: NDArray[Any]) -> Picture:
        """Deform by (n, 2) mm."""
        single = displacement.dtype == np.float32
        u = np.ascontiguousarray(displacement, np.float32 if single else np.float64)
        call = library().echospline_picture_deform_single if single else library().echospline_picture_deform
        self.expect(call(self.handle, u.ctypes.data, u.size))
        return self

    def draw(self, needle: Any = None) -> NDArray[Any]:
        """Return the picture."""
        extra = (4,) if self.transparent else self.pixels.shape[2:]
        out = np.empty((*self.shape, *extra), self.pixels.dtype)
        pointer = None if needle is None else c.byref(needle)
        self.expect(library().echospline_picture_draw(self.handle, pointer, out.ctypes.data, out.nbytes))
        return out

    def inverse(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the exact reference positions."""
        x, y = np.empty(self.shape, np.float32), np.empty(self.shape, np.float32)
        self.expect(library().echospline_picture_inverse(self.handle, x.ctypes.data, y.ctypes.data, x.size))
        return x, y

    def check(self) -> Any:
        """Return the report."""
        report = Report(struct_size=c.sizeof(Report))
        self.expect(library().echospline_picture_check(self.handle, c.byref(report)))
        return report

    def echo(self, needle: Any, points: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return power and transmission at points."""
        p = np.ascontiguousarray(points, np.float64).reshape(-1, 2)
        power, passed = np.empty(len(p)), np.empty(len(p))
        status = library().echospline_picture_echo(
            self.handle, c.byref(needle), p.ctypes.data, len(p), power.ctypes.data, passed.ctypes.data
        )
        self.expect(status)
        return power, passed
