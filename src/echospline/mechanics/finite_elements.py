"""Plane elasticity on bilinear quadrilaterals, equations (18) to (23); knows no needle, tissue or image.

The mesh is a `RegularGrid`: its points are the nodes, its cells the elements. Moduli are kPa, lengths
mm and forces N, so that the stiffness matrix of a slab of ``thickness`` is in N/mm (1 kPa = 1e-3 N/mm^2).
Degrees of freedom are interleaved: row ``2 i`` is the lateral, row ``2 i + 1`` the depth component of node i.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementQuad1, ElementVector, MeshQuad

from echospline.errors import InputError, MissingExtraError, SolverError
from echospline.scene import Floats, RegularGrid, as_points

Plane = Literal["stress", "strain"]
Integration = Literal["full", "selective"]
Method = Literal["cholmod", "superlu"]
METHOD: Method = "cholmod" if find_spec("kvxopt") else "superlu"
"""Default factorisation: CHOLMOD where the extra is installed; results and commands say which it was."""

MPA = 1e-3
"""N/mm^2 per kPa."""

LOCKING = 0.49
"""Poisson's ratio above which fully integrated plane strain is refused: bilinear elements lock."""


def element_nodes(grid: RegularGrid) -> NDArray[np.intp]:
    """Nodes of every element, anticlockwise in (x, y), shape (elements, 4); elements run x fastest."""
    nx, ny = grid.shape
    if nx < 2 or ny < 2:
        raise InputError(f"finite elements need a mesh of 2 x 2 nodes or more; got {grid.shape}")
    first = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    return np.stack([first, first + 1, first + nx + 1, first + nx], axis=1)


def element_centres(grid: RegularGrid) -> Floats:
    """Centres of the elements in mm, shape (elements, 2)."""
    centres: Floats = grid.nodes[element_nodes(grid)].mean(axis=1)
    return centres


def lame(young: ArrayLike, poisson: ArrayLike, plane: Plane = "stress") -> tuple[Floats, Floats]:
    """First and second Lamé parameter in kPa, such that stress = lambda tr(strain) I + 2 mu strain.

    For plane stress lambda is E nu / (1 - nu^2), which is equation (19); for plane strain
    E nu / ((1 + nu) (1 - 2 nu)), which has no bound as nu approaches 0.5.

    Raises
    ------
    InputError
        If E is not positive, or nu is not inside (-1, 0.5] for plane stress, (-1, 0.5) for plane strain.
    """
    if plane not in get_args(Plane):
        raise InputError(f'plane is "stress" or "strain"; got {plane!r}')
    E, nu = np.broadcast_arrays(np.asarray(young, dtype=np.float64), np.asarray(poisson, dtype=np.float64))
    if not (np.isfinite(E).all() and (E > 0).all()):
        raise InputError(f"Young's modulus must be positive numbers in kPa; got {_offender(E, E > 0)}")
    inside = (nu > -1) & ((nu <= 0.5) if plane == "stress" else (nu < 0.5))
    if not inside.all():
        hint = "" if plane == "stress" else "; incompressible tissue: use plane stress, or nu up to 0.4999"
        closing = "]" if plane == "stress" else ")"
        raise InputError(
            f"Poisson's ratio in plane {plane} must lie in (-1, 0.5{closing}; got {_offender(nu, inside)}{hint}"
        )
    mu = E / (2 * (1 + nu))
    lam = E * nu / (1 - nu**2) if plane == "stress" else E * nu / ((1 + nu) * (1 - 2 * nu))
    return lam, mu


