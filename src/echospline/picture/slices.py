"""Pictures of a volume: where the pixels of a plane lie in undeformed tissue, and the slice drawn from there.

X + u(X) = p is solved on a lattice of the picture's pixels: once by a fixed point everywhere, then by Newton's method where that is not
good enough, which is near the needle. The native core interpolates between the lattice and samples the volume across the beam's thickness.
"""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from time import perf_counter
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from echospline import _native as core
from echospline._native import space
from echospline.errors import InputError
from echospline.picture.native import NativePicture
from echospline.picture.needle_echo import NeedleEcho
from echospline.scene import (
    ZERO_LENGTH,
    Floats,
    ImagingPlane,
    Pixels,
    Probe,
    RegularGrid,
    SpatialPose,
    UltrasoundImage,
    Volume,
)

Field = Callable[[Floats], Floats]
"""Displacement (n, 3) mm of reference points (n, 3) mm."""

SliceFormer = Callable[[ImagingPlane, Probe, Field | None, int], UltrasoundImage]
"""Forms the picture of a plane on a probe's grid from the tissue's displacement (none: at rest); the number is the frame's, for its noise."""


@runtime_checkable
class CoreField(Protocol):
    """A displacement that the core can sum itself: planes are then traced back there."""

    def __call__(self, points: Floats, /) -> Floats:
        """Displacement (n, 3) mm of reference points (n, 3) mm."""
        ...

    def in_core(self) -> tuple[space.ForceField, list[Floats]]:
        """Return the field as the core takes it, and the arrays that it points to."""
        ...


STEP = 8
"""Pixels between neighbours of the lattice."""
CLOSE = 0.05
"""Pixels within which a place has to be found."""
NEAR = 4.0
"""mm around the tip within which folds are looked for: beyond, no needle folds tissue."""
HARD = 30
"""Steps of Newton's method at most."""


@dataclass(frozen=True)
class SpatialFolds:
    """Where tissue is turned inside out.

    Parameters
    ----------
    points : int
        Places of the lattice at which the Jacobian determinant is not positive, or to which no tissue leads.
    worst : float
        Smallest determinant.
    place : (x, y, z)
        Where that is, in the undeformed tissue, mm.
    """

    points: int
    worst: float
    place: tuple[float, float, float]

    def __str__(self) -> str:
        x, y, z = self.place
        return f"tissue folds at {self.points} places (Jacobian {self.worst:.2f} at x = {x:.1f}, y = {y:.1f}, z = {z:.1f} mm)"


@dataclass(frozen=True)
class SliceDrawn:
    """A picture of a plane.

    Parameters
    ----------
    image : UltrasoundImage
        On the probe's grid.
    lattice : ndarray, shape (rows, columns, 3)
        Where the lattice's pixels lie in undeformed tissue, mm.
    residual : float
        Largest distance of a checked pixel, midway between the lattice's, from the forward map of its origin, pixels.
    folds : SpatialFolds or None
        Where tissue folds.
    outside : float
        Share of the probe's picture that lies outside the volume.
    milliseconds : dict
        Time per stage: inverse, slice, needle.
    """

    image: UltrasoundImage
    lattice: Floats
    residual: float
    folds: SpatialFolds | None
    outside: float
    milliseconds: dict[str, float]


