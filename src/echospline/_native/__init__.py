"""The native core and its one binding: the C interface of core/include/echospline/echospline.h by ctypes, and nothing else.

Nothing is loaded at import; `library()` loads once. Calls release the interpreter lock, but for the shortest. Structs, enums and functions have
the header's names without the prefix, no defaults and no logic; arrays are passed as addresses. Tests hold all of it to the header.
"""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_double, c_int32, c_int64, c_uint32, c_void_p
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import Any

from echospline.errors import InputError, SolverError

VERSION = (0, 1, 0)  # of the header that this file was written for
FILE = {"win32": "echospline.dll", "darwin": "libechospline.dylib"}.get(sys.platform, "libechospline.so")


class Status(IntEnum):
    """How a function ended."""

    OK = 0
    NULL_POINTER = 1
    WRONG_SIZE = 2
    WRONG_VALUE = 3
    OUT_OF_MEMORY = 4
    NOT_HELD = 5
    NOT_SOLVED = 6
    WRONG_STATE = 7
    FAILED_HANDLE = 8
    NEEDS_STATION = 9


class Level(IntEnum):
    """Processor level."""

    LEVEL_BEST = 0
    LEVEL_BASELINE = 1
    LEVEL_AVX2 = 2
    LEVEL_AVX512 = 3
    LEVEL_NEON = 4
    LEVEL_SIMD128 = 5


class Kernel(IntEnum):
    """Kernel of the field."""

    THIN_PLATE = 0
    ELASTIC = 1


class Precision(IntEnum):
    """Precision of the field."""

    SINGLE = 0
    DOUBLE = 1


class Tip(IntEnum):
    """Landmark of the tip."""

    TIP_POINT = 0
    TIP_NODE = 1


class Loading(IntEnum):
    """How landmarks take up their displacement."""

    FOLLOW = 0
    IMMEDIATE = 1
    STICK = 2


class Plane(IntEnum):
    """Elastic kernel in the plane."""

    PLANE_STRESS = 0
    PLANE_STRAIN = 1


class Edge(IntFlag):
    """Clamped edges or faces."""

    LEFT = 1
    RIGHT = 2
    TOP = 4
    BOTTOM = 8
    FRONT = 16
    BACK = 32


class LandmarkKind(IntEnum):
    """Kind of a landmark that moves."""

    CONTACT = 0
    LEAVING = 1
    TIP = 2
    TIP_LEFT = 3


class PixelType(IntEnum):
    """Type of a picture's pixels."""

    UINT8 = 0
    UINT16 = 1
    INT16 = 2
    FLOAT32 = 3


class Interpolation(IntEnum):
    """How a picture reads its reference between pixels."""

    LINEAR = 0
    NEAREST = 1


class Border(IntEnum):
    """What is drawn where no tissue is."""

    BORDER_VALUE = 0
    BORDER_TRANSPARENT = 1


class Method(IntEnum):
    """How a picture finds where pixels come from."""

    METHOD_AUTO = 0
    METHOD_EXACT = 1
    METHOD_PULL = 2


class NeedlePart(IntFlag):
    """Parts of a needle's echo."""

    SHAFT = 1
    BEVEL = 2
    TAIL = 4
    SHADOW = 8


