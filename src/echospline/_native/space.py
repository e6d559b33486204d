"""The binding of core/include/echospline/space.h: volumes, slices and fields of forces, as `_native` binds echospline.h."""

from __future__ import annotations

import ctypes
import functools
from ctypes import POINTER, c_char_p, c_double, c_int32, c_int64, c_uint32, c_void_p
from enum import IntEnum
from typing import Any

from echospline import _native


class SpaceTop(IntEnum):
    """The surface of elastic tissue in space."""

    TOP_NONE = 0
    TOP_FREE = 1
    TOP_SLIDING = 2


class VolumeOptions(ctypes.Structure):
    """echospline_volume_options."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("level", c_int32),
        ("shape", c_int32 * 3),
        ("reserved", c_int32),
        ("spacing", c_double * 3),
        ("origin", c_double * 3),
    ]


class Slice(ctypes.Structure):
    """echospline_slice."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("columns", c_int32),
        ("rows", c_int32),
        ("step", c_int32),
        ("normal", c_double * 3),
        ("spread", c_void_p),
        ("mask", c_void_p),
        ("background", c_int32),
        ("reserved", c_int32),
    ]


class ForceField(ctypes.Structure):
    """echospline_force_field."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("level", c_int32),
        ("top", c_int32),
        ("reserved", c_int32),
        ("poisson", c_double),
        ("shear_modulus", c_double),
        ("places", c_void_p),
        ("forces", c_void_p),
        ("radii", c_void_p),
        ("force_count", c_int64),
        ("lattice_shape", c_int32 * 3),
        ("lattice_reserved", c_int32),
        ("lattice_spacing", c_double * 3),
        ("lattice_origin", c_double * 3),
        ("lattice", c_void_p),
    ]


class TraceReport(ctypes.Structure):
    """echospline_trace_report."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("reserved", c_int32),
        ("residual", c_double),
        ("folded", c_int64),
        ("jacobian", c_double),
        ("place", c_double * 3),
    ]


FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {  # name: result, arguments; handles and arrays are addresses
    "echospline_volume_create": (c_int32, [POINTER(VolumeOptions), c_void_p, POINTER(c_void_p)]),
    "echospline_volume_destroy": (None, [c_void_p]),
    "echospline_volume_message": (c_char_p, [c_void_p]),
    "echospline_volume_slice": (
        c_int32,
        [c_void_p, POINTER(Slice), c_void_p, c_int64, c_void_p, c_int64, POINTER(c_int64)],
    ),
    "echospline_volume_trace": (
        c_int32,
        [
            c_void_p,
            POINTER(Slice),
            POINTER(ForceField),
            c_void_p,
            c_int64,
            c_void_p,
            c_double,
            c_void_p,
            POINTER(TraceReport),
        ],
    ),
    "echospline_volume_trace_tissue": (
        c_int32,
        [
            c_void_p,
            POINTER(Slice),
            c_void_p,
            c_void_p,
            c_int64,
            c_void_p,
            c_double,
            c_void_p,
            POINTER(TraceReport),
        ],
    ),
    "echospline_force_field_at": (c_int32, [POINTER(ForceField), c_void_p, c_int64, c_void_p]),
}


@functools.cache
def library() -> ctypes.CDLL:
    """Return the core's library with the functions of space declared."""
    found = _native.library()
    for name, (result, arguments) in FUNCTIONS.items():
        function = getattr(found, name)
        function.restype, function.argtypes = result, arguments
    return found
