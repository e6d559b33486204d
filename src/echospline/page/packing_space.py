"""From a scene in space to the pack of a page: the volume, the probe, what the core answers, and the needle."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.page.codings import from_kept, kept, weights_of
from echospline.page.exercise import default_exercises_space
from echospline.page.pack import (
    FORMAT,
    Manifest,
    MeshPart,
    MirroredPart,
    MirrorPart,
    ModelPart,
    NeedlePart,
    NeighboursPart,
    Pack,
    ProbePart,
    VolumePart,
    table,
)
from echospline.page.packing import FASTEST, LABELS, LAG, SENTENCES
from echospline.picture import NeedleEcho
from echospline.scenario import CoreScene, SpatialForcedScene, SpatialScene, spatial_scene
from echospline.scene import ImagingPlane, SpatialGrid

NARROW = {"condition_faces": np.int32, "answers": np.float32}
"""Types of tables in a pack: single precision moves the tissue by 2e-5 mm at most in `sample:spine` and `sample:kidney`, and halves the file."""
MOST_VOXELS = 40_000_000
"""Of a volume in a page."""
ALIKE = 1e-9
"""Part of the greatest answer by which mirror images may differ: rounding of how they were solved, far below single precision."""


def packed_space(scene: SpatialScene, *, language: str = "en", rate: float = 120.0) -> Pack:
    """Pack a scene in space: volume, probe, mesh, models and needle.

    Parameters
    ----------
    scene : SpatialScene
        Opened, 8-bit.
    language : {"en", "de"}
        Of the page.
    rate : float
        Steps per second.

    Raises
    ------
    InputError
        If the volume is too large for a page, or the needle enters outside it.
    """
    scenario, volume = scene.scenario, scene.volume
    space = scenario.space
    if space is None:
        raise InputError("this scenario is no scene in space: it has no [space] table")
    if volume.voxels.size > MOST_VOXELS:
        raise InputError(
            f"a page takes volumes up to {MOST_VOXELS:,} voxels; got {volume.voxels.size:,}: resample it more coarsely"
        )
    grid, insertion, shape = space.grid(volume), space.needle.insertion(), space.probe.probe()
    pose = insertion.pose(float(insertion.times[0]))
    axis = (
        np.subtract(insertion.tip[-1], insertion.entry[-1])
        if space.needle.path
        else np.array(space.needle.direction)
    )
    axis = axis / np.linalg.norm(axis)
    plane = space.probe.planes(insertion).at(float(insertion.times[0]))
    arrays: dict[str, NDArray[Any]] = {"voxels": np.ascontiguousarray(volume.voxels)}
    codings: dict[str, NeighboursPart | MirroredPart] = {
        "voxels": NeighboursPart(weights=weights_of(arrays["voxels"]))
    }
    models = _models(scene, grid, arrays, codings)
    echo = scenario.needle_echo() or NeedleEcho(shaft=False, tip=False, tail=False, shadow=False)
    columns, rows = shape.grid.shape
    values: dict[str, Any] = {
        "format": FORMAT,
        "version": version("echospline"),
        "title": scenario.title or scenario.image.file.replace("sample:", "Sample: ").rsplit("/", 1)[-1],
        "language": language,
        "volume": VolumePart(shape=list(volume.shape), spacing=list(volume.spacing), origin=list(volume.origin), voxels="voxels"),
        "probe": ProbePart(
            shape=shape.shape, columns=columns, rows=rows, spacing=list(shape.grid.spacing), origin=list(shape.grid.origin),
            radius=shape.radius, opening=shape.opening, depth=shape.depth, pose=pose_of(plane), elevation=shape.elevation,
            elevation_depth=shape.elevation_depth, element_height=shape.element_height,
        ),
        "mesh": MeshPart(shape=list(grid.shape), spacing=list(grid.spacing), origin=list(grid.origin)),
        "rate": rate,
        "models": models,
        "needle": NeedlePart(
            entry=[float(v) for v in pose.entry], direction=axis.tolist(), lag=LAG, fastest=FASTEST, echo=echo.named()
        ),
        "exercises": list(scenario.exercise) or list(default_exercises_space(*(c.tolist() for c in grid.corners))),
        "arrays": table(arrays, codings),
    }  # fmt: skip
    return Pack(Manifest(**values), arrays)


def pose_of(plane: ImagingPlane) -> list[float]:
    """Return where a probe is held: x, y, z (mm), yaw, pitch, roll (degrees), the inverse of `scene.probe_plane`."""
    m = plane.matrix
    pitch = float(np.degrees(np.arcsin(np.clip(-m[1, 2], -1, 1))))
    yaw, roll = np.degrees(np.arctan2(m[0, 2], m[2, 2])), np.degrees(np.arctan2(m[1, 0], m[1, 1]))
    return [*(float(v) for v in m[:3, 3]), float(yaw), pitch, float(roll)]


def _models(
    scene: SpatialScene,
    grid: SpatialGrid,
    arrays: dict[str, NDArray[Any]],
    codings: dict[str, NeighboursPart | MirroredPart],
) -> list[ModelPart]:
    """Pack the scenario's own model first, then those that this tissue can have too; their arrays are added to ``arrays``, with their codings."""
    scenario, parts = scene.scenario, []
    for kind in sorted(("green", "elastic"), key=lambda kind: kind != scenario.model.kind):
        try:
            core = spatial_scene(scenario, grid, scene.tissue, kind)
        except InputError:
            if kind == scenario.model.kind:
                raise
            continue  # a second model is offered where this volume is not too large for it
        if core is None:
            continue  # finite elements answer for tissue with regions: nothing that a page has
        given: dict[str, Any]
        if isinstance(core, CoreScene):
            given = {"clamped_points": core.clamped_points, "stiffness": core.stiffness}
            options = {n: list(v) if isinstance(v, tuple) else v for n, v in core.options.items()}
            more = {"kind": "landmarks", "options": options}
        else:
            given = dict(core.arrays)
            more = {"kind": "forced", "options": dict(core.options), "response": dict(core.response)}
            mirrors = _mirrors(core)
            if mirrors:
                given["answers"] = _symmetric(given["answers"], mirrors)
                codings[f"{kind}.answers"] = MirroredPart(mirrors=mirrors)
        named = {}
        for role, array in given.items():
            if array is not None and array.size:
                named[role] = f"{kind}.{role}"
                arrays[named[role]] = np.array(array, dtype=NARROW.get(role, array.dtype))
        parts.append(ModelPart(name=kind, label=LABELS[kind], sentence=SENTENCES[kind], arrays=named, **more))
    if not parts:
        raise InputError(
            "a page answers homogeneous tissue in space (green), or landmarks in a volume that is small enough (elastic); this scene has "
            "regions and is too large for elastic: leave its regions out, or --tissue homogeneous"
        )
    return parts


