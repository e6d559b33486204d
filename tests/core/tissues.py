"""Tissues of the core and of the plain reading of Algorithm 2, side by side, in the plane and in space."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline import _native as core
from echospline.mechanics import Clamps, Elastic, ThinPlate, TPSParameters, anchors_for
from echospline.mechanics.landmarks import contact_lattice, join_gap
from echospline.mechanics.reference import Reference
from echospline.scene import ZERO_LENGTH, Floats, RegularGrid

FACES = {2: ("left", "right", "bottom"), 3: ("left", "right", "bottom", "front", "back")}


@dataclass(frozen=True)
class Box:
    """Points at constant spacing in space, x fastest."""

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def nodes(self) -> Floats:
        x, y, z = (
            o + h * np.arange(n) for n, h, o in zip(self.shape, self.spacing, self.origin, strict=True)
        )
        return np.array([[a, b, c] for c in z for b in y for a in x])

    def nearest(self, point: ArrayLike) -> int:
        index = np.rint(np.subtract(point, self.origin) / self.spacing)
        i, j, k = (int(v) for v in np.clip(index, 0, np.subtract(self.shape, 1)))
        return i + self.shape[0] * (j + self.shape[1] * k)


@dataclass(frozen=True)
class Pose:
    """A needle in the plane or in space."""

    entry: Floats
    tip: Floats
    speed: float = 0.0

    @property
    def depth(self) -> float:
        return float(np.linalg.norm(self.tip - self.entry))

    @property
    def axis(self) -> Floats:
        return (self.tip - self.entry) / self.depth if self.depth >= ZERO_LENGTH else 0 * self.tip


@dataclass(frozen=True)
class Given:
    """A scene."""

    grid: Any
    parameters: TPSParameters
    kernel: ThinPlate | Elastic
    clamped: tuple[str, ...] = ()
    points: Any = None
    stiffness: Floats | None = None
    sliding: tuple[str, ...] = ()

    @property
    def dimension(self) -> int:
        return len(self.grid.shape)

    @cached_property
    def clamps(self) -> Clamps:
        clamped = self.clamped or (() if self.sliding else FACES[self.dimension])
        return Clamps.of(self.grid, clamped, self.points, self.sliding)

    def oracle(self) -> Reference:
        p = self.parameters
        lattice = contact_lattice(self.clamps, p.contact_spacing)
        anchors = anchors_for(self.clamps, self.kernel, p.anchor_spacing)
        gap = join_gap(self.grid, lattice)
        return Reference(self.grid, p, self.kernel, self.clamps, anchors, lattice, gap, self.stiffness)


class Session:
    """A tissue of the core; failures raise its message."""

    def __init__(self, given: Given, precision: str = "double") -> None:
        self.library, self.dimension = core.library(), given.dimension
        p, o = given.parameters, core.SceneOptions(struct_size=ctypes.sizeof(core.SceneOptions))
        o.dimension, o.precision = self.dimension, core.Precision[precision.upper()]
        o.tip, o.loading = core.Tip[f"TIP_{p.tip.upper()}"], core.Loading[p.loading.upper()]
        o.clamped = sum(core.Edge[name.upper()] for name in given.clamps.edges)
        o.sliding = sum(core.Edge[name.upper()] for name in given.clamps.sliding)
        for name in ("shape", "spacing", "origin"):
            getattr(o, name)[: self.dimension] = getattr(given.grid, name)
        for name in ("sigma", "delta", "alpha1", "alpha2", "alpha3", "length", "drag", "friction_speed"):
            setattr(o, name, getattr(p, name))
        o.contact_spacing, o.anchor_spacing = p.contact_spacing, p.anchor_spacing
        solid = given.kernel if isinstance(given.kernel, Elastic) else Elastic()
        o.kernel = core.Kernel.ELASTIC if solid is given.kernel else core.Kernel.THIN_PLATE
        o.poisson, o.radius, o.plane = solid.nu, solid.radius, core.Plane[f"PLANE_{solid.plane.upper()}"]
        points = np.ascontiguousarray(given.clamps.points, dtype=np.float64)
        o.clamped_points, o.clamped_point_count = points.ctypes.data, len(points)
        if given.stiffness is not None:
            o.stiffness, o.stiffness_count = given.stiffness.ctypes.data, len(given.stiffness)
        self.scene, self.tissue = ctypes.c_void_p(), ctypes.c_void_p()
        status = self.library.echospline_scene_create(o, self.scene)
        core.check(status, self.library.echospline_scene_message, self.scene)
        self._check(self.library.echospline_tissue_create(self.scene, self.tissue))

    def __del__(self) -> None:
        self.library.echospline_tissue_destroy(self.tissue)
        self.library.echospline_scene_destroy(self.scene)

    def _check(self, status: int) -> None:
        core.check(status, self.library.echospline_tissue_message, self.tissue)

    def advance(self, pose: Pose, dt: float) -> None:
        p = core.Pose(speed=pose.speed, dt=dt)
        p.entry[: self.dimension], p.tip[: self.dimension] = pose.entry, pose.tip
        self._check(self.library.echospline_advance(self.tissue, p))

    def displacement(self) -> Floats:
        u = np.empty((self.library.echospline_scene_node_count(self.scene), self.dimension))
        self._check(self.library.echospline_displacement(self.tissue, u.ctypes.data, u.size))
        return u

    def displacement_at(self, points: Floats) -> Floats:
        x = np.ascontiguousarray(points, dtype=np.float64)
        u = np.empty_like(x)
        self._check(
            self.library.echospline_displacement_at(self.tissue, x.ctypes.data, len(x), u.ctypes.data)
        )
        return u

    def landmarks(self) -> list[Any]:
        count = ctypes.c_int64()
        self._check(self.library.echospline_landmarks(self.tissue, None, 0, count))
        marks = (core.Landmark * count.value)()
        self._check(self.library.echospline_landmarks(self.tissue, marks, count.value, count))
        return list(marks)

    def statistics(self) -> Any:
        s = core.Statistics(struct_size=ctypes.sizeof(core.Statistics))
        self._check(self.library.echospline_tissue_statistics(self.tissue, s))
        return s

    def anchors(self) -> Floats:
        x = np.empty((self.library.echospline_scene_anchor_count(self.scene), self.dimension))
        status = self.library.echospline_scene_anchors(self.scene, x.ctypes.data, x.size)
        core.check(status, self.library.echospline_scene_message, self.scene)
        return x

    def sources(self) -> NDArray[np.int64]:
        nodes = np.empty(self.library.echospline_scene_source_count(self.scene), dtype=np.int64)
        status = self.library.echospline_scene_sources(self.scene, nodes.ctypes.data, nodes.size)
        core.check(status, self.library.echospline_scene_message, self.scene)
        return nodes


def given(dimension: int, kernel: str, *, stiff: bool = False, **parameters: Any) -> Given:
    """A scene for tests: the plane 40 x 30 mm, or a box 36 x 28 x 26 mm whose every second or third node may be a contact."""
    if dimension == 2:
        grid: Any = RegularGrid((27, 21), (40 / 26, 30 / 20))
        chosen = TPSParameters()
    else:
        grid = Box((25, 21, 27), (1.5, 1.4, 1.0))
        chosen = TPSParameters(delta=2.5, contact_spacing=3.0, anchor_spacing=9.0)
    solid = Elastic(0.45, 1.0, dimension=dimension)
    stiffness = None
    if stiff:
        stiffness = np.random.default_rng(1).uniform(0.5, 5.0, len(grid.nodes))
        stiffness[::7] = np.inf
    return Given(
        grid,
        replace(chosen, **parameters),
        solid if kernel == "elastic" else ThinPlate(dimension=dimension),
        stiffness=stiffness,
    )


def handling(seed: int, grid: Any, dt: float) -> Iterator[Pose]:
    """What a hand does: push, tilt, stop, shift sideways, withdraw, push again, leave, and enter elsewhere; a pose every dt s."""
    rng = np.random.default_rng(seed)
    low = np.array(grid.origin)
    high = low + np.subtract(grid.shape, 1) * np.array(grid.spacing)
    D = len(low)
    for _ in range(2):
        entry = low + rng.uniform(0.3, 0.7, D) * (high - low)
        entry[1] = low[1]
        axis = rng.normal(0, 0.4, D)
        axis[1] = 1.0
        depth, plan = 0.0, [("push", 9), ("tilt", 4), ("push", 3), ("stop", 3), ("shift", 3), ("pull", 5)]
        plan += [("push", 3), ("pull", 12)] if _ == 0 else [("stop", 2)]
        for what, steps in plan:
            turn, speed = rng.normal(0, 0.06, D), rng.uniform(8.0, 16.0)
            for _step in range(steps):
                before = depth
                if what == "push":
                    depth = min(depth + speed * dt, 0.6 * (high[1] - low[1]))
                elif what == "pull":
                    depth = max(depth - speed * dt, 0.0)
                elif what == "tilt":
                    axis = axis + turn
                elif what == "shift":
                    entry = entry + np.where(np.arange(D) == 1, 0.0, 6 * turn)
                axis = axis / np.linalg.norm(axis)
                yield Pose(entry.copy(), entry + depth * axis, (depth - before) / dt)
