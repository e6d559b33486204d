"""The tables of a scenario file: every key with its unit, range, default and meaning.

Numbers are in the project's units (mm, s, mm/s, degrees, N, kPa). A value may carry its unit as text ("25 mm");
another unit is refused.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from echospline.errors import InputError
from echospline.picture import OUTER_DIAMETER, NeedleEcho


def _in_unit(unit: str) -> BeforeValidator:
    def strip(value: object) -> object:
        if not isinstance(value, str):
            return value
        number, _, given = value.strip().partition(" ")
        try:
            plain = float(number)
        except ValueError:
            raise ValueError(f"expected a number in {unit}") from None
        if given.strip() not in ("", unit):
            raise ValueError(f"expected a number in {unit}, not in {given.strip()}")
        return plain

    return BeforeValidator(strip)


Millimetres = Annotated[float, _in_unit("mm")]
Seconds = Annotated[float, _in_unit("s")]
Degrees = Annotated[float, _in_unit("degrees")]
Speed = Annotated[float, _in_unit("mm/s")]
Rate = Annotated[float, _in_unit("1/s")]
Newtons = Annotated[float, _in_unit("N")]
Friction = Annotated[float, _in_unit("N s/mm^2")]
PerLength = Annotated[float, _in_unit("N/mm")]
PerArea = Annotated[float, _in_unit("N/mm^2")]
Kilopascals = Annotated[float, _in_unit("kPa")]
Point = tuple[Millimetres, Millimetres]
Place = Point | tuple[Millimetres, Millimetres, Millimetres]
"""Of the plane, or in space."""


class Section(BaseModel):
    """A table of the file: unknown keys are refused, infinite and NaN numbers too."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


class ImageSection(Section):
    """The tissue before the needle."""

    file: str = Field(
        "sample:calf",
        description="image, cine or DICOM file, sample:calf, which ships inside, or sample:phantom, made from [phantom]",
    )
    spacing: tuple[Annotated[Millimetres, Field(gt=0)], Annotated[Millimetres, Field(gt=0)]] | None = Field(
        None, description="mm per pixel (lateral, depth); only where the file does not say"
    )
    frame: int | None = Field(
        None,
        ge=0,
        description="frame of a cine or slice of a volume, from 0; the first good frame of a cine where not given",
    )
    region: tuple[int, int, int, int] | None = Field(
        None, description="pixels to keep (left, top, right, bottom), the last two just outside"
    )
    window: tuple[float, float] | None = Field(
        None,
        description="pixel values shown as black and white; where not given and needed, the file's own window, else the "
        "lowest and highest value of the picture",
    )

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        if self.window is not None and not self.window[0] < self.window[1]:
            raise ValueError(f"window = {list(self.window)}: expected two pixel values, low before high")
        return self


class LabelsSection(Section):
    """Cells of a labels image that make a region."""

    file: str = Field(description="picture of whole numbers, laid over the whole mesh")
    value: int = Field(description="the number that marks the region")


class CircleSection(Section):
    """A round region."""

    centre: Point = Field(description="mm")
    radius: Millimetres = Field(gt=0, description="mm")


class RegionSection(Section):
    """Part of the tissue that differs; exactly one of layer, circle, polygon, labels."""

    name: str = Field("", description="for reports")
    young: Kilopascals = Field(gt=0, description="Young's modulus, kPa")
    poisson: float = Field(0.45, ge=0, le=0.5, description="Poisson's ratio")
    layer: tuple[Millimetres, Millimetres] | None = Field(None, description="depths from, to, mm")
    circle: CircleSection | None = None
    polygon: list[Point] | None = Field(None, min_length=3, description="corners, mm")
    labels: LabelsSection | None = None


