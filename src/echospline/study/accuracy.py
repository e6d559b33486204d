"""Error of each model against finite elements: the paper's comparison (Fig. 3a), extended to trajectories that were not fitted.

One case is one tissue. Finite elements step the needle through it; the other models are fitted on one oblique
insertion and evaluated on it and on others, marked ``held_out``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from time import thread_time
from typing import Any

import numpy as np

from echospline.errors import InputError
from echospline.mechanics import (
    Elastic,
    FEMModel,
    GreenModel,
    Kernel,
    Solver,
    ThinPlate,
    TPSModel,
    TPSParameters,
    ViscousForces,
    landmark_stiffness,
)
from echospline.mechanics.protocol import TissueModel
from echospline.mechanics.spline import factor
from echospline.scene import (
    Circle,
    FieldError,
    Floats,
    Insertion,
    NeedlePose,
    Region,
    RegularGrid,
    Tissue,
    field_error,
)
from echospline.study.identify import Identification, grid_search, identify
from echospline.study.unit_fields import ForceFields, Observation, SplineFields

CLAMPED = ("left", "right", "bottom")
SIZE = (40.0, 30.0)
"""mm; the mesh of the study."""
FITTED = ((12.0, 0.0), 60.0, 26.0)
"""Entry (mm), angle (degrees), depth (mm) of the insertion that parameters are fitted on: oblique, from the top."""
HELD_OUT = (((26.0, 0.0), 115.0, 22.0), ((20.0, 0.0), 90.0, 24.0), ((6.0, 0.0), 45.0, 24.0))
SPEED = 5.0
"""mm/s."""
ORACLE = 2.1
"""mm; distance to the needle's axis within which nodes are oracle landmarks."""
PRINTED = TPSParameters(loading="immediate", drag=0.0, tip="point", contact_spacing=0.0)
"""The paper's literal laws, every mesh node a possible contact: the field is linear in the alphas."""


@dataclass(frozen=True)
class Case:
    """One tissue under one needle.

    Parameters
    ----------
    name : str
        For tables and files.
    young : float
        kPa.
    friction : float
        N s/mm^2.
    lesion : (x, y, radius, young), optional
        A round region that differs, mm and kPa.
    nodes : (nx, ny)
        Of the mesh.
    steps : int
        Depths per insertion.
    radii : sequence of float
        Regularisation lengths of the elastic kernel to try, mm.
    seed : int
        Of the search.
    """

    name: str = "10 kPa"
    young: float = 10.0
    friction: float = 1e-8
    lesion: tuple[float, float, float, float] | None = None
    nodes: tuple[int, int] = (40, 30)
    steps: int = 50
    radii: Sequence[float] = (0.5, 1.0, 2.0)
    seed: int = 0

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        nx, ny = self.nodes
        return RegularGrid((nx, ny), (SIZE[0] / (nx - 1), SIZE[1] / (ny - 1)))

    @property
    def tissue(self) -> Tissue:
        """Tissue of the finite elements."""
        if self.lesion is None:
            return Tissue(self.young)
        x, y, radius, young = self.lesion
        return Tissue(self.young, regions=[Region(Circle((x, y), radius), young)])

    @property
    def forces(self) -> ViscousForces:
        """The paper's forces, at once."""
        return ViscousForces(0.4, self.friction, ramp=0.0)

    def poses(self, trajectory: tuple[tuple[float, float], float, float]) -> tuple[Floats, list[NeedlePose]]:
        """Return the times (s) and poses of a trajectory: rest, then ``steps`` equal depths."""
        insertion = Insertion.straight(trajectory[0], trajectory[1], trajectory[2], SPEED)
        times = np.linspace(0.0, insertion.duration, self.steps + 1)
        return times, [insertion.pose(float(t)) for t in times]


def observe(model: TissueModel[Any], times: Floats, poses: Sequence[NeedlePose]) -> Observation:
    """Step a model through poses and keep the field of every step."""
    state, before, fields = model.rest(), float(times[0]), []
    for t, pose in zip(times, poses, strict=True):
        state = model.advance(state, pose, float(t) - before)
        before = float(t)
        fields.append(model.displacement(state))
    return Observation(model.grid.nodes, np.array(fields), times, poses)


def accuracy(**arguments: Any) -> dict[str, Any]:
    """Run one case (the arguments of `Case`) and return its rows for the table, one per model and trajectory set."""
    lesion = arguments.get("lesion")
    case = Case(
        **{
            **arguments,
            "nodes": tuple(arguments.get("nodes", (40, 30))),
            "lesion": tuple(lesion) if lesion else None,
        }
    )
    return {"rows": [row for each in _rows(case) for row in table_rows(case, *each)]}


