"""``echospline info``: the content of a file, before anything is done with it."""

from __future__ import annotations

import json
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from echospline import scenario as scenario_room
from echospline.cli.info_space import (
    SAMPLE_VOLUMES,
    of_file_volume,
    of_sample_volume,
    of_space_record,
    of_space_scenario,
    of_tracked,
)
from echospline.errors import InputError
from echospline.io import (
    LIMIT,
    PICTURES,
    SAMPLE,
    SAMPLES,
    Recording,
    decoding,
    displacement_shapes,
    is_spatial_record,
    kind_of,
    list_arrays,
    open_echoes,
    open_recording,
    read_displacement,
    read_spatial_displacement,
    sample_image,
)
from echospline.scene import RegularGrid

LARGEST_REPORT = 2**26
"""Bytes of a report that is still read."""


def info(
    file: Annotated[
        str,
        typer.Argument(
            help="Image, cine, DICOM, RF data, scenario, or a result of echospline: its folder, run.json, displacement.npz, "
            "echoes.npz, a track; sample:calf, sample:kidney and sample:spine come with echospline.",
            show_default=False,
        ),
    ],
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object instead of a table.")
    ] = False,
    limit: Annotated[
        float,
        typer.Option(
            min=1, metavar="MIB", help="Largest decoded size that is still called readable, in MiB."
        ),
    ] = LIMIT,
) -> None:
    """Describe a file: format, pixels, spacing, size in mm, frames and times, and doubts."""
    from rich.console import Console
    from rich.table import Table

    found = describe(file, limit)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for key, value in found.items():
        for i, line in enumerate(_lines(key, value)):
            table.add_row(_label(key) if i == 0 else "", line)
    Console(highlight=False).print(table, markup=False)


def describe(file: str, limit: float = LIMIT) -> dict[str, Any]:
    """Describe the content of a file in values for JSON.

    Parameters
    ----------
    file : str
        Path, or ``sample:NAME``.
    limit : float
        MiB of decoded pixels or arrays.

    Returns
    -------
    dict
        Keys end with their unit: ``spacing_mm`` (lateral, depth), ``size_mm`` (width, depth), ``duration_s``.

    Raises
    ------
    InputError
        If the file is missing, damaged, too large or of no known kind.
    """
    if file.startswith(SAMPLE):
        name = file.removeprefix(SAMPLE)
        return of_sample_volume(name) if name in SAMPLE_VOLUMES else _of_sample(name)
    if not file.strip():
        raise InputError("expected a file or folder; got an empty name")
    path = Path(file)
    if path.is_dir():
        return {"file": str(path)} | (_of_results(path) or _of_recording(_header(path, limit), limit))
    if (report := _report(path)) is not None:
        return {"file": str(path), "bytes": path.stat().st_size} | _of_report(report, path.parent)
    kind, name = kind_of(path)
    about: dict[str, Any] = {"file": str(path), "format": name, "bytes": path.stat().st_size}
    if kind == "displacement":
        about |= _of_echoes(path) if "iq.npy" in _members(path) else _of_displacement(path, limit)
    elif kind in ("toml", "arrays"):
        about |= _of_toml(path) if kind == "toml" else _of_arrays(path)
    else:
        recording = _header(path, limit)
        about |= _of_recording(recording, limit)
        more: dict[str, Any] = {}
        if recording.volume:
            more = of_file_volume(path, limit)
        elif kind in ("metaimage", "nrrd"):
            more = of_tracked(path)
        about |= more | {"notes": [*about.pop("notes"), *more.get("notes", [])]}
    return about


def _header(path: Path, limit: float) -> Recording:
    """Open a recording for its header alone: only one frame of it need fit the limit."""
    return open_recording(path, limit, whole=False)


def _members(path: Path) -> list[str]:
    with decoding(path, "npz"), zipfile.ZipFile(path) as archive:
        return archive.namelist()


def _report(path: Path) -> dict[str, Any] | None:
    """Return the content of a report of a run (run.json, dataset.json ...); None for any other file."""
    if path.suffix.lower() != ".json" or not path.is_file() or path.stat().st_size > LARGEST_REPORT:
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is no valid JSON: {' '.join(str(error).split())}") from error
    return found if isinstance(found, dict) else None


def _of_report(report: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Describe the report of a run, and say which of its files are there."""
    if "model" not in report or "frames" not in report:
        if "samples_per_second" in report:
            kept = ("samples", "made", "resumed", "seconds", "largest_mm")
            return (
                {"format": "report of a dataset"}
                | {k: report[k] for k in kept if k in report}
                | {"notes": []}
            )
        return {"format": "JSON, no report of a run", "keys": sorted(report)[:40], "notes": []}
    names = [name for name in report.get("files", []) if isinstance(name, str)]
    missing = [name for name in names if not (folder / name).exists()]
    picture = report.get("image", {}) if isinstance(report.get("image"), dict) else {}
    about = {
        "format": "report of a run",
        "made": report.get("made"),
        "image": picture.get("source"),
        **(
            {"voxels": picture["voxels"], "voxel_mm": picture.get("spacing_mm")}
            if "voxels" in picture
            else {"spacing_mm": picture.get("spacing_mm")}
        ),
        "model": report["model"],
        "frames": report["frames"],
        "largest_displacement_mm": report.get("largest_displacement_mm"),
        "folded": len(report.get("folded_frames") or []),
        "seconds": report.get("seconds"),
        "files": names,
        "notes": [
            *map(str, picture.get("notes") or []),
            *map(str, report.get("doubts") or []),
            *(f"{name} is no longer there" for name in missing),
        ],
    }
    return {key: value for key, value in about.items() if value is not None}


def _of_results(folder: Path) -> dict[str, Any] | None:
    """Describe a folder of results; None for any other folder."""
    if (folder / "run.json").is_file():
        report = _report(folder / "run.json") or {}
        unfinished = [f"{part.name} is unfinished" for part in sorted(folder.glob("*.part"))]
        found = _of_report(report, folder)
        return found | {"format": "results of a run", "notes": [*found["notes"], *unfinished]}
    if (folder / "zarr.json").is_file():
        report = _report(folder / "dataset.json") or {}
        about = _report(folder / "zarr.json") or {}
        attributes = about.get("attributes") if isinstance(about.get("attributes"), dict) else {}
        kept = ("layout", "seed", "frames", "bases", "pixel_mm", "units")
        listed = {key: attributes[key] for key in kept if attributes and key in attributes}
        return {"format": "dataset (Zarr)"} | listed | (_of_report(report, folder) if report else {"notes": []}) | {
            "format": "dataset (Zarr)"
        }  # fmt: skip
    if not any(f.suffix.lower() in PICTURES for f in folder.iterdir()):
        parts = sorted(folder.glob("*.part"))
        known = [
            f.name
            for f in sorted(folder.iterdir())
            if f.suffix.lower() in (".npz", ".mp4", ".gif", ".mha", ".toml")
        ]
        if known or parts:
            return {
                "format": "folder without a report of a run (run.json)",
                "files": known,
                "notes": [f"{part.name} is unfinished" for part in parts],
            }
    return None


def _of_echoes(path: Path) -> dict[str, Any]:
    echoes = open_echoes(path)
    rows, lines = echoes.grid.shape[::-1]
    last = float(echoes.times[-1] - echoes.times[0])
    return {
        "format": "echoes.npz: complex baseband",
        "samples": {"lines": lines, "rows": rows},
        "spacing_mm": list(echoes.grid.spacing),
        "size_mm": _size(lines, rows, echoes.grid.spacing),
        "carrier_per_mm": echoes.carrier,
        "frames": len(echoes),
        "duration_s": round(last, 6),
        "notes": [],
    }


def _of_arrays(path: Path) -> dict[str, Any]:
    """List the arrays of a Matlab or HDF5 file."""
    found = list_arrays(path)
    return {
        "arrays": {a.name: [*a.shape, a.type] for a in found},
        "notes": [
            "pixels or lines: `echospline track FILE --rf MHZ --variable NAME` reads an array of RF lines"
        ],
    }


def _of_sample(name: str) -> dict[str, Any]:
    if name not in SAMPLES:
        known = ", ".join((*SAMPLES, *SAMPLE_VOLUMES))
        raise InputError(f"there is no sample {name!r}; expected one of: {known}")
    image = sample_image(name)
    rows, columns = image.pixels.shape[:2]
    return {
        "file": f"{SAMPLE}{name}", "format": "PNG, shipped with echospline", "source": SAMPLES[name].source,
        "pixels": {"columns": columns, "rows": rows, "channels": 1, "type": str(image.pixels.dtype)},
        "spacing_mm": list(image.spacing), "size_mm": _size(columns, rows, image.spacing), "frames": 1,
    }  # fmt: skip


def _of_recording(recording: Recording, limit: float) -> dict[str, Any]:
    left, top, right, bottom = recording.region or (0, 0, recording.columns, recording.rows)
    about: dict[str, Any] = {
        "format": recording.format,
        "pixels": {
            "columns": recording.columns,
            "rows": recording.rows,
            "channels": recording.channels,
            "type": str(recording.dtype),
        },
        "decoded_mib": round(recording.decoded_mib, 2),
        "spacing_mm": list(recording.spacing) if recording.spacing else None,
        "frames": recording.frames,
    }
    if recording.region:
        about["region"] = [left, top, right, bottom]
    if recording.spacing:
        about["size_mm"] = _size(right - left, bottom - top, recording.spacing)
    if recording.frames > 1 and not recording.volume:
        times, kept = recording.times, recording.kept
        last = float(np.ptp(times[kept])) if times is not None and len(kept) else None
        about["duration_s"] = round(last, 6) if last is not None else None
        about["fps"] = round((len(kept) - 1) / last, 3) if last else None
    if recording.regions:
        about["regions"] = [
            {"content": r.content, "box": list(r.box), "spacing_mm": list(r.spacing) if r.spacing else None}
            for r in recording.regions
        ]
    if recording.volume:
        about["slices"] = about.pop("frames")
    about["notes"] = [
        *recording.notes,
        *_missing(recording, limit),
        *_size_doubts(right - left, bottom - top, recording),
    ]
    return about


def _size_doubts(columns: int, rows: int, recording: Recording) -> list[str]:
    """Return what other commands say of the picture's size, or refuse it for."""
    if recording.spacing is None:
        return []
    try:
        return scenario_room.size_doubts(RegularGrid((columns, rows), recording.spacing))
    except InputError as error:
        return [str(error)]


def _missing(recording: Recording, limit: float) -> list[str]:
    notes = []
    if recording.spacing is None:
        notes.append("no spacing: give --spacing LAT,DEPTH in mm per pixel")
    if recording.volume:
        notes.append("give --frame to take one slice, or --fps if the third axis is time")
    elif recording.frames > 1 and recording.times is None:
        why = f" ({recording.untimed})" if recording.untimed else ""
        notes.append(f"no frame times{why}: give --fps in frames per second, or --frame to take one")
    if recording.decoded_mib > limit:
        notes.append(
            f"all frames together take {recording.decoded_mib:,.0f} MiB, more than the limit of {limit:,.0f} MiB: they are "
            "read one by one (open_cine, track)"
        )
    return notes


def _of_displacement(path: Path, limit: float) -> dict[str, Any]:
    shapes = displacement_shapes(path)
    record = read_displacement(path, limit=limit)
    moved = np.hypot(record.displacement[..., 0], record.displacement[..., 1])
    depth = np.hypot(*(record.tip - record.entry).T)
    about: dict[str, Any] = {
        "arrays": {name: list(shape) for name, shape in shapes.items()},
        "nodes": len(record.points),
        "frames": len(record),
        "notes": [],
    }
    if is_spatial_record(path):
        spatial = read_spatial_displacement(path, limit=limit)
        moved, depth = (
            np.linalg.norm(v, axis=-1) for v in (spatial.displacement, spatial.tip - spatial.entry)
        )
        about |= of_space_record(spatial)
        about["notes"].append(
            "a run in space: points and largest displacement are those of the mesh in space; tracking and identification read the "
            f"{len(record.points)} points of the picture"
        )
    else:
        try:
            about["mesh"] = list(record.grid().shape)
        except InputError:
            about["notes"].append("the points are no regular grid")
    if len(record):
        last = float(record.times[-1] - record.times[0])
        about["duration_s"] = round(last, 6)
        about["largest_displacement_mm"] = round(float(moved.max()), 6)
        about["deepest_insertion_mm"] = round(float(depth.max()), 6)
        about["speed_mm_s"] = [round(float(record.speed.min()), 6), round(float(record.speed.max()), 6)]
    about["notes"] = about.pop("notes")
    return about


def _of_toml(path: Path) -> dict[str, Any]:
    """Describe a scenario; of another TOML file, list its tables."""
    if path.stat().st_size > scenario_room.LARGEST_FILE:
        raise InputError(
            f"{path} has {path.stat().st_size:,} bytes; a scenario has {scenario_room.LARGEST_FILE:,} at most"
        )
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is no valid TOML: {' '.join(str(error).split())}") from error
    if not set(document) & set(scenario_room.Scenario.model_fields):
        return {"format": "TOML, no scenario", "tables": _tables(document), "notes": []}
    about: dict[str, Any] = {"format": "TOML scenario", "tables": _tables(document), "notes": []}
    try:
        run = scenario_room.load(path)
    except InputError as error:
        about["notes"].append(f"cannot be run: {error}")
    else:
        about |= {
            "title": run.title,
            "image": run.image.file,
            "model": run.model.kind,
            **(of_space_scenario(run) if scenario_room.is_spatial(run) else {"mesh": list(run.mesh.nodes)}),
        }
    return about


def _tables(document: dict[str, Any]) -> dict[str, Any]:
    return {name: sorted(part) if isinstance(part, dict) else part for name, part in document.items()}


def _size(columns: int, rows: int, spacing: tuple[float, float]) -> list[float]:
    """Return the width and depth in mm, whole pixels included."""
    return [round(columns * spacing[0], 4), round(rows * spacing[1], 4)]


def _lines(key: str, value: Any) -> list[str]:
    """Return a value as lines of text for display."""
    shown = _SHOWN.get(key)
    return [_short(value)] if shown is None or value is None else shown(value) or ["none"]


def _shown_pixels(value: dict[str, Any]) -> list[str]:
    return [
        f"{value['columns']} x {value['rows']}, {'RGB' if value['channels'] == 3 else 'grey'}, {value['type']}"
    ]


def _shown_box(value: list[int]) -> list[str]:
    return [f"columns {value[0]} to {value[2] - 1}, rows {value[1]} to {value[3] - 1}"]


def _shown_moves(value: dict[str, Any]) -> str:
    frames = f"{value['frames']} frames" if "frames" in value else ""
    if "moves_mm" not in value:
        return f"{frames}, none of them valid"
    moved = f"moves {value['moves_mm']:g} mm, turns {value['turns_degrees']:g} degrees"
    return f"{frames}, {moved}" if frames else moved


def _shown_regions(value: list[dict[str, Any]]) -> list[str]:
    return [
        f"{r['content']}, {_shown_box(r['box'])[0]}"
        + (f", {r['spacing_mm'][0]:.6g} x {r['spacing_mm'][1]:.6g} mm" if r["spacing_mm"] else "")
        for r in value
    ]


_SHOWN: dict[str, Callable[[Any], list[str]]] = {
    "pixels": _shown_pixels,
    "bytes": lambda v: [f"{v:,}"],
    "decoded_mib": lambda v: [f"{v:,.6g}"],
    "spacing_mm": lambda v: [f"{v[0]:.6g} lateral, {v[1]:.6g} depth"],
    "size_mm": lambda v: [f"{v[0]:.6g} wide, {v[1]:.6g} deep"],
    "speed_mm_s": lambda v: [f"{v[0]:.6g} to {v[1]:.6g}"],
    "voxels": lambda v: [" x ".join(map(str, v[:3])) + (f", {v[3]}" if len(v) > 3 else "")],
    "voxel_mm": lambda v: [f"{v[0]:.6g} lateral, {v[1]:.6g} along depth, {v[2]:.6g} across"],
    "block_mm": lambda v: [f"{v[0]:.6g} wide, {v[1]:.6g} deep, {v[2]:.6g} thick"],
    "transforms": lambda v: [f"{name}: {_shown_moves(part)}" for name, part in v.items()],
    "probe": lambda v: [v if isinstance(v, str) else _shown_moves(v)],
    "followed_share": lambda v: [f"{100 * v:.1f} % of the first picture's points at worst"],
    "region": _shown_box,
    "regions": _shown_regions,
    "arrays": lambda v: [f"{name} ({', '.join(map(str, shape))})" for name, shape in v.items()],
    "samples": lambda v: (
        [f"{v['lines']} lines of {v['rows']} samples"] if isinstance(v, dict) else [f"{v:,}"]
    ),
    "files": lambda v: [", ".join(v)] if v else [],
    "tables": lambda v: [f"{name}: {_short(part)}" for name, part in v.items()],
    "notes": lambda v: [str(note) for note in v],
}
_UNITS = ("mm_s", "mm", "mib", "s")


def _label(key: str) -> str:
    """Return "spacing_mm" as "spacing, mm"."""
    unit = next((unit for unit in _UNITS if key.endswith(f"_{unit}")), None)
    name = key.removesuffix(f"_{unit}").replace("_", " ")
    return f"{name}, {unit.replace('mib', 'MiB').replace('mm_s', 'mm/s')}" if unit else name


def _short(value: Any) -> str:
    if value is None:
        return "not in the file"
    if isinstance(value, list):
        return (
            " x ".join(map(str, value))
            if all(isinstance(v, int) for v in value)
            else ", ".join(map(str, value))
        )
    return str(value)
