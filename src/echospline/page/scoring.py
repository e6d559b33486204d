"""Scores of a recorded insertion: the metrics of the Perk Tutor, in the imaging plane or in space.

Definitions follow PerkTutor/PythonMetrics where it has them: path inefficiency is 100 (path / straight - 1) per
cent, tissue damage the area that the shaft sweeps inside the tissue, motion smoothness the root of the
integral of the squared jerk. Unlike there, the target moves with the *deformed* tissue.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from decimal import ROUND_HALF_UP, Decimal
from math import inf, isfinite

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.live import Trace
from echospline.page.exercise import Exercise
from echospline.scene import Floats

INSIDE = 0.5
"""mm; a needle this deep is in the tissue."""
TURN, TURN_REST = 3.0, 0.5
"""degrees that make a redirection; and s of a steady direction that end it."""
STEADY = 0.01
"""degrees between two steps of a steady direction."""
LEAST = 0.005
"""Of any unit; less is printed as 0."""
JERK_INTERVAL = 0.05
"""s; positions are averaged over this long before the third difference is taken, or it would measure
the rate of the pointer's events instead of the hand."""


@dataclass(frozen=True)
class Score:
    """Result of an exercise; lengths mm, times s.

    Parameters
    ----------
    passed : bool
        Target hit, no vessel touched, redirections within the limit.
    time : float
        From the start to the end.
    tissue_time : float
        With the needle in the tissue.
    path_length : float
        Path length of the tip inside the tissue.
    path_inefficiency : float
        100 (path length / straight way from first entry to last tip - 1), per cent.
    tissue_damage : float
        Area swept by the shaft inside the tissue, mm^2.
    punctures : int
        Times the needle went in.
    redirections : int
        Times it turned in the tissue by more than 3 degrees.
    smoothness : float
        Root of the integral of the squared jerk of the tip, mm/s^2.5; smaller is smoother.
    final_error : float
        Last tip to the deformed target's centre.
    target_shift : float
        Displacement of the target at the end.
    vessel_contacts : int
        Times the needle touched a vessel.
    picture_time : float or None
        In space: how long the tip was in the picture while the needle was in the tissue; None in the plane, where it always is.
    """

    passed: bool
    time: float
    tissue_time: float
    path_length: float
    path_inefficiency: float
    tissue_damage: float
    punctures: int
    redirections: int
    smoothness: float
    final_error: float
    target_shift: float
    vessel_contacts: int
    picture_time: float | None = None

    def to_dict(self) -> dict[str, float | int | bool | None]:
        """Return plain values for JSON; an infinite one is None, and what the plane does not have is left out."""
        values = {
            k: (None if isinstance(v, float) and not isfinite(v) else v) for k, v in asdict(self).items()
        }
        return (
            values
            if self.picture_time is not None
            else {k: v for k, v in values.items() if k != "picture_time"}
        )


def score(trace: Trace, exercise: Exercise, seen: NDArray[np.bool_] | None = None) -> Score:
    """Score a trace; a pure function, so that stored sessions can be scored again.

    Parameters
    ----------
    trace : Trace
        In the plane or in space.
    exercise : Exercise
        What was to be done.
    seen : ndarray of bool, shape (n,), optional
        In space: at which steps the tip was in the picture.

    Raises
    ------
    InputError
        If the trace does not watch this exercise's target and vessels.
    """
    if trace.watched.shape[1] != 1 + len(exercise.vessels):
        raise InputError(
            f"a trace of this exercise watches {1 + len(exercise.vessels)} places; got {trace.watched.shape[1]}"
        )
    if len(trace) == 0:
        return Score(False, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0.0, inf, 0.0, 0, None if seen is None else 0.0)
    inside = trace.depth > INSIDE
    moves = _length(np.diff(trace.tip, axis=0))
    within = inside[1:] & inside[:-1]
    path = float(moves[within].sum())
    touched = [
        contacts(trace.entry, trace.tip, trace.watched[:, 1 + j], vessel.radius, inside)
        for j, vessel in enumerate(exercise.vessels)
    ]
    error = float(_length(trace.tip[-1] - trace.watched[-1, 0])) if inside[-1] else inf
    turned = redirections(trace, inside)
    limit = inf if exercise.most_redirections is None else exercise.most_redirections
    return Score(
        passed=error <= exercise.target.radius and sum(touched) == 0 and turned <= limit,
        time=trace.period * len(trace),
        tissue_time=trace.period * float(inside.sum()),
        path_length=path,
        path_inefficiency=_inefficiency(trace, inside, path),
        tissue_damage=float(swept_area(trace)[within].sum()),
        punctures=_rises(inside),
        redirections=turned,
        smoothness=smoothness(trace),
        final_error=error,
        target_shift=float(_length(trace.watched[-1, 0] - np.array(exercise.target.centre))),
        vessel_contacts=sum(touched),
        picture_time=None if seen is None else trace.period * float((inside & seen).sum()),
    )


