"""Pictures by the native core: a reference image, its deformation by a mesh and the needle's echo, through the C interface alone.

Python objects are translated into the core's structs here; defaults and formulas are the core's.
"""

from __future__ import annotations

import ctypes
import threading
import weakref
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from echospline import _native as core
from echospline.errors import InputError
from echospline.scene import Floats, Pixels, RegularGrid, is_number

Inverse = Literal["auto", "exact"]
Border = float | Literal["transparent"]
Map = NDArray[np.float32]

PIXEL_TYPES = {
    np.dtype(np.uint8): core.PixelType.UINT8,
    np.dtype(np.uint16): core.PixelType.UINT16,
    np.dtype(np.int16): core.PixelType.INT16,
    np.dtype(np.float32): core.PixelType.FLOAT32,
}
"""Types of pixels that the core samples."""
LARGEST = 1e6
"""Grey level beyond which the core takes no border and no white."""
INTERPOLATIONS = {"linear": core.Interpolation.LINEAR, "nearest": core.Interpolation.NEAREST}
METHODS = {"auto": core.Method.METHOD_AUTO, "exact": core.Method.METHOD_EXACT}


def check_border(border: Border, pixels: Pixels) -> None:
    """Refuse a border that pixels of this type cannot hold.

    Raises
    ------
    InputError
        If it is no finite number, or out of the type's range.
    """
    if border == "transparent":
        return
    kind: Any = pixels.dtype
    low, high = (-np.inf, np.inf)
    if np.issubdtype(kind, np.integer):
        low, high = float(np.iinfo(kind).min), float(np.iinfo(kind).max)
    if not is_number(border) or not low <= border <= high:
        span = (
            f"from {low:g} to {high:g}, as pixels of {kind} hold it,"
            if np.isfinite(low)
            else "that is finite"
        )
        raise InputError(f'border must be a number {span} or "transparent"; got {border!r}')


def drawable(pixels: Pixels) -> bool:
    """Return whether the core samples such pixels: grey or red, green and blue, of one of its types."""
    return pixels.dtype in PIXEL_TYPES and (pixels.ndim == 2 or pixels.shape[2] == 3)


@dataclass(frozen=True)
class Report:
    """Check of the present deformation.

    Parameters
    ----------
    residual : float
        Largest distance of a checked pixel from the forward map of its origin, pixels.
    difference : float
        Bound of the distance of interpolated origins from the exact ones, pixels; 0 where all are exact.
    exact_share : float
        Share of the lattice cells of 4 x 4 pixels that are traced pixel by pixel.
    folded_cells : int
        Mesh cells in which the Jacobian determinant is not positive somewhere.
    smallest_jacobian : float
        Over the mesh.
    place : (x, y)
        Where that is, in the reference, mm.
    """

    residual: float
    difference: float
    exact_share: float
    folded_cells: int
    smallest_jacobian: float
    place: tuple[float, float]


