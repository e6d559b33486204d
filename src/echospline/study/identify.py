"""Identification: parameters with which a tissue model fits observed displacements, and the limits of the data.

Linear parameters are solved for, in closed form (least squares, RMSE) or by iteratively reweighted least squares
(least sum of distances, MAE); only the others are searched. `grid_search` is the paper's brute force.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from time import perf_counter
from typing import Literal

import numpy as np
from scipy.optimize import minimize
from scipy.stats import qmc

from echospline.errors import InputError
from echospline.scene import MOVED, FieldError, Floats, distance, field_error
from echospline.study.unit_fields import UnitFields

Objective = Literal["mae", "rmse"]

CONFOUNDED = 30.0
"""Condition number of the scaled Jacobian above which parameters count as confounded (Belsley et al. 1980)."""


@dataclass(frozen=True)
class Identification:
    """Parameters found, their fit and their uncertainty.

    Attributes
    ----------
    values : dict
        Parameter values by name.
    error : FieldError
        Of the fitted field against the observation.
    intervals : dict
        95 % bootstrap interval of each linear parameter, by name; the searched ones are held fixed.
    condition : float
        Condition number of the Jacobian with unit columns: above `CONFOUNDED`, see ``confounded``.
    confounded : tuple of str
        One sentence per combination of parameters that the data do not determine.
    error_map : ndarray, shape (n,)
        Mean distance per point over the frames, mm; nan where a point was never tracked.
    field : ndarray, shape (frames, n, 2)
        The fitted field, mm.
    method : str
        "closed", "grid" or, in space, "simulated".
    runs : int
        Fields evaluated (closed) or simulations run (the others).
    seconds : float
        Time taken, bootstrap not included.
    """

    values: dict[str, float]
    error: FieldError
    intervals: dict[str, tuple[float, float]]
    condition: float
    confounded: tuple[str, ...]
    error_map: Floats
    field: Floats = field(repr=False)
    method: str = "closed"
    runs: int = 0
    seconds: float = 0.0


def identify(
    fields: UnitFields,
    objective: Objective = "mae",
    *,
    seed: int = 0,
    starts: int = 2,
    bootstrap: int = 200,
) -> Identification:
    """Find the parameters that explain an observation best.

    Parameters
    ----------
    fields : UnitFields
        The model's fields per unit of its linear parameters, and the observation.
    objective : {"mae", "rmse"}
        The error to minimise, equation (24).
    seed : int
        Of the starting points of the search and the bootstrap.
    starts : int
        Number of the best points of a coarse search over all levels from which the descent starts.
    bootstrap : int
        Resamples of the frames for the intervals; 0 for none.

    Raises
    ------
    InputError
        If the observation moves no point that the model can move.
    """
    if objective not in ("mae", "rmse"):
        raise InputError(f'objective is "mae" or "rmse"; got {objective!r}')
    began = perf_counter()
    problem = _Problem(fields)
    names = list(fields.search)
    low, high = np.array([fields.search[n] for n in names]).reshape(-1, 2).T

    def theta(level: Mapping[str, float], z: Floats) -> dict[str, float]:
        between = low * (high / low) ** np.clip(z, 0.0, 1.0)
        return dict(level) | dict(zip(names, map(float, between), strict=True))

    levels = [
        dict(zip(fields.levels, map(float, chosen), strict=True))
        for chosen in product(*fields.levels.values())
    ]
    # A coarse search by least squares, which is cheapest; then a descent from the best few points.
    places = qmc.Sobol(len(names), seed=seed).random_base2(2 + len(names)) if names else np.zeros((1, 0))
    looked = [(problem.solve(theta(level, z), "rmse")[1], level, z) for level in levels for z in places]
    looked.sort(key=lambda look: look[0])
    ends: list[tuple[float, dict[str, float]]] = []
    for _, level, place in looked[: max(1, starts)]:
        z = _descend(partial(_cost, problem, theta, level, objective), place)
        found, value = problem.solve(theta(level, z), objective, exact=True)
        ends.append((value, theta(level, z) | found))
    best = min(ends, key=lambda end: end[0])
    values = best[1]
    seconds = perf_counter() - began
    A = problem.fields.fields(values)
    fitted = A @ np.array([values[n] for n in fields.linear])
    observed = fields.observation.displacement
    condition, confounded = problem.confounded(A, values)
    intervals = problem.bootstrap(A, objective, bootstrap, seed)
    return Identification(
        values,
        field_error(fitted, observed),
        intervals,
        condition,
        confounded,
        mean_over_frames(distance(fitted, observed)),
        fitted,
        "closed",
        problem.runs,
        seconds,
    )


def grid_search(
    run: Callable[[Mapping[str, float]], Floats],
    axes: Mapping[str, Sequence[float]],
    observed: Floats,
    objective: Objective = "mae",
) -> Identification:
    """Search by brute force, as in section V of the paper: one whole simulation per combination of values.

    Parameters
    ----------
    run : callable
        Takes values by name, returns the field of every frame, (frames, n, 2) mm.
    axes : mapping
        Values to try of each parameter.
    observed : ndarray, shape (frames, n, 2)
        mm.
    objective : {"mae", "rmse"}
        The error to minimise.
    """
    began = perf_counter()
    best: tuple[float, dict[str, float], Floats] | None = None
    runs = 0
    for combination in product(*axes.values()):
        values = dict(zip(axes, (float(v) for v in combination), strict=True))
        simulated = run(values)
        runs += 1
        cost = getattr(field_error(simulated, observed), objective)
        if best is None or cost < best[0]:
            best = (cost, values, simulated)
    if best is None:
        raise InputError("a grid search needs one value or more of each parameter")
    _, values, simulated = best
    return Identification(
        values,
        field_error(simulated, observed),
        {},
        float("nan"),
        (),
        mean_over_frames(distance(simulated, observed)),
        simulated,
        "grid",
        runs,
        perf_counter() - began,
    )


def _cost(
    problem: _Problem,
    theta: Callable[[Mapping[str, float], Floats], dict[str, float]],
    level: Mapping[str, float],
    objective: Objective,
    z: Floats,
) -> float:
    return problem.solve(theta(level, z), objective)[1]


def _descend(cost: Callable[[Floats], float], z: Floats) -> Floats:
    """Descend by Nelder and Mead in the unit box: the cost is smooth but its derivative is not available."""
    if not len(z):
        return z
    end = minimize(
        cost,
        z,
        method="Nelder-Mead",
        bounds=[(0, 1)] * len(z),
        options={"maxfev": 25 * len(z), "xatol": 5e-3, "fatol": 1e-7},
    )
    return np.asarray(end.x)


class _Problem:
    """Linear least squares or least distances for fixed nonlinear parameters."""

    def __init__(self, fields: UnitFields) -> None:
        self.fields = fields
        self.rows, self.low = fields.least
        observed = fields.observation.displacement
        size = distance(observed, np.zeros_like(observed))
        self.seen = size > MOVED
        self.frame = np.nonzero(self.seen)[0]
        self.target = observed[self.seen]
        self.scale = float(size[self.seen].mean())
        self.runs = 0
        self.guess: dict[str, float] = {}

    def solve(
        self, theta: Mapping[str, float], objective: Objective, *, exact: bool = False
    ) -> tuple[dict[str, float], float]:
        """Find the best linear parameters for given others, and the objective there, mm.

        The fading of the tip's push near surfaces depends on sigma itself: the last sigma found is used for it, and
        ``exact`` repeats until it no longer changes.
        """
        names = list(self.fields.linear)
        for _ in range(20 if exact else 1):
            A = self.fields.fields(dict(theta) | self.guess)[self.seen]
            self.runs += 1
            before = self.guess
            x = self._below(names, A, objective, 1e-9 if exact else 1e-4)
            self.guess = dict(zip(names, map(float, x), strict=True))
            if all(abs(self.guess[n] - before.get(n, np.inf)) <= 1e-6 * abs(self.guess[n]) for n in names):
                break
        epsilon = np.hypot(*(A @ x - self.target).T)
        value = epsilon.mean() if objective == "mae" else np.sqrt((epsilon**2).mean())
        return dict(self.guess), float(value)

    def _below(self, names: list[str], A: Floats, objective: Objective, tolerance: float) -> Floats:
        """Solve, and hold a parameter that came out above its upper bound at that bound."""
        x = self.linear(A, self.target, objective, tolerance=tolerance)
        for name, most in self.fields.most.items():
            i = names.index(name)
            if x[i] > most:
                others = np.arange(len(names)) != i
                free = self.rows[:, i] == 0  # the rows of the others alone
                rest = self.target - A[..., i] * most
                x[i] = most
                x[others] = self.linear(
                    A[..., others],
                    rest,
                    objective,
                    tolerance=tolerance,
                    bounds=(self.rows[free][:, others], self.low[free]),
                )
        return x

    def linear(
        self,
        A: Floats,
        b: Floats,
        objective: Objective,
        weight: Floats | None = None,
        tolerance: float = 1e-6,
        bounds: tuple[Floats, Floats] | None = None,
    ) -> Floats:
        """Minimise sum |A x - b| (mae) or its squares (rmse) with lower bounds on combinations of x.

        The problem is convex: where the free minimum breaks a bound, the answer is the best of the minima on the faces that
        the bounds have, among those that break none. There are few bounds, so all faces are tried.
        """
        rows, low = bounds or (self.rows, self.low)
        w = np.ones(len(b)) if weight is None else weight
        floor = 1e-6 * self.scale
        x = least_distances(A, b, w, objective, floor, tolerance)
        if (rows @ x >= low).all():
            return x
        back = np.linalg.inv(rows)
        B = A @ back  # the unknowns y = rows x have the bounds themselves
        found: list[tuple[float, Floats]] = []
        for face in product((False, True), repeat=len(low)):
            held = np.array(face)
            y = low.copy()
            if not held.all():
                rest = b - B[..., held] @ y[held]
                y[~held] = least_distances(B[..., ~held], rest, w, objective, floor, tolerance)
            if held.any() and (y >= low).all():
                epsilon = np.hypot(*(B @ y - b).T)
                found.append((float(w @ (epsilon if objective == "mae" else epsilon**2)), y))
        x = back @ min(found, key=lambda end: end[0])[1]
        return x

    def confounded(self, A: Floats, values: Mapping[str, float]) -> tuple[float, tuple[str, ...]]:
        """Return the condition of the Jacobian with unit columns, and one sentence per small singular vector."""
        names = list(self.fields.linear)
        return confounding(names, A[self.seen].reshape(-1, len(names)))

    def bootstrap(
        self, A: Floats, objective: Objective, resamples: int, seed: int
    ) -> dict[str, tuple[float, float]]:
        """Estimate 95 % intervals of the linear parameters when the frames are drawn again with replacement."""
        if resamples <= 0:
            return {}
        rng = np.random.default_rng(seed)
        frames = A.shape[0]
        seen = A[self.seen]
        draws = []
        for _ in range(resamples):
            count = np.bincount(rng.integers(0, frames, frames), minlength=frames).astype(float)
            weight = count[self.frame]
            if weight.any():
                keep = weight > 0
                draws.append(self.linear(seen[keep], self.target[keep], objective, weight[keep]))
        low, high = np.percentile(draws, [2.5, 97.5], axis=0)
        return {n: (float(a), float(b)) for n, a, b in zip(self.fields.linear, low, high, strict=True)}


def confounding(names: Sequence[str], J: Floats) -> tuple[float, tuple[str, ...]]:
    """Return the condition of a Jacobian (m, p) with unit columns, and one sentence per small singular vector."""
    norm = np.sqrt((J**2).sum(axis=0))
    sentences = [f"{n} leaves no trace in these frames" for n, s in zip(names, norm, strict=True) if s == 0]
    live = norm > 0
    if not live.any():
        return np.inf, tuple(sentences)
    gram = (J[:, live] / norm[live]).T @ (J[:, live] / norm[live])
    eigenvalues, vectors = np.linalg.eigh(gram)
    singular = np.sqrt(np.maximum(eigenvalues, 0))
    condition = float(singular[-1] / singular[0]) if singular[0] > 0 else np.inf
    alive = [n for n, keep in zip(names, live, strict=True) if keep]
    for s, v in zip(singular, vectors.T, strict=True):
        if s * CONFOUNDED < singular[-1]:
            direction = v / norm[live]
            lead = int(np.argmax(np.abs(v)))
            part = [i for i in range(len(v)) if abs(v[i]) > 0.2]
            others = ", ".join(
                f"{direction[i] / direction[lead]:+.3g} of {alive[i]}" for i in part if i != lead
            )
            sentences.append(
                f"{' and '.join(alive[i] for i in part)} cannot be told apart: +1 of {alive[lead]} with {others} "
                "changes almost nothing"
            )
    return (condition if live.all() else np.inf), tuple(sentences)


def least_distances(
    A: Floats, b: Floats, w: Floats, objective: Objective, floor: float, tolerance: float
) -> Floats:
    """Solve A x = b in weighted least squares (rmse), or least distances (mae) by reweighting (Weiszfeld), which converges because it is convex.

    Parameters
    ----------
    A, b : ndarray, shape (m, 2, p) and (m, 2)
        Fields per unit, and the field to meet.
    w : ndarray, shape (m,)
        Weights.
    objective : {"mae", "rmse"}
        What is made least.
    floor : float
        Distance below which a point counts as met, in the unit of b.
    tolerance : float
        Relative fall of the sum below which reweighting ends.
    """
    p = A.shape[-1]
    flat, target = A.reshape(-1, p), b.reshape(-1)

    def squares(weight: Floats) -> Floats:
        each = np.repeat(weight, 2)
        normal = (flat * each[:, None]).T @ flat
        solution: Floats = np.asarray(np.linalg.lstsq(normal, flat.T @ (each * target), rcond=1e-13)[0])
        return solution

    x = squares(w)
    if objective == "rmse":
        return x
    before = np.inf
    for _ in range(100):
        epsilon = np.hypot(*(flat @ x - target).reshape(-1, 2).T)
        now = float(w @ epsilon)
        if before - now <= tolerance * now:
            break
        before = now
        x = squares(w / np.maximum(epsilon, floor))
    return x


def mean_over_frames(epsilon: Floats) -> Floats:
    """Return the mean of distances (frames, n) over the frames in which each point was followed, (n,); nan where it never was."""
    tracked = np.isfinite(epsilon)
    count = tracked.sum(axis=0)
    total = np.where(tracked, epsilon, 0.0).sum(axis=0)
    mean: Floats = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean
