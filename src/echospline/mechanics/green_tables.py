"""Green's function of a scene as plain numbers and arrays: what the core needs to answer forces without Python.

`tables` writes what `core/include/echospline/green.h` reads, with its names; `NativeGreen` answers from it in the core.
"""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np

from echospline import _native
from echospline._native import green as core
from echospline.errors import InputError
from echospline.mechanics.boundary_forces import OUTSIDE, PIN, BoundaryForces, load_cases
from echospline.mechanics.quadratic import QuadraticSolve
from echospline.scene import Floats, RegularGrid, as_points

TYPES: dict[str, Any] = {"source_counts": np.int32, "sides": np.int32, "order": np.int32, "held": np.uint8}
"""Types of the tables that are no float64."""

COUNTS = {
    "body_count": ("bodies", 2),
    "source_count": ("sources", 2),
    "condition_count": ("conditions", 4),
    "pin_count": ("pins", 2),
    "rank": ("order", 1),
    "line_x_count": ("lines_x", 1),
    "line_y_count": ("lines_y", 1),
    "triangle_count": ("moduli", 2),
    "held_count": ("held", 1),
}
"""Members of the options that say how many entries a table has, and how many numbers an entry is."""


def tables(solver: BoundaryForces | QuadraticSolve) -> dict[str, Any]:
    """Write the tables of a solver.

    Returns
    -------
    dict
        Numbers, lists of two numbers and arrays under the names of ``echospline_green_options``; counts but ``band_count`` follow
        from the arrays. It is all that the core needs; a scene of 40 x 30 mm takes a few kilobytes.
    """
    grid, clamps = solver.grid, solver.clamps
    edges = {"left": 1, "right": 2, "top": 4, "bottom": 8}
    common: dict[str, Any] = {
        "clamped": sum(edges[e] for e in clamps.edges),
        "sliding": sum(edges[e] for e in clamps.sliding),
        "shape": [int(n) for n in grid.shape],
        "spacing": [float(d) for d in grid.spacing],
        "origin": [float(o) for o in grid.origin],
        "radius": float(solver.radius),
    }
    own = _boundary(solver) if isinstance(solver, BoundaryForces) else _solve(solver)
    return common | own


def _boundary(s: BoundaryForces) -> dict[str, Any]:
    conditions, sides = [], []
    side: tuple[int, int, int]
    for piece in s.pieces:
        conditions.append(np.hstack([piece.points, piece.normals]))
        if len(piece.bodies) == 2:
            side = (core.GreenCondition.CONDITION_INTERFACE, piece.bodies[0], piece.bodies[1])
        else:
            kinds = {
                "clamped": core.GreenCondition.CONDITION_CLAMPED,
                "sliding": core.GreenCondition.CONDITION_SLIDING_X + piece.axis,
                "free": core.GreenCondition.CONDITION_FREE,
            }
            side = (kinds[piece.kind], piece.bodies[0], -1)
        sides.append(np.tile(np.array(side, dtype=np.int32), (len(piece.points), 1)))
    circles = [(*c.centre, c.radius) for c in s.partition.circles]
    return {
        "method": int(core.GreenMethod.GREEN_BOUNDARY),
        "weight": float(s.weight),
        "pin_weight": PIN,
        "pin_radius": float(s.pin_radius),
        "lattice": float(OUTSIDE * s.spacing) if len(s.bodies) == 1 else 0.0,
        "band_count": len(s.partition.depths) - 1,
        "bodies": np.array([(b.base.nu, b.base.stiffness) for b in s.bodies]),
        "depths": np.asarray(s.partition.depths, dtype=np.float64),
        "circles": np.array(circles, dtype=np.float64).reshape(-1, 3),
        "sources": np.vstack([b.sources for b in s.bodies]),
        "source_counts": np.array([len(b.sources) for b in s.bodies], dtype=np.int32),
        "conditions": np.vstack(conditions),
        "sides": np.vstack(sides),
        "pins": np.asarray(s.clamps.points, dtype=np.float64).reshape(-1, 2),
        "order": s.order.astype(np.int32),
    }


def _solve(s: QuadraticSolve) -> dict[str, Any]:
    return {
        "method": int(core.GreenMethod.GREEN_SOLVE),
        "lines_x": s.x,
        "lines_y": s.y,
        "moduli": s.moduli,
        "held": s.held.astype(np.uint8),
    }


