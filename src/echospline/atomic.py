"""Files that appear whole: a file is written under a temporary name and renamed once it is complete."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from echospline.errors import EchosplineError, InputError


def part_of(path: Path) -> Path:
    """Return the temporary name of a file: in the folder of the final one, so that renaming is one step."""
    return path.with_name(path.name + ".part")


def give_name(part: Path, path: Path) -> None:
    """Sync a whole file or folder to the disk and give it its final name in one step."""
    if part.is_dir():
        # A folder cannot be renamed onto a full one: the old one is renamed first.
        old = path.with_name(path.name + ".old")
        if path.exists():
            os.replace(path, old)
        os.replace(part, path)
        if old.exists():
            shutil.rmtree(old)
        return
    with part.open("rb") as file:
        os.fsync(file.fileno())
    os.replace(part, path)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn errors of the disk and of encoders into one sentence."""
    try:
        yield
    except EchosplineError:
        raise
    except (OSError, ValueError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:160]
        raise InputError(
            f"cannot write {path}: {reason}; check the folder, its permissions and its space"
        ) from error
