"""The binding of core/include/echospline/green.h: tissue in the plane that answers forces, as `_native` binds echospline.h."""

from __future__ import annotations

import ctypes
import functools
from ctypes import POINTER, c_char_p, c_double, c_int32, c_int64, c_uint32, c_void_p
from enum import IntEnum
from typing import Any

from echospline import _native


class GreenMethod(IntEnum):
    """How tissue is solved."""

    GREEN_BOUNDARY = 0
    GREEN_SOLVE = 1


class GreenCondition(IntEnum):
    """Kind of a condition on an edge or an interface."""

    CONDITION_CLAMPED = 0
    CONDITION_SLIDING_X = 1
    CONDITION_SLIDING_Y = 2
    CONDITION_FREE = 3
    CONDITION_INTERFACE = 4


class GreenOptions(ctypes.Structure):
    """echospline_green_options."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("level", c_int32),
        ("method", c_int32),
        ("clamped", c_uint32),
        ("sliding", c_uint32),
        ("shape", c_int32 * 2),
        ("reserved", c_int32),
        ("spacing", c_double * 2),
        ("origin", c_double * 2),
        ("radius", c_double),
        ("weight", c_double),
        ("pin_weight", c_double),
        ("pin_radius", c_double),
        ("lattice", c_double),
        ("bodies", c_void_p),
        ("depths", c_void_p),
        ("circles", c_void_p),
        ("sources", c_void_p),
        ("source_counts", c_void_p),
        ("conditions", c_void_p),
        ("sides", c_void_p),
        ("pins", c_void_p),
        ("order", c_void_p),
        ("right", c_void_p),
        ("left", c_void_p),
        ("body_count", c_int64),
        ("band_count", c_int64),
        ("source_count", c_int64),
        ("condition_count", c_int64),
        ("pin_count", c_int64),
        ("rank", c_int64),
        ("lines_x", c_void_p),
        ("lines_y", c_void_p),
        ("moduli", c_void_p),
        ("held", c_void_p),
        ("line_x_count", c_int64),
        ("line_y_count", c_int64),
        ("triangle_count", c_int64),
        ("held_count", c_int64),
    ]


FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {  # name: result, arguments; handles and arrays are addresses
    "echospline_green_defaults": (None, [POINTER(GreenOptions)]),
    "echospline_green_create": (c_int32, [POINTER(GreenOptions), POINTER(c_void_p)]),
    "echospline_green_destroy": (None, [c_void_p]),
    "echospline_green_message": (c_char_p, [c_void_p]),
    "echospline_green_answer": (
        c_int32,
        [
            c_void_p,
            c_void_p,
            c_int64,
            c_void_p,
            c_int64,
            c_void_p,
            c_int64,
            c_void_p,
            c_int64,
            c_void_p,
            c_int64,
        ],
    ),
    "echospline_forced_attach": (c_int32, [c_void_p, c_void_p]),
    "echospline_forced_displacement_at": (c_int32, [c_void_p, c_void_p, c_int64, c_void_p]),
}


@functools.cache
def library() -> ctypes.CDLL:
    """Return the core's library with the functions of Green's function declared."""
    found = _native.library()
    for name, (result, arguments) in FUNCTIONS.items():
        function = getattr(found, name)
        function.restype, function.argtypes = result, arguments
    return found
