"""The ultrasound images that ship with the package; data/SOURCES.md names their origin."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from PIL import Image

from echospline.errors import InputError
from echospline.scene import UltrasoundImage


@dataclass(frozen=True)
class Sample:
    """A shipped image.

    Parameters
    ----------
    file : str
        Name inside the folder `data`.
    spacing : (lateral, depth)
        mm per pixel.
    source : str
        Origin and licence in one line.
    """

    file: str
    spacing: tuple[float, float]
    source: str


SAMPLES = {
    "calf": Sample(
        "calf.png",
        (0.0866, 0.0866),
        "calf muscle in vivo (gastrocnemius lateralis), linear probe ML6-15, GE LOGIQ E9; "
        "Tim van der Zee, ultrasound-automated-algorithm, dataset 2, CC0-1.0",
    )
}

IN_SPACE = ("kidney", "spine")
"""Samples that are volumes, which the laboratory makes or reads: here they are only named."""


def sample_image(name: str = "calf") -> UltrasoundImage:
    """Return a shipped image with its spacing.

    Parameters
    ----------
    name : {"calf"}
        calf: 576 x 456 pixels of 0.0866 mm, 49.9 mm wide and 39.5 mm deep, 8-bit grey.

    Raises
    ------
    InputError
        If there is no such image.
    """
    if name not in SAMPLES:
        raise InputError(f"there is no sample {name!r}; expected one of: {', '.join(SAMPLES)}")
    sample = SAMPLES[name]
    with (
        files("echospline").joinpath("data", sample.file).open("rb") as file,
        Image.open(file, formats=("PNG",)) as image,
    ):
        pixels = np.asarray(image)
    return UltrasoundImage.from_array(pixels, sample.spacing, f"sample:{name}: {sample.source}")
