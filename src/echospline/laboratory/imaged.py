"""Lesions and vessels put into a recorded picture or a volume, so that they look as if the scanner had seen them.

Inside a body the picture is scattered again: new speckle of the surrounding tissue's grain (`grain`), at the surrounding
level plus the body's contrast, with its wall; behind it the recorded speckle is brightened. Every other pixel stays as
it is. The change happens within one width of the speckle inside the outline, where the recorded and the new speckle are
mixed so that their variance stays the same: no seam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from echospline.errors import InputError
from echospline.laboratory.bodies import Body
from echospline.laboratory.grain import Grain, Mask, grain_of, local_mean
from echospline.scene import Display, Floats, UltrasoundImage, Volume

MARGIN = 5.0
"""mm of tissue around a body from which its level is taken."""
GRAIN_MARGIN = 12.0
"""mm of tissue around a body from which its speckle is measured: its form changes slowly with the place."""
MEASURED = 96
"""Samples a side at most, in space, from which speckle is measured."""
FADING = 25.0
"""mm over which an enhancement falls to 1/e: beams from other directions, which go round the body, fill in."""
WALL = 0.3
"""mm; standard deviation of a wall's thickness, or that of the speckle along the beam where it is larger."""
ALONG = 0.2
"""Share of a wall's level that is left where the beam runs along it."""
HAZE_LOSS = 6.0
"""dB/mm; reverberations behind the near wall of a vessel die away."""
OUTLIER = 3.0
"""Standard deviations of the local mean beyond which tissue belongs to a fascia or a shadow, not to the surroundings."""
BLACK = 10.0
"""Grey level at most of what has no echo: half of the picture's darkest hundredth where that is lower."""
MARK, MARKS = 70.0, 6
"""Grey levels above the surroundings and above a neighbour that burnt-in marks alone have, and how many such pairs are too many."""


def imaged(
    image: UltrasoundImage,
    bodies: Sequence[Body],
    *,
    display: Display | None = None,
    apex: tuple[float, float] | None = None,
    seed: int = 0,
) -> UltrasoundImage:
    """Return a picture that shows bodies: a pure function, the same for the same arguments.

    Parameters
    ----------
    image : UltrasoundImage
        8-bit, grey (or colours that are all grey).
    bodies : sequence of Body
        In the plane; later ones lie over earlier ones.
    display : Display, optional
        Its dynamic range turns dB into grey levels; 60 dB when not given.
    apex : (x, y), optional
        Where the beams of a curved array cross, mm; beams run straight down when not given.
    seed : int
        Of the speckle.

    Returns
    -------
    UltrasoundImage
        Pixels outside of the bodies and of what lies behind them are unchanged bit for bit.

    Raises
    ------
    InputError
        If a body cannot be imaged here: the picture has colours, another type, no speckle or burnt-in marks there, or the
        body lies outside.
    """
    if not bodies:
        return image
    pixels: NDArray[Any] = image.pixels
    if pixels.dtype != np.uint8:
        raise InputError(
            f"bodies are imaged into 8-bit pictures; got {pixels.dtype}: give a window (image.window)"
        )
    grey = pixels if pixels.ndim == 2 else pixels[..., 0]
    if pixels.ndim == 3 and (pixels[..., :3] != grey[..., None]).any():
        raise InputError("bodies are imaged into grey pictures; this one has colours: save its B-mode alone")
    lattice = _Lattice(grey.shape, image.grid.spacing, image.grid.origin)
    shown = _imaged(grey, lattice, bodies, display or Display(), apex, seed)
    if pixels.ndim == 3:
        shown = np.concatenate([np.repeat(shown[..., None], 3, axis=-1), pixels[..., 3:]], axis=-1)
    return replace(image, pixels=shown)


def imaged_volume(
    volume: Volume, bodies: Sequence[Body], *, display: Display | None = None, seed: int = 0
) -> Volume:
    """Return a volume that shows bodies; beams run along y.

    Parameters
    ----------
    volume : Volume
        8-bit, depth along y.
    bodies : sequence of Body
        In space; later ones lie over earlier ones.
    display : Display, optional
        As for `imaged`.
    seed : int
        Of the speckle.

    Raises
    ------
    InputError
        As `imaged` does.
    """
    if not bodies:
        return volume
    if volume.voxels.dtype != np.uint8:
        raise InputError(
            f"bodies are imaged into 8-bit volumes; got {volume.voxels.dtype}: give a window (space.window)"
        )
    voxels: NDArray[Any] = volume.voxels
    lattice = _Lattice(voxels.shape, volume.spacing, volume.origin)
    return replace(
        volume,
        voxels=_imaged(voxels, lattice, bodies, display or Display(), None, seed, volume.filled),
    )


