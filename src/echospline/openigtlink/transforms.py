"""What a tracker says, put together: where the imaging plane lies and where the needle is in it."""

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
"""Transforms that are remembered; a tracker has a dozen."""


@dataclass(frozen=True)
class Naming:
    """Which frames mean what.

    Parameters
    ----------
    needles : tuple of str
        Frames at the needle's tip, the first that can be found counts (``NeedleTipToReference``).
    reference : str
        The frame that everything is told in.
    image : str
        The image's frame; also its device name.
    axis : (x, y, z)
        Direction of insertion in the needle's frame.
    plane : ImagingPlane
        Where the image lies until a transform from it arrives.
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
    """What is known now.

    Parameters
    ----------
    plane : ImagingPlane
        Where the image lies.
    needle : TrackedNeedle or None
        Where the needle is, if the transforms lead to it.
    trouble : str
        What is wrong, empty if nothing is.
    """

    plane: ImagingPlane
    needle: TrackedNeedle | None
    trouble: str = ""


class Tracking:
    """The newest transform of each name; `locate` puts them together.

    Parameters
    ----------
    grid : RegularGrid
        The image's pixels.
    naming : Naming
        Which frames mean what.
    """

    def __init__(self, grid: RegularGrid, naming: Naming) -> None:
        self.grid, self.naming = grid, naming
        self._known: dict[str, Floats] = {}
        for name, matrix in naming.calibration.items():
            frames_of(name)
            as_transform(matrix)

    def put(self, name: str, matrix: Floats) -> None:
        """Take a transform.

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
        """Where plane and needle are by the newest transforms."""
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
