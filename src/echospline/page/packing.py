"""From a scenario and its image to the pack of a page."""

from __future__ import annotations

from importlib.metadata import version
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.page.exercise import default_exercises
from echospline.page.pack import FORMAT, ImagePart, Manifest, MeshPart, ModelPart, NeedlePart, Pack, table
from echospline.picture import NeedleEcho
from echospline.scenario import Scenario, forced_scene, landmark_scene
from echospline.scene import RegularGrid, UltrasoundImage

LABELS = {"tps": "TPS", "elastic": "Elastic", "green": "Green"}
SENTENCES = {
    "tps": {
        "en": "Thin plate spline: fast, approximate.",
        "de": "Dünne-Platten-Spline: schnell, angenähert.",
    },
    "elastic": {
        "en": "Elastic body spline: fast, keeps volume nearly as tissue does.",
        "de": "Elastischer Spline: schnell, erhält das Volumen fast wie Gewebe.",
    },
    "green": {
        "en": "Green's function: elastic tissue and a needle that sticks, slips and cuts.",
        "de": "Greensche Funktion: elastisches Gewebe und eine Nadel, die haftet, gleitet und schneidet.",
    },
}
LAG, FASTEST = 0.02, 200.0
"""s and mm/s: how the needle follows the hand, as in the live loop."""


def packed(
    scenario: Scenario, image: UltrasoundImage, folder: Path, *, language: str = "en", rate: float = 120.0
) -> Pack:
    """Pack a scene in the plane: picture, mesh, models, needle and exercises.

    Parameters
    ----------
    scenario : Scenario
        Opened with its image, 8-bit.
    image : UltrasoundImage
        At rest.
    folder : Path
        Start of the scenario's relative paths.
    language : {"en", "de"}
        Of the page.
    rate : float
        Steps per second.

    Raises
    ------
    InputError
        If the point of entry or an exercise lies outside the image, or the picture is too large for a page.
    """
    grid = scenario.grid(image)
    entry, angle = scenario.needle.entry, scenario.needle.angle
    if not grid.contains(entry).all():
        x0, x1, y0, y1 = grid.extent
        raise InputError(
            f"needle.entry must lie in the image, x from {x0:g} to {x1:g} and y from {y0:g} to {y1:g} mm; got {entry}"
        )
    if max(image.grid.shape) > 4096:
        raise InputError(
            f"a page takes pictures up to 4096 pixels a side; got {image.grid.shape}: cut it with --region"
        )
    arrays: dict[str, NDArray[Any]] = {"pixels": grey(image)}
    models = _models(scenario, grid, folder, arrays)
    echo = scenario.needle_echo() or NeedleEcho(shaft=False, tip=False, tail=False, shadow=False)
    values: dict[str, Any] = {
        "format": FORMAT,
        "version": version("echospline"),
        "title": scenario.title or scenario.image.file.replace("sample:", "Sample: ").rsplit("/", 1)[-1],
        "language": language,
        "image": ImagePart(
            columns=image.grid.shape[0], rows=image.grid.shape[1], spacing=image.grid.spacing, origin=image.grid.origin,
            pixels="pixels",
        ),
        "mesh": MeshPart(shape=list(grid.shape), spacing=list(grid.spacing), origin=list(grid.origin)),
        "rate": rate,
        "models": models,
        "needle": NeedlePart(
            entry=list(entry), direction=[cos(radians(angle)), sin(radians(angle))], lag=LAG, fastest=FASTEST,
            echo=echo.named(),
        ),
        "exercises": list(scenario.exercise) or list(default_exercises(grid)),
        "arrays": table(arrays),
    }  # fmt: skip
    return Pack(Manifest(**values), arrays)


def doubts(scenario: Scenario, pack: Pack) -> list[str]:
    """Say in a sentence where a page does not begin with the scenario's own model."""
    asked, first = scenario.model.kind, pack.manifest.models[0]
    if asked == first.name:
        return []
    return [
        f"model.kind = {asked} is not among what a page computes for this scene; it begins with {first.label}"
    ]


def grey(image: UltrasoundImage) -> NDArray[np.uint8]:
    """Return 8-bit grey pixels, shape (rows, columns): colour by its brightness.

    Raises
    ------
    InputError
        If the pixels are not 8-bit.
    """
    pixels: NDArray[Any] = image.pixels
    if pixels.dtype != np.uint8:
        raise InputError(f"a page takes 8-bit pixels; got {pixels.dtype}: choose a window (image.window)")
    if pixels.ndim == 3:
        return np.rint(pixels[..., :3].astype(np.float64) @ (0.299, 0.587, 0.114)).astype(np.uint8)
    return np.array(pixels)


def _models(
    scenario: Scenario, grid: RegularGrid, folder: Path, arrays: dict[str, NDArray[Any]]
) -> list[ModelPart]:
    """Pack the models, the scenario's own first; their arrays are added to ``arrays``."""
    if scenario.model.mechanics == "space":
        raise InputError(
            'a page computes a picture by plane elasticity; model.mechanics = "space" asks for a slab: leave it out here, or use simulate'
        )
    parts = []
    green = forced_scene(scenario, grid, folder)
    kinds = ("tps", "elastic") if green is None else ("green", "tps", "elastic")
    for kind in sorted(kinds, key=lambda kind: kind != scenario.model.kind):
        if kind == "green":
            assert green is not None
            given = dict(green.arrays)
            more = {"kind": "forced", "options": dict(green.options), "response": dict(green.response)}
        else:
            scene = landmark_scene(scenario, grid, kind, folder)
            roles = {"clamped_points": scene.clamped_points, "stiffness": scene.stiffness}
            given = {role: array for role, array in roles.items() if array is not None}
            options = {n: list(v) if isinstance(v, tuple) else v for n, v in scene.options.items()}
            more = {"kind": "landmarks", "options": options}
        named = {role: f"{kind}.{role}" for role, array in given.items() if array.size}
        arrays |= {name: np.array(given[role]) for role, name in named.items()}
        parts.append(ModelPart(name=kind, label=LABELS[kind], sentence=SENTENCES[kind], arrays=named, **more))
    return parts
