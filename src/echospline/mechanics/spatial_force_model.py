"""The tissue model in space of a needle that acts by forces: the law that sticks and slips, on any tissue that answers forces.

The law is `mechanics.stick_slip` in space. The tissue's answer to a station of the track is asked for when the tip comes near it; a state
is a value that shares those answers with others.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from echospline.mechanics import stick_slip
from echospline.mechanics.forces import NeedleForces, NeedleLoad, check_step
from echospline.mechanics.landmarks import Clamps
from echospline.mechanics.response import SpatialColumn, SpatialResponse
from echospline.mechanics.space_response import SpaceResponse
from echospline.mechanics.spatial_fem_response import SpatialFEMResponse
from echospline.mechanics.spread import least_near, radius_for
from echospline.mechanics.stick_slip import SlipState, Station, Track
from echospline.scene import Floats, SpatialGrid, SpatialPose, Tissue

KEPT = 64
"""Stations that a model keeps for the next time the needle comes the same way; states hold their own besides."""


@dataclass(frozen=True, slots=True, eq=False)
class SpatialForceState:
    """What needle and tissue remember.

    Attributes
    ----------
    law : SlipState
        The law's variables.
    track : tuple of SpatialColumn
        The tissue's answers to the stations, shared between states.
    forces : ndarray, shape (k, 3)
        Force at every station, N.
    load : NeedleLoad
        The needle's forces; across the axis and as a torque their magnitudes.
    force, torque : ndarray, shape (3,)
        Sum of the needle's forces on the tissue, N, and their torque about the point of entry, N mm.
    """

    law: SlipState
    track: tuple[SpatialColumn, ...]
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
    """

    def __init__(self, response: SpatialResponse, forces: NeedleForces | None = None) -> None:
        self.response, self.law = response, forces or NeedleForces()
        self.extent = self.grid.corners
        self._kept: OrderedDict[tuple[bytes, bytes], SpatialColumn] = OrderedDict()
        self._lock = threading.Lock()
        none = np.zeros(3)
        self._rest = SpatialForceState(stick_slip.at_rest(3), (), np.zeros((0, 3)), NeedleLoad(), none, none)

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
        cell = cell_for(grid, LIVE_CELL, LIVE_NODES)
        least = least_near(material)
        return cls(SpatialFEMResponse(grid, clamps, material, cell=cell, radius=spread, least=least), law)

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
        least = least_near(material)
        return cls(SpatialFEMResponse(grid, clamps, material, cell=size, radius=spread, least=least), law)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the model was made of."""
        return partial(SpatialForceModel), (self.response, self.law)

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
            If dt is negative or not finite.
        SolverError
            If the tissue's answers are no compliance.
        """
        check_step(dt)
        track = state.track

        def supply(before: Track, station: Station) -> Track:
            nonlocal track
            track = track[: len(before)]
            new = self._column(station)
            every = [*track, new]
            first = np.cumsum([0, *(len(c.places) for c in every)])
            at = self.response.column_at(new, np.concatenate([c.places for c in every]))
            rows = np.stack([
                np.tensordot(c.weights, at[first[j] : first[j + 1]], 1) for j, c in enumerate(every)
            ])  # fmt: skip
            track = (*track, new)
            return before.with_station(station, rows)

        law = stick_slip.advance(state.law, pose, dt, self.law, self.extent, supply)
        h = self.law.station_spacing
        force, torque = stick_slip.wrench(law, h, pose)
        return SpatialForceState(
            law, track, stick_slip.station_forces(law, h), stick_slip.load(law, h, pose), force, torque
        )

    def field(self, state: SpatialForceState) -> Callable[[Floats], Floats]:
        """Displacement (n, 3) in mm of any reference points (n, 3) in mm."""
        if not state.forces.any():
            return np.zeros_like
        return self.response.field_of(state.track, state.forces)

    def needle_load(self, state: SpatialForceState) -> NeedleLoad:
        """Return the needle's forces on the tissue."""
        return state.load

    def warnings(self, state: SpatialForceState) -> dict[str, str]:
        """Say where the forces of a state go beyond what the method is good for: a sentence for each limit that is passed."""
        return self.response.warnings(state.track, state.forces)

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        return self.response.describe()

    def _column(self, station: Station) -> SpatialColumn:
        key = station.place.tobytes(), station.axis.tobytes()
        with self._lock:
            if key not in self._kept:
                self._kept[key] = self.response.column(station.points, station.weights)
            self._kept.move_to_end(key)
            found = self._kept[key]
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            return found
