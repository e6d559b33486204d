"""The scene of a page: an image, the models that can deform it, the needle's looks, the exercises."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.live import ModelFactory
from echospline.picture import NeedleEcho
from echospline.scene import NeedlePose, RegularGrid, UltrasoundImage
from echospline.viewer.exercise import Exercise, check_exercises

LARGEST_SIDE = 4096
"""Pixels; every WebGL2 browser accepts textures of 2048, and nearly all accept this."""
PAGE_LOOK = {
    "brightness": 0.9,  # of the strongest echo, share of white
    "resolution": 0.3,  # half width of a thin line's echo to 1/e, mm
    "fade_angle": 40.0,  # tilt at which the mirror echo has fallen to 1/e, degrees
    "floor": 0.3,  # echo that is left at any angle, share of the strongest
    "opacity": 0.45,  # of the shadow
    "refill": 25.0,  # way behind the shaft over which the shadow fades to 1/e, mm
}
"""Numbers of the page's own shader, which draws a simpler needle than `draw_needle`: walls, copies of them, shadow."""


@dataclass(frozen=True)
class Scene:
    """One scene, the same for every client.

    Parameters
    ----------
    title : str
        For display.
    image : UltrasoundImage
        At rest.
    grid : RegularGrid
        The mesh of every model.
    models : callable
        From a name to a model.
    names : tuple of (name, label)
        The available models; the first one is the default.
    entry : (x, y)
        Point of entry, mm.
    angle : float
        Its direction, degrees from +x towards depth.
    echo : NeedleEcho
        Its looks.
    exercises : tuple of Exercise
        The exercises of this scene.
    source : str
        Description of the scene's origin, stored with each session so that it can be run again; not read here.
    upload : str
        Name under which its uploaded picture is stored; empty for the scene that the server began with.

    Raises
    ------
    InputError
        If the image is too large for a browser or an exercise lies outside it.
    """

    title: str
    image: UltrasoundImage
    grid: RegularGrid
    models: ModelFactory
    names: tuple[tuple[str, str], ...]
    entry: tuple[float, float]
    angle: float = 60.0
    echo: NeedleEcho = field(default_factory=NeedleEcho)
    exercises: tuple[Exercise, ...] = ()
    source: str = ""
    upload: str = ""

    def __post_init__(self) -> None:
        if max(self.image.grid.shape) > LARGEST_SIDE:
            raise InputError(
                f"the live page takes images up to {LARGEST_SIDE} pixels a side; got {self.image.grid.shape}"
            )
        if not self.names:
            raise InputError("a scene needs one model or more")
        check_exercises(self.exercises, self.grid)

    @property
    def home(self) -> NeedlePose:
        """The needle at its entry, outside the tissue."""
        return NeedlePose(self.entry, self.entry)

    @cached_property
    def picture(self) -> str:
        """SHA-256 of the pixels with their size and place: equal for the same picture alone."""
        grid, pixels = self.image.grid, np.ascontiguousarray(self.image.pixels)
        head = f"{pixels.dtype.str} {pixels.shape} {grid.shape} {grid.spacing} {grid.origin}"
        return hashlib.sha256(head.encode() + pixels.tobytes()).hexdigest()

    def exercise(self, name: str) -> Exercise | None:
        """Return the exercise of a name."""
        return next((exercise for exercise in self.exercises if exercise.name == name), None)

    def describe(self) -> dict[str, Any]:
        """Return everything that the page needs besides the pixels, as plain values."""
        (columns, rows), spacing, origin = (
            self.image.grid.shape,
            self.image.grid.spacing,
            self.image.grid.origin,
        )
        echo = PAGE_LOOK | {"diameter": self.echo.diameter, "apex": self.echo.apex}
        return {
            "title": self.title,
            "upload": self.upload,
            "image": {"columns": columns, "rows": rows, "spacing": spacing, "origin": origin},
            "mesh": {"shape": self.grid.shape, "spacing": self.grid.spacing, "origin": self.grid.origin},
            "models": [{"name": name, "label": label} for name, label in self.names],
            "needle": {"entry": self.entry, "angle": self.angle, "echo": echo},
            "exercises": [exercise.model_dump() for exercise in self.exercises],
        }


SceneOpener = Callable[[Path, tuple[float, float] | None], Scene]
"""Builds a scene from an uploaded file and a spacing; passed in, because it imports models."""


def tip_of(entry: tuple[float, float], angle: float, depth: float) -> tuple[float, float]:
    """Return the tip of a needle from its entry, mm, direction, degrees, and depth, mm."""
    if depth == 0.0:
        return entry
    return (entry[0] + depth * cos(radians(angle)), entry[1] + depth * sin(radians(angle)))


def grey_bytes(image: UltrasoundImage) -> bytes:
    """Convert pixels to one byte each, row by row: 8-bit unchanged, colour by its brightness, others scaled."""
    pixels: NDArray[Any] = image.pixels
    if pixels.ndim == 3:
        pixels = pixels.astype(np.float64) @ (0.299, 0.587, 0.114)
        if image.pixels.dtype == np.uint8:
            return np.rint(pixels).astype(np.uint8).tobytes()
    if pixels.dtype == np.uint8:
        return pixels.tobytes()
    low, high = float(pixels.min()), float(pixels.max())
    span = high - low if high > low else 1.0
    return np.rint((pixels.astype(np.float64) - low) * (255.0 / span)).astype(np.uint8).tobytes()