def _mirrors(core: SpatialForcedScene) -> list[MirrorPart]:
    """Mirrors of a block's tables: along an axis where its sources, conditions and answers are their own images in its middle."""
    response, arrays = core.response, core.arrays
    low, high = np.array(response["low"]), np.array(response["high"])
    sources, points = (arrays[role].reshape(-1, 3) for role in ("sources", "conditions"))
    faces = arrays["condition_faces"].astype(np.int64)
    answers = arrays["answers"].reshape(-1, points.size)
    rigid = {0: [], 3: [0, 2, 4], 6: list(range(6))}[len(answers) - sources.size]
    found = []
    for axis in range(3):
        near, far = 1 << 2 * axis, 2 << 2 * axis
        opposite = np.where(faces == near, far, np.where(faces == far, near, faces))
        turned = np.where(np.arange(3) == axis, -1.0, 1.0)
        middle = np.where(np.arange(3) == axis, low + high, 0.0)
        of_sources = _partners(sources * turned + middle, sources)
        of_points = _partners(
            np.column_stack([points * turned + middle, 1e6 * opposite]),
            np.column_stack([points, 1e6 * faces]),
        )
        if of_sources is None or of_points is None:
            continue
        # shifts along the axis change their sign, and rotations about the others do
        signs = [*np.tile(turned, len(sources)), *np.concatenate([turned, -turned])[rigid]]
        places = [*(3 * of_sources[:, None] + np.arange(3)).ravel(), *(sources.size + np.arange(len(rigid)))]
        rows = (np.array(signs) * (np.array(places) + 1)).astype(int)
        columns = (turned * (3 * of_points[:, None] + np.arange(3) + 1)).ravel().astype(int)
        if np.abs(_imaged(answers, rows, columns) - answers).max() <= ALIKE * np.abs(answers).max():
            found.append(MirrorPart(rows=rows.tolist(), columns=columns.tolist()))
    return found


def _partners(images: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """Index of the point at every image; None where there is none, or two images share one."""
    apart = np.linalg.norm(images[:, None] - points[None], axis=-1)
    nearest = apart.argmin(axis=1)
    fits = (apart.min(axis=1) < 1e-9).all() and len(np.unique(nearest)) == len(points)
    return nearest if fits else None


def _imaged(answers: NDArray[Any], rows: NDArray[Any], columns: NDArray[Any]) -> NDArray[Any]:
    signs = np.sign(rows)[:, None] * np.sign(columns)
    imaged: NDArray[Any] = signs * answers[np.ix_(np.abs(rows) - 1, np.abs(columns) - 1)]
    return imaged


def _symmetric(answers: NDArray[Any], mirrors: list[MirrorPart]) -> NDArray[Any]:
    """Mean of answers and their images, in single precision, so that images are the same bits."""
    pairs = MirroredPart(mirrors=mirrors).pairs
    mean = answers.reshape(len(pairs[0][0]), -1)
    for rows, columns in pairs:
        mean = (mean + _imaged(mean, np.array(rows), np.array(columns))) / 2
    flat = mean.ravel().astype(NARROW["answers"])
    return from_kept(flat[kept(pairs)], pairs).reshape(answers.shape)
