"""The paper's experiment (Figs. 4 and 5): motion tracked ahead of the tip against models that were fitted to it.

A region of 200 points in 2 x 3 mm travels ahead of the tip. At several insertion depths its motion since the first
frame is tracked; every model is fitted to all of them by least RMSE, compared frame by frame, and a paired test
decides whether two models differ. A second fit on every other depth predicts the depths between, which it does not use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

from echospline.errors import InputError
from echospline.laboratory import Displacement
from echospline.scene import Cine, EchoCine, Floats, Insertion, NeedlePose, RegularGrid
from echospline.study.identify import Identification, identify
from echospline.study.unit_fields import Observation, UnitFields
from echospline.tracking import Tracker, region_ahead, track

Where = Literal["region", "field"]
Fields = Callable[[Observation], UnitFields]
"""Builds a model's unit fields for an observation."""


@dataclass(frozen=True)
class Regions:
    """Tracked motion of the travelling region at several depths, and of a coarse grid over the picture.

    Parameters
    ----------
    frames : tuple of int
        The k frames of the cine that were used.
    times : ndarray, shape (k,)
        s.
    poses : tuple of NeedlePose
        The needle in them.
    points : ndarray, shape (k, n, 2)
        The region's material points, mm.
    displacement : ndarray, shape (k, n, 2)
        Tracked since the first frame, mm.
    confidence : ndarray, shape (k, n)
        0 to 1.
    grid : RegularGrid
        Of the coarse points.
    map : ndarray, shape (k, grid.size, 2)
        Their tracked displacement, nan where the confidence is too low, mm.
    """

    frames: tuple[int, ...]
    times: Floats
    poses: tuple[NeedlePose, ...]
    points: Floats
    displacement: Floats
    confidence: Floats
    grid: RegularGrid
    map: Floats

    def observation(
        self, chosen: Sequence[int], where: Where = "region", threshold: float = 0.3
    ) -> Observation:
        """Return the observation for some of the depths: the region's points in their own frame, or all trusted points."""
        if where == "field":
            poses = [self.poses[i] for i in chosen]
            return Observation(self.grid.nodes, self.map[list(chosen)], self.times[list(chosen)], poses)
        k, n = len(chosen), self.points.shape[1]
        u = np.full((k, k * n, 2), np.nan)
        for row, i in enumerate(chosen):
            seen = self.confidence[i] >= threshold
            u[row, row * n : (row + 1) * n][seen] = self.displacement[i][seen]
        points = self.points[list(chosen)].reshape(-1, 2)
        return Observation(points, u, self.times[list(chosen)], [self.poses[i] for i in chosen])


