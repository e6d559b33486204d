"""The tissue model of a needle that acts by forces: the law that sticks and slips, on any tissue that answers forces.

The native core solves the law and adds up the mesh's displacement; the tissue's answer to a station of the track is asked for when the
tip comes near it. A state is a value: the law's variables, and the stations with their columns, which states share.
"""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections import OrderedDict
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline import _native as core
from echospline.errors import InputError
from echospline.mechanics import stick_slip
from echospline.mechanics.forces import NeedleForces, NeedleLoad, check_step
from echospline.mechanics.response import ForceResponse
from echospline.mechanics.stick_slip import SlipState, Station, Track, station_at
from echospline.scene import Floats, NeedlePose, RegularGrid, as_points

ForceSolver = Literal["native", "reference"]

AHEAD = 1
"""Stations whose columns are computed at once, along the needle's axis. CHOLMOD takes eight back-substitutions as long together as one by one
(153 ms against 8 x 19 at 40 000 nodes), so more would make rarer steps slower still."""
KEPT = 64
"""Stations that a model keeps for the next time the needle comes the same way; states hold their own besides."""


@dataclass(frozen=True, slots=True, eq=False)
class Answered:
    """A station with the tissue's answer to it.

    Attributes
    ----------
    station : Station
        Its place and load.
    columns : ndarray, shape (2, n, 2), float32
        Displacement of the mesh nodes by a unit force along x, and along y, mm/N.
    rows : ndarray, shape (j + 1, 2, 2)
        Mean displacement over the stations before it and itself, mm/N: [station, component, direction of the force].
    key : bytes
        Names the track up to here.
    """

    station: Station
    columns: NDArray[np.float32]
    rows: Floats
    key: bytes


@dataclass(frozen=True, slots=True, eq=False)
class ForceState:
    """What needle and tissue remember.

    Attributes
    ----------
    law : bytes or SlipState
        The law's variables, as the core saves them, or as the reference has them.
    track : tuple of Answered
        Stations with their columns, shared between states.
    forces : ndarray, shape (k, 2)
        Force at every station, N.
    load : NeedleLoad
        The needle's forces.
    displacement : ndarray, shape (n, 2)
        Of the mesh nodes, mm, read-only.
    """

    law: bytes | SlipState
    track: tuple[Answered, ...]
    forces: Floats
    load: NeedleLoad
    displacement: Floats