class NativePicture:
    """One reference image in the core, with its present deformation.

    Every call is safe from any thread; a sequence of calls belongs to one thread at a time.

    Parameters
    ----------
    pixels : ndarray, shape (rows, columns) or (rows, columns, 3)
        uint8, uint16, int16 or float32; copied.
    image : RegularGrid
        Pixel centres.
    mesh : RegularGrid
        Nodes of the deformation, 2 x 2 or more.
    interpolation : {"linear", "nearest"}
        Between reference pixels.
    border : float or "transparent"
        Value where no tissue comes to lie, or an alpha channel (drawn pictures are RGBA).
    inverse : {"auto", "exact"}
        How origins of pixels are found: interpolated where that is good to 0.1 pixel, or each in the cells of the mesh.
    white : float
        Grey level at which the display is white; 0: the largest of an integer type, or 1.

    Raises
    ------
    InputError
        If the core refuses an option.
    """

    def __init__(
        self,
        pixels: Pixels,
        image: RegularGrid,
        mesh: RegularGrid,
        *,
        interpolation: Literal["linear", "nearest"],
        border: Border,
        inverse: Inverse,
        white: float,
    ) -> None:
        self._core = core.library()
        self._lock = threading.Lock()
        o = core.PictureOptions(struct_size=ctypes.sizeof(core.PictureOptions))
        o.pixel_type, o.channels = PIXEL_TYPES[pixels.dtype], 1 if pixels.ndim == 2 else pixels.shape[2]
        o.columns, o.rows = image.shape
        o.interpolation, o.method, o.white = INTERPOLATIONS[interpolation], METHODS[inverse], white
        transparent = border == "transparent"
        o.border = core.Border.BORDER_TRANSPARENT if transparent else core.Border.BORDER_VALUE
        o.border_value = 0.0 if transparent else border
        for d in (0, 1):
            o.spacing[d], o.origin[d] = image.spacing[d], image.origin[d]
            o.mesh_shape[d], o.mesh_spacing[d], o.mesh_origin[d] = (
                mesh.shape[d],
                mesh.spacing[d],
                mesh.origin[d],
            )
        self._shape = (*image.shape[::-1], 4) if transparent else pixels.shape
        self._dtype = pixels.dtype
        self._picture = ctypes.c_void_p()
        self._report = core.PictureReport(struct_size=ctypes.sizeof(core.PictureReport))
        source = np.ascontiguousarray(pixels)
        status = self._core.echospline_picture_create(
            ctypes.byref(o), source.ctypes.data, ctypes.byref(self._picture)
        )
        weakref.finalize(self, self._core.echospline_picture_destroy, self._picture)
        self._check(status)

    @property
    def level(self) -> str:
        """Name of the processor level in use."""
        name: bytes = self._core.echospline_level_name(self._core.echospline_picture_level(self._picture))
        return name.decode()

    def reference(self, pixels: Pixels) -> None:
        """Replace the reference by pixels of the same shape and type."""
        source = np.ascontiguousarray(pixels, dtype=self._dtype)
        with self._lock:
            self._check(
                self._core.echospline_picture_reference(self._picture, source.ctypes.data, source.nbytes)
            )

    def deform(self, displacement: Floats) -> None:
        """Deform by the displacement of the mesh nodes, shape (n, 2), mm."""
        u = np.ascontiguousarray(displacement, dtype=np.float64)
        with self._lock:
            self._check(self._core.echospline_picture_deform(self._picture, u.ctypes.data, u.size))

    def draw(self, needle: core.Needle | None) -> Pixels:
        """Return the deformed picture, with a needle where one is given."""
        out = np.empty(self._shape, dtype=self._dtype)
        pointer = None if needle is None else ctypes.byref(needle)
        with self._lock:
            self._check(
                self._core.echospline_picture_draw(self._picture, pointer, out.ctypes.data, out.nbytes)
            )
        return out

    def inverse(self) -> tuple[Map, Map]:
        """Return each pixel's origin as column and row of the reference, exactly, shape (rows, columns); NaN without tissue."""
        x, y = np.empty(self._shape[:2], np.float32), np.empty(self._shape[:2], np.float32)
        with self._lock:
            self._check(
                self._core.echospline_picture_inverse(self._picture, x.ctypes.data, y.ctypes.data, x.size)
            )
        return x, y

    def report(self) -> Report:
        """Check the inverse against the forward map, and find folds."""
        r = self._report
        with self._lock:
            self._check(self._core.echospline_picture_check(self._picture, ctypes.byref(r)))
            place = (r.place[0], r.place[1])
            return Report(r.residual, r.difference, r.exact_share, r.folded_cells, r.smallest_jacobian, place)

    def echo(self, needle: core.Needle, points: Floats) -> tuple[Floats, Floats]:
        """Return the echo's power relative to white and the share of the tissue's power that passes, at points (n, 2) mm."""
        p = np.ascontiguousarray(points, dtype=np.float64)
        power, passed = np.empty(len(p)), np.empty(len(p))
        with self._lock:
            self._check(
                self._core.echospline_picture_echo(
                    self._picture,
                    ctypes.byref(needle),
                    p.ctypes.data,
                    len(p),
                    power.ctypes.data,
                    passed.ctypes.data,
                )
            )
        return power, passed

    def _check(self, status: int) -> None:
        if status != core.Status.OK:
            core.check(status, self._core.echospline_picture_message, self._picture)


def blank(image: RegularGrid, mesh: RegularGrid, inverse: Inverse = "exact") -> NativePicture:
    """Make a black picture for what needs no pixels: inverse maps, folds, echoes at points."""
    pixels: Any = np.zeros(image.shape[::-1], np.uint8)
    return NativePicture(pixels, image, mesh, interpolation="nearest", border=0.0, inverse=inverse, white=0.0)
