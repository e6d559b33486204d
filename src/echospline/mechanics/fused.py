"""One step of the tissue model by the response: from a needle pose to the deformed mesh without refitting anything.

The same numbers as `tps.TPSModel` reading Algorithm 2 in NumPy, in one compiled call as long as the contacts stay the same.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from echospline.grid import Floats, RegularGrid
from echospline.mechanics.anchored_kernel import AnchoredKernel
from echospline.mechanics.compiled import compile_ahead
from echospline.mechanics.compiled_step import (
    CONTACTS,
    NOT_YET,
    SAME_PLACE,
    allowed,
    move,
    needle,
    slots_of,
    step,
    value_before,
)
from echospline.mechanics.interaction import LET_GO, largest_share
from echospline.mechanics.kernels import ThinPlate
from echospline.mechanics.pixel_field import PixelField
from echospline.mechanics.response import NO_TIP, Precision, Quantities, Response
from echospline.mechanics.spline import Spline
from echospline.mechanics.tip_patch import COEFFICIENTS, DEGREE, HALF_WIDTH
from echospline.needle import NeedlePose

PLAIN = np.empty(0)


class FusedState(NamedTuple):
    """What the tissue remembers, as the compiled step takes it.

    Parameters
    ----------
    landmarks : ndarray, shape (k, 7)
        Contacts, `compiled_step.COLUMNS`, ascending.
    tip : ndarray, shape (12,)
        The tip's own landmark and the last pose, `compiled_step.TIP`.
    mesh : ndarray, shape (n, 2)
        Displacement of the points of the response, mm.
    held_back : int
        Steps since rest in which the landmarks were slowed down so that the picture does not jump.
    """

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
        compile_ahead(f"step, {response.precision}", lambda: _try_out(response.precision))
        self._begin(response, setting)

    def _begin(self, response: Response, setting: Setting) -> None:
        self.response = response
        self.setting = setting
        K, n = len(response.at), len(response.scene.points)
        self.marks, self.alongs = np.empty(K, dtype=np.int64), np.empty(K)
        self.points = n
        self.lock = threading.Lock()

    def rest(self) -> FusedState:
        """State of tissue that no needle has touched."""
        # writable, though nothing writes to them: for the compiler a read-only array is another type
        return FusedState(np.empty((0, 7)), np.zeros(12), np.zeros((self.points, 2)))

    def advance(self, state: FusedState, pose: NeedlePose, dt: float) -> FusedState:
        """State after the needle has moved to ``pose`` in ``dt`` s."""
        with self.lock:
            return self._advance(state, pose, dt)

    def _place(self, state: FusedState, pose: NeedlePose) -> Floats:
        """Where the tip's landmark stands if that is not the tip, and how soft it is; nothing in the plain case."""
        s = self.setting
        if s.node_place is None and s.tip_softness is None:
            return PLAIN
        x, y, moves = (*pose.tip, True) if s.node_place is None else s.node_place(pose.tip)
        soft = before = 0.0
        if s.tip_softness is not None:
            soft, before = s.tip_softness((x, y)), s.tip_softness((float(state.tip[1]), float(state.tip[2])))
        return np.array((x, y, moves, soft, before))

    def _advance(self, state: FusedState, pose: NeedlePose, dt: float) -> FusedState:
        s, r, a = self.setting, self.response, self.response.scene
        place = self._place(state, pose)
        (ex, ey), (tx, ty) = pose.entry, pose.tip
        while True:
            outcome, table, tip, mesh, how = step(
                ex, ey, tx, ty, pose.speed, dt, place, s.places, r.at, state.mesh, state.landmarks, state.tip, s.numbers,
                s.walls, s.posts, a.form, a.frame, a.anchors, a.L_inverse, a.sources, a.felt, r.slots, r.slot_of_source,
                r.count, r.inverse, a.columns, a.table, r.rows, r.single, r.product, r.head, r.square, COEFFICIENTS, DEGREE,
                r.toq, r.near, r.rough, self.marks, self.alongs,
            )  # fmt: skip
            if outcome != CONTACTS:
                break
            r.set_contacts(table[:, 0].astype(np.int64))
        held_back = state.held_back
        if outcome == NOT_YET:
            table, tip, mesh, held_back = self._finish(state, pose, dt, place, table)
        if how == 2:
            r.statistics.direct += 1
            if hypot(tx - state.tip[9], ty - state.tip[10]) * 8.0 < HALF_WIDTH:
                r.prepare((tip[1:3] - a.centre) / a.scale, np.multiply(pose.axis, np.sign(pose.speed)))
        return FusedState(table, tip, mesh, held_back)

    def _finish(
        self, state: FusedState, pose: NeedlePose, dt: float, place: Floats, table: Floats
    ) -> tuple[Floats, Floats, Floats, int]:
        """End a step in which the landmarks are held back or contacts that have left can go, as `tps.TPSModel` does.

        Held back: landmarks move only so far that no node moves beyond the limit, by the field's linearity.
        """
        s, r, a = self.setting, self.response, self.response.scene
        before, was, at, held_back = state.tip, state.mesh, self.response.at, state.held_back
        numbers = needle(*pose.entry, *pose.tip, pose.speed, dt, bool(s.numbers[8]), before, place)
        slot_of = slots_of(table, r.slot_of_source)
        q, tip, free, on_tip, soft, quantities = move(
            table, before, s.places, numbers, s.numbers, s.walls, s.posts, a.form, a.frame, a.anchors, a.L_inverse, a.sources,
            a.felt, r.slots, slot_of, r.inverse,
        )  # fmt: skip
        limit, _ = allowed(table, before, q, free, numbers, s.numbers)
        mesh, change = r.field(slot_of, q, tip, soft, on_tip, at, was)
        if change > limit * limit:
            start, stay = table[:, 2:4].copy(), tip.copy()
            if tip[0] > 0.0:
                stay[3:5] = self._value_before(table, before, tip, slot_of, quantities, float(numbers[14]))
            rest, _ = r.field(slot_of, start, stay, soft, on_tip)
            share = largest_share(rest[at] - was[at], mesh[at] - was[at], limit)
            q = start + share * (q - start)
            tip[3:5] = stay[3:5] + share * (tip[3:5] - stay[3:5])
            mesh = rest + share * (mesh - rest)
            held_back += 1
        table[:, 2:4] = q
        keep = (table[:, 1] > 0.0) | (np.hypot(*(q - free).T) > LET_GO)
        if not keep.all():
            table = table[keep]
            slot_of = r.set_contacts(table[:, 0].astype(np.int64))
            mesh, _ = r.field(slot_of, table[:, 2:4].copy(), tip, soft, self._on_tip(table, tip))
        tip[11] = np.hypot(*mesh[at].T).max()
        return table, tip, mesh, held_back

    def _value_before(
        self,
        table: Floats,
        before: Floats,
        tip: Floats,
        slot_of: NDArray[np.int64],
        quantities: Quantities,
        soft: float,
    ) -> tuple[float, float]:
        """Field at the tip's landmark before the step, mm."""
        r, q = self.response, table[:, 2:4].copy()
        x, y = (tip[1:3] - r.scene.centre) / r.scene.scale
        bx, by = (before[1:3] - r.scene.centre) / r.scene.scale
        spoken = self._on_tip(table, before)
        if spoken >= 0:
            q[spoken], before = before[3:5], NO_TIP
        old = r.at_point(np.array([bx, by])) if before[0] > 0.0 else quantities
        value: tuple[float, float] = value_before(
            r.scene.form, quantities[3], quantities[0], x, y, before, bx, by, soft, q, slot_of, old
        )
        return value

    def _on_tip(self, table: Floats, tip: Floats) -> int:
        """Contact for which a tip's landmark speaks, or -1."""
        if tip[0] == 0.0 or not len(table):
            return -1
        places = self.setting.places[:, table[:, 0].astype(np.int64)]
        distance = np.hypot(places[0] - tip[1], places[1] - tip[2])
        nearest = int(distance.argmin())
        return nearest if distance[nearest] <= SAME_PLACE else -1

    def fine(self, state: FusedState, field: PixelField) -> Floats:
        """Displacement of a fine mesh, shape (n, 2) mm."""
        with self.lock:
            slot_of = self.response.set_contacts(state.landmarks[:, 0].astype(np.int64))
            on_tip = self._on_tip(state.landmarks, state.tip)
            q = np.ascontiguousarray(state.landmarks[:, 2:4])
            return field(self.response, state.mesh, slot_of, q, state.tip, self._soft(state), on_tip)

    def _soft(self, state: FusedState) -> float:
        """Softness of a state's tip landmark."""
        if self.setting.tip_softness is None or not state.tip[0]:
            return 0.0
        return self.setting.tip_softness((float(state.tip[1]), float(state.tip[2])))

    def spline(self, state: FusedState) -> Spline | None:
        """Return the field of a state as a spline, in double precision; None where nothing is displaced."""
        if not len(state.landmarks) and not state.tip[0]:
            return None
        with self.lock:
            soft = self._soft(state)
            slot_of = self.response.set_contacts(state.landmarks[:, 0].astype(np.int64))
            on_tip = self._on_tip(state.landmarks, state.tip)
            return self.response.spline(slot_of, state.landmarks[:, 2:4], state.tip, soft, on_tip)


