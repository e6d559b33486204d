"""``echospline study``: the paper's figures and tables, regenerated."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from echospline import study as study_room
from echospline.atomic import claimed
from echospline.cli.exvivo import exvivo
from echospline.cli.options import LOOKS


def study(
    context: typer.Context,
    out: Annotated[Path, typer.Option("--out", help="folder for figures, tables and report.html")] = Path(
        "out/study"
    ),
    quick: Annotated[
        bool, typer.Option("--quick", help="one to three minutes: fewer depths, meshes and runs")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the searches")] = 0,
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="processes for the accuracy cases; 0 for none")
    ] = 0,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="TCP://HOST:PORT", help="a running dask scheduler")
    ] = None,
    image: Annotated[str, typer.Option("--image", help="ultrasound image of Fig. 2")] = "sample:calf",
    json_: Annotated[bool, typer.Option("--json", help="print the result as JSON, nothing else")] = False,
) -> None:
    """Regenerate the paper's study: Fig. 2, 3a, 3b, tables (CSV, JSON) and one self-contained report.html.

    Every model is compared with finite elements under the same needle, in accuracy (fitted and held-out insertions, four
    moduli in both readings) and in time per step (every method named). Lesions, layers and other edges follow, where linear elasticity stops
    being good, and what a plane model misses of tissue in space. Cases that are in the folder already are not run again.
    """
    from rich.console import Console
    from rich.table import Table

    if context.invoked_subcommand is not None:
        return
    progress = Console(stderr=True)
    command = f"echospline study{' --quick' if quick else ''} --seed {seed}"
    with claimed(out):
        result = study_room.study(
            out, study_room.QUICK if quick else study_room.FULL, seed=seed, workers=workers, scheduler=scheduler, image=image, command=command,
            report=None if json_ else lambda what: progress.print(what, highlight=False),
        )  # fmt: skip
    if json_:
        json.dump(result, sys.stdout, indent=1)
        print()
        return
    console = Console()
    table = Table(title="The paper's claims", title_justify="left")
    for heading in ("claim", "verdict"):
        table.add_column(heading)
    for claim in result["claims"]:
        table.add_row(claim["claim"], claim["verdict"])
    console.print(table)
    console.print(f"report: {out / 'report.html'}")


studies = typer.Typer(**LOOKS)
studies.callback(invoke_without_command=True)(study)
studies.command()(exvivo)
