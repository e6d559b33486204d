"""Recordings of a page as DICOM: frames after a line of JSON that says what they are."""

from __future__ import annotations

import json
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from echospline.errors import InputError
from echospline.io import dicom_cine

LONGEST_HEAD = 4096
"""Bytes."""
Side = Annotated[int, Field(ge=1, le=8192)]


class Head(BaseModel):
    """What the frames are: grey (samples 1) or red, green and blue (3); spacing in mm, or null where they show no plane of one scale."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    columns: Side
    rows: Side
    frames: int = Field(ge=1, le=100_000)
    samples: int = Field(1, ge=1, le=3)
    spacing: tuple[Annotated[float, Field(gt=0, le=1000)], Annotated[float, Field(gt=0, le=1000)]] | None = (
        None
    )
    title: str = Field("", max_length=200)


def as_dicom(data: bytes, rate: str) -> bytes:
    """Return frames of a page as a DICOM file.

    Parameters
    ----------
    data : bytes
        `Head` as JSON, a newline, then frames row by row.
    rate : str
        Frames per second.

    Raises
    ------
    InputError
        If the head is none, or the frames are not as many bytes as it says.
    """
    line, newline, pixels = data.partition(b"\n")
    try:
        if not newline or len(line) > LONGEST_HEAD:
            raise ValueError
        head = Head.model_validate(json.loads(line))
    except (ValueError, RecursionError, ValidationError):
        raise InputError(
            "expected a line of JSON with columns, rows, frames and spacing, then the frames"
        ) from None
    if head.samples == 2:
        raise InputError("frames are grey (1 sample) or red, green and blue (3); got 2")
    shape = (head.frames, head.rows, head.columns) + ((3,) if head.samples == 3 else ())
    size = int(np.prod(shape, dtype=object))
    if len(pixels) != size:
        raise InputError(f"the frames are said to have {size} bytes; got {len(pixels)}")
    try:
        frames_per_second = float(rate)
    except ValueError:
        raise InputError(f"rate must be frames per second; got {rate[:20]!r}") from None
    frames = np.frombuffer(pixels, np.uint8).reshape(shape)
    return dicom_cine(frames, frames_per_second, head.spacing, title=head.title)
