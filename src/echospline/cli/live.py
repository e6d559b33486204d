"""``echospline live``: steer the needle in the browser."""

from __future__ import annotations

import logging
import os
import webbrowser
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from threadpoolctl import threadpool_limits

from echospline.cli.link import address, make_stage
from echospline.cli.notes import print_notes
from echospline.cli.options import scenario_from, with_scenario_options
from echospline.errors import InputError
from echospline.openigtlink import PORT, Looks, Naming, Rates, Session, SessionOptions, read_calibration
from echospline.picture import NeedleEcho
from echospline.scenario import MODELS, Scenario, build_model
from echospline.scene import UltrasoundImage
from echospline.viewer import Scene, Sessions, Settings, build_app, default_exercises, serve, steer

LABELS = {"tps": "TPS", "elastic": "Elastic", "green": "Green", "fem": "FEM"}


def default_sessions() -> Path:
    """Return the file that keeps a user's training sessions."""
    home = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(home) / "echospline" / "sessions.sqlite"


@with_scenario_options
def live(
    source: Annotated[
        str,
        typer.Argument(
            metavar="[IMAGE_OR_SCENARIO]",
            help="an image, cine or DICOM file, sample:calf, or a scenario (.toml) with its exercises",
        ),
    ] = "sample:calf",
    host: Annotated[
        str,
        typer.Option(help="address to listen on; anything but this machine's own asks pages for a token"),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="port; 0 takes any free one")] = 8750,
    rate: Annotated[float, typer.Option(min=10, max=1000, help="model steps per second")] = 120.0,
    clients: Annotated[int, typer.Option(min=1, max=1000, help="most pages at once")] = 64,
    nodes: Annotated[
        bool | None,
        typer.Option(
            "--nodes/--splines",
            help="what is sent for tps and elastic: every node's displacement (9.6 kB for 1200), or the spline's "
            "weights (2 kB, more work here, a smooth picture on any mesh); by default weights above 4000 nodes",
            show_default=False,
        ),
    ] = None,
    sessions: Annotated[
        Path | None,
        typer.Option(help="file that keeps training sessions; by default in the user's data folder"),
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="open the page")] = True,
    link: Annotated[
        bool,
        typer.Option(
            "--link/--no-link", help="a tracker or 3D Slicer steers the needle over OpenIGTLink as well"
        ),
    ] = False,
    link_port: Annotated[
        int, typer.Option(min=0, max=65535, help="port for it on this machine; 0 takes any free one")
    ] = PORT,
    link_connect: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST:PORT", help="an OpenIGTLink server to connect to; may be repeated"),
    ] = None,
    link_config: Annotated[
        Path | None, typer.Option(metavar="FILE.xml", help="PLUS device set file with the calibration")
    ] = None,
    changes: dict[str, Any] | None = None,
) -> None:
    """Steer the needle in the browser and see the tissue move.

    Starts a server on this machine and opens its page; Ctrl+C ends it. Without an argument it shows the image that ships
    with the package. Finished exercises are kept (`echospline sessions` lists and exports them).
    """
    scenario, folder = scenario_from(source, changes or {})
    scenario, image = scenario.opened(folder, eight_bit=True)
    print_notes([*image.notes, *scenario.doubts(folder)])
    scene = scene_of(scenario, image, folder)
    settings = Settings(host, port, rate, clients, nodes=nodes)
    kept = Sessions(sessions or default_sessions())
    scene.models(scene.names[0][0])  # refuses an invalid scenario before a page waits for it
    app = build_app(scene, kept, settings, opener_for(scenario))
    console = Console(stderr=True)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")

    def ready(address: str) -> None:
        console.print(f"steer the needle at [bold]{address}[/]", highlight=False, soft_wrap=True)
        console.print(f"sessions are kept in {kept.path}; Ctrl+C ends", highlight=False, soft_wrap=True)
        if browser:
            webbrowser.open(address)

    with ExitStack() as stack:
        stack.enter_context(
            threadpool_limits(limits=1)
        )  # an engine's step is short: more threads make it slower and less punctual
        if link or link_connect:
            session = Session(
                make_stage(scenario, folder, rate=rate),
                SessionOptions(
                    port=link_port,
                    connect=tuple(address(text) for text in link_connect or ()),
                    looks=Looks(
                        Naming(calibration=read_calibration(link_config) if link_config else {}),
                        echo=scenario.needle_echo(),
                    ),
                    rates=Rates(scenario.output.fps),
                ),
                moved=lambda pose, appears: steer(app, pose, appears),
            )
            stack.enter_context(session)
            console.print(f"OpenIGTLink on 127.0.0.1:{session.port}", highlight=False)
        serve(app, settings, ready)


def scene_of(scenario: Scenario, image: UltrasoundImage, folder: Path) -> Scene:
    """Build the scene of a scenario: its image, mesh and needle, every model, its exercises or the default three.

    Raises
    ------
    InputError
        If the point of entry lies outside the image.
    """
    grid = scenario.grid(image)
    needle = scenario.needle
    entry, angle = (needle.entry, needle.angle)
    if not grid.contains(entry).all():
        x0, x1, y0, y1 = grid.extent
        raise InputError(
            f"needle.entry must lie in the image, x from {x0:g} to {x1:g} and y from {y0:g} to {y1:g} mm; got {entry}"
        )
    first = scenario.model.kind
    kept = scenario.model_copy(
        update={"image": scenario.image.model_copy(update={"file": _whole(scenario, folder)})}
    )
    return Scene(
        title=scenario.title or scenario.image.file.replace("sample:", "Sample: ").rsplit("/", 1)[-1],
        image=image,
        grid=grid,
        models=lambda kind: build_model(scenario, grid, kind=kind, folder=folder),
        names=tuple((kind, LABELS[kind]) for kind in sorted(MODELS, key=lambda kind: kind != first)),
        entry=entry,
        angle=angle,
        echo=scenario.needle_echo() or NeedleEcho(shaft=False, tip=False, tail=False, shadow=False),
        exercises=tuple(scenario.exercise) or default_exercises(grid),
        source=kept.model_dump_json(),
    )


def _whole(scenario: Scenario, folder: Path) -> str:
    """Return the name of the image that is valid in every folder."""
    file = scenario.image.file
    return file if file.startswith("sample:") else str((folder / file).resolve())


def opener_for(scenario: Scenario) -> Callable[[Path, tuple[float, float] | None], Scene]:
    """Build a function that turns uploaded images into scenes with the tissue, mesh and model of a scenario."""

    def opened(path: Path, spacing: tuple[float, float] | None) -> Scene:
        values: dict[str, Any] = {"title": "Your image", "image.file": str(path), "image.spacing": spacing, "image.frame": None, "image.window": None,
                  "image.region": None, "tissue.region": [], "mesh.clamped_points": [], "exercise": []}  # fmt: skip
        bare = scenario.with_values(values, "upload")
        bare, image = bare.opened(path.parent, eight_bit=True)
        x0, x1, y0, _ = bare.grid(image).extent
        return scene_of(bare.with_values({"needle.entry": (x0 + 0.2 * (x1 - x0), y0)}), image, path.parent)

    return opened
