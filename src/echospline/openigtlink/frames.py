"""Coordinate frames and the transforms between them, by the names that PLUS and Slicer give (``NeedleToReference``)."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping

import numpy as np

from echospline.errors import InputError
from echospline.grid import Floats

_TO = re.compile(r"(?<=.)To(?=[A-Z])")


def frames_of(name: str) -> tuple[str, str]:
    """Frames of a transform's name: ``ToolToTracker`` takes coordinates of Tool to those of Tracker.

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
    """Matrix from frame ``source`` to frame ``target``, along the fewest known transforms; None if none lead there.

    Parameters
    ----------
    transforms : mapping of str to ndarray, shape (4, 4)
        By name; each is walked both ways. Matrices act on column vectors from the left.
    source, target : str
        Names of frames.
    """
    steps: dict[str, list[tuple[str, Floats, bool]]] = {}
    for name, matrix in transforms.items():
        start, end = frames_of(name)
        steps.setdefault(start, []).append((end, matrix, False))
        steps.setdefault(end, []).append((start, matrix, True))
    found = {source: np.eye(4)}
    queue = deque([source])
    while queue:
        frame = queue.popleft()
        if frame == target:
            return found[frame]
        for other, matrix, inverse in steps.get(frame, ()):
            if other in found:
                continue
            if inverse and abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
                continue  # a flat transform leads one way only
            found[other] = (np.linalg.inv(matrix) if inverse else matrix) @ found[frame]
            queue.append(other)
    return None
