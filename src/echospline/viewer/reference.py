"""Finite elements along a page's poses: the displacement that they say, to compare a model with."""

from __future__ import annotations

import base64
import binascii
from threading import Event
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from echospline.errors import InputError
from echospline.scene import Floats, NeedlePose
from echospline.viewer.served_scene import Scene, Tissue

MOST_ROWS = 36_000
"""Steps of a page since its last reset: five minutes at 120 a second."""
LARGEST_REQUEST = 3 * 2**20
"""Bytes."""
FARTHEST = 1e6
"""mm."""


class Asked(BaseModel):
    """What a page asks: the scene, and its poses since the last reset as base64 of rows of float64."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    pack: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    rows: str


def asked(data: bytes) -> Asked:
    """Read a request.

    Raises
    ------
    InputError
        If it is none.
    """
    try:
        return Asked.model_validate_json(data, strict=True)
    except ValidationError:
        raise InputError("expected the scene and the poses since the last reset, as JSON") from None


def rows_of(request: Asked, dimension: int) -> Floats:
    """Return the poses of a request: entry, tip (mm), speed (mm/s), shape (n, 2 D + 1).

    Raises
    ------
    InputError
        If they are damaged, none or too many.
    """
    size = 8 * (2 * dimension + 1)
    try:
        data = base64.b64decode(request.rows, validate=True)
    except (binascii.Error, ValueError):
        raise InputError("the poses are no base64") from None
    if len(data) % size or not data:
        raise InputError(f"poses are one or more rows of {size // 8} numbers; got {len(data)} bytes")
    if len(data) > MOST_ROWS * size:
        raise InputError(
            f"finite elements follow at most {MOST_ROWS} steps since the last reset; got {len(data) // size}: reset and push again"
        )
    rows: Floats = np.frombuffer(data, "<f8").reshape(-1, size // 8).astype(np.float64)
    if not (np.abs(rows) <= FARTHEST).all():
        raise InputError(f"poses hold numbers that are not finite or beyond {FARTHEST:g}")
    return rows


def displacement(scene: Scene, rows: Floats, stopped: Event) -> Floats:
    """Run finite elements along poses; returns the displacement of the mesh nodes (n, D) in mm.

    Parameters
    ----------
    scene : Scene
        With finite elements.
    rows : (n, 2 D + 1) ndarray
        Poses of the page's steps.
    stopped : Event
        Ends it early, with what there is.

    Raises
    ------
    InputError
        If the scene has no finite elements, or they refuse a pose.
    """
    if scene.fem is None:
        raise InputError("this scene has no finite elements")
    model: Tissue = scene.fem()
    state, dt, D = model.rest(), 1.0 / scene.pack.manifest.rate, scene.pack.dimension
    for row in rows.tolist():  # the page's own steps: what differs is the tissue
        if stopped.is_set():
            break
        state = model.advance(state, NeedlePose(tuple(row[:D]), tuple(row[D : 2 * D]), row[-1]), dt)
    return model.displacement(state)
