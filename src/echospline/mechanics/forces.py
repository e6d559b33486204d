"""The laws of a needle's forces on tissue: one that sticks and slips, and the paper's viscous one."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, isfinite

import numpy as np

from echospline.errors import InputError
from echospline.scene import Floats, NeedlePose, is_number


@dataclass(frozen=True)
class NeedleForces:
    """A needle that sticks to the tissue, slips and cuts: the parameters of `mechanics.stick_slip`.

    Only ``tip`` is from the paper. No force per length of shaft could be verified in a source; every number marked as assumed is
    our own choice, in the range that makes friction a fifth to a third of the whole force.

    Parameters
    ----------
    tip : float
        Cutting force at the tip along the axis, N: at most this much pushes, and at this much the tip cuts. The paper's F = 0.4 N.
    friction_limit : float
        Greatest friction per mm of shaft in the tissue, N/mm, reached when it slips. Assumed; 0.005 to 0.02 are plausible.
    bond : float
        Stiffness of the bond between shaft and tissue per mm of shaft, N/mm^2. Assumed, a penalty: shaft and tissue slip
        after friction_limit / bond = 0.1 mm, and the visible stick comes from the tissue.
    tip_stiffness : float
        Of the contact between tip and tissue, N/mm. Assumed, a penalty as the bond.
    side_stiffness : float
        Of the contact across the shaft per mm of shaft, N/mm^2. Assumed, a penalty: tilting moves the tissue along.
    viscosity : float
        What friction gains per mm of shaft and mm/s of slip beyond its limit, N s/mm^2. 0 by default: in agarose forces hardly
        differ from 1.8 to 10 mm/s. 5e-4 shows speed. Assumed.
    station_spacing : float
        Distance between the points of the track that carry forces, mm: the resolution of the law along the shaft.
    substep : float
        Longest travel that is solved at once, mm; a step that goes further is divided.
    dead_band : float
        Play in the depth, mm to either side: a tip that moves less along the axis is at rest. 0 by default; 0.15 suits a tracker
        with 0.05 mm of noise.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    tip: float = 0.4
    friction_limit: float = 0.01
    bond: float = 0.1
    tip_stiffness: float = 2.0
    side_stiffness: float = 1.0
    viscosity: float = 0.0
    station_spacing: float = 1.25
    substep: float = 0.25
    dead_band: float = 0.0

    def __post_init__(self) -> None:
        for name, unit in (
            ("tip", "N"), ("friction_limit", "N/mm"), ("viscosity", "N s/mm^2"), ("dead_band", "mm"),
        ):  # fmt: skip
            value = getattr(self, name)
            if not (isfinite(value) and value >= 0):
                raise InputError(f"{name} must be zero or a positive number in {unit}; got {value}")
        for name, unit in (
            ("bond", "N/mm^2"), ("tip_stiffness", "N/mm"), ("side_stiffness", "N/mm^2"),
            ("station_spacing", "mm"), ("substep", "mm"),
        ):  # fmt: skip
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise InputError(f"{name} must be a positive number in {unit}; got {value}")


@dataclass(frozen=True)
class ViscousForces:
    """The paper's needle: a force at the tip, and friction in proportion to speed that relaxes at rest.

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


Forces = NeedleForces | ViscousForces
"""Either law."""


@dataclass(frozen=True, slots=True)
class NeedleLoad:
    """What the needle exerts on the tissue at one instant.

    Parameters
    ----------
    tip : float
        Force of the tip along the axis, N; never negative.
    friction : float
        Sum of the friction along the axis, N; positive where the needle pushes the tissue along, negative on withdrawal.
    side : float
        Sum of the forces across the axis, N; positive towards (-axis_y, axis_x). In space the magnitude of their sum.
    torque : float
        Of all forces about the point of entry, N mm; positive turns x towards y. In space the magnitude of the vector.
    cut : float
        Length of track that has been cut so far, mm from the surface. The viscous law keeps none: 0.
    """

    tip: float = 0.0
    friction: float = 0.0
    side: float = 0.0
    torque: float = 0.0
    cut: float = 0.0


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
