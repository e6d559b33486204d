"""What a trainee and what an instructor gets to see of the stored sessions, as JSON and CSV; pure functions of a list of sessions."""

from __future__ import annotations

import base64
import csv
import io
import json
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from echospline.errors import InputError
from echospline.live import Trace
from echospline.page.exercise import Exercise
from echospline.page.scoring import Score
from echospline.viewer.learning_curve import Criterion, Curve, group_median, learning_curve
from echospline.viewer.sessions import Session

METRICS = {
    "final_error": "mm", "time": "s", "tissue_time": "s", "path_length": "mm", "path_inefficiency": "percent", "tissue_damage": "mm2",
    "smoothness": "mm/s^2.5", "redirections": "", "punctures": "", "vessel_contacts": "",
}  # fmt: skip
"""Metrics of which a class is shown curves, with their units; less is better in all."""
_UNITS = {**METRICS, "target_shift": "mm"}
_PRIVATE = ("owner", "source", "picture", "upload", "events")
"""Fields of a session that no list shows."""


def own_answer(sessions: Sequence[Session], owner: str, trainee: str, criterion: Criterion) -> dict[str, Any]:
    """Return what a trainee sees: the sessions of that name that the same browser sent, their curves, and experts and their level without a name.

    Parameters
    ----------
    sessions : sequence of Session
        In the order in which they were begun; others' among them are left out here.
    owner : str
        SHA-256 of the browser's key; empty for one that has none, which has sent nothing.
    trainee : str
        Name under which it trains.
    """
    own = [s for s in sessions if owner and s.owner == owner and s.trainee == trainee and not s.expert]
    return {
        "sessions": [_listed(s) for s in own],
        "experts": [
            {**_listed(s), "trainee": ""} for s in sessions if s.expert
        ],
        "criterion": criterion.to_dict(),
        "curves": [
            _curves(group, criterion, group_too=False)
            for group in _groups([s for s in sessions if s.expert or s in own])
        ],
    }  # fmt: skip


def class_answer(sessions: Sequence[Session], criterion: Criterion) -> dict[str, Any]:
    """Return what an instructor sees: every session, and of every exercise the curves of its trainees, the group's median and the expert's level.

    Parameters
    ----------
    sessions : sequence of Session
        In the order in which they were begun.
    criterion : Criterion
        Of the learning curves.
    """
    return {
        "sessions": [_listed(s) for s in sessions],
        "criterion": criterion.to_dict(),
        "curves": [_curves(group, criterion, group_too=True) for group in _groups(sessions)],
    }


def may_see(session: Session, owner: str) -> bool:
    """Test whether the browser of this key may read a whole session: one that it sent, or an expert's."""
    return session.expert or bool(owner and session.owner == owner)


def session_file(session: Session, exercise: Exercise, trace: Trace, *, named: bool = True) -> dict[str, Any]:
    """Return a session as a page exports it, so that a page can replay it.

    Parameters
    ----------
    session, exercise, trace
        From `Sessions.load`.
    named : bool
        With the trainee's name.

    Raises
    ------
    InputError
        If it does not say in which scene of a page it was recorded.
    """
    if not session.pack:
        raise InputError(
            f"session {session.id} was recorded before pages had scenes of their own; its trace can be written as CSV"
        )
    return {
        "format": 1, "kind": "echospline session", "version": session.version, "core": session.core,
        "scene": {"title": session.scene, "pack": session.pack}, "model": session.model, "exercise": exercise.model_dump(mode="json"),
        "examination": session.examination, "trainee": session.trainee if named else "",
        "attempt": session.attempt if session.told is None else session.told,
        "started": session.started, "rate": _rate(trace), "ended": session.ended, "steps": len(trace),
        "poses": base64.b64encode(trace.poses.astype("<f8").tobytes()).decode("ascii"), "planes": session.planes or None, "events": session.events,
        "score": session.score,
    }  # fmt: skip


def sessions_file(files: Sequence[dict[str, Any]]) -> str:
    """Return several sessions as one JSON text, which a page and `echospline sessions import` read."""
    return json.dumps({"format": 1, "kind": "echospline sessions", "sessions": list(files)})


def sessions_csv(sessions: Sequence[Session]) -> str:
    """Write sessions as CSV, one row each, in the order of their numbers; units are in the header."""
    names = [f.name for f in fields(Score)]
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(
        ["id", "started", "trainee", "exercise", "scene", "model", *(_with_unit(name) for name in names),
         "attempt", "ended", "examination", "verified", "difference", "expert", "version", "core", "pack"]
    )  # fmt: skip
    for s in sorted(sessions, key=lambda s: s.id):
        writer.writerow(
            [s.id, s.started, _plain(s.trainee), _plain(s.exercise), _plain(s.scene), _plain(s.model),
             *(s.score.get(name) for name in names), s.attempt, s.ended, s.examination,
             {True: "yes", False: "no", None: ""}[s.verified], _plain(s.difference), s.expert, _plain(s.version), s.core, s.pack]
        )  # fmt: skip
    return out.getvalue()


