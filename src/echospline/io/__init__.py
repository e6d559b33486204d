"""Files: images and cines in, cines and displacement records out; input is checked before it is used.

`sequence` is imported by its own name: it loads SimpleITK.
"""

from echospline.io.displacement import (
    DisplacementRecord,
    DisplacementWriter,
    displacement_shapes,
    read_displacement,
)
from echospline.io.echoes import EchoWriter, read_echoes
from echospline.io.kind import head, kind_of
from echospline.io.needle_path import read_needle
from echospline.io.reading import (
    SAMPLE,
    CineStream,
    choose_image,
    open_cine,
    open_recording,
    read,
    read_image,
)
from echospline.io.recording import LIMIT, MIB, Recording, decoding
from echospline.io.samples import SAMPLES, sample_image
from echospline.io.writing import CineWriter, open_writer

__all__ = [
    "LIMIT",
    "MIB",
    "SAMPLE",
    "SAMPLES",
    "CineStream",
    "CineWriter",
    "DisplacementRecord",
    "DisplacementWriter",
    "EchoWriter",
    "Recording",
    "choose_image",
    "decoding",
    "displacement_shapes",
    "head",
    "kind_of",
    "open_cine",
    "open_recording",
    "open_writer",
    "read",
    "read_displacement",
    "read_echoes",
    "read_image",
    "read_needle",
    "sample_image",
]
