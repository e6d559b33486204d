"""The Typer application; every command has a file of its own and is registered here."""

from __future__ import annotations

import sys

import typer

from echospline.cli.bench import bench
from echospline.cli.dataset import dataset
from echospline.cli.exvivo import exvivo
from echospline.cli.identify import identify
from echospline.cli.info import info
from echospline.cli.link import link
from echospline.cli.live import live
from echospline.cli.phantom import phantom
from echospline.cli.reconstruct import reconstruct_command
from echospline.cli.recorded import recorded
from echospline.cli.sessions import sessions
from echospline.cli.simulate import demo, simulate
from echospline.cli.study import study
from echospline.cli.track import track
from echospline.errors import EchosplineError

app = typer.Typer(
    name="echospline",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Simulate, in real time, how an ultrasound image deforms while a needle is pushed into the tissue.",
)


app.command()(simulate)
app.command()(demo)
app.command()(info)
app.command()(bench)
app.command()(identify)
studies = typer.Typer()
studies.callback(invoke_without_command=True)(study)
studies.command()(exvivo)
app.add_typer(studies, name="study")
app.command()(live)
app.add_typer(sessions, name="sessions")
app.command()(link)
app.command()(recorded)
app.command("reconstruct")(reconstruct_command)
app.command()(phantom)
app.command()(track)
app.command()(dataset)


def main() -> None:
    """Run the command line; bad input ends with one sentence on stderr and exit code 2."""
    try:
        app()
    except EchosplineError as error:
        print(f"echospline: {error}", file=sys.stderr)
        raise SystemExit(2) from error
