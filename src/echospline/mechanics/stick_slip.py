"""A needle that sticks, slips and cuts, in plain NumPy: the reading of the law that the native core is compared with.

The track is a row of *stations*, material points h apart, born where the tip cuts (one ahead); each carries a line load of a hat's
shape. With the needle's axis a, D - 1 units n across it, the tip's position p, and X_j + u_j where station j is now:

    eta_j = (p - X_j - u_j) . a     how far the tip is beyond station j
    gap_j = (p - X_j - u_j) . n     how far the shaft lies beside it, in each direction across
    w_j                             covered length of its piece of the track, continuous in eta and in the cut front c
    F_j = clip(F_j + k w_j d(eta_j), -fs w_j, fs w_j)      friction: a stop operator against the tissue
    G_j = G_j + k_n w_j d(gap_j)                           across the shaft, both ways
    T   = clip(k_t eta(c), 0, Fc)                          the tip pushes; while T = Fc it cuts: c grows until k_t eta(c) = Fc

F, G and T of one substep solve a box-constrained quadratic programme, because u = C (F a + G n + T a): the tissue moves along. The cut
front c is the tip's only memory, so a cut track costs friction alone.

The dimension D is that of the poses. In the plane n = (-a_y, a_x). In space the two directions across turn with the axis along the great
circle, so that G_j stays k_n w_j times the gap as a vector, whichever way the needle has been tilted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product
from math import acos, atan2, ceil, cos, hypot, pi, sin

import numpy as np
from numpy.typing import NDArray

from echospline.errors import SolverError
from echospline.mechanics.forces import NeedleForces, NeedleLoad
from echospline.mechanics.interaction import Pose
from echospline.scene import ZERO_LENGTH, Floats

HAT = np.array([-0.75, -0.25, 0.25, 0.75]), np.array([0.125, 0.375, 0.375, 0.125])
"""Places of a station's point forces, in station spacings from it along the axis, and their shares of its force."""
SAME_AXIS = 1e-9
"""Axes that differ by less are one axis, so that rounding in a pose does not turn a straight track."""
MOST_SUBSTEPS = 400
"""Of a step; a needle that jumps further than these times the substep is solved in longer ones."""
MOST_REPEATS = 20
"""Solutions of a substep at most, while the cut front and the covered lengths come to agree with the displacement."""
AGREED = 1e-7
"""mm; the front and the covered lengths agree with the displacement when they change by less."""
LEAST_CONTACT = 1e-9
"""mm; a piece of track that is covered less than this is not touched."""
RUN_AHEAD = 1.5
"""Travels of the needle that the cut front may advance in a substep; usual are 0.9 to 1.1."""
SPRING_BACK = 1.0
"""Travels of the needle that a station may spring back in a substep. In tissue below 5 kPa cutting is unstable: the tissue gives way
less the deeper the tip is. Without the two bounds the front jumps there, and tissue moves many times as far as the needle."""


MOST_GUESSES = 30
"""Of the bounds that hold, before they change one at a time."""
MOST_CHANGES = 20
"""One at a time, per unknown."""
MOST_SWEEPS = 2_000
"""If rounding keeps those from ending."""
ROUNDING = 1e-13
"""N or mm; bounds hold within it."""


@dataclass(frozen=True)
class Station:
    """One material point of the track, and its load.

    Attributes
    ----------
    place : ndarray, shape (D,)
        In the undeformed tissue, mm.
    axis : ndarray, shape (D,)
        Of the needle when the station was born.
    points : ndarray, shape (m, D)
        Where its force acts, mm: those of the four places of its hat that lie in the tissue.
    weights : ndarray, shape (m,)
        Share of the force at each; they add up to one, unless no place lies in the tissue.
    before, share : float
        Part of the hat before the first place in the tissue, and part in the tissue; 0 and 1 inside it.
    """

    place: Floats
    axis: Floats
    points: Floats
    weights: Floats
    before: float
    share: float