def curves_csv(answer: dict[str, Any]) -> str:
    """Write the learning curves of a `class_answer` or `own_answer` as CSV: one row an attempt that counts."""
    out = io.StringIO()
    writer = csv.writer(out)
    writer.writerow(
        ["scene", "exercise", "trainee", "count", "session", "success", "lc_cusum", "threshold", "passed",
         *(_with_unit(name) for name in METRICS)]
    )  # fmt: skip
    for group in answer["curves"]:
        for one in group["trainees"]:
            for k, number in enumerate(one["sessions"]):
                passed = one["passed_at"] is not None and k + 1 >= one["passed_at"]
                writer.writerow(
                    [_plain(group["scene"]), _plain(group["exercise"]), _plain(one["trainee"]), k + 1, number,
                     one["successes"][k], f"{one['values'][k]:.6f}", f"{answer['criterion']['threshold']:.6f}", passed,
                     *(one["metrics"][name][k] for name in METRICS)]
                )  # fmt: skip
    return out.getvalue()


def trace_csv(trace: Trace) -> str:
    """Write a session's trace as CSV: time, pose and the deformed target, one row per step."""
    out = io.StringIO()
    writer = csv.writer(out)
    axes = "xyz"[: trace.dimension]
    writer.writerow(
        ["time (s)", *(f"{what}_{axis} (mm)" for what in ("entry", "tip") for axis in axes), "speed (mm/s)",
         *(f"target_{axis} (mm)" for axis in axes)]
    )  # fmt: skip
    for time, pose, watched in zip(trace.times, trace.poses, trace.watched, strict=True):
        writer.writerow([f"{time:.6f}", *(f"{v:.6f}" for v in (*pose, *watched[0]))])
    return out.getvalue()


def trainee_curve(sessions: Sequence[Session], criterion: Criterion) -> tuple[list[Session], Curve]:
    """Return the attempts of one trainee at one exercise that count, and their learning curve."""
    counted = [s for s in sessions if s.counts and not s.expert]
    return counted, learning_curve((s.success for s in counted), criterion)


def _groups(sessions: Sequence[Session]) -> list[list[Session]]:
    """Return the sessions of every scene and exercise, sorted by their names."""
    groups: dict[tuple[str, str], list[Session]] = {}
    for session in sessions:
        groups.setdefault((session.scene, session.exercise), []).append(session)
    return [groups[key] for key in sorted(groups)]


def _curves(sessions: Sequence[Session], criterion: Criterion, *, group_too: bool) -> dict[str, Any]:
    """Return the curves of one exercise of one scene."""
    trainees: dict[str, list[Session]] = {}
    for session in sessions:
        trainees.setdefault(session.trainee, []).append(session)
    curves = [_trainee(name, trainees[name], criterion) for name in sorted(trainees)]
    curves = [one for one in curves if one["sessions"]]
    answer: dict[str, Any] = {
        "scene": sessions[0].scene, "exercise": sessions[0].exercise, "trainees": curves,
    }  # fmt: skip
    experts = [s for s in sessions if s.expert and s.counts]
    answer["expert"] = {"sessions": [s.id for s in experts], "metrics": _level(experts)}
    if group_too:
        middle, counts = group_median([one["values"] for one in curves])
        answer["median"] = {
            "trainees": counts, "values": middle,
            "metrics": {name: group_median([one["metrics"][name] for one in curves])[0] for name in METRICS},
        }  # fmt: skip
    return answer


def _trainee(name: str, sessions: Sequence[Session], criterion: Criterion) -> dict[str, Any]:
    counted, curve = trainee_curve(sessions, criterion)
    return {
        "trainee": name,
        "sessions": [s.id for s in counted],
        "successes": [s.success for s in counted],
        "values": list(curve.values),
        "passed_at": curve.passed_at,
        "not_counted": sum(not s.counts for s in sessions),
        "metrics": {metric: [s.score.get(metric) for s in counted] for metric in METRICS},
    }


def _level(experts: Sequence[Session]) -> dict[str, float | None]:
    """Return the median of every metric over expert runs; none where there are no experts."""
    if not experts:
        return {}
    return {name: group_median([[s.score.get(name)] for s in experts])[0][0] for name in METRICS}


def _listed(session: Session) -> dict[str, Any]:
    return {
        **{k: v for k, v in session.to_dict().items() if k not in _PRIVATE},
        "counts": session.counts, "success": session.success,
    }  # fmt: skip


def _rate(trace: Trace) -> float:
    """Return steps per second: a trace keeps their period, whose inverse is off by rounding."""
    rate = 1.0 / trace.period
    return round(rate, 9)


def _with_unit(name: str) -> str:
    return f"{name} ({_UNITS[name]})" if _UNITS.get(name) else name


def _plain(text: str) -> str:
    """Quote text that a spreadsheet would read as a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text