def stiffness(
    grid: RegularGrid,
    young: ArrayLike,
    poisson: ArrayLike,
    thickness: float,
    plane: Plane = "stress",
    integration: Integration = "full",
    excess: tuple[NDArray[np.intp], Floats] | None = None,
) -> Any:
    """Assemble the global stiffness matrix K of equation (23).

    Parameters
    ----------
    grid : RegularGrid
        Nodes of the mesh, 2 x 2 or more.
    young, poisson : float or array_like, shape (elements,)
        E in kPa and nu, one number or one per element (`element_centres` says where).
    thickness : float
        Thickness of the slab across the imaging plane, mm.
    plane : {"stress", "strain"}
        Plane stress is equation (19).
    integration : {"full", "selective"}
        "selective" takes the volumetric part at the element's centre only, which keeps nearly
        incompressible plane strain from locking.
    excess : (cells, elasticity), optional
        Elements that are stiffer than isotropic, and by how much: kPa, shape (c, 3, 3), of the strains (xx, yy, xy) with the
        engineering shear. `cut_cells.elements_of` makes it.

    Returns
    -------
    scipy.sparse.csc_matrix, shape (2 n, 2 n), N/mm

    Raises
    ------
    InputError
        If a number is out of its range, or the elements would lock.
    """
    if not (np.isfinite(thickness) and thickness > 0):
        raise InputError(f"thickness must be a positive number in mm; got {thickness}")
    if integration not in get_args(Integration):
        raise InputError(f"integration is one of {', '.join(get_args(Integration))}; got {integration!r}")
    lam, mu = lame(young, poisson, plane)
    if plane == "strain" and integration == "full" and (np.asarray(poisson) > LOCKING).any():
        raise InputError(
            f"bilinear elements in plane strain lock for nu above {LOCKING}: the mesh would be far too stiff; "
            "use integration='selective' or plane stress"
        )
    elements = element_nodes(grid)
    if lam.ndim > 1 or lam.size not in (1, len(elements)):
        raise InputError(
            f"young and poisson must be one number or one per element ({len(elements)}); got shape {lam.shape}"
        )
    mesh = MeshQuad(np.ascontiguousarray(grid.nodes.T), np.ascontiguousarray(elements.T))
    whole = Basis(mesh, ElementVector(ElementQuad1()), intorder=2)
    centre = (np.array([[0.5], [0.5]]), np.array([1.0]))  # skfem's own rules begin at 2 x 2 points
    volumetric = whole if integration == "full" else Basis(mesh, whole.elem, quadrature=centre)
    scale = MPA * thickness
    K = _assemble(_shear, whole, scale * mu) + _assemble(_volume, volumetric, scale * lam)
    if excess is not None and len(excess[0]):
        some = Basis(mesh, whole.elem, intorder=2, elements=excess[0])
        entries = {
            f"d{i}{j}": np.repeat(excess[1][:, i, j, None], some.X.shape[-1], axis=1)
            for i in range(3)
            for j in range(3)
        }
        K = K + scale * BilinearForm(_anisotropic).assemble(some, **entries)
    return K.tocsc()


