"""``echospline simulate`` and ``echospline demo``: from an image and a needle to a cine with its true motion."""

from __future__ import annotations

import json
import sys
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from echospline import laboratory
from echospline import scenario as scenario_room
from echospline.atomic import claimed
from echospline.cli.options import say, scenario_from, with_scenario_options

if TYPE_CHECKING:
    from echospline.picture import ImageFormer
    from echospline.scene import UltrasoundImage

Out = Annotated[Path, typer.Option("--out", help="folder for the results, made where it is not there")]
Json = Annotated[bool, typer.Option("--json", help="print the report of the run as JSON, nothing else")]


@with_scenario_options
def simulate(
    source: Annotated[
        str,
        typer.Argument(
            metavar="IMAGE_OR_SCENARIO",
            help="an image, cine or DICOM file, a volume with an option of space (--view), sample:calf, sample:kidney, sample:spine, or a scenario (.toml)",
        ),
    ],
    out: Out = Path("out"),
    json_: Json = False,
    changes: dict[str, Any] | None = None,
) -> None:
    """Push a needle into an ultrasound image and write how it deforms.

    Writes the cine, `displacement.npz` (the true motion), `summary.png`, `scenario.toml` (the run, resolved: running it
    again gives the same numbers) and `run.json` (parameters, versions, time per stage) into the folder. Options
    replace values of the scenario.
    """
    simulate_into(source, out, changes or {}, as_json=json_)


def demo(out: Out = Path("out/demo"), json_: Json = False) -> None:
    """Run the main job on the image that ships with the package: a needle into calf muscle, in and out again."""
    with as_file(files("echospline").joinpath("data", "demo.toml")) as scenario:
        simulate_into(str(scenario), out, {}, as_json=json_)


def simulate_into(source: str, out: Path, changes: dict[str, Any], *, as_json: bool) -> None:
    """Run a scenario with a progress bar on a terminal, and print a summary."""
    scenario, folder = scenario_from(source, changes)
    if scenario_room.is_spatial(scenario):
        _simulate_space(scenario, folder, out, as_json=as_json)
        return
    scenario, image = scenario.opened(folder, eight_bit=None)
    say([*image.notes, *scenario.label_notes(folder)], "note")
    doubts = scenario_room.check(scenario, image, out)
    say(doubts)
    model = scenario_room.build_model(scenario, scenario.grid(image), folder=folder)
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    with (
        claimed(out),
        Progress(
            TextColumn("simulating"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=as_json or not console.is_terminal,
        ) as bar,
    ):
        task = bar.add_task("simulating", total=None)
        report = scenario_room.run(
            scenario,
            image,
            model,
            out,
            folder,
            progress=lambda done, count: bar.update(task, completed=done, total=count),
            form_image=_image_former(scenario, image),
            doubts=doubts,
        )
    if scenario.model.kind == "green":
        say([report["solved_by"]], "note")
    say(doubt for doubt in report["doubts"] if doubt not in doubts)
    if as_json:
        json.dump(report, sys.stdout, indent=2)
        print()
        return
    _print_summary(report, out)


def _simulate_space(scenario: scenario_room.Scenario, folder: Path, out: Path, *, as_json: bool) -> None:
    """Run a scene in space with a progress bar on a terminal, and print a summary."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from echospline.scenario.run_space import run_space
    from echospline.scenario.space_models import build_spatial_model

    opened = scenario_room.open_spatial(scenario, folder)
    say(opened.notes, "note")
    doubts = scenario_room.check_space(opened.scenario, opened.volume, out)
    say(doubts)
    space = opened.scenario.space
    assert space is not None
    model = build_spatial_model(opened.scenario, space.grid(opened.volume), opened.tissue)
    console = Console(stderr=True)
    columns = (TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    quiet = as_json or not console.is_terminal
    with claimed(out), Progress(*columns, console=console, transient=True, disable=quiet) as bar:
        task = bar.add_task("simulating", total=None)
        report = run_space(
            opened.scenario,
            opened.volume,
            model,
            out,
            folder,
            progress=lambda done, count: bar.update(task, completed=done, total=count),
            form_image=opened.form_image,
            doubts=doubts,
        )
    say(doubt for doubt in report["doubts"] if doubt not in doubts)
    if as_json:
        json.dump(report, sys.stdout, indent=2)
        print()
        return
    _print_summary(report, out)


def _image_former(scenario: scenario_room.Scenario, image: UltrasoundImage) -> ImageFormer | None:
    """Return the image former, where it is not the warp."""
    if scenario.output.image_model == "warp":
        return None
    section = scenario.phantom
    return laboratory.rescatter(
        image, scenario.probe.probe(), display=section.display(), angles=section.angles, seed=section.seed
    )


def _print_summary(report: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(title=f"{report['frames']} frames in {report['seconds']:.1f} s", title_justify="left")
    table.add_column("stage")
    table.add_column("median ms", justify="right")
    table.add_column("p99 ms", justify="right")
    for name, ms in report["milliseconds_per_frame"].items():
        table.add_row(name, f"{ms['median']:.2f}", f"{ms['p99']:.2f}")
    console.print(table)
    console.print(
        f"largest displacement {report['largest_displacement_mm']:.2f} mm, "
        f"inverse map within {report['inverse_map_residual_px']:.1e} px"
    )
    if forces := report.get("largest_forces"):
        console.print(
            f"largest tip force {forces['tip_force_N']:.3f} N, friction {forces['friction_N']:.3f} N, "
            f"side force {forces['side_force_N']:.3f} N"
        )
    for fold in report["folded_frames"][:1]:
        console.print(
            f"[yellow]{len(report['folded_frames'])} frames fold, first at {fold['time_s']} s: {fold['what']}[/]"
        )
    console.print(f"results in {out}: {', '.join(report['files'])}")
