"""The paper's study, with one seeded command: Fig. 2, Fig. 3a and 3b, the tables, and a page that reports them.

Beyond the paper: lesions, layers and other edges, where linear elasticity stops being good, and what a plane misses of space.
"""

from __future__ import annotations

import csv
import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from echospline.atomic import appearing
from echospline.errors import EchosplineError, MissingExtraError
from echospline.io import read_image
from echospline.mechanics import FEMModel, GreenModel, ThinPlate
from echospline.picture import Deformation, warp
from echospline.scenario import size_doubts
from echospline.scene import RegularGrid, UltrasoundImage
from echospline.study.accuracy import (
    CLAMPED,
    FITTED,
    Case,
    accuracy,
    brute_force,
    case_arguments,
    discretisation,
    fit_spline,
    observe,
    spline_model,
)
from echospline.study.charts import accuracy_bars, fields_and_images, speed_lines
from echospline.study.claims import claims
from echospline.study.linearity import linearity
from echospline.study.plane_space import SPACE_SCENES, plane_space_rows
from echospline.study.report import figure, paragraph, table, write_report
from echospline.study.scenes import SCENES, scene_rows
from echospline.study.speed import savings, speed
from echospline.study.sweep import Task, sweep

READINGS: Mapping[str, Mapping[str, float]] = {
    "read as 10, 8, 5, 1 kPa": {"10^4": 10.0, "8^4": 8.0, "5^4": 5.0, "10^3": 1.0},
    "as printed": {"10^4": 10.0, "8^4": 8.0**4 / 1000, "5^4": 5.0**4 / 1000, "10^3": 1.0},
}
"""Young's moduli in kPa, from the paper's values in Pa: read as slips for 10, 8, 5, 1 x 10^3, and literally."""

FRICTION = 1e-3
"""N s/mm^2; friction with a noticeable force (0.13 N at 5 mm/s and 26 mm), in addition to the paper's, which is negligible."""
SCENE, SPACE = "scene-", "space-"
"""First letters of the tasks beyond the paper's."""
LESION = (24.0, 17.0, 6.0, 50.0)
"""Centre (mm), radius (mm) and modulus (kPa) of the stiff lesion, five times its surroundings."""


@dataclass(frozen=True)
class Extent:
    """Extent of a study.

    Parameters
    ----------
    nodes : (nx, ny)
        Mesh of the accuracy cases.
    steps : int
        Depths per insertion.
    node_counts : sequence of int
        Meshes of the speed table.
    seconds : float
        Per method and mesh in the speed table.
    literal_nodes : int
        Largest mesh of the literal algorithm.
    runs, frames : int
        Of the brute force.
    radii : sequence of float
        Of the elastic kernel, mm.
    cell : float
        Of the hexahedra that plane models are compared with in space, mm.
    """

    nodes: tuple[int, int] = (40, 30)
    steps: int = 50
    node_counts: Sequence[int] = (500, 1000, 1200, 2000, 3000, 4500, 10_000, 20_000, 40_000)
    seconds: float = 1.5
    literal_nodes: int = 5_000
    runs: int = 2000
    frames: int = 10
    radii: Sequence[float] = (0.5, 1.0, 2.0)
    cell: float = 3.5


FULL = Extent()
QUICK = Extent(
    nodes=(40, 30), steps=10, node_counts=(500, 1200, 2500, 4500), seconds=0.15, literal_nodes=1_300,
    runs=64, frames=5, radii=(1.0,), cell=4.0,
)  # fmt: skip


