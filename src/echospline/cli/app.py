"""The Typer application; every command has a file of its own, which is loaded when the command runs."""

from __future__ import annotations

import os
import sys
import warnings
from importlib import import_module
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperCommand, TyperGroup

from echospline.cli.options import LOOKS
from echospline.errors import EchosplineError

COMMANDS = {
    "simulate": "Push a needle into an ultrasound image and write how it deforms.",
    "demo": "Run the main job on the image that ships with the package: a needle into calf muscle, in and out again.",
    "info": "Describe a file: format, pixels, spacing, size in mm, frames and times, and doubts.",
    "bench": "Time steps and frames on this machine, against the display's 60 Hz and the haptic 1 kHz; under a minute.",
    "identify": "Find the parameters with which a model fits the observed displacement.",
    "study": "Regenerate the paper's study: Fig. 2, 3a, 3b, tables (CSV, JSON) and one self-contained report.html.",
    "live": "Steer the needle in the browser and see the tissue move.",
    "page": "Write a scene as one file that simulates: it opens by a double click, offline, on a laptop or a phone.",
    "sessions": "Training sessions: list, learning curves, export, import, score again, make a cine.",
    "link": "Join the network of 3D Slicer and PLUS: transforms move the needle, the deforming image comes back.",
    "reconstruct": "Make a volume from a tracked sweep: every picture is put where the probe was, and small gaps are filled.",
    "recorded": "Simulate a recorded procedure again and compare every picture with the recorded one.",
    "phantom": "Image a phantom of point scatterers while a needle deforms it.",
    "track": "Track the motion of tissue through a cine.",
    "dataset": "Draw insertions and image them: pictures, true displacement, needle mask and pose, one chunk per sample.",
}
"""Commands in the order of the help, with the first sentence of their own; a test compares them."""
PLACES = {
    "demo": ("simulate", "demo"),
    "reconstruct": ("reconstruct", "reconstruct_command"),
    "study": ("study", "studies"),
}
"""File and name of the commands that are not called as their file."""


MISTAKE: Any = typer.BadParameter.__base__
"""A mistake on the command line (`UsageError`), which Typer does not export under its own name."""


class _Commands(TyperGroup):
    """The commands, listed from the table above and loaded one by one."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        for name, help_ in COMMANDS.items():
            self.commands[name] = TyperCommand(name, help=help_, rich_markup_mode=self.rich_markup_mode)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names in the order of the table."""
        return list(COMMANDS)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Load the command that is called."""
        if args and args[0] in COMMANDS:
            self.commands[args[0]] = loaded(args[0])
        return super().resolve_command(ctx, args)


def loaded(name: str) -> Any:
    """Load the file of a command and return the command."""
    file, attribute = PLACES.get(name, (name, name))
    found = getattr(import_module(f"echospline.cli.{file}"), attribute)
    if not isinstance(found, typer.Typer):
        alone = typer.Typer(**LOOKS)
        alone.command(name, cls=getattr(found, "command_class", None))(found)
        found = alone
    command = typer.main.get_command(found)
    command.name = name
    return command


app = typer.Typer(name="echospline", cls=_Commands, no_args_is_help=True, **LOOKS)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"echospline {version('echospline')}")
        raise typer.Exit


@app.callback()
def echospline(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Simulate, in real time, how an ultrasound image deforms while a needle is pushed into the tissue."""


def _say_warning(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
    """Print what a model warns of as one sentence; of other packages' warnings users can make nothing."""
    if issubclass(category, UserWarning):
        print(f"echospline: doubt: {message}", file=sys.stderr)


def main() -> None:
    """Run the command line; bad input ends with one sentence on stderr and exit code 2.

    A reader that closes the pipe early (``| head``) has what it wanted: the command then ends with 0, quietly.
    """
    warnings.showwarning = _say_warning
    out, file = sys.stdout, _file_of(sys.stdout)
    code: str | int | None
    try:
        code = _run()
    except SystemExit as end:
        code = end.code
    try:
        out.flush()
        # Typer and Rich end with 1 when the pipe is closed, and put another stream or file in its place.
        closed = sys.stdout is not out or _file_of(out) != file
    except BrokenPipeError:
        closed = True
    if closed:
        os.dup2(os.open(os.devnull, os.O_WRONLY), out.fileno())
        code = 0 if code == 1 else code
    raise SystemExit(code)


def _run() -> int:
    """Run the application and return its exit code."""
    try:
        return app(standalone_mode=False) or 0
    except MISTAKE as error:
        context: Any = error.ctx
        message = error.format_message().rstrip(".")
        if message:  # without, the help has been printed
            path = "echospline" if context is None else context.command_path
            print(f"echospline: {message}; {path} --help lists what there is", file=sys.stderr)
        return 2
    except EchosplineError as error:
        print(f"echospline: {error}", file=sys.stderr)
        return 2
    except typer.Abort:
        return 130


def _file_of(stream: TextIO) -> tuple[int, int] | None:
    """Identify the file, pipe or device behind a stream."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino
