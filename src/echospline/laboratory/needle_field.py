"""A needle in an unbounded elastic plane: a displacement field in closed form, for trials of imaging and tracking."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from echospline.errors import InputError
from echospline.mechanics import Elastic
from echospline.scene import Floats, NeedlePose, RegularGrid

BLOCK = 8192
"""Points evaluated at once: bounds the memory of the kernel matrix."""


@dataclass(frozen=True)
class NeedleField:
    """Point forces along the needle, strongest at the tip (regularised Kelvin solution), still at the edges.

    The field is shifted by its mean along the border and brought to zero there by a squared sine over
    ``rim`` of the width, so that the picture's edges stay. It depends on no tissue model and no image: it is the
    independent truth that moves phantoms.

    Parameters
    ----------
    grid : RegularGrid
        The region; the largest displacement over it is ``peak``.
    pose : NeedlePose
        Pose of the needle.
    peak : float
        mm.
    friction : float
        Force of each mm of shaft as a share of the tip's.
    radius : float
        Regularisation length, mm.
    nu : float
        Poisson's ratio.
    rim : float
        Share of the smaller side over which the field rises from the border.
    """

    grid: RegularGrid
    pose: NeedlePose
    peak: float
    friction: float = 0.25
    radius: float = 2.0
    nu: float = 0.45
    rim: float = 0.25
    _mean: Floats = field(init=False, repr=False, compare=False)
    _scale: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.peak) and self.pose.depth > 0 and 0 < self.rim <= 0.5):
            raise InputError(f"a needle field needs a needle of some length and a finite peak; got {self}")
        coarse = RegularGrid.covering(self.grid, (101, 101))
        free = self._free(coarse.nodes)
        mean = free[coarse.boundary(("top", "bottom", "left", "right"))].mean(axis=0)
        largest = np.hypot(*((free - mean) * self._window(coarse.nodes)[:, None]).T).max()
        object.__setattr__(self, "_mean", mean)
        object.__setattr__(self, "_scale", self.peak / largest)

    def __call__(self, points: Floats) -> Floats:
        """Return the displacement at points (n, 2) mm, mm."""
        out = np.empty((len(points), 2))
        for start in range(0, len(points), BLOCK):
            p = points[start : start + BLOCK]
            out[start : start + BLOCK] = self._scale * (self._free(p) - self._mean) * self._window(p)[:, None]
        return out

    def _free(self, points: Floats) -> Floats:
        count = max(2, round(self.pose.depth))
        sources = self.pose.shaft(np.linspace(1.0, 0.0, count))
        size = np.full(count, self.friction * self.pose.depth / count)
        size[0] = 1.0
        force = np.outer(self.pose.axis, size).ravel()
        u: Floats = Elastic(self.nu, self.radius).matrix(points, sources) @ force
        return u.reshape(2, -1).T

    def _window(self, points: Floats) -> Floats:
        x0, x1, y0, y1 = self.grid.extent
        x, y = points.T
        border = np.minimum.reduce([x - x0, x1 - x, y - y0, y1 - y]) / (self.rim * min(x1 - x0, y1 - y0))
        window: Floats = np.sin(np.clip(border, 0.0, 1.0) * np.pi / 2.0) ** 2
        return window