class SceneOptions(ctypes.Structure):
    """echospline_scene_options."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("dimension", c_int32),
        ("kernel", c_int32),
        ("precision", c_int32),
        ("tip", c_int32),
        ("loading", c_int32),
        ("plane", c_int32),
        ("clamped", c_uint32),
        ("level", c_int32),
        ("shape", c_int32 * 3),
        ("spacing", c_double * 3),
        ("origin", c_double * 3),
        ("sigma", c_double),
        ("delta", c_double),
        ("alpha1", c_double),
        ("alpha2", c_double),
        ("alpha3", c_double),
        ("length", c_double),
        ("drag", c_double),
        ("contact_spacing", c_double),
        ("anchor_spacing", c_double),
        ("poisson", c_double),
        ("radius", c_double),
        ("clamped_points", c_void_p),
        ("clamped_point_count", c_int64),
        ("stiffness", c_void_p),
        ("stiffness_count", c_int64),
        ("contact_room", c_int64),
        ("sliding", c_uint32),
        ("reserved", c_uint32),
        ("friction_speed", c_double),
    ]


class Pose(ctypes.Structure):
    """echospline_pose."""

    _fields_ = [("entry", c_double * 3), ("tip", c_double * 3), ("speed", c_double), ("dt", c_double)]


class Command(ctypes.Structure):
    """echospline_command."""

    _fields_ = [("entry", c_double * 3), ("tip", c_double * 3), ("lag", c_double), ("fastest", c_double)]


class Landmark(ctypes.Structure):
    """echospline_landmark."""

    _fields_ = [
        ("place", c_double * 3),
        ("displacement", c_double * 3),
        ("grip", c_double * 3),
        ("along", c_double),
        ("node", c_int64),
        ("kind", c_int32),
        ("reserved", c_int32),
    ]


class Statistics(ctypes.Structure):
    """echospline_statistics."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("reserved", c_int32),
        ("steps", c_int64),
        ("joined", c_int64),
        ("left", c_int64),
        ("rebuilt", c_int64),
        ("held_back", c_int64),
        ("allocations", c_int64),
        ("residual", c_double),
    ]


class PictureOptions(ctypes.Structure):
    """echospline_picture_options."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("pixel_type", c_int32),
        ("channels", c_int32),
        ("interpolation", c_int32),
        ("border", c_int32),
        ("method", c_int32),
        ("level", c_int32),
        ("columns", c_int32),
        ("rows", c_int32),
        ("mesh_shape", c_int32 * 2),
        ("reserved", c_int32),
        ("spacing", c_double * 2),
        ("origin", c_double * 2),
        ("mesh_spacing", c_double * 2),
        ("mesh_origin", c_double * 2),
        ("border_value", c_double),
        ("white", c_double),
    ]


class Needle(ctypes.Structure):
    """echospline_needle."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("parts", c_uint32),
        ("seed", c_uint32),
        ("curved", c_int32),
        ("entry", c_double * 3),
        ("tip", c_double * 3),
        ("apex", c_double * 2),
        ("diameter", c_double),
        ("lateral", c_double),
        ("axial", c_double),
        ("elevation", c_double),
        ("elevation_depth", c_double),
        ("element_height", c_double),
        ("f_number", c_double),
        ("dynamic_range", c_double),
        ("specular", c_double),
        ("lobe", c_double),
        ("lobe_elevation", c_double),
        ("steering", c_double),
        ("roughness", c_double),
        ("rolloff", c_double),
        ("wobble", c_double),
        ("patches", c_double),
        ("bevel", c_double),
        ("ring_down", c_double),
        ("ring_down_loss", c_double),
        ("opacity", c_double),
    ]


class PictureReport(ctypes.Structure):
    """echospline_picture_report."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("method", c_int32),
        ("residual", c_double),
        ("difference", c_double),
        ("exact_share", c_double),
        ("folded_cells", c_int64),
        ("smallest_jacobian", c_double),
        ("place", c_double * 2),
    ]


class Look(ctypes.Structure):
    """echospline_look."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("level", c_int32),
        ("invert", c_int32),
        ("flip", c_int32),
        ("gain", c_double),
        ("recorded_range", c_double),
        ("dynamic_range", c_double),
        ("depth_gain_count", c_int32),
        ("reserved", c_int32),
        ("depth_gains", c_double * 8),
    ]


