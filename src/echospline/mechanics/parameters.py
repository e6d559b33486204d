"""Parameters of the interaction between needle and tissue in the spline model."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite
from typing import Literal

from echospline.errors import InputError


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
    loading : {"stick", "follow", "immediate"}
        Tissue sticks to the shaft and slips beyond what friction holds; or follows friction at the present speed,
        no faster than the needle moves, and relaxes at rest; or is there at once, as printed.
    friction_speed : float
        Speed at which equation (15) says how far friction holds tissue that sticks, mm/s.
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
    loading: Literal["stick", "follow", "immediate"] = "stick"
    friction_speed: float = 10.0
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
            "friction_speed": (0.0, inf, "mm/s"),
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
        if self.loading not in ("stick", "follow", "immediate"):
            raise InputError(f'loading is "stick", "follow" or "immediate"; got {self.loading!r}')
