"""Files: images and cines in, cines and displacement records out; whatever comes from outside is checked first."""

from echospline.io.displacement import DisplacementRecord, DisplacementWriter, read_displacement
from echospline.io.reading import CineStream, open_cine, open_recording, read, read_image
from echospline.io.writing import CineWriter, open_writer

__all__ = [
    "CineStream",
    "CineWriter",
    "DisplacementRecord",
    "DisplacementWriter",
    "open_cine",
    "open_recording",
    "open_writer",
    "read",
    "read_displacement",
    "read_image",
]
