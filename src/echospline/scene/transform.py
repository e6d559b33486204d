"""Rigid transforms between coordinate frames, named as PLUS and Slicer name them (``NeedleToReference``)."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping

import numpy as np

from echospline.errors import InputError
from echospline.scene.grid import Floats

_TO = re.compile(r"(?<=.)To(?=[A-Z])")


def frames_of(name: str) -> tuple[str, str]:
    """Split a transform's name into its frames: ``ToolToTracker`` takes coordinates of Tool to those of Tracker.

    Raises
    ------
    InputError
        If the name is not <From>To<To> with exactly one such To.
    """
    matches = list(_TO.finditer(name))
    if len(matches) != 1:
        raise InputError(f"a transform is named <From>To<To>, as NeedleTipToReference; got {name!r}")
    return name[: matches[0].start()], name[matches[0].end() :]


def transform_between(transforms: Mapping[str, Floats], source: str, target: str) -> Floats | None:
    """Return the matrix from frame ``source`` to frame ``target`` along the fewest transforms; None if none lead there.

    Parameters
    ----------
    transforms : mapping of str to ndarray, shape (4, 4)
        By name; each is walked both ways. Matrices act on column vectors from the left.
    source, target : str
        Names of frames.
    """
    found = chain_between(transforms, source, target)
    return None if found is None else found[0]


def chain_between(
    transforms: Mapping[str, Floats], source: str, target: str
) -> tuple[Floats, tuple[str, ...]] | None:
    """Return what `transform_between` returns, and the names of the transforms on the way."""
    steps: dict[str, list[tuple[str, str, Floats, bool]]] = {}
    for name, matrix in transforms.items():
        start, end = frames_of(name)
        steps.setdefault(start, []).append((name, end, matrix, False))
        steps.setdefault(end, []).append((name, start, matrix, True))
    found: dict[str, tuple[Floats, tuple[str, ...]]] = {source: (np.eye(4), ())}
    queue = deque([source])
    while queue:
        frame = queue.popleft()
        if frame == target:
            return found[frame]
        before, names = found[frame]
        for name, other, matrix, inverse in steps.get(frame, ()):
            if other in found:
                continue
            if inverse and abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
                continue  # a singular transform cannot be inverted
            found[other] = (np.linalg.inv(matrix) if inverse else matrix) @ before, (*names, name)
            queue.append(other)
    return None


def as_transform(matrix: Floats) -> Floats:
    """Check a 4 x 4 matrix and return it as float64.

    Raises
    ------
    InputError
        If the shape is another, a number is not finite or the last row is not 0 0 0 1.
    """
    array = np.array(matrix, dtype=np.float64)
    if array.shape != (4, 4):
        raise InputError(f"a transform is a 4 x 4 matrix; got shape {array.shape}")
    if not np.isfinite(array).all() or not np.array_equal(array[3], (0, 0, 0, 1)):
        raise InputError(f"a transform has finite numbers and the last row 0 0 0 1; got {array.tolist()}")
    array.setflags(write=False)
    return array
