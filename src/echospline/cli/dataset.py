"""``echospline dataset``: many drawn insertions, imaged, with their true motion, for learning."""

from __future__ import annotations

import json
import sys
from importlib.resources import as_file, files
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer

from echospline import scenario as scenario_room
from echospline import study as study_room
from echospline.atomic import claimed
from echospline.cli.options import say
from echospline.errors import InputError


def dataset(
    scenarios: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[SCENARIO]...", help="bases that are varied in turn (.toml)"),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="the Zarr store, a folder")] = Path("out/dataset.zarr"),
    n: Annotated[int, typer.Option("--n", min=1, max=10_000_000, help="number of samples")] = 10,
    frames: Annotated[
        int, typer.Option(min=2, max=1000, help="frames per sample, evenly over the insertion")
    ] = 8,
    seed: Annotated[int, typer.Option(min=0, help="of the draws")] = 0,
    workers: Annotated[int, typer.Option(min=0, help="processes on this machine; 0 for none")] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="TCP://HOST:PORT", help="a running dask scheduler; it must see the same files"),
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="print the report as JSON, nothing else")] = False,
) -> None:
    """Draw insertions and image them: pictures, true displacement, needle mask and pose, one chunk per sample.

    Tissue, probe, needle path and speckle are drawn around the bases; sample i depends on its base, i and the seed alone,
    and `scenarios/0000000.toml` makes it again (`echospline phantom`). An interrupted run resumes,
    and a larger --n adds samples. Bases in space ([space], or an image sample:kidney or sample:spine) make sequences of a probe that is held along or
    across the needle and drifts: the truth is the motion in the picture and out of it, and where tissue has left the slice
    (`echospline simulate` makes such a sample again).
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    with as_file(files("echospline").joinpath("data", "dataset.toml")) as own:
        bases = [str(path.resolve()) for path in scenarios or [own]]
        loaded = [(Path(base), scenario_room.load(base)) for base in bases]
        for base, first in loaded:
            if scenario_room.is_spatial(first):
                continue
            say((f"{base.name}: {note}" for note in first.label_notes(base.parent)), "note")
            say(scenario_room.needle_doubts(first.insertion(), first.phantom.grid()))
        layouts = [study_room.sample_arrays(first, frames) for _, first in loaded]
        if any(layout != layouts[0] for layout in layouts):
            raise InputError(
                "all bases of a dataset need the same phantom.size, phantom.pixel and mesh.nodes; in space the same shape of the probe's "
                "picture, and bases are all in the plane or all in space"
            )
        say(scenario_room.check_store(n, study_room.sample_bytes(loaded[0][1], frames), out))
        began = perf_counter()
        with claimed(out):
            # names, not paths: the dataset is the same wherever it is made
            study_room.create_store(
                out, scenario_room.load(Path(bases[0])), n, frames, seed, [Path(b).name for b in bases]
            )
            tasks = [
                study_room.Task(
                    f"{i:07d}",
                    {"store": str(out.resolve()), "bases": bases, "index": i, "seed": seed, "frames": frames},
                )
                for i in range(n)
            ]
            with Progress(
                TextColumn("samples"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
                console=Console(stderr=True), transient=True, disable=json_,
            ) as bar:  # fmt: skip
                line = bar.add_task("samples", total=n)
                outcome = study_room.sweep(
                    study_room.make_sample, tasks, out / "tasks", workers=workers, scheduler=scheduler,
                    report=lambda name: bar.advance(line),
                )  # fmt: skip
        seconds = perf_counter() - began
    made = n - outcome.resumed - len(outcome.failed)
    report = {
        "samples": n,
        "made": made,
        "resumed": outcome.resumed,
        "failed": outcome.failed,
        "seconds": seconds,
        "samples_per_second": made / seconds,
        "largest_mm": max((r["largest_mm"] for r in outcome.results.values()), default=0.0),
    }
    study_room.write_summary(out, report)
    if json_:
        json.dump(report, sys.stdout, indent=1)
        print()
    else:
        Console().print(
            f"{made} samples of {frames} frames in {seconds:.1f} s ({made / seconds:.2f} per second), {outcome.resumed} were "
            f"there; results in {out}"
        )
    if outcome.failed:
        name, why = next(iter(outcome.failed.items()))
        raise InputError(f"{len(outcome.failed)} of {n} samples failed; {name}: {why}")
