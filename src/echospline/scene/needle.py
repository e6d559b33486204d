"""The needle: its pose and its motion (insertion), equations (10), (11) and (13)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, hypot, radians, sin

import numpy as np
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.scene.grid import Floats, as_points
from echospline.scene.number import is_number

SAME_TIME = 1e-9
"""s; times closer than this are equal, so that k / fps and a keyframe agree in spite of rounding."""
ZERO_LENGTH = 1e-9
"""mm; a needle shorter than this has no direction, touches nothing and pushes nothing."""


@dataclass(frozen=True, slots=True)
class NeedlePose:
    """Position of the needle at one instant.

    Parameters
    ----------
    entry : (x, y)
        n_s, the point of entry, mm.
    tip : (x, y)
        n_t, the tip, mm.
    speed : float
        Signed speed of the tip along the axis, mm/s; positive inserts, negative withdraws.

    Raises
    ------
    InputError
        If a number is not finite.
    """

    entry: tuple[float, float]
    tip: tuple[float, float]
    speed: float = 0.0

    def __post_init__(self) -> None:
        if len(self.entry) != 2 or len(self.tip) != 2:
            raise InputError(f"entry and tip must be (x, y) in mm; got {self.entry} and {self.tip}")
        values = (*self.entry, *self.tip, self.speed)
        if not all(is_number(v) for v in values):
            raise InputError(
                f"a needle pose must be finite: entry {self.entry} mm, tip {self.tip} mm, speed {self.speed} mm/s"
            )

    @property
    def depth(self) -> float:
        """Insertion depth, mm: the length of the shaft from entry to tip."""
        return hypot(self.tip[0] - self.entry[0], self.tip[1] - self.entry[1])

    @property
    def axis(self) -> tuple[float, float]:
        """Unit vector from entry to tip; (0, 0) for a needle of zero length."""
        length = self.depth
        if length < ZERO_LENGTH:
            return (0.0, 0.0)
        return ((self.tip[0] - self.entry[0]) / length, (self.tip[1] - self.entry[1]) / length)

    def shaft(self, t: ArrayLike) -> Floats:
        """Return points n(t) on the shaft, 0 <= t <= 1 from entry to tip, equation (10), shape (k, 2) mm."""
        ns, nt = np.asarray(self.entry), np.asarray(self.tip)
        points: Floats = ns + np.atleast_1d(np.asarray(t, dtype=np.float64))[:, None] * (nt - ns)
        return points

    def closest(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Find the closest point of the shaft to each point, equations (11) and (13).

        Parameters
        ----------
        points : array_like, shape (n, 2)
            mm.

        Returns
        -------
        t : ndarray, shape (n,)
            Fraction along the shaft, 0 at entry and 1 at the tip.
        distance : ndarray, shape (n,)
            d, mm.
        """
        p = as_points(points)
        ns, along = np.asarray(self.entry), np.subtract(self.tip, self.entry)
        length2 = float(along @ along)
        t = np.zeros(len(p)) if length2 < ZERO_LENGTH**2 else np.clip((p - ns) @ along / length2, 0.0, 1.0)
        d = np.hypot(*(p - ns - t[:, None] * along).T)
        return t, d


