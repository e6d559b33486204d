"""How a needle in the imaging plane looks: shaft, tip, reverberation and shadow, drawn into the deformed image.

The picture is a model of appearance, not of acoustics: it has the traits by which a needle is known in
B-mode. A smooth metal shaft mirrors sound, so its echo fades as it turns towards the beam; the bevelled tip
scatters and stays visible; sound that runs to and fro in the tube gives equally spaced fainter copies
further down the beam; and little sound passes, so what lies behind is darker.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import acos, degrees, exp, hypot, isfinite, sin
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from echospline.errors import InputError
from echospline.scene import ZERO_LENGTH, Floats, NeedlePose, UltrasoundImage, as_points

OUTER_DIAMETER = {
    14: 2.108, 15: 1.829, 16: 1.651, 17: 1.473, 18: 1.270, 19: 1.067,
    20: 0.908, 21: 0.819, 22: 0.718, 23: 0.642, 24: 0.566, 25: 0.515,
}  # fmt: skip
"""Outer diameter in mm of hypodermic tubing by gauge (Birmingham gauge, the nominal sizes of ISO 9626)."""

COPIES = 5
COPY_LOSS = 0.65
"""Reverberations drawn, and how much each is fainter than the one before."""
NOTHING = 40.0
"""Exponent beyond which exp(-x) is below 1e-17 and is not computed."""
FAR_WALL = 0.6
"""Echo of the tube's far wall relative to its near wall."""


@dataclass(frozen=True)
class NeedleEcho:
    """What the needle looks like; each trait can be switched off.

    Parameters
    ----------
    gauge : int
        14 to 25; sets the diameter.
    brightness : float
        Strongest echo as a share of white, 0 to 1.
    resolution : float
        Half width of a thin line's echo in mm (to 1/e), positive.
    fade_angle : float
        Tilt from perpendicular to the beam, in degrees, at which the mirror echo has fallen to 1/e.
    floor : float
        Echo that is left at any angle, as a share of the strongest, 0 to 1.
    opacity : float
        Share of the brightness that the shadow takes behind a shaft perpendicular to the beam, 0 to 1.
    refill : float
        Way behind the shaft over which the shadow fades to 1/e, mm: the needle is thinner than the beam,
        which closes again behind it.
    apex : (x, y), optional
        Where the beams of a curved array meet, mm, above the image; a linear array's beams run straight down.
    shaft, tip, reverberation, shadow : bool
        The traits.

    Raises
    ------
    InputError
        If a number is out of its range.
    """

    gauge: int = 18
    brightness: float = 0.9
    resolution: float = 0.3
    fade_angle: float = 40.0
    floor: float = 0.3
    opacity: float = 0.45
    refill: float = 25.0
    apex: tuple[float, float] | None = None
    shaft: bool = True
    tip: bool = True
    reverberation: bool = True
    shadow: bool = True

    def __post_init__(self) -> None:
        if self.gauge not in OUTER_DIAMETER:
            raise InputError(
                f"gauge must be a whole number from {min(OUTER_DIAMETER)} to {max(OUTER_DIAMETER)}; got {self.gauge}"
            )
        for name in ("brightness", "floor", "opacity"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise InputError(f"{name} must be between 0 and 1; got {value}")
        for name, unit in (("resolution", "mm"), ("fade_angle", "degrees"), ("refill", "mm")):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise InputError(f"{name} must be a positive number in {unit}; got {value}")
        if self.apex is not None:
            as_points(self.apex, "apex")

    @property
    def diameter(self) -> float:
        """Outer diameter, mm."""
        return OUTER_DIAMETER[self.gauge]


def needle_echo(points: ArrayLike, pose: NeedlePose, echo: NeedleEcho) -> tuple[Floats, Floats]:
    """Echo of the needle and what it lets through, at any points of the imaging plane.

    The viewer's fragment shader evaluates the same formulas (`viewer/static/shaders.js`).

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
    brightness : ndarray, shape (n,)
        0 (none) to 1 (white).
    transmission : ndarray, shape (n,)
        1 where nothing shades, less behind the shaft.
    """
    p = np.ascontiguousarray(points, dtype=np.float64)
    brightness, transmission = np.zeros(len(p)), np.ones(len(p))
    if pose.depth < ZERO_LENGTH:
        return brightness, transmission
    _echo(p, pose.entry, pose.axis, pose.depth, _looks(echo), brightness, transmission)
    return brightness, transmission


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
        Grey level of the strongest echo; 255 for 8-bit pixels, else the image's largest value (give it for
        the frames of a cine, whose largest values differ).

    Returns
    -------
    UltrasoundImage
        New pixels of the same type on the same grid.
    """
    looks = NeedleEcho() if echo is None else echo
    pixels = image.pixels
    if white is None:
        white = 255.0 if pixels.dtype == np.uint8 else float(pixels.max())
    rows, columns = _touched(image, pose, looks)
    part = pixels[rows, columns].astype(np.float64)
    x, y = image.grid.x[columns], image.grid.y[rows]
    if part.size == 0 or white <= 0:
        return image
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    shape = (len(y), len(x)) + (1,) * (pixels.ndim - 2)
    light, passed = (v.reshape(shape) for v in needle_echo(points, pose, looks))
    part *= passed
    part += light * np.maximum(white - part, 0.0)
    out = pixels.copy()
    if np.issubdtype(pixels.dtype, np.integer):
        part = np.rint(part)
    out[rows, columns] = part.astype(pixels.dtype)
    return UltrasoundImage(out, image.grid, image.source)


def _looks(echo: NeedleEcho) -> tuple[float, ...]:
    """Return the numbers that the compiled loop takes."""
    apex = (0.0, 0.0) if echo.apex is None else echo.apex
    traits = (echo.shaft, echo.tip, echo.reverberation, echo.shadow, echo.apex is not None)
    return (
        *(float(t) for t in traits),
        *(float(c) for c in apex),
        echo.diameter,
        float(echo.resolution),
        float(echo.brightness),
        float(echo.fade_angle),
        float(echo.floor),
        float(echo.opacity),
        float(echo.refill),
    )


@njit(cache=True, nogil=True)
def _ends(s: Any, length: Any, width: Any) -> Any:
    """Fall off beyond entry and tip."""
    beyond = max(-s, s - length, 0.0)
    return exp(-((beyond / width) ** 2))


@njit(cache=True, nogil=True)
def _step(x: Any) -> Any:
    """Smooth rise from 0 at x = -1 to 1 at x = 1."""
    t = min(max(0.5 * (x + 1.0), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@njit(cache=True, nogil=True)
def _light(s: Any, d: Any, facing: Any, drop: Any, length: Any, looks: Any) -> Any:
    """Echo at (s along, d across) mm: the tube's two walls, their copies further down the beam, the tip."""
    shaft, tip, reverberation = looks[0], looks[1], looks[2]
    radius, width, fade, floor = looks[7] / 2, looks[8], looks[10], looks[11]
    tilt = degrees(acos(min(facing, 1.0)))
    mirror = exp(-((tilt / fade) ** 2))
    strength = floor + (1 - floor) * mirror
    light = 0.0
    if shaft and abs(d) - radius < 6.5 * (width + radius):
        u = length - s  # uneven brightness, fixed to the needle
        grain = 0.88 + 0.12 * sin(2.1 * u) * sin(0.73 * u + 1.0)
        walls = exp(-(((d + radius) / width) ** 2)) + FAR_WALL * exp(-(((d - radius) / width) ** 2))
        between = 0.45 * exp(-((d / (radius + width)) ** 2))
        light += strength * grain * min(walls + between, 1.0) * _ends(s, length, width)
    if reverberation:
        spacing = max(2 * radius, 3 * width)
        for k in range(1, COPIES + 1):
            shift = (k + 1) * spacing  # the far wall is the first of the series
            off = (d + radius - shift * facing) / width
            if off * off > NOTHING:  # a point lies near one copy or none: most of the work is not to be done
                continue
            copy = exp(-(off * off)) * _ends(s - shift * drop, length, width)
            light += 0.8 * COPY_LOSS**k * strength * mirror * copy
    if tip:
        r2 = (s - length) ** 2 + d * d
        light = max(light, (0.85 + 0.15 * mirror) * exp(-r2 / (width + 0.7 * radius) ** 2))
    return light