def station_at(place: Floats, axis: Floats, spacing: float, extent: tuple[Floats, Floats]) -> Station:
    """Build the station of a place; extent: least and greatest corner of the tissue, mm."""
    points = place + spacing * HAT[0][:, None] * axis
    inside = ((points >= extent[0]) & (points <= extent[1])).all(axis=1)
    if not inside.any():
        return Station(place, axis, points[:0], HAT[1][:0], 0.0, 0.0)
    share = float(HAT[1][inside].sum())
    before = float(HAT[1][: inside.argmax()].sum())
    return Station(place, axis, points[inside], HAT[1][inside] / share, before, share)


@dataclass(frozen=True)
class Track:
    """Stations, and the displacement at each by unit forces at every other.

    Attributes
    ----------
    stations : tuple of Station
        In the order in which the tip cut.
    compliance : ndarray, shape (k, D, k, D)
        Mean displacement over station i, component c, by a unit force at station j, component d, mm/N. Symmetric.
    """

    stations: tuple[Station, ...] = ()
    compliance: Floats = field(default_factory=lambda: np.zeros((0, 2, 0, 2)))

    @classmethod
    def empty(cls, dimension: int) -> Track:
        """Return a track without stations."""
        return cls((), np.zeros((0, dimension, 0, dimension)))

    def __len__(self) -> int:
        return len(self.stations)

    @property
    def places(self) -> Floats:
        """Stations in the undeformed tissue, shape (k, D), mm."""
        return np.array([s.place for s in self.stations]).reshape(-1, self.compliance.shape[1])

    def with_station(self, station: Station, rows: Floats) -> Track:
        """Add a station; rows (k + 1, D, D): displacement of every station, itself last, by its own unit forces."""
        k, D = len(self), self.compliance.shape[1]
        C = np.zeros((k + 1, D, k + 1, D))
        C[:k, :, :k] = self.compliance
        C[:, :, k] = rows
        C[k] = rows.transpose(2, 0, 1)
        C[k, :, k] = (rows[k] + rows[k].T) / 2
        return Track((*self.stations, station), C)


Supply = Callable[[Track, Station], Track]
"""Adds a station to a track: asks the tissue for its compliance."""


@dataclass(frozen=True)
class SlipState:
    """What needle and tissue remember.

    Attributes
    ----------
    track : Track
        Of this insertion, or of the last one.
    tip : ndarray, shape (D,)
        Tip that acts: that of the last pose less the play in the depth, mm.
    axis : ndarray, shape (D,), or None
        Of the last pose that had one.
    across : ndarray, shape (D - 1, D)
        Units across that axis.
    depth : float
        Of the last pose, mm.
    friction, covered : ndarray, shape (k,)
        F, N, and w, mm, of every station.
    side : ndarray, shape (D - 1, k)
        G, N, along each of the directions across.
    moved : ndarray, shape (k, D)
        Displacement of the stations, mm.
    push : float
        T, N.
    cut : float
        c, mm along the track.
    """

    track: Track
    tip: Floats
    axis: Floats | None
    across: Floats
    depth: float
    friction: Floats
    side: Floats
    covered: Floats
    moved: Floats
    push: float
    cut: float


def at_rest(dimension: int = 2) -> SlipState:
    """State of tissue that no needle has touched, in the plane or in space."""
    none, D = np.zeros(0), dimension
    return SlipState(
        Track.empty(D), np.zeros(D), None, np.zeros((D - 1, D)), 0.0, none, np.zeros((D - 1, 0)), none,
        np.zeros((0, D)), 0.0, 0.0,
    )  # fmt: skip


def station_forces(state: SlipState, spacing: float) -> Floats:
    """Force at every station, shape (k, D), N."""
    if state.axis is None or not len(state.track):
        return np.zeros((len(state.track), len(state.tip)))
    along = state.friction + _front(state.cut, len(state.track), spacing) * state.push
    return _vectors(along, state.side, state.axis, state.across)


def _vectors(along: Floats, side: Floats, axis: Floats, across: Floats) -> Floats:
    """Forces along the axis (k,) and across it (D - 1, k) as vectors (k, D)."""
    vectors: Floats = np.outer(along, axis)
    for G, n in zip(side, across, strict=True):
        vectors = vectors + np.outer(G, n)
    return vectors