class ForceModel:
    """Tissue that answers forces, under a needle that sticks, slips and cuts. Thread-safe; it pickles as its response does.

    Parameters
    ----------
    response : ForceResponse
        How the tissue answers forces.
    forces : NeedleForces
        The law's parameters.
    solver : {"native", "reference"}
        The native core, or the same law in NumPy, which it is compared with. Their states are not interchangeable.

    Raises
    ------
    InputError
        If the station spacing is below a 500th of the mesh's diagonal.
    """

    def __init__(
        self, response: ForceResponse, forces: NeedleForces | None = None, *, solver: ForceSolver = "native"
    ) -> None:
        if solver not in get_args(ForceSolver):
            raise InputError(f"solver is one of {', '.join(get_args(ForceSolver))}; got {solver!r}")
        self.response, self.law, self.solver = response, forces or NeedleForces(), solver
        x0, x1, y0, y1 = self.grid.extent
        self.extent = np.array([x0, y0]), np.array([x1, y1])
        self._kept: OrderedDict[bytes, Answered] = OrderedDict()
        self._lock = threading.RLock()
        self._native = _NativeLaw(self) if solver == "native" else None
        still = np.zeros((self.grid.size, 2))
        still.setflags(write=False)
        saved: bytes | SlipState = stick_slip.at_rest() if self._native is None else self._native.rest
        self._rest = ForceState(saved, (), np.zeros((0, 2)), NeedleLoad(), still)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the model was made of; a copy has a workspace of its own."""
        return _made, (self.response, self.law, self.solver)

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self.response.grid

    def rest(self) -> ForceState:
        """State of tissue that no needle has touched."""
        return self._rest

    def advance(self, state: ForceState, pose: NeedlePose, dt: float) -> ForceState:
        """State after the needle has moved to ``pose`` in ``dt`` seconds.

        Raises
        ------
        InputError
            If dt is negative or not finite, or the state is of a model with another solver or mesh.
        SolverError
            If the tissue's answers are no compliance.
        """
        check_step(dt)
        with self._lock:
            if isinstance(state.law, bytes) != (self._native is not None):
                raise InputError(f'this state belongs to a model with another solver than "{self.solver}"')
            if self._native is not None:
                return self._native.advance(state, pose, dt)
            return self._advance(state, pose, dt)

    def displacement(self, state: ForceState) -> Floats:
        """Displacement of the mesh nodes, shape (n, 2), mm."""
        if len(state.displacement) != self.grid.size:
            raise InputError(
                f"this state has a mesh of {len(state.displacement)} nodes; the model has {self.grid.size}: use a state of this "
                "model"
            )
        return state.displacement

    def displacement_at(self, state: ForceState, points: ArrayLike) -> Floats:
        """Displacement of any reference points in the tissue, shape (n, 2), mm.

        Raises
        ------
        InputError
            If a point lies outside the tissue.
        """
        wanted = as_points(points)
        loaded = [
            (a.station, f)
            for a, f in zip(state.track, state.forces, strict=True)
            if f.any() and len(a.station.points)
        ]
        if not loaded:  # the answer to no force at all, for the check of the points
            corner = np.array([self.extent[0]])
            return self.response.answer(corner, np.zeros((1, 2, 1)), wanted)[1][..., 0]
        places = np.vstack([s.points for s, _ in loaded])
        forces = np.vstack([s.weights[:, None] * f for s, f in loaded])
        return self.response.answer(places, forces[..., None], wanted)[1][..., 0]

    def needle_load(self, state: ForceState) -> NeedleLoad:
        """Return the needle's forces on the tissue."""
        return state.load

    def answered(self, track: tuple[Answered, ...], station: Station) -> Answered:
        """Answer of the tissue to the next station of a track; those that may come next are computed with it."""
        key = _key(track[-1].key if track else b"", station)
        if key not in self._kept:
            self._answer(track, station, key)
        self._kept.move_to_end(key)
        found = self._kept[key]
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return found

    def _answer(self, track: tuple[Answered, ...], station: Station, key: bytes) -> None:
        h = self.law.station_spacing
        new, keys = [station], [key]
        while len(new) < AHEAD and new[-1].share > 0:
            new.append(station_at(new[-1].place + h * station.axis, station.axis, h, self.extent))
            keys.append(_key(keys[-1], new[-1]))
        every = [*(a.station for a in track), *new]
        first = np.cumsum([0, *(len(s.points) for s in every)])
        places = np.vstack([s.points for s in new])
        cases = np.zeros((len(places), 2, 2 * len(new)))
        start = first[len(track) :] - first[len(track)]
        for i, s in enumerate(new):
            for d in (0, 1):
                cases[start[i] : start[i + 1], d, 2 * i + d] = s.weights
        if len(places):
            mesh, at = self.response.answer(places, cases, np.vstack([s.points for s in every]))
        else:
            mesh, at = np.zeros((self.grid.size, 2, 2)), np.zeros((int(first[-1]), 2, 2))
        for i, s in enumerate(new):
            columns = np.ascontiguousarray(mesh[..., 2 * i : 2 * i + 2].transpose(2, 0, 1), dtype=np.float32)
            rows = np.zeros((len(track) + i + 1, 2, 2))
            for j in range(len(rows)):
                part = slice(first[j], first[j + 1])
                rows[j] = np.tensordot(every[j].weights, at[part, :, 2 * i : 2 * i + 2], 1)
            columns.setflags(write=False)
            self._kept[keys[i]] = Answered(s, columns, rows, keys[i])

    def _advance(self, state: ForceState, pose: NeedlePose, dt: float) -> ForceState:
        """One step of the reference."""
        slip, track = state.law, state.track
        assert isinstance(slip, SlipState)

        def supply(before: Track, station: Station) -> Track:
            nonlocal track
            track = track[: len(before)]
            found = self.answered(track, station)
            track = (*track, found)
            return before.with_station(station, found.rows)

        h = self.law.station_spacing
        slip = stick_slip.advance(slip, pose, dt, self.law, self.extent, supply)
        forces = stick_slip.station_forces(slip, h)
        u = np.zeros((self.grid.size, 2))
        for a, f in zip(track, forces, strict=True):
            u += np.tensordot(f, a.columns.astype(np.float64), 1)
        u.setflags(write=False)
        return ForceState(slip, track, forces, stick_slip.load(slip, h, pose), u)


