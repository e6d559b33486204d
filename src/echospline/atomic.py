"""Files that appear whole, also when two runs share a folder: temporary names of one's own, and folders held by one run."""

from __future__ import annotations

import os
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from echospline.errors import EchosplineError, InputError

PART = ".part"
"""Last ending of every temporary name."""
LOCK = ".echospline.lock"
"""File that the run holds which writes into a folder; the system lets go of it when the process ends, however it ends."""


def part_of(path: Path) -> Path:
    """Return a temporary name that nobody else has: in the folder of the final one, so that renaming is one step."""
    return path.with_name(f"{path.name}.{secrets.token_hex(4)}{PART}")


def give_name(part: Path, path: Path) -> None:
    """Sync a whole file or folder to the disk and give it its final name in one step."""
    if part.is_dir():
        # A folder cannot be renamed onto a full one: the old one is renamed first.
        old = part.with_name(f"{part.name}.old")
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
def appearing(path: Path) -> Iterator[Path]:
    """Give the block a temporary name for a file; it gets its own when the block ends well, else nothing of it is left.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    part = part_of(path)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
            give_name(part, path)
        finally:
            with suppress(OSError):
                part.unlink(missing_ok=True)


@contextmanager
def second_part(part: Path) -> Iterator[Path]:
    """Give the block a name for the final layout of a temporary file; it is removed if the block fails."""
    whole = part.with_name(f"{part.name.removesuffix(PART)}.whole{PART}")
    try:
        yield whole
    except BaseException:
        with suppress(OSError):
            whole.unlink(missing_ok=True)
        raise


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


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Hold a folder while the block writes into it; it is created if missing.

    Raises
    ------
    InputError
        If another run holds the folder, or it cannot be written.
    """
    path = folder / LOCK
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        file = _held(path)
    if file is None:
        raise InputError(
            f"another run is writing into {folder}: give this one another folder (--out), or wait until that one has ended"
        )
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes no open file: there it stays, empty
            path.unlink()
        os.close(file)


def _held(path: Path) -> int | None:
    """Open and lock a file; None where another process has it."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _lock(file)
            if os.path.samestat(os.fstat(file), os.stat(path)):
                return file
        except (BlockingIOError, PermissionError):
            os.close(file)
            return None
        except FileNotFoundError:
            pass  # the run that had it has just removed it
        except BaseException:
            os.close(file)
            raise
        os.close(file)


def _lock(file: int) -> None:
    """Lock an open file for this process, or raise at once."""
    if sys.platform == "win32":
        import msvcrt  # noqa: PLC0415

        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl  # noqa: PLC0415

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
