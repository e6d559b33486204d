"""The calibration in a PLUS device set file: its ``CoordinateDefinitions`` as transforms by name."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from echospline.errors import InputError
from echospline.scene import Floats, frames_of

LARGEST = 2**20
"""Bytes of a device set file."""


def read_calibration(path: str | Path) -> dict[str, Floats]:
    """Read the fixed transforms of a PLUS device set file (``PlusDeviceSet_....xml``).

    Raises
    ------
    InputError
        If the file is no such file or a transform has not 16 numbers.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    if len(data) > LARGEST or b"<!" in data.replace(b"<!--", b""):
        raise InputError(f"{path} is no PLUS device set file: it is too large or declares entities")
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise InputError(f"{path} is no XML: {error}") from error
    if root.tag != "PlusConfiguration":
        raise InputError(f"{path} must be a PLUS device set file, <PlusConfiguration>; got <{root.tag}>")
    calibration: dict[str, Floats] = {}
    for element in root.iterfind("CoordinateDefinitions/Transform"):
        name = f"{element.get('From', '')}To{element.get('To', '')}"
        frames_of(name)
        try:
            numbers = np.array([float(n) for n in element.get("Matrix", "").split()])
        except ValueError:
            numbers = np.empty(0)
        if numbers.shape != (16,) or not np.isfinite(numbers).all():
            raise InputError(f"{path}: the Matrix of {name} must be 16 numbers, row by row")
        calibration[name] = numbers.reshape(4, 4)
    if not calibration:
        raise InputError(f"{path} has no <Transform> in <CoordinateDefinitions>")
    return calibration