@dataclass(frozen=True)
class Insertion:
    """A needle's path: keyframes of entry and tip with straight lines between them.

    Parameters
    ----------
    times : array_like, shape (k,)
        Seconds, strictly ascending, two or more.
    entry : array_like, shape (k, 2) or (2,)
        n_s at the keyframes (one point for a fixed entry), mm.
    tip : array_like, shape (k, 2)
        n_t at the keyframes, mm.

    Raises
    ------
    InputError
        If the arrays do not fit or times do not ascend.
    """

    times: Floats
    entry: Floats
    tip: Floats

    def __post_init__(self) -> None:
        times = np.atleast_1d(np.asarray(self.times, dtype=np.float64))
        if times.ndim != 1 or len(times) < 2 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError("an insertion needs two or more strictly ascending times in s")
        tip = as_points(self.tip, "tip")
        entry = as_points(self.entry, "entry")
        if len(entry) == 1:
            entry = np.repeat(entry, len(times), axis=0)
        if len(tip) != len(times) or len(entry) != len(times):
            raise InputError(
                f"an insertion needs one entry and tip per time: {len(times)} times, {len(entry)} entries, {len(tip)} tips"
            )
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "entry", entry)
        object.__setattr__(self, "tip", tip)

    @classmethod
    def straight(
        cls,
        entry: Sequence[float],
        angle: float,
        depth: float,
        speed: float = 5.0,
        *,
        dwell: float = 0.0,
        retract: bool = False,
        retract_speed: float | None = None,
    ) -> Insertion:
        """Build a path that goes straight in, rests and, if asked, comes out again.

        Parameters
        ----------
        entry : (x, y)
            Point of entry, mm.
        angle : float
            Direction of the axis in degrees from the lateral axis, growing towards depth:
            0 points to +x, 90 straight down, 180 to -x.
        depth : float
            Length inserted, mm, positive.
        speed : float
            Insertion speed, mm/s, positive.
        dwell : float
            Rest at full depth, s.
        retract : bool
            Whether the needle is withdrawn to the entry afterwards.
        retract_speed : float, optional
            mm/s; the insertion speed when not given.

        Raises
        ------
        InputError
            If a number is out of its range.
        """
        back = speed if retract_speed is None else retract_speed
        for name, value, unit in (
            ("depth", depth, "mm"),
            ("speed", speed, "mm/s"),
            ("retract_speed", back, "mm/s"),
        ):
            if not (is_number(value) and value > 0):
                raise InputError(f"{name} must be a positive number in {unit}; got {value}")
        if not (is_number(dwell) and dwell >= 0):
            raise InputError(f"dwell must be zero or a positive number in s; got {dwell}")
        if not is_number(angle):
            raise InputError(f"angle must be a finite number in degrees; got {angle}")
        ns = as_points(entry, "entry")[0]
        nt = ns + depth * np.array([cos(radians(angle)), sin(radians(angle))])
        times, tips = [0.0, depth / speed], [ns, nt]
        if dwell > 0:
            times.append(times[-1] + dwell)
            tips.append(nt)
        if retract:
            times.append(times[-1] + depth / back)
            tips.append(ns)
        return cls(np.array(times), ns, np.array(tips))

    @property
    def duration(self) -> float:
        """Time from first to last keyframe, s."""
        return float(self.times[-1] - self.times[0])

    def pose(self, t: float) -> NeedlePose:
        """Return the pose at time t (s); before the first and after the last keyframe the needle rests there.

        The speed is that of the segment which ends at or contains t, so that the last step of an
        insertion still moves and the first step of a rest does not.
        """
        k = self.times
        i = int(np.clip(np.searchsorted(k, t - SAME_TIME, side="left"), 1, len(k) - 1))
        step = k[i] - k[i - 1]
        a = float(np.clip((t - k[i - 1]) / step, 0.0, 1.0))
        entry = (1 - a) * self.entry[i - 1] + a * self.entry[i]
        tip = (1 - a) * self.tip[i - 1] + a * self.tip[i]
        moving = k[0] < t <= k[-1] + SAME_TIME
        along = tip - entry
        length = float(np.hypot(*along))
        axis = along / length if length > ZERO_LENGTH else self._axis_near(i)
        velocity = ((self.tip[i] - self.entry[i]) - (self.tip[i - 1] - self.entry[i - 1])) / step
        speed = float(velocity @ axis) if moving else 0.0
        return NeedlePose((float(entry[0]), float(entry[1])), (float(tip[0]), float(tip[1])), speed)

    def _axis_near(self, i: int) -> Floats:
        """Return the direction of a segment one of whose ends has zero length."""
        for j in (i, i - 1):
            along = self.tip[j] - self.entry[j]
            length = float(np.hypot(*along))
            if length > ZERO_LENGTH:
                direction: Floats = along / length
                return direction
        return np.zeros(2)
