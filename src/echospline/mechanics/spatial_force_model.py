"""The tissue model in space of a needle that acts by forces: the law that sticks and slips, on any tissue that answers forces.

The law is `mechanics.stick_slip` in space, which the native core solves. The tissue's answer to a station of the track is asked for when
the tip comes near it; a state is a value that shares those answers with others.
"""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, get_args

import numpy as np

from echospline import _native as core
from echospline._native import space
from echospline.errors import InputError
from echospline.mechanics import stick_slip
from echospline.mechanics.force_model import ForceSolver
from echospline.mechanics.forces import NeedleForces, NeedleLoad, check_step
from echospline.mechanics.landmarks import Clamps
from echospline.mechanics.response import SpatialColumn, SpatialResponse
from echospline.mechanics.space_response import SpaceResponse
from echospline.mechanics.spatial_fem_response import SpatialFEMResponse
from echospline.mechanics.spread import radius_for
from echospline.mechanics.stick_slip import SlipState, Station, Track, station_at
from echospline.scene import Floats, SpatialGrid, SpatialPose, Tissue

KEPT = 64
"""Stations that a model keeps for the next time the needle comes the same way; states hold their own besides."""


@dataclass(frozen=True, slots=True, eq=False)
class SpatialAnswered:
    """A station with the tissue's answer to it.

    Attributes
    ----------
    station : Station
        Its place and load.
    column : SpatialColumn
        What the tissue answers to unit forces there.
    rows : ndarray, shape (j + 1, 3, 3)
        Mean displacement over the stations before it and itself, mm/N: [station, component, direction of the force].
    """

    station: Station
    column: SpatialColumn
    rows: Floats


@dataclass(frozen=True, slots=True, eq=False)
class SpatialForceState:
    """What needle and tissue remember.

    Attributes
    ----------
    law : bytes or SlipState
        The law's variables, as the core saves them, or as the reference has them.
    track : tuple of SpatialAnswered
        Stations with the tissue's answers, shared between states.
    forces : ndarray, shape (k, 3)
        Force at every station, N.
    load : NeedleLoad
        The needle's forces; across the axis and as a torque their magnitudes.
    force, torque : ndarray, shape (3,)
        Sum of the needle's forces on the tissue, N, and their torque about the point of entry, N mm.
    """

    law: bytes | SlipState
    track: tuple[SpatialAnswered, ...]
    forces: Floats
    load: NeedleLoad
    force: Floats
    torque: Floats


LIVE_CELL, LIVE_NODES = 5.0, 10_000
"""Cells (mm) and nodes at most of the hexahedra that correct Green's function in tissue with regions. In a block of 40 x 35 x 30 mm cells of 5 mm are
off by 0.9 to 2.4 % in the mean and set up in a third of a second; 10 000 nodes take two seconds, and a station 40 ms."""
FINE_CELL, FINE_NODES = 3.5, 25_000
"""The same of finite elements: 1 to 2 %; 25 000 nodes take about 15 s."""


def cell_for(grid: SpatialGrid, cell: float, nodes: int) -> float:
    """Return the size of cells in mm: ``cell``, or more in tissue so large that they would have more than ``nodes`` nodes."""
    low, high = grid.corners
    return max(cell, float((8.0 * np.prod(high - low) / nodes) ** (1 / 3)))


