"""The words "tps", "elastic", "green" and "fem" become classes here and nowhere else."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from echospline.errors import InputError
from echospline.mechanics import (
    Clamps,
    Elastic,
    FEMModel,
    Forces,
    GreenModel,
    Kernel,
    NeedleForces,
    NeoHookeanModel,
    ThinPlate,
    TPSModel,
    TPSParameters,
    ViscousForces,
    anchors_for,
    landmark_stiffness,
)
from echospline.mechanics.protocol import TissueModel
from echospline.scenario.scenario import Scenario
from echospline.scenario.sections import ForceSection
from echospline.scenario.space_models import MODELS, build_slab_model
from echospline.scene import RegularGrid


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
    if scenario.model.mechanics == "space":
        return build_slab_model(scenario, grid, tissue, kind)
    neo_hookean = scenario.tissue.material == "neo-hookean"
    if neo_hookean and kind in MODELS and kind != "fem":
        raise InputError(
            f"tissue.material = 'neo-hookean' is large deformation, which finite elements alone compute: choose model fem, or "
            f"material linear; got model {kind}"
        )
    mesh = scenario.mesh
    clamped, sliding, points = mesh.clamped, mesh.sliding, mesh.clamped_points
    if kind in ("fem", "green"):
        forces = _forces(scenario.model.forces)
        if kind == "fem":
            linear = FEMModel(grid, clamped, tissue, forces, sliding=sliding, clamped_points=points)
            return NeoHookeanModel(linear) if neo_hookean else linear
        green = scenario.model.green.model_dump()
        return GreenModel(grid, clamped, tissue, forces, sliding=sliding, clamped_points=points, **green)
    landmarks = scenario.model.landmarks.model_dump(exclude_none=True)
    if (
        kind == "elastic" and sliding
    ):  # further apart, a fifth of a displacement passes through a sliding edge between anchors
        landmarks.setdefault("anchor_spacing", 1.0)
    parameters = TPSParameters(**landmarks)
    kernel: Kernel = ThinPlate()
    if kind == "elastic":
        section = scenario.model.elastic
        nu = tissue.poisson if section.poisson is None else section.poisson
        kernel = Elastic(nu, section.radius, tissue.plane)
    if kind in ("tps", "elastic"):
        anchors = anchors_for(Clamps.of(grid, clamped, points, sliding), kernel, parameters.anchor_spacing)
        stiffness = None if tissue.homogeneous else landmark_stiffness(tissue, grid, kernel, anchors)
        return TPSModel(
            grid, clamped, parameters, kernel, sliding=sliding, clamped_points=points, stiffness=stiffness
        )
    raise InputError(f"a model is one of {', '.join(MODELS)}; got {kind!r}")


def _forces(section: ForceSection) -> Forces:
    """Build the law of forces that a scenario names."""
    law = ViscousForces if section.law == "viscous" else NeedleForces
    return law(**section.model_dump(include={parameter.name for parameter in fields(law)}))
