"""A node per pixel: the field of a landmark spline on a fine grid from a coarse one.

Far from its landmarks a thin plate spline is smooth, so cubic interpolation between the points of a coarse grid carries it.
Near a landmark r^2 ln r is not, and the error there is that landmark's weight times a pattern which depends only on where
it stands: U less its own interpolant. Those patterns are tabulated once per possible landmark and added. Neither reads
anything of the size (pixels x landmarks).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echospline.mechanics.anchored_kernel import AnchoredKernel
from echospline.mechanics.compiled import OPTIONS, compile_ahead, kernel
from echospline.mechanics.response import Response
from echospline.scene import Floats, RegularGrid

FINE = 20_000
"""Nodes above which a mesh is evaluated from a coarse one."""

CELLS = 96
"""Coarse cells along an edge of the mesh, at most."""

REACH = 4
"""Coarse cells around a landmark within which its pattern is added."""


def strides(grid: RegularGrid) -> tuple[int, int]:
    """Fine steps per coarse one, along x and y."""
    nx, ny = (max(1, -(-(n - 1) // CELLS)) for n in grid.shape)
    return nx, ny


def coarse_grid(grid: RegularGrid) -> RegularGrid:
    """Every few nodes of a grid, one more before the first and two more after the last, for the cubic."""
    shape, spacing, origin = [], [], []
    for n, h, start, stride in zip(grid.shape, grid.spacing, grid.origin, strides(grid), strict=True):
        shape.append(-(-(n - 1) // stride) + 4)
        spacing.append(h * stride)
        origin.append(start - h * stride)
    return RegularGrid((shape[0], shape[1]), (spacing[0], spacing[1]), (origin[0], origin[1]))


def taps(stride: int) -> Floats:
    """Weights of the four coarse points around each fine one (Lagrange, exact for cubics), shape (stride, 4)."""
    t = np.arange(stride) / stride
    return np.stack(
        [
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        ],
        axis=1,
    )


@njit(**OPTIONS)
def _interpolate(coarse: Any, tx: Any, ty: Any, out: Any) -> None:
    """Cubic interpolation of coarse (my, mx, 2) at out (ny, nx, 2)."""
    ny, nx = out.shape[0], out.shape[1]
    sx, sy, width = tx.shape[0], ty.shape[0], coarse.shape[1] * 2
    flat = coarse.reshape(coarse.shape[0], width)
    line = np.empty(width)
    for i in range(ny):
        j, t = i // sy, ty[i % sy]
        a, b, c, d = flat[j], flat[j + 1], flat[j + 2], flat[j + 3]
        for k in range(width):
            line[k] = t[0] * a[k] + t[1] * b[k] + t[2] * c[k] + t[3] * d[k]
        row = out[i].reshape(2 * nx)
        for phase in range(sx):
            w0, w1, w2, w3 = tx[phase, 0], tx[phase, 1], tx[phase, 2], tx[phase, 3]
            for k in range((nx - 1 - phase) // sx + 1):
                at = 2 * (k * sx + phase)
                m = 2 * k
                row[at] = w0 * line[m] + w1 * line[m + 2] + w2 * line[m + 4] + w3 * line[m + 6]
                row[at + 1] = w0 * line[m + 1] + w1 * line[m + 3] + w2 * line[m + 5] + w3 * line[m + 7]


@njit(**OPTIONS)
def _pattern(
    form: Any, x: float, y: float, first: Any, step: Any, tx: Any, ty: Any, reach: int, out: Any
) -> Any:
    """U less its interpolant around (x, y), into out (1 or 3, height, width): U, or its xx, xy and yy.

    ``first`` and ``step`` are the first coarse point and the coarse spacing, conditioned. Returns the fine index (column,
    row) of the first corner.
    """
    sx, sy, parts = tx.shape[0], ty.shape[0], out.shape[0]
    cx, cy = int(np.floor((x - first[0]) / step[0])), int(np.floor((y - first[1]) / step[1]))
    side = 2 * reach + 4
    U, line = np.empty((3, side, side)), np.empty((3, side))
    for j in range(side):
        for i in range(side):
            dx = first[0] + (cx - reach - 1 + i) * step[0] - x
            dy = first[1] + (cy - reach - 1 + j) * step[1] - y
            U[0, j, i], U[1, j, i], U[2, j, i] = kernel(form, dx, dy)
    for v in range(out.shape[1]):
        j, t = v // sy, ty[v % sy]
        for e in range(parts):
            for i in range(side):
                line[e, i] = (
                    t[0] * U[e, j, i] + t[1] * U[e, j + 1, i] + t[2] * U[e, j + 2, i] + t[3] * U[e, j + 3, i]
                )
        dy = first[1] + (cy - reach + v / sy) * step[1] - y
        for u in range(out.shape[2]):
            i, w = u // sx, tx[u % sx]
            dx = first[0] + (cx - reach + u / sx) * step[0] - x
            exact = kernel(form, dx, dy)
            out[0, v, u] = exact[0] - (
                w[0] * line[0, i] + w[1] * line[0, i + 1] + w[2] * line[0, i + 2] + w[3] * line[0, i + 3]
            )
            if parts == 3:
                out[1, v, u] = exact[1] - (
                    w[0] * line[1, i] + w[1] * line[1, i + 1] + w[2] * line[1, i + 2] + w[3] * line[1, i + 3]
                )
                out[2, v, u] = exact[2] - (
                    w[0] * line[2, i] + w[1] * line[2, i + 1] + w[2] * line[2, i + 2] + w[3] * line[2, i + 3]
                )
    return (cx - 1 - reach) * sx, (cy - 1 - reach) * sy


@njit(**OPTIONS)
def _patterns(
    form: Any, places: Any, first: Any, step: Any, tx: Any, ty: Any, reach: int, out: Any, corners: Any
) -> None:
    """`_pattern` of many places (m, 2)."""
    room = np.empty((out.shape[1], out.shape[2], out.shape[3]))
    for m in range(places.shape[0]):
        corners[m, 0], corners[m, 1] = _pattern(
            form, places[m, 0], places[m, 1], first, step, tx, ty, reach, room
        )
        out[m] = room


@njit(**OPTIONS)
def _add(out: Any, pattern: Any, x0: int, y0: int, wx: float, wy: float) -> None:
    """out (ny, nx, 2) += pattern times (wx, wy), where the pattern lies inside."""
    ny, nx = out.shape[0], out.shape[1]
    left, right = max(0, -x0), min(pattern.shape[2], nx - x0)
    for v in range(max(0, -y0), min(pattern.shape[1], ny - y0)):
        row = out[y0 + v].reshape(2 * nx)
        if pattern.shape[0] == 1:
            line = pattern[0, v]
            for u in range(left, right):
                at = 2 * (x0 + u)
                row[at] += wx * line[u]
                row[at + 1] += wy * line[u]
        else:
            xx, xy, yy = pattern[0, v], pattern[1, v], pattern[2, v]
            for u in range(left, right):
                at = 2 * (x0 + u)
                row[at] += wx * xx[u] + wy * xy[u]
                row[at + 1] += wx * xy[u] + wy * yy[u]


@njit(**OPTIONS)
def _add_all(out: Any, patterns: Any, corners: Any, which: Any, weights: Any) -> None:
    for m in range(which.shape[0]):
        p = which[m]
        _add(out, patterns[p], corners[p, 0], corners[p, 1], weights[m, 0], weights[m, 1])


class PixelField:
    """The field of a `Response` on a fine grid.

    The response's points are those of `coarse_grid`, then the sources. Error against the exact field: below 0.005 mm
    (tested; `docs/performance.md` has the measured one).

    Parameters
    ----------
    grid : RegularGrid
        The fine mesh.
    scene : AnchoredKernel
        Of the response.
    """

    def __init__(self, grid: RegularGrid, scene: AnchoredKernel) -> None:
        compile_ahead("a node per pixel", _try_out)
        self.grid, self.scene, self.coarse = grid, scene, coarse_grid(grid)
        self.taps = [taps(s) for s in strides(grid)]
        self.first = scene.conditioned(np.array(self.coarse.origin))
        self.step = np.array(self.coarse.spacing) / scene.scale
        self.shape = (
            2 * scene.components - 1,
            (2 * REACH + 1) * len(self.taps[1]),
            (2 * REACH + 1) * len(self.taps[0]),
        )
        places = np.vstack([scene.anchors, scene.sources])
        self.patterns = np.empty((len(places), *self.shape), dtype=np.float32)
        self.corners: NDArray[np.int64] = np.empty((len(places), 2), dtype=np.int64)
        _patterns(scene.form, places, self.first, self.step, *self.taps, REACH, self.patterns, self.corners)

    @classmethod
    def points(cls, grid: RegularGrid, sources: Floats) -> Floats:
        """Return the points that the response has to be evaluated at, mm: coarse ones, then the sources."""
        return np.vstack([coarse_grid(grid).nodes, sources])

    def __call__(
        self,
        response: Response,
        values: Floats,
        table: Floats,
        tip: Floats,
        soft: float,
        on_tip: int,
    ) -> Floats:
        """Displacement of the fine nodes, shape (n, 2) mm, from that of the response's points ``values``."""
        nx, ny = self.grid.shape
        mx, my = self.coarse.shape
        out = np.empty((ny, nx, 2))
        _interpolate(values[: mx * my].reshape(my, mx, 2), *self.taps, out)
        if len(self.patterns):
            weights = response.spline(table, table[:, 2:4], tip, soft, on_tip).weights
            if self.scene.components == 2:
                weights = np.ascontiguousarray(weights.reshape(2, -1).T)
            b, k = len(self.scene.anchors), response.count
            which = np.concatenate([np.arange(b), b + response.source_of[:k]])
            _add_all(out, self.patterns, self.corners, which, weights[: b + k])
            if len(weights) > b + k:
                room = np.empty(self.shape)
                x, y = (tip[1:3] - self.scene.centre) / self.scene.scale
                x0, y0 = _pattern(self.scene.form, x, y, self.first, self.step, *self.taps, REACH, room)
                _add(out, room, x0, y0, float(weights[-1, 0]), float(weights[-1, 1]))
        return out.reshape(-1, 2)


def _try_out() -> None:
    """Call every loop once with the types that a step uses."""
    out, tap, corners = np.zeros((3, 3, 2)), taps(2), np.zeros((1, 2), dtype=np.int64)
    form, first, step = np.array([1.0, 0.0, 0.0]), np.zeros(2), np.ones(2)
    _interpolate(np.zeros((6, 6, 2)), tap, tap, out)
    patterns = np.zeros((1, 1, 6, 6), dtype=np.float32)
    _patterns(form, np.zeros((1, 2)), first, step, tap, tap, 1, patterns, corners)
    _add_all(out, patterns, corners, np.zeros(1, dtype=np.int64), np.zeros((1, 2)))
    room = np.zeros((1, 6, 6))
    x0, y0 = _pattern(form, 0.0, 0.0, first, step, tap, tap, 1, room)
    _add(out, room, x0, y0, 0.0, 0.0)
