"""``echospline sessions``: list, export, import and score training sessions again, and make a cine of one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from echospline import live as live_room
from echospline import page as page_room
from echospline import scenario as scenario_room
from echospline import viewer
from echospline.atomic import appearing, claimed
from echospline.cli.live import default_sessions
from echospline.cli.options import LOOKS, say
from echospline.errors import EchosplineError, InputError

sessions = typer.Typer(
    **LOOKS, no_args_is_help=True, help="Training sessions: list, export, import, score again, make a cine."
)

Kept = Annotated[
    Path | None, typer.Option("--sessions", help="file of sessions; by default in the user's data folder")
]
Number = Annotated[int, typer.Argument(min=1, metavar="SESSION", help="number in the list")]
KEYFRAMES_PER_SECOND = 60.0


@sessions.command("list")
def list_(
    kept: Kept = None,
    json_: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """List the sessions, newest first."""
    from rich.console import Console
    from rich.table import Table

    found = _open(kept).newest()
    if json_:
        print(json.dumps([session.to_dict() for session in found], indent=2))
        return
    table = Table(title=f"{len(found)} sessions", title_justify="left")
    for name in (
        "no.",
        "started (UTC)",
        "trainee",
        "exercise",
        "model",
        "result",
        "tip to target mm",
        "time s",
    ):
        table.add_column(name)
    for s in found:
        error = s.score["final_error"]
        table.add_row(
            str(s.id), s.started[:16].replace("T", " "), s.trainee, s.exercise, s.model,
            "passed" if s.score["passed"] else "not passed", "-" if error is None else f"{error:.2f}",
            f"{s.score['time']:.1f}",
        )  # fmt: skip
    Console().print(table, markup=False)


@sessions.command()
def export(
    out: Annotated[Path, typer.Argument(metavar="FILE.csv", help="where to write")],
    number: Annotated[
        int | None, typer.Option("--session", min=1, help="the trace of this one, instead of the list")
    ] = None,
    kept: Kept = None,
) -> None:
    """Write the sessions, or the trace of one, as CSV."""
    stored = _open(kept)
    text = (
        viewer.sessions_csv(stored.newest(1_000_000))
        if number is None
        else viewer.trace_csv(stored.load(number)[2])
    )
    with appearing(out) as part:
        part.write_text(text, encoding="utf-8", newline="")


@sessions.command("import")
def import_(
    file: Annotated[
        Path, typer.Argument(metavar="FILE.json", help="what a page exported: one session or several")
    ],
    pack: Annotated[
        Path | None,
        typer.Option(
            metavar="TRAINER.html", help="the page that they come from; the shipped scene where not given"
        ),
    ] = None,
    kept: Kept = None,
) -> None:
    """Run the sessions of a page again, compare every score with the page's, and store them.

    Each is run by the native core on the page's own scene. A session whose numbers are not those of the page is stored with the difference;
    one of another scene is not stored. Ends with 1 unless every session is verified.
    """
    given = page_room.read_sessions(file)
    scene = None if pack is None else page_room.pack_of_page(pack)
    stored = _open(kept, new=True)
    sound = 0
    for k, session in enumerate(given):
        head = _printable(
            f"{k + 1}. {session.trainee or 'nobody'}, {session.exercise.name}, {session.model}, attempt {session.attempt}"
        )
        try:
            found = page_room.verify(scene or _shipped(session), session)
        except EchosplineError as error:
            print(f"{head}: not stored: {_printable(str(error))}")
            continue
        sound += not found.differences
        said = _printable("; ".join(found.differences)) or "verified"
        number, new = viewer.keep(stored, found)
        print(f"{head}: {said}: stored {'as' if new else 'before as'} {number}")
    print(f"{sound} of {len(given)} sessions verified")
    if sound < len(given):
        raise typer.Exit(1)


def _printable(text: str) -> str:
    """Return text of a file from elsewhere without what would steer a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def _shipped(session: page_room.RecordedSession) -> page_room.Pack:
    """Return the shipped scene as the page of a session may have had it: in the language that gives its pack."""
    scenario, image = scenario_room.Scenario().opened(Path.cwd(), eight_bit=True)
    packs = [
        page_room.packed(scenario, image, Path.cwd(), language=tongue, rate=session.rate)
        for tongue in ("en", "de")
    ]
    return next((pack for pack in packs if pack.digest == session.scene.pack), packs[0])


@sessions.command()
def rescore(number: Number, kept: Kept = None) -> None:
    """Score a stored session again from its trace, and print both scores as JSON."""
    session, exercise, trace = _open(kept).load(number)
    print(json.dumps({"stored": session.score, "now": page_room.score(trace, exercise).to_dict()}, indent=2))


@sessions.command()
def cine(
    number: Number,
    out: Annotated[Path, typer.Option("--out", help="folder for the results")] = Path("out"),
    kept: Kept = None,
) -> None:
    """Run a stored session's needle again: the cine with its true motion, as `echospline simulate` writes it."""
    stored = _open(kept)
    session, _, trace = stored.load(number)
    if not session.source:
        raise InputError(
            f"session {number} does not say what its scene was made from, so it cannot be run again"
        )
    scenario = scenario_room.validated(json.loads(session.source), f"session {number}").with_values(
        {"needle.path": keyframes(trace), "model.kind": session.model}, f"session {number}"
    )
    folder = Path.cwd()
    beside = stored.pictures.folder / Path(scenario.image.file).name
    if (
        session.upload and beside.is_file()
    ):  # the sessions may have been moved, with their pictures beside them
        scenario = scenario.with_values({"image.file": str(beside.resolve())}, f"session {number}")
    scenario, image = scenario.opened(folder, eight_bit=None)
    say([*image.notes, *scenario.label_notes(folder)], "note")
    doubts = scenario_room.check(scenario, image, out)
    say(doubts)
    model = scenario_room.build_model(scenario, scenario.grid(image), folder=folder)
    with claimed(out):
        report = scenario_room.run(scenario, image, model, out, folder, doubts=doubts)
    print(f"results in {out}: {', '.join(report['files'])}")


def keyframes(trace: live_room.Trace) -> list[tuple[float, float, float, float, float]]:
    """Return the rows of time, entry and tip for a scenario's path, at most 60 a second, first and last included."""
    import numpy as np

    if len(trace) < 2:
        raise InputError("this session holds no motion")
    stride = max(1, int(1.0 / (KEYFRAMES_PER_SECOND * trace.period)))
    rows = np.unique([*range(0, len(trace), stride), len(trace) - 1])
    columns = np.column_stack([trace.times, trace.entry, trace.tip])[rows]
    columns[:, 0] -= columns[0, 0]
    return [(float(t), float(ex), float(ey), float(tx), float(ty)) for t, ex, ey, tx, ty in columns]


def _open(kept: Path | None, *, new: bool = False) -> viewer.Sessions:
    path = kept or default_sessions()
    if not new and not path.exists():
        raise InputError(f"there are no sessions in {path}: finish an exercise in `echospline live` first")
    return viewer.Sessions(path)