@njit(cache=True, nogil=True)
def _echo(
    points: Any, entry: Any, axis: Any, length: Any, looks: Any, brightness: Any, transmission: Any
) -> None:
    """Fill brightness and transmission point by point."""
    reverberation, shadow, curved = looks[2], looks[3], looks[4]
    diameter, width, refill = looks[7], looks[8], looks[13]
    arrival = min(1.0, length / diameter)  # the echo grows with the first millimetre: the picture never jumps
    reach = 3 * (width + diameter / 2)
    deepest = reach + ((COPIES + 1) * max(diameter, 3 * width) if reverberation else 0.0)
    beam_x, beam_y = 0.0, 1.0
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        if curved:
            beam_x, beam_y = x - looks[5], y - looks[6]
            size = max(hypot(beam_x, beam_y), ZERO_LENGTH)
            beam_x, beam_y = beam_x / size, beam_y / size
        across = beam_y * axis[0] - beam_x * axis[1]
        side = -1.0 if across < 0 else 1.0  # distances across the shaft count away from the probe
        facing = side * across  # sine of the angle between shaft and beam
        drop = beam_x * axis[0] + beam_y * axis[1]
        s = (x - entry[0]) * axis[0] + (y - entry[1]) * axis[1]
        d = side * ((y - entry[1]) * axis[0] - (x - entry[0]) * axis[1])
        if -reach < d < deepest and -deepest < s < length + deepest:
            brightness[i] = arrival * looks[9] * min(_light(s, d, facing, drop, length, looks), 1.0)
        if shadow and d > 0:
            behind = d / max(facing, 1e-6)  # way back along the beam to the shaft
            met = s - behind * drop
            edge = width + 0.04 * behind  # the shadow's ends blur with distance
            inside = _step(met / edge) * _step((length - met) / edge)
            if inside > 0:
                onset = min(d / diameter, 1.0) * exp(-behind / refill)
                transmission[i] = 1.0 - arrival * looks[12] * facing * onset * inside


def _touched(image: UltrasoundImage, pose: NeedlePose, echo: NeedleEcho) -> tuple[slice, slice]:
    """Rows and columns outside which the needle changes nothing (the shadow runs on downwards)."""
    everything = slice(0, image.grid.shape[1]), slice(0, image.grid.shape[0])
    if echo.apex is not None:
        return everything
    (nx, ny), (dx, dy), (x0, y0) = image.grid.shape, image.grid.spacing, image.grid.origin
    reach = echo.diameter + 6 * echo.resolution + 0.04 * image.grid.extent[3]
    left = int(np.clip((min(pose.entry[0], pose.tip[0]) - reach - x0) // dx, 0, nx))
    right = int(np.clip((max(pose.entry[0], pose.tip[0]) + reach - x0) // dx + 2, 0, nx))
    top = int(np.clip((min(pose.entry[1], pose.tip[1]) - reach - y0) // dy, 0, ny))
    return slice(top, ny), slice(left, right)
