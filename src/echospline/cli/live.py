"""``echospline live``: steer the needle in the browser."""

from __future__ import annotations

import logging
import os
import webbrowser
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import typer

from echospline import io as io_room
from echospline import openigtlink, viewer
from echospline import page as page_room
from echospline import scenario as scenario_room
from echospline import scene as scene_room
from echospline.cli.link import address, make_stage
from echospline.cli.link_space import make_spatial_stage
from echospline.cli.options import say, scenario_from, with_scenario_options
from echospline.errors import InputError

LARGEST_UPLOAD = 256.0
"""MiB of one decoded frame; 4096 x 4096 pixels, the most that a page shows, have 128 in double precision."""
LAST_PATIENCE = 0.5
"""s for work beside the server when it has ended."""


def default_sessions() -> Path:
    """Return the file that keeps a user's training sessions.

    Raises
    ------
    InputError
        If the user has no home.
    """
    named = os.environ.get("XDG_DATA_HOME")
    try:
        folder = Path(named) if named else Path.home() / ".local" / "share"
    except RuntimeError:
        raise InputError(
            "this user has no home folder to keep sessions in; name a file with --sessions"
        ) from None
    return folder / "echospline" / "sessions.sqlite"


def _kept(sessions: Path | None, stack: ExitStack, say: Callable[[str], None]) -> viewer.Sessions:
    """Open the file of sessions; where no file was named and the user's cannot be written, one that lasts as long as the server."""
    if sessions is not None:
        return viewer.Sessions(sessions)
    try:
        return viewer.Sessions(default_sessions())
    except InputError as error:
        say(f"{error}; without one, sessions last until this server ends")
        folder = stack.enter_context(TemporaryDirectory(prefix="echospline-", ignore_cleanup_errors=True))
        return viewer.Sessions(Path(folder) / "sessions.sqlite")


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
    language: Annotated[Literal["en", "de"], typer.Option(help="of the page: en or de")] = "en",
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
    ] = openigtlink.PORT,
    link_connect: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST:PORT", help="an OpenIGTLink server to connect to; may be repeated"),
    ] = None,
    link_config: Annotated[
        Path | None, typer.Option(metavar="FILE.xml", help="PLUS device set file with the calibration")
    ] = None,
    link_silence: Annotated[
        float,
        typer.Option(metavar="S", help="seconds without a transform after which the tracker counts as stale"),
    ] = 0.5,
    origin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="https://HOST",
            help="address of a reverse proxy in front, as browsers see it; may be repeated; asks pages for a token",
        ),
    ] = None,
    token: Annotated[
        bool,
        typer.Option(
            "--token/--no-token",
            help="ask pages for a token where others can reach them; without, the proxy must",
        ),
    ] = True,
    changes: dict[str, Any] | None = None,
) -> None:
    """Steer the needle in the browser and see the tissue move.

    Starts a server on this machine and opens its page; Ctrl+C ends it. Without an argument it shows the image that ships
    with the package. Finished exercises are kept (`echospline sessions` lists and exports them).
    """
    from rich.console import Console
    from threadpoolctl import threadpool_limits

    scenario, folder = scenario_from(source, changes or {})
    opened = None
    if scenario_room.is_spatial(scenario):
        opened = scenario_room.open_spatial(scenario, folder, own=False)
        say([*opened.notes, *scenario_room.unused_doubts(opened.scenario)], "note")
        scene = viewer.Scene(page_room.packed_space(opened, language=language, rate=rate))
    else:
        scenario, image = scenario.opened(folder, eight_bit=True)
        say([*image.notes, *scenario.label_notes(folder)], "note")
        say(scenario_room.size_doubts(image.grid))
        scene = scene_of(scenario, image, folder, language=language, rate=rate)
    say(page_room.doubts(scenario, scene.pack), "note")
    opener = None if opened is not None else opener_for(scenario, language=language, rate=rate)
    settings = viewer.Settings(host, port, clients, origins=tuple(origin or ()), open_door=not token)
    console = Console(stderr=True)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")

    def ready(address: str, teaching: str) -> None:
        console.print(f"steer the needle at [bold]{address}[/]", highlight=False, soft_wrap=True)
        if teaching != address:
            console.print(f"the instructor sees the class at {teaching}", highlight=False, soft_wrap=True)
        console.print(f"sessions are kept in {kept.path}; Ctrl+C ends", highlight=False, soft_wrap=True)
        if browser:
            webbrowser.open(address)

    with ExitStack() as stack:
        kept = _kept(sessions, stack, lambda text: console.print(text, highlight=False, soft_wrap=True))
        app = viewer.build_app(scene, kept, settings, opener)
        # an engine's step is short: more threads make it slower and less punctual
        stack.enter_context(threadpool_limits(limits=1))
        if link or link_connect:
            session = openigtlink.Session(
                make_stage(scenario, folder, rate=rate)
                if opened is None
                else make_spatial_stage(scenario, folder),
                openigtlink.SessionOptions(
                    port=link_port,
                    connect=tuple(address(text) for text in link_connect or ()),
                    looks=openigtlink.Looks(
                        openigtlink.Naming(
                            calibration=openigtlink.read_calibration(link_config) if link_config else {}
                        ),
                        echo=scenario.needle_echo(),
                    ),
                    rates=openigtlink.Rates(scenario.output.fps),
                    silence=link_silence,
                ),
                moved=lambda pose, appears: viewer.steer(app, pose, appears),
                tracked=lambda text: viewer.announce(app, text),
                placed=lambda plane: viewer.turn(app, plane.matrix.ravel()),
            )
            stack.enter_context(session)
            console.print(f"OpenIGTLink on 127.0.0.1:{session.port}", highlight=False)
        viewer.serve(app, settings, ready)
    if viewer.unfinished(LAST_PATIENCE):
        # Everything is closed; a file that is read or a solver at work would crash an interpreter that ends.
        os._exit(0)


