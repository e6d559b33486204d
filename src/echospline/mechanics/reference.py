"""The spline model read in plain NumPy, in the plane and in space: the reference with which the core is compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import ceil, expm1, inf, isfinite

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.mechanics.interaction import (
    CALM,
    LET_GO,
    MOST_SUBSTEPS,
    Pose,
    approach,
    friction,
    largest_share,
    load,
    longest_substep,
    needle_travel,
    relax,
    stick,
    tip_push,
    yielding,
)
from echospline.mechanics.kernels import Kernel
from echospline.mechanics.landmarks import Anchors, Clamps, Mesh
from echospline.mechanics.parameters import TPSParameters
from echospline.mechanics.spline import Spline, factor
from echospline.scene import ZERO_LENGTH, Floats

Nodes = NDArray[np.intp]

SAME_PLACE = 1e-6
"""mm; a tip closer than this to a contact replaces it as landmark, and one so close to what is clamped pushes nothing."""


@dataclass(frozen=True)
class Tip:
    """The landmark of the tip.

    Parameters
    ----------
    point : ndarray, shape (D,)
        Where it stands in the undeformed tissue, mm.
    q : ndarray, shape (D,)
        Its displacement, mm.
    pushed : bool
        Whether the needle's tip is there and pushes; otherwise the needle has left it and it relaxes.
    """

    point: Floats
    q: Floats
    pushed: bool = True


@dataclass(frozen=True)
class TPSState:
    """What the tissue remembers.

    Parameters
    ----------
    pose : Pose or None
        The last pose; None at rest.
    contacts : ndarray of int, shape (k,)
        Nodes that are landmarks now, ascending: in contact, or leaving.
    touching : ndarray of bool, shape (k,)
        Which of them touch the needle; the others have left it and relax.
    q : ndarray, shape (k, D)
        Their displacements, mm.
    along : ndarray, shape (k,)
        Where on the shaft each was touched: distance from the entry, mm.
    grip : ndarray, shape (k, D)
        Displacement across the axis less the shaft's position when it was touched, mm.
    tip : Tip or None
        The tip's own landmark; None where the tip pushes nothing.
    field : Spline or None
        The displacement field; None where nothing is displaced.
    lattice : ndarray, shape (K, D), or None
        The field at the nodes that may become contacts, mm; None where nothing is displaced.
    held_back : int
        Steps since rest in which the landmarks were slowed down so that the picture does not jump.
    """

    pose: Pose | None = None
    contacts: Nodes = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    touching: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))
    q: Floats = field(default_factory=lambda: np.empty((0, 2)))
    along: Floats = field(default_factory=lambda: np.empty(0))
    grip: Floats = field(default_factory=lambda: np.empty((0, 2)))
    tip: Tip | None = None
    field: Spline | None = None
    lattice: Floats | None = None
    held_back: int = 0


class Reference:
    """Algorithm 2 in plain NumPy, a spline fitted anew at each step: the reference for the core.

    The dimension D is that of the mesh.

    Parameters
    ----------
    grid : Mesh
        The mesh.
    parameters : TPSParameters
        Of the interaction.
    kernel : Kernel
        `ThinPlate` (the paper) or `Elastic`, of the mesh's dimension.
    clamps : Clamps
        The clamped and sliding edges (faces), and clamped points.
    anchors : Anchors
        Landmarks along them that stay.
    lattice : ndarray of int, shape (K,)
        Mesh nodes that may become contacts.
    gap : float
        Distance from the tip within which no node joins, mm.
    stiffness : ndarray, shape (n,), or None
        Per mesh node; infinite where None.
    """

    def __init__(
        self,
        grid: Mesh,
        parameters: TPSParameters,
        kernel: Kernel,
        clamps: Clamps,
        anchors: Anchors,
        lattice: Nodes,
        gap: float,
        stiffness: Floats | None,
    ) -> None:
        self.grid, self.parameters, self.kernel, self.clamps = grid, parameters, kernel, clamps
        self.anchors, self.lattice, self.gap, self.stiffness = anchors, lattice, gap, stiffness
        # of the nodes that may become contacts, from what is clamped: beside a sliding edge tissue can follow
        none = np.zeros(len(grid.shape))
        self.clearance = np.array([clamps.clearance(node, none) for node in grid.nodes[lattice]])

    def advance(self, state: TPSState, pose: Pose, dt: float) -> TPSState:
        """State after the needle has moved to ``pose`` in ``dt`` seconds, Algorithm 2.

        A needle that moves far in one step does so in substeps, so that what it touches and leaves does not depend
        on the time step. Only the printed loading, which moves everything at once, takes a step as one.
        """
        before = _at(pose.entry, pose.entry) if state.pose is None else state.pose
        parts = 1
        if self.parameters.loading != "immediate":
            parts = max(
                1,
                min(
                    MOST_SUBSTEPS,
                    ceil(needle_travel(before, pose) / longest_substep(self.parameters.delta) - 1e-9),
                ),
            )
        held_back = state.held_back
        for part in range(1, parts + 1):
            there = pose if part == parts else _between(before, pose, part / parts)
            state = self._substep(state, there, dt / parts)
        return replace(state, held_back=held_back + (state.held_back > held_back))

    def _substep(self, old: TPSState, pose: Pose, dt: float) -> TPSState:
        p = self.parameters
        immediate = p.loading == "immediate"
        before = _at(pose.entry, pose.entry) if old.pose is None else old.pose
        travel = inf if immediate else needle_travel(before, pose)
        state = self._touch(old, pose, leave_at_once=immediate)
        on, off = state.touching, ~state.touching
        while_touched, since_left = self._ways(old, state, pose, before, travel)

        handled = on | (while_touched > 0)  # one that has just left was dragged until then
        q = state.q.copy()
        q[handled] = self._handled(state, handled, pose, before, dt, while_touched)
        tip = self._tip(old, state, q, pose, before, dt, travel)
        free = np.zeros_like(q[off])
        if off.any():
            without = self._fit(state.contacts[on], q[on], tip)
            free = free if without is None else without(self.grid.nodes[state.contacts[off]])
            if tip is not None:  # a contact that the tip replaces goes with it
                free[self._on_tip(state.contacts[off], tip)] = tip.q
            q[off] = self._returned(q[off], free, dt, since_left[off], travel)

        displaced = state.q if old.tip is None else np.vstack([state.q, old.tip.q])
        relaxed = float(_lengths(displaced).max(initial=0.0)) * -expm1(-p.alpha3 * dt)
        limit = CALM * (travel + relaxed) + LET_GO
        state, tip = self._hold_back(old, state, q, tip, limit, dt)
        return self._release(replace(state, pose=pose, tip=tip), off, free)

    def _ways(
        self, old: TPSState, new: TPSState, pose: Pose, before: Pose, travel: float
    ) -> tuple[Floats, Floats]:
        """How far the needle moved while it touched each contact, and since it left it, mm, shape (k,) each.

        The tip has passed a contact that joins, and drawn back from one that leaves, somewhere within the step.
        """
        while_touched = np.where(new.touching, travel, 0.0)
        since_left = np.where(new.touching, 0.0, travel)
        if isfinite(travel):
            touched = np.isin(new.contacts, old.contacts[old.touching])
            out = pose.depth < ZERO_LENGTH
            axis = np.array(before.axis if out else pose.axis)
            passed = pose.depth - self.gap - (self.grid.nodes[new.contacts] - pose.entry) @ axis
            fresh, left = new.touching & ~touched, ~new.touching & touched
            while_touched[fresh] = np.clip(passed[fresh], 0.0, travel)
            drawn_back = left & ((passed < 0) | out)
            since_left[drawn_back] = np.clip(-passed[drawn_back], 0.0, travel)
            while_touched[left] = travel - since_left[left]
        return while_touched, since_left

    def _handled(
        self,
        state: TPSState,
        which: NDArray[np.bool_],
        pose: Pose,
        before: Pose,
        dt: float,
        travel: Floats,
    ) -> Floats:
        """Return new displacements of contacts that the needle touches, or touched in this step; (13) to (16)."""
        p, axis, travel = self.parameters, np.array(pose.axis), travel[which]
        q, nodes = state.q[which], self.grid.nodes[state.contacts[which]]
        distance = self._distance(nodes, q, pose)[1]
        shaft = np.asarray(pose.entry) + state.along[which, None] * axis
        side = _across(state.grip[which] + p.drag * shaft, axis)
        sticks = p.loading == "stick"
        f = friction(distance, p.friction_speed if sticks else pose.speed, p.alpha1, p.alpha2, p.length)
        if p.loading != "immediate":
            f = yielding(f, self.clearance[np.searchsorted(self.lattice, state.contacts[which])])
        # a shaft that hardly is in the tissue drags it no further than its own depth
        most = inf if p.loading == "immediate" else pose.depth
        if not sticks:
            return load(q, f, side, axis, p.alpha3, dt, travel, most)
        moved = np.clip(float(np.subtract(pose.tip, before.tip) @ axis), -travel, travel)
        return stick(q, np.minimum(np.abs(f), most), moved, side, axis, travel)

    def _returned(self, q: Floats, free: Floats, dt: float, since: Floats, travel: float) -> Floats:
        """Return displacements of contacts that the needle has left, on their way to the field without them."""
        share = since / travel if 0.0 < travel < inf else np.ones_like(since)
        left_over = np.exp(-self.parameters.alpha3 * dt * share)[:, None]
        return approach(free + (q - free) * left_over, free, since)

    def rest(self) -> TPSState:
        """State of tissue that no needle has touched."""
        none = np.empty((0, self._dimension))
        return TPSState(q=none, grip=none)

    def displacement_at(self, state: TPSState, points: ArrayLike) -> Floats:
        """Displacement of any reference points (n, D) mm, shape (n, D), mm."""
        points = np.asarray(points, dtype=np.float64)
        return np.zeros(points.shape) if state.field is None else state.field(points)

    def spline(self, state: TPSState) -> Spline | None:
        """Return the spline through anchors and the landmarks of a state; None where nothing is displaced."""
        return self._fit(state.contacts, state.q, state.tip)

    def _hold_back(
        self,
        old: TPSState,
        new: TPSState,
        q: Floats,
        tip: Tip | None,
        limit: float,
        dt: float,
    ) -> tuple[TPSState, Tip | None]:
        """Move the landmarks to their new displacements, or as far that way as no node moves beyond the limit.

        A few landmarks close together can swing the field far from them much further than they move themselves.
        Landmarks that stay at the displacement which the field already has change nothing, and the field is
        linear in their displacements, so the largest share that keeps the limit is found at once. Only a tip that moves on
        takes a landmark away where it was; where that alone is too much, it leaves its landmark there.
        """
        was = self._at_lattice(old)
        field = self._fit(new.contacts, q, tip)
        u = self._on_lattice(field)
        if not isfinite(limit) or _lengths(_zero(u, was) - was).max(initial=0.0) <= limit:
            return replace(new, q=q, field=field, lattice=u), tip
        stay = None if tip is None else replace(tip, q=self.displacement_at(old, tip.point[None])[0])
        rest = _zero(self._on_lattice(self._fit(new.contacts, new.q, stay)), was) - was
        if old.tip is not None and _lengths(rest).max(initial=0.0) > limit:
            tip = self._leaving_tip(old.tip, new, q, dt, limit / CALM, drop=False)
            stay = old.tip
            u = self._on_lattice(self._fit(new.contacts, q, tip))
            rest = np.zeros_like(rest)
        share = largest_share(rest, _zero(u, was) - was, limit)
        q = new.q + share * (q - new.q)
        if tip is not None and stay is not None:
            tip = replace(tip, q=stay.q + share * (tip.q - stay.q))
        field = self._fit(new.contacts, q, tip)
        return replace(
            new, q=q, field=field, lattice=self._on_lattice(field), held_back=old.held_back + 1
        ), tip

    def _release(self, state: TPSState, off: NDArray[np.bool_], free: Floats) -> TPSState:
        """Drop contacts that the needle has left and that no longer matter: the field without each one is the same.

        One that has come to where it goes may still hold back others that have not; so each is judged by the field without
        it alone, and all that go in one step change the field by no more than one may.
        """
        close = np.zeros(len(state.q), dtype=bool)
        close[off] = _lengths(state.q[off] - free) <= LET_GO
        keep, changed = np.ones(len(state.q), dtype=bool), 0.0
        for j in np.flatnonzero(close):
            keep[j] = False
            if state.tip is not None and self._on_tip(state.contacts[j : j + 1], state.tip)[0]:
                without = state.tip.q
            else:
                rest = self._fit(state.contacts[keep], state.q[keep], state.tip)
                node = self.grid.nodes[state.contacts[j]]
                without = np.zeros_like(node) if rest is None else rest(node)[0]
            change = float(_lengths(state.q[j] - without))
            keep[j] = changed + change > LET_GO
            changed += 0.0 if keep[j] else change
        if keep.all():
            return state
        state = _select(state, keep)
        field = self._fit(state.contacts, state.q, state.tip)
        return replace(state, field=field, lattice=self._on_lattice(field))

    @property
    def _dimension(self) -> int:
        return len(self.grid.shape)

    def _at_lattice(self, state: TPSState) -> Floats:
        return np.zeros((len(self.lattice), self._dimension)) if state.lattice is None else state.lattice

    def _on_lattice(self, field: Spline | None) -> Floats | None:
        return None if field is None else field(self.grid.nodes[self.lattice])

    def _distance(self, nodes: Floats, u: Floats, pose: Pose) -> tuple[Floats, Floats]:
        """Distance from the entry along the axis, and d of equation (13), of nodes displaced by u; mm.

        Tissue that a tilting needle has pushed aside is still beside it: the part ``drag`` of the displacement
        across the axis counts. With drag = 0 this is (13) at the rest positions, as printed.
        """
        axis = np.array(pose.axis)
        offset = nodes + self.parameters.drag * _across(u, axis) - pose.entry
        along = offset @ axis
        beyond = along - np.clip(along, 0.0, pose.depth)
        aside = _across(offset, axis)
        return along, np.sqrt((aside * aside).sum(axis=-1) + beyond * beyond)

    def _touch(self, state: TPSState, pose: Pose, *, leave_at_once: bool) -> TPSState:
        """Let nodes join and leave; who joins has the displacement that the field already has there."""
        p, axis = self.parameters, np.array(pose.axis)
        points = self.grid.nodes[self.lattice]
        u = self._at_lattice(state)
        touched = np.zeros(len(points), dtype=bool)
        along = np.zeros(len(points))
        if pose.depth >= ZERO_LENGTH:
            along, distance = self._distance(points, u, pose)
            touched = (distance <= p.delta) & (along <= pose.depth - self.gap)
        here = np.searchsorted(self.lattice, state.contacts)
        listed = np.zeros(len(points), dtype=bool)
        listed[here] = True
        member = touched if leave_at_once else touched | listed
        q, s, grip = u.copy(), np.clip(along, 0.0, pose.depth), np.empty_like(u)
        q[here] = state.q
        fresh = touched.copy()
        fresh[here[state.touching]] = False
        s[here[state.touching]] = state.along[state.touching]
        grip[here] = state.grip
        shaft = np.asarray(pose.entry) + s[:, None] * axis
        grip[fresh] = p.drag * (_across(q, axis) - shaft)[fresh]
        return replace(
            state,
            contacts=self.lattice[member],
            touching=touched[member],
            q=q[member],
            along=s[member],
            grip=grip[member],
        )

    def _tip(
        self, old: TPSState, new: TPSState, q: Floats, pose: Pose, before: Pose, dt: float, travel: float
    ) -> Tip | None:
        """Return the tip's landmark, equation (12); None where the tip pushes nothing."""
        p, axis, point = self.parameters, np.array(pose.axis), np.asarray(pose.tip)
        clearance = self.clamps.clearance(pose.tip, axis)
        if p.sigma == 0.0 or (clearance <= 0.0 and (p.loading == "immediate" or p.tip == "node")):
            return None
        push = self._push(pose, clearance) * axis
        advancing = pose.speed >= 0 and pose.depth >= ZERO_LENGTH
        if p.tip == "node":
            node = self.grid.nearest(pose.tip)
            if not advancing or self.clamps.held[node].any():
                return None
            place = self.grid.nodes[node]
            return Tip(place, point + push - place)
        if p.loading == "immediate":
            return Tip(point, push) if advancing else None
        if p.loading == "stick":
            return self._sticking_tip(old, new, q, pose, before, dt, travel)
        inside = advancing and clearance > SAME_PLACE
        return self._following_tip(old, new, q, pose, push if inside else None, dt, travel)

    def _push(self, pose: Pose, clearance: float) -> float:
        """How far the tip pushes the tissue ahead of it, mm; beside what is clamped it fades as friction does, or as printed."""
        p = self.parameters
        if p.loading == "immediate":
            return tip_push(pose, p.sigma, clearance)
        return float(yielding(np.array([min(p.sigma, pose.depth)]), np.array([clearance]))[0])

    def _sticking_tip(
        self, old: TPSState, new: TPSState, q: Floats, pose: Pose, before: Pose, dt: float, travel: float
    ) -> Tip | None:
        """Return the tip's landmark where it pushes and never pulls: a stop with one side, whatever the speed.

        The landmark moves on with a tip that advances, pushed ahead by up to sigma. A tip that draws back lets the tissue
        there come back by as much, until the landmark does nothing and is gone; one that returns before that takes it up.
        """
        axis, point, tip = np.array(pose.axis), np.asarray(pose.tip), old.tip
        moved = float((point - before.tip) @ axis)
        lead = 0.0
        if tip is not None and tip.pushed:
            lead = max(0.0, float((tip.point - before.tip) @ np.array(before.axis)) - moved)
        elif tip is not None and (moved <= 0 or _lengths(point - tip.point) > max(travel, LET_GO)):
            return self._leaving_tip(tip, new, q, dt, travel)
        place = point + lead * axis
        clearance = self.clamps.clearance(place.tolist(), axis)
        if pose.depth < ZERO_LENGTH or clearance <= SAME_PLACE:
            return None if tip is None else self._leaving_tip(tip, new, q, dt, travel)
        clear = _lengths(self.grid.nodes[new.contacts[~new.touching]] - place).min(initial=inf) > self.gap
        if tip is None and (moved <= 0 or not clear):
            return None
        field = self._fit(new.contacts, q)
        free = np.zeros_like(point) if field is None else field(place)[0]
        was = self.displacement_at(old, place[None])[0] if tip is None else tip.q
        push = self._push(pose, clearance)
        ahead = max(min(float(was @ axis) + moved, push), float(free @ axis))
        pushed = approach(was[None], (ahead * axis + _across(free, axis))[None], travel)[0]
        if moved <= 0 and _lengths(pushed - free) <= LET_GO:
            return None
        return Tip(place, pushed)

    def _following_tip(
        self,
        old: TPSState,
        new: TPSState,
        q: Floats,
        pose: Pose,
        push: Floats | None,
        dt: float,
        travel: float,
    ) -> Tip | None:
        """Return the tip's landmark where it grows, moves and dies away without a jump; no push on withdrawal."""
        axis, point = np.array(pose.axis), np.asarray(pose.tip)
        # the tip of a needle that comes back to the landmark which it left takes it up again; one that pushes into
        # tissue where nodes still relax waits until they are gone: two landmarks in one place would tear the field
        clear = _lengths(self.grid.nodes[new.contacts[~new.touching]] - point).min(initial=inf) > self.gap
        back = old.tip is None or old.tip.pushed or _lengths(point - old.tip.point) <= max(travel, LET_GO)
        if push is None or not (clear and back):
            return None if old.tip is None else self._leaving_tip(old.tip, new, q, dt, travel)
        if old.tip is None and pose.speed <= 0:
            return None
        field = self._fit(new.contacts, q)
        free = np.zeros_like(point) if field is None else field(point)[0]
        # a tip that begins to push starts from the displacement that the tissue had there before the step
        was = self.displacement_at(old, point[None])[0] if old.tip is None else old.tip.q
        ahead = float(push @ axis)
        if pose.speed == 0:  # (17): at rest the whole field relaxes, the tip's push with the contacts
            was = (
                _across(was, axis) + relax(was, np.zeros_like(was), self.parameters.alpha3, dt) @ axis * axis
            )
            ahead = min(float(was @ axis), ahead)
        wanted = ahead * axis + _across(free, axis)
        return Tip(point, approach(was[None], wanted[None], travel)[0])

    def _leaving_tip(
        self, tip: Tip, new: TPSState, q: Floats, dt: float, travel: float, *, drop: bool = True
    ) -> Tip | None:
        """Let the landmark that the tip has left relax to the field without it, then go."""
        field = self._fit(new.contacts, q)
        free = np.zeros_like(tip.q) if field is None else field(tip.point)[0]
        if drop and _lengths(tip.q - free) <= LET_GO:
            return None
        relaxed = relax(tip.q, free, self.parameters.alpha3, dt)
        return Tip(tip.point, approach(relaxed[None], free[None], travel)[0], pushed=False)

    def _fit(self, contacts: Nodes, q: Floats, tip: Tip | None = None) -> Spline | None:
        """Spline through anchors, contacts and tip; None where there is nothing but anchors."""
        if tip is None and len(contacts) == 0:
            return None
        anchors = self.anchors.places
        landmarks = [anchors, self.grid.nodes[contacts]]
        moves = [np.zeros_like(anchors), q]
        if tip is not None:
            apart = ~self._on_tip(contacts, tip)
            contacts = contacts[apart]
            landmarks = [anchors, landmarks[1][apart], tip.point[None]]
            moves = [moves[0], q[apart], tip.q[None]]
        every = np.vstack(landmarks)
        held = np.ones(every.shape, dtype=bool)
        held[: len(anchors)] = self.anchors.held
        return factor(self.kernel, every, self._stiffness(contacts, tip), held).solve(np.vstack(moves))

    def _on_tip(self, contacts: Nodes, tip: Tip) -> NDArray[np.bool_]:
        """Which contacts the tip replaces as landmark, being in the same place."""
        there: NDArray[np.bool_] = _lengths(self.grid.nodes[contacts] - tip.point) <= SAME_PLACE
        return there

    def _stiffness(self, contacts: Nodes, tip: Tip | None) -> Floats | None:
        """Return the stiffness of anchors (infinite), contacts and tip."""
        if self.stiffness is None:
            return None
        own = [np.full(len(self.anchors), inf), self.stiffness[contacts]]
        if tip is not None:
            own.append(self.stiffness[[self.grid.nearest(tip.point)]])
        return np.concatenate(own)


