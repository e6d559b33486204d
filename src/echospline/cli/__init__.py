"""The command line: one file per command."""

from echospline.cli.app import main

__all__ = ["main"]
