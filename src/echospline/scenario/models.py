"""The words "tps", "elastic", "green" and "fem" become classes here and nowhere else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from echospline.errors import InputError
from echospline.mechanics import (
    Clamps,
    Elastic,
    FEMModel,
    GreenModel,
    Kernel,
    NeedleForces,
    ThinPlate,
    TPSModel,
    TPSParameters,
    landmark_stiffness,
)
from echospline.mechanics.protocol import TissueModel
from echospline.scenario.scenario import Scenario
from echospline.scene import RegularGrid

MODELS = ("tps", "elastic", "green", "fem")


def build_model(
    scenario: Scenario, grid: RegularGrid, *, kind: str | None = None, folder: Path | None = None
) -> TissueModel[Any]:
    """Build the tissue model of a scenario.

    Parameters
    ----------
    scenario : Scenario
        Its [tissue], [mesh] and [model].
    grid : RegularGrid
        The mesh.
    kind : {"tps", "elastic", "green", "fem"}, optional
        Another model than the scenario's, for the same scene.
    folder : Path, optional
        Start of the scenario's relative paths; the working folder when not given.

    Raises
    ------
    InputError
        If there is no such model or its parameters are invalid.
    """
    kind = kind or scenario.model.kind
    tissue = scenario.make_tissue(folder or Path(), grid)
    clamped, points = scenario.mesh.clamped, scenario.mesh.clamped_points
    if kind in ("fem", "green"):
        forces = NeedleForces(**scenario.model.forces.model_dump())
        if kind == "fem":
            return FEMModel(grid, clamped, tissue, forces, clamped_points=points)
        radius = scenario.model.green.radius
        return GreenModel(grid, clamped, tissue, forces, clamped_points=points, radius=radius)
    parameters = TPSParameters(**scenario.model.landmarks.model_dump())
    kernel: Kernel = ThinPlate()
    if kind == "elastic":
        section = scenario.model.elastic
        nu = tissue.poisson if section.poisson is None else section.poisson
        kernel = Elastic(nu, section.radius, tissue.plane)
    if kind in ("tps", "elastic"):
        anchors = Clamps.of(grid, clamped, points).anchors(parameters.anchor_spacing)
        try:
            stiffness = None if tissue.homogeneous else landmark_stiffness(tissue, grid, kernel, anchors)
            return TPSModel(grid, clamped, parameters, kernel, clamped_points=points, stiffness=stiffness)
        except InputError as error:
            if "on one line" not in str(error):
                raise
            raise InputError(
                f"mesh.clamped = {list(clamped)} (--clamped) does not hold a thin plate spline: {error}; clamp a second edge, "
                "or use the model fem or elastic, which one edge holds"
            ) from None
    raise InputError(f"a model is one of {', '.join(MODELS)}; got {kind!r}")