def load(state: SlipState, spacing: float, pose: Pose) -> NeedleLoad:
    """Return the needle's forces in a state; the torque is about the entry of the pose.

    In space the forces across the axis and the torque are vectors, and their magnitudes are returned (`wrench` has the vectors).
    """
    if not len(state.track):
        return NeedleLoad()
    f = station_forces(state, spacing)
    if len(state.tip) == 3:
        torque = float(np.linalg.norm(wrench(state, spacing, pose)[1]))
        side = float(np.linalg.norm(state.side.sum(axis=1)))
    else:
        arm = state.track.places + state.moved - np.asarray(pose.entry)
        torque = float(np.sum(arm[:, 0] * f[:, 1] - arm[:, 1] * f[:, 0]))
        side = float(state.side.sum())
    return NeedleLoad(state.push, float(state.friction.sum()), side, torque, state.cut)


def wrench(state: SlipState, spacing: float, pose: Pose) -> tuple[Floats, Floats]:
    """Force (3,) in N of a needle in space on the tissue, and its torque (3,) in N mm about the entry of the pose."""
    f = station_forces(state, spacing)
    arm = state.track.places + state.moved - np.asarray(pose.entry)
    return f.sum(axis=0), np.cross(arm, f).sum(axis=0)


def advance(
    state: SlipState,
    pose: Pose,
    dt: float,
    law: NeedleForces,
    extent: tuple[Floats, Floats],
    supply: Supply,
) -> SlipState:
    """State after the needle has moved to a pose in dt seconds, in substeps."""
    axis, depth = _axis(state, pose), pose.depth
    tip = np.asarray(pose.tip, dtype=np.float64)
    if axis is None or depth < ZERO_LENGTH:  # it has no direction and touches nothing
        return replace(_released(state), tip=tip, depth=0.0)
    if state.axis is None or state.axis @ axis < 0:  # the first, or drawn out and turned
        entry = np.asarray(pose.entry, dtype=np.float64)
        state = replace(_released(state), axis=axis, across=_units_across(axis), tip=entry, depth=0.0)
    assert state.axis is not None
    acting = _play(state.tip, tip, axis, law.dead_band)
    length = _length_inside(state)
    travel = max(
        hypot(*(acting - state.tip)), hypot(*(acting - length * axis - state.tip + length * state.axis))
    )
    count = int(min(max(1.0, ceil(travel / law.substep - 1e-9)), MOST_SUBSTEPS))
    first, depth0, from_axis = state.tip, state.depth, state.axis
    for i in range(1, count + 1):
        s = i / count
        a = axis if axis is from_axis or i == count else _between(from_axis, axis, s)
        state = _substep(
            state, first + s * (acting - first), a, depth0 + s * (depth - depth0), travel / count, dt / count,
            law, extent, supply,
        )  # fmt: skip
    return state


def _released(state: SlipState) -> SlipState:
    """Let go of the tissue; track and cut front stay."""
    k, D = len(state.track), len(state.tip)
    none = np.zeros(k)
    return replace(
        state, friction=none, side=np.zeros((D - 1, k)), covered=none, moved=np.zeros((k, D)), push=0.0
    )


def _axis(state: SlipState, pose: Pose) -> Floats | None:
    """Axis of a pose; the last one where the pose has none, or where they differ by rounding alone."""
    if pose.depth < ZERO_LENGTH:
        return state.axis
    axis = np.array(pose.axis)
    if state.axis is not None and np.abs(axis - state.axis).max() < SAME_AXIS:
        return state.axis
    return axis


def _play(before: Floats, tip: Floats, axis: Floats, band: float) -> Floats:
    """Tip that acts: it follows the seen one along the axis with a play of the dead band to either side."""
    ahead = float((tip - before) @ axis)
    held = min(max(ahead, -band), band)
    acting: Floats = tip - held * axis
    return acting


