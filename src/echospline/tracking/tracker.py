"""Speckle tracking: displacement of material points between two frames, and along a cine.

A `Tracker` measures one pair of frames; `track` accumulates pairs along material points. Displacement belongs to
the point where the tissue was at rest (frame 0), never to a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from echospline.errors import InputError
from echospline.scene import (
    Display,
    Echo,
    Floats,
    NeedlePose,
    RegularGrid,
    UltrasoundImage,
    as_points,
)
from echospline.tracking.carrier_phase import CarrierPhase
from echospline.tracking.dense_flow import DenseFlow, Grey
from echospline.tracking.signal import at_points, has_signal

Frame = UltrasoundImage | Echo
Reference = Literal["keyframe", "first", "previous"]


@dataclass(frozen=True)
class Motion:
    """Displacement of points between two frames, with its confidence.

    Parameters
    ----------
    displacement : ndarray, shape (n, 2)
        mm.
    confidence : ndarray, shape (n,)
        0 (do not use) to 1.
    """

    displacement: Floats
    confidence: Floats


class Frames(Protocol):
    """Frames with their times, which can be iterated more than once: `Cine`, `EchoCine`, or frames that are read meanwhile."""

    @property
    def times(self) -> Floats:
        """Seconds, one per frame."""
        ...

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[Frame]: ...


class Tracker(Protocol):
    """A method that measures the motion between two frames of one grid."""

    def motion(self, before: Frame, after: Frame, points: Floats) -> Motion:
        """Measure the motion of the tissue that is at ``points`` (n, 2) mm in ``before``."""
        ...


@dataclass(frozen=True)
class Track:
    """Displacement along a cine, against frame 0.

    Parameters
    ----------
    points : ndarray, shape (n, 2)
        Positions of material points in frame 0, mm.
    times : ndarray, shape (frames,)
        s.
    displacement : ndarray, shape (frames, n, 2)
        mm.
    confidence : ndarray, shape (frames, n)
        0 to 1; the lowest along the chain of pairs that led to the frame.
    keyframes : tuple of int
        Frames against which later ones were measured.
    """

    points: Floats
    times: Floats
    displacement: Floats
    confidence: Floats
    keyframes: tuple[int, ...] = (0,)


@dataclass(frozen=True)
class FlowTracker:
    """Dense flow, checked by its inverse and by correlation, refined by the carrier where the frames are echoes.

    Parameters
    ----------
    search : DenseFlow
        Measures the motion.
    check : DenseFlow or None
        Measures the reverse motion for the forward-backward test; None skips the test.
    phase : CarrierPhase or None
        Refines the axial part when the frames are `Echo`; None uses their envelope only.
    window : float
        Side of the window of the correlation test, mm.
    tolerance : float
        Forward-backward error that halves the confidence, mm.
    """

    search: DenseFlow = field(default_factory=DenseFlow)
    check: DenseFlow | None = field(default_factory=lambda: DenseFlow(refinements=5, finest=1))
    phase: CarrierPhase | None = field(default_factory=CarrierPhase)
    window: float = 2.0
    tolerance: float = 0.05

    def __post_init__(self) -> None:
        if not (self.window > 0 and self.tolerance > 0):
            raise InputError(
                f"window and tolerance are positive lengths in mm; got {self.window}, {self.tolerance}"
            )

    def motion(self, before: Frame, after: Frame, points: Floats) -> Motion:
        """Measure the motion of the tissue at ``points`` (n, 2) mm; points outside the picture have confidence 0."""
        before, after = levelled(before, after)
        a, b, grid = grey_pair(before, after)
        spacing = np.asarray(grid.spacing, dtype=np.float32)
        u = self.search.flow(a, b) * spacing
        confidence = np.clip(correlation(a, b, u / spacing, self.window / np.asarray(grid.spacing)), 0.0, 1.0)
        if self.check is not None:
            back = self.check.flow(b, a) * spacing
            there = _pull(back, u / spacing)
            error = np.hypot(*np.moveaxis(u + there, -1, 0))
            confidence = confidence / (1.0 + (error / self.tolerance) ** 2)
        alive = has_signal(a, grid) & (_pull(has_signal(b, grid).astype(np.float32), u / spacing) > 0.5)
        confidence = np.where(alive, confidence, np.float32(0.0))
        inside = before.grid.contains(points) & at_points(alive, grid, points)
        quality = np.where(inside, np.clip(sample(confidence, grid, points), 0.0, 1.0), 0.0)
        if self.phase is not None and isinstance(before, Echo) and isinstance(after, Echo):
            refined, _ = self.phase.refine(before, after, regrid(u, grid, before.grid))
            return Motion(sample(refined, before.grid, points), quality)
        return Motion(sample(u, grid, points), quality)


def track(
    cine: Frames | Sequence[Frame],
    points: Floats,
    tracker: Tracker,
    *,
    times: Floats | None = None,
    reference: Reference = "keyframe",
    step: float = 0.6,
    needle: Sequence[NeedlePose | None] | None = None,
    needle_radius: float = 1.0,
    threshold: float = 0.3,
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> Track:
    """Follow material points through a cine.

    Parameters
    ----------
    cine : Cine, EchoCine, Frames or sequence of frames
        Frame 0 is the reference. Frames are taken one after the other; three are held at a time.
    points : ndarray, shape (n, 2)
        Positions in frame 0, mm.
    tracker : Tracker
        Measures the pairs.
    times : ndarray, optional
        Seconds, when ``cine`` is a plain sequence.
    reference : {"keyframe", "first", "previous"}
        Measure against the last keyframe, which advances whenever the motion since it exceeds ``step`` (few
        links, so little drift, and little decorrelation per link); always against frame 0; or frame to frame.
    step : float
        Largest motion of a point per link, mm: longer links lose correlation, shorter ones add up more errors.
    needle : sequence of NeedlePose or None, optional
        One per frame: points within ``needle_radius`` mm of the shaft are not tissue and get confidence 0.
    threshold : float
        Points of lower confidence, and those that disagree with their neighbours, get their neighbours' motion
        (and a low confidence). Where a frame has no signal, the confidence is 0, in frame 0 as well.
    progress : callable
        Wraps the iteration over frames.

    Raises
    ------
    InputError
        If the arguments do not fit.
    """
    x = as_points(points)
    count = len(cine)
    own = getattr(cine, "times", None)
    if own is not None:
        times = np.asarray(own, dtype=np.float64)
    if times is None or len(times) != count:
        raise InputError(f"tracking {count} frames needs {count} times in s")
    if needle is not None and len(needle) != count:
        raise InputError(f"one needle pose per frame is needed: {count} frames, {len(needle)} poses")
    if reference not in ("keyframe", "first", "previous"):
        raise InputError(f"reference is keyframe, first or previous; got {reference!r}")
    if not step > 0:
        raise InputError(f"step must be a positive length in mm; got {step}")
    frames = iter(cine)
    key_frame = previous = _next(frames, 0, count)
    displacement, confidence = np.zeros((count, len(x), 2)), np.zeros((count, len(x)))
    grey, _, grid = grey_pair(*levelled(key_frame, key_frame))
    confidence[0] = at_points(has_signal(grey, grid), grid, x)
    neighbours = Neighbours.of(x)
    key, keys = 0, [0]

    def link(frame: Frame, k: int) -> Motion:
        p = x + displacement[key]
        found = tracker.motion(key_frame, frame, p)
        quality = found.confidence.copy()
        for pose in (needle[key], needle[k]) if needle is not None else ():
            if pose is not None and pose.depth > 0:
                for q in (p, p + found.displacement):
                    quality[pose.closest(q)[1] < needle_radius] = 0.0
        return neighbours.mended(Motion(found.displacement, quality), threshold)

    if needle is not None and needle[0] is not None and needle[0].depth > 0:
        confidence[0, needle[0].closest(x)[1] < needle_radius] = 0.0
    for k in progress(range(1, count)):
        frame = _next(frames, k, count)
        found = link(frame, k)
        trusted = found.confidence >= threshold
        peak = np.hypot(*found.displacement[trusted].T).max(initial=0.0)
        if reference == "keyframe" and peak > step and key < k - 1:
            key, key_frame = k - 1, previous
            keys.append(key)
            found = link(frame, k)
        displacement[k] = displacement[key] + found.displacement
        confidence[k] = np.minimum(confidence[key], found.confidence)
        previous = frame
        if reference == "previous":
            key, key_frame = k, frame
            keys.append(key)
    return Track(x, times, displacement, confidence, tuple(keys))


def _next(frames: Iterator[Frame], k: int, count: int) -> Frame:
    frame = next(frames, None)
    if frame is None:
        raise InputError(f"the cine ends after {k} of {count} frames")
    return frame


@dataclass(frozen=True)
class Neighbours:
    """The eight nearest neighbours of every point and their distances, for the test of outliers."""

    index: NDArray[np.intp]
    distance: Floats
    """Shapes (n, k)."""

    @classmethod
    def of(cls, points: Floats, k: int = 8) -> Neighbours:
        """Find the neighbours; fewer than ``k`` where there are fewer points."""
        k = min(k, len(points) - 1)
        if k < 3:
            return cls(np.empty((len(points), 0), dtype=np.intp), np.empty((len(points), 0)))
        distance, index = cKDTree(points).query(points, k=k + 1)
        return cls(np.asarray(index[:, 1:]), np.asarray(distance[:, 1:], dtype=np.float64))

    def mended(self, motion: Motion, threshold: float, floor: float = 0.01) -> Motion:
        """Give outliers and points below the threshold the mean motion of their trusted neighbours.

        The test is the normalised median of Westerweel and Scarano (2005), limit 3, with ``floor`` mm added to
        the spread. Where no neighbour is above the threshold, the measured value stays, with its low confidence.
        """
        if self.index.shape[1] == 0:
            return motion
        u, quality = motion.displacement, motion.confidence.copy()
        around = u[self.index]
        middle = np.median(around, axis=1)
        spread = np.median(np.abs(around - middle[:, None]), axis=1) + floor
        quality[(np.abs(u - middle) / spread > 3.0).any(axis=1)] = 0.0
        weight = (quality[self.index] >= threshold) / np.maximum(self.distance, 1e-9)
        total = weight.sum(axis=1)
        bad = (quality < threshold) & (total > 0)
        u = u.copy()
        u[bad] = (weight[bad, :, None] * around[bad]).sum(axis=1) / total[bad, None]
        return Motion(u, quality)


def levelled(before: Frame, after: Frame) -> tuple[Frame, Frame]:
    """Scale echoes by the root mean square of ``before``, whatever unit they are in; pictures stay as they are."""
    if not (isinstance(before, Echo) and isinstance(after, Echo)):
        return before, after
    level = float(np.sqrt(np.mean(np.abs(before.iq).astype(np.float64) ** 2)))
    if not level > 0:
        return before, after

    def scaled(echo: Echo) -> Echo:
        return Echo(
            (np.asarray(echo.iq, np.complex128) / level).astype(np.complex64), echo.grid, echo.carrier
        )

    first = scaled(before)
    return first, first if after is before else scaled(after)


def grey_pair(before: Frame, after: Frame) -> tuple[Grey, Grey, RegularGrid]:
    """Return both frames as 8-bit grey pictures of one grid."""
    if isinstance(before, Echo) and isinstance(after, Echo):
        grid = picture_grid(before)
        first, second = (_picture(frame, grid) for frame in (before, after))
        return first, second, grid
    if isinstance(before, Echo) or isinstance(after, Echo):
        raise InputError("both frames of a pair must be pictures or both echoes")
    if before.grid != after.grid:
        raise InputError(f"both frames of a pair must have one grid; got {before.grid} and {after.grid}")
    a, b = (np.asarray(f.pixels) for f in (before, after))
    if a.ndim == 3:
        a, b = (np.asarray(np.rint(f.mean(axis=2)), dtype=f.dtype) for f in (a, b))
    if a.dtype != np.uint8 or b.dtype != np.uint8:
        a, b = (f.astype(np.float64) for f in (a, b))
        low, high = min(a.min(), b.min()), max(a.max(), b.max())
        scale = 255.0 / (high - low) if high > low else 0.0
        a, b = (np.rint((f - low) * scale).astype(np.uint8) for f in (a, b))
    return np.ascontiguousarray(a), np.ascontiguousarray(b), before.grid


def picture_grid(echo: Echo) -> RegularGrid:
    """Build a grid of square pixels, three to a wavelength (2 / carrier), over the samples of an echo frame."""
    h = 2.0 / echo.carrier / 3.0
    x0, x1, y0, y1 = echo.grid.extent
    return RegularGrid((int((x1 - x0) / h + 1e-9) + 1, int((y1 - y0) / h + 1e-9) + 1), (h, h), (x0, y0))


def _picture(echo: Echo, grid: RegularGrid) -> Grey:
    envelope = echo.envelope().astype(np.float32)
    at = echo.grid.to_index(grid.nodes).astype(np.float32).reshape(*grid.shape[::-1], 2)
    onto = cv2.remap(
        envelope, np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1]), cv2.INTER_LINEAR
    )
    return Display().grey(onto)


def correlation(a: Grey, b: Grey, u: NDArray[np.float32], window: Floats) -> NDArray[np.float32]:
    """Compute the normalised cross-correlation of ``a`` with ``b`` taken back by ``u`` (pixels), in a box around every pixel."""
    x, y = a.astype(np.float32), _pull(b.astype(np.float32), u)
    size = tuple(int(max(3, round(float(w)))) for w in window)

    def mean(z: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.blur(z, size))

    mx, my = mean(x), mean(y)
    xy, xx, yy = mean(x * y) - mx * my, mean(x * x) - mx * mx, mean(y * y) - my * my
    power = np.sqrt(np.maximum(xx, 0) * np.maximum(yy, 0))
    # a flat patch (black, saturated) carries no motion: no correlation
    found = np.zeros_like(xy)
    np.divide(xy, power, out=found, where=power > 1e-3)
    return found


def _pull(picture: NDArray[np.float32], u: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sample ``picture`` at every pixel moved by ``u`` pixels."""
    rows, columns = u.shape[:2]
    x = np.arange(columns, dtype=np.float32)[None, :] + u[..., 0]
    y = np.arange(rows, dtype=np.float32)[:, None] + u[..., 1]
    return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def regrid(values: NDArray[np.float32], grid: RegularGrid, onto: RegularGrid) -> NDArray[np.float32]:
    """Interpolate values on one grid (bilinear) to all points of another, image-like."""
    at = grid.to_index(onto.nodes).astype(np.float32).reshape(*onto.shape[::-1], 2)
    x, y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def sample(values: NDArray[np.float32], grid: RegularGrid, points: Floats) -> Floats:
    """Sample values on a grid at points in mm (bicubic; the edge's value beyond it), shape (n,) or (n, 2)."""
    at = grid.to_index(points).astype(np.float32)
    found = np.empty((len(points), *values.shape[2:]), dtype=np.float64)
    # OpenCV's maps hold at most 32767 columns
    for start in range(0, len(points), 32000):
        part = at[None, start : start + 32000]
        found[start : start + 32000] = cv2.remap(
            values,
            np.ascontiguousarray(part[..., 0]),
            np.ascontiguousarray(part[..., 1]),
            cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )[0]
    return found
