"""How a needle looks in B-mode: shaft, tip, ring-down and shadow, drawn into a picture by the native core.

The echo follows what was measured on real needles (docs/theory.md, "The needle's picture"): one line from the near wall, bright
only near perpendicular to the beam and faint and grainy beyond; a tip that stays bright; both added as power before log
compression. It is a model of appearance: no sound is propagated.
"""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass, field, fields, replace
from math import log10
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from echospline import _native as core
from echospline.errors import InputError
from echospline.picture.native import NativePicture, blank
from echospline.scene import (
    ZERO_LENGTH,
    Floats,
    NeedlePose,
    Pixels,
    RegularGrid,
    UltrasoundImage,
    as_points,
    is_number,
)

OUTER_DIAMETER: dict[int, float] = {
    14: 2.108, 15: 1.829, 16: 1.651, 17: 1.473, 18: 1.270, 19: 1.067,
    20: 0.908, 21: 0.819, 22: 0.718, 23: 0.642, 24: 0.566, 25: 0.515,
}  # fmt: skip
"""Outer diameter in mm of hypodermic tubing by gauge (Birmingham gauge, the nominal sizes of ISO 9626)."""

DIRECT = (np.uint8, np.uint16, np.int16)
"""Types of pixels that the core draws into as they are; others are scaled so that white is 1."""


@functools.cache
def _defaults() -> core.Needle:
    """Return the core's needle; it is not changed."""
    needle = core.Needle(struct_size=ctypes.sizeof(core.Needle))
    core.library().echospline_needle_defaults(ctypes.byref(needle))
    return needle


def _of_core(name: str) -> Any:
    """Return a dataclass field whose default the core has."""
    return field(default_factory=lambda: getattr(_defaults(), name))


