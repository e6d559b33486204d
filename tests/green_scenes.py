"""Scenes, paths and a way into the core for the tests of Green's function there."""

from __future__ import annotations

from typing import Any

import numpy as np

from echospline import _native
from echospline.mechanics import Clamps, ForcedScene, ForcedStep, NeedleLoad
from echospline.mechanics.green_response import green_response
from echospline.scene import Circle, Layer, NeedlePose, Polygon, RegularGrid, Tissue
from echospline.scene.tissue import Region

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
BOX = ("left", "right", "bottom")
LESION = Tissue(regions=[Region(Circle((22.0, 14.0), 4.0), 50.0)])
LAYERS = Tissue(regions=[Region(Layer(0.0, 6.0), 30.0), Region(Circle((20.0, 18.0), 4.0), 2.0)])
POLYGON = Tissue(regions=[Region(Polygon(((18.0, 10.0), (26.0, 12.0), (20.0, 20.0))), 40.0)])

SCENES: dict[str, tuple[Any, ...]] = {  # tissue, clamped, sliding, clamped points, method
    "sliding top": (Tissue(), BOX, ("top",), None, "boundary"),
    "free top": (Tissue(), BOX, (), None, "boundary"),
    "clamped top": (Tissue(), ("left", "top"), ("bottom",), None, "boundary"),
    "clamped points": (Tissue(), ("bottom",), ("top",), [(10.0, 20.0), (30.0, 12.0)], "boundary"),
    "plane strain": (Tissue(poisson=0.45, plane="strain"), BOX, ("top",), None, "boundary"),
    "lesion": (LESION, BOX, ("top",), None, "regions"),
    "lesion, free top and a clamped point": (LESION, BOX, (), [(8.0, 20.0)], "regions"),
    "layer and lesion": (LAYERS, BOX, ("top",), None, "regions"),
    "polygon": (POLYGON, ("left", "bottom"), ("top",), [(30.0, 12.0)], "solve"),
}


def made(name: str, grid: RegularGrid = GRID) -> Any:
    """Response of a scene."""
    tissue, clamped, sliding, points, method = SCENES[name]
    return green_response(grid, Clamps.of(grid, clamped, points, sliding), tissue, method=method)


def session() -> list[tuple[NeedlePose, float]]:
    """Poses with their time step: a push, a rest with a tremor, a tilt of a hand, a withdrawal and another track."""
    entry, dt = np.array([14.0, 0.0]), 1 / 60
    axis = np.array([np.cos(np.radians(62.0)), np.sin(np.radians(62.0))])
    shaken = np.random.default_rng(3).normal(0.0, 0.05, 30)
    depths = [*np.linspace(0.0, 19.0, 70), *(19.0 + shaken)]
    poses = [(entry, entry + d * axis) for d in depths]
    for turn in np.radians(np.linspace(0.0, 6.0, 20)):
        a = np.array([np.cos(np.radians(62.0) + turn), np.sin(np.radians(62.0) + turn)])
        poses.append((entry, entry + 19.0 * a))
    last = poses[-1][1] - entry
    poses += [(entry, entry + s * last) for s in np.linspace(1.0, 0.05, 50)]
    poses += [(np.array([30.0, -2.0]), np.array([30.0, d])) for d in np.linspace(-1.0, 12.0, 40)]
    return [(NeedlePose(tuple(e), tuple(t)), dt) for e, t in poses]


class Attached:
    """A forced tissue of the core with a green made from tables alone, which goes on from one state to the next."""

    def __init__(self, tables: dict[str, Any]) -> None:
        arrays = {name: table for name, table in tables.items() if isinstance(table, np.ndarray)}
        numbers = {name: value for name, value in tables.items() if name not in arrays}
        self.step = ForcedStep(ForcedScene({}, numbers, arrays))
        self.core, self.forced, self.green = self.step._core, self.step._forced, self.step._green
        self.state = self.step.rest()

    def check(self, status: int) -> None:
        _native.check(status, self.core.echospline_forced_message, self.forced)

    def advance(self, pose: NeedlePose, dt: float) -> None:
        self.state = self.step.advance(self.state, pose, dt)

    def displacement(self) -> np.ndarray:
        return self.step.displacement(self.state)

    def displacement_at(self, points: np.ndarray) -> np.ndarray:
        return self.step.displacement_at(self.state, points)

    def load(self) -> NeedleLoad:
        return self.step.load(self.state)
