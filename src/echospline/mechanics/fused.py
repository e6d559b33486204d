"""One step of the tissue model by the response: from a needle pose to the deformed mesh without refitting anything.

The same numbers as `tps.TPSModel` reading Algorithm 2 in NumPy, in one compiled call as long as the contacts stay the same.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, inf
from typing import Any

import numpy as np

from echospline.grid import Floats
from echospline.mechanics.compiled_step import SAME_PLACE, step, value_before
from echospline.mechanics.interaction import LET_GO, largest_share, needle_travel
from echospline.mechanics.response import NO_TIP, Response
from echospline.mechanics.spline import Spline
from echospline.mechanics.tip_patch import COEFFICIENTS, DEGREE, HALF_WIDTH
from echospline.needle import NeedlePose

NO_CONTACTS = np.empty((0, 7))
for _array in (NO_TIP, NO_CONTACTS):
    _array.setflags(write=False)


@dataclass(frozen=True, slots=True)
class FusedState:
    """What the tissue remembers, as the compiled step takes it.

    Parameters
    ----------
    pose : NeedlePose or None
        The last pose; None at rest.
    landmarks : ndarray, shape (k, 7)
        Contacts, `compiled_step.COLUMNS`, ascending.
    tip : ndarray, shape (6,)
        The tip's own landmark, `compiled_step.TIP`.
    mesh : ndarray, shape (n, 2)
        Displacement of the points of the response, mm.
    held_back : int
        Steps since rest in which the landmarks were slowed down so that the picture does not jump.
    """

    pose: NeedlePose | None
    landmarks: Floats
    tip: Floats
    mesh: Floats
    held_back: int = 0


@dataclass(frozen=True)
class Setting:
    """What a step needs to know beside the response.

    Parameters
    ----------
    numbers : ndarray, shape (10,)
        sigma, delta, alpha1, alpha2, alpha3, length, drag, gap, 1 for immediate loading, 1 for a tip on a node.
    places : ndarray, shape (2, K)
        The nodes that may become contacts, mm.
    walls : ndarray, shape (4,)
        Clamped edges: x of left and right, y of top and bottom; infinite where free, mm.
    posts : ndarray, shape (j, 2)
        Clamped points, mm.
    node_place : callable, optional
        For a tip on a node: from the tip (mm) to (x, y of the nearest node, whether it can move).
    tip_softness : callable, optional
        Softness of a tip landmark at (x, y) mm; 0 when not given.
    """

    numbers: Floats
    places: Floats
    walls: Floats
    posts: Floats
    node_place: Callable[[tuple[float, float]], tuple[float, float, bool]] | None = None
    tip_softness: Callable[[tuple[float, float]], float] | None = None


class FusedStep:
    """`advance` of the tissue model, on a `Response` that it keeps.

    States are values: any of them may be advanced at any time, from any thread. The response follows the contacts of
    the state that it is asked about, so going on from the last one is fast.
    """

    def __init__(self, response: Response, setting: Setting) -> None:
        self.response = response
        self.setting = setting
        K, n = len(response.at), len(response.scene.points)
        self.marks, self.alongs = np.empty(K, dtype=np.int64), np.empty(K)
        self.still: Floats = np.zeros((n, 2))
        self.still.setflags(write=False)
        self.lock = threading.Lock()

    def rest(self) -> FusedState:
        """State of tissue that no needle has touched."""
        return FusedState(None, NO_CONTACTS, NO_TIP, self.still)

    def advance(self, state: FusedState, pose: NeedlePose, dt: float) -> FusedState:
        """State after the needle has moved to ``pose`` in ``dt`` s."""
        with self.lock:
            return self._advance(state, pose, dt)

    def _pose(self, state: FusedState, pose: NeedlePose, dt: float) -> Floats:
        """The pose as the compiled step takes it."""
        s = self.setting
        (ex, ey), (tx, ty), depth = pose.entry, pose.tip, pose.depth
        ax, ay = pose.axis
        travel = inf
        if not s.numbers[8]:
            travel = hypot(tx - ex, ty - ey) if state.pose is None else needle_travel(state.pose, pose)
        x, y, moves = (tx, ty, True) if s.node_place is None else s.node_place(pose.tip)
        soft = before = 0.0
        if s.tip_softness is not None:
            soft, before = s.tip_softness((x, y)), s.tip_softness((float(state.tip[1]), float(state.tip[2])))
        return np.array((ex, ey, tx, ty, ax, ay, depth, pose.speed, travel, dt, x, y, moves, soft, before))

    def _call(self, state: FusedState, numbers: Floats) -> Any:
        s, r, a = self.setting, self.response, self.response.scene
        return step(
            s.places, r.at, state.mesh, state.landmarks, state.tip, numbers, s.numbers, s.walls, s.posts, a.form,
            a.frame, a.anchors, a.L_inverse, a.sources, a.felt, r.slots, r.slot_of_source, r.count, r.inverse,
            a.columns, a.table, r.rows, r.single, r.product, r.head, r.square, COEFFICIENTS, DEGREE, r.toq,
            r.near, r.rough, self.marks, self.alongs,
        )  # fmt: skip

    def _advance(self, state: FusedState, pose: NeedlePose, dt: float) -> FusedState:
        r = self.response
        numbers = self._pose(state, pose, dt)
        result = self._call(state, numbers)
        if not result[0]:
            r.set_contacts(result[1][:, 0].astype(np.int64))
            result = self._call(state, numbers)
        _, table, slot_of, q, tip, free, on_tip, soft, _, mesh, change, how, limit, drops = result
        held_back = state.held_back
        if change > limit * limit:
            q, tip, mesh, drops = self._hold_back(state, numbers, result)
            held_back += 1
        table[:, 2:4] = q
        if drops:
            off = table[:, 1] == 0.0
            keep = ~(off & (np.hypot(*(q - free).T) <= LET_GO))
            table = table[keep]
            slot_of = r.set_contacts(table[:, 0].astype(np.int64))
            on_tip = self._on_tip(table, tip)
            mesh, _ = r.field(slot_of, table[:, 2:4].copy(), tip, soft, on_tip)
        if how == 2:
            r.statistics.direct += 1
            if numbers[8] * 8.0 < HALF_WIDTH:
                place = (tip[1:3] - r.scene.centre) / r.scene.scale
                r.prepare(place, numbers[4:6] * np.sign(pose.speed))
        return FusedState(pose, table, tip, mesh, held_back)

    def _hold_back(
        self, state: FusedState, numbers: Floats, result: Any
    ) -> tuple[Floats, Floats, Floats, int]:
        """Landmarks only so far that no node moves beyond the limit: as `tps.TPSModel` does, by the field's linearity."""
        r, was = self.response, state.mesh
        _, table, slot_of, q, tip, free, on_tip, soft, quantities, mesh, _, _, limit, _ = result
        before, start = state.tip, table[:, 2:4].copy()
        stay, resting = tip.copy(), start
        if tip[0] > 0.0:
            x, y = (tip[1:3] - r.scene.centre) / r.scene.scale
            bx, by = (before[1:3] - r.scene.centre) / r.scene.scale
            spoken = self._on_tip(table, before)
            if spoken >= 0:
                resting, before = start.copy(), NO_TIP
                resting[spoken] = state.tip[3:5]
            old = r.at_point(np.array([bx, by])) if before[0] > 0.0 else quantities
            stay[3:5] = value_before(
                r.scene.form, quantities[3], quantities[0], x, y, before, bx, by, float(numbers[14]), resting, slot_of, old
            )  # fmt: skip
        rest, _ = r.field(slot_of, start, stay, soft, on_tip)
        at = r.at
        share = largest_share(rest[at] - was[at], mesh[at] - was[at], float(limit))
        q = start + share * (q - start)
        tip = tip.copy()
        tip[3:5] = stay[3:5] + share * (tip[3:5] - stay[3:5])
        off = table[:, 1] == 0.0
        drops = int((off & (np.hypot(*(q - free).T) <= LET_GO)).sum())
        return q, tip, rest + share * (mesh - rest), drops

    def _on_tip(self, table: Floats, tip: Floats) -> int:
        """Contact for which a tip's landmark speaks, or -1."""
        if tip[0] == 0.0 or not len(table):
            return -1
        places = self.setting.places[:, table[:, 0].astype(np.int64)]
        distance = np.hypot(places[0] - tip[1], places[1] - tip[2])
        nearest = int(distance.argmin())
        return nearest if distance[nearest] <= SAME_PLACE else -1

    def spline(self, state: FusedState) -> Spline | None:
        """Return the field of a state as a spline, in double precision; None where nothing is displaced."""
        if not len(state.landmarks) and not state.tip[0]:
            return None
        with self.lock:
            soft = 0.0
            if self.setting.tip_softness is not None and state.tip[0] > 0.0:
                soft = self.setting.tip_softness((float(state.tip[1]), float(state.tip[2])))
            slot_of = self.response.set_contacts(state.landmarks[:, 0].astype(np.int64))
            on_tip = self._on_tip(state.landmarks, state.tip)
            return self.response.spline(slot_of, state.landmarks[:, 2:4], state.tip, soft, on_tip)
