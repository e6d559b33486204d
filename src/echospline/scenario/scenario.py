"""A scenario: one commented TOML file that determines a run completely; read, validated and written with all defaults.

The tables and their keys are in `echospline.scenario.sections`.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator

from echospline.atomic import appearing
from echospline.errors import InputError
from echospline.picture import NeedleEcho
from echospline.scenario.body_section import BodySection, bodies_of, body_regions
from echospline.scenario.messages import describe as _describe
from echospline.scenario.messages import sentence, shown
from echospline.scenario.phantom_section import PhantomSection, ProbeSection
from echospline.scenario.scale import PHANTOM, size_doubts
from echospline.scenario.sections import (
    VISCOUS,
    ExerciseSection,
    ImageSection,
    MeshSection,
    ModelSection,
    NeedleSection,
    OutputSection,
    RegionSection,
    Section,
    TissueSection,
)
from echospline.scenario.space_section import SpaceSection
from echospline.scene import (
    Circle,
    Insertion,
    Label,
    Layer,
    Polygon,
    Region,
    RegularGrid,
    Shape,
    Tissue,
    UltrasoundImage,
)

FORMAT_1 = {
    "mesh.sliding": [],
    "model.kind": "tps",
    "model.landmarks.loading": "follow",
    "model.forces.law": "viscous",
}
"""What a file of format 1 means where it does not say."""
LARGEST_FILE = 1_000_000
"""Bytes; a scenario is a page of text."""


class Scenario(Section):
    """Complete description of one run.

    Read one with `load`, change it with `with_values`, write it with `save`.
    """

    format: Literal[2] = Field(2, description="version of this file's meaning; 1 is read as it was meant")
    title: str = Field("", description="one line for reports")
    image: ImageSection = Field(default_factory=ImageSection)
    tissue: TissueSection = Field(default_factory=TissueSection)
    mesh: MeshSection = Field(default_factory=MeshSection)
    needle: NeedleSection = Field(default_factory=NeedleSection)
    model: ModelSection = Field(default_factory=ModelSection)
    output: OutputSection = Field(default_factory=OutputSection)
    probe: ProbeSection = Field(default_factory=ProbeSection)
    phantom: PhantomSection = Field(default_factory=PhantomSection)
    space: SpaceSection | None = Field(None, description="a scene in space: the image is a volume")
    body: list[BodySection] = Field(
        default=[], description="lesions and vessels that the picture shows, each on top of those before"
    )
    exercise: list[ExerciseSection] = Field(default=[], description="what can be trained live")

    @model_validator(mode="before")
    @classmethod
    def _of_format_1(cls, given: Any) -> Any:
        """Fill in what a file of format 1 meant where it said nothing: a free top, landmarks that relax, viscous friction, the spline."""
        if not isinstance(given, Mapping) or given.get("format") != 1:
            return given
        tree = {**given, "format": 2}
        for key, meant in FORMAT_1.items():
            *tables, last = key.split(".")
            table = tree
            for name in tables:
                inner = table.get(name, {})
                if not isinstance(inner, Mapping):
                    return tree  # not a table: the fault is said by the fields
                table[name] = table = dict(inner)
            table.setdefault(last, meant)
        return tree

    def with_values(self, values: Mapping[str, Any], origin: str = "scenario") -> Scenario:
        """Return a copy with some keys changed, ``{"needle.depth": 20}``, validated.

        Raises
        ------
        InputError
            If a key is unknown or a value invalid.
        """
        tree = self.model_dump(mode="json", exclude_unset=False)
        for key, value in values.items():
            *tables, last = key.split(".")
            table = tree
            for name in tables:
                if table.get(name) is None:  # a table that is not there yet: [space]
                    table[name] = {}
                table = table[name]
            table[last] = value
        mesh = tree["mesh"]
        if (
            "mesh.clamped" in values
            and "mesh.sliding" not in values
            and isinstance(mesh["clamped"], list | tuple)
        ):
            mesh["sliding"] = [edge for edge in mesh["sliding"] if edge not in mesh["clamped"]]  # clamped now
        old = [key for key in values if key.startswith("model.forces.") and key.split(".")[-1] in VISCOUS]
        if old and tree["model"]["forces"]["law"] == "stick-slip":
            raise InputError(
                f'{old[0]} belongs to the viscous law of forces; this scenario\'s model.forces.law is "stick-slip": set it to '
                '"viscous" too, or set friction_limit'
            )
        return validated(tree, origin)

    def read_image(self, folder: Path) -> UltrasoundImage:
        """Read the image; a relative path starts at ``folder``; sample:phantom is [phantom] at rest."""
        return self.opened(folder)[1]

    def opened(self, folder: Path, *, eight_bit: bool | None = False) -> tuple[Scenario, UltrasoundImage]:
        """Read the image, and write the choices that its file left open into the scenario: frame and window.

        Parameters
        ----------
        folder : Path
            Start of relative paths.
        eight_bit : bool, optional
            Whether pixels of other types need a window; None where the formats decide. The window chosen is the file's
            own (DICOM, NIfTI), else the lowest and highest value of the picture, which loses no contrast to the ends.

        Returns
        -------
        scenario : Scenario
            Running it again gives the same image.
        image : UltrasoundImage
            Its notes are the reader's and those of the window.

        Raises
        ------
        InputError
            If the file cannot be read, is a volume and no slice is named, or has a size that no ultrasound picture has, or
            a body cannot be imaged into it.
        """
        bodies = bodies_of(self.body, self.exercise) if self.has_bodies else []
        scenario, image = self._recorded(folder, eight_bit=True if bodies else eight_bit)
        if bodies:
            from echospline.laboratory import imaged  # noqa: PLC0415  (as below)

            image = imaged(
                image,
                bodies,
                display=self.phantom.display(),
                apex=self.needle.echo.apex,
                seed=self.phantom.seed,
            )
        return scenario, image

    @property
    def has_bodies(self) -> bool:
        """Whether the picture is to show lesions or vessels that were not recorded."""
        return bool(self.body) or any(
            disc.shown for exercise in self.exercise for disc in (exercise.target, *exercise.vessels)
        )

    def _recorded(self, folder: Path, *, eight_bit: bool | None) -> tuple[Scenario, UltrasoundImage]:
        """Read the picture as it was recorded."""
        section = self.image
        if section.file == PHANTOM:
            image = self.phantom.still(self.probe.probe())
            return self, image if section.window is None else image.windowed(*section.window)
        if not section.file.strip():
            raise InputError("image.file is empty; expected an image, a cine or sample:calf")
        from echospline.io import choose_image, needs_window  # noqa: PLC0415  (a wrong key is said before readers are loaded)

        name = section.file if section.file.startswith("sample:") else str(folder / section.file)
        image, frame, asked = choose_image(
            name, spacing=section.spacing, frame=section.frame, region=section.region
        )
        size_doubts(image.grid)  # refuses what no scene can be, before anything is made of it
        if eight_bit is None:
            clear = self.output.border == "transparent"
            eight_bit = needs_window(self.output.formats, image.pixels.dtype, transparent=clear)
        window = section.window
        if window is None and eight_bit and image.pixels.dtype != np.uint8:
            window = asked or _span(image)
        if window is not None:
            image = image.windowed(*window)
        chosen = section.model_copy(
            update={"window": window, "frame": frame if frame or section.frame is not None else None}
        )
        return self.model_copy(update={"image": chosen}), image

    def label_notes(self, folder: Path) -> list[str]:
        """List the notes of the readers on the labels images of the tissue."""
        from echospline.io import open_recording  # noqa: PLC0415  (as above)

        files = dict.fromkeys(r.labels.file for r in self.tissue.region if r.labels is not None)
        return [f"{file}: {note}" for file in files for note in open_recording(folder / file).notes]

    def grid(self, image: UltrasoundImage) -> RegularGrid:
        """Lay the mesh over the image."""
        return RegularGrid.covering(image.grid, self.mesh.nodes)

    def insertion(self) -> Insertion:
        """Return the needle's path.

        Raises
        ------
        InputError
            If the speed profile does not ascend to the full depth, or the path's times do not ascend.
        """
        n = self.needle
        if n.path is not None:
            rows = np.array(n.path)
            return Insertion(rows[:, 0], rows[:, 1:3], rows[:, 3:5])
        if isinstance(n.speed, float):
            return Insertion.straight(
                n.entry,
                n.angle,
                n.depth,
                n.speed,
                dwell=n.dwell,
                retract=n.retract,
                retract_speed=n.retract_speed,
            )
        return _profiled(n, n.speed)

    def needle_echo(self) -> NeedleEcho | None:
        """Return the needle's looks, or None where it is not drawn."""
        return self.needle.echo.looks(self.needle.gauge) if self.output.needle else None

    def make_tissue(self, folder: Path, mesh: RegularGrid) -> Tissue:
        """Build the tissue with its regions; a labels image is laid over the whole mesh."""
        t = self.tissue
        regions = [
            Region(_shape(r, folder, mesh, f"tissue.region[{i}]"), r.young, r.poisson, r.name)
            for i, r in enumerate(t.region)
        ]
        regions += body_regions(self.body, self.exercise)
        return Tissue(t.young, t.poisson, regions, t.thickness, t.plane)

    def save(self, path: Path, folder: Path) -> None:
        """Write the scenario with a comment for every key; relative paths in ``folder`` stay valid from ``path``."""
        import tomlkit  # noqa: PLC0415  (only runs are written; many scenarios are only read)

        document = tomlkit.document()
        document.add(
            tomlkit.comment("echospline scenario: run it with  echospline simulate THIS_FILE --out DIR")
        )
        moved = self
        if not self.image.file.startswith("sample:"):
            image = os.path.relpath((folder / self.image.file).resolve(), path.parent.resolve())
            moved = self.model_copy(update={"image": self.image.model_copy(update={"file": image})})
        _write_section(tomlkit, document, moved)
        with appearing(path) as part:
            part.write_text(tomlkit.dumps(document), encoding="utf-8")


