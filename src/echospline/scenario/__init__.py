"""Scenario files: their tables and messages, and the models that they name.

`run` is imported by its own name: it loads the writers of sequences.
"""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.scenario.models import MODELS, build_model
    from echospline.scenario.scenario import LARGEST_FILE, PHANTOM, Scenario, describe, load, validated
    from echospline.scenario.sections import DiscSection, ExerciseSection
else:
    on_demand(__name__)

__all__ = [
    "LARGEST_FILE",
    "MODELS",
    "PHANTOM",
    "DiscSection",
    "ExerciseSection",
    "Scenario",
    "build_model",
    "describe",
    "load",
    "validated",
]