def _between(start: Floats, end: Floats, share: float) -> Floats:
    """Axis that has turned from one to another, less than a right angle away, by a share of the angle between them."""
    if len(start) == 2:
        first = atan2(start[1], start[0])
        turn = (atan2(end[1], end[0]) - first + pi) % (2 * pi) - pi
        return np.array([cos(first + share * turn), sin(first + share * turn)])
    angle = acos(min(1.0, float(start @ end)))
    ahead = end - (start @ end) * start
    length = float(np.linalg.norm(ahead))
    if length < SAME_AXIS * SAME_AXIS:
        return end
    axis: Floats = cos(share * angle) * start + sin(share * angle) / length * ahead
    return axis


def _units_across(axis: Floats) -> Floats:
    """D - 1 units across an axis, at right angles to each other, shape (D - 1, D); in space any two will do."""
    if len(axis) == 2:
        return np.array([[-axis[1], axis[0]]])
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)])


def _turned(across: Floats, before: Floats, axis: Floats) -> Floats:
    """Units across an axis after it has turned: about the line at right angles to both, and not about itself."""
    if len(axis) == 2:
        return _units_across(axis)
    if axis is before:
        return across
    half = before + axis
    turned = across - np.outer(across @ axis / (1.0 + before @ axis), half)
    first = turned[0] - (turned[0] @ axis) * axis  # rounding does not add up
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)])


def _front(cut: float, count: int, spacing: float) -> Floats:
    """Weights of the stations at the cut front, shape (k,): the tip's force acts between two of them."""
    j = min(int(cut / spacing), count - 2)
    beyond = cut / spacing - j
    weights = np.zeros(count)
    weights[j], weights[j + 1] = 1.0 - beyond, beyond
    return weights


def _length_inside(state: SlipState) -> float:
    """Length of the shaft in the tissue, mm."""
    if not len(state.track) or state.axis is None:
        return 0.0
    return max(0.0, float((state.tip - state.track.stations[0].place - state.moved[0]) @ state.axis))


def _covered(eta: Floats, cut: float, track: Track, h: float) -> Floats:
    """Length of the shaft that touches each station's piece of the track, mm."""
    before = np.array([s.before for s in track.stations]) * h
    share = np.array([s.share for s in track.stations]) * h
    reach = np.minimum(eta, cut - h * np.arange(len(track)))
    covered: Floats = np.clip(reach + h / 2 - before, 0.0, share)
    covered[covered < LEAST_CONTACT] = 0.0
    return covered


def _substep(
    state: SlipState,
    tip: Floats,
    axis: Floats,
    depth: float,
    travel: float,
    dt: float,
    law: NeedleForces,
    extent: tuple[Floats, Floats],
    supply: Supply,
) -> SlipState:
    assert state.axis is not None
    touching = bool(state.covered.any()) or state.push > 0
    inside = bool(((tip >= extent[0]) & (tip <= extent[1])).all())
    if not touching:
        if not inside:
            across = _turned(state.across, state.axis, axis)
            return replace(state, tip=tip, axis=axis, across=across, depth=depth)
        if not _in_the_track(state, tip, axis, law.station_spacing):
            place = _entry(tip, axis, depth, extent)
            state = _fresh(
                state, supply(Track.empty(len(axis)), station_at(place, axis, law.station_spacing, extent))
            )
    state = _grown(state, axis, RUN_AHEAD * travel, law.station_spacing, extent, supply)
    return _solve(state, tip, axis, depth, travel, dt, law)


def _in_the_track(state: SlipState, tip: Floats, axis: Floats, h: float) -> bool:
    """Return whether the needle enters where it had been: both ends of the track lie within h / 2 of its line."""
    if not len(state.track):
        return False
    places = state.track.places
    ends = np.array([places[0], _front(state.cut, len(places), h) @ places])
    beside = np.linalg.norm((tip - ends) @ _units_across(axis).T, axis=1)
    return bool((beside <= h / 2).all() and (ends[1] - ends[0]) @ axis >= 0)


def _entry(tip: Floats, axis: Floats, depth: float, extent: tuple[Floats, Floats]) -> Floats:
    """Where a shaft that ends at the tip comes into the tissue: on its border, or where the needle begins."""
    way = depth
    for d in range(len(axis)):
        if axis[d] != 0.0:
            way = min(way, (tip[d] - extent[0 if axis[d] > 0 else 1][d]) / axis[d])
    entry: Floats = np.clip(tip - max(way, 0.0) * axis, *extent)
    return entry


