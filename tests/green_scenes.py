"""Scenes, paths and a way into the core for the tests of Green's function there."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from echospline import _native
from echospline._native import green as core
from echospline.mechanics import Clamps, NeedleForces
from echospline.mechanics.green_response import green_response
from echospline.mechanics.green_tables import options_of
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
    """A forced tissue of the core with a green made from tables alone, as any host makes it."""

    def __init__(self, tables: dict[str, Any], law: NeedleForces | None = None) -> None:
        self.core, law = core.library(), law or NeedleForces()
        self.green, self.forced = ctypes.c_void_p(), ctypes.c_void_p()
        options, self.kept = options_of(tables)
        self.nodes = tables["shape"][0] * tables["shape"][1]
        status = self.core.echospline_green_create(ctypes.byref(options), ctypes.byref(self.green))
        _native.check(status, self.core.echospline_green_message, self.green)
        o = _native.ForcedOptions(struct_size=ctypes.sizeof(_native.ForcedOptions), node_count=self.nodes)
        for name in ("tip", "friction_limit", "bond", "tip_stiffness", "side_stiffness", "viscosity", "station_spacing",
                     "substep", "dead_band"):  # fmt: skip
            setattr(o, name, getattr(law, name))
        for d in (0, 1):
            o.low[d] = tables["origin"][d]
            o.high[d] = tables["origin"][d] + tables["spacing"][d] * (tables["shape"][d] - 1)
        self.check(self.core.echospline_forced_create(ctypes.byref(o), ctypes.byref(self.forced)))
        self.check(self.core.echospline_forced_attach(self.forced, self.green))

    def check(self, status: int) -> None:
        _native.check(status, self.core.echospline_forced_message, self.forced)

    def advance(self, pose: NeedlePose, dt: float) -> None:
        p = _native.Pose(dt=dt, speed=pose.speed)
        p.entry[0], p.entry[1] = pose.entry
        p.tip[0], p.tip[1] = pose.tip
        self.check(self.core.echospline_forced_advance(self.forced, ctypes.byref(p)))

    def displacement(self) -> np.ndarray:
        u = np.empty((self.nodes, 2))
        self.check(self.core.echospline_forced_displacement(self.forced, u.ctypes.data, u.size))
        return u

    def displacement_at(self, points: np.ndarray) -> np.ndarray:
        p = np.ascontiguousarray(points, dtype=np.float64)
        u = np.empty_like(p)
        self.check(
            self.core.echospline_forced_displacement_at(self.forced, p.ctypes.data, len(p), u.ctypes.data)
        )
        return u

    def load(self) -> _native.NeedleLoad:
        load = _native.NeedleLoad()
        self.check(self.core.echospline_forced_load(self.forced, ctypes.byref(load)))
        return load

    def save(self) -> bytes:
        saved = ctypes.create_string_buffer(self.core.echospline_forced_state_size(self.forced))
        self.check(self.core.echospline_forced_state_save(self.forced, saved, len(saved)))
        return saved.raw

    def restore(self, saved: bytes) -> None:
        self.check(self.core.echospline_forced_state_load(self.forced, saved, len(saved)))

    def __del__(self) -> None:
        self.core.echospline_forced_destroy(self.forced)
        self.core.echospline_green_destroy(self.green)
