"""Motion of a needle: following its commands, and straight to a pose."""

from __future__ import annotations

from typing import Any

import numpy as np

from echospline.live.snapshot import Command
from echospline.mechanics.motion import follow as towards
from echospline.mechanics.motion import follow_in_space as towards_in_space
from echospline.mechanics.protocol import SpatialTissueModel, TissueModel
from echospline.scene import NeedlePose, SpatialPose


def follow(pose: NeedlePose, command: Command, dt: float, lag: float, fastest: float) -> NeedlePose:
    """Move the needle towards its command as a hand does, without jumps.

    Commands come at the rate of a screen or a tracker, steps at another; applied directly, they would make the speed of (15)
    flicker between zero and a multiple of the true one. A first-order lag smooths it.

    Parameters
    ----------
    pose : NeedlePose
        Before the step.
    command : Command
        The needle's goal.
    dt : float
        Length of the step, s.
    lag : float
        Time constant, s; 0 goes there at once.
    fastest : float
        Upper limit of the speed of tip and entry, mm/s.

    Returns
    -------
    NeedlePose
        After the step; its speed is the axial speed of the tip relative to the entry, mm/s.

    Raises
    ------
    InputError
        If a number is out of its range or not finite.
    """
    return towards(pose, command.entry, command.tip, dt, lag, fastest)


def follow_in_space(
    pose: SpatialPose, command: SpatialPose, dt: float, lag: float, fastest: float
) -> SpatialPose:
    """Move a needle in space towards its command; as `follow`."""
    return towards_in_space(pose, command.entry, command.tip, dt, lag, fastest)


def insert_straight(
    model: TissueModel[Any], pose: NeedlePose, speed: float = 10.0, stride: float = 0.5
) -> object:
    """Return the state of a model after a straight insertion to a pose: the first state after a switch of models.

    Parameters
    ----------
    model : TissueModel
        Any model.
    pose : NeedlePose
        Pose of the needle.
    speed : float
        Of the insertion, mm/s.
    stride : float
        Length of one step, mm.
    """
    state = model.rest()
    depth, axis = pose.depth, pose.axis
    steps = int(np.ceil(depth / stride))
    for k in range(1, steps + 1):
        s = depth * k / steps
        tip = (pose.entry[0] + s * axis[0], pose.entry[1] + s * axis[1])
        state = model.advance(state, NeedlePose(pose.entry, tip, speed), depth / steps / speed)
    return state


def insert_straight_in_space(
    model: SpatialTissueModel[Any], pose: SpatialPose, speed: float = 10.0, stride: float = 0.5
) -> object:
    """Return the state of a model in space after a straight insertion to a pose; as `insert_straight`."""
    state = model.rest()
    depth, axis = pose.depth, np.array(pose.axis)
    steps = int(np.ceil(depth / stride))
    for k in range(1, steps + 1):
        x, y, z = np.array(pose.entry) + depth * k / steps * axis
        tip = float(x), float(y), float(z)
        state = model.advance(state, SpatialPose(pose.entry, tip, speed), depth / steps / speed)
    return state
