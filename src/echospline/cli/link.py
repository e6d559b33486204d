"""``echospline link``: a tracker or 3D Slicer moves the needle over OpenIGTLink and receives the deforming image."""

from __future__ import annotations

import logging
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from echospline import live as live_room
from echospline import openigtlink
from echospline import scenario as scenario_room
from echospline import scene as scene_room
from echospline.cli.options import say, scenario_from, with_scenario_options
from echospline.errors import InputError

AXES = {
    "x": (1.0, 0.0, 0.0), "-x": (-1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0), "-z": (0.0, 0.0, -1.0),
}  # fmt: skip
ORIENTATIONS = ("MF", "UF", "MN", "UN")


@with_scenario_options
def link(
    source: Annotated[
        str,
        typer.Argument(
            metavar="[IMAGE_OR_SCENARIO]",
            help="an image, cine or DICOM file, sample:calf, or a scenario (.toml); a volume is a scenario with [space], "
            "sample:kidney or sample:spine",
        ),
    ] = "sample:calf",
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="port to listen on; 0 takes any free one")
    ] = openigtlink.PORT,
    host: Annotated[
        str,
        typer.Option(help="address to listen on; OpenIGTLink knows no password, so trusted networks only"),
    ] = "127.0.0.1",
    connect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="HOST:PORT", help="a server to connect to as well (PLUS, a tracker); may be repeated"
        ),
    ] = None,
    serve: Annotated[
        bool, typer.Option("--serve/--no-serve", help="listen for peers, or only connect")
    ] = True,
    needle_frame: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FRAME",
            help="frame at the needle's tip; may be repeated  [default: NeedleTip, StylusTip]",
        ),
    ] = None,
    needle_axis: Annotated[
        str, typer.Option(metavar="AXIS", help="direction of insertion in that frame: x, -x, y, -y, z, -z")
    ] = "z",
    reference: Annotated[
        str, typer.Option(metavar="FRAME", help="frame of all positions sent")
    ] = "Reference",
    image_name: Annotated[
        str, typer.Option(metavar="NAME", help="device name and frame of the image")
    ] = "Image",
    embed: Annotated[
        bool,
        typer.Option(
            "--embed/--no-embed",
            help="send the image in its place, or in pixels with ImageToReference beside it",
        ),
    ] = True,
    orientation: Annotated[
        str,
        typer.Option(
            metavar="MF|UF|MN|UN",
            help="how the picture lies in its file: columns grow to the Marked or Unmarked side of the probe, rows to the "
            "Far or Near end; it is turned to MF",
        ),
    ] = "MF",
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.xml", help="PLUS device set file whose CoordinateDefinitions are the calibration"
        ),
    ] = None,
    beam: Annotated[
        float,
        typer.Option(
            metavar="MM", help="thickness of the beam (full width at half maximum): the needle fades beyond"
        ),
    ] = 4.0,
    contact: Annotated[
        float,
        typer.Option(
            metavar="MM", help="distance from plane and image beyond which the needle moves no tissue"
        ),
    ] = 10.0,
    place: Annotated[
        str,
        typer.Option(
            metavar="axial|file|lps",
            help="where a volume stands in the reference frame: in Slicer's axial view, at its file's coordinates (as "
            "reconstruct and PLUS write them), or at those read as LPS; a transform SceneToReference goes before",
        ),
    ] = "axial",
    target: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y", help="point of the tissue, mm, that is followed and sent as POINT; may be repeated"
        ),
    ] = None,
    mesh_rate: Annotated[
        float, typer.Option(metavar="N", help="displaced meshes (POLYDATA) per second; 0 for none")
    ] = 5.0,
    rate: Annotated[float, typer.Option(min=10, max=1000, help="model steps per second")] = 120.0,
    scenarios: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="scenarios that peers may load by name; without, none"),
    ] = None,
    silence: Annotated[
        float,
        typer.Option(metavar="S", help="seconds without a transform after which the needle counts as stale"),
    ] = 0.5,
    ask: Annotated[
        str,
        typer.Option(
            metavar="TYPE",
            help="stream that servers of --connect are asked to start: TDATA, QTDATA, QTRANS, POSITION or none",
        ),
    ] = "TDATA",
    duration: Annotated[
        float, typer.Option(metavar="S", min=0, help="end after so many seconds; 0 runs until Ctrl+C")
    ] = 0.0,
    quiet: Annotated[bool, typer.Option("--quiet", help="say nothing but warnings")] = False,
    changes: dict[str, Any] | None = None,
) -> None:
    """Join the network of 3D Slicer and PLUS: transforms move the needle, the deforming image comes back.

    In a volume they move the probe as well, and the picture of its plane comes back. Images go out at the scenario's frames per second (--fps). docs/slicer.md shows how to connect step by step.
    """
    from threadpoolctl import threadpool_limits

    logging.basicConfig(
        level=logging.WARNING if quiet else logging.INFO, format="%(message)s", stream=sys.stderr, force=True
    )
    scenario, folder = scenario_from(source, changes or {})
    naming = openigtlink.Naming(
        needles=tuple(needle_frame) if needle_frame else ("NeedleTip", "StylusTip"),
        reference=reference,
        image=image_name,
        axis=axis_of(needle_axis),
        calibration=openigtlink.read_calibration(config) if config else {},
    )
    options = openigtlink.SessionOptions(
        host=host if serve else "",
        port=port,
        connect=tuple(address(text) for text in connect or ()),
        looks=openigtlink.Looks(naming, embed, scenario.needle_echo()),
        reach=scene_room.Reach(thickness=beam, contact=contact),
        rates=openigtlink.Rates(scenario.output.fps, mesh_rate),
        silence=silence,
        ask="" if ask.lower() == "none" else ask.upper(),
    )
    if not options.host and not options.connect:
        raise InputError("nothing to do: with --no-serve give --connect HOST:PORT")

    def staged(
        chosen: scenario_room.Scenario, start: Path, points: list[tuple[float, float]]
    ) -> openigtlink.Stage | openigtlink.SpatialStage:
        if scenario_room.is_spatial(chosen):
            from echospline.cli.link_space import make_spatial_stage

            return make_spatial_stage(chosen, start, place)
        made = make_stage(chosen, start, orientation, rate, points)
        say([*made.image.notes, *chosen.label_notes(start)], "note")
        say(scenario_room.size_doubts(made.image.grid))
        return made

    if scenario_room.is_spatial(scenario):
        from echospline.cli.link_space import refuse_options_of_the_plane

        refuse_options_of_the_plane(
            {
                "--orientation": (orientation, "MF", "the picture is made in MF: leave it out"),
                "--beam": (beam, 4.0, "the slice's thickness is space.probe.elevation"),
                "--target": (target, None, "no points are followed yet: leave it out"),
                "--mesh-rate": (mesh_rate, 5.0, "no mesh is sent yet: leave it out"),
                "--rate": (rate, 120.0, "model and picture step together, --fps times per second"),
            }
        )
    elif place != "axial":
        raise InputError(f"--place {place} belongs to volumes; a picture's place is ImageToReference")
    stage = staged(scenario, folder, [_point(text) for text in target or ()])

    def load_named(name: str) -> openigtlink.Stage | openigtlink.SpatialStage:
        assert scenarios is not None  # otherwise it is not passed on
        if Path(name).name != name or not name.endswith(".toml"):
            raise InputError(f"a scenario is named NAME.toml, without folders; got {name!r}")
        return staged(scenario_room.load(scenarios / name), scenarios, [])

    # An engine's step is short: more threads make it slower and less punctual.
    with (
        threadpool_limits(limits=1),
        openigtlink.Session(stage, options, load_named if scenarios else None) as session,
    ):
        if not quiet:
            where = f"OpenIGTLink on {host}:{session.port}" if serve else "OpenIGTLink"
            print(f"{where}: {_summary(stage)}; Ctrl+C ends", flush=True)
        until = time.monotonic() + duration if duration else float("inf")
        with suppress(KeyboardInterrupt):
            while not session.wait(0.2) and time.monotonic() < until:
                pass


