"""Command-line options that stand for keys of a scenario: flag, key and parser of the text.

The help text, range and default of every option come from the scenario's own tables, so that they are written once.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_type_hints

import typer
from typer.core import TyperCommand, TyperOption

from echospline import scenario as scenario_room
from echospline.errors import InputError

LOOKS: dict[str, Any] = {
    "add_completion": False,
    "rich_markup_mode": "markdown",
    "pretty_exceptions_enable": False,
}
"""Settings of every Typer application."""


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.split(",")]


def _nodes(text: str) -> list[int]:
    return [int(part) for part in text.lower().split("x")]


def integers(text: str) -> list[int]:
    """Read whole numbers separated by commas."""
    return [int(part) for part in text.split(",")]


def _words(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _edges(text: str) -> list[str]:
    return [] if text.strip() == "none" else _words(text)


def _probe(text: str) -> dict[str, Any]:
    numbers = _numbers(text)
    if len(numbers) not in (3, 6):
        raise ValueError
    turned = dict(zip(("yaw", "pitch", "roll"), numbers[3:], strict=False))
    return {"position": numbers[:3], "view": None, **turned}


def _border(text: str) -> float | str:
    return text if text == "transparent" else float(text)


@dataclass(frozen=True)
class Option:
    """One flag."""

    flag: str
    key: str
    metavar: str
    read: Callable[[str], Any] | None = None
    panel: str = "Needle"


def _landmark(name: str, metavar: str) -> Option:
    return Option(
        f"--{name.replace('_', '-')}", f"model.landmarks.{name}", metavar, None, "Model tps, elastic"
    )


OPTIONS = (
    Option("--spacing", "image.spacing", "LAT,DEPTH", _numbers, "Image"),
    Option("--frame", "image.frame", "N", int, "Image"),
    Option("--region", "image.region", "L,T,R,B", integers, "Image"),
    Option("--window", "image.window", "LOW,HIGH", _numbers, "Image"),
    Option("--mesh", "mesh.nodes", "NXxNY", _nodes, "Mesh"),
    Option("--clamped", "mesh.clamped", "EDGE,...|none", _edges, "Mesh"),
    Option("--sliding", "mesh.sliding", "EDGE,...|none", _edges, "Mesh"),
    Option("--sides", "mesh.sides", "clamped|sliding|free", None, "Mesh"),
    Option("--entry", "needle.entry", "X,Y", _numbers),
    Option("--angle", "needle.angle", "DEG"),
    Option("--depth", "needle.depth", "MM"),
    Option("--speed", "needle.speed", "MM_S"),
    Option("--dwell", "needle.dwell", "S"),
    Option("--retract/--no-retract", "needle.retract", ""),
    Option("--retract-speed", "needle.retract_speed", "MM_S"),
    Option("--gauge", "needle.gauge", "N", int),
    Option("--model", "model.kind", "NAME", None, "Model"),
    Option("--mechanics", "model.mechanics", "plane|space", None, "Model"),
    _landmark("sigma", "MM"),
    _landmark("delta", "MM"),
    _landmark("alpha1", "S"),
    _landmark("alpha2", "S"),
    _landmark("alpha3", "1/S"),
    _landmark("length", "MM"),
    _landmark("drag", "0..1"),
    _landmark("tip", "point|node"),
    _landmark("loading", "LAW"),
    _landmark("friction_speed", "MM_S"),
    _landmark("contact_spacing", "MM"),
    _landmark("anchor_spacing", "MM"),
    Option("--elastic-radius", "model.elastic.radius", "MM", None, "Model tps, elastic"),
    Option("--green-radius", "model.green.radius", "MM", None, "Model fem, green"),
    Option("--green-method", "model.green.method", "auto|boundary|regions|solve", None, "Model fem, green"),
    Option("--tip-force", "model.forces.tip", "N", None, "Model fem, green"),
    Option("--law", "model.forces.law", "LAW", None, "Model fem, green"),
    Option("--friction-limit", "model.forces.friction_limit", "N/MM", None, "Model fem, green"),
    Option("--bond", "model.forces.bond", "N/MM2", None, "Model fem, green"),
    Option("--tip-stiffness", "model.forces.tip_stiffness", "N/MM", None, "Model fem, green"),
    Option("--side-stiffness", "model.forces.side_stiffness", "N/MM2", None, "Model fem, green"),
    Option("--viscosity", "model.forces.viscosity", "NS/MM2", None, "Model fem, green"),
    Option("--station-spacing", "model.forces.station_spacing", "MM", None, "Model fem, green"),
    Option("--substep", "model.forces.substep", "MM", None, "Model fem, green"),
    Option("--dead-band", "model.forces.dead_band", "MM", None, "Model fem, green"),
    Option("--shaft-friction", "model.forces.friction", "NS/MM2", None, "Model fem, green"),
    Option("--ramp", "model.forces.ramp", "MM", None, "Model fem, green"),
    Option("--young", "tissue.young", "KPA", None, "Model fem, green"),
    Option("--poisson", "tissue.poisson", "NU", None, "Model fem, green"),
    Option("--material", "tissue.material", "linear|neo-hookean", None, "Model fem"),
    Option("--thickness", "tissue.thickness", "MM", None, "Model fem, green"),
    Option("--depth-axis", "space.depth_axis", "AXIS", None, "Space"),
    Option("--space-mesh", "space.mesh.nodes", "NXxNYxNZ", _nodes, "Space"),
    Option("--tissue", "space.tissue", "own|homogeneous", None, "Space"),
    Option("--view", "space.probe.view", "longitudinal|transverse", None, "Space"),
    Option("--probe", "space.probe", "X,Y,Z[,YAW,PITCH,ROLL]", _probe, "Space"),
    Option("--needle-entry", "space.needle.entry", "X,Y,Z", _numbers, "Space"),
    Option("--needle-direction", "space.needle.direction", "X,Y,Z", _numbers, "Space"),
    Option("--needle-depth", "space.needle.depth", "MM", None, "Space"),
    Option("--fps", "output.fps", "N", None, "Output"),
    Option("--formats", "output.formats", "NAME,...", _words, "Output"),
    Option("--border", "output.border", "VALUE", _border, "Output"),
    Option("--folding", "output.folding", "flag|refuse", None, "Output"),
    Option("--image-model", "output.image_model", "warp|rescatter", None, "Output"),
    Option("--needle/--no-needle", "output.needle", "", None, "Output"),
    Option("--figure/--no-figure", "output.figure", "", None, "Output"),
    Option("--displacement/--no-displacement", "output.displacement", "", None, "Output"),
)


def with_scenario_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a Typer command every option of `OPTIONS`; it receives those given as ``changes={"needle.depth": "20"}``."""
    hints = get_type_hints(command, include_extras=True)
    own = [
        p.replace(annotation=hints[p.name])
        for p in inspect.signature(command).parameters.values()
        if p.name != "changes"
    ]
    extra = [
        inspect.Parameter(
            _name(option),
            inspect.Parameter.KEYWORD_ONLY,
            annotation=bool | None if not option.metavar else str | None,
            default=typer.Option(
                None,
                option.flag,
                metavar=option.metavar or None,
                rich_help_panel=option.panel,
                show_default=False,
            ),
        )
        for option in OPTIONS
    ]

    def wrapped(**given: Any) -> None:
        changes = {o.key: v for o in OPTIONS if (v := given.pop(_name(o))) is not None}
        command(**given, changes=changes)

    named: Any = wrapped
    named.command_class = ScenarioCommand
    named.__name__, named.__doc__ = command.__name__, command.__doc__
    named.__signature__ = inspect.Signature([*own, *extra])
    named.__annotations__ = {p.name: p.annotation for p in (*own, *extra)}
    return wrapped