def _fresh(state: SlipState, track: Track) -> SlipState:
    """Begin a new track of one station."""
    zero, D = np.zeros(1), len(state.tip)
    return replace(
        state, track=track, friction=zero, side=np.zeros((D - 1, 1)), covered=zero, moved=np.zeros((1, D)),
        push=0.0, cut=0.0,
    )  # fmt: skip


def _grown(
    state: SlipState,
    axis: Floats,
    ahead: float,
    h: float,
    extent: tuple[Floats, Floats],
    supply: Supply,
) -> SlipState:
    """Lay stations ahead of the cut front, as far as it may come and one more; none beyond the first one outside."""
    track = state.track
    while len(track) < 2 or ((len(track) - 1) * h < state.cut + ahead and track.stations[-1].share > 0):
        track = supply(track, station_at(track.stations[-1].place + h * axis, axis, h, extent))
    old = len(state.friction)
    if len(track) == old:
        return state
    f = station_forces(state, h) if old > 1 else np.zeros((old, len(axis)))
    moved = np.einsum("icjd,jd->ic", track.compliance[old:, :, :old], f)
    none = np.zeros(len(track) - old)
    return replace(
        state,
        track=track,
        friction=np.append(state.friction, none),
        side=np.hstack([state.side, np.zeros((len(state.side), len(none)))]),
        covered=np.append(state.covered, none),
        moved=np.vstack([state.moved, moved]),
    )


@dataclass(frozen=True)
class _Motion:
    """What a substep is to the stations: compliances in the needle's frame, and motions with the tissue undeformed."""

    axis: Floats
    across: Floats
    within: list[
        list[Floats]
    ]  # displacement along direction c at i by a force along d at j; the axis, then those across
    eta: Floats
    eta_gained: Floats  # over eta before the substep, in tissue that had moved
    gap_gained: list[Floats]  # in every direction across

    @classmethod
    def of(cls, state: SlipState, tip: Floats, axis: Floats) -> _Motion:
        assert state.axis is not None
        C, X = state.track.compliance, state.track.places
        across = _turned(state.across, state.axis, axis)
        frame = [axis, *across]
        before = state.tip - X - state.moved
        within: list[list[Floats]] = [[] for _ in frame]
        for c, d in product(range(len(frame)), repeat=2):
            within[c].append(
                np.einsum("icjd,c,d->ij", C, frame[c], frame[d]) if d >= c else within[d][c].T
            )  # reciprocity
        return cls(
            axis,
            across,
            within,
            (tip - X) @ axis,
            (tip - X) @ axis - before @ state.axis,
            [(tip - X) @ n - before @ n0 for n, n0 in zip(across, state.across, strict=True)],
        )


def _solve(
    state: SlipState, tip: Floats, axis: Floats, depth: float, travel: float, dt: float, law: NeedleForces
) -> SlipState:
    """Forces, displacement and cut front of one substep, solved until all three agree."""
    h, track = law.station_spacing, state.track
    motion = _Motion.of(state, tip, axis)
    exists = np.array([s.share > 0 for s in track.stations], dtype=np.float64)
    furthest = min(state.cut + RUN_AHEAD * travel, (len(track) - 1) * h)
    cut, moved = state.cut, state.moved
    touched = float(_front(state.cut, len(track), h) @ exists)
    held = _held_before(state.friction, state.covered, state.push, touched, law)
    pairs: list[tuple[float, float]] = []  # fronts tried, and how far each lagged behind
    for _ in range(MOST_REPEATS):
        w, weights = _covered(motion.eta - moved @ axis, cut, track, h), _front(cut, len(track), h)
        touch = float(weights @ exists)
        F, G, T = _forces(state, motion, w, weights, touch, dt, law, held)
        held = _held_before(F, w, T, touch, law)
        f = _vectors(F + weights * T, G, axis, motion.across)
        moved = np.einsum("icjd,jd->ic", track.compliance, f)
        eta = motion.eta - moved @ axis
        back = float(((state.moved - moved) @ axis).max())
        if cut > state.cut and back > SPRING_BACK * travel:  # cut less far
            furthest = state.cut + (cut - state.cut) * SPRING_BACK * travel / back
        lag = float(weights @ eta) - (law.tip / law.tip_stiffness if touch > 0 else 0.0)
        pairs.append((cut, lag))
        front = _next_front(pairs, state.cut, furthest)
        settled = np.abs(_covered(eta, front, track, h) - w).max() < AGREED
        if settled and abs(front - cut) < AGREED:
            break
        cut = front
    return replace(
        state, tip=tip, axis=axis, across=motion.across, depth=depth, friction=F, side=G, covered=w, moved=moved,
        push=T, cut=pairs[-1][0],
    )  # fmt: skip