def study(
    out: Path,
    extent: Extent = FULL,
    *,
    seed: int = 0,
    workers: int = 0,
    scheduler: str | None = None,
    image: str = "sample:calf",
    command: str = "echospline study",
    report: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Run the study and write figures, tables and ``report.html`` into a folder.

    Parameters
    ----------
    out : Path
        Folder; accuracy cases with results in it are not run again.
    extent : Extent
        `FULL` or `QUICK`.
    seed : int
        Of the searches.
    workers, scheduler
        See `sweep`: where the accuracy cases run. Times are always measured here, alone.
    image : str
        Ultrasound image of Fig. 2.
    command : str
        Command line of this run, for the report.
    report : callable, optional
        Called with a description of each part.

    Returns
    -------
    dict
        ``accuracy``, ``scenes``, ``linearity``, ``plane_space``, ``speed``, ``savings``, ``identification`` and ``claims`` as written.

    Raises
    ------
    MissingExtraError
        If kvxopt, which the times are compared with, is not installed.
    """
    if find_spec("kvxopt") is None:
        raise MissingExtraError("kvxopt", "cholmod", "the study's comparison of times with CHOLMOD")
    say = report or (lambda _: None)
    tasks = _tasks(extent, seed)
    where = {"workers": workers, "scheduler": scheduler}
    with threadpool_limits(limits=1):
        outcome = sweep(_task, tasks, out / "tasks", report=lambda name: say(f"accuracy: {name}"), **where)  # type: ignore[arg-type]
        if outcome.failed:
            name, why = next(iter(outcome.failed.items()))
            raise EchosplineError(f"{len(outcome.failed)} of {len(tasks)} cases failed; {name}: {why}")
        beyond: dict[str, list[dict[str, Any]]] = {
            first: [
                row
                for name, result in outcome.results.items()
                if name.startswith(first)
                for row in result["rows"]
            ]
            for first in (SCENE, SPACE)
        }
        rows = _table(
            {name: result for name, result in outcome.results.items() if not name.startswith((SCENE, SPACE))}
        )
        say("linear elasticity against neo-Hookean tissue")
        large = linearity(extent.nodes)
        say("Fig. 2")
        figure_2(out, extent, seed, image)
        say("identification against brute force")
        versus = brute_force(runs=extent.runs, frames=extent.frames, nodes=extent.nodes, seed=seed)
    times = speed(extent.node_counts, seconds=extent.seconds, literal_nodes=extent.literal_nodes, report=say)
    saved = savings(times)
    judged = claims(rows, saved)
    figure_3a(out, rows)
    speed_lines(times, out / "fig3b")
    result: dict[str, Any] = {
        "accuracy": rows, "scenes": beyond[SCENE], "linearity": large, "plane_space": beyond[SPACE], "speed": times, "savings": saved,
        "identification": versus, "claims": judged,
    }  # fmt: skip
    for name, content in result.items():
        _write(out / f"{name}.json", json.dumps(content, indent=1, allow_nan=False))
    for name in ("accuracy", "scenes", "linearity", "plane_space", "speed", "savings"):
        _write_csv(out / f"{name}.csv", result[name])
    _report(out, result, extent, command)
    return result


def figure_2(out: Path, extent: Extent, seed: int, image: str) -> None:
    """Write the paper's Fig. 2: fields, errors and deformed images of TPS, Green's function and FEM."""
    case = Case(nodes=extent.nodes, steps=extent.steps, seed=seed)
    grid = case.grid
    times, poses = case.poses(FITTED)
    fem = FEMModel(grid, CLAMPED, case.tissue, case.forces)
    seen = observe(fem, times, poses)
    tps = spline_model(grid, fit_spline(grid, seen, ThinPlate(), seed), ThinPlate())
    green = GreenModel(grid, CLAMPED, case.tissue, case.forces)
    fields = {
        "FEM": seen.displacement[-1],
        "TPS": observe(tps, times, poses).displacement[-1],
        "Green": observe(green, times, poses).displacement[-1],
    }
    found = read_image(image)
    size_doubts(found.grid, "the image's spacing")  # refuses what no picture can be
    picture = _fitted_to(found, grid)
    images = {"at rest": picture} | {
        f"deformed by {name}": warp(picture, Deformation(grid, u))
        for name, u in fields.items()
        if name != "Green"
    }
    fields_and_images(grid, fields, "FEM", images, poses[-1], out / "fig2")


def figure_3a(out: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the paper's Fig. 3a: MAE and RMSE by modulus, one panel per reading."""
    chosen = {
        ("tps", "thin plate", "fitted"): "TPS, fitted",
        ("tps", "thin plate", "oracle landmarks"): "TPS, oracle landmarks",
        ("tps", "elastic", "fitted"): "elastic kernel, fitted",
        ("tps", "elastic", "oracle landmarks"): "elastic kernel, oracle landmarks",
        ("green", "half-plane", "nothing fitted"): "Green's function, nothing fitted",
    }
    groups = []
    for reading in READINGS:
        bars = [
            {**row, "method": chosen[key]}
            for row in rows
            if row["reading"] == reading
            and row["held_out"]
            and (key := (row["model"], row["kernel"], row["how"])) in chosen
        ]
        groups.append((f"moduli {reading}", bars))
    accuracy_bars(groups, out / "fig3a")


def _task(kind: str, **arguments: Any) -> dict[str, Any]:
    """Run one case in a worker, on one thread like all others."""
    with threadpool_limits(limits=1):
        return {
            "mesh": discretisation,
            "case": accuracy,
            "scene": scene_rows,
            "space": plane_space_rows,
        }[kind](**arguments)


def _tasks(extent: Extent, seed: int) -> list[Task]:
    base = Case(nodes=extent.nodes, steps=extent.steps, radii=tuple(extent.radii), seed=seed)
    moduli = sorted({kpa for reading in READINGS.values() for kpa in reading.values()}, reverse=True)
    cases = [replace(base, name=f"{kpa:g} kPa", young=kpa) for kpa in moduli]
    cases.append(replace(base, name="10 kPa, friction", friction=FRICTION))
    cases.append(replace(base, name="10 kPa, stiff lesion", lesion=LESION))
    tasks = [
        Task(case.name.replace(", ", "-").replace(" ", "_"), {"kind": "case", **case_arguments(case)})
        for case in cases
    ]
    scenes = [
        Task(
            f"{SCENE}{index:02d}",
            {
                "kind": "scene",
                "scene": index,
                "nodes": list(extent.nodes),
                "steps": extent.steps,
                "seed": seed,
            },
        )
        for index in range(len(SCENES))
    ]
    scenes += [
        Task(
            f"{SPACE}{index:02d}",
            {"kind": "space", "scene": index, "nodes": list(extent.nodes), "cell": extent.cell},
        )
        for index in range(len(SPACE_SCENES))
    ]
    return [
        *tasks,
        Task("mesh", {"kind": "mesh", **case_arguments(replace(base, name="10 kPa, mesh"))}),
        *scenes,
    ]


def _table(results: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Flatten rows; the four moduli appear under each reading of the paper's values."""
    rows = []
    plain = [row for result in results.values() for row in result["rows"]]
    for reading, moduli in READINGS.items():
        for label, kpa in moduli.items():
            own = [row for row in plain if row["case"] == f"{kpa:g} kPa"]
            rows += [{**row, "reading": reading, "label": f"{label} Pa\n= {kpa:g} kPa"} for row in own]
    moduli_cases = {f"{kpa:g} kPa" for moduli in READINGS.values() for kpa in moduli.values()}
    return rows + [
        {**row, "reading": None, "label": None} for row in plain if row["case"] not in moduli_cases
    ]


def _fitted_to(image: UltrasoundImage, grid: RegularGrid) -> UltrasoundImage:
    """Stretch an image's spacing so that it covers the mesh of the study."""
    rows, columns = image.pixels.shape[:2]
    x0, x1, y0, y1 = grid.extent
    spacing = ((x1 - x0) / (columns - 1), (y1 - y0) / (rows - 1))
    return UltrasoundImage(image.pixels, RegularGrid((columns, rows), spacing, grid.origin), image.source)


def _write(path: Path, text: str) -> None:
    with appearing(path) as part:
        part.write_text(text, encoding="utf-8")


def _write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with appearing(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(
            {k: json.dumps(v) if isinstance(v, dict) else v for k, v in row.items()} for row in rows
        )


_ACCURACY = {
    "case": "tissue", "model": "model", "kernel": "kernel", "how": "parameters", "held_out": "held out",
    "mae_mm": "MAE, mm", "mae_percent_of_mean": "MAE, % of mean", "rmse_mm": "RMSE, mm",
    "rmse_percent_of_mean": "RMSE, % of mean", "mean_displacement_mm": "mean displacement, mm",
}  # fmt: skip
_SCENES = {
    "scene": "scene", "model": "model", "how": "parameters", "held_out": "held out", "mae_percent_of_mean": "MAE, % of mean",
    "worst_pose_percent": "worst pose, %", "mae_mm": "MAE, mm", "mean_displacement_mm": "mean displacement, mm", "refused": "refused because",
}  # fmt: skip
_LINEARITY = {
    "plane": "plane", "peak_mm": "largest displacement, linear, mm", "force_n": "force, N",
    "difference_percent_of_mean": "distance to neo-Hookean, % of mean", "refused": "no answer because",
}  # fmt: skip
_SPACE = {
    "scene": "scene", "model": "model", "mean_displacement_mm": "mean displacement in the picture, mm",
    "out_of_plane_percent": "of the motion, out of the plane, %", "moves_percent": "moves, % of space",
    "moves_near_percent": "within 3 mm of the needle, %", "error_percent": "error, % of mean", "best_factor": "best factor",
    "error_with_factor_percent": "error with it, %", "error_everywhere_percent": "error of the whole picture, %",
}  # fmt: skip
_SPEED = {
    "method": "method", "nodes": "nodes", "cpu_median_ms": "median, ms of processor", "median_ms": "median, ms of wall clock", "p99_ms": "p99, ms",
    "setup_ms": "set-up, ms", "threads": "threads", "steps": "steps timed",
}  # fmt: skip


def _nonlinear(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return one sentence per plane law: how far linear elasticity is off, by the size of the motion."""
    said = []
    for plane in ("stress", "strain"):
        shares = [
            f"{row['difference_percent_of_mean']:.1f} % at {row['peak_mm']:g} mm"
            if row["refused"] is None
            else f"no answer at {row['peak_mm']:g} mm"
            for row in rows
            if row["plane"] == plane
        ]
        said.append(f"in plane {plane} {', '.join(shares)}")
    return f"Linear elasticity is off by a mean of {'; '.join(said)} of largest displacement."


def _report(out: Path, result: Mapping[str, Any], extent: Extent, command: str) -> None:
    seen: set[tuple[Any, ...]] = set()
    rows = []
    for row in result["accuracy"]:  # 10 and 1 kPa belong to both readings; they are listed once
        key = tuple(row[k] for k in ("case", "model", "kernel", "how", "held_out"))
        if key not in seen:
            seen.add(key)
            rows.append(row)
    versus = result["identification"]
    packages = ", ".join(
        f"{name} {version(name)}" for name in ("echospline", "numpy", "scipy", "scikit-fem", "kvxopt")
    )
    sections = [
        ("What the paper claims, and what this run shows", [
            table(result["claims"], {"claim": "claim", "verdict": "verdict", "evidence": "evidence"}),
        ]),
        ("Fields and images (Fig. 2)", [
            figure(out / "fig2.png", "Displacement of each model at full depth, its distance to FEM, and the image that "
                   "each deforms. The needle enters at the top, obliquely."),
        ]),
        ("Errors by modulus (Fig. 3a)", [
            figure(out / "fig3a.svg", "MAE and RMSE against FEM, equation (24), on insertions that were not fitted."),
            paragraph("Parameters are fitted on one oblique insertion and judged on it (held out: no) and on three others "
                      "(held out: yes). Oracle landmarks are told FEM's true displacement at every node near the needle's axis: "
                      "no law of interaction can do better with them. Nothing fitted means the same modulus, Poisson's ratio and "
                      "forces as FEM. The row of FEM itself is the error of its mesh against one four times as fine."),
            table(rows, _ACCURACY),
        ]),
        ("Lesions, layers and edges", [
            paragraph("The same needle, 10 kPa, where the paper did not look. Fitted as above, through the scenario that names the scene; Green's "
                      "function and the finite elements have nothing fitted. The reference is finite elements on a mesh three times as fine. An edge that is neither clamped nor sliding is free. The worst pose is the largest share of its own mean, of "
                      "all deeper than 4 mm. A model that refuses a scene says why."),
            table(result["scenes"], _SCENES),
        ]),
        ("Where linear elasticity stops", [
            paragraph(f"{_nonlinear(result['linearity'])} Neo-Hookean tissue under the same force at the same material point (finite elements, total "
                      "Lagrangian) is the reference; a force at the tip, 22 mm deep, in the paper's scene."),
            table(result["linearity"], _LINEARITY),
        ]),
        ("A plane against space", [
            paragraph("A picture shows a plane of tissue that is a block. The same needle and the same forces (0.4 N at the tip, 0.005 N/mm along the shaft) in both, "
                      "10 kPa, nu 0.45: plane models, as thick as the block and under the needle's projection, and Green's function in space, against quadratic "
                      f"hexahedra of {extent.cell:g} mm that correct closed forms. Means over three needles, of the motion in the picture, further than 3 mm from the needle where "
                      "not said otherwise. The factor is the one number that brings a model closest, as identified forces would."),
            table(result["plane_space"], _SPACE),
        ]),
        ("Time per step (Fig. 3b)", [
            figure(out / "fig3b.svg", "Median processor time from a pose of the needle to the displacement of all nodes, one thread."),
            table(result["savings"], {"method": "method", "against": "against", "mean_saving_percent": "time saved, mean %",
                                      "least_saving_percent": "time saved, least %", "meshes": "meshes"}),
            table(result["speed"], _SPEED),
        ]),
        ("Identification against brute force", [
            paragraph(f"{versus['grid_runs']} whole simulations of {versus['frames']} depths took {versus['grid_seconds']:.1f} s "
                      f"({versus['grid_seconds_for_2000_runs']:.0f} s for 2000) and reached {versus['grid_mae_mm']:.4f} mm; the "
                      f"closed form with its search took {versus['closed_seconds']:.2f} s and reached "
                      f"{versus['closed_mae_mm']:.4f} mm: {versus['times_faster_than_2000_runs']:.0f} times faster than 2000 runs, and "
                      f"{versus['times_faster_than_2000_runs_of_the_fast_path']:.0f} times faster than 2000 runs of the fast path."),
        ]),
        ("How this was made", [
            paragraph(f"{command}; mesh {extent.nodes[0]} x {extent.nodes[1]}, {extent.steps} depths per insertion, plane stress, "
                      "thickness 40 mm, nu 0.45, tip force 0.4 N, clamped left, right and bottom. Friction as printed, "
                      f"1e-8 N s/mm^2 per mm of shaft, and felt, {FRICTION:g}."),
            paragraph(f"{packages}; Python {platform.python_version()}, {platform.machine()}, {os.cpu_count()} processors."),
        ]),
    ]  # fmt: skip
    write_report(out / "report.html", "Thin plate spline and finite elements under a needle", sections)