def regions(
    cine: Cine | EchoCine,
    insertion: Insertion,
    tracker: Tracker,
    *,
    depths: int = 8,
    shallowest: float = 2.0,
    distance: float = 4.0,
    size: tuple[float, float] = (2.0, 3.0),
    mask: float = 1.0,
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> Regions:
    """Track the region ahead of the tip at evenly spaced insertion depths.

    Parameters
    ----------
    cine : Cine or EchoCine
        Frame 0 shows the tissue before the needle.
    insertion : Insertion
        The needle, on the cine's clock and coordinates.
    tracker : Tracker
    depths : int
        Number of frames used.
    shallowest : float
        Depth of the first one, mm.
    distance : float
        From the tip to the region's centre, mm.
    size : (float, float)
        Of the region, mm.
    mask : float
        Half width of the masked needle, mm.
    progress : callable
        Wraps the iteration over frames.

    Raises
    ------
    InputError
        If the needle does not push far enough inside the recording, or the region leaves the picture.
    """
    poses = [insertion.pose(float(t)) for t in cine.times]
    depth = np.array([pose.depth for pose in poses])
    pushing = np.array([pose.speed > 0 for pose in poses])
    if depths < 3:
        raise InputError(f"the protocol needs three depths or more; got {depths}")
    usable = [
        k
        for k in range(1, len(poses))
        if pushing[k]
        and depth[k] >= shallowest
        and cine.grid.contains(region_ahead(poses[k], distance, size)).all()
    ]
    if len(usable) < depths:
        raise InputError(
            f"the recording has {len(usable)} frames in which the needle pushes, is {shallowest:g} mm deep or more and "
            f"has the region {distance:g} mm ahead inside the picture; the protocol needs {depths}"
        )
    wanted = np.linspace(depth[usable[0]], depth[usable[-1]], depths)
    frames = tuple(sorted({usable[int(np.abs(depth[usable] - d).argmin())] for d in wanted}))
    points = np.stack([region_ahead(poses[k], distance, size) for k in frames])
    x0, x1, y0, y1 = cine.grid.extent
    grid = RegularGrid((41, 41), ((x1 - x0) / 40, (y1 - y0) / 40), (x0, y0))
    every = np.concatenate([points.reshape(-1, 2), grid.nodes])
    found = track(cine, every, tracker, needle=list(poses), needle_radius=mask, progress=progress)
    k, n = points.shape[:2]
    # index [i, j]: frame of depth i, points of depth j; only the diagonal is the region of its own frame
    u = found.displacement[list(frames)]
    quality = found.confidence[list(frames)]
    own = np.arange(k)
    whole = np.where(quality[:, k * n :, None] >= 0.3, u[:, k * n :], np.nan)
    return Regions(
        frames,
        np.asarray(cine.times, dtype=np.float64)[list(frames)],
        tuple(poses[i] for i in frames),
        points,
        u[:, : k * n].reshape(k, k, n, 2)[own, own],
        quality[:, : k * n].reshape(k, k, n)[own, own],
        grid,
        whole,
    )


@dataclass(frozen=True)
class Fit:
    """One model against the tracked regions.

    Parameters
    ----------
    values : dict
        Parameters fitted to all depths.
    rmse : ndarray, shape (k,)
        Fitted field against tracked motion per depth, mm.
    held_out : dict
        Depth index -> RMSE of the prediction by the fit to the other half of the depths, against tracked motion.
    held_out_true, held_out_field : dict
        The same against the true motion, of the region and of the coarse grid; empty where it is not known.
    map : ndarray, shape (k, grid.size, 2)
        Fitted field on the coarse grid, mm.
    """

    values: dict[str, float]
    rmse: Floats
    held_out: dict[int, float]
    held_out_true: dict[int, float]
    held_out_field: dict[int, float]
    map: Floats


def fit(
    seen: Regions,
    fields: Fields,
    truth: Sequence[Displacement] | None = None,
    *,
    where: Where = "region",
    seed: int = 0,
) -> Fit:
    """Fit one model to all depths, and predict every depth from those of the other parity.

    Parameters
    ----------
    seen : Regions
    fields : callable
        The model.
    where : {"region", "field"}
        Fitted to the region ahead of the tip, as in the paper, or to all tracked points. Errors are of the region
        in either case.
    truth : sequence of Displacement, optional
        True displacement at each of the depths' frames.
    seed : int
        Of the search.
    """
    k = len(seen.frames)
    whole = _identified(seen, fields, list(range(k)), where, seed)
    rmse = np.array([_rmse(_field(seen, fields, whole, i, seen.points[i]), seen, i) for i in range(k)])
    held: dict[int, float] = {}
    held_true: dict[int, float] = {}
    held_field: dict[int, float] = {}
    for parity in (0, 1):
        part = _identified(seen, fields, list(range(1 - parity, k, 2)), where, seed)
        for i in range(parity, k, 2):
            u = _field(seen, fields, part, i, seen.points[i])
            held[i] = _rmse(u, seen, i)
            if truth is not None:
                held_true[i] = root_mean_square(u - truth[i](seen.points[i]))
                inside = seen.poses[i].closest(seen.grid.nodes)[1] > 1.0
                nodes = seen.grid.nodes[inside]
                held_field[i] = root_mean_square(_field(seen, fields, part, i, nodes) - truth[i](nodes))
    maps = np.stack([_field(seen, fields, whole, i, seen.grid.nodes) for i in range(k)])
    return Fit(whole.values, rmse, held, held_true, held_field, maps)


def _identified(seen: Regions, fields: Fields, chosen: list[int], where: Where, seed: int) -> Identification:
    return identify(fields(seen.observation(chosen, where)), "rmse", seed=seed, bootstrap=0)


def _field(seen: Regions, fields: Fields, found: Identification, i: int, points: Floats) -> Floats:
    """Return the displacement of points at depth i with the parameters found, shape (n, 2) mm."""
    # an observation must displace something; its values do not enter the field
    ask = Observation(points, np.ones((1, len(points), 2)), seen.times[[i]], [seen.poses[i]])
    model = fields(ask)
    return np.asarray(model.fields(found.values)[0] @ np.array([found.values[n] for n in model.linear]))


def root_mean_square(error: Floats) -> float:
    """Return the root of the mean squared length of vectors (n, 2)."""
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


def _rmse(u: Floats, seen: Regions, i: int) -> float:
    trusted = seen.confidence[i] >= 0.3
    if not trusted.any():
        raise InputError(
            f"no point of the region is tracked reliably at {seen.times[i]:.2f} s: choose other depths or a larger distance"
        )
    return root_mean_square((u - seen.displacement[i])[trusted])


def paired(a: Floats, b: Floats) -> dict[str, Any]:
    """Test whether two models' RMSE per frame differ: paired t test, Wilcoxon's signed ranks, 95 % interval of the mean.

    A large p does not show that they are the same; the interval bounds their difference.
    """
    d = np.asarray(a) - np.asarray(b)
    n = len(d)
    if n < 3:
        raise InputError(f"a paired test needs three frames or more; got {n}")
    half = float(stats.t.ppf(0.975, n - 1) * d.std(ddof=1) / np.sqrt(n))
    same = bool(np.ptp(d) == 0)
    return {
        "frames": n,
        "mean_difference_mm": float(d.mean()),
        "interval_95_mm": [float(d.mean()) - half, float(d.mean()) + half],
        "p_t": None if same else float(stats.ttest_rel(a, b).pvalue),
        "p_wilcoxon": None if same else float(stats.wilcoxon(a, b).pvalue),
    }


def tracker_error(seen: Regions, truth: Sequence[Displacement]) -> Floats:
    """Return the RMSE of the tracker itself in the region of each depth, mm, shape (k,)."""
    out = []
    for i, true in enumerate(truth):
        trusted = seen.confidence[i] >= 0.3
        out.append(root_mean_square((seen.displacement[i] - true(seen.points[i]))[trusted]))
    return np.array(out)


def compared(fits: Mapping[str, Fit]) -> dict[str, dict[str, Any]]:
    """Run paired tests of every two models over the depths: of the fits and of the held-out predictions."""
    names = list(fits)
    out: dict[str, dict[str, Any]] = {}
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            held = [np.array([fits[m].held_out[k] for k in sorted(fits[m].held_out)]) for m in (a, b)]
            out[f"{a} - {b}"] = {"fit": paired(fits[a].rmse, fits[b].rmse), "held out": paired(*held)}
    return out
