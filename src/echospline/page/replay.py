"""Sessions run again by the native core on the scene of their pack, and compared with what the page said of them."""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.live import Trace
from echospline.page.exercise import check_exercises
from echospline.page.pack import LARGEST, ModelPart, Pack, inflated
from echospline.page.probe import in_picture
from echospline.page.rules import broken_rules
from echospline.page.scoring import Score, printed, prints_alike, score
from echospline.page.sessions_file import RecordedSession
from echospline.scene import Floats, NeedlePose, SpatialPose

SLACK = 1e-6
"""mm and mm/s: how far rounding takes a recorded motion from what the hand's limits allow."""
_SCENE = re.compile(rb'<script type="text/plain" id="scene">([A-Za-z0-9+/=\s]*)</script>')


class Tissue(Protocol):
    """A model of a pack in the native core; states are values."""

    def rest(self) -> Any:
        """State of tissue that no needle has touched."""
        ...

    def advance(self, state: Any, pose: Any, dt: float) -> Any:
        """State after the needle has moved to ``pose`` in ``dt`` seconds."""
        ...

    def displacement_at(self, state: Any, points: Floats) -> Floats:
        """Displacement of reference points (n, D) in mm, shape (n, D), mm."""
        ...


@dataclass(frozen=True)
class Verified:
    """A session run again.

    Parameters
    ----------
    session : RecordedSession
        As the page exported it.
    trace : Trace
        The recorded poses, and where target and vessels were by the native core.
    score : Score
        Of that trace.
    differences : tuple of str
        What does not hold, a sentence each; empty for a session that is verified.
    """

    session: RecordedSession
    trace: Trace
    score: Score
    differences: tuple[str, ...]


def pack_of_page(path: Path) -> Pack:
    """Read the scene out of a page that `bundle` made.

    Raises
    ------
    InputError
        If the file cannot be read or holds no scene.
    """
    try:
        if path.stat().st_size > 2 * LARGEST:
            raise InputError(f"{path} is larger than any page of echospline")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read the page {path}: {error.strerror}") from error
    found = _SCENE.findall(data)
    if len(found) != 1:
        raise InputError(
            f"{path} is no page of echospline: it holds {len(found)} scenes; expected what echospline page wrote"
        )
    try:
        return Pack.from_bytes(inflated(base64.b64decode(found[0])))
    except ValueError:
        raise InputError(f"the scene of {path} is damaged: it is no base64") from None


def tissue_of(pack: Pack, model: ModelPart) -> Tissue:
    """Return a model of a pack in the native core.

    Raises
    ------
    InputError, SolverError
        If the core refuses it.
    """
    from echospline.scenario import (  # noqa: PLC0415 - packs are read without the numerics
        CoreScene,
        ForcedScene,
        SpatialForcedScene,
        forced_steps,
        landmark_steps,
        spatial_steps,
    )

    tissue: Tissue
    if model.kind == "landmarks":
        points = pack.array(model, "clamped_points")
        clamped = np.empty((0, pack.dimension)) if points is None else np.ascontiguousarray(points)
        tissue = landmark_steps(CoreScene(model.options, clamped, pack.array(model, "stiffness")))
        return tissue
    law = {name: float(value) for name, value in model.options.items() if not isinstance(value, list)}
    given = {role: pack.arrays[name] for role, name in model.arrays.items()}
    if pack.dimension == 3:
        tissue = spatial_steps(SpatialForcedScene(law, model.response or {}, given))
    else:
        tissue = forced_steps(ForcedScene(law, model.response or {}, given))
    return tissue


def replay(pack: Pack, session: RecordedSession) -> Trace:
    """Run a session through the native core.

    Raises
    ------
    InputError
        If the session is not one of this pack's scene, or its rows are damaged.
    """
    if session.scene.pack != pack.digest:
        raise InputError(
            f"this session was recorded in another scene, {session.scene.title!r}: give the page that it came from with --pack"
        )
    rows = session.rows(pack.dimension)
    tissue = tissue_of(pack, pack.model(session.model))
    check_exercises([session.exercise], *pack.corners)
    places = np.array(session.exercise.landmarks, dtype=np.float64)
    dt = 1.0 / session.rate
    state = tissue.rest()
    watched = np.empty((len(rows), *places.shape))
    D = pack.dimension
    made: type[Any] = NeedlePose if D == 2 else SpatialPose
    for k, row in enumerate(rows.tolist()):
        state = tissue.advance(state, made(tuple(row[:D]), tuple(row[D : 2 * D]), row[-1]), dt)
        watched[k] = places + tissue.displacement_at(state, places)
    return Trace(dt, rows, watched)