@dataclass(frozen=True)
class NeedleEcho:
    """The needle's looks; each part can be switched off.

    Levels are dB of power relative to white, sigmas are of amplitude. Defaults are the core's; they stand with their sources
    in docs/theory.md.

    Parameters
    ----------
    gauge : int
        14 to 25; sets the diameter.
    shaft, tip, tail, shadow : bool
        The parts: line of the near wall; tip and heel of the bevel; ring-down below a shaft across the beam; shadow.
    apex : (x, y), optional
        Where the beams of a curved array cross, mm, above the image; a linear array's beams run straight down.
    lateral, axial : float
        Resolution across and along the beam: sigma, 0.01 to 100 mm.
    elevation : float
        Thickness of the slice at its focus: sigma, 0.01 to 1000 mm.
    elevation_depth : float
        Depth of that focus, 0.1 to 10000 mm.
    element_height : float
        Height of the array across the plane, 0 to 1000 mm: the slice is thicker off its focus.
    f_number : float
        Depth over aperture, 0.1 to 100: sets the penumbra of the shadow.
    dynamic_range : float
        Of the display, 1 to 300 dB.
    specular : float
        Level of a shaft at right angles to the beam, before compounding, -300 to 60 dB.
    lobe, lobe_elevation : float
        Tilt at which that has fallen by 4.3 dB, in the plane and out of it, 0.1 to 90 degrees.
    steering : float
        Beams are compounded at 0 and plus and minus this, 0 (no compounding) to 60 degrees.
    roughness : float
        Level of the grain that is left at any tilt, -300 to 60 dB.
    rolloff : float
        Loss of the grain from 50 to 90 degrees of tilt, 0 to 100 dB.
    wobble : float
        Standard deviation of slow changes along the shaft, 0 to 20 dB.
    patches : float
        Standard deviation of the grain's level from patch to patch of 1.5 mm, 0 to 20 dB.
    bevel : float
        Level of the tip, -300 to 60 dB.
    ring_down : float
        First level of the tail relative to the specular echo, -300 to 0 dB.
    ring_down_loss : float
        Loss along the tail, 0.1 to 1000 dB/mm.
    opacity : float
        Share of a blocked ray that is lost, 0 to 1.
    seed : int
        Of the grain, which is fixed to the needle.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    gauge: int = 18
    shaft: bool = True
    tip: bool = True
    tail: bool = True
    shadow: bool = True
    apex: tuple[float, float] | None = None
    lateral: float = _of_core("lateral")
    axial: float = _of_core("axial")
    elevation: float = _of_core("elevation")
    elevation_depth: float = _of_core("elevation_depth")
    element_height: float = _of_core("element_height")
    f_number: float = _of_core("f_number")
    dynamic_range: float = _of_core("dynamic_range")
    specular: float = _of_core("specular")
    lobe: float = _of_core("lobe")
    lobe_elevation: float = _of_core("lobe_elevation")
    steering: float = _of_core("steering")
    roughness: float = _of_core("roughness")
    rolloff: float = _of_core("rolloff")
    wobble: float = _of_core("wobble")
    patches: float = _of_core("patches")
    bevel: float = _of_core("bevel")
    ring_down: float = _of_core("ring_down")
    ring_down_loss: float = _of_core("ring_down_loss")
    opacity: float = _of_core("opacity")
    seed: int = _of_core("seed")

    def __post_init__(self) -> None:
        if self.gauge not in OUTER_DIAMETER:
            raise InputError(
                f"gauge must be a whole number from {min(OUTER_DIAMETER)} to {max(OUTER_DIAMETER)}; got {self.gauge}"
            )
        if self.apex is not None:
            as_points(self.apex, "apex")
        for name in _NUMBERS:
            if not is_number(getattr(self, name)):
                raise InputError(f"{name} of a needle must be a finite number; got {getattr(self, name)!r}")
        if not (int(self.seed) == self.seed and 0 <= self.seed < 2**32):
            raise InputError(f"seed must be a whole number from 0 to {2**32 - 1}; got {self.seed}")
        needle_echo(np.empty((0, 2)), NeedlePose((0.0, 0.0), (0.0, 1.0)), self)  # the core checks the ranges

    @property
    def diameter(self) -> float:
        """Outer diameter, mm."""
        return OUTER_DIAMETER[self.gauge]

    def named(self) -> dict[str, int | float | list[float]]:
        """Return these looks as members of `echospline_needle` by their names, without a place: as every host gives them to the core."""
        needle = self.between((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        read = {name: getattr(needle, name) for name, *_ in core.Needle._fields_}
        return {
            name: list(value) if isinstance(value, ctypes.Array) else value
            for name, value in read.items()
            if name not in ("struct_size", "entry", "tip")
        }

    def fainter(self, share: float) -> NeedleEcho:
        """Return the looks of a needle whose echo has ``share`` of the amplitude, above 0 to 1."""
        loss = 20 * log10(share)
        return replace(
            self,
            specular=self.specular + loss,
            roughness=self.roughness + loss,
            bevel=self.bevel + loss,
            opacity=self.opacity * share,
        )

    def at(self, pose: NeedlePose) -> core.Needle:
        """Return the core's needle with these looks, in the plane of the picture."""
        return self.between((*pose.entry, 0.0), (*pose.tip, 0.0))

    def between(
        self,
        entry: tuple[float, float, float],
        tip: tuple[float, float, float],
        *,
        apex: tuple[float, float] | None = None,
    ) -> core.Needle:
        """Return the core's needle with these looks.

        Parameters
        ----------
        entry, tip : (x, y, z)
            In the frame of the picture: lateral, depth, distance from the plane, mm.
        apex : (x, y), optional
            Where the probe's beams cross, mm, if these looks do not say.
        """
        needle = core.Needle.from_buffer_copy(_defaults())
        for name in _NUMBERS:
            setattr(needle, name, getattr(self, name))
        needle.diameter = self.diameter
        parts = zip(core.NeedlePart, (self.shaft, self.tip, self.tail, self.shadow), strict=True)
        needle.parts = sum(part for part, drawn in parts if drawn)
        crossing = apex if self.apex is None else self.apex
        if crossing is not None:
            needle.curved, needle.apex[0], needle.apex[1] = 1, *crossing
        needle.entry[:], needle.tip[:] = entry, tip
        return needle


