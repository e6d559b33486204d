"""What a plane model misses of tissue in space: the same needle and forces in both, judged by the motion that the picture shows.

A scene is a block of tissue with the study's plane in its middle. The truth is quadratic hexahedra that correct closed forms near the needle; the plane models are
finite elements in plane stress and plane strain, which know what a plane can know: the block's thickness, and the needle's projection.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline.mechanics import Clamps, SpatialForceModel
from echospline.mechanics.fem_response import FEMResponse
from echospline.mechanics.space_response import block
from echospline.mechanics.spatial_fem_response import SpatialFEMResponse
from echospline.scene import Floats, Layer, Region, RegularGrid, SpatialPose, Tissue
from echospline.study.accuracy import CLAMPED, SIZE

YOUNG, POISSON = 10.0, 0.45
"""kPa, and Poisson's ratio."""
TIP, FRICTION = 0.4, 5e-3
"""N at the tip, and N/mm along the shaft."""
PIECE = 0.25
"""mm of shaft for each place at which friction acts, at most."""
NEAR = 3.0
"""mm from the needle's axis: closer, the field is that of a point force and depends on how it is spread."""
HEADINGS = ((-8.0, 60.0, 22.0), (6.0, 115.0, 22.0), (0.0, 90.0, 20.0))
"""Entry (mm from the middle), angle (degrees) and depth (mm) of the needles, in the plane."""
SIDES = ("left", "right", "bottom")
WALLS = (*SIDES, "front", "back")


@dataclass(frozen=True)
class SpaceScene:
    """A block of tissue, and needles at one position to the picture's plane.

    Parameters
    ----------
    name : str
        For tables.
    thickness : float
        Of the block across the plane, mm.
    held : tuple of str
        Clamped faces; the others are free.
    layer : (top, bottom), optional
        Depths of a layer of five times the modulus, mm.
    aside : float
        Distance of the needle's middle from the plane, mm.
    turned : float
        Angle by which the needle is turned out of the plane about the vertical through its middle, degrees.
    """

    name: str
    thickness: float = 40.0
    held: tuple[str, ...] = WALLS
    layer: tuple[float, float] | None = None
    aside: float = 0.0
    turned: float = 0.0

    @property
    def regions(self) -> list[Region]:
        """The layer, if there is one."""
        return [] if self.layer is None else [Region(Layer(*self.layer), 5 * YOUNG)]

    def needles(self) -> Iterator[SpatialPose]:
        """Poses, x from the middle of the block."""
        c, s = np.cos(np.radians(self.turned)), np.sin(np.radians(self.turned))
        for entry, angle, depth in HEADINGS:
            along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))]) * depth
            middle = np.array([entry + along[0] / 2, along[1] / 2, self.aside])
            # an oblique needle turns about the vertical; a vertical one has no direction there and leans out of the plane
            half = np.array([along[0] / 2 * c, along[1] / 2, along[0] / 2 * s])
            if abs(along[0]) < 1e-9:
                half = np.array([0.0, along[1] / 2 * c, along[1] / 2 * s])
                middle[1] = half[1]
            yield SpatialPose(tuple(middle - half), tuple(middle + half), 1.0)


SPACE_SCENES = (
    SpaceScene("40 mm thick, front and back free", held=SIDES),
    SpaceScene("10 mm thick, front and back free", 10.0, SIDES),
    SpaceScene("40 mm thick, all walls clamped"),
    SpaceScene("the same, 50 kPa below 12 mm", layer=(12.0, SIZE[1])),
    SpaceScene("walls clamped, needle 4 mm beside the plane", aside=4.0),
    SpaceScene("walls clamped, needle turned 30 degrees out of the plane", turned=30.0),
)


def plane_space_rows(**arguments: Any) -> dict[str, Any]:
    """Run one scene: ``scene``, its place in `SPACE_SCENES`, ``nodes`` (nx, ny) of the plane mesh, and ``cell``, mm, of the truth's hexahedra."""
    nx, ny = arguments["nodes"]
    scene = SPACE_SCENES[int(arguments["scene"])]
    return {"rows": list(_rows(scene, (int(nx), int(ny)), float(arguments["cell"])))}