class ForcedOptions(ctypes.Structure):
    """echospline_forced_options."""

    _fields_ = [
        ("struct_size", c_uint32),
        ("level", c_int32),
        ("node_count", c_int64),
        ("low", c_double * 2),
        ("high", c_double * 2),
        ("tip", c_double),
        ("friction_limit", c_double),
        ("bond", c_double),
        ("tip_stiffness", c_double),
        ("side_stiffness", c_double),
        ("viscosity", c_double),
        ("station_spacing", c_double),
        ("substep", c_double),
        ("dead_band", c_double),
    ]


class Station(ctypes.Structure):
    """echospline_station."""

    _fields_ = [
        ("index", c_int64),
        ("place", c_double * 2),
        ("axis", c_double * 2),
        ("points", c_double * 8),
        ("weights", c_double * 4),
        ("point_count", c_int32),
        ("reserved", c_int32),
    ]


class NeedleLoad(ctypes.Structure):
    """echospline_needle_load."""

    _fields_ = [
        ("tip", c_double),
        ("friction", c_double),
        ("side", c_double),
        ("torque", c_double),
        ("cut", c_double),
    ]


FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {  # name: result, arguments; handles and arrays are addresses
    "echospline_status_text": (c_char_p, [c_int32]),
    "echospline_version": (c_uint32, []),
    "echospline_level_best": (c_int32, []),
    "echospline_level_available": (c_int32, [c_int32]),
    "echospline_level_name": (c_char_p, [c_int32]),
    "echospline_scene_defaults": (None, [POINTER(SceneOptions)]),
    "echospline_scene_create": (c_int32, [POINTER(SceneOptions), POINTER(c_void_p)]),
    "echospline_scene_destroy": (None, [c_void_p]),
    "echospline_scene_message": (c_char_p, [c_void_p]),
    "echospline_scene_level": (c_int32, [c_void_p]),
    "echospline_scene_node_count": (c_int64, [c_void_p]),
    "echospline_scene_anchor_count": (c_int64, [c_void_p]),
    "echospline_scene_source_count": (c_int64, [c_void_p]),
    "echospline_scene_anchors": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_scene_sources": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_follow": (c_int32, [POINTER(Pose), POINTER(Command), POINTER(Pose)]),
    "echospline_tissue_create": (c_int32, [c_void_p, POINTER(c_void_p)]),
    "echospline_tissue_destroy": (None, [c_void_p]),
    "echospline_tissue_message": (c_char_p, [c_void_p]),
    "echospline_tissue_reset": (c_int32, [c_void_p]),
    "echospline_advance": (c_int32, [c_void_p, POINTER(Pose)]),
    "echospline_displacement": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_displacement_single": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_displacement_at": (c_int32, [c_void_p, c_void_p, c_int64, c_void_p]),
    "echospline_landmarks": (c_int32, [c_void_p, c_void_p, c_int64, POINTER(c_int64)]),
    "echospline_tissue_statistics": (c_int32, [c_void_p, POINTER(Statistics)]),
    "echospline_state_size": (c_int64, [c_void_p]),
    "echospline_state_save": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_state_load": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_picture_defaults": (None, [POINTER(PictureOptions)]),
    "echospline_needle_defaults": (None, [POINTER(Needle)]),
    "echospline_picture_create": (c_int32, [POINTER(PictureOptions), c_void_p, POINTER(c_void_p)]),
    "echospline_picture_destroy": (None, [c_void_p]),
    "echospline_picture_message": (c_char_p, [c_void_p]),
    "echospline_picture_level": (c_int32, [c_void_p]),
    "echospline_picture_size": (c_int64, [c_void_p]),
    "echospline_picture_reference": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_picture_deform": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_picture_deform_single": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_picture_follow": (c_int32, [c_void_p, c_void_p]),
    "echospline_picture_draw": (c_int32, [c_void_p, POINTER(Needle), c_void_p, c_int64]),
    "echospline_picture_inverse": (c_int32, [c_void_p, c_void_p, c_void_p, c_int64]),
    "echospline_picture_check": (c_int32, [c_void_p, POINTER(PictureReport)]),
    "echospline_picture_echo": (c_int32, [c_void_p, POINTER(Needle), c_void_p, c_int64, c_void_p, c_void_p]),
    "echospline_look_defaults": (None, [POINTER(Look)]),
    "echospline_shade": (c_int32, [POINTER(Look), c_void_p, c_int32, c_int32, c_void_p, c_int64]),
    "echospline_forced_defaults": (None, [POINTER(ForcedOptions)]),
    "echospline_forced_create": (c_int32, [POINTER(ForcedOptions), POINTER(c_void_p)]),
    "echospline_forced_destroy": (None, [c_void_p]),
    "echospline_forced_message": (c_char_p, [c_void_p]),
    "echospline_forced_reset": (c_int32, [c_void_p]),
    "echospline_forced_advance": (c_int32, [c_void_p, POINTER(Pose)]),
    "echospline_forced_wanted": (c_int32, [c_void_p, POINTER(Station)]),
    "echospline_forced_stations": (c_int32, [c_void_p, c_void_p, c_int64, POINTER(c_int64)]),
    "echospline_forced_answer": (c_int32, [c_void_p, c_void_p, c_int64, c_void_p, c_int64]),
    "echospline_forced_load": (c_int32, [c_void_p, POINTER(NeedleLoad)]),
    "echospline_forced_forces": (c_int32, [c_void_p, c_void_p, c_int64, POINTER(c_int64)]),
    "echospline_forced_displacement": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_forced_displacement_single": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_forced_state_size": (c_int64, [c_void_p]),
    "echospline_forced_state_save": (c_int32, [c_void_p, c_void_p, c_int64]),
    "echospline_forced_state_load": (c_int32, [c_void_p, c_void_p, c_int64]),
}


