"""Messages for the page, made from those for the command line: without paths and options."""

from __future__ import annotations

import re
from pathlib import Path

_REMEDIES = (
    ("--spacing", "fill in the size of a pixel in mm"),
    ("spacing=", "fill in the size of a pixel in mm"),
    ("--frame", "save one frame as a picture"),
    ("--region", "cut the picture to its ultrasound part"),
)
"""What stands for an option in a message that asks for it."""
_PRIVATE = re.compile(
    r"--[a-z]|[a-z_]+=|\b[a-z]+(?:\.[a-z_]+)+ =|in Python|raise the limit|\.toml\b|[\\/][\w.~-]+[\\/]|(?:^|\s)~?/\w"
)
"""An option, a keyword argument or key of a scenario, a limit of the command line, or a path."""
NOTHING_LEFT = "this file cannot be read as a picture"


def for_page(text: str, *paths: Path, otherwise: str = NOTHING_LEFT) -> str:
    """Return a message that a person at the page can use.

    Clauses (between ``:`` and ``;``) that hold an option, a keyword or a path are left out; the page's own remedy stands
    for an option that it has.

    Parameters
    ----------
    text : str
        A message of an exception.
    paths : Path
        Files that are called "this file"; longer paths first where one is part of another.
    otherwise : str
        The message if nothing is left.
    """
    for path in paths:
        for name in (str(path.resolve()), str(path), path.name):
            text = text.replace(name, "this file")
    clauses = [clause.strip() for clause in re.split(r"[:;]\s", text)]
    kept = [clause for clause in clauses if clause and not _PRIVATE.search(clause)]
    hidden = " ".join(clause for clause in clauses if _PRIVATE.search(clause))
    remedies = list(dict.fromkeys(remedy for word, remedy in _REMEDIES if word in hidden))
    return ": ".join([*(kept or [otherwise]), *remedies])
