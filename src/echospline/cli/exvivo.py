"""``echospline study exvivo``: the paper's experiment on a recording, or on a phantom with known motion."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated, Any

import typer

from echospline import io as io_room
from echospline import laboratory, mechanics
from echospline import picture as picture_room
from echospline import scenario as scenario_room
from echospline import scene as scene_room
from echospline import study as study_room
from echospline.atomic import appearing, claimed
from echospline.cli.options import say
from echospline.cli.phantom import phantom_into
from echospline.cli.track import load, tracker
from echospline.errors import InputError

KINDS = ("tps", "elastic", "fem")


def exvivo(
    out: Annotated[Path, typer.Option("--out", help="folder for report.html, tables and figures")] = Path(
        "out/exvivo"
    ),
    cine: Annotated[
        str | None,
        typer.Option(
            metavar="FILE", help="the recording; a phantom driven by finite elements where not given"
        ),
    ] = None,
    needle: Annotated[
        Path | None,
        typer.Option(help="with --cine: path of the needle, CSV (time_s,entry_x_mm,...) or displacement.npz"),
    ] = None,
    scenario: Annotated[
        Path | None,
        typer.Option(help="tissue, clamp and mesh (.toml); of the phantom too where there is no --cine"),
    ] = None,
    spacing: Annotated[str | None, typer.Option(metavar="LAT,DEPTH", help="mm per pixel")] = None,
    fps: Annotated[float | None, typer.Option(metavar="N", help="frames per second")] = None,
    crop: Annotated[str | None, typer.Option(metavar="L,T,R,B", help="pixels to keep")] = None,
    rf: Annotated[
        float | None, typer.Option("--rf", metavar="MHZ", help="the cine holds RF of this frequency")
    ] = None,
    b_mode: Annotated[
        bool, typer.Option("--b-mode", help="track the phantom's pictures, not its echoes")
    ] = False,
    method: Annotated[str, typer.Option(help="tracker: flow or block")] = "flow",
    depths: Annotated[
        int, typer.Option(min=3, max=200, help="insertion depths compared; the paper has 8")
    ] = 8,
    distance: Annotated[
        float, typer.Option(metavar="MM", help="from the tip to the centre of the region")
    ] = 4.0,
    seed: Annotated[int, typer.Option(min=0, help="of the searches")] = 0,
    json_: Annotated[bool, typer.Option("--json", help="print the result as JSON, nothing else")] = False,
) -> None:
    """Repeat the paper's ex-vivo protocol (Figs. 4 and 5).

    The motion of 200 points in 2 x 3 mm ahead of the tip is tracked at several depths; thin plate spline, elastic kernel
    and finite elements are fitted to it separately (RMSE), compared frame by frame with a paired test, and used to
    predict depths outside the fit. On the phantom the truth is known, and the tracker's own error is reported too.
    """
    import numpy as np

    if (cine is None) != (needle is None):
        raise InputError("--cine and --needle belong together: where the needle is in every frame")
    scene, folder = _scene(scenario)
    truth_file = None
    if cine is None:
        phantom_into(scene, out / "phantom", folder, echoes=True, quiet=json_)
        frames: scene_room.Cine | scene_room.EchoCine = load(str(out / "phantom" / "echoes.npz"))
        if b_mode and isinstance(frames, scene_room.EchoCine):
            display, grid = scene.phantom.display(), scene.phantom.grid()
            pictures = np.stack([echo.b_mode(display, grid).pixels for echo in frames])
            frames = scene_room.Cine(pictures, frames.times, grid, "speckle phantom")
        truth_file = out / "phantom" / "displacement.npz"
        insertion = scene.insertion()
    else:
        frames = load(cine, spacing=spacing, fps=fps, crop=crop, rf=rf)
        insertion = io_room.read_needle(needle) if needle is not None else scene.insertion()
    say(
        scenario_room.size_doubts(frames.grid, "--spacing")
        + scenario_room.needle_doubts(insertion, frames.grid)
    )
    with claimed(out):
        result = study_exvivo(
            frames, insertion, scene, folder, out, truth_file=truth_file, method=method, depths=depths,
            distance=distance, seed=seed, quiet=json_, source=cine or "phantom driven by finite elements",
        )  # fmt: skip
    if json_:
        json.dump(result, sys.stdout, indent=1)
        print()
        return
    _print_summary(result, out)


def study_exvivo(
    frames: scene_room.Cine | scene_room.EchoCine,
    insertion: scene_room.Insertion,
    scene: scenario_room.Scenario,
    folder: Path,
    out: Path,
    *,
    truth_file: Path | None,
    method: str,
    depths: int,
    distance: float,
    seed: int,
    quiet: bool,
    source: str,
) -> dict[str, Any]:
    """Track, fit, test, draw and write the report; returns the content of ``exvivo.json``."""
    from rich.console import Console
    from rich.progress import track as counted

    wrap: Callable[[Any], Any] = (
        iter
        if quiet
        else lambda it: counted(list(it), "tracking", console=Console(stderr=True), transient=True)
    )
    seen = study_room.regions(
        frames, insertion, tracker(method), depths=depths, distance=distance, progress=wrap
    )  # fmt: skip
    truth = None if truth_file is None else _truth(truth_file, seen)
    mesh = scene_room.RegularGrid.covering(frames.grid, scene.mesh.nodes)
    models = {kind: _fields(scene, folder, mesh, kind) for kind in KINDS}
    fits = {kind: study_room.fit(seen, model, truth, seed=seed) for kind, model in models.items()}
    wide = {
        kind: study_room.fit(seen, model, truth, where="field", seed=seed) for kind, model in models.items()
    }
    result = _result(seen, fits, truth, source) | {
        "fitted to the whole field": {
            "means": _result(seen, wide, truth, source)["means"],
            "parameters": {kind: f.values for kind, f in wide.items()},
        }
    }
    own = None if truth is None else study_room.tracker_error(seen, truth)
    depth = [pose.depth for pose in seen.poses]
    study_room.error_per_depth(
        depth,
        {k: f.rmse for k, f in fits.items()},
        {k: f.held_out for k, f in fits.items()},
        own,
        out / "fig_5a",
    )
    study_room.motion_maps(seen, {k: f.map for k, f in fits.items()}, out / "fig_5bc")
    study_room.motion_maps(seen, {k: f.map for k, f in wide.items()}, out / "maps_whole_field")
    _write(out, result)
    return result


def _scene(path: Path | None) -> tuple[scenario_room.Scenario, Path]:
    if path is not None:
        return scenario_room.load(path), path.resolve().parent
    with as_file(files("echospline").joinpath("data", "exvivo.toml")) as inside:
        return scenario_room.load(inside), Path.cwd()


def _fields(
    scene: scenario_room.Scenario, folder: Path, mesh: scene_room.RegularGrid, kind: str
) -> Callable[[study_room.Observation], study_room.UnitFields]:
    """Build the unit fields of the model of that name; its laws are those linear in the parameters."""
    if scene.model.mechanics == "space":
        raise InputError(study_room.IN_PLANE)
    built = scenario_room.build_model(
        scene.with_values({**study_room.PRINTED, "model.kind": kind}), mesh, folder=folder
    )
    if isinstance(built, mechanics.TPSModel):
        return lambda seen: study_room.SplineFields(built, seen)
    if isinstance(built, mechanics.FEMModel | mechanics.GreenModel):
        return lambda seen: study_room.ForceFields(built, seen)
    raise InputError(f"{kind} has no parameters to identify")


def _truth(path: Path, seen: study_room.Regions) -> list[laboratory.Displacement]:
    record = io_room.read_displacement(path)
    return [
        laboratory.displacement_of(picture_room.Deformation(record.grid(), record.displacement[k]))
        for k in seen.frames
    ]


def _result(
    seen: study_room.Regions,
    fits: Mapping[str, study_room.Fit],
    truth: Sequence[laboratory.Displacement] | None,
    source: str,
) -> dict[str, Any]:
    import numpy as np

    rows = []
    for i, pose in enumerate(seen.poses):
        size = np.hypot(*seen.displacement[i].T)
        row: dict[str, Any] = {
            "frame": seen.frames[i],
            "depth_mm": round(pose.depth, 3),
            "tracked_mean_mm": float(size.mean()),
            "trusted": float((seen.confidence[i] >= 0.3).mean()),
        }
        row |= {f"{kind}_rmse_mm": float(f.rmse[i]) for kind, f in fits.items()}
        row |= {f"{kind}_held_out_mm": f.held_out[i] for kind, f in fits.items()}
        if truth is not None:
            row["tracker_rmse_mm"] = float(study_room.tracker_error(seen, truth)[i])
            row |= {f"{kind}_held_out_true_mm": f.held_out_true[i] for kind, f in fits.items()}
            row |= {f"{kind}_held_out_field_mm": f.held_out_field[i] for kind, f in fits.items()}
        rows.append(row)
    means = {
        key: float(np.mean([row[key] for row in rows]))
        for key in rows[0]
        if key.endswith("_mm") and key != "depth_mm"
    }
    return {
        "source": source,
        "rows": rows,
        "means": means,
        "parameters": {kind: f.values for kind, f in fits.items()},
        "paired": study_room.compared(fits),
    }


def _write(out: Path, result: Mapping[str, Any]) -> None:
    path = out / "exvivo.json"
    with appearing(path) as part:
        part.write_text(json.dumps(result, indent=1), encoding="utf-8")
    rows = result["rows"]
    known = "tracker_rmse_mm" in rows[0]
    columns = {
        "frame": "frame",
        "depth_mm": "depth, mm",
        "tracked_mean_mm": "mean motion, mm",
        "trusted": "trusted share",
    }
    columns |= {f"{k}_rmse_mm": f"{k} RMSE, mm" for k in KINDS} | {
        f"{k}_held_out_mm": f"{k} unseen, mm" for k in KINDS
    }
    if known:
        columns |= {"tracker_rmse_mm": "tracker itself, mm"}
        columns |= {f"{k}_held_out_true_mm": f"{k} unseen against truth, mm" for k in KINDS}
        columns |= {f"{k}_held_out_field_mm": f"{k} unseen, whole field, mm" for k in KINDS}
    tests = [
        {"pair": pair, "what": what}
        | test
        | {"low": test["interval_95_mm"][0], "high": test["interval_95_mm"][1]}
        for pair, whats in result["paired"].items()
        for what, test in whats.items()
    ]
    test_columns = {
        "pair": "models", "what": "RMSE of", "frames": "frames", "mean_difference_mm": "mean difference, mm",
        "low": "95 % from", "high": "to", "p_t": "p, paired t", "p_wilcoxon": "p, Wilcoxon",
    }  # fmt: skip
    study_room.write_report(
        out / "report.html",
        "Ex-vivo protocol: tracked motion ahead of the tip against fitted models",
        [
            ("What was done", [
                study_room.paragraph(f"Source: {result['source']}. A region of 200 points in 2 x 3 mm travels ahead of the tip; its "
                          "motion since the first frame is tracked at each depth. Every model is fitted to all depths by least "
                          "RMSE. 'Unseen' is the prediction at a depth by a fit to the depths of the other parity."),
            ]),
            ("Error per depth (Fig. 5a)", [study_room.table([result["means"]], {c: h for c, h in columns.items() if c in result["means"]}),
                                             study_room.table(rows, columns), study_room.figure(out / "fig_5a.png", "RMSE per insertion depth")]),
            ("Do the models differ?", [
                study_room.table(tests, test_columns),
                study_room.paragraph("A large p does not show that two models are the same; the interval says how far apart they may be."),
            ]),
            ("Displacement maps (Fig. 5b, c)", [
                study_room.figure(out / "fig_5bc.png", "Axial displacement, tracked, and of the models fitted to the region alone"),
                study_room.paragraph("A fit to the region says nothing of the rest of the picture: look at the maps before believing it."),
            ]),
            ("Fitted to the whole tracked field", [
                study_room.table(_summary(result["fitted to the whole field"]["means"]), SUMMARY),
                study_room.figure(out / "maps_whole_field.png", "The same with models fitted to every trusted point of the picture"),
                study_room.table([{"model": k} | v for k, v in result["fitted to the whole field"]["parameters"].items()],
                      {"model": "model"} | {n: n for v in result["parameters"].values() for n in v}),
            ]),
            ("Parameters of the fits to the region", [study_room.table([{"model": k} | v for k, v in result["parameters"].items()],
                                  {"model": "model"} | {n: n for v in result["parameters"].values() for n in v})]),
        ],
    )  # fmt: skip


SUMMARY = {
    "model": "model",
    "rmse": "region, fitted, um",
    "held_out": "region, unseen, um",
    "held_out_true": "region, unseen, against truth, um",
    "held_out_field": "whole field, unseen, against truth, um",
}


def _summary(means: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return the means over the depths, one row per model, um."""
    rows = []
    for kind in KINDS:
        values = {k: means.get(f"{kind}_{k}_mm") for k in SUMMARY if k != "model"}
        rows.append(
            {"model": kind} | {k: None if v is None else round(1000 * v, 1) for k, v in values.items()}
        )
    return rows


def _print_summary(result: Mapping[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    means = result["means"]
    for title, numbers in (
        ("Fitted to the region ahead of the tip; mean RMSE over the depths", means),
        ("Fitted to the whole tracked field", result["fitted to the whole field"]["means"]),
    ):
        shown = Table(title=title, title_justify="left")
        for key, heading in SUMMARY.items():
            shown.add_column(heading, justify="left" if key == "model" else "right")
        for row in _summary(numbers):
            shown.add_row(*("" if row[key] is None else str(row[key]) for key in SUMMARY))
        console.print(shown)
    if "tracker_rmse_mm" in means:
        console.print(f"the tracker itself: {1000 * means['tracker_rmse_mm']:.1f} um")
    for pair, tests in result["paired"].items():
        t = tests["fit"]
        low, high = (1000 * v for v in t["interval_95_mm"])
        p = "" if t["p_t"] is None else f", paired t p = {t['p_t']:.3g}, Wilcoxon p = {t['p_wilcoxon']:.3g}"
        console.print(f"{pair}: {1000 * t['mean_difference_mm']:+.1f} um ({low:+.1f} to {high:+.1f}){p}")
    console.print(f"report: {out / 'report.html'}")
