"""Tissue that answers forces by Green's function, with the needle's law, as every host gives it to the core; and its steps here."""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline import _native
from echospline._native import green as core
from echospline.errors import InputError
from echospline.mechanics.forces import NeedleForces, NeedleLoad
from echospline.mechanics.green_response import GreenResponse
from echospline.mechanics.green_tables import options_of
from echospline.scene import Floats, NeedlePose, as_points

LAW = (
    "tip", "friction_limit", "bond", "tip_stiffness", "side_stiffness", "viscosity", "station_spacing", "substep",
    "dead_band",
)  # fmt: skip
"""Options that a `ForcedScene` may name: parameters of `NeedleForces`, which are members of `echospline_forced_options`."""


@dataclass(frozen=True, eq=False)
class ForcedScene:
    """A forced tissue as every host gives it to the core; in JavaScript ``core.green(options, {...response, ...arrays})``.

    Parameters
    ----------
    options : mapping of str to float
        The law: members of `echospline_forced_options`; those that are missing are the core's defaults.
    response : mapping
        How the tissue answers: members of `echospline_green_options` that are numbers or two of them.
    arrays : mapping of str to ndarray
        Its tables, under their names there; counts follow from them.

    Raises
    ------
    InputError
        If a name is unknown, a value has another form than its member, or tables do not fit together.
    """

    options: Mapping[str, float]
    response: Mapping[str, int | float | Sequence[int] | Sequence[float]]
    arrays: Mapping[str, NDArray[Any]]

    def __post_init__(self) -> None:
        for name, value in self.options.items():
            if name not in LAW:
                raise InputError(
                    f"{name!r} is no option of a forced tissue; expected some of {', '.join(LAW)}"
                )
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError(f"option {name} of a forced tissue must be a number; got {value!r}")
        options_of({**self.response, **self.arrays})  # refuses what does not fit

    @classmethod
    def of(cls, response: GreenResponse, law: NeedleForces | None = None) -> ForcedScene:
        """Return the scene of a response and a law, `ForceModel.response` and `ForceModel.law` of a `GreenModel`."""
        tables = response.tables()
        arrays = {name: table for name, table in tables.items() if isinstance(table, np.ndarray)}
        numbers = {name: value for name, value in tables.items() if name not in arrays}
        return cls({name: float(getattr(law or NeedleForces(), name)) for name in LAW}, numbers, arrays)


class ForcedStep:
    """Steps of a forced scene in the core alone, for any state, from any thread. A state is the core's own, as bytes.

    Parameters
    ----------
    scene : ForcedScene
        What is given.

    Raises
    ------
    InputError, SolverError
        If the core refuses it.
    """

    def __init__(self, scene: ForcedScene) -> None:
        self.scene = scene
        self._core = core.library()
        self._lock = threading.Lock()
        green, kept = options_of({**scene.response, **scene.arrays})
        self._green, self._forced = ctypes.c_void_p(), ctypes.c_void_p()
        status = self._core.echospline_green_create(ctypes.byref(green), ctypes.byref(self._green))
        del kept  # copied
        weakref.finalize(self, _destroy, self._core, self._forced, self._green)
        _native.check(status, self._core.echospline_green_message, self._green)
        self._nodes = green.shape[0] * green.shape[1]
        o = _native.ForcedOptions(struct_size=ctypes.sizeof(_native.ForcedOptions))
        self._core.echospline_forced_defaults(ctypes.byref(o))
        for name, value in scene.options.items():
            setattr(o, name, value)
        o.node_count = self._nodes
        for d in (0, 1):
            o.low[d] = green.origin[d]
            o.high[d] = green.origin[d] + green.spacing[d] * (green.shape[d] - 1)
        self._check(self._core.echospline_forced_create(ctypes.byref(o), ctypes.byref(self._forced)))
        self._check(self._core.echospline_forced_attach(self._forced, self._green))
        self._current: bytes | None = None
        self._rest = self._saved()

    def rest(self) -> bytes:
        """State of tissue that no needle has touched."""
        return self._rest

    def advance(self, state: bytes, pose: NeedlePose, dt: float) -> bytes:
        """State after the needle has moved to ``pose`` in ``dt`` seconds."""
        p = _native.Pose(dt=dt, speed=pose.speed)
        p.entry[0], p.entry[1] = pose.entry
        p.tip[0], p.tip[1] = pose.tip
        with self._lock:
            self._go_to(state)
            self._current = None
            self._check(self._core.echospline_forced_advance(self._forced, ctypes.byref(p)))
            return self._saved()

    def displacement(self, state: bytes) -> Floats:
        """Displacement of the mesh nodes, shape (n, 2), mm."""
        u = np.empty((self._nodes, 2))
        with self._lock:
            self._go_to(state)
            self._check(self._core.echospline_forced_displacement(self._forced, u.ctypes.data, u.size))
        return u

    def displacement_at(self, state: bytes, points: Floats) -> Floats:
        """Displacement of reference points (p, 2) in mm in the tissue, shape (p, 2), mm."""
        p = np.ascontiguousarray(as_points(points, "points"))
        if p.shape[1] != 2:
            raise InputError(f"points must have shape (p, 2) in mm; got {p.shape}")
        u = np.empty_like(p)
        with self._lock:
            self._go_to(state)
            self._check(
                self._core.echospline_forced_displacement_at(
                    self._forced, p.ctypes.data, len(p), u.ctypes.data
                )
            )
        return u

    def load(self, state: bytes) -> NeedleLoad:
        """Forces of the needle."""
        load = _native.NeedleLoad()
        with self._lock:
            self._go_to(state)
            self._check(self._core.echospline_forced_load(self._forced, ctypes.byref(load)))
        return NeedleLoad(load.tip, load.friction, load.side, load.torque, load.cut)

    def _go_to(self, state: bytes) -> None:
        if state is not self._current:
            self._current = None
            self._check(self._core.echospline_forced_state_load(self._forced, state, len(state)))
            self._current = state

    def _saved(self) -> bytes:
        saved = ctypes.create_string_buffer(self._core.echospline_forced_state_size(self._forced))
        self._check(self._core.echospline_forced_state_save(self._forced, saved, len(saved)))
        self._current = saved.raw
        return self._current

    def _check(self, status: int) -> None:
        if status != _native.Status.OK:
            _native.check(status, self._core.echospline_forced_message, self._forced)


def _destroy(library: ctypes.CDLL, forced: ctypes.c_void_p, green: ctypes.c_void_p) -> None:
    library.echospline_forced_destroy(forced)
    library.echospline_green_destroy(green)
