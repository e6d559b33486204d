"""Identification in space: parameters with which a spatial model moves the picture as it was seen to move.

No field of the law that sticks, slips and cuts is linear in its parameters, so whole runs are simulated: one at the parameters, one beside it for
each of them, then the step that is best if the field were linear (least squares or least distances), taken as far as it helps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.mechanics.protocol import SpatialTissueModel
from echospline.picture.slices import origins
from echospline.scenario import Scenario
from echospline.scenario.space_models import build_spatial_model
from echospline.scene import MOVED, Floats, SpatialGrid, Tissue, distance, field_error
from echospline.study.identify import (
    CONFOUNDED,
    Identification,
    Objective,
    confounding,
    least_distances,
    mean_over_frames,
)

FITTED = {
    "green": ("tip", "friction_limit"),
    "fem": ("tip", "friction_limit"),
    "tps": ("sigma", "alpha1", "alpha2"),
    "elastic": ("sigma", "alpha1", "alpha2"),
}
"""Parameters that are found, by model: those of [model.forces] or of [model.landmarks]."""
BESIDE = 0.05
"""Share of a parameter by which it is changed to see its effect: less is lost in where tissue begins to slip, more is not the slope."""
FURTHEST = 3.0
"""Factor by which a parameter may change in one step: beyond, the field is not linear."""
WELL = 0.1
"""Share by which the error has to fall in the directions that the observation determines, or all directions are tried as well."""
CLOSE, EXACT = 2e-3, 1e-5
"""Relative change of the error, and its share of the motion, below which the search ends."""


@dataclass(frozen=True, eq=False)
class SeenRun:
    """What a picture showed of tissue at some times of a run.

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Places in the first picture, in the probe's frame, mm.
    times : ndarray, shape (f,)
        s from the start of the run, ascending: every time at which the run was stepped.
    chosen : ndarray of int, shape (k,)
        Which of them were observed.
    displacement : ndarray, shape (k, n, 2)
        Seen in the picture, mm; nan where tissue was not followed. It holds the motion of the probe.
    """

    points: Floats
    times: Floats
    chosen: NDArray[np.intp]
    displacement: Floats


class PictureRuns:
    """Simulates the motion that a picture shows, for a scenario with other values of its model's parameters.

    Parameters
    ----------
    scenario : Scenario
        With a [space] table and the kind of the model.
    grid, tissue
        Mesh and tissue in space.
    seen : SeenRun
        Points and times.
    """

    def __init__(self, scenario: Scenario, grid: SpatialGrid, tissue: Tissue, seen: SeenRun) -> None:
        if scenario.space is None:
            raise InputError("this scenario is no scene in space: it has no [space] table")
        self.scenario, self.grid, self.tissue, self.seen = scenario, grid, tissue, seen
        self.insertion = scenario.space.needle.insertion()
        self._start = float(self.insertion.times[0])
        path = scenario.space.probe.planes(self.insertion)
        self.planes = [path.at(self._start + float(t)) for t in seen.times]
        self.runs = 0

    @property
    def names(self) -> Sequence[str]:
        """Names of the parameters."""
        return FITTED[self.scenario.model.kind]

    @property
    def table(self) -> str:
        """Name of their table in [model]."""
        return "forces" if self.scenario.model.kind in ("green", "fem") else "landmarks"

    def still(self) -> Floats:
        """Return what still tissue would show, (k, n, 2) mm: the motion of the probe alone."""
        at = self.planes[0].lift(self.seen.points)
        return np.array([self.planes[k].lower(at)[:, :2] - self.seen.points for k in self.seen.chosen])

    def with_values(self, values: Mapping[str, float]) -> Scenario:
        """Return the scenario with values of its parameters."""
        return self.scenario.with_values({f"model.{self.table}.{n}": float(v) for n, v in values.items()})

    def run(self, values: Mapping[str, float]) -> Floats:
        """Simulate, and return the displacement in the picture, shape (k, n, 2) mm."""
        self.runs += 1
        model: SpatialTissueModel[Any] = build_spatial_model(self.with_values(values), self.grid, self.tissue)
        times, longest, wanted = self.seen.times, self.scenario.output.longest_step, set(self.seen.chosen)
        state, shown = model.rest(), []
        start = self.planes[0].lift(self.seen.points)
        for k, t in enumerate(times):
            if k:
                steps = max(1, ceil(float(t - times[k - 1]) / longest - 1e-9))
                for i in range(1, steps + 1):
                    now = times[k - 1] + (t - times[k - 1]) * i / steps
                    state = model.advance(
                        state, self.insertion.pose(self._start + float(now)), float(t - times[k - 1]) / steps
                    )
            if k == 0 and self.insertion.pose(self._start + float(t)).depth > 0:
                # the needle is in when the recording begins: the points' tissue has moved already
                state = model.advance(state, self.insertion.pose(self._start + float(t)), longest)
                start, _, _ = origins(start, model.field(state), 1e-3)
            if k in wanted:
                moved = start + model.field(state)(start)
                shown.append(self.planes[k].lower(moved)[:, :2] - self.seen.points)
        return np.array(shown)


def fit_in_space(
    runs: PictureRuns,
    objective: Objective = "mae",
    *,
    start: Mapping[str, float] | None = None,
    most: int = 8,
    bootstrap: int = 200,
    seed: int = 0,
    report: Callable[[str], None] | None = None,
) -> Identification:
    """Find the parameters with which simulated pictures move as seen.

    Parameters
    ----------
    runs : PictureRuns
        The scene and the observation.
    objective : {"mae", "rmse"}
        The error to minimise, equation (24).
    start : mapping, optional
        Where to begin; the scenario's own values when not given. One that is 0 or less begins at 0.001: a step only multiplies.
    most : int
        Steps at most.
    bootstrap : int
        Resamples of the frames for the intervals, with the last linear field; 0 for none.
    seed : int
        Of the bootstrap.
    report : callable, optional
        Called with a line about each step.

    Returns
    -------
    Identification
        Error, map and field are of the tissue's motion in the picture, the probe's own taken away.

    Raises
    ------
    InputError
        If the objective is unknown, or the observation holds no motion but the probe's.
    """
    if objective not in ("mae", "rmse"):
        raise InputError(f'objective is "mae" or "rmse"; got {objective!r}')
    began = perf_counter()
    names, still = list(runs.names), runs.still()
    observed = runs.seen.displacement - still
    seen = distance(observed, np.zeros_like(observed)) > MOVED
    if not seen.any():
        raise InputError("the picture shows no motion but the probe's own, so there is nothing to identify")
    section = getattr(runs.scenario.model, runs.table)
    own = {n: float(getattr(section, n)) for n in names}
    values = {n: v if v > 0 else 1e-3 for n, v in {**own, **(start or {})}.items()}

    def simulated(v: Mapping[str, float]) -> tuple[Floats, float]:
        field = runs.run(v) - still
        return field, float(getattr(field_error(field, observed), objective))

    field, cost = simulated(values)
    scale = float(distance(observed, np.zeros_like(observed))[seen].mean())
    for step in range(most):
        slopes = _slopes(runs, values, field + still)
        at, before = np.array([values[n] for n in names]), cost
        missing, even = (observed - field)[seen], np.ones(int(seen.sum()))
        for basis in _bases(slopes[seen], at):
            along = least_distances(slopes[seen] @ basis, missing, even, objective, 1e-6 * scale, 1e-6)
            move = _reached(at, basis @ along)
            for part in (1.0, 0.5, 0.25, 0.125):
                trial = dict(zip(names, map(float, at + part * move), strict=True))
                new, new_cost = simulated(trial)
                if new_cost < cost:
                    field, cost, values = new, new_cost, trial
                    break
            if before - cost > WELL * before:
                break
        if report is not None:
            report(
                f"step {step + 1}: {objective} {cost:.4f} mm, {', '.join(f'{n} {v:.4g}' for n, v in values.items())}"
            )
        if before - cost < CLOSE * before or cost < EXACT * scale:
            break
    slopes = _slopes(runs, values, field + still)
    seconds = perf_counter() - began
    condition, sentences = confounding(names, slopes[seen].reshape(-1, len(names)))
    intervals = _intervals(slopes, observed - field, seen, values, objective, bootstrap, seed, scale)
    return Identification(
        values,
        field_error(field, observed),
        intervals,
        condition,
        sentences,
        mean_over_frames(distance(field, observed)),
        field,
        "simulated",
        runs.runs,
        seconds,
    )


def _bases(slopes: Floats, values: Floats) -> list[Floats]:
    """Return directions (p, k) for a step: those that the observation determines first, then all.

    Parameters
    ----------
    slopes : ndarray, shape (m, 2, p)
        Field per unit of each parameter.
    values : ndarray, shape (p,)
        The parameters, which scale the directions.
    """
    J = slopes.reshape(-1, len(values)) * values
    eigenvalues, vectors = np.linalg.eigh(J.T @ J)
    singular = np.sqrt(np.maximum(eigenvalues, 0.0))
    kept = singular * CONFOUNDED >= singular[-1]
    whole = np.diag(values)
    return [whole] if kept.all() else [whole @ vectors[:, kept], whole]


def _reached(values: Floats, move: Floats) -> Floats:
    """Shorten a move of parameters (p,) so that none changes by more than `FURTHEST`; it keeps its direction."""
    limit = np.where(move > 0, (FURTHEST - 1.0) * values, (1.0 - 1.0 / FURTHEST) * values)
    return move * min(1.0, float((limit / np.maximum(np.abs(move), 1e-300)).min()))


def _slopes(runs: PictureRuns, values: Mapping[str, float], field: Floats) -> Floats:
    """Return the change of the field per unit of each parameter, shape (k, n, 2, p)."""
    slopes = []
    for name, value in values.items():
        h = BESIDE * value
        slopes.append((runs.run({**values, name: value + h}) - field) / h)
    return np.stack(slopes, axis=-1)


def _intervals(
    slopes: Floats,
    rest: Floats,
    seen: NDArray[np.bool_],
    values: Mapping[str, float],
    objective: Objective,
    resamples: int,
    seed: int,
    scale: float,
) -> dict[str, tuple[float, float]]:
    """Return 95 % intervals of the parameters when frames are drawn again with replacement and the field is linear around the found ones."""
    if resamples <= 0:
        return {}
    rng = np.random.default_rng(seed)
    frames, frame = len(rest), np.nonzero(seen)[0]
    A, b = slopes[seen], rest[seen]
    draws = []
    for _ in range(resamples):
        weight = np.bincount(rng.integers(0, frames, frames), minlength=frames).astype(float)[frame]
        keep = weight > 0
        if keep.any():
            draws.append(least_distances(A[keep], b[keep], weight[keep], objective, 1e-6 * scale, 1e-4))
    low, high = np.percentile(draws, [2.5, 97.5], axis=0)
    return {n: (v + float(a), v + float(c)) for (n, v), a, c in zip(values.items(), low, high, strict=True)}