SHORT = (  # calls of a microsecond: to release the interpreter lock and fetch it again would cost more than they do
    "echospline_state_size",
    "echospline_state_save",
    "echospline_tissue_statistics",
    "echospline_displacement",
    "echospline_follow",
    "echospline_forced_wanted",
    "echospline_forced_load",
    "echospline_forced_forces",
    "echospline_forced_state_size",
    "echospline_forced_state_save",
)


class CoreError(ImportError):
    """The core's library is missing, or is another version's; the message says what to do."""


def load(path: Path) -> ctypes.CDLL:
    """Load a library of the core and declare its functions."""
    expected = ".".join(map(str, VERSION))
    if not path.exists():
        raise CoreError(f"expected the core's library at {path}; it is not there; run: pip install .")
    try:
        found = ctypes.CDLL(str(path))
        found.echospline_version.restype, found.echospline_version.argtypes = c_uint32, []
        number = int(found.echospline_version())
    except (OSError, AttributeError) as error:
        raise CoreError(
            f"expected the core's library {expected} in {path}; it cannot be loaded: {error}; run: pip install ."
        ) from error
    if (number >> 16, number >> 8 & 255, number & 255) != VERSION:
        came = f"{number >> 16}.{number >> 8 & 255}.{number & 255}"
        raise CoreError(
            f"expected version {expected} of the core's library {path}; got {came}; run: pip install ."
        )
    keeping_the_lock = ctypes.PyDLL(str(path))
    for name, (result, arguments) in FUNCTIONS.items():
        function = getattr(keeping_the_lock if name in SHORT else found, name)
        function.restype, function.argtypes = result, arguments
        setattr(found, name, function)
    return found


@functools.cache
def library() -> ctypes.CDLL:
    """Return the core's library; loaded at the first call."""
    return load(Path(__file__).parent / FILE)


def check(status: int, message: Callable[[Any], bytes], handle: Any) -> None:
    """Raise the error of a status that is not OK, with the handle's message."""
    if status == Status.OK:
        return
    text = message(handle).decode()
    if status == Status.OUT_OF_MEMORY:
        raise MemoryError(text)
    if status in (Status.NOT_HELD, Status.NOT_SOLVED):
        raise SolverError(text)
    raise InputError(text)