def say(sentences: Iterable[str], kind: Literal["doubt", "note"] = "doubt") -> None:
    """Print sentences on stderr, each once, one line each: doubts about the scale of a scene, or notes of the readers of its files."""
    for sentence in dict.fromkeys(sentences):
        print(f"echospline: {kind}: {sentence}", file=sys.stderr)


class ScenarioCommand(TyperCommand):
    """A command with options of a scenario, whose help is read from the scenario's tables when it is shown."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Describe the keys, then write the help."""
        keys = {_name(option): option.key for option in OPTIONS}
        for parameter in self.params:
            if isinstance(parameter, TyperOption) and parameter.help is None and parameter.name in keys:
                parameter.help = scenario_room.describe(keys[parameter.name])
        super().format_help(ctx, formatter)


def scenario_from(source: str, changes: dict[str, Any]) -> tuple[scenario_room.Scenario, Path]:
    """Read a scenario, or start one on an image, and apply the options given.

    Returns
    -------
    scenario : Scenario
    folder : Path
        Start of its relative paths.

    Raises
    ------
    InputError
        If the file or an option is invalid.
    """
    if source.lower().endswith(".toml"):
        scenario, folder = scenario_room.load(source), Path(source).resolve().parent
    else:
        scenario, folder = scenario_room.Scenario(), Path.cwd()
        changes = {"image.file": source, **changes}
    changes = _in_space(scenario, changes)
    try:
        return scenario.with_values(_flat({k: _read(k, v) for k, v in changes.items()}), "options"), folder
    except InputError as error:  # the message names the user's flag, not the key
        said = str(error)
        for key in sorted(changes, key=len, reverse=True):
            flags = {o.key: o.flag for o in OPTIONS}
            flag = flags.get(key, flags.get(key.removeprefix("space.")))
            if flag and said.startswith(f"options: {key}"):
                raise InputError(said.replace(f"options: {key}", flag)) from None
        raise InputError(said) from None


_SHARED = ("speed", "dwell", "retract", "retract_speed")
"""Keys of [needle] whose option means the same in space, for [space.needle]."""


def _in_space(scenario: scenario_room.Scenario, changes: dict[str, Any]) -> dict[str, Any]:
    """Give the options of how a needle moves to [space.needle] where the scene is one in space."""
    source = changes.get("image.file")
    named = source is not None and scenario_room.is_spatial(scenario.with_values({"image.file": source}))
    if not (named or scenario_room.is_spatial(scenario) or any(key.startswith("space.") for key in changes)):
        return changes
    return {
        (f"space.{k}" if k in [f"needle.{name}" for name in _SHARED] else k): v for k, v in changes.items()
    }


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    """Spread an option that stands for several keys of a table over them."""
    spread: dict[str, Any] = {}
    for key, value in values.items():
        spread |= (
            {f"{key}.{name}": v for name, v in value.items()} if isinstance(value, dict) else {key: value}
        )
    return spread


def _name(option: Option) -> str:
    return option.flag.split("/")[0].lstrip("-").replace("-", "_")


def _read(key: str, value: Any) -> Any:
    option = next((o for o in OPTIONS if o.key == key), None)
    if option is None or option.read is None or not isinstance(value, str):
        return value
    try:
        return option.read(value)
    except ValueError:
        raise InputError(
            f"{option.flag} expects {option.metavar} ({scenario_room.describe(key)}); got {value!r}"
        ) from None