@dataclass(frozen=True)
class FactoredStiffness:
    """K factored once with what is held taken out; `solve` is a back-substitution.

    Attributes
    ----------
    free : ndarray of bool, shape (2 n,)
        Which degrees of freedom move.
    method : {"cholmod", "superlu"}
        Who factored: CHOLMOD through kvxopt, or SciPy's SuperLU.
    """

    free: NDArray[np.bool_]
    method: Method
    _coupling: Any
    _solve: Callable[[Floats], Floats]

    def solve(self, loads: ArrayLike, clamped_displacement: ArrayLike | None = None) -> Floats:
        """Displacement of the nodes under nodal loads, equation (23).

        Parameters
        ----------
        loads : array_like, shape (n, 2) or (n, 2, k)
            Forces on the nodes, N; k load cases at once. Those on held components go into what holds them.
        clamped_displacement : array_like, shape (n, 2), optional
            Where held components are held, mm; zero when not given.

        Returns
        -------
        ndarray, shape (n, 2) or (n, 2, k), mm
        """
        f = np.asarray(loads, dtype=np.float64)
        if f.ndim not in (2, 3) or f.shape[0] * 2 != len(self.free) or f.shape[1] != 2:
            raise InputError(f"loads must have shape ({len(self.free) // 2}, 2[, k]) in N; got {f.shape}")
        if not np.isfinite(f).all():
            raise InputError("loads must be finite numbers in N")
        rhs = f.reshape(len(self.free), -1)[self.free]
        u = np.zeros((len(self.free), rhs.shape[1]))
        if clamped_displacement is not None:
            held = np.asarray(clamped_displacement, dtype=np.float64).reshape(-1)
            if held.shape != self.free.shape or not np.isfinite(held).all():
                raise InputError(
                    f"clamped_displacement must be ({len(self.free) // 2}, 2) finite numbers in mm"
                )
            rhs = rhs - (self._coupling @ held[~self.free])[:, None]
            u[~self.free] = held[~self.free, None]
        u[self.free] = self._solve(rhs)
        return u.reshape(f.shape)

    def compliance(self, nodes: ArrayLike) -> Compliance:
        """Field of a unit force on each of the given nodes, one column per node and direction."""
        chosen = np.unique(np.asarray(nodes, dtype=np.intp))
        loads = np.zeros((len(self.free) // 2, 2, 2 * len(chosen)))
        case = np.arange(len(chosen))
        loads[chosen, 0, 2 * case] = 1.0
        loads[chosen, 1, 2 * case + 1] = 1.0
        return Compliance(chosen, self.solve(loads).reshape(len(self.free), -1))


@dataclass(frozen=True)
class Compliance:
    """Fields of unit forces on a few nodes: a step is one product, no solve.

    Attributes
    ----------
    nodes : ndarray, shape (m,)
        The loaded nodes, ascending.
    columns : ndarray, shape (2 n, 2 m)
        mm/N, interleaved on both sides.
    """

    nodes: NDArray[np.intp]
    columns: Floats

    def solve(self, loads: Floats) -> Floats:
        """Displacement (n, 2) in mm under nodal loads (n, 2) in N that act on ``nodes`` only."""
        unexpected = np.setdiff1d(np.flatnonzero(loads.any(axis=1)), self.nodes)
        if len(unexpected):
            raise InputError(
                f"compliance has no column for the loaded node {int(unexpected[0])}; add it to nodes"
            )
        return (self.columns @ loads[self.nodes].reshape(-1)).reshape(-1, 2)


def factor(K: Any, held: ArrayLike, method: Method = METHOD) -> FactoredStiffness:
    """Factor the stiffness matrix with some nodes, or some of their components, held.

    Parameters
    ----------
    K : sparse matrix, shape (2 n, 2 n)
        From `stiffness`, N/mm.
    held : array_like of int, or of bool with shape (n, 2)
        Nodes held in both directions, or which components (lateral, depth) of which nodes are held
        (`Clamps.held`: an edge that slides holds one). No shift and no turn of the tissue as a whole may be left.
    method : {"cholmod", "superlu"}
        "cholmod" (kvxopt, an extra) is the faster on large meshes; "superlu" needs nothing but SciPy. The one named is used;
        by default CHOLMOD where it is installed.

    Raises
    ------
    InputError
        If what is held leaves a shift free, or the method is unknown.
    MissingExtraError
        If it is "cholmod" and kvxopt is not installed.
    SolverError
        If the matrix is not positive definite.
    """
    if method not in get_args(Method):
        raise InputError(f"a factorisation is one of {', '.join(get_args(Method))}; got {method!r}")
    fixed = _components(np.asarray(held), K.shape[0] // 2)
    free = ~fixed.ravel()
    if not free.any():
        raise InputError("every node is clamped; nothing is left to move")
    rows = K.tocsr()[free]
    inner = rows[:, free].tocsc()
    solve = _cholmod(inner) if method == "cholmod" else _superlu(inner)
    return FactoredStiffness(free, method, rows[:, ~free].tocsr(), solve)


def _components(held: NDArray[Any], n: int) -> NDArray[np.bool_]:
    """Return which components of n nodes are held, shape (n, 2)."""
    if held.dtype != bool:
        nodes = np.unique(held.astype(np.intp))
        if len(nodes) < 2 or nodes[0] < 0 or nodes[-1] >= n:
            raise InputError(
                f"two or more of the {n} nodes must be clamped, or the tissue floats away; got {len(nodes)}"
            )
        held = np.zeros((n, 2), dtype=bool)
        held[nodes] = True
    if held.shape != (n, 2):
        raise InputError(f"held components must be a boolean for each of {n} x 2; got shape {held.shape}")
    for name, column in zip(("x", "y"), held.T, strict=True):
        if not column.any():
            raise InputError(
                f"nothing holds the tissue along {name}: clamp an edge, or let one across {name} slide"
            )
    if held.sum() < 3:
        raise InputError(
            "three or more components must be held, or the tissue turns: clamp an edge or a second point"
        )
    fixed: NDArray[np.bool_] = held
    return fixed


def point_loads(grid: RegularGrid, points: ArrayLike, forces: ArrayLike) -> Floats:
    """Consistent nodal loads (n, 2) in N of forces (k, 2) in N at points (k, 2) in mm anywhere in the mesh."""
    nodes, weights = shape_functions(grid, points)
    f = np.broadcast_to(np.asarray(forces, dtype=np.float64), (len(nodes), 2))
    loads = np.zeros((grid.size, 2))
    np.add.at(loads, nodes, weights[:, :, None] * f[:, None, :])
    return loads


def line_loads(grid: RegularGrid, start: ArrayLike, end: ArrayLike, force_per_mm: ArrayLike) -> Floats:
    """Consistent nodal loads (n, 2) in N of a uniform force per length, (2,) in N/mm, from start to end.

    The line is cut where it crosses from element to element, and each piece is integrated exactly (two Gauss
    points: a bilinear shape function is a quadratic along a line). Only the part inside the mesh counts:
    a shaft outside the tissue rubs on nothing.
    """
    ends = as_points(
        [np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)], "start and end"
    )
    i0, along = grid.to_index(ends[0]), np.diff(grid.to_index(ends), axis=0)[0]
    length = float(np.hypot(*(ends[1] - ends[0])))
    last = np.subtract(grid.shape, 1)
    cuts = [np.array([0.0, 1.0])]
    for axis in range(2):
        if along[axis] != 0:
            lines = np.arange(last[axis] + 1)
            cuts.append((lines - i0[axis]) / along[axis])
    t = np.unique(np.concatenate(cuts))
    t = t[(t >= 0) & (t <= 1)]
    middle, half = (t[1:] + t[:-1]) / 2, np.diff(t) / 2
    inside = ((i0 + middle[:, None] * along >= 0) & (i0 + middle[:, None] * along <= last)).all(axis=1)
    middle, half = middle[inside], half[inside]
    gauss = np.array([-1.0, 1.0]) / np.sqrt(3.0)
    s = (middle[:, None] + half[:, None] * gauss).ravel()
    points = ends[0] + s[:, None] * (ends[1] - ends[0])
    force = np.asarray(force_per_mm, dtype=np.float64)
    return point_loads(grid, points, np.repeat(half * length, 2)[:, None] * force)


def shape_functions(grid: RegularGrid, points: ArrayLike) -> tuple[NDArray[np.intp], Floats]:
    """Nodes (k, 4) around each point and the values (k, 4) there of their shape functions N_i, equation (22).

    Raises
    ------
    InputError
        If a point lies outside the mesh (by more than a rounding error).
    """
    p = as_points(points)
    last = np.subtract(grid.shape, 1)
    index = grid.to_index(p)
    outside = ((index < -1e-6) | (index > last + 1e-6)).any(axis=1)
    if outside.any():
        x0, x1, y0, y1 = grid.extent
        where = tuple(float(c) for c in p[np.flatnonzero(outside)[0]])
        raise InputError(
            f"points must lie in the mesh, x {x0:g} to {x1:g} mm and y {y0:g} to {y1:g} mm; got {where}"
        )
    cell = np.clip(np.floor(index).astype(np.intp), 0, last - 1)
    s, t = np.clip(index - cell, 0.0, 1.0).T
    first = cell[:, 1] * grid.shape[0] + cell[:, 0]
    nodes = first[:, None] + np.array([0, 1, grid.shape[0] + 1, grid.shape[0]])
    return nodes, np.stack([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t], axis=1)


def interpolate(grid: RegularGrid, values: Floats, points: ArrayLike) -> Floats:
    """Nodal values (n, 2) at any points (k, 2) of the mesh, equation (22), shape (k, 2)."""
    nodes, weights = shape_functions(grid, points)
    field: Floats = np.einsum("kj,kjc->kc", weights, values[nodes])
    return field


def _offender(values: Floats, good: NDArray[np.bool_]) -> float:
    flat = np.atleast_1d(values)
    return float(flat[np.flatnonzero(~np.atleast_1d(good) | ~np.isfinite(flat))[0]])


def _strain(u: Any) -> tuple[Any, Any, Any]:
    """Strain, equation (20)."""
    return u.grad[0][0], u.grad[1][1], u.grad[0][1] + u.grad[1][0]


def _shear(u: Any, v: Any, w: Any) -> Any:
    """2 mu strain : strain, the part of the weak form (21) that shape changes cost."""
    (exx, eyy, gxy), (vxx, vyy, hxy) = _strain(u), _strain(v)
    return w["modulus"] * (2 * exx * vxx + 2 * eyy * vyy + gxy * hxy)


def _anisotropic(u: Any, v: Any, w: Any) -> Any:
    """Strain : elasticity : strain of the weak form (21) with a matrix of moduli."""
    e, f = _strain(u), _strain(v)
    return sum(w[f"d{i}{j}"] * e[j] * f[i] for i in range(3) for j in range(3))


def _volume(u: Any, v: Any, w: Any) -> Any:
    """Lambda tr(strain) tr(strain), the part of the weak form (21) that area changes cost."""
    return w["modulus"] * (u.grad[0][0] + u.grad[1][1]) * (v.grad[0][0] + v.grad[1][1])


def _assemble(form: Callable[[Any, Any, Any], Any], basis: Any, modulus: Floats) -> Any:
    points = basis.X.shape[-1]
    per_point = np.broadcast_to(np.reshape(modulus, (-1, 1)), (basis.mesh.nelements, points))
    return BilinearForm(form).assemble(basis, modulus=np.ascontiguousarray(per_point))


def _cholmod(A: Any) -> Callable[[Floats], Floats]:
    try:
        kvxopt: Any = import_module("kvxopt")
        cholmod: Any = import_module("kvxopt.cholmod")
    except ImportError as missing:
        raise MissingExtraError(
            "kvxopt", "cholmod", "factoring by CHOLMOD (superlu needs nothing)"
        ) from missing
    lower = sparse.tril(A).tocoo()
    Ak = kvxopt.spmatrix(lower.data, lower.row.astype(int), lower.col.astype(int), A.shape)
    numeric = cholmod.symbolic(Ak)
    try:
        cholmod.numeric(Ak, numeric)
    except ArithmeticError as singular:
        raise SolverError(
            "the stiffness matrix is not positive definite; check moduli and clamp"
        ) from singular

    def solve(rhs: Floats) -> Floats:
        x = kvxopt.matrix(np.asfortranarray(rhs))
        try:
            cholmod.solve(numeric, x)
        except (
            ArithmeticError
        ) as singular:  # a pivot of zero or less is reported here, not by the factorisation
            raise SolverError(
                "the stiffness matrix is not positive definite; check moduli and clamp"
            ) from singular
        return np.array(x)

    return solve


def _superlu(A: Any) -> Callable[[Floats], Floats]:
    try:
        lu = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as singular:
        raise SolverError("the stiffness matrix is singular; check moduli and clamp") from singular

    def solve(rhs: Floats) -> Floats:
        solution: Floats = lu.solve(np.ascontiguousarray(rhs))
        return solution

    return solve
