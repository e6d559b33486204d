"""Training sessions in SQLite: attempts counted, each written in one transaction with what made it and whether it was verified."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from echospline.errors import InputError
from echospline.live import Trace
from echospline.page import Verified, beyond
from echospline.page.exercise import Exercise
from echospline.page.scoring import Score
from echospline.viewer.pictures import Pictures
from echospline.viewer.session_schema import opened, prepare, written

_COLUMNS = (
    "id, started, trainee, exercise, scene, model, source, score, picture, upload, attempt, told, examination, ended, events, planes, "
    "version, core, pack, verified, difference, expert, owner"
)


@dataclass(frozen=True)
class Session:
    """One stored session, without its trace.

    Parameters
    ----------
    id : int
        Its number.
    started : str
        UTC, ISO 8601.
    trainee, exercise, scene, model : str
        Who, the exercise's name, the scene's title, the model's name.
    source : str
        What the scene was made from, as JSON; empty where a page made it.
    score : dict
        Fields of `Score`.
    picture, upload : str
        SHA-256 of the pixels, and the name of an uploaded picture.
    attempt, told : int, int or None
        Number of the attempt as it was counted here, and as the page gave it.
    examination : bool
        Whether it was recorded without any help.
    ended : {"finished", "reset", "time"}
    events : list of [step, kind]
    planes : str
        Where a probe was that moved, as a page exports it; empty in the plane.
    version, core, pack : str
        What made it: version of echospline, SHA-256 of its core and of the scene.
    verified : bool or None
        Whether a replay gave the page's numbers and no rule was broken; None where there was nothing to compare.
    difference : str
        Why it is not verified.
    expert : bool
        Whether it is a benchmark for others.
    owner : str
        SHA-256 of the key of the browser that sent it.
    """

    id: int
    started: str
    trainee: str
    exercise: str
    scene: str
    model: str
    source: str
    score: dict[str, Any]
    picture: str
    upload: str
    attempt: int
    told: int | None
    examination: bool
    ended: str
    events: list[list[Any]]
    planes: str
    version: str
    core: str
    pack: str
    verified: bool | None
    difference: str
    expert: bool
    owner: str

    @property
    def counts(self) -> bool:
        """Whether it counts for the trainee: all do but those that are not what they say."""
        return self.verified is not False

    @property
    def success(self) -> bool:
        """Whether the exercise was passed and handed in; who resets gives the attempt up."""
        return bool(self.score["passed"]) and self.ended != "reset"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, without the source, the probe's motion and the owner's key."""
        return {
            f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("source", "owner", "planes")
        }


@dataclass(frozen=True)
class Record:
    """What is stored of an attempt beside its motion and score; the fields are those of `Session`.

    Parameters
    ----------
    digest : str
        SHA-256 of a session that came from a page; it is stored once.
    """

    started: str = ""
    ended: str = "finished"
    examination: bool = False
    events: tuple[tuple[int, str], ...] = ()
    planes: str = ""
    told: int | None = None
    version: str = ""
    core: str = ""
    pack: str = ""
    verified: bool | None = None
    difference: str = ""
    digest: str = ""
    owner: str = ""


@dataclass(frozen=True)
class Kept:
    """A session that `Sessions.keep` has stored, now or before.

    Parameters
    ----------
    number, attempt : int
        Of the session; as counted here.
    new : bool
        False where it had been stored before.
    difference : str
        Why it is not verified; empty where it is.
    """

    number: int
    attempt: int
    new: bool
    difference: str

    @property
    def verified(self) -> bool:
        """Whether it is what it says."""
        return not self.difference