class TissueSection(Section):
    """Material of the tissue: used by fem and green, and by the elastic kernel for Poisson's ratio."""

    young: Kilopascals = Field(10.0, gt=0, description="Young's modulus of the background, kPa")
    poisson: float = Field(0.45, ge=0, le=0.5, description="Poisson's ratio of the background")
    thickness: Millimetres = Field(40.0, gt=0, description="across the imaging plane, mm")
    plane: Literal["stress", "strain"] = Field("stress", description="plane stress (19) or plane strain")
    material: Literal["linear", "neo-hookean"] = Field(
        "linear", description="linear elasticity, or neo-hookean for large deformation (fem alone, offline)"
    )
    region: list[RegionSection] = Field(
        default=[], description="layers, lesions; each on top of those before"
    )


class MeshSection(Section):
    """The mesh over the image and its clamped edges."""

    nodes: tuple[Annotated[int, Field(ge=2, le=4096)], Annotated[int, Field(ge=2, le=4096)]] = Field(
        (40, 30),
        description="nodes along x and y, corner to corner over the image",
        json_schema_extra={"between": "x"},  # as the command line takes it: 40x30
    )
    clamped: list[Literal["top", "bottom", "left", "right"]] = Field(
        ["left", "right", "bottom"], description="edges held fast; top is the probe's face"
    )
    sliding: list[Literal["top", "bottom", "left", "right"]] = Field(
        ["top"],
        description="edges that move along themselves alone: the skin under the probe; any other edge is free",
    )
    clamped_points: list[Point] = Field(default=[], description="further points held fast, mm")

    @model_validator(mode="before")
    @classmethod
    def _clamped_top_does_not_slide(cls, given: Any) -> Any:
        """Let a clamped edge not slide, where nothing is said of sliding edges."""
        if (
            isinstance(given, dict)
            and "sliding" not in given
            and isinstance(given.get("clamped"), list | tuple)
        ):
            return {**given, "sliding": [edge for edge in ("top",) if edge not in given["clamped"]]}
        return given


def _look(name: str, description: str) -> Any:
    """Return a key whose default and range the core has."""
    return Field(default_factory=lambda: getattr(NeedleEcho(), name), description=description)


class EchoSection(Section):
    """The needle's looks; levels are dB of power relative to white."""

    shaft: bool = Field(True, description="draw the line of the near wall")
    tip: bool = Field(True, description="draw tip and heel of the bevel")
    tail: bool = Field(True, description="draw the ring-down below a shaft across the beam")
    shadow: bool = Field(True, description="draw the shadow")
    apex: Point | None = Field(
        None, description="where the beams of a curved array cross, mm; a linear array where not given"
    )
    lateral: Millimetres = _look("lateral", "resolution across the beam: sigma, mm")
    axial: Millimetres = _look("axial", "resolution along the beam: sigma, mm")
    elevation: Millimetres = _look("elevation", "thickness of the slice at its focus: sigma, mm")
    elevation_depth: Millimetres = _look("elevation_depth", "depth of that focus, mm")
    element_height: Millimetres = _look("element_height", "height of the array across the plane, mm")
    f_number: float = _look("f_number", "depth over aperture: penumbra of the shadow")
    dynamic_range: float = _look("dynamic_range", "of the display, dB")
    specular: float = _look("specular", "level of a shaft at right angles to the beam, dB")
    lobe: Degrees = _look("lobe", "tilt at which that has fallen by 4.3 dB, degrees")
    lobe_elevation: Degrees = _look("lobe_elevation", "the same out of the plane, degrees")
    steering: Degrees = _look(
        "steering", "beams are compounded at 0 and plus and minus this, degrees; 0: none"
    )
    roughness: float = _look("roughness", "level of the grain at any tilt, dB")
    rolloff: float = _look("rolloff", "its loss from 50 to 90 degrees of tilt, dB")
    wobble: float = _look("wobble", "standard deviation of slow changes along the shaft, dB")
    patches: float = _look("patches", "standard deviation of the grain's level in patches of 1.5 mm, dB")
    bevel: float = _look("bevel", "level of the tip, dB")
    ring_down: float = _look("ring_down", "first level of the tail relative to the specular echo, dB")
    ring_down_loss: float = _look("ring_down_loss", "loss along the tail, dB/mm")
    opacity: float = _look("opacity", "share of a blocked ray that is lost, 0 to 1")
    seed: int = _look("seed", "of the grain, which is fixed to the needle")

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        try:
            self.looks(min(OUTER_DIAMETER))
        except InputError as error:
            raise ValueError(str(error)) from None
        return self

    def looks(self, gauge: int) -> NeedleEcho:
        """Return the looks of a needle of a gauge."""
        return NeedleEcho(gauge=gauge, **self.model_dump())


