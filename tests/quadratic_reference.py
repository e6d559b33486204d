"""Truth for tests and benchmarks: quadratic triangles of scikit-fem, which share no code with the package's own solvers."""

from functools import lru_cache

import numpy as np
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTriP2, ElementVector, MeshTri
from skfem.helpers import ddot, sym_grad, trace

EDGES = {"left": (0, 0), "right": (0, -1), "top": (1, 0), "bottom": (1, -1)}


@BilinearForm
def _hooke(u, v, w):
    e, d = sym_grad(u), sym_grad(v)
    return w["lam"] * trace(e) * trace(d) + 2 * w["mu"] * ddot(e, d)


class Quadratic:
    """Plane elasticity on a rectangle, cells ``h`` mm split into two triangles; held like `Clamps`, loaded by point forces."""

    def __init__(self, extent, h):
        x0, x1, y0, y1 = extent
        self.x = np.linspace(x0, x1, round((x1 - x0) / h) + 1)
        self.y = np.linspace(y0, y1, round((y1 - y0) / h) + 1)
        self.mesh = MeshTri.init_tensor(self.x, self.y)
        self.basis = Basis(self.mesh, ElementVector(ElementTriP2()), intorder=2)
        self.centres = self.mesh.p[:, self.mesh.t].mean(axis=1).T

    def stiffness(self, young, poisson, thickness, plane):
        E, nu = np.broadcast_to(young, len(self.centres)), np.broadcast_to(poisson, len(self.centres))
        mu = E / (2 * (1 + nu))
        lam = E * nu / ((1 + nu) * (1 - 2 * nu)) if plane == "strain" else E * nu / (1 - nu**2)
        points = self.basis.X.shape[-1]
        scaled = (1e-3 * thickness * np.repeat(m[:, None], points, axis=1) for m in (lam, mu))
        lam, mu = (np.ascontiguousarray(m) for m in scaled)
        return _hooke.assemble(self.basis, lam=lam, mu=mu).tocsc()

    def solver(self, K, clamped=(), sliding=(), pins=(), pin_radius=0.4):
        """Function from loads (dofs, k) to displacements (dofs, k)."""
        place = self.basis.doflocs
        held = np.zeros(K.shape[0], dtype=bool)
        component = np.zeros(K.shape[0], dtype=int)
        component[self.basis.nodal_dofs[1]] = component[self.basis.facet_dofs[1]] = 1
        for edge in (*clamped, *sliding):
            axis, side = EDGES[edge]
            line = (self.x, self.y)[axis][side]
            on = np.abs(place[axis] - line) < 1e-9
            held |= on if edge in clamped else on & (component == axis)
        for p in pins:
            held |= np.hypot(place[0] - p[0], place[1] - p[1]) <= pin_radius
        free = ~held
        lu = splu(
            K[free][:, free].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

        def solve(loads):
            u = np.zeros(loads.shape)
            u[free] = lu.solve(np.ascontiguousarray(loads[free]))
            return u

        return solve

    def probes(self, points):
        """Sparse matrix (2 n, dofs): displacement of points, x and y of each after the other."""
        P = self.basis.probes(np.asarray(points, dtype=float).T).tocsr()
        n = len(points)
        return P[np.arange(2 * n).reshape(2, n).T.ravel()]

    def loads(self, points, forces):
        """Consistent nodal loads of point forces (m, 2) in N."""
        return self.probes(points).T @ np.asarray(forces, dtype=float).ravel()


@lru_cache(maxsize=4)
def quadratic(extent, h):
    return Quadratic(extent, h)


@lru_cache(maxsize=2)
def _uniform(extent, h, *moduli):
    return quadratic(extent, h).stiffness(*moduli)


def needle(entry, angle, depth, tip=0.4, friction=5e-3, per_mm=2.0):
    """Places (m, 2) and forces (m, 2) of a needle: friction (N/mm) at the middles of short pieces, and the tip's force."""
    axis = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    count = max(1, int(np.ceil(depth * per_mm)))
    s = (np.arange(count) + 0.5) / count * depth
    size = np.r_[np.full(count, friction * depth / count), tip]
    return np.asarray(entry) + np.r_[s, depth][:, None] * axis, size[:, None] * axis


def truth(extent, h, nodes, poses, young=10.0, poisson=0.45, plane="stress", thickness=40.0, **held):
    """Displacement (poses, n, 2) of nodes under needles; ``young`` and ``poisson`` both numbers or both functions of points."""
    model = quadratic(extent, h)
    if callable(young):
        K = model.stiffness(young(model.centres), poisson(model.centres), thickness, plane)
    else:
        K = _uniform(extent, h, young, poisson, thickness, plane)
    solve = model.solver(K, **held)
    loads = np.stack([model.loads(*pose) for pose in poses], axis=1)
    return (model.probes(nodes) @ solve(loads)).T.reshape(len(poses), len(nodes), 2)


def errors(found, true):
    """Mean distance over the mean displacement of all poses, and of the worst pose, %."""
    size = lambda v: np.hypot(v[..., 0], v[..., 1])  # noqa: E731
    share = [size(u - t).mean() / size(t).mean() for u, t in zip(found, true, strict=True)]
    return 100 * size(np.subtract(found, true)).mean() / size(np.asarray(true)).mean(), 100 * max(share)
