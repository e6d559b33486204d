"""What ``echospline info`` says of files in space: volumes, tracked sequences, scenes with a probe, and records of their motion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from echospline.errors import InputError
from echospline.io import SpatialDisplacementRecord
from echospline.io.sequence_header import read_header
from echospline.scenario import Scenario
from echospline.scene import Floats, Volume

SAMPLE_VOLUMES = ("kidney", "spine")


def of_volume(volume: Volume) -> dict[str, Any]:
    """Describe voxels in the scene's frame: x lateral, y depth, z elevation."""
    return {
        "voxels": [*volume.shape, str(volume.voxels.dtype)],
        "voxel_mm": list(volume.spacing),
        "block_mm": [round(float(v), 4) for v in volume.size],
    }


def of_sample_volume(name: str) -> dict[str, Any]:
    """Describe a volume that comes with echospline; the kidney is not made for it."""
    from echospline.laboratory.kidney import SEED, cache_path
    from echospline.laboratory.kidney_recipe import DEPTH, THICKNESS, VOXEL, WIDTH
    from echospline.laboratory.sample_volumes import sample_volume

    about: dict[str, Any] = {"file": f"sample:{name}"}
    use = [
        f"a volume: `echospline simulate sample:{name} --view longitudinal` shows it under a probe and a needle (docs/space.md)"
    ]
    kept = cache_path(SEED) if name == "kidney" else None
    if name == "kidney" and (kept is None or not kept.is_file()):
        made = "made on first use, in about half a minute"
        return about | {
            "format": f"volume that echospline makes itself, {made}", "voxel_mm": list(VOXEL),
            "block_mm": [WIDTH, DEPTH, THICKNESS], "notes": use,
        }  # fmt: skip
    volume, _ = sample_volume(name)
    origin = (
        "volume that echospline made itself, kept in the cache folder"
        if name == "kidney"
        else "MetaImage, shipped with echospline"
    )
    return about | {"format": origin, "source": volume.source, **of_volume(volume), "notes": use}


def of_file_volume(path: Path, limit: float) -> dict[str, Any]:
    """Describe a file whose third axis is a direction in space, or say why it cannot be simulated."""
    from echospline.io.volume_reading import read_volume_and_axis

    try:
        volume, axis = read_volume_and_axis(path, limit=limit)
    except InputError as error:
        return {"notes": [f"no volume for a scene in space: {error}"]}
    return of_volume(volume) | {
        "notes": [
            f"`echospline simulate --view longitudinal` takes it as a scene in space; depth along y of its frame, {axis} of its file, unless "
            "--depth-axis says another"
        ]
    }


def of_tracked(path: Path) -> dict[str, Any]:
    """Describe the transforms of a sequence of PLUS or 3D Slicer, header alone; nothing for a file that has none."""
    try:
        with path.open("rb") as file:
            header = read_header(file, path)
    except (InputError, OSError):
        return {}  # no sequence: what it is has been said already
    if not header.transforms:
        return {}
    told = {}
    for name, matrices in sorted(header.transforms.items()):
        known = matrices[np.isfinite(matrices).all(axis=(1, 2))]
        told[name] = {"frames": len(known), **(moves(known) if len(known) else {})}
    names = set(told)
    use = (
        "the pose of every picture is in it: `echospline reconstruct` makes a volume of the sweep"
        if any(name.startswith("ImageTo") for name in names)
        else "tracked tools: `echospline recorded` replays it; `reconstruct` needs --config with the probe's calibration"
    )
    return {"transforms": told, "notes": [use]}


def of_space_record(record: SpatialDisplacementRecord) -> dict[str, Any]:
    """Describe the motion of a scene in space, and how much of it the picture could follow."""
    from echospline.io.displacement_space import RANKS

    rows, columns = record.picture_points.shape[:2]
    about: dict[str, Any] = {
        "arrays": {name: list(getattr(record, name).shape) for name in RANKS},
        "nodes": len(record.points),
        "picture_points": [columns, rows],
    }
    if len(record):
        first = record.picture_valid[0]
        about["largest_out_of_plane_mm"] = round(
            float(np.abs(record.picture_out_of_plane[:, first]).max(initial=0.0)), 6
        )
        if first.any():
            least = record.picture_valid[:, first].mean(axis=1).min()
            about["followed_share"] = round(float(least), 4)
        about["probe"] = moves(record.plane)
    return about


def of_space_scenario(run: Scenario) -> dict[str, Any]:
    """Describe the probe, needle and mesh of a scenario in space."""
    from echospline.scenario.space_section import SpaceSection

    space = run.space or SpaceSection()
    shape, needle = space.probe.probe(), space.needle
    if shape.shape == "linear":
        face = f"linear, {shape.width:g} mm wide"
    else:
        face = f"curved, radius {shape.radius:g} mm, opening {shape.opening:g} degrees"
    if space.probe.path is not None:
        held = f"on a path of {len(space.probe.path)} poses"
    elif space.probe.view is not None:
        held = f"{space.probe.view} to the needle"
    else:
        x, y, z = space.probe.position
        held = f"at {x:g}, {y:g}, {z:g} mm"
    columns, rows = shape.grid.shape
    return {
        "scene": "in space",
        "mesh": list(space.mesh.nodes),
        "probe": f"{face}, {shape.depth:g} mm deep, {held}",
        "picture": f"{columns} x {rows} pixels of {shape.pixel:g} mm",
        "needle": "on a path of poses" if needle.path is not None else f"{needle.depth:g} mm deep",
    }


def moves(matrices: Floats) -> dict[str, float]:
    """Return how far poses (n, 4, 4) go from the first: mm, and degrees about one axis."""
    away = np.linalg.norm(matrices[:, :3, 3] - matrices[0, :3, 3], axis=1)
    turn = matrices[:, :3, :3] @ np.linalg.inv(matrices[0, :3, :3])
    cosine = np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1.0, 1.0)
    return {
        "moves_mm": round(float(away.max()), 3),
        "turns_degrees": round(float(np.degrees(np.arccos(cosine)).max()), 2),
    }
