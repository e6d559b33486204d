"""The file of sessions: its tables, and how a file of an older version is brought up to date in one transaction."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from echospline.errors import InputError

SCHEMA_VERSION = 4
WAITING = 20.0
"""s that a process waits for others that write to the same file."""
_TABLE = """
CREATE TABLE session (
  id INTEGER PRIMARY KEY AUTOINCREMENT, -- a number is never given twice, also when a session is deleted
  started TEXT NOT NULL,      -- UTC, ISO 8601
  trainee TEXT NOT NULL,
  exercise TEXT NOT NULL,     -- name
  definition TEXT NOT NULL,   -- the exercise as JSON: it can be scored again when the scenario is gone
  scene TEXT NOT NULL,        -- title
  source TEXT NOT NULL DEFAULT '', -- what the scene was made from (a scenario as JSON), where the server made it
  model TEXT NOT NULL,
  score TEXT NOT NULL,        -- JSON; of the stored trace, by this program
  trace BLOB NOT NULL,
  picture TEXT NOT NULL DEFAULT '', -- SHA-256 of the pixels
  upload TEXT NOT NULL DEFAULT '',  -- name of the stored picture, empty for the scene that the server began with
  attempt INTEGER NOT NULL,   -- counted here, from 1, per trainee, exercise and scene
  told INTEGER,               -- the number that the page gave it
  examination INTEGER NOT NULL DEFAULT 0,
  ended TEXT NOT NULL DEFAULT 'finished', -- finished, reset or time
  events TEXT NOT NULL DEFAULT '[]',      -- JSON: [[step, kind], ...]
  planes TEXT NOT NULL DEFAULT '', -- base64, as a page exports them: where a probe was that moved; empty in the plane
  version TEXT NOT NULL DEFAULT '', -- of echospline, whose page recorded it
  core TEXT NOT NULL DEFAULT '',    -- SHA-256 of the WebAssembly
  pack TEXT NOT NULL DEFAULT '',    -- SHA-256 of the scene's bytes
  verified INTEGER,                 -- 1: run again, every number the same; 0: not the same; NULL: recorded here, nothing to compare
  difference TEXT NOT NULL DEFAULT '', -- of one that is not verified
  expert INTEGER NOT NULL DEFAULT 0,   -- 1: a benchmark
  digest TEXT NOT NULL DEFAULT '',     -- SHA-256 of a session that came from a page, which is stored once
  owner TEXT NOT NULL DEFAULT ''       -- SHA-256 of the key of the browser that sent it
)
"""
_INDICES = (
    "CREATE UNIQUE INDEX session_digest ON session (digest) WHERE digest <> ''",
    "CREATE INDEX session_attempt ON session (trainee, exercise, scene)",
    "CREATE INDEX session_owner ON session (owner) WHERE owner <> ''",
)
_SINCE_1 = "id, started, trainee, exercise, definition, scene, source, model, score, trace"


def prepare(path: Path) -> None:
    """Create a file of sessions, or bring an older one up to date.

    Several processes may do so at once: one does it, the others wait. A process that is killed leaves the file as it was.

    Raises
    ------
    InputError
        If the file holds something else, or was written by a newer version.
    OSError, sqlite3.Error
        If it cannot be opened or written.
    """
    with opened(path) as database:
        with _transaction(database, "DEFERRED"):  # number and tables of one moment, while others may be at it
            if _version(database, path) == SCHEMA_VERSION:
                return
        _log_ahead(database)
        with written(database):
            version = _version(database, path)  # another process may have been quicker
            if version == SCHEMA_VERSION:
                return
            if version == 0:
                database.execute("DROP TABLE IF EXISTS session")  # empty: see _version
                database.execute(_TABLE)
            else:
                _migrate(database, version, path)
            for index in _INDICES:
                database.execute(index)
            database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a file; transactions are begun by `written` alone, and what is deleted is overwritten."""
    database = sqlite3.connect(path, timeout=WAITING, isolation_level=None)
    try:
        database.execute("PRAGMA secure_delete = ON")
        yield database
    finally:
        database.close()


