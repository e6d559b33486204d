"""A recorded insertion, one row per step of the engine, and the recorder that collects it."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from math import isfinite

import numpy as np

from echospline.errors import InputError
from echospline.live.snapshot import Snapshot
from echospline.scene import Floats, NeedlePose

MOST_ROWS, MOST_WATCHED = 2_000_000, 64
IN_SPACE = -3.0
"""Stands before a stored trace in space, where one in the plane has its period."""


@dataclass(frozen=True)
class Trace:
    """A recorded insertion, one row per step of the engine.

    Parameters
    ----------
    period : float
        s.
    poses : ndarray, shape (n, 2 D + 1)
        entry, tip (D numbers each, mm), speed (mm/s); D is 2 in the plane and 3 in space.
    watched : ndarray, shape (n, k, D)
        Deformed positions of target and vessels, mm.
    """

    period: float
    poses: Floats
    watched: Floats

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def times(self) -> Floats:
        """Times after the start, s, shape (n,)."""
        times: Floats = self.period * np.arange(1, len(self) + 1, dtype=np.float64)
        return times

    @property
    def dimension(self) -> int:
        """2 in the plane, 3 in space."""
        return 3 if self.poses.shape[1] == 7 else 2

    @property
    def entry(self) -> Floats:
        """Points of entry, shape (n, D), mm."""
        return self.poses[:, : self.dimension]

    @property
    def tip(self) -> Floats:
        """Tips, shape (n, D), mm."""
        return self.poses[:, self.dimension : 2 * self.dimension]

    @property
    def depth(self) -> Floats:
        """Insertion depths, shape (n,), mm."""
        along = self.tip - self.entry
        if self.dimension == 2:
            depth: Floats = np.hypot(along[:, 0], along[:, 1])
            return depth
        return np.asarray(np.linalg.norm(along, axis=1))

    def pose(self, row: int) -> NeedlePose:
        """Return one pose in the plane."""
        x, y, tx, ty, speed = (float(v) for v in self.poses[row])
        return NeedlePose((x, y), (tx, ty), speed)

    def to_bytes(self) -> bytes:
        """Compress to bytes for storage."""
        n, k, D = len(self), self.watched.shape[1], self.dimension
        head = [self.period, n, k] if D == 2 else [IN_SPACE, self.period, n, k]
        rows = np.hstack([self.poses, self.watched.reshape(n, D * k)])
        return np.array(head, "<f8").tobytes() + zlib.compress(rows.astype("<f8").tobytes())

    @classmethod
    def from_bytes(cls, data: bytes) -> Trace:
        """Read what `to_bytes` wrote; sizes are checked before anything is decompressed.

        Raises
        ------
        InputError
            If the bytes are not a trace.
        """
        D = 3 if data[:8] == np.array([IN_SPACE], "<f8").tobytes() else 2
        data = data[8:] if D == 3 else data
        if len(data) < 24:
            raise InputError("a stored trace is cut short")
        period, n, k = np.frombuffer(data[:24], "<f8")
        if not (isfinite(period) and period > 0 and 0 <= n <= MOST_ROWS and 0 <= k <= MOST_WATCHED):
            raise InputError("a stored trace has no valid head")
        columns = 2 * D + 1 + D * int(k)
        size = int(n) * columns * 8
        inflate = zlib.decompressobj()
        try:
            content = inflate.decompress(data[24:], size + 1)
        except zlib.error as error:
            raise InputError("a stored trace is damaged") from error
        if len(content) != size or not inflate.eof:
            raise InputError("a stored trace has another length than its head says")
        rows = np.frombuffer(content, "<f8").reshape(int(n), columns)
        if not np.isfinite(rows).all():
            raise InputError("a stored trace has numbers that are not finite")
        poses, watched = rows[:, : 2 * D + 1], rows[:, 2 * D + 1 :]
        return cls(float(period), poses.copy(), watched.reshape(int(n), int(k), D).copy())


class Recorder:
    """Collects the rows of a `Trace`; observe an engine with it.

    A reset of the engine starts a new recording, and frozen time is not recorded. The recording ends
    after ``longest`` seconds.
    """

    def __init__(self, period: float, longest: float) -> None:
        self.period = period
        self._most = max(1, round(longest / period))
        self._time = 0.0
        self._rows: list[tuple[float, ...]] = []
        self._watched: list[Floats] = []

    def __call__(self, snapshot: Snapshot) -> None:
        """Record one snapshot."""
        if snapshot.time < self._time:
            self._rows, self._watched = [], []
        moved, self._time = snapshot.time != self._time, snapshot.time
        if moved and not self.over:
            pose = snapshot.pose
            self._rows.append((*pose.entry, *pose.tip, pose.speed))
            self._watched.append(snapshot.watched)

    @property
    def over(self) -> bool:
        """Whether the time is up."""
        return len(self._rows) >= self._most

    @property
    def elapsed(self) -> float:
        """Recorded so far, s."""
        return self.period * len(self._rows)

    def trace(self) -> Trace:
        """Return the recording so far."""
        if not self._rows:
            return Trace(self.period, np.empty((0, 5)), np.empty((0, 1, 2)))
        count = min(len(self._rows), len(self._watched))
        return Trace(self.period, np.array(self._rows[:count]), np.stack(self._watched[:count]))
