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


class SpatialOptions(ctypes.Structure):
    """echospline_spatial_options."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("level", c_int32),
        ("low", c_double * 3),
        ("high", c_double * 3),
        ("tip", c_double),
        ("friction_limit", c_double),
        ("bond", c_double),
        ("tip_stiffness", c_double),
        ("side_stiffness", c_double),
        ("viscosity", c_double),
        ("station_spacing", c_double),
        ("substep", c_double),
        ("dead_band", c_double),
        ("top", c_int32),
        ("clamped", c_uint32),
        ("sliding", c_uint32),
        ("reserved", c_int32),
        ("poisson", c_double),
        ("shear_modulus", c_double),
        ("radius", c_double),
        ("source_radius", c_double),
        ("traction_length", c_double),
        ("sources", c_void_p),
        ("source_count", c_int64),
        ("conditions", c_void_p),
        ("condition_faces", c_void_p),
        ("condition_count", c_int64),
        ("answers", c_void_p),
        ("answer_count", c_int64),
        ("lattice_shape", c_int32 * 3),
        ("lattice_reserved", c_int32),
        ("lattice_spacing", c_double * 3),
        ("lattice_origin", c_double * 3),
    ]


class SpatialStation(ctypes.Structure):
    """echospline_spatial_station."""

    _fields_ = [
        ("index", c_int64),
        ("place", c_double * 3),
        ("axis", c_double * 3),
        ("points", c_double * 12),
        ("weights", c_double * 4),
        ("point_count", c_int32),
        ("reserved", c_int32),
    ]


class SpatialLoad(ctypes.Structure):
    """echospline_spatial_load."""

    _fields_ = [
        ("tip", c_double),
        ("friction", c_double),
        ("side", c_double),
        ("cut", c_double),
        ("force", c_double * 3),
        ("torque", c_double * 3),
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
    "echospline_spatial_defaults": (None, [POINTER(SpatialOptions)]),
    "echospline_spatial_create": (c_int32, [POINTER(SpatialOptions), POINTER(c_void_p)]),
    "echospline_spatial_destroy": (None, [c_void_p]),
    "echospline_spatial_message": (c_char_p, [c_void_p]),
    "echospline_spatial_reset": (c_int32, [c_void_p]),
    "echospline_spatial_advance": (c_int32, [c_void_p, POINTER(_native.Pose)]),
    "echospline_spatial_wanted": (c_int32, [c_void_p, POINTER(SpatialStation)]),
    "echospline_spatial_answer": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_spatial_needle": (c_int32, [c_void_p, POINTER(SpatialLoad)]),
    "echospline_spatial_forces": (c_int32, [c_void_p, c_void_p, c_int64, POINTER(c_int64)]),
    "echospline_spatial_stations": (c_int32, [c_void_p, c_void_p, c_int64, POINTER(c_int64)]),
    "echospline_spatial_field": (c_int32, [c_void_p, POINTER(ForceField)]),
    "echospline_spatial_state_size": (c_int64, [c_void_p]),
    "echospline_spatial_state_save": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_spatial_state_load": (c_int32, [c_void_p, c_void_p, c_int64]),
}


@functools.cache
def library() -> ctypes.CDLL:
    """Return the core's library with the functions of space declared."""
    found = _native.library()
    for name, (result, arguments) in FUNCTIONS.items():
        function = getattr(found, name)
        function.restype, function.argtypes = result, arguments
    return found