def _forces(
    state: SlipState,
    motion: _Motion,
    w: Floats,
    weights: Floats,
    touch: float,
    dt: float,
    law: NeedleForces,
    held: NDArray[np.int8],
) -> tuple[Floats, Floats, float]:
    """F, G (D - 1, k) and T for covered lengths w and a tip between the stations of these weights, ``touch`` of it in the tissue."""
    on = np.flatnonzero(w > 0)
    m, D, here, t = len(on), len(motion.within), np.ix_(on, on), weights[:, None]
    kept = np.minimum(1.0, w[on] / np.where(state.covered[on] > 0, state.covered[on], np.inf))
    bond, firm, limit = law.bond * w[on], law.side_stiffness * w[on], law.friction_limit * w[on]
    pressing = law.tip_stiffness * touch if touch > 0 else 1.0
    W = motion.within
    A = np.empty((D * m + 1, D * m + 1))
    for c in range(D):
        rows = slice(c * m, (c + 1) * m)
        for d in range(D):
            A[rows, d * m : (d + 1) * m] = W[c][d][here]
        A[rows, -1] = (W[c][0] @ t)[on, 0]
        A[-1, rows] = (t.T @ W[0][c])[0, on]
    A[-1, -1] = (t.T @ W[0][0] @ t)[0, 0]
    A[np.diag_indices(len(A))] += np.r_[1 / bond, np.tile(1 / firm, D - 1), 1 / pressing]
    b = np.concatenate([
        kept * state.friction[on] / bond + motion.eta_gained[on],
        *(kept * G[on] / firm + gap[on] for G, gap in zip(state.side, motion.gap_gained, strict=True)),
        [weights @ motion.eta],
    ])  # fmt: skip
    free = np.full((D - 1) * m, np.inf)
    guess = np.concatenate([held[on], np.zeros(len(free), dtype=np.int8), held[-1:]])
    soft = np.zeros(D * m + 1)
    if law.viscosity > 0:
        soft[:m] = dt / (law.viscosity * w[on])
    z = solve_box(A, b, np.r_[-limit, -free, 0.0], np.r_[limit, free, law.tip * touch], soft, guess)
    F, side = np.zeros(len(w)), np.zeros((D - 1, len(w)))
    F[on], side[:, on] = z[:m], z[m:-1].reshape(D - 1, m)
    return F, side, float(z[-1])


def _next_front(pairs: list[tuple[float, float]], least: float, most: float) -> float:
    """Front to be tried next (mm): where the lag of the last two vanishes, between where it was and how far it may go."""
    (cut, lag) = pairs[-1]
    step = lag
    if len(pairs) > 1 and (slope := cut - pairs[-2][0]) != 0:
        slope = (lag - pairs[-2][1]) / slope
        if slope < 0:
            step = -lag / slope
    return min(max(cut + step, least), most)


def _held_before(F: Floats, covered: Floats, T: float, touch: float, law: NeedleForces) -> NDArray[np.int8]:
    """Guess which bounds hold from friction and tip force of a solution before: -1, 0 or 1 for every station, then for the tip."""
    limit = law.friction_limit * covered * (1.0 - 1e-9)
    held = np.zeros(len(F) + 1, dtype=np.int8)
    held[:-1][(covered > 0) & (limit <= F)] = 1
    held[:-1][(covered > 0) & (-limit >= F)] = -1
    held[-1] = 1 if law.tip * touch * (1.0 - 1e-9) <= T else -1 if T <= 0.0 else 0
    return held