class NativeVolume:
    """Voxels in the core, packed for slicing.

    Parameters
    ----------
    volume : Volume
        uint8 voxels.

    Raises
    ------
    InputError
        If voxels have another type, or the core refuses the volume.
    """

    def __init__(self, volume: Volume) -> None:
        if volume.voxels.dtype != np.uint8:
            raise InputError(
                f"a volume is sliced from 8-bit voxels; got {volume.voxels.dtype}: choose a window (Volume.windowed)"
            )
        self._core = space.library()
        o = space.VolumeOptions(struct_size=ctypes.sizeof(space.VolumeOptions))
        for k in range(3):
            o.shape[k], o.spacing[k], o.origin[k] = volume.shape[k], volume.spacing[k], volume.origin[k]
        voxels = np.ascontiguousarray(volume.voxels)
        self._volume = ctypes.c_void_p()
        status = self._core.echospline_volume_create(
            ctypes.byref(o), voxels.ctypes.data, ctypes.byref(self._volume)
        )
        weakref.finalize(self, self._core.echospline_volume_destroy, self._volume)
        core.check(status, self._core.echospline_volume_message, self._volume)

    def slice(
        self,
        lattice: Floats,
        shape: tuple[int, int],
        step: int,
        normal: Floats,
        spread: Floats | None = None,
        mask: NDArray[np.bool_] | None = None,
        background: int = 0,
    ) -> tuple[Pixels, int]:
        """Draw a slice.

        Parameters
        ----------
        lattice : ndarray, shape (m, k, 3)
            Where every ``step``-th pixel lies in the volume, mm; it reaches the last row and column or beyond.
        shape : (columns, rows)
            Of the picture.
        step : int
            Pixels between the lattice's neighbours.
        normal : ndarray, shape (3,)
            Unit vector across the slice.
        spread : ndarray, shape (rows,), optional
            Sigma of the slice's thickness, mm.
        mask : ndarray of bool, shape (rows, columns), optional
            Pixels that are shown.
        background : int
            Grey level elsewhere, and outside the volume.

        Returns
        -------
        pixels : ndarray of uint8, shape (rows, columns)
        outside : int
            Shown pixels outside the volume.
        """
        s = space.Slice(struct_size=ctypes.sizeof(space.Slice), columns=shape[0], rows=shape[1], step=step)
        s.background = background
        s.normal[:] = [float(v) for v in normal]
        places = np.ascontiguousarray(lattice, dtype=np.float64)
        sigma = None if spread is None else np.ascontiguousarray(spread, dtype=np.float32)
        shown = None if mask is None else np.ascontiguousarray(mask, dtype=np.uint8)
        s.spread = None if sigma is None else sigma.ctypes.data
        s.mask = None if shown is None else shown.ctypes.data
        out = np.empty(shape[::-1], np.uint8)
        outside = ctypes.c_int64()
        status = self._core.echospline_volume_slice(
            self._volume, ctypes.byref(s), places.ctypes.data, places.size, out.ctypes.data, out.size,
            ctypes.byref(outside),
        )  # fmt: skip
        core.check(status, self._core.echospline_volume_message, self._volume)
        return out, outside.value

    def trace(
        self,
        places: Floats,
        shape: tuple[int, int],
        step: int,
        field: CoreField,
        tip: Floats | None,
        close: float,
    ) -> tuple[Floats, float, SpatialFolds | None]:
        """Find where a slice's lattice comes from, in the core.

        Parameters
        ----------
        places : ndarray, shape (m * k, 3)
            Of the lattice's pixels in the deformed tissue, mm; see `slice` for the lattice, ``shape`` and ``step``.
        field : CoreField
            Displacement of the tissue.
        tip : ndarray, shape (3,), optional
            Of the needle, mm: around it folds are looked for.
        close : float
            Distance within which a place has to be reached, mm.

        Returns
        -------
        origins : ndarray, shape (m * k, 3)
            In undeformed tissue, mm.
        residual : float
            Largest distance midway between the places from the forward map of the origin there, mm.
        folds : SpatialFolds or None
        """
        s = space.Slice(struct_size=ctypes.sizeof(space.Slice), columns=shape[0], rows=shape[1], step=step)
        p = np.ascontiguousarray(places, dtype=np.float64)
        given, _kept = field.in_core()
        X = np.empty_like(p)
        report = space.TraceReport(struct_size=ctypes.sizeof(space.TraceReport))
        at = None if tip is None else np.ascontiguousarray(tip, dtype=np.float64)
        status = self._core.echospline_volume_trace(
            self._volume, ctypes.byref(s), ctypes.byref(given), p.ctypes.data, p.size,
            None if at is None else at.ctypes.data, close, X.ctypes.data, ctypes.byref(report),
        )  # fmt: skip
        core.check(status, self._core.echospline_volume_message, self._volume)
        folds = None
        if report.folded:
            x, y, z = report.place
            folds = SpatialFolds(report.folded, report.jacobian, (x, y, z))
        return X, report.residual, folds


