"""LC-CUSUM: its curve against Wald's likelihood ratio written out, its risk against every sequence and against simulation."""

from __future__ import annotations

from itertools import product
from math import log

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.viewer.learning_curve import Criterion, group_median, learning_curve

CLASS = Criterion()


def by_suffixes(successes, criterion):
    """Largest log likelihood ratio of any run of attempts that ends now, or zero: the same statistic without a recursion."""
    acceptable, unacceptable = criterion.acceptable, criterion.unacceptable
    values = []
    for end in range(1, len(successes) + 1):
        ratios = [0.0]
        for start in range(end):
            won = sum(successes[start:end])
            lost = end - start - won
            likely = (1 - acceptable) ** won * acceptable**lost
            ratios.append(log(likely / ((1 - unacceptable) ** won * unacceptable**lost)))
        values.append(max(ratios))
    return values


def test_the_curve_is_the_largest_likelihood_ratio_of_any_last_run_of_attempts():
    rng = np.random.default_rng(3)
    for criterion in (CLASS, Criterion(0.05, 0.15, 50, 0.1)):
        for rate in (0.9, 0.6, 0.2):
            successes = (rng.random(40) < rate).tolist()
            found = learning_curve(successes, criterion)
            np.testing.assert_allclose(found.values, by_suffixes(successes, criterion), atol=1e-9)


def test_the_weights_are_those_of_the_paper():
    curve = learning_curve([True, True, False, True, False, False], Criterion(0.1, 0.2, 100, 0.05))
    up, down = log(0.9 / 0.8), log(0.1 / 0.2)  # 0.1178 and -0.6931
    assert curve.values == pytest.approx([up, 2 * up, 0.0, up, 0.0, 0.0])
    assert 2 * up + down < 0
    assert curve.passed_at is None


@pytest.mark.parametrize("failure_rate", [0.1, 0.4, 0.55])
def test_the_probability_of_passing_is_the_sum_over_every_sequence_of_outcomes(failure_rate):
    criterion = Criterion(0.1, 0.4, 11, 0.2)
    total = 0.0
    for outcomes in product((True, False), repeat=11):
        if learning_curve(outcomes, criterion).passed_at is not None:
            won = sum(outcomes)
            total += (1 - failure_rate) ** won * failure_rate ** (11 - won)
    assert 0.0 < total < 1.0
    assert criterion.passing(failure_rate) == pytest.approx(total, abs=1e-12)


def test_the_threshold_keeps_the_risk_and_the_next_lower_sum_does_not():
    rng = np.random.default_rng(11)
    lots = rng.random((40_000, CLASS.attempts)) >= CLASS.unacceptable  # successes
    steps = np.where(lots, CLASS.gain, -CLASS.loss)
    now, most = np.zeros(len(steps)), np.zeros(len(steps))
    for step in steps.T:
        now = np.maximum(0.0, now + step)
        most = np.maximum(most, now)
    passed = (most >= CLASS.threshold - 1e-9).mean()
    assert passed == pytest.approx(CLASS.passing(CLASS.unacceptable), abs=0.004)  # 4 standard errors
    assert CLASS.passing(CLASS.unacceptable) <= CLASS.risk
    lower = max(
        value
        for a in range(1, 31)
        for b in range(31 - a)
        for value in (a * CLASS.gain - b * CLASS.loss,)
        if value < CLASS.threshold - 1e-9
    )
    assert (most >= lower - 1e-9).mean() > CLASS.risk


def test_one_who_always_succeeds_passes_after_threshold_over_gain_attempts_and_stays_passed():
    needed = int(np.ceil(CLASS.threshold / CLASS.gain - 1e-9))
    assert learning_curve([True] * (needed - 1), CLASS).passed_at is None
    assert learning_curve([True] * needed, CLASS).passed_at == needed
    assert learning_curve([True] * needed + [False] * 20, CLASS).passed_at == needed
    assert learning_curve([False] + [True] * needed, CLASS).passed_at == needed + 1
    assert needed == 11


def test_short_runs_are_counted_as_by_hand():
    criterion = Criterion(0.1, 0.4, 3, 0.25)  # three successes of three at a failure rate of 0.4: 0.216
    assert criterion.threshold == pytest.approx(3 * criterion.gain)
    assert criterion.passing(0.4) == pytest.approx(0.6**3)
    assert criterion.passing(0.4, 4) == pytest.approx(0.6**3 + 0.4 * 0.6**3)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ((0.4, 0.1), "acceptable < unacceptable"),
        ((0.0, 0.1), "acceptable < unacceptable"),
        ((0.1, 0.4, 0), "whole number from 1"),
        ((0.1, 0.4, 500), "whole number from 1"),
        ((0.1, 0.4, 30, 1.0), "between 0 and 1"),
    ],
)
def test_criteria_that_say_nothing_are_refused(values, said):
    with pytest.raises(InputError, match=said):
        Criterion(*values)


def test_a_risk_that_no_number_of_successes_keeps_is_said():
    with pytest.raises(InputError, match="never told from a proficient one"):
        Criterion(0.1, 0.4, 3, 0.05).threshold  # noqa: B018 - computed when asked


def test_the_groups_median_is_over_those_who_made_the_attempt():
    medians, counts = group_median([[1.0, 2.0, 3.0], [5.0, None], [9.0, 4.0]])
    assert medians == [5.0, 4.0, 3.0]
    assert counts == [3, 3, 1]
    assert group_median([[None, None], [1.0, None]])[0] == [None, None]
    assert group_median([]) == ([], [])