def load(path: str | Path) -> Scenario:
    """Read and validate a scenario file.

    Raises
    ------
    InputError
        With the key, the value and the expectation.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise InputError(f"{path} has {size} bytes; a scenario is a TOML file of at most {LARGEST_FILE}")
        text = path.read_text(encoding="utf-8-sig")  # some editors begin a file with a byte-order mark
        tree = tomllib.loads(text)
    except OSError as error:
        raise InputError(f"cannot read the scenario {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not a TOML file: {error}") from error
    return validated(tree, str(path))


def validated(tree: Mapping[str, Any], origin: str) -> Scenario:
    """Check a tree of tables and values.

    Raises
    ------
    InputError
        One sentence on the first fault, and the number of others.
    """
    try:
        return Scenario.model_validate(tree)
    except ValidationError as error:
        faults = error.errors(include_url=False)
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        raise InputError(f"{origin}: {sentence(Scenario, faults[0])}{more}") from None


def describe(key: str) -> str:
    """Describe a key with its range and default: ``describe("needle.depth")``."""
    return _describe(Scenario, key)


def _profiled(n: NeedleSection, profile: Sequence[tuple[float, float]]) -> Insertion:
    """Turn a speed profile into keyframes."""
    depths = np.array([0.0, *(row[0] for row in profile)])
    speeds = np.array([row[1] for row in profile])
    if not profile or (np.diff(depths) <= 0).any() or (speeds <= 0).any() or abs(depths[-1] - n.depth) > 1e-9:
        raise InputError(
            f"needle.speed = {shown(list(profile))}: a profile needs ascending depths that end at the full depth "
            f"{n.depth:g} mm, and positive speeds in mm/s"
        )
    times = np.concatenate([[0.0], np.cumsum(np.diff(depths) / speeds)])
    axis = np.array([np.cos(np.radians(n.angle)), np.sin(np.radians(n.angle))])
    if n.dwell > 0:
        times, depths = np.append(times, times[-1] + n.dwell), np.append(depths, depths[-1])
    if n.retract:
        back = n.retract_speed or float(speeds[-1])
        times, depths = np.append(times, times[-1] + depths[-1] / back), np.append(depths, 0.0)
    entry = np.array(n.entry)
    return Insertion(times, entry, entry + depths[:, None] * axis)


def _span(image: UltrasoundImage) -> tuple[float, float]:
    """Return the lowest and highest value of a picture, for a window that cuts nothing."""
    values = image.pixels[np.isfinite(image.pixels)]
    if values.size == 0:
        raise InputError("a picture holds no value that is finite")
    low, high = float(values.min()), float(values.max())
    return low, high if high > low else low + 1.0


def _shape(region: RegionSection, folder: Path, mesh: RegularGrid, key: str) -> Shape:
    given = [name for name in ("layer", "circle", "polygon", "labels") if getattr(region, name) is not None]
    if len(given) != 1:
        raise InputError(
            f"{key}: exactly one of layer, circle, polygon, labels says where it is; got {given or 'none'}"
        )
    if region.layer is not None:
        return Layer(*region.layer)
    if region.circle is not None:
        return Circle(region.circle.centre, region.circle.radius)
    if region.polygon is not None:
        return Polygon(tuple(region.polygon))
    if region.labels is None:
        raise InputError(f"{key} says nothing of where it is")
    from echospline.io import read_image  # noqa: PLC0415  (as above)

    path = folder / region.labels.file
    labels = read_image(str(path), spacing=(1.0, 1.0)).pixels
    if labels.ndim != 2 or not np.issubdtype(labels.dtype, np.integer):
        raise InputError(f"{key}.labels.file = {path}: expected a grey picture of whole numbers")
    shape = (labels.shape[1], labels.shape[0])
    return Label(labels.astype(np.int64), RegularGrid.covering(mesh, shape), region.labels.value)


def _write_section(toml: Any, table: Any, section: BaseModel) -> None:
    """Add every key of a section with its description as a comment; sections inside come after plain keys."""
    inner: list[tuple[str, Any]] = []
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if value is None:
            continue
        if isinstance(value, BaseModel) or (
            isinstance(value, list) and value and isinstance(value[0], BaseModel)
        ):
            inner.append((name, value))
        else:
            item = toml.item(_as_toml(value))
            if field.description:
                item.comment(field.description)
            table.add(name, item)
    for name, value in inner:
        if isinstance(value, BaseModel):
            sub = toml.table()
            _write_section(toml, sub, value)
            table.add(toml.nl())
            table.add(name, sub)
        else:
            rows = toml.aot()
            for row in value:
                sub = toml.table()
                _write_section(toml, sub, row)
                rows.append(sub)
            table.add(name, rows)


def _as_toml(value: Any) -> Any:
    return [_as_toml(v) for v in value] if isinstance(value, tuple | list) else value
