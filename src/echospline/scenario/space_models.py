"""The words "green", "tps", "elastic" and "fem" become classes in space here, and [tissue] with its regions becomes tissue in space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from echospline.errors import InputError
from echospline.mechanics import Elastic, Kernel, NeedleForces, ThinPlate, TPSParameters
from echospline.mechanics.plane_in_space import PlaneInSpace, extruded, faces, slab
from echospline.mechanics.protocol import SpatialTissueModel
from echospline.mechanics.spatial_force_model import SpatialForceModel
from echospline.mechanics.spatial_landmark_model import IN_SPACE, SpatialLandmarkModel
from echospline.scenario.scenario import Scenario
from echospline.scene import RegularGrid, SpatialGrid, Tissue

MODELS = ("tps", "elastic", "green", "fem")
LAW = (
    "tip",
    "friction_limit",
    "bond",
    "tip_stiffness",
    "side_stiffness",
    "viscosity",
    "station_spacing",
    "substep",
    "dead_band",
)
"""Keys of [model.forces] that the law in space reads."""


def build_spatial_model(
    scenario: Scenario, grid: SpatialGrid, tissue: Tissue, *, kind: str | None = None
) -> SpatialTissueModel[Any]:
    """Build the tissue model of a scenario in space.

    Parameters
    ----------
    scenario : Scenario
        Its [space.mesh] and [model].
    grid : SpatialGrid
        The mesh.
    tissue : Tissue
        In space.
    kind : {"green", "tps", "elastic", "fem"}, optional
        Another model than the scenario's, for the same scene.

    Raises
    ------
    InputError
        If the scenario has no [space], there is no such model, or its parameters are invalid.
    """
    if scenario.space is None:
        raise InputError("this scenario is no scene in space: it has no [space] table")
    mesh = scenario.space.mesh
    return _model(scenario, grid, mesh.clamped, mesh.sliding, tissue, kind or scenario.model.kind)


def build_slab_model(
    scenario: Scenario, grid: RegularGrid, tissue: Tissue, kind: str | None = None
) -> PlaneInSpace[Any]:
    """Build the tissue model of a picture whose tissue is a slab in space: `model.mechanics = "space"`.

    Parameters
    ----------
    scenario : Scenario
        Its [mesh] and [model].
    grid : RegularGrid
        The picture's mesh.
    tissue : Tissue
        Of the plane; every section of the slab is like it, and its thickness is the slab's.
    kind : {"green", "tps", "elastic", "fem"}, optional
        Another model than the scenario's, for the same scene.

    Raises
    ------
    InputError
        If points are clamped, the material is for large deformation, or there is no such model.
    """
    if scenario.mesh.clamped_points:
        raise InputError(
            "mesh.clamped_points hold points of a picture; in space they would be lines or points of the slab: leave them out, or take "
            'model.mechanics = "plane"'
        )
    if scenario.tissue.material != "linear":
        raise InputError(
            'tissue.material = "neo-hookean" is computed in the plane alone: take model.mechanics = "plane", or material linear'
        )
    sides = scenario.mesh.sides
    clamped = faces(scenario.mesh.clamped, sides, "clamped")
    sliding = faces(scenario.mesh.sliding, sides, "sliding")
    inside = extruded(tissue, grid.extent[2])
    whole = slab(grid, tissue.thickness)
    return PlaneInSpace(grid, _model(scenario, whole, clamped, sliding, inside, kind or scenario.model.kind))


def _model(
    scenario: Scenario,
    grid: SpatialGrid,
    clamped: Sequence[str],
    sliding: Sequence[str],
    tissue: Tissue,
    kind: str,
) -> SpatialTissueModel[Any]:
    """Build a model by its name."""
    if kind in ("green", "fem"):
        section = scenario.model.forces
        if section.law != "stick-slip":
            raise InputError(
                'model.forces.law = "viscous" is the paper\'s, in the plane; in space the law is "stick-slip"'
            )
        forces = NeedleForces(**{name: getattr(section, name) for name in LAW})
        made = SpatialForceModel.green if kind == "green" else SpatialForceModel.fem
        return made(grid, clamped, tissue, forces, sliding=sliding)
    if kind in ("tps", "elastic"):
        kernel: Kernel = ThinPlate(3)
        if kind == "elastic":
            chosen = scenario.model.elastic
            nu = tissue.poisson if chosen.poisson is None else chosen.poisson
            kernel = Elastic(nu, chosen.radius, dimension=3)
        return SpatialLandmarkModel(grid, clamped, tissue, _landmarks(scenario), kernel, sliding=sliding)
    raise InputError(f"a model is one of {', '.join(MODELS)}; got {kind!r}")


def _landmarks(scenario: Scenario) -> TPSParameters:
    """Return the interaction of [model.landmarks], with the spacings of space where the plane's stand at their defaults."""
    given = scenario.model.landmarks.model_dump(exclude_none=True)
    plane = TPSParameters()
    for name in ("anchor_spacing", "contact_spacing", "delta"):
        if given.get(name, getattr(plane, name)) == getattr(plane, name):
            given[name] = getattr(IN_SPACE, name)
    return TPSParameters(**given)
