"""Tracked transforms combined: position of the imaging plane, and of the needle in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from echospline.errors import InputError
from echospline.openigtlink.tools import TRACKER_FRAME
from echospline.scene import (
    AXIAL,
    Floats,
    ImagingPlane,
    RegularGrid,
    TrackedNeedle,
    as_transform,
    chain_between,
    frames_of,
    rigid_fault,
    transform_between,
)

MOST = 100
"""Transforms stored at most; a tracker has a dozen."""
FARTHEST = 1e4
"""mm; no tracker sees a tool at 10 m."""
_STAYS = "the needle stays where it was"


@dataclass(frozen=True)
class Naming:
    """Names of frames.

    Parameters
    ----------
    needles : tuple of str
        Frames at the needle's tip, the first that can be found counts (``NeedleTipToReference``).
    reference : str
        The frame of all positions sent.
    image : str
        The image's frame; also its device name.
    axis : (x, y, z)
        Direction of insertion in the needle's frame.
    plane : ImagingPlane
        Plane of the image until a transform from it arrives.
    calibration : mapping of str to ndarray
        Fixed transforms (``NeedleTipToNeedle``, ``ImageToProbe``).
    probe, scene : str
        In space: the probe's frame and the volume's.
    """

    needles: tuple[str, ...] = ("NeedleTip", "StylusTip")
    reference: str = "Reference"
    image: str = "Image"
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    plane: ImagingPlane = field(default_factory=lambda: ImagingPlane(AXIAL))
    calibration: Mapping[str, Floats] = field(default_factory=dict)
    probe: str = "Probe"
    scene: str = "Scene"


@dataclass(frozen=True)
class Located:
    """Positions of plane and needle by the newest transforms.

    Parameters
    ----------
    plane : ImagingPlane
        Plane of the image.
    needle : TrackedNeedle or None
        The needle, if a chain of transforms leads to it; where it was last known to be while ``held``.
    trouble : str
        Description of a fault; empty if there is none.
    fault : {"", "Transforms", "Invalid", "Stale", "Refused"}
        Kind of the fault: no chain of transforms, a status other than OK, silence, a matrix that no tool can have.
    about : str
        Name of the transform at fault.
    held : bool
        Whether the needle stays where it was.
    """

    plane: ImagingPlane
    needle: TrackedNeedle | None
    trouble: str = ""
    fault: str = ""
    about: str = ""
    held: bool = False


@dataclass
class _Heard:
    """One transform as its tracker sends it."""

    matrix: Floats | None = None
    at: float = 0.0
    count: int = 0
    status: str = ""
    refusal: str = ""
    kind: str = ""
    unit_settled: bool = False


class Received:
    """The newest transform of each name, and what its tracker says of it.

    A transform whose status is not OK, or that no tool can have, leaves the one before it in force. Times are those of the
    receiver: the clocks of trackers are not set.

    Parameters
    ----------
    naming : Naming
        Names of frames.
    silence : float
        Seconds without a transform after which a tool counts as stale.
    """

    def __init__(self, naming: Naming, silence: float = 0.5) -> None:
        self.naming, self.silence = naming, silence
        self._heard: dict[str, _Heard] = {}
        for name, matrix in naming.calibration.items():
            frames_of(name)
            as_transform(matrix)

    def put(self, name: str, matrix: Floats, status: str = "", now: float = 0.0) -> None:
        """Store a transform, unless its status or its numbers forbid.

        Parameters
        ----------
        name : str
            <From>To<To>.
        matrix : ndarray, shape (4, 4)
            As received.
        status : str
            The sender's word on it (``OK``, ``INVALID``, ``MISSING`` ...); empty where it gives none.
        now : float
            The receiver's clock, s.

        Raises
        ------
        InputError
            If its name is not <From>To<To>, or there are too many; and once for every kind of matrix that no tool can
            have: repeated ones are refused in silence, until a good one comes.
        """
        frames_of(name)
        if name not in self._heard and len(self._heard) >= MOST:
            raise InputError(f"at most {MOST} transforms are remembered; {name} is one too many")
        heard = self._heard.setdefault(name, _Heard())
        heard.at, heard.count = now, heard.count + 1
        heard.status = "" if is_valid(status) else status.strip().upper()[:40]
        if heard.status:
            return
        kind, reason = self._refusal(name, matrix, settled=heard.unit_settled)
        if kind:
            known, heard.kind = heard.kind, kind
            if known != kind:
                heard.refusal = reason
                raise InputError(f"{name}: {reason}")
            return
        heard.matrix, heard.refusal, heard.kind = as_transform(matrix), "", ""
        heard.unit_settled = heard.unit_settled or math.hypot(*matrix[:3, 3]) >= self._least(name)

    def _least(self, name: str) -> float:
        """Return the distance below which mm are doubted, mm: a tool is never within 3 mm of its tracker.

        A tip in the reference frame can be, but not within 1 mm from the first moment on, unless it lies at 0 exactly.
        """
        start, end = frames_of(name)
        if end == TRACKER_FRAME:
            return 3.0
        return 1.0 if start in self.naming.needles and end == self.naming.reference else 0.0

    def _refusal(self, name: str, matrix: Floats, *, settled: bool) -> tuple[str, str]:
        """Return kind and reason if no tool can have this matrix; the image's own may be scaled to pixels."""
        if (
            np.shape(matrix) != (4, 4)
            or not np.isfinite(matrix).all()
            or not np.array_equal(matrix[3], (0, 0, 0, 1))
        ):
            return "numbers", (
                "expected 4 x 4 finite numbers with the last row 0 0 0 1, and a unit quaternion where there is one"
            )
        if self.naming.image in frames_of(name):
            return _picture_fault(matrix)
        kind, reason = rigid_fault(matrix)
        if kind:
            return kind, reason
        distance = math.hypot(*matrix[:3, 3])
        if distance > FARTHEST:
            return "far", (
                f"expected a translation in mm; got {distance:.4g}, farther than any tracker sees: "
                "are these micrometres? Send mm"
            )
        if not settled and 0.0 < distance < self._least(name):
            return "near", (
                f"expected a translation in mm; got {distance:.2g}, nearer than a tool can be: "
                "are these metres? Send mm"
            )
        return "", ""

    @property
    def any(self) -> bool:
        """Whether a transform has come."""
        return bool(self._heard)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the transforms that have come."""
        return tuple(self._heard)

    def known(self, standing: Mapping[str, Floats] | None = None) -> dict[str, Floats]:
        """Return the transforms in force: those that stand without a word, those of the calibration, those received."""
        heard = {k: h.matrix for k, h in self._heard.items() if h.matrix is not None}
        return {**(standing or {}), **self.naming.calibration, **heard}

    def spoken(self) -> tuple[str, str, str]:
        """Return kind, name and reason of the first transform that is invalid or refused; empty if there is none."""
        for name, heard in self._heard.items():
            if heard.status or heard.kind:
                fault, reason = self._spoken(name, heard)
                return fault, name, reason
        return "", "", ""

    def fault(self, chain: tuple[str, ...], now: float) -> tuple[str, str, str]:
        """Return kind, name and reason if the tool at the end of this chain of transforms is not known now."""
        heard = {name: self._heard[name] for name in chain if name in self._heard}
        for name, one in heard.items():
            if one.status or one.kind:
                return (fault := self._spoken(name, one))[0], name, fault[1]
        # a transform that came once is a setting, not a stream: it may rest as long as another one goes on
        streams = {name: one for name, one in heard.items() if one.count > 1} or heard
        if streams:
            name, oldest = min(streams.items(), key=lambda item: item[1].at)
            if now - oldest.at > self.silence:
                return "Stale", name, f"stale: {name} has been silent for {now - oldest.at:.1f} s"
        return "", "", ""

    @staticmethod
    def _spoken(name: str, heard: _Heard) -> tuple[str, str]:
        if heard.status:
            return "Invalid", f"{name} is {heard.status}"
        return "Refused", f"{name} is refused: {heard.refusal}"


class Tracking:
    """Combines the newest transforms into the image's plane and the needle in it.

    Parameters
    ----------
    grid : RegularGrid
        The image's pixels.
    naming : Naming
        Names of frames.
    silence : float
        Seconds without a transform after which the needle counts as stale.
    """

    def __init__(self, grid: RegularGrid, naming: Naming, silence: float = 0.5) -> None:
        self.grid, self.naming, self.received = grid, naming, Received(naming, silence)
        self._good: TrackedNeedle | None = None

    def put(self, name: str, matrix: Floats, status: str = "", now: float = 0.0) -> None:
        """Store a transform; see `Received.put`."""
        self.received.put(name, matrix, status, now)

    def locate(self, now: float = 0.0) -> Located:
        """Locate plane and needle by the newest transforms.

        Parameters
        ----------
        now : float
            The receiver's clock, s.
        """
        n = self.naming
        known = self.received.known()
        plane, trouble = n.plane, ""
        image = transform_between(known, n.image, n.reference)
        if image is not None:
            try:
                plane = ImagingPlane.of_image(image, self.grid)
            except InputError as error:
                trouble = str(error)
        for frame in n.needles:
            found = chain_between(known, frame, n.reference)
            if found is None:
                continue
            tip, chain = found
            fault, about, reason = self.received.fault(chain, now)
            kind, described = rigid_fault(tip)
            if kind and not fault:
                fault, about, reason = "Refused", chain[0], f"{' * '.join(chain)}: {described}"
            if self._good is None and not kind:
                self._good = plane.see(tip, n.axis)
            if fault:
                return Located(plane, self._good, f"{reason}; {_STAYS}", fault, about, held=True)
            self._good = plane.see(tip, n.axis)
            return Located(plane, self._good, trouble, "Transforms" if trouble else "")
        fault, about, reason = self.received.spoken()
        if fault:
            return Located(plane, None, f"{reason}; no tracked needle yet", fault, about)
        if self.received.any and not trouble:
            trouble = (
                f"no transform leads from {' or '.join(n.needles)} to {n.reference}; "
                f"there are {', '.join(sorted(known))}"
            )
        return Located(plane, None, trouble, "Transforms" if trouble else "")


def _picture_fault(matrix: Floats) -> tuple[str, str]:
    """Return kind and reason if no picture can have this matrix, whose columns may hold its spacing."""
    largest = float(np.abs(matrix).max())
    if largest > FARTHEST:
        return "far", f"expected the picture's place in mm; got {largest:.4g}, farther than any tracker sees"
    return "", ""


def is_valid(status: str) -> bool:
    """Test whether a tracker's status lets its transform be used: OK, a pressed switch, or none given."""
    word = status.strip().upper().removeprefix("TOOL_")
    return word in ("", "OK") or (word.startswith("SWITCH") and word.endswith("_IS_ON"))
