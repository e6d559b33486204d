"""``echospline identify``: observed displacements in, parameters that ``simulate`` runs out."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from echospline import study as study_room
from echospline.errors import InputError


def identify(
    fields: Annotated[
        list[str],
        typer.Argument(
            metavar="FIELD...",
            help="displacement.npz of a simulation, .npz or .mha of `track`, or a folder of a run; several make a cohort",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="folder for the results")] = Path("out/identify"),
    scenario: Annotated[
        Path | None,
        typer.Option("--scenario", help="the scene (.toml); by default scenario.toml beside each field"),
    ] = None,
    model: Annotated[
        str | None, typer.Option("--model", help="tps, elastic, green or fem; by default the scenario's")
    ] = None,
    objective: Annotated[
        str, typer.Option("--objective", help="what is made least: mae or rmse (24)")
    ] = "mae",
    method: Annotated[
        str,
        typer.Option(
            "--method", help="closed (closed form and a small search) or grid (the paper's brute force)"
        ),
    ] = "closed",
    needle: Annotated[
        Path | None,
        typer.Option("--needle", help="path of the needle (CSV or npz) where the field holds none"),
    ] = None,
    confidence: Annotated[
        float, typer.Option("--confidence", min=0, max=1, help="tracked points below this are left out")
    ] = 0.5,
    frames: Annotated[
        int, typer.Option("--frames", min=0, help="frames used, evenly spaced; 0 for all")
    ] = 60,
    runs: Annotated[int, typer.Option("--runs", min=8, help="simulations of --method grid")] = 2000,
    bootstrap: Annotated[
        int, typer.Option("--bootstrap", min=0, help="resamples for the 95 % intervals")
    ] = 200,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the search and the bootstrap")] = 0,
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="processes on this machine; 0 for none")
    ] = 0,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="TCP://HOST:PORT", help="a running dask scheduler")
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="print the reports as JSON, nothing else")] = False,
) -> None:
    """Find the parameters with which a model fits the observed displacement.

    Writes `identified.toml` (run it with `echospline simulate`), `identification.json` (errors, 95 % intervals, combinations
    that the data do not determine) and `error_map.png`. Several fields run one after another, on `--workers` or on a cluster;
    each result is written as soon as its task ends, and an interrupted run resumes.
    """
    for field in fields:
        if not Path(field).exists():
            raise InputError(f"there is no file or folder {field}: expected a displacement field or a run")
    names = _names(fields)
    tasks = []
    for name, field in zip(names, fields, strict=True):
        folder = out if len(fields) == 1 else out / name
        arguments: dict[str, Any] = {
            "field": str(Path(field).resolve()), "out": str(folder.resolve()),
            "scenario": None if scenario is None else str(scenario.resolve()), "model": model, "objective": objective,
            "needle": None if needle is None else str(needle.resolve()), "confidence": confidence,
            "method": method, "frames": frames, "runs": runs, "bootstrap": bootstrap, "seed": seed,
        }  # fmt: skip
        tasks.append(study_room.Task(name, arguments))
    if len(tasks) == 1 and not workers and scheduler is None:
        reports = {names[0]: study_room.calibrate(**tasks[0].arguments)}
        failed: dict[str, str] = {}
    else:
        outcome = study_room.sweep(
            study_room.calibrate, tasks, out / "tasks", workers=workers, scheduler=scheduler
        )
        reports, failed = outcome.results, outcome.failed
    if json_:
        json.dump({"reports": reports, "failed": failed}, sys.stdout, indent=1)
        print()
    else:
        _print_summary(reports, out)
    if failed:
        name, why = next(iter(failed.items()))
        raise InputError(f"{len(failed)} of {len(tasks)} fields could not be identified; {name}: {why}")


def _names(fields: list[str]) -> list[str]:
    """Name each field after its file or folder, numbered where two are equal."""
    stems = []
    for field in fields:
        path = Path(field).resolve()
        stem = (
            path.name if path.is_dir() else (path.parent.name if path.stem == "displacement" else path.stem)
        )
        stems.append("".join(c if c.isalnum() or c in "._-" else "_" for c in stem).lstrip("._-") or "field")
    return [s if stems.count(s) == 1 else f"{s}-{i + 1}" for i, s in enumerate(stems)]


def _print_summary(reports: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for name, report in reports.items():
        table = Table(title=f"{name}: {report['model']}, {report['method']}", title_justify="left")
        for heading in ("parameter", "value", "95 % interval"):
            table.add_column(heading, justify="left" if heading == "parameter" else "right")
        for key, value in report["values"].items():
            low, high = report["interval_95_percent"].get(key, (None, None))
            table.add_row(key, f"{value:.4g}", "" if low is None else f"{low:.4g} to {high:.4g}")
        console.print(table)
        console.print(
            f"MAE {report['mae_mm']:.4f} mm ({report['mae_percent_of_mean']:.1f} % of the mean displacement), "
            f"RMSE {report['rmse_mm']:.4f} mm ({report['rmse_percent_of_mean']:.1f} %); "
            f"{report['frames']} frames, {report['runs']} evaluations, {report['seconds']:.1f} s"
        )
        for sentence in report["cannot_be_told_apart"]:
            console.print(f"[yellow]{sentence}[/]")
    console.print(f"results in {out}")