class SpatialForceModel:
    """Tissue in space that answers forces, under a needle that sticks, slips and cuts. Thread-safe; it pickles as its response does.

    Parameters
    ----------
    response : SpatialResponse
        How the tissue answers forces.
    forces : NeedleForces
        The law's parameters.
    solver : {"native", "reference"}
        The native core, or the same law in NumPy, which it is compared with. Their states are not interchangeable.

    Raises
    ------
    InputError
        If the station spacing is below a 500th of the tissue's diagonal.
    """

    def __init__(
        self, response: SpatialResponse, forces: NeedleForces | None = None, *, solver: ForceSolver = "native"
    ) -> None:
        if solver not in get_args(ForceSolver):
            raise InputError(f"solver is one of {', '.join(get_args(ForceSolver))}; got {solver!r}")
        self.response, self.law, self.solver = response, forces or NeedleForces(), solver
        self.extent = self.grid.corners
        self._kept: OrderedDict[tuple[bytes, bytes], SpatialColumn] = OrderedDict()
        self._lock = threading.RLock()
        self._native = _SpatialLaw(self) if solver == "native" else None
        none = np.zeros(3)
        saved: bytes | SlipState = stick_slip.at_rest(3) if self._native is None else self._native.rest
        self._rest = SpatialForceState(saved, (), np.zeros((0, 3)), NeedleLoad(), none, none)

    @classmethod
    def green(
        cls,
        grid: SpatialGrid,
        clamped: Iterable[str] = ("left", "right", "bottom", "front", "back"),
        tissue: Tissue | None = None,
        forces: NeedleForces | None = None,
        *,
        sliding: Iterable[str] = (),
        radius: float | None = None,
    ) -> SpatialForceModel:
        """Build the model on Green's function in space.

        Homogeneous tissue is answered by closed forms and forces outside the faces (`SpaceResponse`), tissue with regions by closed
        forms and coarse hexahedra that are solved anew for every station (`SpatialFEMResponse` with cells of `LIVE_CELL` or more).

        Parameters
        ----------
        grid : SpatialGrid
            Its corners are those of the tissue.
        clamped, sliding : iterable of {"top", "bottom", "left", "right", "front", "back"}
            Faces that do not move, and that move along themselves alone.
        tissue : Tissue
            E and nu; regions are spheres, boxes, layers and labels of a volume.
        forces : NeedleForces
            The law's parameters.
        radius : float, optional
            Over which a force is spread, mm; by default `spread.radius_for`: so that tissue does not fold.

        Raises
        ------
        InputError
            If faces, tissue or radius do not fit.
        """
        material, law = tissue or Tissue(), forces or NeedleForces()
        clamps = Clamps.of(grid, clamped, sliding=sliding)
        spread = radius_for(law, material, grid) if radius is None else radius
        if material.homogeneous:
            return cls(SpaceResponse(grid, clamps, material, radius=spread), law)
        return cls(
            SpatialFEMResponse(
                grid, clamps, material, cell=cell_for(grid, LIVE_CELL, LIVE_NODES), radius=spread
            ),
            law,
        )

    @classmethod
    def fem(
        cls,
        grid: SpatialGrid,
        clamped: Iterable[str] = ("left", "right", "bottom", "front", "back"),
        tissue: Tissue | None = None,
        forces: NeedleForces | None = None,
        *,
        sliding: Iterable[str] = (),
        radius: float | None = None,
        cell: float | None = None,
    ) -> SpatialForceModel:
        """Build the model on finite elements: slower and finer, what the others are compared with.

        Parameters
        ----------
        grid, clamped, tissue, forces, sliding, radius
            As for `green`.
        cell : float, optional
            Greatest size of a cell, about, mm; by default `FINE_CELL`, or more in large tissue.

        Raises
        ------
        InputError
            If faces, tissue, radius or cell do not fit.
        """
        material, law = tissue or Tissue(), forces or NeedleForces()
        clamps = Clamps.of(grid, clamped, sliding=sliding)
        spread = radius_for(law, material, grid) if radius is None else radius
        size = cell_for(grid, FINE_CELL, FINE_NODES) if cell is None else cell
        return cls(SpatialFEMResponse(grid, clamps, material, cell=size, radius=spread), law)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the model was made of; a copy has a workspace of its own."""
        return partial(SpatialForceModel, solver=self.solver), (self.response, self.law)

    @property
    def grid(self) -> SpatialGrid:
        """The mesh; its corners are those of the tissue."""
        return self.response.grid

    def rest(self) -> SpatialForceState:
        """State of tissue that no needle has touched."""
        return self._rest

    def advance(self, state: SpatialForceState, pose: SpatialPose, dt: float) -> SpatialForceState:
        """State after the needle has moved to ``pose`` in ``dt`` seconds.

        Raises
        ------
        InputError
            If dt is negative or not finite, or the state is of a model with another solver or tissue.
        SolverError
            If the tissue's answers are no compliance.
        """
        check_step(dt)
        if isinstance(state.law, bytes) != (self._native is not None):
            raise InputError(f'this state belongs to a model with another solver than "{self.solver}"')
        with self._lock:
            if self._native is not None:
                return self._native.advance(state, pose, dt)
            return self._advance(state, pose, dt)

    def field(self, state: SpatialForceState) -> Callable[[Floats], Floats]:
        """Displacement (n, 3) in mm of any reference points (n, 3) in mm."""
        if not state.forces.any():
            return np.zeros_like
        return self.response.field_of([a.column for a in state.track], state.forces)

    def needle_load(self, state: SpatialForceState) -> NeedleLoad:
        """Return the needle's forces on the tissue."""
        return state.load

    def warnings(self, state: SpatialForceState) -> dict[str, str]:
        """Say where the forces of a state go beyond what the method is good for: a sentence for each limit that is passed."""
        return self.response.warnings([a.column for a in state.track], state.forces)

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        return self.response.describe()

    def answered(self, track: tuple[SpatialAnswered, ...], station: Station) -> SpatialAnswered:
        """Answer of the tissue to the next station of a track."""
        new = self._column(station)
        every = [*(a.column for a in track), new]
        first = np.cumsum([0, *(len(c.places) for c in every)])
        at = self.response.column_at(new, np.concatenate([c.places for c in every]))
        rows = np.stack(
            [np.tensordot(c.weights, at[first[j] : first[j + 1]], 1) for j, c in enumerate(every)]
        )
        return SpatialAnswered(station, new, rows)

    def _advance(self, state: SpatialForceState, pose: SpatialPose, dt: float) -> SpatialForceState:
        """One step of the reference."""
        slip, track = state.law, state.track
        assert isinstance(slip, SlipState)

        def supply(before: Track, station: Station) -> Track:
            nonlocal track
            track = track[: len(before)]
            found = self.answered(track, station)
            track = (*track, found)
            return before.with_station(station, found.rows)

        slip = stick_slip.advance(slip, pose, dt, self.law, self.extent, supply)
        h = self.law.station_spacing
        force, torque = stick_slip.wrench(slip, h, pose)
        return SpatialForceState(
            slip, track, stick_slip.station_forces(slip, h), stick_slip.load(slip, h, pose), force, torque
        )

    def _column(self, station: Station) -> SpatialColumn:
        key = station.place.tobytes(), station.axis.tobytes()
        if key not in self._kept:
            self._kept[key] = self.response.column(station.points, station.weights)
        self._kept.move_to_end(key)
        found = self._kept[key]
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return found


