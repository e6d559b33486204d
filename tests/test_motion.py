"""A needle that follows its command: the core against the plain reading."""

from __future__ import annotations

from dataclasses import replace
from math import exp, hypot

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.live import Command, follow
from echospline.scene.needle import ZERO_LENGTH, NeedlePose

ARRIVED = 1e-4  # mm; a needle this near to its goal is put exactly there
HOME = NeedlePose((20.0, 0.0), (20.0, 0.0))


def plain(pose, command, dt, lag, fastest):
    """First-order lag towards the command, no faster than `fastest`; the speed is along the axis, relative to the entry."""
    share = 1.0 - exp(-dt / lag) if lag > 0 else 1.0
    entry = towards(pose.entry, command.entry, share, fastest * dt)
    tip = towards(pose.tip, command.tip, share, fastest * dt)
    moved = NeedlePose(entry, tip)
    axis = moved.axis if moved.depth > ZERO_LENGTH else pose.axis
    along = np.subtract(tip, entry) - np.subtract(pose.tip, pose.entry)
    return replace(moved, speed=float(along @ axis) / dt)


def towards(start, goal, share, longest):
    dx, dy = goal[0] - start[0], goal[1] - start[1]
    distance = hypot(dx, dy)
    step = min(share * distance, longest)
    if distance - step < ARRIVED:
        return goal
    return (start[0] + dx * step / distance, start[1] + dy * step / distance)


def numbers(pose):
    return np.array([*pose.entry, *pose.tip, pose.speed])


@pytest.mark.parametrize("lag", [0.0, 0.02, 0.3])
@pytest.mark.parametrize("fastest", [5.0, 200.0, float("inf")])
def test_the_core_follows_as_the_plain_reading_does(lag, fastest):
    rng = np.random.default_rng(5)
    ours = expected = HOME
    for _ in range(60):
        entry, tip = rng.uniform(0, 40, 2), rng.uniform(0, 30, 2)
        if rng.random() < 0.2:
            tip = entry  # a needle of no length
        command = Command(tuple(entry.tolist()), tuple(tip.tolist()))
        for _ in range(int(rng.integers(1, 30))):
            dt = float(rng.choice([1e-3, 1 / 60, 0.5]))
            ours = follow(ours, command, dt, lag, fastest)
            expected = plain(expected, command, dt, lag, fastest)
            np.testing.assert_allclose(numbers(ours), numbers(expected), rtol=1e-9, atol=1e-9)


def test_a_needle_near_its_goal_is_put_exactly_there():
    goal = Command((20.0, 0.0), (20.1, 13.7))
    pose = HOME
    for _ in range(200):
        pose = follow(pose, goal, 1 / 60, 0.05, 100.0)
    assert (pose.entry, pose.tip, pose.speed) == (goal.entry, goal.tip, 0.0)


@pytest.mark.parametrize(
    ("tip", "dt", "lag", "fastest"),
    [
        ((float("nan"), 1.0), 0.1, 0.1, 10.0),
        ((1.0, float("inf")), 0.1, 0.1, 10.0),
        ((1.0, 1.0), 0.0, 0.1, 10.0),
        ((1.0, 1.0), float("nan"), 0.1, 10.0),
        ((1.0, 1.0), 0.1, -0.1, 10.0),
        ((1.0, 1.0), 0.1, 0.1, 0.0),
    ],
)
def test_what_cannot_be_followed_is_refused(tip, dt, lag, fastest):
    with pytest.raises(InputError, match="a needle follows finite positions in mm"):
        follow(HOME, Command((20.0, 0.0), tip), dt, lag, fastest)
