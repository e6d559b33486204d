"""Tracked transforms combined in space: where the probe's picture and the needle are in the scene, and the scene in the reference frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from echospline.errors import InputError
from echospline.openigtlink.transforms import Naming, Received
from echospline.scene import (
    Floats,
    ImagingPlane,
    RegularGrid,
    TrackedNeedle,
    chain_between,
    frames_of,
    nearest_rigid,
    picture_plane,
    rigid_fault,
)

_AT_THE_TIP = ImagingPlane(np.eye(4))
"""Sees a needle in the frame that its matrix leads to."""


@dataclass(frozen=True)
class SpatialLocated:
    """Positions of scene, probe and needle by the newest transforms.

    Parameters
    ----------
    scene : ndarray, shape (4, 4)
        Scene to reference frame, mm.
    plane : ImagingPlane or None
        The picture's frame to the scene's, if a chain of transforms leads there; where it was last known to be while held.
    needle : TrackedNeedle or None
        In the scene's frame; likewise.
    trouble, fault, about : str
        As in `Located`.
    probe_held, needle_held : bool
        Whether the probe, the needle stays where it was.
    """

    scene: Floats
    plane: ImagingPlane | None = None
    needle: TrackedNeedle | None = None
    trouble: str = ""
    fault: str = ""
    about: str = ""
    probe_held: bool = False
    needle_held: bool = False

    @property
    def held(self) -> bool:
        """Whether something stays where it was."""
        return self.probe_held or self.needle_held


_Wrong = tuple[str, str, str]
"""Kind, name and reason of a fault; empty where there is none."""
_FINE: _Wrong = ("", "", "")


class SpatialTracking:
    """Combines the newest transforms into probe and needle in the scene.

    Without a word of a tracker or a calibration, the frame of the probe is the picture's (x along the face from its middle, y along the beam), and
    the scene stands at its place.

    Parameters
    ----------
    grid : RegularGrid
        The picture's pixels in its frame.
    place : ndarray, shape (4, 4)
        Scene to reference frame where no transform says so, mm.
    naming : Naming
        Names of frames.
    silence : float
        Seconds without a transform after which a tool counts as stale.

    Raises
    ------
    InputError
        If the calibration has a transform from the picture to the probe that does not fit the picture, or another that is not rigid.
    """

    def __init__(self, grid: RegularGrid, place: Floats, naming: Naming, silence: float = 0.5) -> None:
        self.grid, self.place, self.naming = grid, place, naming
        self.received = Received(naming, silence)
        self._scene = place
        self._plane: ImagingPlane | None = None
        self._needle: TrackedNeedle | None = None
        self.picture_to_probe: Floats = np.eye(4)
        """From the picture's frame to the probe's, mm, by the calibration."""
        for name, matrix in naming.calibration.items():
            kind, reason = rigid_fault(matrix) if naming.image not in frames_of(name) else ("", "")
            if kind:
                raise InputError(f"calibration {name}: {reason}")
        calibrated = chain_between(naming.calibration, naming.image, naming.probe)
        if calibrated is not None:
            try:
                self.picture_to_probe = picture_plane(calibrated[0], grid).matrix
            except InputError as error:
                raise InputError(
                    f"calibration {' * '.join(calibrated[1])}: {error} (space.probe.pixel)"
                ) from None

    def put(self, name: str, matrix: Floats, status: str = "", now: float = 0.0) -> None:
        """Store a transform; see `Received.put`."""
        self.received.put(name, matrix, status, now)

    def locate(self, now: float = 0.0) -> SpatialLocated:
        """Combine the newest transforms; ``now`` is the receiver's clock, s."""
        known = self._known()
        scene = self._locate_scene(known)
        probe_seen, probe = self._locate_probe(known, now)
        needle_seen, needle = self._locate_needle(known, now)
        wrong = scene if scene[0] else probe if probe[0] else needle
        trouble = wrong[2]
        held = [
            name for name, one in (("the probe", probe), ("the needle", needle)) if one[0] and one[0] != "Transforms"
        ]  # fmt: skip
        if probe[2] and needle[2] and probe[2] != needle[2]:
            trouble = f"{probe[2]}; {needle[2]}"
        if held:
            trouble += (
                f"; {' and '.join(held)} {'stay where they were' if len(held) > 1 else 'stays where it was'}"
            )
        if not wrong[0] and not (probe_seen and needle_seen):
            kind, about, reason = self.received.spoken()
            if kind:
                nothing = "probe" if not probe_seen else "needle"
                wrong, trouble = (kind, about, reason), f"{reason}; no tracked {nothing} yet"
        if not wrong[0] and self.received.any and not probe_seen and not needle_seen:
            frames = ", ".join((*self.naming.needles, self.naming.image))
            trouble = f"no transform leads from {frames} to {self.naming.reference}; there are {', '.join(sorted(known))}"
            wrong = ("Transforms", "", trouble)
        return SpatialLocated(
            self._scene, self._plane, self._needle, trouble, wrong[0], wrong[1],
            "the probe" in held, "the needle" in held,
        )  # fmt: skip

    def _known(self) -> dict[str, Floats]:
        """Return all transforms in force, those that hold without a word included."""
        n, known = self.naming, self.received.known()
        if not any(n.scene in frames_of(name) for name in known):
            known[f"{n.scene}To{n.reference}"] = self.place
        if chain_between(n.calibration, n.image, n.probe) is None and f"{n.image}To{n.probe}" not in known:
            known[f"{n.image}To{n.probe}"] = ImagingPlane(np.eye(4)).image_matrix(self.grid)
        return known

    def _locate_scene(self, known: Mapping[str, Floats]) -> _Wrong:
        found = chain_between(known, self.naming.scene, self.naming.reference)
        if found is None:
            return (
                "Transforms",
                "",
                f"no transform leads from {self.naming.scene} to {self.naming.reference}; it stands where it did",
            )
        matrix, chain = found
        kind, described = rigid_fault(matrix)
        if kind:
            return "Refused", chain[0], f"{' * '.join(chain)}: {described}"
        self._scene = nearest_rigid(matrix)
        return _FINE

    def _locate_probe(self, known: Mapping[str, Floats], now: float) -> tuple[bool, _Wrong]:
        """Take the plane's newest place; returns whether a chain leads to it, and what is wrong with it."""
        found = chain_between(known, self.naming.image, self.naming.scene)
        if found is None:
            return False, _FINE
        matrix, chain = found
        wrong = self.received.fault(chain, now)
        try:
            plane = picture_plane(matrix, self.grid)
        except InputError as error:
            return True, wrong if wrong[0] else ("Refused", chain[0], str(error))
        if not wrong[0] or self._plane is None:
            self._plane = plane
        return True, wrong

    def _locate_needle(self, known: Mapping[str, Floats], now: float) -> tuple[bool, _Wrong]:
        """Take the needle's newest place; returns whether a chain leads to it, and what is wrong with it."""
        n = self.naming
        for frame in n.needles:
            found = chain_between(known, frame, n.scene)
            if found is None:
                continue
            matrix, chain = found
            wrong = self.received.fault(chain, now)
            kind, described = rigid_fault(matrix)
            if kind:
                return True, wrong if wrong[0] else ("Refused", chain[0], f"{' * '.join(chain)}: {described}")
            if not wrong[0] or self._needle is None:
                self._needle = _AT_THE_TIP.see(nearest_rigid(matrix), n.axis)
            return True, wrong
        if any("Needle" in name for name in self.received.names):
            there = ", ".join(sorted(self.received.names))
            missing = f"no transform leads from {' or '.join(n.needles)} to {n.reference}; there are {there}"
            return False, ("Transforms", "", missing)
        return False, _FINE
