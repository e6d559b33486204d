"""Green's function of any tissue in a rectangle: which of three ways answers the needle's forces, and how far to trust it.

`BoundaryForces` holds homogeneous tissue ("boundary") and tissue with straight layers and round lesions ("regions") without a mesh;
`QuadraticSolve` ("solve") holds any other on quadratic triangles.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from echospline.errors import InputError
from echospline.mechanics.boundary_forces import BoundaryForces, UnsuitedError, inside
from echospline.mechanics.green_tables import NativeGreen, tables
from echospline.mechanics.half_plane import HalfPlane
from echospline.mechanics.landmarks import Clamps
from echospline.mechanics.quadratic import QuadraticSolve
from echospline.scene import Floats, RegularGrid, Tissue

GreenMethod = Literal["auto", "boundary", "regions", "solve"]

TRUSTED = 0.01
"""Mean residual of "boundary" and "regions" above which "auto" solves instead. In 60 random scenes one with a residual below
it was more than 1 % from the live solve (1.5 %); above 3 % errors of any size were seen (`benchmarks/green_accuracy.py --random`)."""


class GreenResponse:
    """Elastic tissue in a rectangle that answers point forces by Green's function; a `ForceResponse`.

    Parameters
    ----------
    solver : BoundaryForces or QuadraticSolve
        What answers.
    tissue : Tissue
        Its moduli, for the limits.
    method : {"boundary", "regions", "solve"}
        What the solver is.
    reason : str
        Why no other method was chosen; empty where the first did.
    """

    def __init__(
        self, solver: BoundaryForces | QuadraticSolve, tissue: Tissue, method: GreenMethod, reason: str = ""
    ) -> None:
        self.solver, self.tissue, self.method, self.reason = solver, tissue, method, reason

    def __getstate__(self) -> dict[str, Any]:
        """What is pickled: all but the core's copy, which is made anew."""
        return {name: value for name, value in self.__dict__.items() if name != "native"}

    @property
    def grid(self) -> RegularGrid:
        """The mesh whose nodes carry the displacement."""
        return self.solver.grid

    @property
    def radius(self) -> float:
        """Length over which a force is spread, mm."""
        return self.solver.radius

    def answer(self, places: Floats, forces: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Displacement of the mesh nodes and of points under load cases; see `ForceResponse.answer`."""
        return self.native.answer(places, forces, points)

    @cached_property
    def native(self) -> NativeGreen:
        """The solver in the core, which answers; `solver` answers the same in NumPy and SciPy."""
        return NativeGreen(self.solver)

    def tables(self) -> dict[str, Any]:
        """Return numbers and arrays from which the core answers without Python; see `green_tables.tables`."""
        return tables(self.solver)

    def describe(self) -> str:
        """Return in one sentence which method answers, its residual, and why it was chosen."""
        because = f"; {self.reason}" if self.reason else ""
        return f"Green's function, {self.method}: {self.solver.describe()}{because}."

    @property
    def clearance(self) -> float:
        """Least distance of a force from an edge or interface that the method is good for, mm; 0 where there is none."""
        return self.solver.nearest if isinstance(self.solver, BoundaryForces) else 0.0

    def bearable(self, places: Floats) -> Floats:
        """Force at each of places (m, 2) at which |grad u| reaches 1 under its own blob, N, shape (m,).

        About 3.5 E radius thickness in plane stress. Beyond it the displacement is no longer sure to be one to one, and linear
        elasticity has long stopped being good.
        """
        young, poisson = self.tissue.at(places) if len(places) else (np.zeros(0), np.zeros(0))
        steep = {
            float(nu): HalfPlane.of(self.tissue, 1.0, float(nu), None).steepest for nu in np.unique(poisson)
        }
        per = np.array([steep[float(nu)] for nu in poisson])
        force: Floats = 1e-3 * young * self.radius * self.tissue.thickness / per
        return force

    def warnings(self, places: Floats, forces: Floats) -> dict[str, str]:
        """Say where forces (m, 2) or (m, 2, k) in N at places (m, 2) go beyond what the method is good for.

        Returns
        -------
        dict of str to str
            One sentence for each limit that is passed: "near" where a force is close to an edge or an interface, "folding" where it
            is more than tissue bears. Empty where nothing is to be said. A model gives each to `warnings.warn` once.
        """
        p = inside(self.grid, places, "places of forces")
        f = np.asarray(forces, dtype=np.float64).reshape(len(p), 2, -1)
        size = np.hypot(f[:, 0], f[:, 1]).max(axis=1, initial=0.0)
        acting = size > 0
        said: dict[str, str] = {}
        if isinstance(self.solver, BoundaryForces) and acting.any():
            gap = self.solver.clearance(p[acting])
            if gap.min() < self.clearance:
                x, y = p[acting][gap.argmin()]
                said["near"] = (
                    f"a force at ({x:.1f}, {y:.1f}) mm is {gap.min():.2g} mm from an edge or interface; Green's function "
                    f'({self.method}) is good from {self.clearance:.2g} mm: use method = "solve" or fem there'
                )
        if acting.any():
            share = size[acting] / self.bearable(p[acting])
            if share.max() > 1.0:
                x, y = p[acting][share.argmax()]
                said["folding"] = (
                    f"a force of {size[acting][share.argmax()]:.2g} N at ({x:.1f}, {y:.1f}) mm is {share.max():.1f} times what tissue bears "
                    f"there without |grad u| above 1: lower the force, or raise Young's modulus, the thickness or the radius of {self.radius:g} mm"
                )
        return said


def green_response(
    grid: RegularGrid,
    clamps: Clamps,
    tissue: Tissue,
    *,
    radius: float = 0.4,
    method: GreenMethod = "auto",
) -> GreenResponse:
    """Set up Green's function of tissue, whatever its regions and edges.

    Parameters
    ----------
    grid : RegularGrid
        The mesh; its extent is the tissue.
    clamps : Clamps
        Which edges and points hold it.
    tissue : Tissue
        Its moduli, thickness, plane stress or strain.
    radius : float
        Over which a force is spread, mm; by default about the radius of an 18 gauge needle. The field near a force depends on it,
        the field elsewhere does not.
    method : {"auto", "boundary", "regions", "solve"}
        "boundary" is for homogeneous tissue, "regions" for straight layers and round lesions, "solve" for any.
        "auto" takes the first of them that the tissue allows and whose residual is below `TRUSTED`;
        `GreenResponse.describe` tells which, and why.

    Raises
    ------
    InputError
        If a method is asked for that cannot represent the tissue, or a number is out of its range.
    """
    if method not in get_args(GreenMethod):
        raise InputError(f"method of green is one of {', '.join(get_args(GreenMethod))}; got {method!r}")
    if method == "solve":
        return GreenResponse(QuadraticSolve(grid, clamps, tissue, radius), tissue, "solve")
    if method == "boundary" and not tissue.homogeneous:
        raise InputError(
            'method "boundary" of green is for homogeneous tissue, and this one has regions; use "regions", "solve" or "auto"'
        )
    kind: GreenMethod = "boundary" if tissue.homogeneous and method != "regions" else "regions"
    try:
        found = BoundaryForces(grid, clamps, tissue, radius)
    except UnsuitedError as unsuited:
        if method != "auto":
            raise InputError(
                f'method "{method}" of green cannot hold this tissue: {unsuited}; use "solve" or "auto"'
            ) from unsuited
        return GreenResponse(
            QuadraticSolve(grid, clamps, tissue, radius), tissue, "solve", f"not regions: {unsuited}"
        )
    if method == "auto" and not found.residual.mean <= TRUSTED:
        reason = f"not {kind}: its residual of {100 * found.residual.mean:.2g} % is above {100 * TRUSTED:g} %"
        return GreenResponse(QuadraticSolve(grid, clamps, tissue, radius), tissue, "solve", reason)
    return GreenResponse(found, tissue, kind)
