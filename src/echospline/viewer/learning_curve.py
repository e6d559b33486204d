"""The learning curve of a trainee: LC-CUSUM, a sequential test for having become proficient.

D. J. Biau, S. M. Williams, M. M. Schlup, R. S. Nizard, R. Porcher: Quantitative and individualized assessment of the learning
curve using LC-CUSUM. British Journal of Surgery 95 (2008) 925-929, doi:10.1002/bjs.6056.

A trainee is taken to be *not* proficient, and every attempt adds the logarithm of its likelihood ratio between an acceptable failure rate
p_a and an unacceptable one p_u, never below zero:

    S_0 = 0,   S_t = max(0, S_(t-1) + w_t),   w_t = ln((1 - p_a) / (1 - p_u)) on success,  ln(p_a / p_u) < 0 on failure.

The trainee passes at the first S_t >= h. The threshold h follows from the risk that one whose failure rate is still p_u passes
within a number of attempts; that risk is computed exactly here, where the paper simulates it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import inf, log
from statistics import median

from echospline.errors import InputError

MOST_ATTEMPTS = 200
"""Attempts of a criterion; the exact risk takes time with their cube."""
EXACT = 1e-9
"""Two sums of the same weights in another order are the same number to this."""


@dataclass(frozen=True)
class Criterion:
    """What proficient means.

    Parameters
    ----------
    acceptable, unacceptable : float
        Failure rates p_a < p_u.
    attempts : int
        Attempts over which the risk is meant.
    risk : float
        Largest probability that a trainee whose failure rate stays unacceptable passes within them.

    Raises
    ------
    InputError
        If a number is out of range, or no threshold keeps the risk.
    """

    acceptable: float = 0.1
    unacceptable: float = 0.4
    attempts: int = 30
    risk: float = 0.05

    def __post_init__(self) -> None:
        if not 0 < self.acceptable < self.unacceptable < 1:
            raise InputError(
                "failure rates must be 0 < acceptable < unacceptable < 1; "
                f"got {self.acceptable:g} and {self.unacceptable:g}"
            )
        if not (isinstance(self.attempts, int) and 1 <= self.attempts <= MOST_ATTEMPTS):
            raise InputError(
                f"attempts must be a whole number from 1 to {MOST_ATTEMPTS}; got {self.attempts}"
            )
        if not 0 < self.risk < 1:
            raise InputError(f"the risk must be a probability between 0 and 1; got {self.risk:g}")

    @property
    def gain(self) -> float:
        """What a success adds."""
        return log((1 - self.acceptable) / (1 - self.unacceptable))

    @property
    def loss(self) -> float:
        """What a failure takes away, as a positive number."""
        return log(self.unacceptable / self.acceptable)

    @cached_property
    def threshold(self) -> float:
        """The smallest reachable h that keeps the risk."""
        return _threshold(self)

    def passing(self, failure_rate: float, attempts: int | None = None) -> float:
        """Return the probability of passing within a number of attempts (those of the criterion) at a constant failure rate."""
        return _passing(self, self.threshold, failure_rate, attempts or self.attempts)

    def to_dict(self) -> dict[str, float]:
        """Return plain values for JSON, with the threshold and what it means."""
        return {
            "acceptable": self.acceptable, "unacceptable": self.unacceptable, "attempts": self.attempts, "risk": self.risk,
            "gain": self.gain, "loss": self.loss, "threshold": self.threshold,
            "passes_unacceptable": self.passing(self.unacceptable), "passes_acceptable": self.passing(self.acceptable),
        }  # fmt: skip


@dataclass(frozen=True)
class Curve:
    """A trainee's curve at an exercise.

    Parameters
    ----------
    values : tuple of float
        S_t after every attempt.
    passed_at : int or None
        Number of the attempt, from 1, at which the threshold was first reached.
    """

    values: tuple[float, ...]
    passed_at: int | None


def learning_curve(successes: Iterable[bool], criterion: Criterion) -> Curve:
    """Compute LC-CUSUM over attempts, oldest first."""
    values: list[float] = []
    now = 0.0
    for success in successes:
        now = max(0.0, now + (criterion.gain if success else -criterion.loss))
        values.append(now)
    reached = (k for k, value in enumerate(values, 1) if value >= criterion.threshold - EXACT)
    return Curve(tuple(values), next(reached, None))


def group_median(rows: Sequence[Sequence[float | None]]) -> tuple[list[float | None], list[int]]:
    """Return the median of a group at every attempt, and of how many it is.

    Parameters
    ----------
    rows : sequence of sequences
        One a trainee, a value an attempt; None is a value without bound (a target that was never reached).

    Returns
    -------
    medians : list of float or None
        Over those who made that many attempts; None where it is without bound.
    counts : list of int
        How many they are.
    """
    medians: list[float | None] = []
    counts: list[int] = []
    for k in range(max((len(row) for row in rows), default=0)):
        values = [inf if value is None else value for row in rows if k < len(row) for value in (row[k],)]
        middle = median(values)
        medians.append(None if middle == inf else middle)
        counts.append(len(values))
    return medians, counts


@lru_cache(maxsize=64)
def _threshold(criterion: Criterion) -> float:
    """Find the smallest reachable sum at which the risk is kept; the risk falls as the threshold rises."""
    n, gain, loss = criterion.attempts, criterion.gain, criterion.loss
    sums = sorted({a * gain - b * loss for a in range(1, n + 1) for b in range(n + 1 - a)})
    reachable = [value for value in sums if value > EXACT]
    low, high = 0, len(reachable)
    while low < high:
        middle = (low + high) // 2
        if _passing(criterion, reachable[middle], criterion.unacceptable, n) <= criterion.risk:
            high = middle
        else:
            low = middle + 1
    if low == len(reachable):
        raise InputError(
            f"within {n} attempts a trainee who fails {criterion.unacceptable:.0%} of them is never told from a proficient one at a "
            f"risk of {criterion.risk:g}: allow more attempts or a larger risk, or set the failure rates further apart"
        )
    return reachable[low]


@lru_cache(maxsize=1024)
def _passing(criterion: Criterion, threshold: float, failure_rate: float, attempts: int) -> float:
    """Return the probability of reaching a threshold: the distribution of (successes, failures) since S was last zero, attempt by attempt."""
    gain, loss = criterion.gain, criterion.loss
    chances, passed = {(0, 0): 1.0}, 0.0
    for _ in range(attempts):
        after: dict[tuple[int, int], float] = {}
        for (a, b), chance in chances.items():
            if (a + 1) * gain - b * loss >= threshold - EXACT:
                passed += chance * (1 - failure_rate)
            else:
                after[a + 1, b] = after.get((a + 1, b), 0.0) + chance * (1 - failure_rate)
            down = (a, b + 1) if a * gain - (b + 1) * loss > EXACT else (0, 0)
            after[down] = after.get(down, 0.0) + chance * failure_rate
        chances = after
    return passed
