"""Notes of the readers, printed by every command that reads a file as `echospline info` prints them."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console


def print_notes(notes: Iterable[str]) -> None:
    """Print each note once, on stderr."""
    console = Console(stderr=True, highlight=False)
    for note in dict.fromkeys(notes):
        console.print(f"note: {note}", markup=False, soft_wrap=True)