class NeedleSection(Section):
    """The needle and its path."""

    entry: Point = Field((10.0, 0.0), description="point of entry (x lateral, y depth), mm")
    angle: Degrees = Field(50.0, ge=-180, le=360, description="degrees: 0 towards +x, 90 straight down")
    depth: Millimetres = Field(28.0, gt=0, le=500, description="length inserted, mm")
    speed: Annotated[Speed, Field(gt=0, le=1000)] | list[tuple[Millimetres, Speed]] = Field(
        8.0, description="mm/s, or a profile [[to depth mm, mm/s], ...] whose last depth is the full depth"
    )
    dwell: Seconds = Field(1.5, ge=0, le=3600, description="rest at full depth, s")
    retract: bool = Field(True, description="pull the needle out again")
    retract_speed: Annotated[Speed, Field(gt=0, le=1000)] | None = Field(
        None, description="mm/s; the (last) insertion speed where not given"
    )
    path: list[tuple[Seconds, Millimetres, Millimetres, Millimetres, Millimetres]] | None = Field(
        None,
        min_length=2,
        description="in place of all of the above: rows of time, entry x, y, tip x, y (s, mm)",
    )
    gauge: int = Field(
        18, ge=min(OUTER_DIAMETER), le=max(OUTER_DIAMETER), description="gauge, sets the diameter"
    )
    echo: EchoSection = Field(default_factory=EchoSection)


class LandmarkSection(Section):
    """The interaction of tps and elastic: equations (12) to (17)."""

    sigma: Millimetres = Field(1.0, ge=0, le=50, description="push of the tip (12), mm")
    delta: Millimetres = Field(1.5, ge=0, le=50, description="reach of friction around the shaft (13), mm")
    alpha1: Seconds = Field(0.08, ge=-10, le=10, description="friction (15), s")
    alpha2: Seconds = Field(0.04, ge=-10, le=10, description="friction that falls with distance (15), s")
    alpha3: Rate = Field(1.0, ge=0, le=1e3, description="relaxation (16), 1/s")
    length: Millimetres = Field(1.0, gt=0, le=100, description="length inside the exponential of (15), mm")
    drag: float = Field(
        1.0, ge=0, le=1, description="sideways motion that tissue follows, 0 (paper) to 1 (bonded)"
    )
    tip: Literal["point", "node"] = Field("point", description="landmark at the tip, or nearest node (paper)")
    loading: Literal["stick", "follow", "immediate"] = Field(
        "stick",
        description="tissue sticks to the shaft and slips, or follows friction and relaxes at rest (paper's (16), (17)), or has it "
        "at once (paper)",
    )
    friction_speed: Speed = Field(
        10.0,
        ge=0,
        le=1e3,
        description="speed at which (15) says how far friction holds tissue that sticks, mm/s",
    )
    contact_spacing: Millimetres = Field(
        1.25, ge=0, le=50, description="between contacts, mm; 0 takes every node"
    )
    anchor_spacing: Annotated[Millimetres, Field(gt=0, le=50)] | None = Field(
        None,
        description="between anchors on held edges, mm; 1.5 where not given, 1 for elastic beside an edge that slides",
    )


class ElasticSection(Section):
    """The elastic kernel."""

    radius: Millimetres = Field(1.0, gt=0, le=50, description="regularisation length, mm")
    poisson: float | None = Field(
        None, ge=0, lt=0.5, description="Poisson's ratio; the tissue's where not given"
    )


