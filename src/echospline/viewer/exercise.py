"""Exercises: a target in the tissue, perhaps vessels to avoid, and what counts as done."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from echospline.errors import InputError
from echospline.grid import Floats, RegularGrid

Point = tuple[float, float]


class Disc(BaseModel):
    """A round structure in the imaging plane; it moves with the tissue.

    Parameters
    ----------
    centre : (x, y)
        At rest, mm.
    radius : float
        mm, positive.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    centre: Point
    radius: float = Field(gt=0, le=100)

    @field_validator("centre")
    @classmethod
    def _finite(cls, value: Point) -> Point:
        if not all(isfinite(c) for c in value):
            raise ValueError("must be two finite numbers in mm")
        return value


class Exercise(BaseModel):
    """What a trainee shall do.

    Parameters
    ----------
    name : str
        Short and unique; sessions are listed under it.
    title, goal : str
        For the page.
    target : Disc
        Where the tip shall end; hit when it lies within the radius of the *deformed* target.
    vessels : tuple of Disc
        The needle may not touch them.
    most_redirections : int, optional
        More of them fail the exercise.
    time_limit : float
        s; the recording ends there by itself.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(min_length=1, max_length=80)
    title: str = Field(min_length=1, max_length=80)
    goal: str = Field(default="", max_length=400)
    target: Disc
    vessels: tuple[Disc, ...] = Field(default=(), max_length=20)
    most_redirections: int | None = Field(default=None, ge=0)
    time_limit: float = Field(default=120.0, gt=0, le=1800)

    @property
    def landmarks(self) -> Floats:
        """Centres of target and vessels at rest, shape (1 + vessels, 2), mm: what the engine watches."""
        return np.array([self.target.centre, *(vessel.centre for vessel in self.vessels)])


def read_exercises(path: Path) -> tuple[Exercise, ...]:
    """Read the ``[[exercise]]`` tables of a TOML file (a scenario, for one); none is an empty tuple.

    Raises
    ------
    InputError
        If the file is no TOML or a table is not an exercise.
    """
    try:
        with path.open("rb") as file:
            content = tomllib.load(file)
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read exercises from {path}: {error}") from error
    return parse_exercises(content.get("exercise", []), str(path))


def parse_exercises(tables: Iterable[Any], source: str) -> tuple[Exercise, ...]:
    """Check exercise tables; ``source`` is where they come from, for the message."""
    exercises: list[Exercise] = []
    if not isinstance(tables, list | tuple):
        raise InputError(f"{source}: exercises are written as [[exercise]] tables")
    for number, table in enumerate(tables, 1):
        try:
            exercises.append(Exercise.model_validate(table))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise InputError(f"{source}: exercise {number}: {where}: {first['msg']}") from error
    names = [exercise.name for exercise in exercises]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{source}: two exercises are called {name!r}; names must differ")
    return tuple(exercises)


def check_inside(exercises: Iterable[Exercise], grid: RegularGrid) -> None:
    """Refuse exercises whose target or vessels lie outside the mesh."""
    for exercise in exercises:
        if not grid.contains(exercise.landmarks).all():
            x0, x1, y0, y1 = grid.extent
            raise InputError(
                f"exercise {exercise.name!r}: target and vessels must lie in the image, "
                f"x from {x0:g} to {x1:g} and y from {y0:g} to {y1:g} mm"
            )


def default_exercises(grid: RegularGrid) -> tuple[Exercise, ...]:
    """Three exercises that fit any image: their places are fractions of its extent."""
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
            vessels=(disc(0.54, 0.36, 0.07),),
        ),
    )