def printed(value: float | None) -> str:
    """Return a metric's value as a page prints it.

    Examples
    --------
    >>> [printed(value) for value in (None, 0.004, 3.0, 9.876, 98.76, 9876.5)]
    ['–', '0', '3', '9.88', '98.8', '9877']
    """
    if value is None:
        return "–"
    if abs(value) < LEAST:
        return "0"
    if value == int(value):
        return str(int(value))
    return str(Decimal(value).quantize(Decimal(1).scaleb(-_digits(value)), ROUND_HALF_UP))


def prints_alike(a: float | None, b: float | None) -> bool:
    """Return whether two values of a metric are printed alike.

    So are values whose difference is below a hundredth of the last printed digit: they may lie on both sides of where a printed digit
    changes, and two builds of the core agree on the field within 1e-4 mm.
    """
    if a is None or b is None:
        return a is b
    if isinstance(a, bool) or isinstance(b, bool):
        return a == b
    return printed(a) == printed(b) or abs(a - b) < 0.01 * 10.0 ** -_digits(a)


def _digits(value: float) -> int:
    """Return the number of decimals that are printed."""
    return 2 if abs(value) < 10 else 1 if abs(value) < 1000 else 0


def swept_area(trace: Trace) -> Floats:
    """Return the area between the shaft of each row and that of the row before, shape (n - 1,), mm^2.

    A needle that only moves along itself sweeps nothing; the two triangles are those of the quadrilateral
    of old and new entry and tip.
    """
    a, b = trace.entry[:-1], trace.tip[:-1]
    c, d = trace.tip[1:], trace.entry[1:]
    return _triangle(a, b, c) + _triangle(a, c, d)


def _triangle(a: Floats, b: Floats, c: Floats) -> Floats:
    u, v = b - a, c - a
    if u.shape[1] == 3:
        return 0.5 * _length(np.cross(u, v))
    area: Floats = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    return area


def _length(vectors: Floats) -> Floats:
    """Length of each vector, mm."""
    length: Floats = np.hypot(vectors[..., 0], vectors[..., 1])
    return length if vectors.shape[-1] == 2 else np.hypot(length, vectors[..., 2])


def redirections(trace: Trace, inside: NDArray[np.bool_]) -> int:
    """Count the turns inside the tissue by more than `TURN` degrees; one turn lasts until the needle holds still."""
    along = trace.tip - trace.entry
    angle = np.degrees(np.unwrap(np.arctan2(along[:, 1], along[:, 0])))

    def between(row: int, other: int) -> float:
        """Degrees between the directions of two rows."""
        if trace.dimension == 2:
            return float(abs(angle[row] - angle[other]))
        return _angle(along[row], along[other])

    rest_rows = max(1, round(TURN_REST / trace.period))
    count, held, turning, still = 0, 0, False, 0
    for row in range(len(trace)):
        if row == 0 or not inside[row] or not inside[row - 1]:
            held, turning, still = row, False, 0
            continue
        still = still + 1 if between(row, row - 1) < STEADY else 0
        if not turning and between(row, held) > TURN:
            count, turning = count + 1, True
        if still >= rest_rows:
            held, turning = row, False
    return count


def _angle(a: Floats, b: Floats) -> float:
    """Angle between two directions in space, degrees."""
    return float(np.degrees(np.arctan2(_length(np.cross(a, b)), a @ b)))


def contacts(entry: Floats, tip: Floats, centres: Floats, radius: float, inside: NDArray[np.bool_]) -> int:
    """Count how often the shaft begins to touch a disc that moves with the tissue."""
    along = tip - entry
    length2 = np.maximum((along**2).sum(axis=1), 1e-12)
    t = np.clip(((centres - entry) * along).sum(axis=1) / length2, 0.0, 1.0)
    nearest = _length(entry + t[:, None] * along - centres)
    return _rises(inside & (nearest <= radius))


def smoothness(trace: Trace) -> float:
    """Return the root of the integral of the squared jerk of the tip, after averaging over `JERK_INTERVAL`."""
    rows = max(1, round(JERK_INTERVAL / trace.period))
    blocks = len(trace) // rows
    if blocks < 4:
        return 0.0
    dt = rows * trace.period
    tip = trace.tip[: blocks * rows].reshape(blocks, rows, trace.dimension).mean(axis=1)
    jerk = np.diff(tip, n=3, axis=0) / dt**3
    return float(np.sqrt((jerk**2).sum() * dt))


def _rises(flag: NDArray[np.bool_]) -> int:
    return int(flag[0]) + int((flag[1:] & ~flag[:-1]).sum())


def _inefficiency(trace: Trace, inside: NDArray[np.bool_], path: float) -> float:
    rows = np.flatnonzero(inside)
    if len(rows) == 0:
        return 0.0
    straight = float(_length(trace.tip[rows[-1]] - trace.tip[rows[0]]))
    return 100.0 * (path / straight - 1.0) if straight > INSIDE else inf
