"""The tables of a scenario that put lesions and vessels into the picture: [[body]], and exercises with ``imaged`` or ``echo``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from pydantic import Field, model_validator

from echospline.errors import InputError
from echospline.scenario.sections import (
    CircleSection,
    DiscSection,
    EchoKind,
    ExerciseSection,
    Kilopascals,
    Millimetres,
    Point,
    Section,
)
from echospline.scene import Circle, Polygon, Region, Shape, Sphere

if TYPE_CHECKING:  # the laboratory is loaded when a body is imaged
    from echospline.laboratory import Body, Round, Tube

Place = tuple[Millimetres, Millimetres, Millimetres]
TARGET: EchoKind = "hypoechoic"
VESSEL: EchoKind = "anechoic"
"""How an imaged target and an imaged vessel show where nothing else is said."""


class SphereSection(Section):
    """A ball in space."""

    centre: Place = Field(description="mm")
    radius: Millimetres = Field(gt=0, description="mm")


class TubeSection(Section):
    """A vessel: everything within a radius of a line."""

    start: Point | Place = Field(description="mm; may lie outside the picture")
    end: Point | Place = Field(description="mm; may lie outside the picture")
    radius: Millimetres = Field(gt=0, description="mm")


class BodySection(Section):
    """A lesion or vessel that is imaged; exactly one of circle, sphere, tube."""

    name: str = Field("", description="for reports")
    echo: EchoKind = Field(
        "hypoechoic",
        description="hypoechoic (a dark lesion), anechoic (a vessel) or hyperechoic (a bright lesion)",
    )
    contrast: float | None = Field(
        None,
        ge=-80,
        le=40,
        description="level against the tissue around it, dB, in place of the echo's usual one",
    )
    circle: CircleSection | None = None
    sphere: SphereSection | None = None
    tube: TubeSection | None = None
    young: Kilopascals | None = Field(
        None, gt=0, description="Young's modulus, kPa: the body is a region of the tissue too"
    )
    poisson: float = Field(0.45, ge=0, le=0.5, description="Poisson's ratio of that region")

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        given = [name for name in ("circle", "sphere", "tube") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                f"exactly one of circle, sphere, tube says where a body is; got {given or 'none'}"
            )
        return self

    def place(self) -> Round | Tube:
        """Return its shape, mm."""
        from echospline.laboratory import Round, Tube  # noqa: PLC0415

        if self.tube is not None:
            return Tube(self.tube.start, self.tube.end, self.tube.radius)
        disc = self.circle or self.sphere
        if disc is None:
            raise InputError("a [[body]] has exactly one of circle, sphere, tube")
        return Round(disc.centre, disc.radius)


def bodies_of(sections: Sequence[BodySection], exercises: Sequence[ExerciseSection]) -> list[Body]:
    """Return everything that the picture is to show: [[body]] in order, then imaged targets and vessels, each place once.

    Parameters
    ----------
    sections : sequence of BodySection
    exercises : sequence of ExerciseSection
        All of them: a picture has the targets of every exercise.
    """
    from echospline.laboratory import Body, Round  # noqa: PLC0415

    found = [Body.of(section.echo, section.place(), section.contrast) for section in sections]
    for disc, echo in _discs(exercises):
        body = Body.of(echo, Round(disc.centre, disc.radius))
        if body not in found:
            found.append(body)
    return found


def body_regions(sections: Sequence[BodySection], exercises: Sequence[ExerciseSection]) -> list[Region]:
    """Return the bodies that are stiffer or softer, as regions of the tissue."""
    regions = [
        Region(_region_shape(section), section.young, section.poisson, section.name)
        for section in sections
        if section.young is not None
    ]
    seen: list[tuple[tuple[float, ...], float]] = []
    for exercise in exercises:
        for disc in (exercise.target, *exercise.vessels):
            where = (tuple(disc.centre), disc.radius)
            if disc.young is not None and where not in seen:
                seen.append(where)
                regions.append(Region(_round(disc.centre, disc.radius), disc.young, 0.45, exercise.name))
    return regions


def _discs(exercises: Sequence[ExerciseSection]) -> list[tuple[DiscSection, EchoKind]]:
    """Return the discs of exercises that are imaged, with their echo."""
    found: list[tuple[DiscSection, EchoKind]] = []
    for exercise in exercises:
        if exercise.target.shown:
            found.append((exercise.target, exercise.target.echo or TARGET))
        found += [(vessel, vessel.echo or VESSEL) for vessel in exercise.vessels if vessel.shown]
    return found


def _round(centre: Sequence[float], radius: float) -> Shape:
    """Return a disc or a ball as a shape of the tissue."""
    if len(centre) == 2:
        return Circle((centre[0], centre[1]), radius)
    return Sphere((centre[0], centre[1], centre[2]), radius)


def _region_shape(section: BodySection) -> Shape:
    """Return a body's shape for the tissue; a tube in the plane is a strip, without its round ends.

    Raises
    ------
    InputError
        If it is a tube in space.
    """
    if section.tube is None:
        disc = section.circle or section.sphere
        if disc is None:
            raise InputError("a [[body]] has exactly one of circle, sphere, tube")
        return _round(disc.centre, disc.radius)
    start, end, r = section.tube.start, section.tube.end, section.tube.radius
    if len(start) != 2 or len(end) != 2:
        raise InputError(
            "a tube in space is imaged, but has the stiffness of the tissue around it: leave out its young, or make it a sphere"
        )
    (ax, ay), (bx, by) = start, end
    length = ((bx - ax) ** 2 + (by - ay) ** 2) ** 0.5
    nx, ny = -(by - ay) / length * r, (bx - ax) / length * r
    return Polygon(((ax + nx, ay + ny), (bx + nx, by + ny), (bx - nx, by - ny), (ax - nx, ay - ny)))
