"""Tracked transforms combined: position of the imaging plane, and of the needle in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from echospline.errors import InputError
from echospline.scene import (
    AXIAL,
    Floats,
    ImagingPlane,
    RegularGrid,
    TrackedNeedle,
    as_transform,
    frames_of,
    transform_between,
)

MOST = 100
"""Transforms stored at most; a tracker has a dozen."""


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
    """

    needles: tuple[str, ...] = ("NeedleTip", "StylusTip")
    reference: str = "Reference"
    image: str = "Image"
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    plane: ImagingPlane = field(default_factory=lambda: ImagingPlane(AXIAL))
    calibration: Mapping[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True)
class Located:
    """Positions of plane and needle by the newest transforms.

    Parameters
    ----------
    plane : ImagingPlane
        Plane of the image.
    needle : TrackedNeedle or None
        The needle, if a chain of transforms leads to it.
    trouble : str
        Description of a fault; empty if there is none.
    """

    plane: ImagingPlane
    needle: TrackedNeedle | None
    trouble: str = ""


class Tracking:
    """Stores the newest transform of each name; `locate` combines them.

    Parameters
    ----------
    grid : RegularGrid
        The image's pixels.
    naming : Naming
        Names of frames.
    """

    def __init__(self, grid: RegularGrid, naming: Naming) -> None:
        self.grid, self.naming = grid, naming
        self._known: dict[str, Floats] = {}
        for name, matrix in naming.calibration.items():
            frames_of(name)
            as_transform(matrix)

    def put(self, name: str, matrix: Floats) -> None:
        """Store a transform.

        Raises
        ------
        InputError
            If its name is not <From>To<To>, or there are too many.
        """
        frames_of(name)
        if name not in self._known and len(self._known) >= MOST:
            raise InputError(f"at most {MOST} transforms are remembered; {name} is one too many")
        self._known[name] = matrix

    def locate(self) -> Located:
        """Locate plane and needle by the newest transforms."""
        n = self.naming
        known = {**n.calibration, **self._known}
        plane, trouble = n.plane, ""
        image = transform_between(known, n.image, n.reference)
        if image is not None:
            try:
                plane = ImagingPlane.of_image(image, self.grid)
            except InputError as error:
                trouble = str(error)
        for frame in n.needles:
            tip = transform_between(known, frame, n.reference)
            if tip is not None:
                return Located(plane, plane.see(tip, n.axis), trouble)
        if self._known and not trouble:
            trouble = (
                f"no transform leads from {' or '.join(n.needles)} to {n.reference}; "
                f"there are {', '.join(sorted(known))}"
            )
        return Located(plane, None, trouble)
