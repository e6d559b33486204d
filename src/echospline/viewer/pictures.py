"""Uploaded pictures, stored beside the sessions that were recorded in them."""

from __future__ import annotations

import hashlib
import json
import re
import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from echospline.errors import InputError

NAME = re.compile(r"[0-9a-f]{16}")
"""Names of uploaded scenes."""
KEPT_UNUSED = 24 * 3600.0
"""s; a picture without a session is deleted when a server starts later than this after the upload."""


@dataclass(frozen=True)
class Picture:
    """An uploaded file.

    Parameters
    ----------
    name : str
        Of its scene: 16 hexadecimal digits that follow from content and spacing.
    path : Path
        The stored file.
    spacing : (lateral, depth) or None
        mm, as given with the upload.
    """

    name: str
    path: Path
    spacing: tuple[float, float] | None


class Pictures:
    """A folder of uploaded files, named by their content, each with a record of its spacing.

    Parameters
    ----------
    folder : Path
        Created at the first upload.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def part(self) -> Path:
        """Return the path of a new file to receive into.

        Raises
        ------
        InputError
            If the folder cannot be made.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"uploads cannot be stored here ({error.strerror})") from error
        return self.folder / f"receiving-{secrets.token_hex(8)}"

    def keep(self, part: Path, digest: str, suffix: str, spacing: tuple[float, float] | None) -> Picture:
        """Give a received file its name, and record its spacing.

        Parameters
        ----------
        part : Path
            From `part`.
        digest : str
            SHA-256 of the content, hexadecimal.
        suffix : str
            Ending of the file's name, with its dot.
        spacing : (lateral, depth) or None
            mm.
        """
        name = hashlib.sha256(f"{digest} {spacing}".encode()).hexdigest()[:16]
        path = self.folder / f"{digest[:32]}{suffix}"
        part.replace(path)
        record = self.part()
        record.write_text(json.dumps({"file": path.name, "spacing": spacing}), encoding="utf-8")
        record.replace(self._record(name))
        return Picture(name, path, spacing)

    def find(self, name: str) -> Picture | None:
        """Return the picture of a scene, if it is stored."""
        if not NAME.fullmatch(name):
            return None
        try:
            record = json.loads(self._record(name).read_text(encoding="utf-8"))
            path = self.folder / Path(str(record["file"])).name
            given = record["spacing"]
            spacing = None if given is None else (float(given[0]), float(given[1]))
        except (OSError, ValueError, KeyError, TypeError, IndexError):
            return None
        return Picture(name, path, spacing) if path.is_file() else None

    def drop(self, name: str) -> None:
        """Forget a scene, and delete its file unless another scene shows it."""
        picture = self.find(name)
        with suppress(OSError):
            self._record(name).unlink(missing_ok=True)
            if picture is not None and picture.path not in {p.path for p in self._all()}:
                picture.path.unlink(missing_ok=True)

    def sweep(self, needed: Callable[[str], bool], now: float | None = None) -> None:
        """Delete old files that nothing needs.

        Parameters
        ----------
        needed : callable
            Returns whether a session was recorded in the scene of this name.
        now : float, optional
            Seconds since 1970.
        """
        now = time.time() if now is None else now
        with suppress(OSError):
            for picture in self._all():
                if now - picture.path.stat().st_mtime > KEPT_UNUSED and not needed(picture.name):
                    self.drop(picture.name)
            for part in self.folder.glob("receiving-*"):
                if now - part.stat().st_mtime > KEPT_UNUSED:
                    part.unlink(missing_ok=True)

    def _all(self) -> list[Picture]:
        found = (self.find(record.stem) for record in self.folder.glob("*.json"))
        return [picture for picture in found if picture is not None]

    def _record(self, name: str) -> Path:
        return self.folder / f"{name}.json"
