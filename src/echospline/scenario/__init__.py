"""Scenario files: their tables and messages, the models that they name, and their runs."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.scenario.body_section import BodySection, bodies_of
    from echospline.scenario.core_models import (
        CoreScene,
        ForcedScene,
        SpatialForcedScene,
        forced_scene,
        forced_steps,
        landmark_scene,
        landmark_steps,
        spatial_scene,
        spatial_steps,
    )
    from echospline.scenario.models import build_model
    from echospline.scenario.run import run
    from echospline.scenario.scale import (
        PHANTOM,
        check,
        check_store,
        needle_doubts,
        size_doubts,
    )
    from echospline.scenario.scenario import LARGEST_FILE, Scenario, describe, load, validated
    from echospline.scenario.sections import DiscSection, ExerciseSection
    from echospline.scenario.space_models import MODELS
    from echospline.scenario.space_scale import check_space, unused_doubts
    from echospline.scenario.space_scene import SpatialScene, is_spatial, open_spatial
else:
    on_demand(__name__)

__all__ = [
    "LARGEST_FILE",
    "MODELS",
    "PHANTOM",
    "BodySection",
    "CoreScene",
    "DiscSection",
    "ExerciseSection",
    "ForcedScene",
    "Scenario",
    "SpatialForcedScene",
    "SpatialScene",
    "bodies_of",
    "build_model",
    "check",
    "check_space",
    "check_store",
    "describe",
    "forced_scene",
    "forced_steps",
    "is_spatial",
    "landmark_scene",
    "landmark_steps",
    "load",
    "needle_doubts",
    "open_spatial",
    "run",
    "size_doubts",
    "spatial_scene",
    "spatial_steps",
    "unused_doubts",
    "validated",
]
