"""The per-frame fields ``Seq_Frame0000_NAME`` of recorded sequences, as PLUS, 3D Slicer and echospline write them."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from echospline.io.declared import Clock, Lengths
from echospline.scene import Floats

FRAME_FIELD = re.compile(r"Seq_Frame(\d{1,19})_(\w+)", re.IGNORECASE)
"""Number of the frame, of any number of digits, and the field's name."""
_TRANSFORM = re.compile(r"Image(To\w+?)Transform", re.IGNORECASE)


class FrameFields:
    """The fields of every frame, by lower-case name.

    Parameters
    ----------
    fields : mapping of str to str
        The header; other fields are not used.
    frames : int
        Number of frames; fields beyond the last are not used.
    """

    def __init__(self, fields: Mapping[str, str], frames: int) -> None:
        self._frames = frames
        self._named: dict[str, dict[int, str]] = {}
        for key, value in fields.items():
            match = FRAME_FIELD.fullmatch(key)
            if match and int(match[1]) < frames:
                self._named.setdefault(match[2].lower(), {})[int(match[1])] = value

    def __bool__(self) -> bool:
        return bool(self._named)

    def clock(self) -> Clock | None:
        """Return the time stamps; the fault names the first good frame that has none. None where no frame has one."""
        name = next((n for n in ("timestamp", "unfilteredtimestamp") if n in self._named), None)
        if name is None:
            return None
        stamps = np.array([_number(self._named[name].get(i, "")) for i in range(self._frames)])
        valid = self.valid()
        needed = np.ones(self._frames, dtype=bool) if valid is None else valid
        missing = np.flatnonzero(needed & ~np.isfinite(stamps))
        if len(missing):
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            return Clock("Seq_Frame..._Timestamp", None, f"lacks frame {missing[0]}{more}")
        return Clock("Seq_Frame..._Timestamp", stamps)

    def valid(self) -> NDArray[np.bool_] | None:
        """Return the frames whose image status is OK; None where no frame has a status."""
        status = self._named.get("imagestatus") or self._named.get("status")
        if not status:
            return None
        return np.array([status.get(i, "OK").strip().upper() == "OK" for i in range(self._frames)])

    def lengths(self) -> list[Lengths]:
        """Return the calibration (columns of a transform from Image, of the shown picture), then the frames' own spacing."""
        found = []
        for name, values in self._named.items():
            if _TRANSFORM.fullmatch(name):
                status = self._named.get(f"{name}status", {})
                good = (values[i] for i in sorted(values) if status.get(i, "OK").strip().upper() == "OK")
                found += calibrations(next(good, ""), f"calibration {_shown_name(name)}")
        for value in list(self._named.get("elementspacing", {}).values())[:1]:
            numbers = _numbers(value)
            if len(numbers) >= 2:
                first, second = float(numbers[0]), float(numbers[1])
                found.append(Lengths((first, second), "Seq_Frame..._ElementSpacing", one_is_unknown=True))
        return found


def calibrations(matrix: str, name: str) -> list[Lengths]:
    """Return the distance of pixels from the columns of a 4 x 4 transform from Image, or nothing if it is none."""
    numbers = _numbers(matrix)
    if len(numbers) != 16 or not np.isfinite(numbers).all():
        return []
    lateral, depth = np.linalg.norm(numbers.reshape(4, 4)[:3, :2], axis=0)
    # the identity is the value of a transform that was never calibrated
    return [Lengths((float(lateral), float(depth)), name, shown=True, one_is_unknown=True)]


def _shown_name(name: str) -> str:
    """Return "imagetoprobetransform" as "Image to probe"."""
    return name.removesuffix("transform").capitalize().replace("to", " to ", 1)


def _numbers(text: str) -> Floats:
    try:
        return np.array([float(v) for v in text.split()])
    except ValueError:
        return np.empty(0)


def _number(text: str) -> float:
    found = _numbers(text)
    return float(found[0]) if len(found) == 1 else float("nan")
