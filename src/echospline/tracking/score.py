"""How far tracked motion is from the true one, in the plane and in pictures of a scene in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from echospline.errors import InputError
from echospline.scene import Floats
from echospline.tracking.tracker import Track
from echospline.tracking.tracks import TrackRecord

TRUSTED = 0.3
"""Confidence from which a tracked point counts."""
OUTLIER = 0.1
"""mm; a point that misses by this much or more is an outlier, as in the tables of `docs/laboratory.md`."""
SAME_TIME = 1e-3
"""s; how far a tracked frame may lie outside the times of the truth: containers round times."""


@dataclass(frozen=True)
class Score:
    """Error of tracked motion; every frame after the first, every point.

    Parameters
    ----------
    points : int
        Points and frames that count: trusted, and with a truth.
    axial_um, lateral_um : float
        Root mean square error, micrometres; nan where no point counts.
    outliers : float
        Share of them that misses by `OUTLIER` or more.
    motion_um : float
        Root mean square of their true motion, micrometres.
    followed : float
        Share of the points with a truth that is trusted; nan without any.
    gone_trusted : float
        Share of the points without a truth (tissue that left the slice or the picture) that is trusted all the same; nan where there is none.
    """

    points: int
    axial_um: float
    lateral_um: float
    outliers: float
    motion_um: float
    followed: float
    gone_trusted: float


def score(found: Track, truth: TrackRecord) -> Score:
    """Compare tracked motion with the true one.

    The truth is interpolated between its points (bilinear) and times (linear); it counts where all the points and times around have it.

    Raises
    ------
    InputError
        If the truth's points are no regular grid, or its times do not span those of the track.
    """
    motion, known = true_motion(truth, found.points, found.times)
    error = found.displacement[1:] - motion[1:]
    known, trusted = known[1:], found.confidence[1:] >= TRUSTED
    counts = known & trusted
    lateral, axial = (_rms(error[..., i][counts]) for i in (0, 1))
    missed = np.hypot(*error[counts].T) >= OUTLIER
    return Score(
        int(counts.sum()),
        1e3 * axial,
        1e3 * lateral,
        _mean(missed),
        1e3 * _rms(np.hypot(*motion[1:][counts].T)),
        _mean(trusted[known]),
        _mean(trusted[~known]),
    )


def truth_doubts(found: Track, truth: TrackRecord) -> list[str]:
    """Return the doubt that a truth is that of another cine: of one that lasts another time, by more than a frame."""
    times, known = np.asarray(found.times), np.asarray(truth.motion.times)
    lasts, other = float(times[-1] - times[0]), float(known[-1] - known[0])
    frame = float(np.median(np.diff(times)))
    if abs(other - lasts) <= frame * 1.001:
        return []
    return [
        f"the truth lasts {other:.4g} s and the cine {lasts:.4g} s: if it is not the displacement.npz of the run that made this cine, the "
        "distances from it mean nothing"
    ]


def true_motion(truth: TrackRecord, points: Floats, times: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return a record's motion at other points (n, 2) mm and times (f,) s: displacement (f, n, 2) mm, and where it has one, (f, n) of bool.

    Raises
    ------
    InputError
        If the record's points are no regular grid, or its times do not span the others.
    """
    record = truth.motion
    grid, own = record.grid(), record.times
    if len(own) < 2:
        raise InputError("a truth has two frames or more; got one")
    if times[0] < own[0] - SAME_TIME or times[-1] > own[-1] + SAME_TIME:
        raise InputError(
            f"the truth spans {own[0]:g} to {own[-1]:g} s, the track {times[0]:g} to {times[-1]:g} s: are both of one run?"
        )
    nx, ny = grid.shape
    index = ((points - grid.origin) / grid.spacing).T[::-1]
    inside = ((index >= -1e-6) & (index <= np.array([[ny - 1], [nx - 1]]) + 1e-6)).all(axis=0)
    values = np.concatenate([record.displacement, truth.confidence[..., None]], axis=2)

    def at(frame: int) -> Floats:
        layers = values[frame].reshape(ny, nx, 3)
        return np.stack(
            [map_coordinates(layers[..., i], index, order=1, mode="nearest") for i in range(3)], axis=1
        )

    out = np.empty((len(times), len(points), 3))
    for k, t in enumerate(times):
        j = int(np.clip(np.searchsorted(own, t), 1, len(own) - 1))
        share = float(np.clip((t - own[j - 1]) / (own[j] - own[j - 1]), 0.0, 1.0))
        out[k] = (1 - share) * at(j - 1) + share * at(j)
    return out[..., :2], (out[..., 2] > 1.0 - 1e-9) & inside


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _mean(values: NDArray[np.bool_]) -> float:
    return float(values.mean()) if values.size else float("nan")
