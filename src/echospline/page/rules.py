"""Rules of an exercise that a recorded attempt can break: its entry, its time, its number of attempts."""

from __future__ import annotations

import numpy as np

from echospline.live import Trace
from echospline.page.exercise import Exercise

SAME = 1e-6
"""mm; an entry that is fixed keeps its place to this, which is rounding alone."""


def broken_rules(exercise: Exercise, trace: Trace, attempt: int) -> list[str]:
    """Say which rules of its exercise an attempt breaks, a sentence each.

    Parameters
    ----------
    exercise : Exercise
        With its rules.
    trace : Trace
        The recorded motion.
    attempt : int
        Number of the attempt, from 1; 0 where nobody counted.
    """
    said = []
    if len(trace) and (exercise.entry is not None or exercise.entry_between is not None):
        said += _moved_entry(exercise, trace)
    longest = round(exercise.time_limit / trace.period)
    if len(trace) > longest:
        said.append(
            f"it lasts {trace.period * len(trace):.1f} s; the exercise ends after {exercise.time_limit:g} s"
        )
    if exercise.attempts is not None and attempt > exercise.attempts:
        said.append(beyond(attempt, exercise.attempts))
    return said


def beyond(attempt: int, attempts: int) -> str:
    """Return the sentence for an attempt that is one too many."""
    return f"it is attempt {attempt}; the exercise has {attempts}"


def _moved_entry(exercise: Exercise, trace: Trace) -> list[str]:
    first = trace.entry[0]
    if np.abs(trace.entry - first).max() > SAME:
        return ["the entry moved; the exercise gives it"]
    if exercise.entry is not None and np.abs(first - exercise.entry).max() > SAME:
        came, given = (", ".join(f"{v:.2f}" for v in place) for place in (first, exercise.entry))
        return [f"the needle entered at {came} mm; the exercise says {given}"]
    if exercise.entry_between is not None:
        low, high = exercise.entry_between
        if not low - SAME <= first[0] <= high + SAME:
            return [
                f"the needle entered at x = {first[0]:.2f} mm; the exercise draws it from {low:g} to {high:g} mm"
            ]
    return []