@dataclass(frozen=True)
class _Lattice:
    """Places of an array's samples: axes (z,) y, x; spacing and origin in the order x, y (, z), mm."""

    shape: tuple[int, ...]
    spacing: tuple[float, ...]
    origin: tuple[float, ...]

    @property
    def depth_axis(self) -> int:
        """The array's axis along which depth grows."""
        return len(self.shape) - 2

    @property
    def steps(self) -> Floats:
        """Spacing in the order of the array's axes, mm."""
        return np.array(self.spacing[::-1])

    def part(self, low: Floats, high: Floats) -> tuple[slice, ...]:
        """Return the samples inside a box of corners (x, y (, z)), mm; empty where it lies outside."""
        first = np.floor((low - self.origin) / self.spacing).astype(int)
        last = np.ceil((high - self.origin) / self.spacing).astype(int) + 1
        size = np.array(self.shape[::-1])
        a, b = np.clip(first, 0, size), np.clip(last, 0, size)
        return tuple(slice(int(i), int(max(i, j))) for i, j in zip(a[::-1], b[::-1], strict=True))

    def points(self, part: tuple[slice, ...]) -> Floats:
        """Return the places of some samples, shape (..., D), mm."""
        axes = [
            o + h * np.arange(s.start, s.stop)
            for o, h, s in zip(self.origin, self.spacing, part[::-1], strict=True)
        ]
        mesh = np.meshgrid(*axes[::-1], indexing="ij")
        return np.stack(mesh[::-1], axis=-1)


def _imaged(
    values: NDArray[np.uint8],
    lattice: _Lattice,
    bodies: Sequence[Body],
    display: Display,
    apex: tuple[float, float] | None,
    seed: int,
    filled: Mask | None = None,
) -> NDArray[np.uint8]:
    grey = values.astype(np.float64)
    changed = np.zeros(values.shape, dtype=bool)
    per_db = 255.0 / display.dynamic_range
    black = min(BLACK, 0.5 * float(np.quantile(values, 0.01)))
    for index, body in enumerate(bodies):
        low, high = body.shape.bounds
        if len(low) != values.ndim:
            raise InputError(f"body {index + 1} has {len(low)} coordinates; this scene has {values.ndim}")
        part = lattice.part(low, high)
        if 0 in grey[part].shape or not (body.shape.distance(lattice.points(part)) < 0).any():
            raise InputError(f"body {index + 1} lies outside the picture: {body.shape}")
        try:
            _add(grey, changed, values, lattice, body, bodies, per_db, black, apex, (seed, index), filled)
        except InputError as error:
            raise InputError(
                f"body {index + 1} at {tuple(np.round((low + high) / 2, 2).tolist())} mm cannot be imaged here: {error}"
            ) from error
    shown = np.rint(np.clip(grey, 0.0, 255.0)).astype(np.uint8)  # as a display does beyond black and white
    return np.where(changed, shown, values)


def _add(
    grey: Floats,
    changed: Mask,
    values: NDArray[np.uint8],
    lattice: _Lattice,
    body: Body,
    bodies: Sequence[Body],
    per_db: float,
    black: float,
    apex: tuple[float, float] | None,
    seed: tuple[int, int],
    filled: Mask | None,
) -> None:
    """Put one body into ``grey`` and mark what it changes."""
    near = _around(body, lattice, MARGIN)
    points = lattice.points(near)
    distance = body.shape.distance(points)
    inside = distance < 0
    beam = _beam(points, apex)
    _refuse_marks(values[near], distance < 1.0)
    tissue = _tissue(grey, values, lattice, near, body, bodies, apex, filled)
    wide = _around(body, lattice, GRAIN_MARGIN)
    speckle = _grain(grey[wide], _tissue(grey, values, lattice, wide, body, bodies, apex, filled), seed[0])
    # what is recorded, brightened behind the body, and its local mean
    gain = per_db * _gain(body, lattice, apex)
    brighter = np.abs(gain) >= 0.5
    grey += gain
    changed |= brighter
    recorded = grey[near]
    normal = _gradient(distance, lattice.steps)
    width = _in_mm(speckle, normal, lattice.steps)
    width = np.clip(0.7 * width, 1.5 * lattice.steps.min(), 0.5 * body.shape.radius)
    w = np.clip(-distance / width, 0.0, 1.0)
    w = w * w * (3.0 - 2.0 * w)
    scale = np.maximum(2.0, 1.3 * np.diag(speckle.shape) ** -0.5 * 2.355)
    mean = local_mean(recorded, np.ones_like(inside), scale)
    surrounding = local_mean(grey[near] - gain[near], tissue, max(2.0, body.shape.radius) / lattice.steps)
    level = surrounding + per_db * _contrast(body, distance, width, normal, beam, lattice, near, apex)
    new = speckle.speckle(recorded.shape, np.random.default_rng(seed))
    # near black only noise is left: it does not go below the picture's own black
    floor = np.maximum(level, black)
    new = new * np.clip(floor / (3.0 * new.std()), 0.0, 1.0)
    mixed = (1.0 - w) * mean + w * floor + np.sqrt(1.0 - w) * (recorded - mean) + np.sqrt(w) * new
    grey[near] = np.where(inside, mixed, recorded)
    changed[near] |= inside