def table_rows(
    case: Case,
    model: str,
    kernel: str,
    how: str,
    fitted: FieldError,
    held: FieldError,
    values: Mapping[str, float],
) -> list[dict[str, Any]]:
    """Return the rows of one model: on the fitted trajectory and on the held-out ones."""
    return [
        {
            "case": case.name,
            "young_kpa": case.young,
            "friction_ns_per_mm2": case.friction,
            "model": model,
            "kernel": kernel,
            "how": how,
            "held_out": out,
            "mae_mm": e.mae,
            "rmse_mm": e.rmse,
            "mae_percent_of_mean": e.mae_percent,
            "rmse_percent_of_mean": e.rmse_percent,
            "worst_mm": e.worst,
            "mean_displacement_mm": e.mean_displacement,
            "parameters": dict(values),
        }
        for out, e in ((False, fitted), (True, held))
    ]


Row = tuple[str, str, str, FieldError, FieldError, Mapping[str, float]]


def _rows(case: Case) -> Iterator[Row]:
    grid = case.grid
    fem = FEMModel(grid, CLAMPED, case.tissue, case.forces)
    times, poses = case.poses(FITTED)
    seen = observe(fem, times, poses)
    others = [observe(fem, *case.poses(trajectory)) for trajectory in HELD_OUT]

    def judged(model: TissueModel[Any]) -> FieldError:
        return _joint([observe(model, o.times, o.poses).displacement for o in others], others)

    for name, kernels in (
        ("thin plate", [ThinPlate()]),
        ("elastic", [Elastic(case.tissue.poisson, radius) for radius in case.radii]),
    ):
        fits = [(fit_spline(grid, seen, kernel, case.seed), kernel) for kernel in kernels]
        found, kernel = min(fits, key=lambda fit: fit[0].error.mae)
        values = found.values | ({"radius": kernel.radius} if isinstance(kernel, Elastic) else {})
        yield "tps", name, "fitted", found.error, judged(spline_model(grid, found, kernel)), values
        if case.lesion is not None:
            anchors = TPSModel(grid, CLAMPED, PRINTED, kernel).anchors
            stiffness = landmark_stiffness(case.tissue, grid, kernel, anchors)
            soft = fit_spline(grid, seen, kernel, case.seed, stiffness)
            yield (
                "tps", name, "fitted, stiffness per landmark", soft.error,
                judged(spline_model(grid, soft, kernel, stiffness)), soft.values,
            )  # fmt: skip
        bound = [oracle(grid, o, kernel) for o in (seen, *others)]
        yield (
            "tps", name, "oracle landmarks", field_error(bound[0], seen.displacement), _joint(bound[1:], others), {}
        )  # fmt: skip
    green = GreenModel(grid, CLAMPED, Tissue(case.young), case.forces)
    told = observe(green, times, poses).displacement
    yield "green", "half-plane", "nothing fitted", field_error(told, seen.displacement), judged(green), {}
    found = identify(ForceFields(green, seen), "mae", bootstrap=0)
    forces = replace(case.forces, tip=found.values["tip"], friction=found.values["friction"])
    fitted = GreenModel(grid, CLAMPED, Tissue(case.young), forces)
    yield "green", "half-plane", "fitted", found.error, judged(fitted), found.values


def fit_spline(
    grid: RegularGrid, seen: Observation, kernel: Kernel, seed: int = 0, stiffness: Floats | None = None
) -> Identification:
    """Identify sigma, delta, alpha1, alpha2 and length of the printed laws by least mean distance."""
    model = TPSModel(grid, CLAMPED, PRINTED, kernel, stiffness=stiffness)
    return identify(SplineFields(model, seen), "mae", seed=seed, bootstrap=0)


def spline_model(
    grid: RegularGrid, found: Identification, kernel: Kernel, stiffness: Floats | None = None
) -> TPSModel:
    """Build the model with the parameters found."""
    values: dict[str, Any] = dict(found.values)
    return TPSModel(
        grid, CLAMPED, replace(PRINTED, **values), kernel, stiffness=stiffness, precision="double"
    )


def oracle(grid: RegularGrid, seen: Observation, kernel: Kernel) -> Floats:
    """Fit a spline through the truth (the true displacement at every node near the axis, anchors held) and return its fields.

    No law of interaction can do better with these landmarks: the remaining error is the kernel's own.
    """
    anchors = TPSModel(grid, CLAMPED, PRINTED, kernel).anchors.places
    inside = np.setdiff1d(np.arange(grid.size), grid.boundary(CLAMPED))
    fields = []
    for pose, u in zip(seen.poses, seen.displacement, strict=True):
        near = inside[pose.closest(grid.nodes[inside])[1] <= ORACLE]
        landmarks = np.vstack([anchors, grid.nodes[near]])
        spline = factor(kernel, landmarks).solve(np.vstack([np.zeros_like(anchors), u[near]]))
        fields.append(spline(grid.nodes))
    return np.array(fields)


