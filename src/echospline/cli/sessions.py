"""``echospline sessions``: list, learning curves, export, import, benchmarks, deletion; score a session again, make its cine."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echospline import live as live_room
from echospline import page as page_room
from echospline import scenario as scenario_room
from echospline import viewer
from echospline.atomic import appearing, claimed
from echospline.cli.live import default_sessions
from echospline.cli.options import LOOKS, say
from echospline.errors import EchosplineError, InputError

if TYPE_CHECKING:
    from rich.table import Table

sessions = typer.Typer(
    **LOOKS,
    no_args_is_help=True,
    help="Training sessions: list, learning curves, export, import, score again, make a cine.",
)

Kept = Annotated[
    Path | None, typer.Option("--sessions", help="file of sessions; by default in the user's data folder")
]
Number = Annotated[int, typer.Argument(min=1, metavar="SESSION", help="number in the list")]
Trainee = Annotated[str | None, typer.Option(help="of this trainee alone")]
ExerciseName = Annotated[str | None, typer.Option("--exercise", help="of this exercise alone")]
KEYFRAMES_PER_SECOND = 60.0


@sessions.command("list")
def list_(
    trainee: Trainee = None,
    exercise: ExerciseName = None,
    kept: Kept = None,
    json_: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """List the sessions, newest first."""
    from rich.console import Console

    found = _of(_open(kept).newest(1_000_000), trainee, exercise)
    if json_:
        print(json.dumps([session.to_dict() for session in found], indent=2))
        return
    columns = (
        "no.",
        "started (UTC)",
        "trainee",
        "exercise",
        "attempt",
        "model",
        "result",
        "tip mm",
        "time s",
        "verified",
    )
    table = _table(f"{len(found)} sessions", columns)
    for s in found:
        error = s.score["final_error"]
        result = ("passed" if s.score["passed"] else "not passed") + {
            "reset": ", reset",
            "time": ", time up",
        }.get(s.ended, "")
        table.add_row(
            str(s.id), s.started[:16].replace("T", " "), _printable(s.trainee) + (" (expert)" if s.expert else ""),
            _printable(s.exercise), str(s.attempt), _printable(s.model), result, "-" if error is None else f"{error:.2f}",
            f"{s.score['time']:.1f}", {True: "yes", False: "no", None: "-"}[s.verified],
        )  # fmt: skip
    Console().print(table, markup=False)
    for s in found:
        if s.difference:
            print(f"{s.id} does not count: {_printable(s.difference)}")


@sessions.command()
def curve(
    trainee: Trainee = None,
    exercise: ExerciseName = None,
    acceptable: Annotated[float, typer.Option(help="failure rate of a proficient trainee")] = 0.1,
    unacceptable: Annotated[float, typer.Option(help="failure rate of one who is not")] = 0.4,
    attempts: Annotated[int, typer.Option(help="attempts over which the risk is meant")] = 30,
    risk: Annotated[
        float, typer.Option(help="largest probability that one who is not proficient passes within them")
    ] = 0.05,
    kept: Kept = None,
    json_: Annotated[bool, typer.Option("--json", help="print JSON, every curve whole")] = False,
) -> None:
    """Show learning curves: who is proficient at which exercise, since which attempt (LC-CUSUM), beside the group's median and experts.

    Every attempt that is verified counts, also one that was ended by Reset; --trainee leaves the group's median as it is.
    """
    from rich.console import Console

    criterion = viewer.Criterion(acceptable, unacceptable, attempts, risk)
    answer = viewer.class_answer(_of(_open(kept).every(), None, exercise), criterion)
    if trainee is not None:
        for group in answer["curves"]:
            group["trainees"] = [one for one in group["trainees"] if one["trainee"] == trainee]
        answer["sessions"] = [one for one in answer["sessions"] if one["trainee"] == trainee]
    if json_:
        print(json.dumps(answer, indent=2))
        return
    threshold = criterion.threshold
    columns = (
        "trainee",
        "attempts",
        "passed",
        f"LC-CUSUM (of {threshold:.2f})",
        "median",
        "last tip mm",
        "expert mm",
        "proficient",
    )
    for group in answer["curves"]:
        table = _table(f"{_printable(group['exercise'])}, {_printable(group['scene'])}", columns)
        level = group["expert"]["metrics"].get("final_error")
        for one in group["trainees"]:
            last = len(one["values"])
            middle = group["median"]["values"][last - 1]
            table.add_row(
                _printable(one["trainee"]) or "nobody", str(last), str(sum(one["successes"])), f"{one['values'][-1]:.2f}",
                f"{middle:.2f}", _shown(one["metrics"]["final_error"][-1]), _shown(level),
                "not yet" if one["passed_at"] is None else f"since attempt {one['passed_at']}",
            )  # fmt: skip
        Console().print(table, markup=False)
    say(
        [
            f"one who fails {unacceptable:.0%} of the attempts passes within {attempts} with a probability of "
            f"{criterion.passing(unacceptable):.1%}, one who fails {acceptable:.0%} with {criterion.passing(acceptable):.1%}"
        ],
        "note",
    )


@sessions.command()
def export(
    out: Annotated[Path, typer.Argument(metavar="FILE", help="FILE.csv, or FILE.json for a page")],
    number: Annotated[
        int | None,
        typer.Option("--session", min=1, help="this one alone; as CSV its trace, instead of the list"),
    ] = None,
    curves: Annotated[
        bool, typer.Option("--curves", help="as CSV the learning curves, one row an attempt")
    ] = False,
    trainee: Trainee = None,
    exercise: ExerciseName = None,
    kept: Kept = None,
) -> None:
    """Write the sessions as CSV, or as the JSON that a page and `echospline sessions import` read, with every motion."""
    kind = out.suffix.lower()
    if kind not in (".csv", ".json") or (curves and (number is not None or kind == ".json")):
        raise InputError(
            "sessions are written as FILE.csv or FILE.json, and curves as FILE.csv of all sessions; "
            f"got {out.name}{' with --curves' if curves else ''}"
        )
    stored = _open(kept)
    if kind == ".json":
        text = _page_file(
            stored, _of(stored.every(), trainee, exercise) if number is None else [stored.load(number)[0]]
        )
    elif number is not None:
        text = viewer.trace_csv(stored.load(number)[2])
    elif curves:
        text = viewer.curves_csv(
            viewer.class_answer(_of(stored.every(), trainee, exercise), viewer.Criterion())
        )
    else:
        text = viewer.sessions_csv(_of(stored.every(), trainee, exercise))
    with appearing(out) as part:
        part.write_text(text, encoding="utf-8", newline="")


def _page_file(stored: viewer.Sessions, chosen: list[viewer.Session]) -> str:
    """Return sessions as a page reads them; those that no page recorded are left out, and that is said."""
    with_page = [session for session in chosen if session.pack]
    without = len(chosen) - len(with_page)
    if without:
        say(
            [
                f"{without} of {len(chosen)} sessions were not recorded by a page and are left out: write them as CSV"
            ]
        )
    return viewer.sessions_file([viewer.session_file(*stored.load(session.id)) for session in with_page])


@sessions.command()
def expert(
    numbers: Annotated[list[int], typer.Argument(min=1, metavar="SESSION...", help="numbers in the list")],
    off: Annotated[bool, typer.Option("--off", help="make them trainees' sessions again")] = False,
    kept: Kept = None,
) -> None:
    """Make sessions benchmarks: their level is shown beside every curve, and trainees may replay them, without a name."""
    _open(kept).mark_expert(numbers, not off)
    print(f"{len(numbers)} sessions are {'trainees' if off else 'benchmarks'} now")


@sessions.command()
def delete(
    numbers: Annotated[
        list[int] | None, typer.Argument(min=1, metavar="SESSION...", help="numbers in the list")
    ] = None,
    trainee: Annotated[str | None, typer.Option(help="all sessions of this trainee instead")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="do not ask")] = False,
    kept: Kept = None,
) -> None:
    """Delete sessions for good, by their numbers or all of a trainee."""
    if bool(numbers) == (trainee is not None):
        raise InputError("sessions are deleted by their numbers or with --trainee NAME, one of both")
    stored = _open(kept)
    chosen = numbers or [session.id for session in stored.every() if session.trainee == trainee]
    if not chosen:
        raise InputError(f"{trainee!r} has no sessions in {stored.path}")
    if not yes and not typer.confirm(f"Delete {len(chosen)} sessions for good?"):
        raise typer.Exit(1)
    stored.delete(chosen)
    print(f"{len(chosen)} sessions deleted")


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
        known = stored.keep(found)
        sound += known.verified
        said = _printable(known.difference) or "verified"
        print(f"{head}: {said}: stored {'as' if known.new else 'before as'} {known.number}")
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


def _of(sessions: list[viewer.Session], trainee: str | None, exercise: str | None) -> list[viewer.Session]:
    return [s for s in sessions if trainee in (None, s.trainee) and exercise in (None, s.exercise)]


def _table(title: str, columns: tuple[str, ...]) -> Table:
    from rich.box import SIMPLE
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=SIMPLE, pad_edge=False, padding=(0, 1, 0, 0))
    for name in columns:
        table.add_column(name)
    return table


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _open(kept: Path | None, *, new: bool = False) -> viewer.Sessions:
    path = kept or default_sessions()
    if not new and not path.exists():
        raise InputError(f"there are no sessions in {path}: finish an exercise in `echospline live` first")
    return viewer.Sessions(path)
