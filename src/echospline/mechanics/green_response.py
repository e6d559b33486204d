"""Green's function as tissue that answers forces."""

from __future__ import annotations

import numpy as np

from echospline.errors import InputError
from echospline.mechanics.half_plane import GreensFunction
from echospline.mechanics.landmarks import Clamps
from echospline.mechanics.response import ForceResponse
from echospline.scene import Floats, RegularGrid, Tissue


class GreenResponse:
    """Homogeneous tissue by Green's function with anchors along what is clamped: a `ForceResponse`."""

    def __init__(
        self, grid: RegularGrid, clamps: Clamps, tissue: Tissue, *, radius: float, spacing: float
    ) -> None:
        if not tissue.homogeneous:
            raise InputError(
                "Green's function is that of homogeneous tissue; for tissue with regions use finite elements (fem)"
            )
        if clamps.sliding:
            raise InputError(
                "Green's function does not know sliding edges yet; clamp the edge or leave it free"
            )
        self._grid = grid
        self.green = GreensFunction(
            clamps.anchors(spacing), tissue.young, tissue.poisson, tissue.thickness, tissue.plane, radius,
            spacing / (2.0 * np.pi), None if "top" in clamps.edges else grid.origin[1],
        )  # fmt: skip
        self.projector = self.green.projector(grid.nodes)

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self._grid

    def answer(self, places: Floats, forces: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Displacement under k load cases of point forces; see `ForceResponse.answer`."""
        f = forces.transpose(1, 0, 2).reshape(2 * len(places), -1)
        mesh = self.green.columns(self.grid.nodes, places, self.projector) @ f
        at = self.green.columns(points, places) @ f if len(points) else np.zeros((0, f.shape[1]))
        return _vectors(mesh), _vectors(at)

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        return "Green's function of homogeneous tissue, with anchors along what is clamped"


def green_response(
    grid: RegularGrid, clamps: Clamps, tissue: Tissue, *, radius: float = 0.4, spacing: float = 1.5
) -> ForceResponse:
    """Build the response of tissue by Green's function."""
    return GreenResponse(grid, clamps, tissue, radius=radius, spacing=spacing)


def _vectors(blocks: Floats) -> Floats:
    """From (2 n, k) in blocks to (n, 2, k)."""
    vectors: Floats = np.ascontiguousarray(blocks.reshape(2, -1, blocks.shape[1]).transpose(1, 0, 2))
    return vectors