def verify(pack: Pack, session: RecordedSession) -> Verified:
    """Run a session again and say how it differs from what the page said.

    Compared are every metric as it is printed, the exercise with that of the pack, the rate, and the motion with the needle's limits:
    no faster than the pack allows, and with the speed that its poses have, and with the exercise's rules on entry, time and attempts.

    Raises
    ------
    InputError
        If it cannot be run again at all.
    """
    trace = replay(pack, session)
    found = score(trace, session.exercise, _seen(pack, session, trace))
    said = [
        *_of_another_exercise(pack, session),
        *impossible_motion(trace, pack.manifest.needle.fastest),
        *broken_rules(session.exercise, trace, session.attempt),
    ]
    if session.rate != pack.manifest.rate:
        said.append(f"it has {session.rate:g} steps a second, the scene {pack.manifest.rate:g}")
    if session.planes is not None and pack.dimension == 2:
        said.append("it moves a probe, and the scene has no probe")
    told = session.score
    if told is None and session.ended != "reset":
        said.append("it carries no score of the page")
    if told is not None:
        for name, value in found.to_dict().items():
            if name not in told:
                said.append(f"the page says nothing of {name}")
            elif not prints_alike(told[name], value):
                said.append(f"{name} is {_shown(value)}, the page said {_shown(told[name])}")
    return Verified(session, trace, found, tuple(said))


def impossible_motion(trace: Trace, fastest: float) -> list[str]:
    """Say where a recorded motion is none that a needle following a hand can make: faster than ``fastest`` mm/s, or with another speed than
    its poses have.
    """
    if len(trace) == 0:
        return []
    said = []
    limit = fastest * trace.period + SLACK
    if trace.depth[0] > 2 * limit:
        said.append(f"the needle begins {trace.depth[0]:.2f} mm deep; it begins outside the tissue")
    for name, places in (("tip", trace.tip), ("entry", trace.entry)):
        step = np.linalg.norm(np.diff(places, axis=0), axis=1)
        if step.max(initial=0.0) > limit:
            row = int(step.argmax()) + 1
            said.append(
                f"the {name} jumps {step.max():.2f} mm in step {row}; at most {limit:.2f} mm are possible"
            )
    shaft = trace.tip - trace.entry
    length = np.linalg.norm(shaft, axis=1, keepdims=True)
    long, long_before = length[1:] > 1e-9, length[:-1] >= 1e-9
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.where(long, shaft[1:] / length[1:], np.where(long_before, shaft[:-1] / length[:-1], 0.0))
    speed = (np.diff(shaft, axis=0) * axis).sum(axis=1) / trace.period
    off = np.abs(speed - trace.poses[1:, -1])
    if off.max(initial=0.0) > SLACK * max(1.0, fastest):
        row = int(off.argmax()) + 1
        said.append(
            f"the speed in step {row} is said to be {trace.poses[row, -1]:.2f} mm/s, and its poses give {speed[row - 1]:.2f}"
        )
    return said


def _seen(pack: Pack, session: RecordedSession, trace: Trace) -> NDArray[np.bool_] | None:
    """Return at which steps the tip was in the picture; None in the plane."""
    probe = pack.manifest.probe
    if probe is None:
        return None
    planes = session.plane_rows() if session.planes else np.array([[0.0, *probe.pose]])
    if len(planes) == 0 or (len(trace) and planes[-1, 0] >= len(trace)):
        raise InputError("planes of a session begin at step 0 and end before its last step")
    return in_picture(probe, planes, trace.tip)


def _of_another_exercise(pack: Pack, session: RecordedSession) -> list[str]:
    known = {exercise.name: exercise for exercise in pack.manifest.exercises}
    given = session.exercise
    if given.name not in known:
        return [f"the scene has no exercise {given.name!r}"]
    return [] if known[given.name] == given else [f"its exercise {given.name!r} is not that of the scene"]


def _shown(value: float | bool | None) -> str:
    return ("yes" if value else "no") if isinstance(value, bool) else printed(value)
