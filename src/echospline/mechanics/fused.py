"""One step of the tissue model by the response: from a needle pose to the deformed mesh without refitting anything.

The same numbers as `tps.TPSModel` reading Algorithm 2 in NumPy, in one compiled call as long as the contacts stay the same.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from echospline.mechanics.anchored_kernel import AnchoredKernel
from echospline.mechanics.compiled import compile_ahead
from echospline.mechanics.compiled_step import (
    BEYOND,
    CONTACTS,
    RELEASED,
    allowed,
    move,
    released,
    spoken,
    step,
)
from echospline.mechanics.interaction import largest_share
from echospline.mechanics.kernels import ThinPlate
from echospline.mechanics.pixel_field import PixelField
from echospline.mechanics.response import NO_TIP, Precision, Response
from echospline.mechanics.spline import Spline
from echospline.mechanics.tip_patch import PARTS
from echospline.mechanics.touch import needle
from echospline.scene import Floats, NeedlePose, RegularGrid

PLAIN = np.empty(0)


class FusedState(NamedTuple):
    """What the tissue remembers, as the compiled step takes it.

    Parameters
    ----------
    landmarks : ndarray, shape (k, 7)
        Contacts, `touch.COLUMNS`, ascending.
    tip : ndarray, shape (12,)
        The tip's own landmark and the last pose, `touch.TIP`.
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
        `touch.SETTING`; 1 for immediate loading, 1 for a tip on a node.
    places : ndarray, shape (2, K)
        The nodes that may become contacts, line by line of the lattice (y, then x ascending), mm.
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
        self.points = len(response.scene.points)
        self.lines = _lines(setting.places)
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
        s, r = self.setting, self.response
        place, before = self._place(state, pose), state.tip
        where = _floats(pose)
        while True:
            outcome, table, tip, mesh, how, lacks = step(
                r.basis, s.places, self.lines, s.posts, s.walls, s.numbers, state.landmarks, before, state.mesh, place,
                *where, float(dt),
            )  # fmt: skip
            if outcome != CONTACTS:
                break
            r.set_contacts(table[:, 0])
        held_back = state.held_back
        if outcome == BEYOND:
            table, tip, mesh = self._hold_back(state, pose, dt, place, table)
            held_back += 1
        elif outcome == RELEASED:
            table, tip, mesh = self._without_released(table, tip, state.mesh)
        if how == 2:
            r.statistics.direct += 1
        if lacks:
            r.prepare(tip, before)
        return FusedState(table, tip, mesh, held_back)

    def _hold_back(
        self, state: FusedState, pose: NeedlePose, dt: float, place: Floats, table: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Move the landmarks only so far that no node moves beyond the limit, by the field's linearity, as
        `tps.TPSModel` does."""
        s, r = self.setting, self.response
        before, was, at, k = state.tip, state.mesh, r.at, len(table)
        numbers = needle(*_floats(pose), float(dt), bool(s.numbers[8]), before, place)
        tip, on_tip, soft = move(r.basis, s.places, s.posts, s.walls, s.numbers, table, before, numbers)
        q, free = r.q[:k].copy(), r.free[:k].copy()
        limit = allowed(table, before, numbers, s.numbers)
        mesh, _, _ = r.field(table, q, tip, soft, on_tip)
        start, stay = table[:, 2:4].copy(), tip.copy()
        if tip[0] > 0.0:
            stay[3:5] = self._value_before(table, before, tip, float(numbers[14]))
        rest, _, _ = r.field(table, start, stay, soft, on_tip)
        share = largest_share(rest[at] - was[at], mesh[at] - was[at], limit)
        q = start + share * (q - start)
        tip[3:5] = stay[3:5] + share * (tip[3:5] - stay[3:5])
        mesh = rest + share * (mesh - rest)
        table[:, 2:4] = q
        kept = released(table, free)
        if kept < k:
            return self._without_released(table[:kept], tip, was)
        tip[11] = np.hypot(*mesh[at].T).max()
        return table, tip, mesh

    def _without_released(self, table: Floats, tip: Floats, was: Floats) -> tuple[Floats, Floats, Floats]:
        """Let go the contacts that a table does not have any more."""
        self.response.set_contacts(table[:, 0])
        q, soft, on_tip = table[:, 2:4].copy(), self._soft(tip), self._on_tip(table, tip)
        mesh, _, tip[11] = self.response.field(table, q, tip, soft, on_tip, was)
        return table, tip, mesh

    def _value_before(self, table: Floats, before: Floats, tip: Floats, soft: float) -> tuple[float, float]:
        """Field at the tip's landmark before the step, mm."""
        q = table[:, 2:4].copy()
        on_tip = self._on_tip(table, before)
        if on_tip >= 0:
            q[on_tip], before = before[3:5], NO_TIP
        return self.response.before(table, q, before, soft, tip[1:3])

    def _on_tip(self, table: Floats, tip: Floats) -> int:
        """Contact for which a tip's landmark speaks, or -1."""
        return int(spoken(self.setting.places, table, tip))

    def fine(self, state: FusedState, field: PixelField) -> Floats:
        """Displacement of a fine mesh, shape (n, 2) mm."""
        with self.lock:
            self.response.set_contacts(state.landmarks[:, 0])
            on_tip = self._on_tip(state.landmarks, state.tip)
            return field(self.response, state.mesh, state.landmarks, state.tip, self._soft(state.tip), on_tip)

    def _soft(self, tip: Floats) -> float:
        """Softness of a tip's landmark."""
        if self.setting.tip_softness is None or not tip[0]:
            return 0.0
        return self.setting.tip_softness((float(tip[1]), float(tip[2])))

    def spline(self, state: FusedState) -> Spline | None:
        """Return the field of a state as a spline, in double precision; None where nothing is displaced."""
        if not len(state.landmarks) and not state.tip[0]:
            return None
        with self.lock:
            soft = self._soft(state.tip)
            self.response.set_contacts(state.landmarks[:, 0])
            on_tip = self._on_tip(state.landmarks, state.tip)
            return self.response.spline(state.landmarks, state.landmarks[:, 2:4], state.tip, soft, on_tip)


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
    tip = np.array([1.0, 2.2, 2.1, 0, 0, 1, 1, 0, 0, 0, 0, 0])
    r.prepare(tip, tip, PARTS)
    r.set_contacts(np.arange(6))
    r.set_contacts(np.arange(3, 6))
    table = np.zeros((3, 7))
    table[:, 0] = np.arange(3, 6)
    q = np.zeros((3, 2))
    r.field(table, q, tip)
    r.before(table, q, tip, 0.0, np.ones(2))
    r.spline(table, q, tip)
    # what holds a step back, here only to be there: this scene is too calm for it
    pose = needle(3.1, 0.0, 3.1, 2.0, 1.0, 0.1, False, tip, PLAIN)
    places, posts = setting.places, setting.posts
    move(r.basis, places, posts, walls, numbers, table, tip, pose)
    allowed(table, tip, pose, numbers)
    released(table, r.free[:3].copy())


def _floats(pose: NeedlePose) -> tuple[float, float, float, float, float]:
    """Entry, tip and speed. Whole numbers would be another type for the compiler, which would start again in the loop."""
    (ex, ey), (tx, ty) = pose.entry, pose.tip
    return float(ex), float(ey), float(tx), float(ty), float(pose.speed)


def _lines(places: Floats) -> Floats:
    """Rows of the lattice, as `touch.touched` takes them, shape (j + 1, 2): first place, y."""
    y, count = places[1], places.shape[1]
    first = np.flatnonzero(np.diff(y, prepend=np.nan) != 0.0)
    return np.array([*zip(first, y[first], strict=True), (count, 0.0)], dtype=np.float64).reshape(-1, 2)