@contextmanager
def written(database: sqlite3.Connection) -> Iterator[None]:
    """Write in one transaction, after waiting for other writers."""
    with _transaction(database, "IMMEDIATE"):
        yield


@contextmanager
def _transaction(database: sqlite3.Connection, kind: Literal["DEFERRED", "IMMEDIATE"]) -> Iterator[None]:
    database.execute(f"BEGIN {kind}")
    try:
        yield
    except BaseException:
        database.execute("ROLLBACK")
        raise
    database.execute("COMMIT")


def _version(database: sqlite3.Connection, path: Path) -> int:
    """Return the schema of a file, 0 for an empty one.

    Raises
    ------
    InputError
        If it is none of ours.
    """
    (version,) = database.execute("PRAGMA user_version").fetchone()
    if version > SCHEMA_VERSION:
        raise InputError(
            f"{path} was written by a newer version (schema {version}, this one knows up to {SCHEMA_VERSION}): "
            "update echospline, or choose another file with --sessions"
        )
    tables = {
        name
        for (name,) in database.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
        )
    }
    # An older version that was killed while it made its file left an empty table and no number.
    begun = version == 0 and (
        not tables
        or (tables == {"session"} and not database.execute("SELECT 1 FROM session LIMIT 1").fetchone())
    )
    if version < 0 or (version > 0 and "session" not in tables) or (version == 0 and not begun):
        raise InputError(
            f"{path} is a database of something else, not of sessions; choose another file with --sessions"
        )
    return int(version)


def _log_ahead(database: sqlite3.Connection) -> None:
    """Let readers and a writer work side by side; this waits for others by itself, because SQLite does not here."""
    until = time.monotonic() + WAITING
    while True:
        try:
            database.execute("PRAGMA journal_mode = WAL")
        except sqlite3.OperationalError:
            if time.monotonic() > until:
                raise
            time.sleep(0.02)
        else:
            return


def _migrate(database: sqlite3.Connection, version: int, path: Path) -> None:
    """Copy the rows of schema 1, 2 or 3 into the present table; attempts are counted in the order of their numbers."""
    database.execute("ALTER TABLE session RENAME TO session_before")
    database.execute(_TABLE)
    kept = _SINCE_1 + (", picture, upload" if version >= 2 else "")
    database.execute(
        f"INSERT INTO session ({kept}, attempt) "
        f"SELECT {kept}, row_number() OVER (PARTITION BY trainee, exercise, scene ORDER BY id) FROM session_before"
    )
    if version >= 3:
        imported = database.execute(
            "SELECT id, verified, made, digest FROM session_before WHERE made <> '' OR verified <> ''"
        ).fetchall()
        for number, verified, made, digest in imported:
            try:
                known = json.loads(made or "{}")
            except ValueError:
                raise InputError(
                    f"session {number} in {path} is damaged: what made it is no JSON; choose another file with --sessions"
                ) from None
            _add_origin(database, number, verified, known, digest)
    database.execute("DROP TABLE session_before")


def _add_origin(
    database: sqlite3.Connection, number: int, verified: str, made: dict[str, Any], digest: str
) -> None:
    """Write what schema 3 kept as one text into the columns of its own."""
    database.execute(
        "UPDATE session SET verified = ?, difference = ?, told = ?, examination = ?, ended = ?, events = ?, version = ?, core = ?, "
        "pack = ?, digest = ? WHERE id = ?",
        (
            1 if verified == "yes" else 0, "" if verified == "yes" else verified, made.get("attempt"),
            int(bool(made.get("examination"))), made.get("ended", "finished"), json.dumps(made.get("events", [])),
            made.get("version", ""), made.get("core", ""), made.get("pack", ""), digest, number,
        ),
    )  # fmt: skip