class NativeGreen:
    """Tissue that answers point forces in the core; a `ForceResponse`. Thread-safe: the core only reads.

    Parameters
    ----------
    solver : BoundaryForces or QuadraticSolve
        What was set up; its tables are copied.

    Raises
    ------
    SolverError
        If the stiffness is not positive.
    """

    def __init__(self, solver: BoundaryForces | QuadraticSolve) -> None:
        self._grid, self._core = solver.grid, core.library()
        self._handle = ctypes.c_void_p()
        options, _kept = options_of(
            tables(solver), solver.factors if isinstance(solver, BoundaryForces) else None
        )
        status = self._core.echospline_green_create(ctypes.byref(options), ctypes.byref(self._handle))
        weakref.finalize(self, self._core.echospline_green_destroy, self._handle)
        self._check(status)

    @property
    def grid(self) -> RegularGrid:
        """The mesh."""
        return self._grid

    def answer(self, places: Floats, forces: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Displacement of the mesh nodes and of points under load cases; see `ForceResponse.answer`."""
        return self._answer(places, forces, points, on_mesh=True)

    def at(self, places: Floats, forces: Floats, points: Floats) -> Floats:
        """Displacement (p, 2, k) in mm of points alone under load cases."""
        return self._answer(places, forces, points, on_mesh=False)[1]

    def _answer(
        self, places: Floats, forces: Floats, points: Floats, *, on_mesh: bool
    ) -> tuple[Floats, Floats]:
        s, p = _rows(places, "places of forces"), _rows(points, "points")
        F = np.ascontiguousarray(load_cases(s, forces))
        k = F.shape[1]
        mesh = np.empty((self._grid.size if on_mesh else 0, 2, k))
        at = np.empty((len(p), 2, k))
        status = self._core.echospline_green_answer(
            self._handle, s.ctypes.data, len(s), F.ctypes.data, k, p.ctypes.data, len(p),
            mesh.ctypes.data if on_mesh else None, mesh.size, at.ctypes.data, at.size,
        )  # fmt: skip
        self._check(status)
        return mesh, at

    def _check(self, status: int) -> None:
        if status != _native.Status.OK:
            _native.check(status, self._core.echospline_green_message, self._handle)


NUMBERS = tuple(
    name
    for name, kind in ((field[0], field[1]) for field in core.GreenOptions._fields_)
    if name not in ("struct_size", "level", "reserved", "right", "left", *COUNTS)
    and kind is not ctypes.c_void_p
)
"""Members of the options that tables may name and that are numbers, or two of them."""
WIDTHS = dict(COUNTS.values()) | {"depths": 1, "circles": 3, "source_counts": 1, "sides": 3}
"""Numbers per entry of every array."""


def options_of(
    given: Mapping[str, Any], factors: tuple[Floats, Floats] | None = None
) -> tuple[core.GreenOptions, list[Any]]:
    """Options of the core from tables, and the arrays that they point to; factors: right and left, which it then need not find.

    Raises
    ------
    InputError
        If a name is unknown, a value has another form than its member, or an array is shorter than others say: the core has no
        other way to know.
    """
    o = core.GreenOptions(struct_size=ctypes.sizeof(core.GreenOptions))
    kept: dict[str, Any] = {}
    for name, value in given.items():
        if name in WIDTHS:
            kept[name] = _table(name, value)
            setattr(o, name, kept[name].ctypes.data)
            continue
        if name not in NUMBERS:
            raise InputError(
                f"{name!r} is no table of green; expected some of {', '.join((*NUMBERS, *WIDTHS))}"
            )
        try:
            if isinstance(getattr(o, name), ctypes.Array):
                getattr(o, name)[:] = tuple(value)
            else:
                setattr(o, name, value)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{name} of green has another form than the core's; got {value!r}") from None
    length = {name: len(table) for name, table in kept.items()}
    if o.method == core.GreenMethod.GREEN_BOUNDARY:
        bodies = length.get("bodies", 0) // 2
        expected = {
            "depths": o.band_count + 1,
            "circles": 3 * (bodies - o.band_count),
            "source_counts": bodies,
        }
        expected["sides"] = length.get("conditions", 0) // 4 * 3
        for name, count in expected.items():
            if length.get(name, 0) != count:
                raise InputError(f"{name} of green must have {count} numbers; got {length.get(name, 0)}")
    for count, (name, width) in COUNTS.items():
        setattr(o, count, length.get(name, 0) // width)
    if factors is not None:
        kept["right"], kept["left"] = (np.ascontiguousarray(f) for f in factors)
        o.right, o.left = kept["right"].ctypes.data, kept["left"].ctypes.data
    return o, list(kept.values())


def _table(name: str, value: Any) -> Any:
    """Return an array of the options, flat, of the core's type."""
    found = np.asarray(value)
    if found.dtype.kind not in "buif" or found.size % WIDTHS[name]:
        raise InputError(
            f"{name} of green must be numbers, {WIDTHS[name]} per entry; got shape {found.shape} of {found.dtype}"
        )
    if name in TYPES:
        with np.errstate(invalid="ignore"):
            whole = np.array_equal(found, found.astype(TYPES[name]))
        if not whole:
            raise InputError(f"{name} of green must be whole numbers")
    return np.ascontiguousarray(found.ravel(), dtype=TYPES.get(name, np.float64))


def _rows(points: Floats, name: str) -> Floats:
    if np.size(points) == 0:
        return np.zeros((0, 2))
    found = np.ascontiguousarray(as_points(points, name))
    if found.shape[1] != 2:
        raise InputError(f"{name} must have two coordinates; got {found.shape[1]}")
    return found