def _try_out(precision: Precision) -> None:
    """Call everything that a step may call, in a scene as small as can be, so that it is compiled."""
    grid = RegularGrid((7, 7), (1.0, 1.0))
    nodes, edge = grid.nodes, grid.boundary(("left", "right", "bottom"))
    inner = np.setdiff1d(np.arange(grid.size), edge)
    scene = AnchoredKernel.factor(ThinPlate(), nodes[edge], nodes, sources=nodes[inner])
    numbers = np.array([0.5, 1.2, 0.1, 0.1, 1.0, 1.0, 1.0, 0.25, 0.0, 0.0])
    walls = np.array([0.0, 6.0, -inf, 6.0])
    setting = Setting(numbers, np.ascontiguousarray(nodes[inner].T), walls, np.empty((0, 2)))
    model = FusedStep.__new__(FusedStep)
    model._begin(Response(scene, inner, precision), setting)
    state = model.rest()
    for depth, speed in ((0.5, 1.0), (2.6, 1.0), (2.61, 1.0), (0.3, -1.0), (0.3, 0.0)):
        state = model.advance(state, NeedlePose((3.1, 0.0), (3.1, depth), speed), 0.1)
    r = model.response
    r.prepare(np.zeros(2), np.zeros(2), rows=r.sources_in_patch)
    r.set_contacts(np.arange(6))
    r.set_contacts(np.arange(3, 6))
    q, slots = np.zeros((3, 2)), r.slot_of_source[3:6]
    r.field(slots, q)
    quantities = r.at_point(np.zeros(2))
    value_before(
        scene.form, quantities[3], quantities[0], 0.0, 0.0, np.ones(12), 0.1, 0.1, 0.0, q, slots, quantities
    )