def discretisation(**arguments: Any) -> dict[str, Any]:
    """Measure the error of the finite-element mesh itself against a mesh four times as fine, at the coarse nodes."""
    case = Case(**{**arguments, "nodes": tuple(arguments["nodes"])})
    nx, ny = case.nodes
    fine = replace(case, nodes=(4 * (nx - 1) + 1, 4 * (ny - 1) + 1))
    models = [FEMModel(c.grid, CLAMPED, c.tissue, c.forces) for c in (case, fine)]
    pick = np.arange(fine.grid.size).reshape(fine.nodes[::-1])[::4, ::4].ravel()
    errors = []
    for trajectories in ([FITTED], HELD_OUT):
        pairs = [[observe(m, *case.poses(t)).displacement for m in models] for t in trajectories]
        coarse, exact = (np.concatenate(each) for each in zip(*pairs, strict=True))
        errors.append(field_error(coarse, exact[:, pick]))
    return {
        "rows": [
            *table_rows(case, "fem", "mesh four times as fine", "nothing fitted", errors[0], errors[1], {})
        ]
    }


def brute_force(*, runs: int, frames: int, nodes: Sequence[int], seed: int = 0) -> dict[str, Any]:
    """Compare the paper's grid of whole simulations with the closed form, on the same frames, in one process.

    Seconds are of processor time, so that other processes do not distort the comparison.
    """
    if runs < 8:
        raise InputError(f"a grid needs 8 runs or more; got {runs}")
    case = Case(nodes=(int(nodes[0]), int(nodes[1])), steps=frames)
    grid = case.grid
    seen = observe(FEMModel(grid, CLAMPED, case.tissue, case.forces), *case.poses(FITTED))
    model = TPSModel(grid, CLAMPED, PRINTED)
    identify(SplineFields(model, seen.frames(np.array([frames]))), bootstrap=0)  # fills caches
    began = thread_time()
    closed = identify(SplineFields(model, seen), "mae", seed=seed, bootstrap=0)
    closed_seconds = thread_time() - began  # unit fields included
    largest = float(np.hypot(*np.moveaxis(seen.displacement, -1, 0)).max())
    per_axis = [round(runs ** (1 / 3))] * 2
    axes: dict[str, Sequence[float]] = {
        "sigma": list(np.linspace(0.05, 1.0, round(runs / per_axis[0] ** 2)) * largest),
        "alpha1": list(np.linspace(0.0, 1.0, per_axis[0]) * largest / SPEED),
        "alpha2": list(np.linspace(0.0, 2.0, per_axis[1]) * largest / SPEED),
    }

    def simulate(values: Mapping[str, float], solver: Solver = "refit") -> Floats:
        given: dict[str, Any] = dict(values)
        parameters = replace(PRINTED, delta=1.5, length=1.0, **given)
        return observe(
            TPSModel(grid, CLAMPED, parameters, solver=solver), seen.times, seen.poses
        ).displacement

    began = thread_time()
    grid_found = grid_search(simulate, axes, seen.displacement)
    per_run = (thread_time() - began) / grid_found.runs
    some = [{"sigma": s, "alpha1": axes["alpha1"][1], "alpha2": axes["alpha2"][1]} for s in axes["sigma"]]
    simulate(some[0], "response")  # fills caches
    began = thread_time()
    for values in some:
        simulate(values, "response")
    per_fast_run = (thread_time() - began) / len(some)
    return {
        "grid_runs": grid_found.runs,
        "grid_seconds": per_run * grid_found.runs,
        "grid_seconds_for_2000_runs": 2000 * per_run,
        "grid_mae_mm": grid_found.error.mae,
        "closed_seconds": closed_seconds,
        "closed_mae_mm": closed.error.mae,
        "times_faster_than_2000_runs": 2000 * per_run / closed_seconds,
        "times_faster_than_2000_runs_of_the_fast_path": 2000 * per_fast_run / closed_seconds,
        "frames": frames,
        "nodes": grid.size,
        "grid_values": grid_found.values,
        "closed_values": closed.values,
    }


def _joint(fields: Sequence[Floats], seen: Sequence[Observation]) -> FieldError:
    return field_error(np.concatenate(fields), np.concatenate([o.displacement for o in seen]))


def case_arguments(case: Case) -> dict[str, Any]:
    """Return the arguments of `accuracy` as values for JSON."""
    return asdict(case)
