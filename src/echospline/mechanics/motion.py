"""Motion of a needle that follows its command, as the native core moves it for every host."""

from __future__ import annotations

import ctypes

from echospline import _native as core
from echospline.errors import InputError
from echospline.scene import NeedlePose, SpatialPose
from echospline.scene.space import Triple


def follow(
    pose: NeedlePose,
    entry: tuple[float, float],
    tip: tuple[float, float],
    dt: float,
    lag: float,
    fastest: float,
) -> NeedlePose:
    """Move a needle one step towards its command.

    Parameters
    ----------
    pose : NeedlePose
        Before the step.
    entry, tip : (x, y)
        Where the needle shall go, mm.
    dt : float
        Length of the step, s, positive.
    lag : float
        Time constant with which it follows, s; 0: at once.
    fastest : float
        Upper limit of the speed of tip and entry, mm/s, positive.

    Returns
    -------
    NeedlePose
        After the step; its speed is the axial speed of the tip relative to the entry, mm/s.

    Raises
    ------
    InputError
        If a number is out of its range or not finite.
    """
    after = _followed((*pose.entry, 0.0), (*pose.tip, 0.0), (*entry, 0.0), (*tip, 0.0), dt, lag, fastest)
    return NeedlePose((after.entry[0], after.entry[1]), (after.tip[0], after.tip[1]), after.speed)


def follow_in_space(
    pose: SpatialPose, entry: Triple, tip: Triple, dt: float, lag: float, fastest: float
) -> SpatialPose:
    """Move a needle in space one step towards its command; as `follow`, with entry and tip (x, y, z) in mm."""
    after = _followed(pose.entry, pose.tip, entry, tip, dt, lag, fastest)
    return SpatialPose(tuple(after.entry), tuple(after.tip), after.speed)


def _followed(
    now_entry: Triple, now_tip: Triple, entry: Triple, tip: Triple, dt: float, lag: float, fastest: float
) -> core.Pose:
    now, after = core.Pose(entry=now_entry, tip=now_tip), core.Pose(dt=dt)
    command = core.Command(entry, tip, lag, fastest)
    status = core.library().echospline_follow(ctypes.byref(now), ctypes.byref(command), ctypes.byref(after))
    if status != core.Status.OK:
        raise InputError(
            "a needle follows finite positions in mm, in steps of a positive dt, with a lag of zero or more and a positive "
            f"fastest speed; got entry {entry}, tip {tip}, dt {dt} s, lag {lag} s, fastest {fastest} mm/s"
        )
    return after