def solve_box(
    A: Floats, b: Floats, low: Floats, high: Floats, soft: Floats, guess: NDArray[np.int8] | None = None
) -> Floats:
    """Minimise z.A z / 2 - b.z with low <= z <= high, where a bound may be soft.

    Parameters
    ----------
    A : ndarray, shape (n, n)
        Symmetric, positive definite.
    b, low, high : ndarray, shape (n,)
        Bounds may be infinite.
    soft : ndarray, shape (n,)
        Beyond a bound z costs soft (z - bound)^2 / 2; 0 is a hard bound.
    guess : ndarray of int8, shape (n,), optional
        Which bounds may hold: -1 the lower, 1 the upper. It changes how soon the solution is found, and not the solution.

    Returns
    -------
    ndarray, shape (n,)
        The one minimum: found by guessing which bounds hold and correcting the guess (a Newton method, two or three systems).
        Should that come back to an earlier guess, the first wrong bound alone is corrected, which ends (Murty 1974); and
        should rounding prevent even that, Gauss-Seidel sweeps converge.
    """
    held = np.zeros(len(b), dtype=np.int8) if guess is None else guess.copy()
    for attempt in range(MOST_GUESSES + MOST_CHANGES * len(b)):
        z = _with_bounds(A, b, low, high, soft, held)
        guess = _bounds_held(A, b, low, high, soft, held, z)
        wrong = np.flatnonzero(guess != held)
        if not len(wrong):
            return z
        if attempt < MOST_GUESSES:
            held = guess
        else:
            held[wrong[0]] = guess[wrong[0]]
    return _sweeps(A, b, low, high, soft)


def _with_bounds(
    A: Floats, b: Floats, low: Floats, high: Floats, soft: Floats, held: NDArray[np.int8]
) -> Floats:
    """Minimum when bounds hold where ``held`` is -1 (low) or 1 (high)."""
    bound = np.where(held > 0, high, np.where(held < 0, low, 0.0))
    fixed = (held != 0) & (soft == 0)
    extra = np.where((held != 0) & ~fixed, soft, 0.0)
    z, free = bound.copy(), ~fixed
    if free.any():
        S = A[np.ix_(free, free)] + np.diag(extra[free])
        z[free] = np.linalg.solve(S, b[free] + (extra * bound)[free] - A[np.ix_(free, fixed)] @ z[fixed])
    return z


def _bounds_held(
    A: Floats, b: Floats, low: Floats, high: Floats, soft: Floats, held: NDArray[np.int8], z: Floats
) -> NDArray[np.int8]:
    """Guess corrected by a solution: a bound is passed, or pulls the wrong way."""
    pull, rigid = b - A @ z, soft == 0
    guess = np.zeros(len(b), dtype=np.int8)
    guess[(held == 0) & (z > high + ROUNDING)] = 1
    guess[(held == 0) & (z < low - ROUNDING)] = -1
    guess[(held > 0) & np.where(rigid, pull > -ROUNDING, z > high - ROUNDING)] = 1
    guess[(held < 0) & np.where(rigid, pull < ROUNDING, z < low + ROUNDING)] = -1
    return guess


def _sweeps(A: Floats, b: Floats, low: Floats, high: Floats, soft: Floats) -> Floats:
    z = np.zeros(len(b))
    for _ in range(MOST_SWEEPS):
        change = 0.0
        for i in range(len(b)):
            free = z[i] + (b[i] - A[i] @ z) / A[i, i]
            bound = min(max(free, low[i]), high[i])
            new = bound if soft[i] == 0 else (free * A[i, i] + bound * soft[i]) / (A[i, i] + soft[i])
            change, z[i] = max(change, abs(new - z[i])), new
        if change < 1e-14 * max(1.0, float(np.abs(z).max())):
            return z
    raise SolverError(
        "the needle's forces could not be solved: the tissue's answer to them is not positive definite"
    )