def _around(body: Body, lattice: _Lattice, margin: float) -> tuple[slice, ...]:
    """Return the part of the lattice within a margin around a body, at least its radius."""
    low, high = body.shape.bounds
    reach = max(margin, body.shape.radius)
    return lattice.part(low - reach, high + reach)


def _tissue(
    grey: Floats,
    values: NDArray[np.uint8],
    lattice: _Lattice,
    part: tuple[slice, ...],
    body: Body,
    bodies: Sequence[Body],
    apex: tuple[float, float] | None,
    filled: Mask | None,
) -> Mask:
    """Test which samples of a part are tissue like that around the body: unclipped, of no body, not behind it, of no fascia."""
    points = lattice.points(part)
    tissue = (values[part] > 0) & (values[part] < 255) & (_way(body, lattice, part, apex) == 0)
    for other in bodies:
        tissue &= other.shape.distance(points) > 0
    if filled is not None:
        tissue &= filled[part]
    return _even(grey[part], tissue, 1.0 / lattice.steps)


def _grain(grey: Floats, tissue: Mask, seed: int) -> Grain:
    """Measure the grain; in space in the part with most tissue, of `MEASURED` samples a side."""
    if grey.ndim == 2:
        return grain_of(grey, tissue, seed)
    part = []
    for axis, n in enumerate(grey.shape):
        profile = tissue.sum(axis=tuple(a for a in range(grey.ndim) if a != axis)).astype(np.float64)
        size = min(n, MEASURED)
        sums = np.convolve(profile, np.ones(size), "valid")
        start = int(sums.argmax())
        part.append(slice(start, start + size))
    return grain_of(grey[tuple(part)], tissue[tuple(part)], seed)


def _even(grey: Floats, tissue: Mask, sigma: Floats) -> Mask:
    """Leave out tissue whose mean over a millimetre lies far from the surroundings': fasciae, shadows, vessels."""
    if not tissue.any():
        return tissue
    mean = local_mean(grey, tissue, sigma)
    middle = float(np.median(mean[tissue]))
    spread = 1.4826 * float(np.median(np.abs(mean[tissue] - middle)))
    return tissue & (np.abs(mean - middle) <= OUTLIER * max(spread, 1.0))


def _refuse_marks(values: NDArray[np.uint8], where: Mask) -> None:
    """Refuse text and rulers: bright pixels beside much darker ones along a row.

    Speckle has jumps too, but towards the dark: its nulls are sharp, its peaks never.

    Raises
    ------
    InputError
        If there are several.
    """
    signed = values.astype(np.int16)
    jump = np.abs(np.diff(signed, axis=-1))
    bright = np.maximum(signed[..., 1:], signed[..., :-1]) > np.median(signed) + MARK
    marks = bright & (jump > MARK) & where[..., 1:]
    if int(marks.sum()) >= MARKS:
        raise InputError(
            "the picture has sharp marks there that are no speckle (text, a ruler?); choose another place"
        )


def _beam(points: Floats, apex: tuple[float, float] | None) -> Floats:
    """Return the beam's direction at points, shape (..., D)."""
    if apex is None:
        down = np.zeros(points.shape[-1])
        down[1] = 1.0
        return np.broadcast_to(down, points.shape)
    along = points - np.asarray(apex)
    unit: Floats = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    return unit


def _gradient(distance: Floats, steps: Floats) -> Floats:
    """Return the unit outward normal, components in the order of the array's axes, shape (..., D)."""
    slopes = [np.gradient(distance, step, axis=axis) for axis, step in enumerate(steps)]
    normal = np.stack(slopes, axis=-1)
    unit: Floats = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    return unit


