"""``echospline link``: a tracker or 3D Slicer drives the needle over OpenIGTLink and gets the deforming image back."""

from __future__ import annotations

import logging
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from echospline.errors import InputError
from echospline.grid import RegularGrid
from echospline.image import UltrasoundImage
from echospline.live import LiveEngine
from echospline.models import MODELS, build_model
from echospline.needle import NeedlePose
from echospline.openigtlink.link import PORT
from echospline.openigtlink.picture import Looks
from echospline.openigtlink.plus import read_calibration
from echospline.openigtlink.scene import Reach
from echospline.openigtlink.session import Rates, Session, SessionOptions, Stage
from echospline.openigtlink.tracking import Naming
from echospline.scenario import Scenario, load, validated

AXES = {"x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0), "z": (0, 0, 1), "-z": (0, 0, -1)}
ORIENTATIONS = ("MF", "UF", "MN", "UN")


def link(
    source: Annotated[
        str,
        typer.Argument(
            metavar="[IMAGE_OR_SCENARIO]", help="Image, cine or DICOM file, or a scenario (.toml)."
        ),
    ] = "sample:calf",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes any free one.")
    ] = PORT,
    host: Annotated[
        str,
        typer.Option(
            help="Address to listen on. OpenIGTLink knows no password: open it to trusted networks only."
        ),
    ] = "127.0.0.1",
    connect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="HOST:PORT", help="Connect to a server as well (PLUS, a tracker); may be repeated."
        ),
    ] = None,
    serve: Annotated[bool, typer.Option(help="Listen for peers; without, only connect.")] = True,
    spacing: Annotated[
        str | None,
        typer.Option(metavar="LATERAL,DEPTH", help="mm per pixel, where the image file does not say."),
    ] = None,
    orientation: Annotated[
        str,
        typer.Option(
            help="Which way the picture lies in its file, in PLUS' letters: columns grow to the Marked or Unmarked side, "
            "rows to the Far or Near end. It is turned to MF."
        ),
    ] = "MF",
    model: Annotated[str | None, typer.Option(help=f"Tissue model: {', '.join(MODELS)}.")] = None,
    needle: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FRAME", help="Frame at the needle's tip; may be repeated. Default: NeedleTip, StylusTip."
        ),
    ] = None,
    axis: Annotated[
        str, typer.Option(help="Direction of insertion in that frame: x, -x, y, -y, z, -z.")
    ] = "z",
    reference: Annotated[
        str, typer.Option(metavar="FRAME", help="Frame that everything is told in.")
    ] = "Reference",
    image_name: Annotated[
        str, typer.Option(metavar="NAME", help="Device name and frame of the image.")
    ] = "Image",
    embed: Annotated[
        bool,
        typer.Option(
            help="Send the image with its place in the reference frame; without, send ImageToReference beside it."
        ),
    ] = True,
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.xml", help="PLUS device set file: its CoordinateDefinitions are the calibration."
        ),
    ] = None,
    beam: Annotated[
        float, typer.Option(metavar="MM", help="Thickness of the beam (FWHM): the needle fades beyond.")
    ] = 4.0,
    contact: Annotated[
        float,
        typer.Option(metavar="MM", help="Distance from the plane beyond which the needle moves no tissue."),
    ] = 10.0,
    target: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="Point in mm that is followed and sent as POINT; may be repeated."),
    ] = None,
    fps: Annotated[float, typer.Option(help="Images per second, at most 1000.")] = 30.0,
    mesh_rate: Annotated[
        float, typer.Option(help="Displaced meshes (POLYDATA) per second; 0 for none.")
    ] = 5.0,
    rate: Annotated[float, typer.Option(help="Steps of the tissue per second.")] = 120.0,
    scenarios: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Scenarios that peers may load by name; without, none."),
    ] = None,
    duration: Annotated[
        float, typer.Option(min=0, help="Seconds after which to end; 0 runs until Ctrl-C.")
    ] = 0.0,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing but warnings.")] = False,
) -> None:
    """Join the network of 3D Slicer and PLUS: transforms move the needle, the deforming image comes back."""
    logging.basicConfig(
        level=logging.WARNING if quiet else logging.INFO, format="%(message)s", stream=sys.stderr, force=True
    )
    naming = Naming(
        needles=tuple(needle) if needle else ("NeedleTip", "StylusTip"),
        reference=reference,
        image=image_name,
        axis=_choice("--axis", axis, AXES),
        calibration=read_calibration(config) if config else {},
    )
    if orientation not in ORIENTATIONS:
        raise InputError(f"--orientation is one of {', '.join(ORIENTATIONS)}; got {orientation}")
    scenario, folder = _scenario(source, spacing)
    options = SessionOptions(
        host=host if serve else "",
        port=port,
        connect=tuple(_address(text) for text in connect or ()),
        looks=Looks(naming, embed, scenario.needle_echo()),
        reach=Reach(thickness=beam, contact=contact),
        rates=Rates(fps, mesh_rate),
    )
    if not options.host and not options.connect:
        raise InputError("nothing to do: without --serve give --connect HOST:PORT")
    stage = make_stage(
        scenario, folder, model, orientation, rate, [_pair("--target", t) for t in target or ()]
    )

    def load_named(name: str) -> Stage:
        assert scenarios is not None  # otherwise it is not passed on
        if Path(name).name != name or name.startswith("."):
            raise InputError(f"a scenario is named without folders; got {name!r}")
        return make_stage(load(scenarios / name), scenarios, model, orientation, rate, [])

    with Session(stage, options, load_named if scenarios else None) as session:
        if not quiet:
            where = f"OpenIGTLink on {host}:{session.port}" if serve else "OpenIGTLink"
            print(f"{where}: {_summary(stage)}. Ctrl-C ends it.", flush=True)
        until = time.monotonic() + duration if duration else float("inf")
        try:
            while not session.wait(0.2) and time.monotonic() < until:
                pass
        except KeyboardInterrupt:
            pass


