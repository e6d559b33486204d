"""``echospline bench``: time of a step and a frame on this machine."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from echospline import mechanics
from echospline import study as study_room


def bench(
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON rows (times in ms) instead of a table.")
    ] = False,
) -> None:
    """Time steps and frames on this machine, against the display's 60 Hz and the haptic 1 kHz; under a minute."""
    from rich.console import Console
    from rich.table import Table
    from threadpoolctl import threadpool_limits

    say = Console(stderr=True, highlight=False)
    with say.status("…") as status, threadpool_limits(1):
        rows = study_room.benchmark(status.update)
    if as_json:
        print(json.dumps([row.as_json() for row in rows], indent=2))
        return
    core = mechanics.describe_core()
    table = Table(box=None, pad_edge=False, title="times in ms; step: from needle pose to mesh displacement")
    table.add_column("what", no_wrap=True)
    for name in ("nodes", "median", "p99", "per s", "x limit", "60 Hz", "1 kHz"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            row.name,
            f"{row.nodes}",
            f"{row.median_ms:.3f}",
            f"{row.p99_ms:.3f}",
            f"{1000 / row.median_ms:.0f}",
            f"{row.ratio_to_limit:.1f}",
            "yes" if row.p99_ms < 1000 / 60 else "no",
            "-" if row.name.startswith("frame") else ("yes" if row.p99_ms < 1 else "no"),
        )
    console = Console(highlight=False)
    console.print(f"core {core['version']}, level {core['level']}, one thread")
    console.print(table)
    console.print(
        "60 Hz, 1 kHz: whether 99 of 100 fit. x limit: median against the bare float32\n"
        "product of the landmarks and the mesh, which is one read of the response;\n"
        "of a frame, against cv2.remap of the same picture.\n"
        "step at, contact change: in the core alone.\n"
        "frame: step, inverse map, warp and needle of 512 x 512 pixels.",
        markup=False,
    )