def law_options(law: NeedleForces, extent: tuple[Floats, Floats]) -> space.SpatialOptions:
    """Return the law of a needle in tissue between two corners, as the core takes it; without tables."""
    o = space.SpatialOptions(struct_size=ctypes.sizeof(space.SpatialOptions))
    o.low[:], o.high[:] = ([float(v) for v in corner] for corner in extent)
    o.tip, o.friction_limit, o.bond = law.tip, law.friction_limit, law.bond
    o.tip_stiffness, o.side_stiffness, o.viscosity = law.tip_stiffness, law.side_stiffness, law.viscosity
    o.station_spacing, o.substep, o.dead_band = law.station_spacing, law.substep, law.dead_band
    return o


class _SpatialLaw:
    """The law in the core: one workspace, which goes on from any state. The caller holds the lock."""

    def __init__(self, model: SpatialForceModel) -> None:
        self._model, self._core = weakref.proxy(model), space.library()
        self._handle = ctypes.c_void_p()
        options = law_options(model.law, model.extent)
        status = self._core.echospline_spatial_create(ctypes.byref(options), ctypes.byref(self._handle))
        weakref.finalize(self, self._core.echospline_spatial_destroy, self._handle)
        self._check(status)
        self._pose, self._station, self._load = core.Pose(), space.SpatialStation(), space.SpatialLoad()
        self._count = ctypes.c_int64()
        self._track: tuple[SpatialAnswered, ...] = ()  # what the core has been told
        self._current: SpatialForceState | None = None
        self.rest = self._saved()

    def advance(self, state: SpatialForceState, pose: SpatialPose, dt: float) -> SpatialForceState:
        """One step."""
        if state is not self._current:
            self._current = None
            saved = state.law
            assert isinstance(saved, bytes)
            self._check(self._core.echospline_spatial_state_load(self._handle, saved, len(saved)))
        p = self._pose
        p.entry[:], p.tip[:] = pose.entry, pose.tip
        p.speed, p.dt = 0.0, dt
        self._current = None
        while (
            status := self._core.echospline_spatial_advance(self._handle, self._pose)
        ) == core.Status.NEEDS_STATION:
            self._supply(state.track)
        self._check(status)
        self._current = self._present(state.track)
        return self._current

    def _supply(self, known: tuple[SpatialAnswered, ...]) -> None:
        """Answer the wanted station: from the state's track, or by asking the tissue."""
        wanted = self._station
        self._check(self._core.echospline_spatial_wanted(self._handle, wanted))
        j, place, axis = wanted.index, np.array(wanted.place), np.array(wanted.axis)
        found = known[j] if j < len(known) and _same(known[j].station, place, axis) else None
        if found is None or self._track[:j] != known[:j]:
            station = station_at(place, axis, self._model.law.station_spacing, self._model.extent)
            found = self._model.answered(self._track[:j], station)
        rows = np.ascontiguousarray(found.rows)
        self._check(self._core.echospline_spatial_answer(self._handle, rows.ctypes.data, rows.size))
        self._track = (*self._track[:j], found)

    def _present(self, known: tuple[SpatialAnswered, ...]) -> SpatialForceState:
        self._check(self._core.echospline_spatial_forces(self._handle, None, 0, self._count))
        forces = np.empty((self._count.value, 3))
        self._check(
            self._core.echospline_spatial_forces(self._handle, forces.ctypes.data, len(forces), self._count)
        )
        load = self._load
        self._check(self._core.echospline_spatial_needle(self._handle, load))
        torque = np.array(load.torque)
        size = float(np.linalg.norm(torque))
        # a step that only lets go of a loaded state asks for no answers: its track is the one that the state came with
        track = known if not forces.any() and self._lies_on(known, len(forces)) else self._track
        return SpatialForceState(
            self._saved(), track[: len(forces)], forces,
            NeedleLoad(load.tip, load.friction, load.side, size, load.cut), np.array(load.force), torque,
        )  # fmt: skip

    def _lies_on(self, known: tuple[SpatialAnswered, ...], count: int) -> bool:
        """Whether a track has the stations of the core's state."""
        stations = (space.SpatialStation * max(count, 1))()
        self._check(
            self._core.echospline_spatial_stations(
                self._handle, ctypes.addressof(stations), count, self._count
            )
        )
        return len(known) >= count and all(
            _same(a.station, np.array(s.place), np.array(s.axis))
            for a, s in zip(known[:count], stations, strict=False)
        )

    def _saved(self) -> bytes:
        saved = ctypes.create_string_buffer(self._core.echospline_spatial_state_size(self._handle))
        self._check(self._core.echospline_spatial_state_save(self._handle, saved, len(saved)))
        return saved.raw

    def _check(self, status: int) -> None:
        if status != core.Status.OK:
            core.check(status, self._core.echospline_spatial_message, self._handle)


def _same(station: Station, place: Floats, axis: Floats) -> bool:
    return bool((station.place == place).all() and (station.axis == axis).all())
