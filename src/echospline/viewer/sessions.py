"""Training sessions in SQLite: each written in one transaction, listed with progress, exported as CSV."""

from __future__ import annotations

import csv
import io
import json
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from echospline.errors import InputError
from echospline.live import Trace
from echospline.viewer.exercise import Exercise
from echospline.viewer.pictures import Pictures
from echospline.viewer.scoring import Score

SCHEMA_VERSION = 3
_SCHEMA = """
CREATE TABLE IF NOT EXISTS session (
  id INTEGER PRIMARY KEY,
  started TEXT NOT NULL,      -- UTC, ISO 8601
  trainee TEXT NOT NULL,
  exercise TEXT NOT NULL,     -- name
  definition TEXT NOT NULL,   -- the exercise as JSON: it can be scored again when the scenario is gone
  scene TEXT NOT NULL,        -- title
  source TEXT NOT NULL,       -- what the scene was made from (a scenario as JSON)
  model TEXT NOT NULL,
  score TEXT NOT NULL,        -- JSON
  trace BLOB NOT NULL,
  picture TEXT NOT NULL DEFAULT '', -- SHA-256 of the pixels, empty in sessions of schema 1
  upload TEXT NOT NULL DEFAULT '',  -- name of the stored picture, empty for the scene that the server began with
  verified TEXT NOT NULL DEFAULT '', -- of an imported session: "yes", or how it differs from what its page said
  made TEXT NOT NULL DEFAULT '',    -- of an imported session, JSON: what made it, its attempt, how it ended
  digest TEXT NOT NULL DEFAULT ''   -- SHA-256 of an imported session, so that it is stored once
)
"""
_ADDED = {2: ("picture", "upload"), 3: ("verified", "made", "digest")}
"""Columns that came with a schema."""
_COLUMNS = "id, started, trainee, exercise, scene, model, source, score, picture, upload, verified, made"


@dataclass(frozen=True)
class Session:
    """One row of the list; `score` has the fields of `Score`, and `verified` and `made` are those of an `Import`."""

    id: int
    started: str
    trainee: str
    exercise: str
    scene: str
    model: str
    source: str
    score: dict[str, Any]
    picture: str = ""
    upload: str = ""
    verified: str = ""
    made: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, without the source."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "source"}


@dataclass(frozen=True)
class Import:
    """What is known of a session that a page recorded on its own.

    Parameters
    ----------
    started : str
        UTC, ISO 8601.
    verified : str
        "yes", or how it differs from what its page said.
    made : dict
        Plain values: what made it, its attempt, how it ended.
    digest : str
        SHA-256 of the session; a session is stored once.
    """

    started: str
    verified: str
    made: dict[str, Any]
    digest: str