def make_stage(
    scenario: Scenario,
    folder: Path,
    model: str | None = None,
    orientation: str = "MF",
    rate: float = 120.0,
    targets: list[tuple[float, float]] | None = None,
) -> Stage:
    """Image, tissue and needle of a scenario, ready to run live.

    Parameters
    ----------
    scenario : Scenario
        What is simulated.
    folder : Path
        Where its relative paths start.
    model : str, optional
        Another model than the scenario's.
    orientation : {"MF", "UF", "MN", "UN"}
        Which way the picture lies in its file.
    rate : float
        Steps per second.
    targets : list of (x, y)
        Points that are followed, mm.
    """
    image = oriented(scenario.read_image(folder), orientation)
    grid = scenario.grid(image)
    insertion = scenario.insertion()
    entry = (float(insertion.entry[0, 0]), float(insertion.entry[0, 1]))
    engine = LiveEngine(
        lambda kind: build_model(scenario, grid, kind=kind, folder=folder),
        model or scenario.model.kind,
        NeedlePose(entry, entry),
        rate=rate,
    )
    if targets:
        engine.watch(np.array(targets))
    return Stage(image, engine, MODELS, insertion)


def oriented(image: UltrasoundImage, orientation: str) -> UltrasoundImage:
    """Turn a picture of another orientation to MF: columns to the marked side, rows away from the probe."""
    pixels = image.pixels
    if orientation[0] == "U":
        pixels = pixels[:, ::-1]
    if orientation[1] == "N":
        pixels = pixels[::-1]
    grid: RegularGrid = image.grid
    return UltrasoundImage(np.ascontiguousarray(pixels), grid, image.source)


def _scenario(source: str, spacing: str | None) -> tuple[Scenario, Path]:
    if source.lower().endswith(".toml"):
        if spacing:
            raise InputError("a scenario says its own spacing: leave --spacing out")
        return load(source), Path(source).parent
    image: dict[str, object] = {
        "file": source if source.startswith("sample:") else str(Path(source).absolute())
    }
    if spacing:
        image["spacing"] = list(_pair("--spacing", spacing))
    return validated({"format": 1, "image": image}, "command line"), Path()


def _summary(stage: Stage) -> str:
    x0, x1, y0, y1 = stage.image.grid.extent
    newest = stage.engine.snapshots.latest()
    name = newest.value.model if newest else ""
    return f"image {x1 - x0:.1f} x {y1 - y0:.1f} mm, {name} on {stage.engine.model.grid.size} nodes"


def _pair(option: str, text: str) -> tuple[float, float]:
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{option} takes two numbers in mm with a comma between; got {text!r}") from None
    return first, second


def _address(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon:
        return text, PORT
    if not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError(f"--connect takes HOST:PORT; got {text!r}")
    return host, int(port)


def _choice(option: str, text: str, choices: dict[str, tuple[int, int, int]]) -> tuple[float, float, float]:
    if text not in choices:
        raise InputError(f"{option} is one of {', '.join(choices)}; got {text}")
    x, y, z = choices[text]
    return float(x), float(y), float(z)