@dataclass(frozen=True)
class _Between:
    """A pose within a step."""

    entry: tuple[float, ...]
    tip: tuple[float, ...]
    speed: float

    @property
    def depth(self) -> float:
        return float(np.linalg.norm(np.subtract(self.tip, self.entry)))

    @property
    def axis(self) -> tuple[float, ...]:
        length = self.depth
        share = 1.0 / length if length >= ZERO_LENGTH else 0.0
        return tuple(share * np.subtract(self.tip, self.entry))


def _at(entry: Sequence[float], tip: Sequence[float], speed: float = 0.0) -> Pose:
    return _Between(tuple(entry), tuple(tip), speed)


def _between(before: Pose, after: Pose, share: float) -> Pose:
    """Pose on the straight way of both ends of the needle, at the speed of the whole step."""
    entry, tip = (
        np.add(a, share * np.subtract(b, a))
        for a, b in ((before.entry, after.entry), (before.tip, after.tip))
    )
    return _at(entry.tolist(), tip.tolist(), after.speed)


def _lengths(vectors: Floats) -> Floats:
    """Lengths of vectors (..., D)."""
    lengths: Floats = np.linalg.norm(vectors, axis=-1)
    return lengths


def _across(vectors: Floats, axis: Floats) -> Floats:
    """Part of vectors (..., D) across the axis; all of it where there is no axis."""
    across: Floats = vectors - np.multiply.outer(vectors @ axis, axis)
    return across


def _select(state: TPSState, keep: NDArray[np.bool_]) -> TPSState:
    return replace(
        state,
        contacts=state.contacts[keep],
        touching=state.touching[keep],
        q=state.q[keep],
        along=state.along[keep],
        grip=state.grip[keep],
    )


def _zero(field: Floats | None, like: Floats) -> Floats:
    return np.zeros_like(like) if field is None else field
