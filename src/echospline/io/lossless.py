"""Lossless JPEG and JPEG-LS frames of DICOM files, decoded by GDCM in a process of their own.

GDCM ends the whole process on some damaged frames (assertions, invalid memory), so it never runs in this one: a child
process writes frames as plain bytes to its standard output, and its abnormal end counts as a damaged file.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from echospline.errors import InputError, MissingExtraError
from echospline.scene import Pixels


def lossless_frames(
    path: Path, shape: tuple[int, ...], dtype: np.dtype[Any], frame: int | None, what: str
) -> Iterator[Pixels]:
    """Decode frames in a child process.

    Parameters
    ----------
    path : Path
        DICOM file.
    shape : (rows, columns) or (rows, columns, 3)
        Of one frame, as its header declares it.
    dtype : dtype
        Of the pixels.
    frame : int, optional
        This frame alone; all of them when None.
    what : str
        Name of the compression.

    Raises
    ------
    MissingExtraError
        If GDCM is not installed.
    InputError
        If a frame cannot be decoded.
    """
    if find_spec("gdcm") is None:
        raise MissingExtraError("python-gdcm", "dicom", f"DICOM compressed as {what}")
    size = prod(shape) * dtype.itemsize
    # -P keeps the working folder out of the child's module path.
    command = [sys.executable, "-P", "-m", __name__, str(path), "" if frame is None else str(frame)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as child:
        if child.stdout is None:
            raise InputError(f"cannot start a decoder for {path}")
        try:
            data = child.stdout.read(size)
            while len(data) == size:
                yield np.frombuffer(data, dtype).reshape(shape)
                data = child.stdout.read(size)
        except GeneratorExit:
            child.kill()
            raise
    if child.returncode != 0 or data:
        raise InputError(f"{path} is damaged: its {what} frames cannot be decoded")


def _main(path: str, frame: str) -> None:
    from pydicom.pixels.utils import iter_pixels  # noqa: PLC0415

    from echospline.io.dicom.pixels import PREAMBLE_MARK, read_dataset  # noqa: PLC0415

    with open(path, "rb") as file:
        bare = file.read(132)[128:] != PREAMBLE_MARK
    source: Any = read_dataset(Path(path)) if bare else path
    for pixels in iter_pixels(source, indices=[int(frame)] if frame else None, decoding_plugin="gdcm"):
        sys.stdout.buffer.write(np.ascontiguousarray(pixels).data)


if __name__ == "__main__":
    _main(sys.argv[1], sys.argv[2])
