"""Files: images and cines in, cines and displacement records out; input is checked before it is used.

`sequence` is imported by its own name: it loads SimpleITK.
"""

from echospline.io.arrays import ArrayInfo, LineCine, list_arrays, open_lines
from echospline.io.dicom_cine import dicom_cine
from echospline.io.displacement import (
    DisplacementRecord,
    DisplacementWriter,
    displacement_shapes,
    is_spatial_record,
    read_displacement,
    read_spatial_displacement,
)
from echospline.io.displacement_space import SpatialDisplacementRecord
from echospline.io.echoes import EchoStream, EchoWriter, open_echoes, read_echoes
from echospline.io.kind import PICTURES, head, kind_of
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
from echospline.io.writing import TRANSPARENT, CineWriter, needs_window, open_writer

__all__ = [
    "LIMIT",
    "MIB",
    "PICTURES",
    "SAMPLE",
    "SAMPLES",
    "TRANSPARENT",
    "ArrayInfo",
    "CineStream",
    "CineWriter",
    "DisplacementRecord",
    "DisplacementWriter",
    "EchoStream",
    "EchoWriter",
    "LineCine",
    "Recording",
    "SpatialDisplacementRecord",
    "choose_image",
    "decoding",
    "dicom_cine",
    "displacement_shapes",
    "head",
    "is_spatial_record",
    "kind_of",
    "list_arrays",
    "needs_window",
    "open_cine",
    "open_echoes",
    "open_lines",
    "open_recording",
    "open_writer",
    "read",
    "read_displacement",
    "read_echoes",
    "read_image",
    "read_needle",
    "read_spatial_displacement",
    "sample_image",
]