def _rows(scene: SpaceScene, nodes: tuple[int, int], cell: float) -> Iterator[dict[str, Any]]:
    width, height = SIZE
    grid = RegularGrid(nodes, (width / (nodes[0] - 1), height / (nodes[1] - 1)), (-width / 2, 0.0))
    points = np.column_stack([grid.nodes, np.zeros(grid.size)])
    tissue = Tissue(YOUNG, POISSON, regions=scene.regions)
    mesh, clamps = block((width, height, scene.thickness), dict.fromkeys(scene.held, "clamped"))
    truth = SpatialFEMResponse(mesh, clamps, tissue, cell=cell)
    live = SpatialForceModel.green(mesh, scene.held, tissue, radius=truth.radius).response
    poses = list(scene.needles())
    loads = [_load(pose) for pose in poses]

    def in_space(response: Any) -> Floats:
        fields = [
            response.field_of([response.column(places, size / size.sum())], size.sum() * axis[None])(points)
            for places, size, axis in loads
        ]
        return np.array(fields)

    seen = in_space(truth)
    far = np.array([_distance(pose, points) > NEAR for pose in poses])
    about = {
        "scene": scene.name,
        "mean_displacement_mm": float(np.linalg.norm(seen[..., :2], axis=-1)[far].mean()),
        "out_of_plane_percent": 100 * float(np.abs(seen[..., 2])[far].mean() / np.linalg.norm(seen, axis=-1)[far].mean()),
    }  # fmt: skip
    for plane in ("stress", "strain"):
        flat = Tissue(YOUNG, POISSON, thickness=scene.thickness, plane=plane, regions=scene.regions)
        response = FEMResponse(grid, Clamps.of(grid, CLAMPED), flat)
        fields = []
        for places, size, axis in loads:
            forces = (size[:, None] * axis)[:, :2]
            fields.append(response.answer(places[:, :2], forces[..., None], grid.nodes)[1][..., 0])
        yield {**about, "model": f"plane {plane}", **_numbers(np.array(fields), seen[..., :2], far)}
    yield {**about, "model": "green in space", **_numbers(in_space(live)[..., :2], seen[..., :2], far)}


def _load(pose: SpatialPose) -> tuple[Floats, Floats, Floats]:
    """Return places (m, 3), the forces' sizes (m,) in N, friction along the shaft and then the tip, and the axis (3,)."""
    pieces = int(np.ceil(pose.depth / PIECE))
    entry, axis = np.array(pose.entry), np.array(pose.axis)
    s = np.append((np.arange(pieces) + 0.5) / pieces, 1.0) * pose.depth
    size = np.append(np.full(pieces, FRICTION * pose.depth / pieces), TIP)
    return entry + s[:, None] * axis, size, axis


def _distance(pose: SpatialPose, points: Floats) -> Floats:
    """Return the distance of points (n, 3) from the needle and from its projection on the plane z = 0, the lesser, mm."""
    least = np.full(len(points), np.inf)
    for flat in (1.0, 0.0):
        a, b = (np.array(p) * [1.0, 1.0, flat] for p in (pose.entry, pose.tip))
        share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        least = np.minimum(least, np.linalg.norm(points - a - share[:, None] * (b - a), axis=1))
    return least


def _numbers(u: Floats, truth: Floats, far: NDArray[np.bool_]) -> dict[str, Any]:
    """Compare displacements (needles, n, 2) at the points ``far`` (needles, n) from the needle, nearer, and everywhere."""
    size = np.linalg.norm(truth, axis=-1)

    def share(factor: float, where: NDArray[np.bool_] = far) -> float:
        return 100 * float(np.linalg.norm(factor * u - truth, axis=-1)[where].mean() / size[where].mean())

    factor = best_factor(u[far], truth[far])
    moved = np.linalg.norm(u, axis=-1)
    return {
        "moves_percent": 100 * float(moved[far].mean() / size[far].mean()),
        "moves_near_percent": 100 * float(moved[~far].mean() / size[~far].mean()),
        "error_percent": share(1.0),
        "best_factor": factor,
        "error_with_factor_percent": share(factor),
        "error_everywhere_percent": share(1.0, np.ones_like(far)),
    }


def best_factor(u: Floats, truth: Floats) -> float:
    """Return the factor of u (n, 2) with the least mean distance from truth (n, 2): a convex problem in one number, by golden section."""
    low, high = 0.0, 2.0 * float(np.linalg.norm(truth, axis=1).sum() / np.linalg.norm(u, axis=1).sum())
    ratio = (np.sqrt(5.0) - 1.0) / 2.0
    while high - low > 1e-6 * high:
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        if np.linalg.norm(a * u - truth, axis=1).sum() < np.linalg.norm(b * u - truth, axis=1).sum():
            high = b
        else:
            low = a
    return float((low + high) / 2)