def make_stage(
    scenario: scenario_room.Scenario,
    folder: Path,
    orientation: str = "MF",
    rate: float = 120.0,
    targets: list[tuple[float, float]] | None = None,
) -> openigtlink.Stage:
    """Build the image, tissue and needle of a scenario, ready to run live.

    Parameters
    ----------
    scenario : Scenario
        The scenario to simulate.
    folder : Path
        Start of its relative paths.
    orientation : {"MF", "UF", "MN", "UN"}
        Orientation of the picture in its file.
    rate : float
        Steps per second.
    targets : list of (x, y)
        Points whose motion is reported, mm.
    """
    import numpy as np

    image = oriented(scenario.read_image(folder), orientation)
    grid = scenario.grid(image)
    insertion = scenario.insertion()
    entry = (float(insertion.entry[0, 0]), float(insertion.entry[0, 1]))
    engine = live_room.LiveEngine(
        lambda kind: scenario_room.build_model(scenario, grid, kind=kind, folder=folder),
        scenario.model.kind,
        scene_room.NeedlePose(entry, entry),
        rate=rate,
    )
    if targets:
        engine.watch(np.array(targets))
    return openigtlink.Stage(image, engine, scenario_room.MODELS, insertion)


def oriented(image: scene_room.UltrasoundImage, orientation: str) -> scene_room.UltrasoundImage:
    """Turn a picture of another orientation to MF: columns to the marked side, rows away from the probe.

    Raises
    ------
    InputError
        If there is no such orientation.
    """
    import numpy as np

    if orientation not in ORIENTATIONS:
        raise InputError(f"--orientation is one of {', '.join(ORIENTATIONS)}; got {orientation!r}")
    pixels = image.pixels
    if orientation[0] == "U":
        pixels = pixels[:, ::-1]
    if orientation[1] == "N":
        pixels = pixels[::-1]
    return scene_room.UltrasoundImage(np.ascontiguousarray(pixels), image.grid, image.source, image.notes)


def _summary(stage: openigtlink.Stage | openigtlink.SpatialStage) -> str:
    if isinstance(stage, openigtlink.SpatialStage):
        from echospline.cli.link_space import summary_in_space

        return summary_in_space(stage)
    x0, x1, y0, y1 = stage.image.grid.extent
    newest = stage.engine.snapshots.latest()
    name = newest.value.model if newest else ""
    return f"image {x1 - x0:.1f} x {y1 - y0:.1f} mm, {name} on {stage.engine.model.grid.size} nodes"


def address(text: str) -> tuple[str, int]:
    """Split ``HOST:PORT`` into host and port; without a port OpenIGTLink's own.

    Raises
    ------
    InputError
        If the port is no number from 1 to 65535.
    """
    host, colon, port = text.rpartition(":")
    if not colon:
        return text, openigtlink.PORT
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError(f"--connect expects HOST:PORT; got {text!r}")
    return host, int(port)


def _point(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--target expects X,Y in mm; got {text!r}") from None
    return x, y


def axis_of(text: str) -> tuple[float, float, float]:
    """Return the unit vector of ``x``, ``-x``, ... ``-z``.

    Raises
    ------
    InputError
        If the text is another.
    """
    if text not in AXES:
        raise InputError(f"--needle-axis is one of {', '.join(AXES)}; got {text!r}")
    return AXES[text]
