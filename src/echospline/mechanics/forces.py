"""The forces of a needle on tissue, and how they build up and relax: shared by all models that answer forces."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, isfinite

import numpy as np

from echospline.errors import InputError
from echospline.scene import Floats, NeedlePose, is_number


@dataclass(frozen=True)
class NeedleForces:
    """What the needle exerts on the tissue.

    Parameters
    ----------
    tip : float
        Cutting force at the tip along the axis while the needle advances, N. It stays while the needle rests and
        dies away on withdrawal. The paper's F = 0.4 N.
    friction : float
        Viscous friction per mm of shaft and per mm/s of axial speed, N s/mm^2. The paper's 1e-5 N s/m is read
        per mm of shaft: 1e-8 N s/mm^2. At 5 mm/s and 30 mm that is 1.5e-6 N, nothing beside the tip; 1e-3 makes
        friction (0.15 N) comparable with cutting.
    alpha3 : float
        Rate at which friction relaxes once the needle slows, equation (16), 1/s.
    ramp : float
        Needle travel over which forces build up, and the tip's dies away, mm: 63 % after one ramp. 0 is at once,
        the paper's law.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    tip: float = 0.4
    friction: float = 1e-8
    alpha3: float = 1.0
    ramp: float = 1.0

    def __post_init__(self) -> None:
        units = {"tip": "N", "friction": "N s/mm^2", "alpha3": "1/s", "ramp": "mm"}
        for name, unit in units.items():
            value = getattr(self, name)
            if not (isfinite(value) and value >= 0):
                raise InputError(f"{name} must be zero or a positive number in {unit}; got {value}")

    def missing(self, travel: float) -> float:
        """Share of a growing force that is still missing after the needle's travel (mm): exp(-travel / ramp)."""
        return 0.0 if self.ramp == 0 else exp(-travel / self.ramp)

    def advance_tip(self, force: float, pose: NeedlePose, travel: float, *, inside: bool) -> float:
        """Force at the tip (N) after a step: it builds up, stays at rest, dies away; none outside the tissue."""
        if not inside:
            return 0.0
        if pose.speed == 0:
            return force
        target = self.tip if pose.speed > 0 else 0.0
        return target + (force - target) * self.missing(travel)

    def advance_friction(self, q: Floats, target: Floats, travel: float, dt: float) -> Floats:
        """Friction loads after a step: those that grow build up with travel, the others relax, equation (16).

        Parameters
        ----------
        q, target : ndarray, shape (k, 2)
            Loads so far and loads of steady motion, in one unit.
        travel : float
            Of the needle in the step, mm.
        dt : float
            s.
        """
        growing = np.sum((target - q) * target, axis=1, keepdims=True) > 0
        share = np.where(growing, self.missing(travel), exp(-self.alpha3 * dt))
        after: Floats = target + (q - target) * share
        return after


def travelled(before: NeedlePose | None, after: NeedlePose) -> float:
    """Longest way that a point of the shaft has gone, mm; from the entry if there was no needle before."""
    if before is None:
        return after.depth
    ends = [np.hypot(*np.subtract(getattr(after, end), getattr(before, end))) for end in ("entry", "tip")]
    return float(max(ends))


def check_step(dt: float) -> None:
    """Refuse a time step that is negative or not finite."""
    if not (is_number(dt) and dt >= 0):
        raise InputError(f"dt must be zero or a positive number in s; got {dt!r}")