class GreenSection(Section):
    """Green's function: how the tissue answers forces."""

    radius: Millimetres = Field(0.4, gt=0, le=50, description="length over which a force is spread, mm")
    method: Literal["auto", "boundary", "regions", "solve"] = Field(
        "auto",
        description="closed forms (homogeneous; layers and lesions), a live solve, or the first that is good",
    )


class ForceSection(Section):
    """The needle's forces for fem and green: a law that sticks and slips, or the paper's viscous one."""

    law: Literal["stick-slip", "viscous"] = Field(
        "stick-slip",
        description="stick-slip (sticks, slips, cuts) or viscous (paper), which reads tip, friction, alpha3 and ramp alone",
    )
    tip: Newtons = Field(0.4, ge=0, le=100, description="cutting force at the tip, N (paper)")
    friction_limit: PerLength = Field(
        0.01,
        ge=0,
        le=10,
        description="greatest friction per mm of shaft, N/mm; 0.005 to 0.02 are plausible (assumed)",
    )
    bond: PerArea = Field(
        0.1, gt=0, le=1e3, description="stiffness between shaft and tissue per mm, N/mm^2 (assumed)"
    )
    tip_stiffness: PerLength = Field(
        2.0, gt=0, le=1e3, description="stiffness of the tip's contact, N/mm (assumed)"
    )
    side_stiffness: PerArea = Field(
        1.0, gt=0, le=1e3, description="stiffness across the shaft per mm, N/mm^2 (assumed)"
    )
    viscosity: Friction = Field(
        0.0,
        ge=0,
        le=10,
        description="friction beyond its limit per mm and mm/s of slip, N s/mm^2; 5e-4 shows speed (assumed)",
    )
    station_spacing: Millimetres = Field(
        1.25, ge=0.05, le=50, description="between the points of the track that carry forces, mm"
    )
    substep: Millimetres = Field(
        0.25, ge=0.001, le=50, description="longest travel that is solved at once, mm"
    )
    dead_band: Millimetres = Field(
        0.0,
        ge=0,
        le=10,
        description="play in the depth to either side, mm; 0.15 suits a tracker with 0.05 mm of noise",
    )
    friction: Friction = Field(
        1e-3,
        ge=0,
        le=10,
        description="viscous: friction per mm of shaft and mm/s of speed, N s/mm^2 (paper: 1e-8)",
    )
    alpha3: Rate = Field(1.0, ge=0, le=1e3, description="viscous: relaxation (16), 1/s")
    ramp: Millimetres = Field(
        1.0, ge=0, le=100, description="viscous: travel over which forces build up, mm; 0 at once"
    )

    @model_validator(mode="before")
    @classmethod
    def _of_old_files(cls, given: Any) -> Any:
        """Numbers of the viscous law without a law: a file from before there were two."""
        if isinstance(given, dict) and "law" not in given and VISCOUS.intersection(given):
            return {**given, "law": "viscous"}
        return given


VISCOUS = frozenset({"friction", "alpha3", "ramp"})
"""Keys of [model.forces] that the viscous law alone reads."""


class ModelSection(Section):
    """The tissue model."""

    kind: Literal["tps", "elastic", "green", "fem"] = Field(
        "green", description="green, tps (paper), elastic or fem"
    )
    landmarks: LandmarkSection = Field(default_factory=LandmarkSection)
    elastic: ElasticSection = Field(default_factory=ElasticSection)
    green: GreenSection = Field(default_factory=GreenSection)
    forces: ForceSection = Field(default_factory=ForceSection)