def _in_mm(speckle: Grain, normal: Floats, steps: Floats) -> Floats:
    """Return the speckle's width along unit normals, mm."""
    pixels = normal / steps
    pixels = pixels / np.maximum(np.linalg.norm(pixels, axis=-1, keepdims=True), 1e-9)
    width: Floats = speckle.width(pixels) * np.linalg.norm(pixels * steps, axis=-1)
    return width


def _contrast(
    body: Body,
    distance: Floats,
    width: Floats,
    normal: Floats,
    beam: Floats,
    lattice: _Lattice,
    near: tuple[slice, ...],
    apex: tuple[float, float] | None,
) -> Floats:
    """Return the level inside a body against the surrounding tissue, dB: its own, the haze's, the wall's."""
    level = np.full(distance.shape, body.contrast)
    if body.haze is not None:
        way = _way(body, lattice, near, apex)
        level = 10.0 * np.log10(10.0 ** (level / 10.0) + 10.0 ** ((body.haze - HAZE_LOSS * way) / 10.0))
    if body.wall is not None:
        square = np.abs((normal[..., ::-1] * beam).sum(axis=-1))
        shown = ALONG + (1.0 - ALONG) * square**4
        thick = np.maximum(WALL, 0.4 * width)
        line = np.exp(-0.5 * (np.minimum(distance + thick, 0.0) / thick) ** 2)  # up to the outline itself
        level = level + (body.wall - level) * shown * line
    return level


def _way(body: Body, lattice: _Lattice, near: tuple[slice, ...], apex: tuple[float, float] | None) -> Floats:
    """Return how far the beam has come inside the body, mm."""
    return _summed(body, lattice, near, apex, np.inf, soft=False)


def _gain(body: Body, lattice: _Lattice, apex: tuple[float, float] | None) -> Floats:
    """Return what the body adds to the level behind it, dB, on the whole lattice."""
    gain = np.zeros(lattice.shape)
    if body.enhancement == 0.0:
        return gain
    part = _shadowed(body, lattice, apex)
    gain[part] = body.enhancement * _summed(body, lattice, part, apex, FADING, soft=True)
    return gain


def _shadowed(body: Body, lattice: _Lattice, apex: tuple[float, float] | None) -> tuple[slice, ...]:
    """Return the part of the lattice that can lie behind the body."""
    if apex is not None:
        return tuple(slice(0, n) for n in lattice.shape)
    low, high = body.shape.bounds
    high = high.copy()
    high[1] = lattice.origin[1] + lattice.spacing[1] * lattice.shape[lattice.depth_axis]
    return lattice.part(low, high)


def _summed(
    body: Body,
    lattice: _Lattice,
    part: tuple[slice, ...],
    apex: tuple[float, float] | None,
    fading: float,
    *,
    soft: bool,
) -> Floats:
    """Sum along the beams the length inside a body, which fades as exp(-way / fading), mm.

    ``soft`` counts the outer half of the radius in part: a beam has a width, and one that meets the edge sees half tissue.
    """

    def density(points: Floats) -> Floats:
        distance = body.shape.distance(points)
        if soft:
            return np.clip(-distance / (0.5 * body.shape.radius), 0.0, 1.0)
        return (distance < 0).astype(np.float64)

    if apex is None:
        axis, step = lattice.depth_axis, lattice.spacing[1]
        return _leaking(density(lattice.points(part)), step, fading, axis)
    points = lattice.points(part)
    away = points - np.asarray(apex)
    reach, angle = np.hypot(away[..., 0], away[..., 1]), np.arctan2(away[..., 0], away[..., 1])
    step = min(lattice.spacing)
    radii = np.arange(reach.min(), reach.max() + step, step)
    angles = np.arange(angle.min(), angle.max() + step / reach.max(), step / reach.max())
    polar = np.stack(
        [apex[0] + radii[:, None] * np.sin(angles), apex[1] + radii[:, None] * np.cos(angles)], axis=-1
    )
    summed = _leaking(density(polar), step, fading, 0)
    index = np.stack([(reach - radii[0]) / step, (angle - angles[0]) / (step / reach.max())])
    return np.asarray(ndimage.map_coordinates(summed, index, order=1, mode="nearest"))


def _leaking(density: Floats, step: float, fading: float, axis: int) -> Floats:
    """Integrate dg/ds = density - g / fading along an axis."""
    keep = float(np.exp(-step / fading))
    return np.asarray(signal.lfilter([step], [1.0, -keep], density, axis=axis), dtype=np.float64)