_NUMBERS = tuple(
    f.name for f in fields(NeedleEcho) if f.name not in ("gauge", "shaft", "tip", "tail", "shadow", "apex")
)
"""Looks that have the same name in the core."""


@functools.cache
def _one_pixel() -> NativePicture:
    """Return a picture for echoes at points."""
    return blank(RegularGrid((1, 1), (1.0, 1.0)), RegularGrid((2, 2), (1.0, 1.0)))


def needle_echo(points: ArrayLike, pose: NeedlePose, echo: NeedleEcho) -> tuple[Floats, Floats]:
    """Compute the needle's echo and what it lets through, at any points of the imaging plane.

    Parameters
    ----------
    points : array_like, shape (n, 2)
        mm.
    pose : NeedlePose
        The needle.
    echo : NeedleEcho
        Its looks.

    Returns
    -------
    power : ndarray, shape (n,)
        Of the echo relative to white; in dB, 0 is white and ``-echo.dynamic_range`` black.
    transmission : ndarray, shape (n,)
        Share of the tissue's power that passes the needle: 1 where nothing shades.
    """
    p = np.asarray(points, dtype=np.float64)
    if pose.depth < ZERO_LENGTH:
        return np.zeros(len(p)), np.ones(len(p))
    return _one_pixel().echo(echo.at(pose), p)


def white_of(pixels: Pixels) -> float:
    """Return the grey level of white: 255 for 8-bit pixels, else the largest value."""
    return 255.0 if pixels.dtype == np.uint8 else float(pixels.max(initial=0))


def draw_needle(
    image: UltrasoundImage, pose: NeedlePose, echo: NeedleEcho | None = None, white: float | None = None
) -> UltrasoundImage:
    """Draw the needle's echo and shadow into an image.

    Parameters
    ----------
    image : UltrasoundImage
        Usually the deformed one: the needle is where it is, whatever the tissue does. Not changed.
    pose : NeedlePose
        The needle.
    echo : NeedleEcho, optional
        Its looks; the defaults of `NeedleEcho`.
    white : float, optional
        Grey level at which the display is white; 255 for 8-bit pixels, else the image's largest value (give it for
        the frames of a cine, whose largest values differ).

    Returns
    -------
    UltrasoundImage
        New pixels of the same type on the same grid; those that the needle does not touch are the same.
    """
    pixels: Any = image.pixels
    grid = image.grid
    if white is None:
        white = white_of(pixels)
    if pose.depth < ZERO_LENGTH or pixels.size == 0 or white <= 0:
        return image
    colour = pixels if pixels.ndim == 2 else pixels[..., :3]
    direct = pixels.dtype.type in DIRECT
    source = colour if direct else (colour / white).astype(np.float32)
    span = [max(n - 1, 1) * d for n, d in zip(grid.shape, grid.spacing, strict=True)]
    still = NativePicture(  # undeformed, each pixel is the nearest one to itself
        source, grid, RegularGrid((2, 2), (span[0], span[1]), grid.origin),
        interpolation="nearest", border=0.0, inverse="exact", white=white if direct else 1.0,
    )  # fmt: skip
    drawn = still.draw((NeedleEcho() if echo is None else echo).at(pose))
    changed = drawn != source
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        changed &= pixels[..., 3:] > 0  # no needle where there is no tissue
    out = pixels.copy()
    part = drawn[changed] if direct else drawn[changed].astype(np.float64) * white
    if np.issubdtype(pixels.dtype, np.integer) and not direct:
        limits = np.iinfo(pixels.dtype)
        part = np.clip(np.rint(part), limits.min, limits.max)
    into = out if out.ndim == 2 else out[..., :3]
    into[changed] = part.astype(pixels.dtype)
    return UltrasoundImage(out, grid, image.source)