class Sessions:
    """A file of sessions; every call opens it anew, so any thread may call and a killed process leaves it whole.

    Parameters
    ----------
    path : Path
        Created with its folder if missing.

    Raises
    ------
    InputError
        If the file cannot be opened or is not such a file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.pictures = Pictures(path.with_name(f"{path.stem}-pictures"))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with self._open() as database:
                (version,) = database.execute("PRAGMA user_version").fetchone()
                if version not in range(SCHEMA_VERSION + 1):
                    raise InputError(
                        f"{path} was written by another version (schema {version}, this one knows {SCHEMA_VERSION}); "
                        "choose another file with --sessions"
                    )
                database.execute("PRAGMA journal_mode = WAL")
                database.execute(_SCHEMA)
                for schema in range(version + 1, SCHEMA_VERSION + 1) if version else ():
                    for column in _ADDED[schema]:
                        database.execute(f"ALTER TABLE session ADD COLUMN {column} TEXT NOT NULL DEFAULT ''")
                database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        except (OSError, sqlite3.Error) as error:
            raise InputError(
                f"cannot keep sessions in {path}: {error}; choose another file with --sessions"
            ) from error

    def add(
        self,
        exercise: Exercise,
        trace: Trace,
        score: Score,
        *,
        trainee: str,
        scene: str,
        model: str,
        source: str = "",
        picture: str = "",
        upload: str = "",
        imported: Import | None = None,
    ) -> int:
        """Store a session in one transaction; returns its id."""
        known = imported or Import(datetime.now(UTC).isoformat(timespec="seconds"), "", {}, "")
        row = (
            known.started, trainee, exercise.name,
            exercise.model_dump_json(), scene, source, model, json.dumps(score.to_dict()), trace.to_bytes(),
            picture, upload, known.verified, json.dumps(known.made) if known.made else "", known.digest,
        )  # fmt: skip
        with self._open() as database:
            cursor = database.execute(
                "INSERT INTO session (started, trainee, exercise, definition, scene, source, model, score, trace, "
                "picture, upload, verified, made, digest) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                row,
            )
            assert cursor.lastrowid is not None  # an INSERT has one
            return cursor.lastrowid

    def newest(self, limit: int = 500) -> list[Session]:
        """Return the newest sessions, newest first."""
        with self._open() as database:
            rows = database.execute(f"SELECT {_COLUMNS} FROM session ORDER BY id DESC LIMIT ?", (limit,))
            return [_session(row) for row in rows]

    def number_of(self, digest: str) -> int | None:
        """Return the number of the imported session of this SHA-256; None where it is not stored."""
        with self._open() as database:
            found = database.execute("SELECT id FROM session WHERE digest = ? LIMIT 1", (digest,)).fetchone()
        return None if found is None else int(found[0])

    def needs(self, upload: str) -> bool:
        """Test whether a session was recorded in the uploaded picture of this name."""
        with self._open() as database:
            found = database.execute("SELECT 1 FROM session WHERE upload = ? LIMIT 1", (upload,)).fetchone()
        return found is not None

    def load(self, number: int) -> tuple[Session, Exercise, Trace]:
        """Read one session with its exercise and trace.

        Raises
        ------
        InputError
            If there is none with this number, or it is damaged.
        """
        with self._open() as database:
            row = database.execute(
                f"SELECT {_COLUMNS}, definition, trace FROM session WHERE id = ?", (number,)
            ).fetchone()
        if row is None:
            raise InputError(f"there is no session {number} in {self.path}")
        *columns, definition, trace = row
        try:
            exercise = Exercise.model_validate_json(definition)
            return _session(columns), exercise, Trace.from_bytes(trace)
        except (ValidationError, json.JSONDecodeError) as error:
            raise InputError(f"session {number} in {self.path} is damaged: {error}") from error

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        database = sqlite3.connect(self.path, timeout=10.0)
        try:
            with database:
                yield database
        finally:
            database.close()


def _session(columns: Sequence[Any]) -> Session:
    number, started, trainee, exercise, scene, model, source, scored, picture, upload, verified, made = (
        columns
    )
    return Session(
        number, started, trainee, exercise, scene, model, source, json.loads(scored), picture, upload,
        verified, json.loads(made) if made else {},
    )  # fmt: skip


def sessions_csv(sessions: list[Session]) -> str:
    """Write sessions as CSV, one row each, oldest first; units are in the header."""
    units = {"time": "s", "tissue_time": "s", "path_length": "mm", "path_inefficiency": "percent",
             "tissue_damage": "mm2", "smoothness": "mm/s^2.5", "final_error": "mm", "target_shift": "mm"}  # fmt: skip
    names = [f.name for f in fields(Score)]
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(
        ["id", "started", "trainee", "exercise", "scene", "model"]
        + [f"{name} ({units[name]})" if name in units else name for name in names]
        + ["attempt", "verified"]
    )
    for session in reversed(sessions):
        writer.writerow(
            [session.id, session.started, _plain(session.trainee), _plain(session.exercise),
             _plain(session.scene), session.model, *(session.score.get(name) for name in names),
             session.made.get("attempt"), _plain(session.verified)]
        )  # fmt: skip
    return out.getvalue()


def trace_csv(trace: Trace) -> str:
    """Write a session's trace as CSV: time, pose and the deformed target, one row per step."""
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(
        ["time (s)", "entry_x (mm)", "entry_y (mm)", "tip_x (mm)", "tip_y (mm)", "speed (mm/s)",
         "target_x (mm)", "target_y (mm)"]
    )  # fmt: skip
    for time, pose, watched in zip(trace.times, trace.poses, trace.watched, strict=True):
        writer.writerow([f"{time:.6f}", *(f"{v:.6f}" for v in (*pose, *watched[0]))])
    return out.getvalue()


def _plain(text: str) -> str:
    """Quote text that a spreadsheet would read as a formula."""
    return f"'{text}" if text[:1] in "=+-@\t\r" else text
