"""The table of a scenario in space: [space], with its probe, needle and mesh; the image is a volume."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from echospline.errors import InputError
from echospline.scenario.sections import Degrees, Millimetres, Seconds, Section, Speed
from echospline.scene import (
    ImagingPlane,
    PlanePath,
    Probe,
    SpatialGrid,
    SpatialInsertion,
    Volume,
    probe_plane,
)

Place = tuple[Millimetres, Millimetres, Millimetres]
Face = Literal["top", "bottom", "left", "right", "front", "back"]


class SpaceMeshSection(Section):
    """The mesh over the volume and what holds its faces."""

    nodes: tuple[
        Annotated[int, Field(ge=2, le=257)],
        Annotated[int, Field(ge=2, le=257)],
        Annotated[int, Field(ge=2, le=257)],
    ] = Field(
        (21, 17, 15),
        description="nodes along x, y and z, corner to corner over the volume",
        json_schema_extra={"between": "x"},  # as the command line takes it
    )
    clamped: list[Face] = Field(
        ["left", "right", "bottom", "front", "back"], description="faces held fast; top is the skin"
    )
    sliding: list[Face] = Field(
        ["top"], description="faces that move along themselves alone; any other is free"
    )


class SpaceProbeSection(Section):
    """The probe: the shape of its picture, the thickness of its slice, and where a hand holds it."""

    shape: Literal["linear", "curved"] = Field("linear", description="a rectangle, or a sector")
    width: Millimetres = Field(40.0, ge=1, le=500, description="of a linear array's face, mm")
    radius: Millimetres = Field(60.0, ge=1, le=500, description="of a curved array's face, mm")
    opening: Degrees = Field(60.0, ge=1, le=179, description="of a curved array's sector, degrees")
    depth: Millimetres = Field(40.0, ge=1, le=500, description="of the picture, mm")
    pixel: Millimetres = Field(0.12, ge=0.005, le=10, description="size of a pixel, mm")
    elevation: Millimetres = Field(
        0.75,
        ge=0,
        le=100,
        description="half-thickness of the slice at its focus: sigma, mm; 0: infinitely thin",
    )
    elevation_depth: Millimetres = Field(18.0, ge=0.1, le=1000, description="depth of that focus, mm")
    element_height: Millimetres = Field(5.0, ge=0, le=200, description="of the array across the slice, mm")
    view: Literal["longitudinal", "transverse"] | None = Field(
        None,
        description="along the needle, or across it at its deepest point, in place of position and angles",
    )
    position: Place = Field((0.0, 0.0, 0.0), description="middle of the probe's face (x, y, z), mm")
    yaw: Degrees = Field(
        0.0, ge=-360, le=360, description="turns it about its beam: 90 is transverse, degrees"
    )
    pitch: Degrees = Field(0.0, ge=-89, le=89, description="tilts (fans) it about its lateral axis, degrees")
    roll: Degrees = Field(0.0, ge=-89, le=89, description="rocks it in its own plane, degrees")
    path: list[tuple[Seconds, Millimetres, Millimetres, Millimetres, Degrees, Degrees, Degrees]] | None = (
        Field(
            None,
            min_length=2,
            description="rows of time, x, y, z, yaw, pitch, roll (s, mm, degrees) in place of one position",
        )
    )

    def probe(self) -> Probe:
        """Return the shape of the picture."""
        return Probe(
            self.shape, self.width, self.radius, self.opening, self.depth, self.pixel,
            self.elevation, self.elevation_depth, self.element_height,
        )  # fmt: skip

    def planes(self, insertion: SpatialInsertion) -> PlanePath:
        """Return where the probe is, times from the start of the insertion.

        Raises
        ------
        InputError
            If the path's times do not ascend, or a view is asked for of a needle that goes straight down.
        """
        if self.path is not None:
            rows = np.array(self.path)
            return PlanePath(rows[:, 0], tuple(probe_plane(r[1:4], *r[4:7]) for r in rows))
        if self.view is not None:
            return PlanePath.still(view_of(insertion, self.view))
        return PlanePath.still(probe_plane(self.position, self.yaw, self.pitch, self.roll))


class SpaceNeedleSection(Section):
    """The needle and its path in space."""

    entry: Place = Field((-14.0, 0.0, 0.0), description="point of entry (x, y, z), mm")
    direction: tuple[float, float, float] = Field(
        (1.0, 1.0, 0.0),
        description="of the axis (x, y, z); any length: (1, 1, 0) is 45 degrees in the plane z = 0",
    )
    depth: Millimetres = Field(28.0, gt=0, le=500, description="length inserted, mm")
    speed: Annotated[Speed, Field(gt=0, le=1000)] = Field(8.0, description="mm/s")
    dwell: Seconds = Field(1.0, ge=0, le=3600, description="rest at full depth, s")
    retract: bool = Field(True, description="pull the needle out again")
    retract_speed: Annotated[Speed, Field(gt=0, le=1000)] | None = Field(
        None, description="mm/s; the insertion speed where not given"
    )
    path: (
        list[tuple[Seconds, Millimetres, Millimetres, Millimetres, Millimetres, Millimetres, Millimetres]]
        | None
    ) = Field(
        None,
        min_length=2,
        description="in place of all of the above: rows of time, entry x, y, z, tip x, y, z (s, mm)",
    )

    def insertion(self) -> SpatialInsertion:
        """Return the path.

        Raises
        ------
        InputError
            If the path's times do not ascend, or the direction has no length.
        """
        if self.path is not None:
            rows = np.array(self.path)
            return SpatialInsertion(rows[:, 0], rows[:, 1:4], rows[:, 4:7])
        return SpatialInsertion.straight(
            self.entry, self.direction, self.depth, self.speed,
            dwell=self.dwell, retract=self.retract, retract_speed=self.retract_speed,
        )  # fmt: skip


class SpaceSection(Section):
    """A scene in space: the image is a volume, needle and probe are poses."""

    depth_axis: Literal["x", "-x", "y", "-y", "z", "-z"] | None = Field(
        None, description="the volume's axis along which depth grows; y where neither file nor sample says"
    )
    window: tuple[float, float] | None = Field(
        None, description="values shown as black and white; from least to greatest where voxels need one"
    )
    tissue: Literal["own", "homogeneous"] | None = Field(
        None,
        description="own: the modulus of every tissue, where the volume knows it (sample:kidney); homogeneous: tissue.young and the layers of "
        "tissue.region; where not given, own unless the scenario says a modulus or a layer",
    )
    mesh: SpaceMeshSection = Field(default_factory=SpaceMeshSection)
    probe: SpaceProbeSection = Field(
        default_factory=SpaceProbeSection,
        description="middle of the probe's face, mm, and how it is turned, degrees",
    )
    needle: SpaceNeedleSection = Field(default_factory=SpaceNeedleSection)

    @model_validator(mode="after")
    def _faces_are_one_thing(self) -> Self:
        both = sorted(set(self.mesh.clamped) & set(self.mesh.sliding))
        if both:
            raise ValueError(f"the {both[0]} face is said to be both clamped and sliding")
        return self

    def grid(self, volume: Volume) -> SpatialGrid:
        """Lay the mesh over the volume, corner to corner."""
        return volume.mesh(self.mesh.nodes)


def view_of(insertion: SpatialInsertion, view: Literal["longitudinal", "transverse"]) -> ImagingPlane:
    """Place the probe over a needle at its deepest: along it, or across it through the tip.

    The probe's face lies on the skin (y = 0) above the middle of the needle's way, or above the tip.

    Raises
    ------
    InputError
        If the needle goes straight down, so that it has no direction along the skin: give position and angles.
    """
    lengths = np.linalg.norm(insertion.tip - insertion.entry, axis=1)
    k = int(lengths.argmax())
    entry, tip = insertion.entry[k], insertion.tip[k]
    along = (tip - entry) * [1.0, 0.0, 1.0]
    if np.linalg.norm(along) < 1e-6:
        raise InputError(
            "a needle that goes straight down has no direction along the skin: give the probe's position, yaw, pitch and roll "
            "in place of a view"
        )
    # yaw turns x towards -z about y: the picture's lateral axis is (cos yaw, 0, -sin yaw)
    yaw = float(np.degrees(np.arctan2(-along[2], along[0])))
    middle = (entry + tip) / 2 if view == "longitudinal" else tip
    return probe_plane((middle[0], 0.0, middle[2]), yaw if view == "longitudinal" else yaw + 90.0)