class Sessions:
    """A file of sessions; every call opens it anew, so any thread or process may call and a killed one leaves it whole.

    Parameters
    ----------
    path : Path
        Created with its folder if missing; a file of an older version is brought up to date.

    Raises
    ------
    InputError
        If the file cannot be opened, is not such a file or was written by a newer version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.pictures = Pictures(path.with_name(f"{path.stem}-pictures"))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            prepare(path)
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
        record: Record | None = None,
    ) -> int:
        """Store a session in one transaction and count its attempt; returns its number."""
        with self._written() as database:
            return self._insert(
                database, exercise, trace, score, (trainee, scene, model, source, picture, upload),
                record or Record(),
            ).number  # fmt: skip

    def keep(
        self, found: Verified, *, scene: str = "", source: str = "", upload: str = "", owner: str = ""
    ) -> Kept:
        """Store a session that a page recorded and that was run again; a session is stored once.

        Parameters
        ----------
        found : Verified
            From `echospline.page.verify`. Its score is stored, not the page's.
        scene : str
            Title of the scene; what the page says where not given.
        source : str
            What the scene was made from, as JSON; empty where a page made it.
        upload : str
            Name of the uploaded picture that it was recorded in.
        owner : str
            SHA-256 of the key of the browser that sent it.
        """
        session = found.session
        record = Record(
            session.when, session.ended, session.examination, tuple(session.events), session.planes or "", session.attempt, session.version,
            session.core, session.scene.pack, not found.differences, "; ".join(found.differences), session.digest, owner,
        )  # fmt: skip
        person = (session.trainee, scene or session.scene.title, session.model, source, "", upload)
        with self._written() as database:
            before = database.execute(
                "SELECT id, attempt, difference FROM session WHERE digest = ?", (session.digest,)
            ).fetchone()
            if before is not None:
                return Kept(before[0], before[1], False, before[2])
            return self._insert(database, session.exercise, found.trace, found.score, person, record)

    @staticmethod
    def _insert(
        database: sqlite3.Connection,
        exercise: Exercise,
        trace: Trace,
        score: Score,
        person: tuple[str, str, str, str, str, str],
        record: Record,
    ) -> Kept:
        trainee, scene, model, source, picture, upload = person
        (before,) = database.execute(
            "SELECT coalesce(max(attempt), 0) FROM session WHERE trainee = ? AND exercise = ? AND scene = ?",
            (trainee, exercise.name, scene),
        ).fetchone()
        attempt = before + 1
        if exercise.attempts is not None and attempt > exercise.attempts and record.told is not None:
            one_too_many = beyond(attempt, exercise.attempts)
            if one_too_many not in record.difference:
                said = "; ".join(text for text in (record.difference, one_too_many) if text)
                record = replace(record, verified=False, difference=said)
        row = {
            "started": record.started or datetime.now(UTC).isoformat(timespec="seconds"),
            "trainee": trainee, "exercise": exercise.name, "definition": exercise.model_dump_json(), "scene": scene,
            "source": source, "model": model, "score": json.dumps(score.to_dict()), "trace": trace.to_bytes(), "picture": picture,
            "upload": upload, "attempt": attempt, "told": record.told, "examination": int(record.examination), "ended": record.ended,
            "events": json.dumps(record.events), "planes": record.planes, "version": record.version, "core": record.core, "pack": record.pack,
            "verified": None if record.verified is None else int(record.verified), "difference": record.difference,
            "digest": record.digest, "owner": record.owner,
        }  # fmt: skip
        cursor = database.execute(
            f"INSERT INTO session ({', '.join(row)}) VALUES ({', '.join(':' + name for name in row)})", row
        )
        assert cursor.lastrowid is not None  # an INSERT has one
        return Kept(cursor.lastrowid, attempt, True, record.difference)

    def newest(self, limit: int = 500) -> list[Session]:
        """Return the newest sessions, newest first."""
        return self._select("ORDER BY id DESC LIMIT ?", limit)

    def every(self) -> list[Session]:
        """Return all sessions in the order in which they were begun."""
        return self._select("ORDER BY started, id")

    def owned(self, owner: str) -> list[Session]:
        """Return the sessions that a browser sent, and those of experts, in the order in which they were begun."""
        return self._select("WHERE (owner = ? AND owner <> '') OR expert = 1 ORDER BY started, id", owner)

    def find(self, number: int) -> Session | None:
        """Return one session, if there is one with this number."""
        found = self._select("WHERE id = ?", number)
        return found[0] if found else None

    def number_of(self, digest: str) -> int | None:
        """Return the number of the session of this SHA-256 that came from a page; None where it is not stored."""
        with self._opened() as database:
            found = database.execute("SELECT id FROM session WHERE digest = ? LIMIT 1", (digest,)).fetchone()
        return None if found is None else int(found[0])

    def needs(self, upload: str) -> bool:
        """Test whether a session was recorded in the uploaded picture of this name."""
        with self._opened() as database:
            found = database.execute("SELECT 1 FROM session WHERE upload = ? LIMIT 1", (upload,)).fetchone()
        return found is not None

    def load(self, number: int) -> tuple[Session, Exercise, Trace]:
        """Read one session with its exercise and trace.

        Raises
        ------
        InputError
            If there is none with this number, or it is damaged.
        """
        with self._opened() as database:
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

    def mark_expert(self, numbers: Iterable[int], expert: bool) -> None:
        """Make sessions benchmarks, or trainees' sessions again.

        Raises
        ------
        InputError
            If one does not exist; then none is changed.
        """
        self._change("UPDATE session SET expert = :to WHERE id = :number", numbers, {"to": int(expert)})

    def delete(self, numbers: Iterable[int]) -> None:
        """Delete sessions; their bytes are overwritten, and their numbers are not given again.

        Raises
        ------
        InputError
            If one does not exist; then none is deleted.
        """
        self._change("DELETE FROM session WHERE id = :number", numbers, {})

    def _change(self, statement: str, numbers: Iterable[int], values: dict[str, Any]) -> None:
        with self._written() as database:
            for number in numbers:
                if database.execute(statement, {**values, "number": number}).rowcount != 1:
                    raise InputError(f"there is no session {number} in {self.path}; nothing was changed")

    def _select(self, rest: str, *values: object) -> list[Session]:
        with self._opened() as database:
            rows = database.execute(f"SELECT {_COLUMNS} FROM session {rest}", values).fetchall()
        return [_session(row) for row in rows]

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        try:
            with opened(self.path) as database:
                yield database
        except sqlite3.Error as error:
            raise InputError(f"the sessions in {self.path} cannot be read or written: {error}") from error

    @contextmanager
    def _written(self) -> Iterator[sqlite3.Connection]:
        with self._opened() as database, written(database):
            yield database


def _session(columns: Sequence[Any]) -> Session:
    row = dict(zip((f.name for f in fields(Session)), columns, strict=True))
    row["score"], row["events"] = json.loads(row["score"]), json.loads(row["events"])
    row["examination"], row["expert"] = bool(row["examination"]), bool(row["expert"])
    row["verified"] = None if row["verified"] is None else bool(row["verified"])
    return Session(**row)
