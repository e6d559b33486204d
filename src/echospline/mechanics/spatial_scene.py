"""Tissue in space that answers forces from tables, with the needle's law, as every host gives it to the core; and its steps here."""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline import _native as core
from echospline._native import space
from echospline.errors import InputError
from echospline.mechanics.forced_scene import LAW
from echospline.mechanics.forces import NeedleForces
from echospline.mechanics.space_response import SpaceResponse
from echospline.scene import Floats, SpatialPose, as_points

TABLES: dict[str, tuple[type[np.generic], int]] = {
    "sources": (np.float64, 3), "conditions": (np.float64, 3), "condition_faces": (np.uint32, 1), "answers": (np.float64, 1),
}  # fmt: skip
"""Type of every table, and numbers per entry."""
NUMBERS = {
    "low": 3, "high": 3, "top": 1, "clamped": 1, "sliding": 1, "poisson": 1, "shear_modulus": 1, "radius": 1, "source_radius": 1,
    "traction_length": 1, "lattice_shape": 3, "lattice_spacing": 3, "lattice_origin": 3,
}  # fmt: skip
"""Members of ``echospline_spatial_options`` that say how the tissue answers, and how many numbers each is."""


@dataclass(frozen=True, eq=False)
class SpatialForcedScene:
    """A forced tissue in space as every host gives it to the core; in JavaScript ``core.spatial({...options, ...response, ...arrays})``.

    Parameters
    ----------
    options : mapping of str to float
        The law: members of ``echospline_spatial_options``; those that are missing are the core's defaults.
    response : mapping
        How the tissue answers: members that are numbers or three of them.
    arrays : mapping of str to ndarray
        Its tables, flat or by entries; counts follow from them.

    Raises
    ------
    InputError
        If a name is unknown or missing, a value has another form than its member, or tables do not fit together.
    """

    options: Mapping[str, float]
    response: Mapping[str, int | float | Sequence[int] | Sequence[float]]
    arrays: Mapping[str, NDArray[Any]]

    def __post_init__(self) -> None:
        for name, option in self.options.items():
            if name not in LAW or isinstance(option, bool) or not isinstance(option, int | float):
                raise InputError(
                    f"options of a forced tissue are numbers named {', '.join(LAW)}; got {name} = {option!r}"
                )
        for what, given, known in (("numbers", self.response, NUMBERS), ("tables", self.arrays, TABLES)):
            if set(given) != set(known):
                raise InputError(f"{what} of tissue in space are {', '.join(known)}; got {', '.join(given)}")
        for name, count in NUMBERS.items():
            value = self.response[name]
            if (len(value) if isinstance(value, Sequence) else 1) != count:
                raise InputError(f"{name} of tissue in space needs {count} numbers; got {value!r}")
        size = {name: array.size for name, array in self.arrays.items()}
        points = size["condition_faces"]
        rows, rest = divmod(size["answers"], max(3 * points, 1))
        fit = size["conditions"] == 3 * points and size["sources"] % 3 == 0 and rest == 0
        if not fit or rows - size["sources"] not in (0, 3, 6):
            raise InputError(f"tables of tissue in space do not fit each other; they have {size} numbers")

    @classmethod
    def of(cls, response: SpaceResponse, law: NeedleForces) -> SpatialForcedScene:
        """Return the scene of a response and a law, those of a `SpatialForceModel`."""
        tables = response.tables()
        arrays = {name: np.asarray(tables[name]) for name in TABLES}
        numbers = {name: np.asarray(tables[name]).tolist() for name in NUMBERS}
        return cls({name: float(getattr(law, name)) for name in LAW}, numbers, arrays)


class SpatialStep:
    """Steps of such a scene in the core alone, for any state, from any thread. A state is the core's own, as bytes.

    Parameters
    ----------
    scene : SpatialForcedScene
        What is given.

    Raises
    ------
    InputError, SolverError
        If the core refuses it.
    """

    def __init__(self, scene: SpatialForcedScene) -> None:
        self.scene = scene
        self._core, self._handle = space.library(), ctypes.c_void_p()
        self._lock = threading.Lock()
        o = space.SpatialOptions(struct_size=ctypes.sizeof(space.SpatialOptions))
        self._core.echospline_spatial_defaults(ctypes.byref(o))
        try:
            for name, value in {**scene.options, **scene.response}.items():
                if isinstance(getattr(o, name), ctypes.Array):
                    getattr(o, name)[:] = tuple(np.atleast_1d(value).tolist())
                else:
                    setattr(o, name, value)
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"{name} of tissue in space has another form than the core's; got {value!r}"
            ) from None
        kept = {
            name: np.ascontiguousarray(scene.arrays[name].ravel(), dtype=kind)
            for name, (kind, _) in TABLES.items()
        }
        for name, array in kept.items():
            setattr(o, name, array.ctypes.data)
        o.source_count, o.condition_count = kept["sources"].size // 3, kept["condition_faces"].size
        o.answer_count = kept["answers"].size
        status = self._core.echospline_spatial_create(ctypes.byref(o), ctypes.byref(self._handle))
        weakref.finalize(self, self._core.echospline_spatial_destroy, self._handle)
        self._check(status)
        self._current: bytes | None = None
        self._rest = self._saved()

    def rest(self) -> bytes:
        """State of tissue that no needle has touched."""
        return self._rest

    def advance(self, state: bytes, pose: SpatialPose, dt: float) -> bytes:
        """State after the needle has moved to ``pose`` in ``dt`` seconds."""
        p = core.Pose(dt=dt, speed=pose.speed)
        p.entry[:], p.tip[:] = pose.entry, pose.tip
        with self._lock:
            self._go_to(state)
            self._current = None
            self._check(self._core.echospline_spatial_advance(self._handle, ctypes.byref(p)))
            return self._saved()

    def displacement_at(self, state: bytes, points: Floats) -> Floats:
        """Displacement of reference points (p, 3) in mm in the tissue, shape (p, 3), mm."""
        p = np.ascontiguousarray(as_points(points, "points", 3))
        u = np.empty_like(p)
        field = space.ForceField(struct_size=ctypes.sizeof(space.ForceField))
        with self._lock:
            self._go_to(state)
            self._check(self._core.echospline_spatial_field(self._handle, ctypes.byref(field)))
            self._check(
                self._core.echospline_force_field_at(
                    ctypes.byref(field), p.ctypes.data, len(p), u.ctypes.data
                )
            )
        return u

    def _go_to(self, state: bytes) -> None:
        if state is not self._current:
            self._current = None
            self._check(self._core.echospline_spatial_state_load(self._handle, state, len(state)))
            self._current = state

    def _saved(self) -> bytes:
        saved = ctypes.create_string_buffer(self._core.echospline_spatial_state_size(self._handle))
        self._check(self._core.echospline_spatial_state_save(self._handle, saved, len(saved)))
        self._current = saved.raw
        return self._current

    def _check(self, status: int) -> None:
        if status != core.Status.OK:
            core.check(status, self._core.echospline_spatial_message, self._handle)
