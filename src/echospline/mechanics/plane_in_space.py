"""A picture's tissue as what it is, a slab in space: its plane is z = 0, and the plane's motion is that of a model in space.

Plane elasticity spreads a needle over the whole thickness of the slab: its field falls off as ln r, where tissue about a needle falls off as 1 / r. The
model in space knows the needle as a line. While needle and regions lie in the plane and along z, the plane stays plane.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Literal

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.mechanics.forces import NeedleLoad
from echospline.mechanics.protocol import SpatialTissueModel, State, described, needle_load
from echospline.mechanics.spatial_force_model import SpatialForceState
from echospline.scene import (
    Extruded,
    Floats,
    Layer,
    NeedlePose,
    Region,
    RegularGrid,
    SpatialGrid,
    SpatialPose,
    Tissue,
    as_points,
)

Sides = Literal["clamped", "sliding", "free"]
MOST_LAYERS = 41
"""Nodes across the slab at most: more than landmark models can have contacts for."""


def slab(grid: RegularGrid, thickness: float) -> SpatialGrid:
    """Lay a mesh in space about a picture's mesh: the picture is z = 0, its first row y = 0; layers are as far apart as nodes of the picture.

    Parameters
    ----------
    grid : RegularGrid
        The picture's mesh, mm.
    thickness : float
        Of the slab, mm.

    Raises
    ------
    InputError
        If the thickness is not positive.
    """
    if not (np.isfinite(thickness) and thickness > 0):
        raise InputError(f"thickness of the tissue must be a positive number in mm; got {thickness}")
    x0, x1, y0, y1 = grid.extent
    across = 2 * max(1, min(MOST_LAYERS // 2, round(thickness / 2 / max(grid.spacing)))) + 1
    nx, ny = grid.shape
    half = thickness / 2
    return SpatialGrid.spanning((x0, 0.0, -half), (x1, y1 - y0, half), (nx, ny, across))


def extruded(tissue: Tissue, surface: float = 0.0) -> Tissue:
    """Return the tissue of a slab whose every section is a plane's tissue; ``surface`` is the plane's y that becomes 0."""
    regions = [
        Region(
            Layer(r.shape.top - surface, r.shape.bottom - surface)  # elements put lines on its interfaces
            if isinstance(r.shape, Layer)
            else Extruded(r.shape, surface),
            r.young, r.poisson, r.name, r.fluid,
        )
        for r in tissue.regions
    ]  # fmt: skip
    return Tissue(tissue.young, tissue.poisson, regions, tissue.thickness, tissue.plane)


def faces(edges: Iterable[str], sides: Sides, wanted: Sides) -> tuple[str, ...]:
    """Return the faces of a slab that are held as ``wanted``: the edges given, and front and back where they are held so."""
    return (*edges, *(("front", "back") if sides == wanted else ()))


@dataclass(frozen=True, slots=True, eq=False)
class PlaneState(Generic[State]):
    """State of the model in space, and where the needle is in the plane."""

    inner: State
    pose: NeedlePose | None = None


class PlaneInSpace(Generic[State]):
    """The plane z = 0 of a model in space as a tissue model of the plane. Thread-safe; it pickles as its model does.

    Parameters
    ----------
    grid : RegularGrid
        The picture's mesh: its nodes carry the displacement.
    model : SpatialTissueModel
        On `slab` of the same mesh.

    Raises
    ------
    InputError
        If the model's tissue is not that of the mesh.
    """

    def __init__(self, grid: RegularGrid, model: SpatialTissueModel[State]) -> None:
        self.grid, self.model = grid, model
        x0, x1, y0, y1 = grid.extent
        low, high = model.grid.corners
        if not np.allclose([low[0], high[0], low[1], high[1]], [x0, x1, 0.0, y1 - y0], atol=1e-6):
            raise InputError(
                f"the tissue in space spans x {low[0]:g} to {high[0]:g} and y {low[1]:g} to {high[1]:g} mm; the picture's mesh x {x0:g} to "
                f"{x1:g} and, from its first row, y 0 to {y1 - y0:g}: lay it by slab"
            )
        self._top = y0
        self._warned: set[str] = set()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the model was made of."""
        return partial(PlaneInSpace), (self.grid, self.model)

    def rest(self) -> PlaneState[State]:
        """State of tissue that no needle has touched."""
        return PlaneState(self.model.rest())

    def advance(self, state: PlaneState[State], pose: NeedlePose, dt: float) -> PlaneState[State]:
        """State after the needle has moved to ``pose`` in ``dt`` seconds."""
        (ex, ey), (tx, ty) = pose.entry, pose.tip
        lifted = SpatialPose((ex, ey - self._top, 0.0), (tx, ty - self._top, 0.0), pose.speed)
        after = PlaneState(self.model.advance(state.inner, lifted, dt), pose)
        self._warn(after)
        return after

    def displacement(self, state: PlaneState[State]) -> Floats:
        """Displacement of the mesh nodes, shape (n, 2), mm."""
        return self.displacement_at(state, self.grid.nodes)

    def displacement_at(self, state: PlaneState[State], points: ArrayLike) -> Floats:
        """Displacement of any reference points (n, 2) in mm, shape (n, 2), mm."""
        p = as_points(points)
        lifted = np.column_stack([p[:, 0], p[:, 1] - self._top, np.zeros(len(p))])
        u: Floats = np.ascontiguousarray(self.model.field(state.inner)(lifted)[:, :2], dtype=np.float64)
        return u

    def needle_load(self, state: PlaneState[State]) -> NeedleLoad | None:
        """Return the needle's forces on the tissue, with the signs of the plane; None where the model has none (landmarks)."""
        load, inner = needle_load(self.model, state.inner), state.inner
        if load is None or state.pose is None or not isinstance(inner, SpatialForceState):
            return load
        x, y = state.pose.axis if state.pose.depth > 0 else (0.0, 1.0)
        side = float(inner.force[1] * x - inner.force[0] * y)
        return NeedleLoad(load.tip, load.friction, side, float(inner.torque[2]), load.cut)

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        low, high = self.model.grid.corners
        return f"in space, in the middle of a slab of {high[2] - low[2]:g} mm: {described(self.model)}"

    def _warn(self, state: PlaneState[State]) -> None:
        """Say once per model what goes beyond the limits of the response."""
        doubts = getattr(self.model, "warnings", None)
        for kind, sentence in (doubts(state.inner) if callable(doubts) else {}).items():
            if kind not in self._warned:
                self._warned.add(kind)
                warnings.warn(sentence, stacklevel=3)