class _NativeLaw:
    """The law in the core: one workspace, which goes on from any state. The caller holds the lock."""

    def __init__(self, model: ForceModel) -> None:
        self._model, self._core = weakref.proxy(model), core.library()
        law = model.law
        o = core.ForcedOptions(struct_size=ctypes.sizeof(core.ForcedOptions), node_count=model.grid.size)
        for d in (0, 1):
            o.low[d], o.high[d] = model.extent[0][d], model.extent[1][d]
        o.tip, o.friction_limit, o.bond = law.tip, law.friction_limit, law.bond
        o.tip_stiffness, o.side_stiffness, o.viscosity = law.tip_stiffness, law.side_stiffness, law.viscosity
        o.station_spacing, o.substep, o.dead_band = law.station_spacing, law.substep, law.dead_band
        self._handle = ctypes.c_void_p()
        status = self._core.echospline_forced_create(ctypes.byref(o), ctypes.byref(self._handle))
        weakref.finalize(self, self._core.echospline_forced_destroy, self._handle)
        self._check(status)
        self._pose, self._station, self._load = core.Pose(), core.Station(), core.NeedleLoad()
        self._count = ctypes.c_int64()
        self._track: tuple[Answered, ...] = ()  # what the core has been told
        self._current: ForceState | None = None
        self.rest = self._saved()

    def advance(self, state: ForceState, pose: NeedlePose, dt: float) -> ForceState:
        """One step."""
        if state is not self._current:
            self._current = None
            saved = state.law
            assert isinstance(saved, bytes)
            self._check(self._core.echospline_forced_state_load(self._handle, saved, len(saved)))
        p = self._pose
        p.entry[0], p.entry[1] = pose.entry
        p.tip[0], p.tip[1] = pose.tip
        p.speed, p.dt = pose.speed, dt
        self._current = None
        known = state.track
        while (
            status := self._core.echospline_forced_advance(self._handle, self._pose)
        ) == core.Status.NEEDS_STATION:
            self._supply(known)
        self._check(status)
        self._current = self._present(known)
        return self._current

    def _supply(self, known: tuple[Answered, ...]) -> None:
        """Answer the wanted station: from the state's track, or by asking the tissue."""
        wanted = self._station
        self._check(self._core.echospline_forced_wanted(self._handle, wanted))
        j, place, axis = wanted.index, np.array(wanted.place), np.array(wanted.axis)
        found = known[j] if j < len(known) and _same(known[j].station, place, axis) else None
        if found is None or self._track[:j] != known[:j]:
            station = station_at(place, axis, self._model.law.station_spacing, self._model.extent)
            found = self._model.answered(self._track[:j], station)
        rows = np.ascontiguousarray(found.rows)
        self._check(
            self._core.echospline_forced_answer(
                self._handle, found.columns.ctypes.data, found.columns.size, rows.ctypes.data, rows.size
            )
        )
        self._track = (*self._track[:j], found)

    def _present(self, known: tuple[Answered, ...]) -> ForceState:
        grid: RegularGrid = self._model.grid
        mesh = np.empty((grid.size, 2))
        while (
            status := self._core.echospline_forced_displacement(self._handle, mesh.ctypes.data, mesh.size)
        ) == core.Status.NEEDS_STATION:
            self._supply(known)
        self._check(status)
        mesh.setflags(write=False)
        self._check(self._core.echospline_forced_forces(self._handle, None, 0, self._count))
        forces = np.empty((self._count.value, 2))
        self._check(
            self._core.echospline_forced_forces(self._handle, forces.ctypes.data, len(forces), self._count)
        )
        load = self._load
        self._check(self._core.echospline_forced_load(self._handle, load))
        return ForceState(
            self._saved(),
            self._track[: len(forces)],
            forces,
            NeedleLoad(load.tip, load.friction, load.side, load.torque, load.cut),
            mesh,
        )

    def _saved(self) -> bytes:
        saved = ctypes.create_string_buffer(self._core.echospline_forced_state_size(self._handle))
        self._check(self._core.echospline_forced_state_save(self._handle, saved, len(saved)))
        return saved.raw

    def _check(self, status: int) -> None:
        if status != core.Status.OK:
            core.check(status, self._core.echospline_forced_message, self._handle)


def _made(response: ForceResponse, forces: NeedleForces, solver: ForceSolver) -> ForceModel:
    return ForceModel(response, forces, solver=solver)


def _same(station: Station, place: Floats, axis: Floats) -> bool:
    return bool((station.place == place).all() and (station.axis == axis).all())


def _key(before: bytes, station: Station) -> bytes:
    """Name of a track that goes on with a station."""
    return blake2b(before + station.place.tobytes() + station.axis.tobytes(), digest_size=16).digest()