class OutputSection(Section):
    """The files to write."""

    fps: float = Field(25.0, gt=0, le=1000, description="frames per second")
    longest_step: Seconds = Field(1 / 30, gt=0, le=10, description="longest time step of the model, s")
    formats: list[Literal["mp4", "gif", "png", "mha", "igs.mha", "seq.nrrd"]] = Field(
        ["mp4"], description="cines: mp4, gif, png, mha; with the needle's transforms: igs.mha, seq.nrrd"
    )
    displacement: bool = Field(True, description="write displacement.npz, the true motion")
    figure: bool = Field(True, description="write summary.png")
    needle: bool = Field(True, description="draw the needle's echo")
    border: Annotated[float, Field(ge=0)] | Literal["transparent"] = Field(
        0.0, description="value where no tissue comes to lie; transparent with the formats png and mha"
    )
    folding: Literal["flag", "refuse"] = Field("flag", description="what happens when the picture folds")
    inverse: Literal["auto", "exact"] = Field(
        "auto", description="origins of pixels: interpolated where good to 0.1 pixel, or each traced exactly"
    )
    image_model: Literal["warp", "rescatter"] = Field(
        "warp",
        description="warp the picture, or move scatterers as bright as it and image them anew ([probe])",
    )

    @model_validator(mode="after")
    def _holds_opacity(self) -> Self:
        if self.border != "transparent":
            return self
        from echospline.io import TRANSPARENT  # noqa: PLC0415  (a wrong key is said before readers are loaded)

        other = [name for name in self.formats if name not in TRANSPARENT]
        if other:
            raise ValueError(
                f"border = transparent cannot be written as {', '.join(other)}; formats with transparency are "
                f"{', '.join(TRANSPARENT)}: give --formats {TRANSPARENT[0]}"
            )
        return self


EchoKind = Literal["hypoechoic", "anechoic", "hyperechoic"]


class DiscSection(Section):
    """A round structure, in space a ball; it moves with the tissue."""

    centre: Place = Field(description="where it lies at rest (x lateral, y depth, in space z elevation), mm")
    radius: Millimetres = Field(gt=0, le=100, description="mm")
    imaged: bool = Field(
        False, description="the picture shows it as a scanner would: a target hypoechoic, a vessel anechoic"
    )
    echo: EchoKind | None = Field(
        None, description="imaged with this echo: hypoechoic, anechoic or hyperechoic"
    )
    young: Kilopascals | None = Field(
        None, gt=0, description="Young's modulus, kPa, where it is stiffer or softer than the tissue"
    )

    @property
    def shown(self) -> bool:
        """Whether the picture itself shows it."""
        return self.imaged or self.echo is not None


class ExerciseSection(Section):
    """An exercise of the live simulator."""

    name: str = Field(
        min_length=1, max_length=80, description="short and unique; sessions are listed under it"
    )
    title: str = Field(min_length=1, max_length=80, description="for the page")
    goal: str = Field("", max_length=400, description="one or two sentences for the page")
    target: DiscSection = Field(
        description="where the tip shall end; hit inside the radius of the deformed target"
    )
    vessels: list[DiscSection] = Field(default=[], max_length=20, description="what the needle may not touch")
    most_redirections: int | None = Field(None, ge=0, description="turns inside the tissue that are allowed")
    time_limit: Seconds = Field(
        120.0, gt=0, le=1800, description="the time left is counted down, and the recording ends with it, s"
    )
    help: bool = Field(
        True,
        description="rings, guide line and readouts may be shown; false: not while the exercise is recorded",
    )
    entry: Place | None = Field(
        None, description="the needle enters here, mm; where not given, the trainee chooses"
    )
    entry_between: tuple[Millimetres, Millimetres] | None = Field(
        None,
        description="the entry is drawn by lot between these lateral positions, mm, anew in every attempt",
    )
    attempts: int | None = Field(
        None, ge=1, le=1000, description="attempts that a trainee has; any number where not given"
    )

    @model_validator(mode="after")
    def _one_entry(self) -> Self:
        if self.entry is not None and self.entry_between is not None:
            raise ValueError("an entry is fixed (entry) or drawn by lot (entry_between), not both")
        if self.entry_between is not None and not self.entry_between[0] < self.entry_between[1]:
            raise ValueError(
                f"entry_between = {list(self.entry_between)}: expected two lateral positions in mm, the smaller one first"
            )
        return self

    @property
    def landmarks(self) -> list[Place]:
        """Centres of target and vessels at rest, mm: the points watched while the tissue moves."""
        return [self.target.centre, *(vessel.centre for vessel in self.vessels)]
