"""The models of a scenario as every host of the core takes them, and steps of the native core from what such a host was given."""

from __future__ import annotations

from pathlib import Path

from echospline.errors import InputError
from echospline.mechanics import (
    CoreScene,
    ForcedScene,
    ForcedStep,
    GreenModel,
    NativeStep,
    NeedleForces,
    SpatialForcedScene,
    SpatialForceModel,
    SpatialLandmarkModel,
    SpatialStep,
    TPSModel,
)
from echospline.mechanics.space_response import SpaceResponse
from echospline.scenario.models import build_model
from echospline.scenario.scenario import Scenario
from echospline.scenario.space_models import build_spatial_model
from echospline.scene import RegularGrid, SpatialGrid, Tissue

__all__ = [
    "CoreScene",
    "ForcedScene",
    "SpatialForcedScene",
    "forced_scene",
    "forced_steps",
    "landmark_scene",
    "landmark_steps",
    "spatial_scene",
    "spatial_steps",
]

LANDMARKS = ("tps", "elastic")
"""Models of landmarks."""


def landmark_scene(scenario: Scenario, grid: RegularGrid, kind: str, folder: Path) -> CoreScene:
    """Return what the core is given for a model of landmarks.

    Parameters
    ----------
    scenario : Scenario
        Its [tissue], [mesh] and [model].
    grid : RegularGrid
        The mesh.
    kind : {"tps", "elastic"}
        The model.
    folder : Path
        Start of the scenario's relative paths.

    Raises
    ------
    InputError
        If it is no model of landmarks, or its parameters are invalid.
    """
    model = build_model(scenario, grid, kind=kind, folder=folder)
    if not isinstance(model, TPSModel) or model.native is None:
        raise InputError(f"a model of landmarks is one of {', '.join(LANDMARKS)}; got {kind!r}")
    return model.native.scene


def landmark_steps(scene: CoreScene) -> NativeStep:
    """Return the native core's steps of a scene of landmarks.

    Raises
    ------
    InputError, SolverError
        If the core refuses it.
    """
    return NativeStep(scene)


def forced_scene(scenario: Scenario, grid: RegularGrid, folder: Path) -> ForcedScene | None:
    """Return what the core is given for tissue that answers forces by Green's function; None where the scenario's needle has another law.

    Parameters
    ----------
    scenario : Scenario
        Its [tissue], [mesh] and [model].
    grid : RegularGrid
        The mesh.
    folder : Path
        Start of the scenario's relative paths.

    Raises
    ------
    InputError
        If the parameters are invalid.
    """
    if scenario.tissue.material != "linear" or scenario.model.forces.law != "stick-slip":
        return None
    model = build_model(scenario, grid, kind="green", folder=folder)
    assert isinstance(model, GreenModel)
    assert isinstance(model.forces, NeedleForces)
    return ForcedScene.of(model.response, model.forces)


def forced_steps(scene: ForcedScene) -> ForcedStep:
    """Return the native core's steps of a forced scene.

    Raises
    ------
    InputError, SolverError
        If the core refuses it.
    """
    return ForcedStep(scene)


def spatial_scene(
    scenario: Scenario, grid: SpatialGrid, tissue: Tissue, kind: str
) -> CoreScene | SpatialForcedScene | None:
    """Return what the core is given for a model in space; None where finite elements answer, which it has not.

    Parameters
    ----------
    scenario : Scenario
        Its [space.mesh] and [model].
    grid : SpatialGrid
        The mesh.
    tissue : Tissue
        In space.
    kind : {"green", "tps", "elastic"}
        The model.

    Raises
    ------
    InputError
        If its parameters are invalid, or the mesh is too large for it.
    """
    if kind == "green" and tissue.regions:  # before elements are set up in vain
        return None
    model = build_spatial_model(scenario, grid, tissue, kind=kind)
    if isinstance(model, SpatialLandmarkModel):
        return model.native.scene
    assert isinstance(model, SpatialForceModel)
    if not isinstance(model.response, SpaceResponse):
        return None
    return SpatialForcedScene.of(model.response, model.law)


def spatial_steps(scene: SpatialForcedScene) -> SpatialStep:
    """Return the native core's steps of a forced scene in space.

    Raises
    ------
    InputError, SolverError
        If the core refuses it.
    """
    return SpatialStep(scene)
