"""The spline model read in plain NumPy, in the plane and in space: the reference with which the core is compared."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import expm1, inf, isfinite

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.mechanics.interaction import (
    CALM,
    LET_GO,
    Pose,
    approach,
    friction,
    largest_share,
    load,
    needle_travel,
    relax,
    tip_push,
)
from echospline.mechanics.kernels import Kernel
from echospline.mechanics.landmarks import Anchors, Clamps, Mesh
from echospline.mechanics.parameters import TPSParameters
from echospline.mechanics.spline import Spline, factor
from echospline.scene import ZERO_LENGTH, Floats

Nodes = NDArray[np.intp]


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

    def advance(self, state: TPSState, pose: Pose, dt: float) -> TPSState:
        """State after the needle has moved to ``pose`` in ``dt`` seconds, Algorithm 2."""
        p = self.parameters
        axis = np.array(pose.axis)
        immediate = p.loading == "immediate"
        way = pose.depth if state.pose is None else needle_travel(state.pose, pose)
        travel = inf if immediate else way

        old = state
        state = self._touch(old, pose, leave_at_once=immediate)
        nodes = self.grid.nodes[state.contacts]
        q = state.q.copy()
        on = state.touching
        distance = self._distance(nodes[on], q[on], pose)[1]
        shaft = np.asarray(pose.entry) + state.along[on, None] * axis
        side = _across(state.grip[on] + p.drag * shaft, axis)
        f = friction(distance, pose.speed, p.alpha1, p.alpha2, p.length)
        q[on] = load(q[on], f, side, axis, p.alpha3, dt, travel)

        tip = self._tip(old, state, q, pose, dt, travel)
        off = ~on
        free = np.zeros_like(q[off])
        if off.any():
            without = self._fit(state.contacts[on], q[on], tip)
            free = free if without is None else without(nodes[off])
            q[off] = approach(relax(q[off], free, p.alpha3, dt), free, travel)
        displaced = state.q if old.tip is None else np.vstack([state.q, old.tip.q])
        relaxed = float(_lengths(displaced).max(initial=0.0)) * -expm1(-p.alpha3 * dt)
        state, tip = self._hold_back(old, state, q, tip, CALM * (travel + relaxed) + LET_GO)

        keep = np.ones(len(state.q), dtype=bool)
        keep[off] = _lengths(state.q[off] - free) > LET_GO
        if not keep.all():
            state = _select(state, keep)
            state = replace(state, field=self._fit(state.contacts, state.q, tip))
            state = replace(state, lattice=self._on_lattice(state.field))
        return replace(state, pose=pose, tip=tip)

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
        self, old: TPSState, new: TPSState, q: Floats, tip: Tip | None, limit: float
    ) -> tuple[TPSState, Tip | None]:
        """Move the landmarks to their new displacements, or as far that way as no node moves beyond the limit.

        A few landmarks close together can swing the field far from them much further than they move themselves.
        Landmarks that stay at the displacement which the field already has change nothing, and the field is
        linear in their displacements, so the largest share that keeps the limit is found at once.
        """
        was = self._at_lattice(old)
        field = self._fit(new.contacts, q, tip)
        u = self._on_lattice(field)
        if not isfinite(limit) or _lengths(_zero(u, was) - was).max(initial=0.0) <= limit:
            return replace(new, q=q, field=field, lattice=u), tip
        stay = None if tip is None else replace(tip, q=self.displacement_at(old, tip.point[None])[0])
        rest = _zero(self._on_lattice(self._fit(new.contacts, new.q, stay)), was) - was
        share = largest_share(rest, _zero(u, was) - was, limit)
        q = new.q + share * (q - new.q)
        if tip is not None and stay is not None:
            tip = replace(tip, q=stay.q + share * (tip.q - stay.q))
        field = self._fit(new.contacts, q, tip)
        return replace(
            new, q=q, field=field, lattice=self._on_lattice(field), held_back=old.held_back + 1
        ), tip

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
        self, old: TPSState, new: TPSState, q: Floats, pose: Pose, dt: float, travel: float
    ) -> Tip | None:
        """Return the tip's landmark, equation (12); None where the tip pushes nothing."""
        p, axis, point = self.parameters, np.array(pose.axis), np.asarray(pose.tip)
        clearance = self.clamps.clearance(pose.tip, axis)
        if clearance <= 0.0 or p.sigma == 0.0:
            return None
        push = tip_push(pose, p.sigma, clearance) * axis
        advancing = pose.speed >= 0 and pose.depth >= ZERO_LENGTH
        if p.tip == "node":
            node = self.grid.nearest(pose.tip)
            if not advancing or self.clamps.held[node].any():
                return None
            place = self.grid.nodes[node]
            return Tip(place, point + push - place)
        if p.loading == "immediate":
            return Tip(point, push) if advancing else None
        return self._following_tip(old, new, q, pose, push if advancing else None, dt, travel)

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

    def _leaving_tip(self, tip: Tip, new: TPSState, q: Floats, dt: float, travel: float) -> Tip | None:
        """Let the landmark that the tip has left relax to the field without it, then go."""
        field = self._fit(new.contacts, q)
        free = np.zeros_like(tip.q) if field is None else field(tip.point)[0]
        if _lengths(tip.q - free) <= LET_GO:
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
            apart = _lengths(landmarks[1] - tip.point) > 1e-6  # a tip on a node speaks for it
            contacts = contacts[apart]
            landmarks = [anchors, landmarks[1][apart], tip.point[None]]
            moves = [moves[0], q[apart], tip.q[None]]
        every = np.vstack(landmarks)
        held = np.ones(every.shape, dtype=bool)
        held[: len(anchors)] = self.anchors.held
        return factor(self.kernel, every, self._stiffness(contacts, tip), held).solve(np.vstack(moves))

    def _stiffness(self, contacts: Nodes, tip: Tip | None) -> Floats | None:
        """Return the stiffness of anchors (infinite), contacts and tip."""
        if self.stiffness is None:
            return None
        own = [np.full(len(self.anchors), inf), self.stiffness[contacts]]
        if tip is not None:
            own.append(self.stiffness[[self.grid.nearest(tip.point)]])
        return np.concatenate(own)


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
