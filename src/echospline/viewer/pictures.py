"""Uploaded pictures, stored beside the sessions that were recorded in them."""

from __future__ import annotations

import json
import re
import secrets
import threading
import time
from collections import Counter
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
        Of its scene: the first 16 digits of its pack's SHA-256, hexadecimal.
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
        self._held: Counter[Path] = Counter()
        self._lock = threading.RLock()

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

    def keep(self, part: Path, digest: str, suffix: str) -> Path:
        """Give a received file its name, and hold it until it is released.

        Parameters
        ----------
        part : Path
            From `part`.
        digest : str
            SHA-256 of the content, hexadecimal.
        suffix : str
            Ending of the file's name, with its dot.
        """
        path = self.folder / f"{digest[:32]}{suffix}"
        with self._lock:
            self._held[path] += 1
            part.replace(path)
        return path

    def record(self, name: str, path: Path, spacing: tuple[float, float] | None) -> Picture:
        """Record that a file, as it was opened with a spacing, is the scene of this name."""
        record = self.part()
        record.write_text(json.dumps({"file": path.name, "spacing": spacing}), encoding="utf-8")
        record.replace(self._record(name))
        return Picture(name, path, spacing)

    def release(self, path: Path) -> None:
        """End a hold; a file that no scene shows is deleted."""
        with self._lock, suppress(OSError):
            self._held[path] -= 1
            if self._held[path] <= 0:
                del self._held[path]
                self._delete_unshown(path)

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
        with self._lock, suppress(OSError):
            self._record(name).unlink(missing_ok=True)
            if picture is not None and picture.path not in self._held:
                self._delete_unshown(picture.path)

    def _delete_unshown(self, path: Path) -> None:
        if path not in {picture.path for picture in self._all()}:
            path.unlink(missing_ok=True)

    def prune(self, needed: Callable[[str], bool], most: int) -> None:
        """Delete the oldest pictures that nothing needs, beyond so many."""
        with suppress(OSError):
            unused = [picture.name for picture in self._all() if not needed(picture.name)]
            unused.sort(key=lambda name: self._record(name).stat().st_mtime)
            for name in unused[: max(0, len(unused) - most)]:
                self.drop(name)

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
            shown = {picture.path for picture in self._all()}
            for part in self.folder.glob("*"):
                if part not in shown and part.suffix != ".json" and now - part.stat().st_mtime > KEPT_UNUSED:
                    part.unlink(missing_ok=True)

    def _all(self) -> list[Picture]:
        found = (self.find(record.stem) for record in self.folder.glob("*.json"))
        return [picture for picture in found if picture is not None]

    def _record(self, name: str) -> Path:
        return self.folder / f"{name}.json"
