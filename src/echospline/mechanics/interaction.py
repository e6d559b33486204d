"""How the needle acts on the tissue: tip (12), friction (14)(15), relaxation (16)(17), as pure functions.

Forces never appear: each effect is a displacement of a landmark, in mm. What the paper leaves open (how a
displacement loads, what withdrawal and tilting do) is read as `docs/theory.md` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, inf
from typing import Protocol

import numpy as np

from echospline.scene import Floats

LET_GO = 2e-5
"""mm; a landmark that has left the needle is dropped once it is this close to the field without it."""

CALM = 2.5
"""A step moves no node further than this times the needle's travel and the relaxation due, but where friction is at once."""

SUBSTEP = 0.25
"""mm of the needle's travel after which a step looks again at who touches it, where friction has no reach: see `longest_substep`."""

MOST_SUBSTEPS = 100
"""In one step; a needle that moves further than this many substeps at once has been put elsewhere, not moved."""


class Pose(Protocol):
    """Position of the needle at one instant, in the plane (`NeedlePose`) or in space: D numbers per point."""

    @property
    def entry(self) -> Sequence[float]:
        """n_s, the point of entry, mm."""
        ...

    @property
    def tip(self) -> Sequence[float]:
        """n_t, the tip, mm."""
        ...

    @property
    def speed(self) -> float:
        """Signed speed of the tip along the axis, mm/s."""
        ...

    @property
    def depth(self) -> float:
        """Length of the shaft from entry to tip, mm."""
        ...

    @property
    def axis(self) -> Sequence[float]:
        """Unit vector from entry to tip; zero for a needle of zero length."""
        ...


def friction(distance: Floats, speed: float, alpha1: float, alpha2: float, length: float) -> Floats:
    """Displacement f along the axis of points at a distance from the shaft, equation (15).

    Parameters
    ----------
    distance : ndarray
        d, distance to the shaft, mm.
    speed : float
        v, signed axial speed, mm/s: withdrawal drags the tissue back.
    alpha1, alpha2 : float
        s; f does not depend on the time step.
    length : float
        Length that makes d dimensionless in the exponential, mm (the paper prints a bare d: 1 mm).

    Returns
    -------
    ndarray
        f, mm.
    """
    f: Floats = (alpha1 + alpha2 / (1.0 + np.exp(np.minimum(distance / length, 700.0)))) * speed
    return f


def relax(q: Floats, target: Floats, alpha3: float, dt: float) -> Floats:
    """Displacement after dt of decay towards a target, equation (16): exact, so halving dt changes nothing.

    Parameters
    ----------
    q, target : ndarray
        mm.
    alpha3 : float
        Rate, 1/s.
    dt : float
        s.
    """
    relaxed: Floats = target + (q - target) * exp(-alpha3 * dt)
    return relaxed


def longest_substep(delta: float) -> float:
    """Travel (mm) after which a step looks again at who touches the needle: a sixth of friction's reach delta (mm).

    Longer ones would depend on the time step; and a scene in another unit of length is divided as this one is.
    """
    return delta / 6.0 if delta > 0 else SUBSTEP


def approach(q: Floats, target: Floats, travel: Floats | float) -> Floats:
    """Move displacements (k, D) towards their targets, none further than ``travel`` (mm, one for all or (k,))."""
    gap = target - q
    share = np.minimum(1.0, travel / np.maximum(np.linalg.norm(gap, axis=1), 1e-300))
    moved: Floats = q + gap * share[:, None]
    return moved


def yielding(f: Floats, clearance: Floats) -> Floats:
    """Displacement that friction or the tip asks for beside what is clamped, mm: it fades over five times itself.

    Tissue beside a clamp cannot follow. A landmark there that did would give the spline a slope at the clamp, which a thin plate
    carries far away; so the displacement begins with the fourth power of the distance, and grows by 0.4 mm per mm at most.

    Parameters
    ----------
    f : ndarray, shape (k,)
        Displacement asked for in the open, mm.
    clearance : ndarray, shape (k,)
        Distance to what is clamped, mm.
    """
    reach = 5.0 * np.abs(f)
    near = np.divide(clearance, reach, out=np.ones_like(f), where=clearance < reach)
    step = near * near * (3.0 - 2.0 * near)
    faded: Floats = f * step * step
    return faded


