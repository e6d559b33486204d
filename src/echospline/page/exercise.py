"""Exercises: a target in the tissue, perhaps vessels to avoid, and the criteria of success.

They are the ``[[exercise]]`` tables of a scenario; three are provided for any image.
"""

from __future__ import annotations

from collections.abc import Sequence

from echospline.errors import InputError
from echospline.scenario import DiscSection as Disc
from echospline.scenario import ExerciseSection as Exercise
from echospline.scene import RegularGrid

__all__ = ["Disc", "Exercise", "check_exercises", "default_exercises"]


def check_exercises(exercises: Sequence[Exercise], grid: RegularGrid) -> None:
    """Check names and positions of exercises against each other and the mesh.

    Raises
    ------
    InputError
        If two share a name, or a target, a vessel or an entry lies outside the mesh.
    """
    names = [exercise.name for exercise in exercises]
    for exercise in exercises:
        if names.count(exercise.name) > 1:
            raise InputError(f"two exercises are called {exercise.name!r}; names must differ")
        if not grid.contains(exercise.landmarks).all():
            x0, x1, y0, y1 = grid.extent
            raise InputError(
                f"exercise {exercise.name!r}: target and vessels must lie in the image, "
                f"x from {x0:g} to {x1:g} and y from {y0:g} to {y1:g} mm"
            )
        for entry in _entries(exercise, grid):
            if not grid.contains(entry).all():
                x0, x1, y0, y1 = grid.extent
                raise InputError(
                    f"exercise {exercise.name!r}: the entry must lie in the image, "
                    f"x from {x0:g} to {x1:g} and y from {y0:g} to {y1:g} mm; got {entry[0]:g}, {entry[1]:g}"
                )


def _entries(exercise: Exercise, grid: RegularGrid) -> list[tuple[float, float]]:
    """Return the entries between which an exercise lets its needle begin, mm."""
    if exercise.entry is not None:
        return [exercise.entry]
    return [] if exercise.entry_between is None else [(x, grid.extent[2]) for x in exercise.entry_between]


def default_exercises(grid: RegularGrid) -> tuple[Exercise, ...]:
    """Return three exercises that fit any image: their places are fractions of its extent."""
    x0, x1, y0, y1 = grid.extent
    size = min(x1 - x0, y1 - y0)

    def disc(u: float, v: float, share: float) -> Disc:
        return Disc(centre=(x0 + u * (x1 - x0), y0 + v * (y1 - y0)), radius=share * size)

    return (
        Exercise(
            name="shallow-target",
            title="Hit the target",
            goal="Bring the tip into the ring. The tissue moves with the needle, and the target with it.",
            target=disc(0.58, 0.38, 0.035),
        ),
        Exercise(
            name="deep-target",
            title="One straight path",
            goal="Choose entry and angle well: hit the deep target without turning the needle inside the tissue.",
            target=disc(0.42, 0.66, 0.03),
            most_redirections=0,
        ),
        Exercise(
            name="past-the-vessel",
            title="Past the vessel",
            goal="Reach the target behind the vessel without touching the vessel.",
            target=disc(0.55, 0.62, 0.035),
            vessels=[disc(0.54, 0.36, 0.07)],
        ),
    )