def origins(places: Floats, field: Field, close: float) -> tuple[Floats, Floats, Floats]:
    """Find where deformed places come from: X with X + u(X) = p.

    Parameters
    ----------
    places : ndarray, shape (n, 3)
        p, mm.
    field : callable
        u, mm.
    close : float
        Distance within which a place has to be reached, mm.

    Returns
    -------
    origins : ndarray, shape (n, 3)
        X, mm.
    missed : ndarray, shape (n,)
        Distance of X + u(X) from p, mm.
    jacobian : ndarray, shape (n,)
        Determinant of I + grad u where Newton's method needed it, else 1.
    """
    X = places - field(places)
    miss = X + field(X) - places
    X -= miss  # a second step of the fixed point, without a third look where the first miss was small
    distance = np.linalg.norm(miss, axis=1)
    jacobian = np.ones(len(X))
    active = np.flatnonzero(distance > close)
    if len(active):
        miss[active] = X[active] + field(X[active]) - places[active]
        distance[active] = np.linalg.norm(miss[active], axis=1)
    for _ in range(HARD):
        active = np.flatnonzero(distance > close)
        if not len(active):
            break
        J = gradients(X[active], field) + np.eye(3)
        jacobian[active] = np.linalg.det(J)
        good = np.abs(jacobian[active]) > 1e-6
        step = -miss[active]
        step[good] = -np.linalg.solve(J[good], miss[active][good][:, :, None])[:, :, 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(
            1.0, 0.5 / np.maximum(length, 1e-12)
        )  # half a millimetre at most: folds throw Newton far
        X[active] += step
        miss[active] = X[active] + field(X[active]) - places[active]
        distance[active] = np.linalg.norm(miss[active], axis=1)
    return X, distance, jacobian


def gradients(points: Floats, field: Field, h: float = 1e-2) -> Floats:
    """Displacement gradient du_i / dx_j at points (n, 3), shape (n, 3, 3), by central differences over 2 h mm."""
    n = len(points)
    around = np.concatenate([points + sign * h * unit for unit in np.eye(3) for sign in (1.0, -1.0)])
    u = field(around).reshape(3, 2, n, 3)
    gradient: Floats = ((u[:, 0] - u[:, 1]) / (2 * h)).transpose(1, 2, 0)
    return gradient


def lattice_of(probe: Probe) -> RegularGrid:
    """Return the lattice of a probe's pixels on which origins are found: every `STEP`-th, to the last one or beyond."""
    columns, rows = probe.grid.shape
    dx, dy = probe.grid.spacing
    shape = (ceil((columns - 1) / STEP) + 1, ceil((rows - 1) / STEP) + 1)
    return RegularGrid(shape, (STEP * dx, STEP * dy), probe.grid.origin)


class SliceDrawing:
    """Draws pictures of a probe in a volume.

    Parameters
    ----------
    volume : Volume
        Undeformed tissue, 8-bit voxels, in the scene's frame: y = 0 is the surface.
    probe : Probe
        Shape of the picture and thickness of the slice.
    form_image : callable, optional
        Forms pictures in place of slicing the volume (`SliceFormer`).
    """

    def __init__(self, volume: Volume, probe: Probe, form_image: SliceFormer | None = None) -> None:
        self.volume, self.probe, self._former = volume, probe, form_image
        self._voxels = NativeVolume(volume)
        grid = probe.grid
        columns, rows = grid.shape
        self._lattice = lattice_of(probe)
        self._hides = not bool(probe.mask.all())
        self._spread = probe.thickness(grid.y) if probe.elevation > 0 else None
        span = ((columns - 1) * grid.spacing[0], (rows - 1) * grid.spacing[1])
        blank: Pixels = np.zeros((rows, columns), np.uint8)
        self._picture = NativePicture(
            blank, grid, RegularGrid((2, 2), span, grid.origin),
            interpolation="nearest", border=0.0, inverse="auto", white=0.0,
        )  # fmt: skip

    def draw(
        self,
        plane: ImagingPlane,
        field: Field | CoreField | None = None,
        pose: SpatialPose | None = None,
        needle: NeedleEcho | None = None,
        index: int = 0,
    ) -> SliceDrawn:
        """Draw the picture of a plane.

        Parameters
        ----------
        plane : ImagingPlane
            Where the probe is: its matrix takes the picture's frame to the scene's.
        field : callable, optional
            Displacement of the tissue; none: at rest.
        pose : SpatialPose, optional
            The needle.
        needle : NeedleEcho, optional
            Its looks; not drawn when not given.
        index : int
            Number of the frame: what ``form_image`` draws anew for each.
        """
        began = perf_counter()
        grid, lattice = self.probe.grid, self._lattice
        places = plane.lift(lattice.nodes)
        X, residual, folds = places, 0.0, None
        if field is not None:
            X, residual, folds = self._undo(places, field, pose)
        inverse = perf_counter()
        shape = (*lattice.shape[::-1], 3)
        if self._former is None:
            pixels, beyond = self._voxels.slice(
                X.reshape(shape), grid.shape, STEP, plane.matrix[:3, 2], self._spread, self.probe.mask
            )
            outside = beyond / max(int(self.probe.mask.sum()), 1)
        else:
            pixels = self._former(plane, self.probe, field, index).pixels
            seen = self.probe.sees(lattice.nodes)
            outside = 1.0 - float(self.volume.contains(X[seen]).mean()) if seen.any() else 0.0
        sliced = perf_counter()
        if pose is not None and needle is not None and pose.depth >= ZERO_LENGTH:
            self._picture.reference(pixels)
            pixels = self._picture.draw(needle.between(*pose.seen_from(plane), apex=self.probe.apex))
            if self._hides:
                np.multiply(pixels, self.probe.mask, out=pixels)
        done = perf_counter()
        return SliceDrawn(
            UltrasoundImage(pixels, grid, self.volume.source),
            X.reshape(shape),
            residual,
            folds,
            outside,
            {
                "inverse": 1e3 * (inverse - began),
                "slice": 1e3 * (sliced - inverse),
                "needle": 1e3 * (done - sliced),
            },
        )

    def _undo(
        self, places: Floats, field: Field | CoreField, pose: SpatialPose | None
    ) -> tuple[Floats, float, SpatialFolds | None]:
        """Return origins of the lattice, the residual midway between its points, and folds."""
        pixel = min(self.probe.grid.spacing)
        if isinstance(field, CoreField):
            tip = None if pose is None else np.array(pose.tip)
            X, residual, folds = self._voxels.trace(
                places, self.probe.grid.shape, STEP, field, tip, CLOSE * pixel
            )
            return X, residual / pixel, folds
        X, missed, jacobian = origins(places, field, CLOSE * pixel)
        shape = self._lattice.shape[::-1]
        corners = X.reshape(*shape, 3), places.reshape(*shape, 3)
        middle, aim = (
            ((c[:-1, :-1] + c[:-1, 1:] + c[1:, :-1] + c[1:, 1:]) / 4).reshape(-1, 3) for c in corners
        )
        reached = self.volume.contains(middle)
        gap = middle[reached] + field(middle[reached]) - aim[reached]
        residual = float(np.linalg.norm(gap, axis=1).max(initial=0.0)) / pixel
        if pose is not None:
            near = np.flatnonzero(np.linalg.norm(X - pose.tip, axis=1) < NEAR)
            if len(near):
                jacobian[near] = np.linalg.det(gradients(X[near], field) + np.eye(3))
        bad = (jacobian <= 0) | (missed > CLOSE * pixel)
        bad &= self.volume.contains(X)
        if not bad.any():
            return X, residual, None
        worst = int(np.where(bad, jacobian, np.inf).argmin())
        place = (float(X[worst, 0]), float(X[worst, 1]), float(X[worst, 2]))
        return X, residual, SpatialFolds(int(bad.sum()), float(jacobian[worst]), place)