def stick(
    q: Floats, held: Floats, moved: Floats, side: Floats, axis: Floats, travel: Floats | float
) -> Floats:
    """New displacements of landmarks that stick to the shaft and slip beyond what friction holds.

    Along the axis this is the stop operator of Coulomb friction on displacements, q <- min(max(q + moved, -held), held): at rest
    nothing changes, and a needle that turns back drags the tissue back through zero, whatever the time step. Across the axis
    a landmark follows the shaft.

    Parameters
    ----------
    q : ndarray, shape (k, D)
        Displacements so far, mm.
    held : ndarray, shape (k,)
        Largest displacement along the axis that friction holds, mm, zero or more.
    moved : ndarray, shape (k,)
        Motion of the shaft along its axis while it touched each landmark, mm; negative on withdrawal.
    side : ndarray, shape (k, D)
        Displacement across the axis that the shaft asks for, mm.
    axis : ndarray, shape (D,)
        Unit vector from entry to tip.
    travel : ndarray, shape (k,), or float
        Longest way that a point of the needle has moved meanwhile, mm: a landmark moves no further.

    Returns
    -------
    ndarray, shape (k, D)
        mm.
    """
    along = np.clip(q @ axis + moved, -held, held)
    return approach(q, along[:, None] * axis + side, travel)


def load(
    q: Floats,
    f: Floats,
    side: Floats,
    axis: Floats,
    alpha3: float,
    dt: float,
    travel: Floats | float,
    most: float = inf,
) -> Floats:
    """New displacements of the landmarks in contact.

    Along the axis a landmark is loaded while friction asks for more than it has in friction's direction; then it
    follows, by at most the needle's own travel. Otherwise it relaxes towards f, equation (16). Across the axis
    it follows the shaft.

    Parameters
    ----------
    q : ndarray, shape (k, D)
        Displacements so far, mm.
    f : ndarray, shape (k,)
        Friction displacement along the axis, equation (15), mm.
    side : ndarray, shape (k, D)
        Displacement across the axis that the shaft asks for, mm.
    axis : ndarray, shape (D,)
        Unit vector from entry to tip.
    alpha3, dt : float
        Rate (1/s) and time (s) of relaxation.
    travel : ndarray, shape (k,), or float
        Longest way that a point of the needle has moved meanwhile, mm; infinite is the printed law: at once f
        while there is friction, relaxation only without.
    most : float
        Displacement along the axis beyond which a landmark comes back as the needle travels, mm.

    Returns
    -------
    ndarray, shape (k, D)
        mm.
    """
    along = q @ axis
    loading = (np.sign(f) * (f - along) > 0) | (np.isinf(travel) & (f != 0))
    relaxed = np.where(loading, along, relax(along, f, alpha3, dt))
    rested = q + (relaxed - along)[:, None] * axis
    target = np.clip(np.where(loading, f, relaxed), -most, most)[:, None] * axis + side
    return approach(rested, target, travel)


def tip_push(pose: Pose, sigma: float, clearance: float) -> float:
    """How far the tip pushes the tissue ahead of it: sigma of equation (12), mm.

    While the tip is shallower than sigma the push is the depth itself; towards a clamped edge, which cannot be
    pushed, it fades over four sigma.

    Parameters
    ----------
    pose : Pose
        Where the needle is.
    sigma : float
        mm.
    clearance : float
        Distance from the tip to what is clamped, mm; 0 beyond it.
    """
    push = min(sigma, pose.depth)
    near = min(1.0, clearance / (4.0 * sigma)) if sigma > 0 else 0.0
    return push * near * near * (3.0 - 2.0 * near)


def needle_travel(before: Pose, after: Pose) -> float:
    """Longest way that a point of the shaft has moved between two poses, mm (a straight needle: at one of its ends)."""
    ends = ((before.entry, after.entry), (before.tip, after.tip))
    return float(max(np.linalg.norm(np.subtract(b, a)) for a, b in ends))


def largest_share(start: Floats, end: Floats, limit: float) -> float:
    """Largest t in [0, 1] with |start + t (end - start)| <= limit in every row; 0 where even the start is beyond."""
    step = end - start
    a = (step * step).sum(axis=1)
    b = (start * step).sum(axis=1)
    c = (start * start).sum(axis=1) - limit**2
    if (c > 0).any():
        return 0.0
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    t = np.divide(root - b, a, out=np.full_like(a, inf), where=a > 0)
    return float(min(1.0, t.min(initial=1.0)))