def scene_of(
    scenario: scenario_room.Scenario,
    image: scene_room.UltrasoundImage,
    folder: Path,
    *,
    language: Literal["en", "de"] = "en",
    rate: float = 120.0,
) -> viewer.Scene:
    """Build the scene of a scenario: its pack, and finite elements on the same mesh.

    Raises
    ------
    InputError
        If the point of entry or an exercise lies outside the image, or the picture is too large for a page.
    """
    kept = scenario.model_copy(
        update={"image": scenario.image.model_copy(update={"file": _whole(scenario, folder)})}
    )
    grid = scenario.grid(image)
    return viewer.Scene(
        pack=page_room.packed(scenario, image, folder, language=language, rate=rate),
        source=kept.model_dump_json(),
        fem=lambda: scenario_room.build_model(scenario, grid, kind="fem", folder=folder),
    )


def _whole(scenario: scenario_room.Scenario, folder: Path) -> str:
    """Return the name of the image that is valid in every folder."""
    file = scenario.image.file
    return file if file.startswith("sample:") else str((folder / file).resolve())


def opener_for(
    scenario: scenario_room.Scenario, *, language: Literal["en", "de"] = "en", rate: float = 120.0
) -> Callable[[Path, tuple[float, float] | None], viewer.Scene]:
    """Build a function that turns uploaded images into scenes with the tissue, mesh and model of a scenario."""

    def opened(path: Path, spacing: tuple[float, float] | None) -> viewer.Scene:
        values: dict[str, Any] = {"title": "Your image", "image.file": str(path), "image.spacing": spacing, "image.frame": None, "image.window": None,
                  "image.region": None, "tissue.region": [], "mesh.clamped_points": [], "body": [], "exercise": []}  # fmt: skip
        bare = scenario.with_values(values, "upload")
        io_room.open_recording(path, LARGEST_UPLOAD, whole=False)  # refuses a bomb by its header
        bare, image = bare.opened(path.parent, eight_bit=True)
        x0, x1, y0, _ = bare.grid(image).extent
        bare = bare.with_values({"needle.entry": (x0 + 0.2 * (x1 - x0), y0)})
        return scene_of(bare, image, path.parent, language=language, rate=rate)

    return opened
