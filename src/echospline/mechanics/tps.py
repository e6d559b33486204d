"""The tissue model of the paper: landmarks moved by the needle, a spline that carries them to the whole mesh.

One step (Algorithm 2): which nodes the shaft touches (13), how friction, rest and tilt move them (14)-(16), how the
tip pushes (12), and the spline through anchors, contacts and tip (2)-(9). Read in plain NumPy, refitting at each step;
`echospline.mechanics.response` reaches the same numbers faster.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from math import expm1, inf, isfinite
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.grid import Floats, RegularGrid
from echospline.mechanics.anchored_kernel import AnchoredKernel
from echospline.mechanics.compiled import forget_stale_code
from echospline.mechanics.fused import FusedState, FusedStep, Setting
from echospline.mechanics.interaction import (
    CALM,
    LET_GO,
    follow,
    friction,
    largest_share,
    load,
    needle_travel,
    relax,
    tip_push,
)
from echospline.mechanics.kernels import Kernel, ThinPlate
from echospline.mechanics.landmarks import Clamps, contact_lattice
from echospline.mechanics.pixel_field import FINE, PixelField
from echospline.mechanics.response import Precision, Response
from echospline.mechanics.spline import Spline, factor
from echospline.needle import ZERO_LENGTH, NeedlePose

Nodes = NDArray[np.intp]
Solver = Literal["response", "refit"]


@dataclass(frozen=True)
class TPSParameters:
    """Parameters of the interaction.

    Parameters
    ----------
    sigma : float
        Push of the tip, equation (12), mm.
    delta : float
        Reach of friction around the shaft, equation (13), mm.
    alpha1, alpha2 : float
        Friction, equation (15), s.
    alpha3 : float
        Rate of relaxation, equation (16), 1/s.
    length : float
        Length inside the exponential of equation (15), mm.
    drag : float
        Share of the shaft's sideways motion that contacts follow, 0 (the paper) to 1 (bonded).
    tip : {"point", "node"}
        A landmark at the tip itself, or the nearest mesh node as printed (which jumps).
    loading : {"follow", "immediate"}
        Friction grows no faster than the needle moves, or is there at once as printed.
    contact_spacing : float
        Distance between the nodes that may become contacts, mm; 0 takes every mesh node, as printed.
    anchor_spacing : float
        Greatest distance between anchors along the clamped edges, mm.
    """

    sigma: float = 1.0
    delta: float = 1.5
    alpha1: float = 0.08
    alpha2: float = 0.04
    alpha3: float = 1.0
    length: float = 1.0
    drag: float = 1.0
    tip: Literal["point", "node"] = "point"
    loading: Literal["follow", "immediate"] = "follow"
    contact_spacing: float = 1.25
    anchor_spacing: float = 1.5

    def __post_init__(self) -> None:
        limits = {
            "sigma": (0.0, inf, "mm"),
            "delta": (0.0, inf, "mm"),
            "alpha1": (-inf, inf, "s"),
            "alpha2": (-inf, inf, "s"),
            "alpha3": (0.0, inf, "1/s"),
            "length": (1e-9, inf, "mm"),
            "drag": (0.0, 1.0, "(no unit)"),
            "contact_spacing": (0.0, inf, "mm"),
            "anchor_spacing": (1e-3, inf, "mm"),
        }
        for name, (low, high, unit) in limits.items():
            value = getattr(self, name)
            if not (isfinite(value) and low <= value <= high):
                raise InputError(
                    f"{name} must be a finite number from {low:g} to {high:g} {unit}; got {value}"
                )
        if self.tip not in ("point", "node"):
            raise InputError(f'tip is "point" or "node"; got {self.tip!r}')
        if self.loading not in ("follow", "immediate"):
            raise InputError(f'loading is "follow" or "immediate"; got {self.loading!r}')


@dataclass(frozen=True)
class Tip:
    """The landmark of the tip.

    Parameters
    ----------
    point : ndarray, shape (2,)
        Where it stands in the undeformed tissue, mm.
    q : ndarray, shape (2,)
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
    pose : NeedlePose or None
        The last pose; None at rest.
    contacts : ndarray of int, shape (k,)
        Nodes that are landmarks now, ascending: in contact, or leaving.
    touching : ndarray of bool, shape (k,)
        Which of them touch the needle; the others have left it and relax.
    q : ndarray, shape (k, 2)
        Their displacements, mm.
    along : ndarray, shape (k,)
        Where on the shaft each was touched: distance from the entry, mm.
    grip : ndarray, shape (k, 2)
        Displacement across the axis less the shaft's position when it was touched, mm.
    tip : Tip or None
        The tip's own landmark; None where the tip pushes nothing.
    field : Spline or None
        The displacement field; None where nothing is displaced.
    lattice : ndarray, shape (K, 2), or None
        The field at the nodes that may become contacts, mm; None where nothing is displaced.
    held_back : int
        Steps since rest in which the landmarks were slowed down so that the picture does not jump.
    """

    pose: NeedlePose | None = None
    contacts: Nodes = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    touching: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))
    q: Floats = field(default_factory=lambda: np.empty((0, 2)))
    along: Floats = field(default_factory=lambda: np.empty(0))
    grip: Floats = field(default_factory=lambda: np.empty((0, 2)))
    tip: Tip | None = None
    field: Spline | None = None
    lattice: Floats | None = None
    held_back: int = 0


State = TPSState | FusedState


class TPSModel:
    """Tissue as a landmark spline.

    Parameters
    ----------
    grid : RegularGrid
        The mesh, 2 x 2 nodes or more.
    clamped : iterable of {"top", "bottom", "left", "right"}
        Edges that anchors hold: the same that finite elements clamp.
    parameters : TPSParameters
        Of the interaction.
    kernel : Kernel
        `ThinPlate` (the paper) or `Elastic`.
    clamped_points : array_like, shape (k, 2), optional
        Further anchors, mm.
    stiffness : array_like, shape (n,), optional
        Per mesh node: how firmly a landmark there holds its displacement (see `spline.factor`); infinite when
        not given.
    solver : {"response", "refit"}
        How a step reaches its numbers: the mesh's response kept and updated (`fused`), or a spline fitted anew at
        each step, as Algorithm 1 is printed. The states of the two are not interchangeable.
    precision : {"single", "double"}
        Of the product that moves the mesh, with the solver "response". The single one stays within 1e-4 mm.

    Raises
    ------
    InputError
        If an edge has another name, the anchors do not determine a spline, or a stiffness is not positive.
    """

    def __init__(
        self,
        grid: RegularGrid,
        clamped: Iterable[str] = ("left", "right", "bottom"),
        parameters: TPSParameters | None = None,
        kernel: Kernel | None = None,
        *,
        clamped_points: ArrayLike | None = None,
        stiffness: ArrayLike | None = None,
        solver: Solver = "response",
        precision: Precision = "single",
    ) -> None:
        if solver not in get_args(Solver):
            raise InputError(f"solver is one of {', '.join(get_args(Solver))}; got {solver!r}")
        if precision not in get_args(Precision):
            raise InputError(f"precision is one of {', '.join(get_args(Precision))}; got {precision!r}")
        self.grid = grid
        self.parameters = parameters or TPSParameters()
        self.kernel = kernel or ThinPlate()
        self.clamps = Clamps.of(grid, clamped, clamped_points)
        self.anchors = self.clamps.anchors(self.parameters.anchor_spacing)
        factor(self.kernel, self.anchors)  # refuses anchors that hold nothing, before any step is made
        self.lattice = contact_lattice(self.clamps, self.parameters.contact_spacing)
        self.gap = 0.25 * _spacing(grid, self.lattice)
        self.stiffness: Floats | None = None
        if stiffness is not None:
            k = np.array(np.broadcast_to(np.asarray(stiffness, dtype=np.float64), (grid.size,)))
            if not (k > 0).all():
                raise InputError(f"every stiffness must be positive (or infinite); got {k.min()}")
            self.stiffness = k
        self.pixels: PixelField | None = None
        self.fast = self._fused(precision) if solver == "response" else None

    def rest(self) -> State:
        """State of tissue that no needle has touched."""
        return TPSState() if self.fast is None else self.fast.rest()

    def displacement(self, state: State) -> Floats:
        """Displacement of the mesh nodes, shape (n, 2), mm."""
        if isinstance(state, FusedState):
            return state.mesh if self.pixels is None else self._fast().fine(state, self.pixels)
        return self.displacement_at(state, self.grid.nodes)

    def displacement_at(self, state: State, points: ArrayLike) -> Floats:
        """Displacement of any reference points (n, 2) mm, shape (n, 2), mm."""
        points = np.asarray(points, dtype=np.float64)
        field = self.spline(state)
        return np.zeros(points.shape) if field is None else field(points)

    def spline(self, state: State) -> Spline | None:
        """Return the displacement field as a spline (it can be evaluated elsewhere); None where nothing is displaced."""
        return self._fast().spline(state) if isinstance(state, FusedState) else state.field

    def advance(self, state: State, pose: NeedlePose, dt: float) -> State:
        """State after the needle has moved to ``pose`` in ``dt`` seconds, Algorithm 2.

        Raises
        ------
        InputError
            If dt is negative or not finite.
        """
        if not (isfinite(dt) and dt >= 0):
            raise InputError(f"dt must be zero or a positive number of seconds; got {dt}")
        if isinstance(state, FusedState):
            return self._fast().advance(state, pose, dt)
        if self.fast is not None:
            raise InputError('this state belongs to a model with the solver "refit"; this one has "response"')
        return self._refit(state, pose, dt)

    def _refit(self, state: TPSState, pose: NeedlePose, dt: float) -> TPSState:
        """Algorithm 2 in plain NumPy, a spline fitted anew at each step: the reference for the fast solver."""
        p = self.parameters
        axis = np.array(pose.axis)
        before = state.pose or NeedlePose(pose.entry, pose.entry)
        immediate = p.loading == "immediate"
        travel = inf if immediate else needle_travel(before, pose)

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
        free = np.zeros((int(off.sum()), 2))
        if off.any():
            without = self._fit(state.contacts[on], q[on], tip)
            free = free if without is None else without(nodes[off])
            q[off] = follow(relax(q[off], free, p.alpha3, dt), free, travel)
        displaced = state.q if old.tip is None else np.vstack([state.q, old.tip.q])
        relaxed = float(np.hypot(*displaced.T).max(initial=0.0)) * -expm1(-p.alpha3 * dt)
        state, tip = self._hold_back(old, state, q, tip, CALM * (travel + relaxed) + LET_GO)

        keep = np.ones(len(state.q), dtype=bool)
        keep[off] = np.hypot(*(state.q[off] - free).T) > LET_GO
        if not keep.all():
            state = _select(state, keep)
            state = replace(state, field=self._fit(state.contacts, state.q, tip))
            state = replace(state, lattice=self._on_lattice(state.field))
        return replace(state, pose=pose, tip=tip)

    def _fused(self, precision: Precision) -> FusedStep:
        """Build the fast solver of this scene."""
        forget_stale_code()
        p, nodes = self.parameters, self.grid.nodes
        sources, at, points = nodes[self.lattice], self.lattice, nodes
        if self.grid.size > FINE:
            points = PixelField.points(self.grid, sources)
            at = len(points) - len(sources) + np.arange(len(sources))
        scene = AnchoredKernel.factor(self.kernel, self.anchors, points, sources=sources)
        if self.grid.size > FINE:
            self.pixels = PixelField(self.grid, scene)
        softness = None if self.stiffness is None else scene.compliance(self.stiffness[self.lattice])
        x0, x1, y0, y1 = self.grid.extent
        walls = {"left": x0, "right": x1, "top": y0, "bottom": y1}
        free = {"left": -inf, "right": inf, "top": -inf, "bottom": inf}
        numbers = (p.sigma, p.delta, p.alpha1, p.alpha2, p.alpha3, p.length, p.drag, self.gap)
        setting = Setting(
            np.array([*numbers, p.loading == "immediate", p.tip == "node"]),
            np.ascontiguousarray(nodes[self.lattice].T),
            np.array([walls[e] if e in self.clamps.edges else free[e] for e in walls]),
            self.clamps.points,
            self._node_place if p.tip == "node" else None,
            None if self.stiffness is None else lambda point: self._softness(scene, point),
        )
        return FusedStep(Response(scene, at, precision, softness), setting)

    def _fast(self) -> FusedStep:
        if self.fast is None:
            raise InputError('this state belongs to a model with the solver "response"; this one has "refit"')
        return self.fast

    def _node_place(self, tip: tuple[float, float]) -> tuple[float, float, bool]:
        """Node nearest to the tip (mm), and whether it can move."""
        node = self.grid.nearest(tip)
        x, y = self.grid.nodes[node]
        return float(x), float(y), node not in self.clamps.nodes

    def _softness(self, scene: AnchoredKernel, point: tuple[float, float]) -> float:
        k = np.full(1, inf) if self.stiffness is None else self.stiffness[[self.grid.nearest(point)]]
        return float(scene.compliance(k)[0])

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
        if not isfinite(limit) or np.hypot(*(_zero(u, was) - was).T).max() <= limit:
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

    def _at_lattice(self, state: TPSState) -> Floats:
        return np.zeros((len(self.lattice), 2)) if state.lattice is None else state.lattice

    def _on_lattice(self, field: Spline | None) -> Floats | None:
        return None if field is None else field(self.grid.nodes[self.lattice])

    def _distance(self, nodes: Floats, u: Floats, pose: NeedlePose) -> tuple[Floats, Floats]:
        """Distance from the entry along the axis, and d of equation (13), of nodes displaced by u; mm.

        Tissue that a tilting needle has pushed aside is still beside it: the part ``drag`` of the displacement
        across the axis counts. With drag = 0 this is (13) at the rest positions, as printed.
        """
        axis = np.array(pose.axis)
        offset = nodes + self.parameters.drag * _across(u, axis) - pose.entry
        along = offset @ axis
        beyond = along - np.clip(along, 0.0, pose.depth)
        across = np.hypot(*_across(offset, axis).T)
        return along, np.hypot(across, beyond)

    def _touch(self, state: TPSState, pose: NeedlePose, *, leave_at_once: bool) -> TPSState:
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
        self, old: TPSState, new: TPSState, q: Floats, pose: NeedlePose, dt: float, travel: float
    ) -> Tip | None:
        """Return the tip's landmark, equation (12); None where the tip pushes nothing."""
        p, axis, point = self.parameters, np.array(pose.axis), np.asarray(pose.tip)
        clearance = self.clamps.clearance(pose.tip)
        if clearance <= 0.0 or p.sigma == 0.0:
            return None
        push = tip_push(pose, p.sigma, clearance) * axis
        advancing = pose.speed >= 0 and pose.depth >= ZERO_LENGTH
        if p.tip == "node":
            node = self.grid.nearest(pose.tip)
            if not advancing or node in self.clamps.nodes:
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
        pose: NeedlePose,
        push: Floats | None,
        dt: float,
        travel: float,
    ) -> Tip | None:
        """Return the tip's landmark where it grows, moves and dies away without a jump; no push on withdrawal."""
        axis, point = np.array(pose.axis), np.asarray(pose.tip)
        # the tip of a needle that comes back to the landmark which it left takes it up again; one that pushes into
        # tissue where nodes still relax waits until they are gone: two landmarks in one place would tear the field
        clear = (
            np.hypot(*(self.grid.nodes[new.contacts[~new.touching]] - point).T).min(initial=inf) > self.gap
        )
        back = old.tip is None or old.tip.pushed or np.hypot(*(point - old.tip.point)) <= max(travel, LET_GO)
        if push is None or not (clear and back):
            return None if old.tip is None else self._leaving_tip(old.tip, new, q, dt, travel)
        if old.tip is None and pose.speed <= 0:
            return None
        field = self._fit(new.contacts, q)
        free = np.zeros(2) if field is None else field(point)[0]
        # a tip that begins to push starts from the displacement that the tissue had there before the step
        was = self.displacement_at(old, point[None])[0] if old.tip is None else old.tip.q
        ahead = float(push @ axis)
        if pose.speed == 0:  # (17): at rest the whole field relaxes, the tip's push with the contacts
            was = _across(was, axis) + relax(was, np.zeros(2), self.parameters.alpha3, dt) @ axis * axis
            ahead = min(float(was @ axis), ahead)
        wanted = ahead * axis + _across(free, axis)
        return Tip(point, follow(was[None], wanted[None], travel)[0])

    def _leaving_tip(self, tip: Tip, new: TPSState, q: Floats, dt: float, travel: float) -> Tip | None:
        """Let the landmark that the tip has left relax to the field without it, then go."""
        field = self._fit(new.contacts, q)
        free = np.zeros(2) if field is None else field(tip.point)[0]
        if np.hypot(*(tip.q - free)) <= LET_GO:
            return None
        relaxed = relax(tip.q, free, self.parameters.alpha3, dt)
        return Tip(tip.point, follow(relaxed[None], free[None], travel)[0], pushed=False)

    def _fit(self, contacts: Nodes, q: Floats, tip: Tip | None = None) -> Spline | None:
        """Spline through anchors, contacts and tip; None where there is nothing but anchors."""
        if tip is None and len(contacts) == 0:
            return None
        landmarks = [self.anchors, self.grid.nodes[contacts]]
        moves = [np.zeros_like(self.anchors), q]
        if tip is not None:
            apart = np.hypot(*(landmarks[1] - tip.point).T) > 1e-6  # a tip on a node speaks for it
            contacts = contacts[apart]
            landmarks = [self.anchors, landmarks[1][apart], tip.point[None]]
            moves = [moves[0], q[apart], tip.q[None]]
        return factor(self.kernel, np.vstack(landmarks), self._stiffness(contacts, tip)).solve(
            np.vstack(moves)
        )

    def _stiffness(self, contacts: Nodes, tip: Tip | None) -> Floats | None:
        """Return the stiffness of anchors (infinite), contacts and tip."""
        if self.stiffness is None:
            return None
        own = [np.full(len(self.anchors), inf), self.stiffness[contacts]]
        if tip is not None:
            own.append(self.stiffness[[self.grid.nearest(tip.point)]])
        return np.concatenate(own)


def _across(vectors: Floats, axis: Floats) -> Floats:
    """Part of vectors (..., 2) across the axis; all of it where there is no axis."""
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


def _spacing(grid: RegularGrid, lattice: Nodes) -> float:
    """Smallest distance between neighbouring lines of the lattice, mm."""
    gaps = [float(np.diff(np.unique(np.round(grid.nodes[lattice, i], 9))).min(initial=inf)) for i in (0, 1)]
    least = min(gaps)
    return least if isfinite(least) else min(grid.spacing)


def _zero(field: Floats | None, like: Floats) -> Floats:
    return np.zeros_like(like) if field is None else field
