"""A scene in space for tests of the link: smooth voxels, a small probe, and tissue that follows the tip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from echospline.live import SpatialEngine
from echospline.openigtlink import SpatialStage
from echospline.picture.slices import SliceDrawing
from echospline.scene import ImagingPlane, Probe, SpatialGrid, SpatialPose, Volume, probe_plane

PROBE = Probe(width=16.0, depth=14.0, pixel=0.25, elevation=0.0)
GRID = SpatialGrid.spanning((-15.0, 0.0, -10.0), (15.0, 24.0, 10.0), (7, 6, 5))
HOME = SpatialPose((-6.0, 0.0, 0.0), (-6.0, 0.0, 0.0))


def smooth_volume() -> Volume:
    """Voxels of 0.5 mm whose brightness varies along all three axes, over (-15..15, 0..24, -10..10) mm."""
    z, y, x = np.meshgrid(
        np.linspace(-10, 10, 41), np.linspace(0, 24, 49), np.linspace(-15, 15, 61), indexing="ij"
    )
    bright = 125 + 50 * np.sin(x / 4) + 40 * np.cos(y / 3 + 0.3 * x) + 30 * np.sin(z / 2.5 + y / 5)
    return Volume(bright.round().astype(np.uint8), (0.5, 0.5, 0.5), (-15.0, 0.0, -10.0), source="smooth")


@dataclass(frozen=True)
class Dragged:
    """Stand-in tissue: what is near the tip goes with it; `share` tells models apart."""

    share: float = 0.12
    grid: SpatialGrid = GRID

    def rest(self):
        return HOME

    def advance(self, state, pose, dt):
        return pose

    def field(self, state):
        def u(points):
            r2 = ((points - np.array(state.tip)) ** 2).sum(axis=1)
            return self.share * state.depth * np.exp(-r2 / 40.0)[:, None] * np.array(state.axis)

        return u


class Failing(Dragged):
    def advance(self, state, pose, dt):
        raise ArithmeticError("no answer")


MODELS = {"soft": Dragged(), "stiff": Dragged(0.01), "failing": Failing()}


def make_engine(**options) -> SpatialEngine:
    return SpatialEngine(
        lambda name: MODELS[name],
        "soft",
        SliceDrawing(smooth_volume(), PROBE),
        probe_plane((0.0, 0.0, 0.0)),
        HOME,
        **options,
    )


def make_stage(**options) -> SpatialStage:
    stage = {k: options.pop(k) for k in ("insertion", "planes", "place") if k in options}
    return SpatialStage(make_engine(rate=100.0, **options), tuple(MODELS), **stage)


def expected_picture(plane: ImagingPlane, pose: SpatialPose | None = None, share: float = 0.12) -> np.ndarray:
    """Brightness at every pixel of a plane, by plain interpolation where the tissue under it lay at rest; (rows, columns)."""
    p = plane.lift(PROBE.grid.nodes)
    X = p
    if pose is not None:
        u = Dragged(share).field(pose)
        for _ in range(60):
            X = p - u(X)
    return smooth_volume().sample(X).reshape(PROBE.grid.shape[::-1])


def rigid(turn, shift) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    matrix[:3, 3] = shift
    return matrix
