"""From observed displacements to a scenario that `simulate` runs: identification of one recording."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from echospline.atomic import appearing, claimed
from echospline.errors import InputError
from echospline.io import read_needle
from echospline.mechanics import FEMModel, GreenModel, TPSModel
from echospline.scenario import MODELS, Scenario, build_model, is_spatial, load, open_spatial
from echospline.scenario.space_section import SpaceSection
from echospline.scene import MOVED, Floats, field_error
from echospline.study.charts import error_map
from echospline.study.identify import Identification, Objective, grid_search, identify
from echospline.study.spatial_fit import PictureRuns, SeenRun, fit_in_space
from echospline.study.unit_fields import ForceFields, Observation, SplineFields
from echospline.tracking import read_track

PRINTED: Mapping[str, Any] = {
    "model.landmarks.loading": "immediate",
    "model.landmarks.drag": 0.0,
    "model.landmarks.tip": "point",
    "model.forces.law": "viscous",
    "model.forces.ramp": 0.0,
}
"""The laws under which fields are linear in the parameters."""

IN_PLANE = 'parameters are identified in the plane or in a scene with [space]: give a scenario with model.mechanics = "plane"'
"""What is said to scenarios whose picture is the middle of a slab in space."""


def calibrate(
    *,
    field: str,
    out: str,
    scenario: str | None = None,
    model: str | None = None,
    objective: Objective = "mae",
    method: str = "closed",
    needle: str | None = None,
    confidence: float = 0.5,
    frames: int = 60,
    runs: int = 2000,
    bootstrap: int = 200,
    seed: int = 0,
) -> dict[str, Any]:
    """Identify a model from a displacement record and write the result.

    Parameters
    ----------
    field : str
        ``displacement.npz`` of a simulation, ``.npz`` or ``.mha`` of a tracking, or a folder with a displacement.npz.
    out : str
        Folder for ``identified.toml`` (a scenario), ``identification.json``, ``error_map.png`` and ``.svg``.
    scenario : str, optional
        The scene: image, mesh, clamp, tissue; ``scenario.toml`` in the record's folder when not given.
    model : {"tps", "elastic", "green", "fem"}, optional
        The model to identify; the scenario's when not given.
    objective : {"mae", "rmse"}
        The error to minimise.
    method : {"closed", "grid"}
        Closed form and a small search, or the paper's brute force; a scene in space is always searched by simulated runs (`spatial_fit`).
    needle : str, optional
        Path of the needle (CSV, or the npz of another record) where the record has none.
    confidence : float
        Tracked points below this (0 to 1) are left out, frame by frame.
    frames : int
        Frames used, evenly spaced, the stops of the needle among them; 0 for all.
    runs : int
        Simulations of the brute force.
    bootstrap : int
        Resamples for the intervals.
    seed : int
        Of search and bootstrap.

    Returns
    -------
    dict
        The content of ``identification.json``.

    Raises
    ------
    InputError
        If a file or an option is invalid.
    """
    with claimed(Path(out)):
        return _calibrated(
            Path(field),
            Path(out),
            scenario,
            model,
            objective,
            method,
            needle,
            confidence,
            frames,
            runs,
            bootstrap,
            seed,
        )


def _calibrated(
    path: Path,
    folder: Path,
    scenario: str | None,
    model: str | None,
    objective: Objective,
    method: str,
    needle: str | None,
    confidence: float,
    frames: int,
    runs: int,
    bootstrap: int,
    seed: int,
) -> dict[str, Any]:
    """Do it in a folder that is held."""
    path = path / "displacement.npz" if path.is_dir() else path
    beside = path.parent / "scenario.toml"
    if scenario is None and not beside.exists():
        raise InputError(
            f"there is no {beside.name} beside {path}; say where the scene is with --scenario FILE.toml"
        )
    source = Path(scenario) if scenario is not None else beside
    scene = load(source)
    kind = model or scene.model.kind
    if kind not in MODELS:
        raise InputError(f"a model is one of {', '.join(MODELS)}; got {kind!r}")
    if is_spatial(scene):
        if method != "closed" or needle is not None:
            raise InputError(
                "a scene in space is identified by simulated runs with the needle and probe of its scenario: leave out --method and --needle"
            )
        return _calibrated_in_space(
            path, folder, source, scene, kind, objective, confidence, frames, bootstrap, seed
        )
    if scene.model.mechanics == "space":
        raise InputError(IN_PLANE)
    if method not in ("closed", "grid"):
        raise InputError(f'method is "closed" or "grid"; got {method!r}')
    scene = scene.with_values({**PRINTED, "model.kind": kind})
    seen = _observation(path, needle, confidence)
    seen = seen.frames(_chosen(seen, frames))
    grid = scene.grid(scene.read_image(source.parent))
    built = build_model(scene, grid, folder=source.parent)
    if method == "closed":
        fields = (
            SplineFields(built, seen) if isinstance(built, TPSModel) else ForceFields(_forces(built), seen)
        )
        with threadpool_limits(limits=1):  # many small products: more threads only slow them down
            found = identify(fields, objective, seed=seed, bootstrap=bootstrap)
    else:
        found = grid_search(
            _run(scene, built, source.parent, seen), _axes(kind, seen, runs), seen.displacement, objective
        )
    keys = {name: f"model.{_table(kind)}.{name}" for name in found.values}
    result = scene.with_values({keys[n]: v for n, v in found.values.items()}, "identified parameters")
    result.save(folder / "identified.toml", source.parent)
    error_map(seen.points, found.error_map, folder / "error_map", f"{kind} identified: {path.name}")
    report = _report(kind, objective, path, seen, found)
    with appearing(folder / "identification.json") as part:
        part.write_text(json.dumps(report, indent=1, allow_nan=False), encoding="utf-8")
    return report


def _calibrated_in_space(
    path: Path,
    folder: Path,
    source: Path,
    scene: Scenario,
    kind: str,
    objective: Objective,
    confidence: float,
    frames: int,
    bootstrap: int,
    seed: int,
) -> dict[str, Any]:
    """Identify a spatial model from the motion that a picture showed."""
    opened = open_spatial(scene.with_values({"model.kind": kind}), source.parent)
    space = opened.scenario.space or SpaceSection()
    seen = _observation(path, None, confidence, needed=False)
    chosen = _chosen(seen, frames)
    corner = np.array(space.probe.probe().grid.origin)  # a cine's first pixel is (0, 0)
    run = SeenRun(seen.points + corner, seen.times - seen.times[0], chosen, seen.displacement[chosen])
    runs = PictureRuns(opened.scenario, space.grid(opened.volume), opened.tissue, run)
    with threadpool_limits(limits=1):
        found = fit_in_space(runs, objective, bootstrap=bootstrap, seed=seed)
    result = runs.with_values(found.values).model_copy(update={"title": "identified parameters"})
    result.save(folder / "identified.toml", source.parent)
    error_map(seen.points, found.error_map, folder / "error_map", f"{kind} in space identified: {path.name}")
    report = _report(
        kind, objective, path, seen.frames(chosen), found, seen.displacement[chosen] - runs.still()
    )
    report["in_space"] = True
    with appearing(folder / "identification.json") as part:
        part.write_text(json.dumps(report, indent=1, allow_nan=False), encoding="utf-8")
    return report


def _observation(path: Path, needle: str | None, confidence: float, *, needed: bool = True) -> Observation:
    """Read a record; points that were not tracked well enough become nan."""
    if not 0.0 <= confidence <= 1.0:
        raise InputError(f"confidence must lie in 0 to 1; got {confidence}")
    track = read_track(path)
    record = track.motion
    insertion = None if needle is None else read_needle(needle)
    poses = [
        record.pose(i) if insertion is None else insertion.pose(float(t)) for i, t in enumerate(record.times)
    ]
    if needed and all(pose.depth == 0 for pose in poses):
        raise InputError(f"{path} holds no needle; say where it was with --needle FILE.csv")
    seen = np.where(track.confidence[..., None] >= confidence, record.displacement, np.nan)
    return Observation(record.points, seen, record.times, poses)


def _forces(built: Any) -> FEMModel | GreenModel:
    if not isinstance(built, FEMModel | GreenModel):
        raise InputError(
            f"forces are identified where the field is linear in them; {type(built).__name__} is not: set tissue.material = 'linear'"
        )
    return built


def _table(kind: str) -> str:
    return "forces" if kind in ("fem", "green") else "landmarks"


def _chosen(seen: Observation, count: int) -> NDArray[np.intp]:
    """Choose evenly spaced frames, those at which the needle stops included: otherwise relaxation would start late."""
    every = np.arange(len(seen.poses))
    if count < 0:
        raise InputError(f"frames must be 0 (all) or a positive number; got {count}")
    if count == 0 or count >= len(every):
        return every
    moving = np.array([pose.speed != 0 for pose in seen.poses])
    stops = np.flatnonzero(moving[:-1] & ~moving[1:])
    evenly = np.linspace(0, len(every) - 1, count).round().astype(np.intp)
    return np.unique(np.concatenate([evenly, stops]))


def _run(
    scene: Scenario, built: Any, folder: Path, seen: Observation
) -> Callable[[Mapping[str, float]], Floats]:
    table = _table(scene.model.kind)

    def run(values: Mapping[str, float]) -> Floats:
        model = build_model(
            scene.with_values({f"model.{table}.{n}": v for n, v in values.items()}), built.grid, folder=folder
        )
        state, before, fields = model.rest(), float(seen.times[0]), []
        for t, pose in zip(seen.times, seen.poses, strict=True):
            state = model.advance(state, pose, float(t) - before)
            before = float(t)
            fields.append(model.displacement_at(state, seen.points))
        return np.array(fields)

    return run


def _axes(kind: str, seen: Observation, runs: int) -> dict[str, Sequence[float]]:
    """Return the values for the brute force, from none to the most that the largest displacement allows."""
    if runs < 8:
        raise InputError(f"a grid needs 8 runs or more; got {runs}")
    largest = float(np.nanmax(np.hypot(seen.displacement[..., 0], seen.displacement[..., 1])))
    fastest = max(abs(pose.speed) for pose in seen.poses) or 1.0
    if kind in ("fem", "green"):
        n = round(runs**0.5)
        return {"tip": list(np.linspace(0.0, 1.0, n)), "friction": list(np.linspace(0.0, 5e-3, n))}
    n = round(runs ** (1 / 3))
    return {
        "sigma": list(np.linspace(0.05, 1.0, round(runs / n**2)) * largest),
        "alpha1": list(np.linspace(0.0, 1.0, n) * largest / fastest),
        "alpha2": list(np.linspace(0.0, 2.0, n) * largest / fastest),
    }


def _report(
    kind: str,
    objective: str,
    path: Path,
    seen: Observation,
    found: Identification,
    observed: Floats | None = None,
) -> dict[str, Any]:
    per_frame = []
    observed = seen.displacement if observed is None else observed
    for t, u, v in zip(seen.times, found.field, observed, strict=True):
        moves = (np.hypot(*np.nan_to_num(v).T) > MOVED).any()
        per_frame.append({"time_s": float(t), "mae_mm": field_error(u, v).mae if moves else None})
    return {
        "source": path.name,
        "model": kind,
        "objective": objective,
        "method": found.method,
        "values": found.values,
        "interval_95_percent": {n: list(i) for n, i in found.intervals.items()},
        "mae_mm": found.error.mae,
        "rmse_mm": found.error.rmse,
        "mae_percent_of_mean": found.error.mae_percent,
        "rmse_percent_of_mean": found.error.rmse_percent,
        "worst_mm": found.error.worst,
        "mean_displacement_mm": found.error.mean_displacement,
        "condition": found.condition if np.isfinite(found.condition) else None,
        "cannot_be_told_apart": list(found.confounded),
        "frames": len(seen.poses),
        "points": len(seen.points),
        "runs": found.runs,
        "seconds": found.seconds,
        "per_frame": per_frame,
    }
