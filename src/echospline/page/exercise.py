"""Exercises: a target in the tissue, perhaps vessels to avoid, and the criteria of success.

They are the ``[[exercise]]`` tables of a scenario; three are provided for any image, two for any volume.
"""

from __future__ import annotations

from collections.abc import Sequence

from echospline.errors import InputError
from echospline.scenario import DiscSection as Disc
from echospline.scenario import ExerciseSection as Exercise
from echospline.scene import RegularGrid

__all__ = ["Disc", "Exercise", "check_exercises", "default_exercises", "default_exercises_space"]

SLACK = 1e-9
"""mm, rounding."""


def check_exercises(exercises: Sequence[Exercise], low: Sequence[float], high: Sequence[float]) -> None:
    """Check names and positions of exercises against each other and the mesh.

    Parameters
    ----------
    exercises : sequence of Exercise
        Of one scene.
    low, high : sequence of float
        Corners of its mesh, mm: two numbers each in the plane, three in space.

    Raises
    ------
    InputError
        If two share a name, or a target, a vessel or an entry lies outside the mesh or has another number of coordinates.
    """
    names = [exercise.name for exercise in exercises]
    axes = " and ".join(f"{axis} from {a:g} to {b:g}" for axis, a, b in zip("xyz", low, high, strict=False))

    def outside(place: Sequence[float]) -> bool:
        return len(place) != len(low) or not all(
            a - SLACK <= v <= b + SLACK for a, v, b in zip(low, place, high, strict=True)
        )

    for exercise in exercises:
        if names.count(exercise.name) > 1:
            raise InputError(f"two exercises are called {exercise.name!r}; names must differ")
        if any(outside(place) for place in exercise.landmarks):
            raise InputError(
                f"exercise {exercise.name!r}: target and vessels must lie in the image, {axes} mm"
            )
        if exercise.entry_between is not None and len(low) == 3:
            raise InputError(
                f"exercise {exercise.name!r}: an entry is drawn by lot in the plane alone; in space give entry"
            )
        for entry in _entries(exercise, low):
            if outside(entry):
                came = ", ".join(f"{v:g}" for v in entry)
                raise InputError(
                    f"exercise {exercise.name!r}: the entry must lie in the image, {axes} mm; got {came}"
                )


def _entries(exercise: Exercise, low: Sequence[float]) -> list[Sequence[float]]:
    """Return the entries between which an exercise lets its needle begin, mm."""
    if exercise.entry is not None:
        return [exercise.entry]
    return [] if exercise.entry_between is None else [(x, low[1]) for x in exercise.entry_between]


def default_exercises_space(low: Sequence[float], high: Sequence[float]) -> tuple[Exercise, ...]:
    """Return two exercises that fit any volume: their places are fractions of its extent."""
    size = min(b - a for a, b in zip(low, high, strict=True))

    def ball(u: float, v: float, w: float, share: float) -> Disc:
        x, y, z = (a + part * (b - a) for a, b, part in zip(low, high, (u, v, w), strict=True))
        return Disc(centre=(x, y, z), radius=share * size)

    return (
        Exercise(
            name="in-space",
            title="Find and hit the target",
            goal="Find the target with the probe, keep the needle in the picture and bring the tip into the target.",
            target=ball(0.55, 0.45, 0.5, 0.06),
        ),
        Exercise(
            name="past-the-vessel-in-space",
            title="Past the vessel",
            goal="Reach the target behind the vessel without touching the vessel.",
            target=ball(0.5, 0.6, 0.55, 0.06),
            vessels=[ball(0.5, 0.35, 0.5, 0.09)],
        ),
    )


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
