"""Plane elasticity on quadratic triangles whose edges follow the boundaries of regions: scikit-fem's elements, nothing of ours.

What bilinear elements make of a cell that a boundary crosses is judged against it. Units as everywhere: mm, N, kPa.
"""

import numpy as np
from kvxopt import cholmod, matrix, spmatrix
from scipy import sparse
from skfem import Basis, BilinearForm, ElementTriP2, ElementVector, MeshTri


class QuadraticPlane:
    """A rectangle of tissue from the origin, cut into squares of side ``h`` and each into two triangles.

    Parameters
    ----------
    size : (width, height)
        mm.
    h : float
        mm.
    circles : sequence of ((x, y), radius)
        Vertices close to a circle are moved onto it.
    young : callable
        Modulus in kPa at points (n, 2).
    nu, thickness, plane
        Of the whole slab.
    held : callable
        Which components are held at points (n, 2), shape (n, 2) of bool.
    """

    def __init__(self, size, h, circles, young, held, nu=0.45, thickness=40.0, plane="stress"):
        self.size = np.array(size, dtype=float)
        lines = [np.linspace(0, w, round(w / h) + 1) for w in size]
        mesh = MeshTri.init_tensor(*lines)
        p = mesh.p.copy()
        for centre, radius in circles:
            d = p - np.reshape(centre, (2, 1))
            r = np.hypot(*d)
            near = np.abs(r - radius) < 0.36 * h
            p[:, near] = (np.reshape(centre, (2, 1)) + d * radius / np.maximum(r, 1e-9))[:, near]
        mesh = MeshTri(p, mesh.t)
        self.basis = Basis(mesh, ElementVector(ElementTriP2()), intorder=4)
        E = young(p[:, mesh.t].mean(axis=1).T)
        mu = E / (2 * (1 + nu))
        lam = E * nu / (1 - nu**2) if plane == "stress" else E * nu / ((1 + nu) * (1 - 2 * nu))
        per_point = [np.repeat(m[:, None], self.basis.X.shape[-1], axis=1) for m in (lam, mu)]
        K = BilinearForm(_energy).assemble(self.basis, lam=per_point[0], mu=per_point[1]) * 1e-3 * thickness
        places = self.basis.doflocs.T
        component = np.empty(self.basis.N, dtype=int)  # skfem numbers the components of a node in turn
        for dofs in (self.basis.nodal_dofs, self.basis.facet_dofs):
            component[dofs[0]], component[dofs[1]] = 0, 1
        self.free = ~held(places)[np.arange(len(places)), component]
        lower = sparse.tril(K[self.free][:, self.free]).tocoo()
        A = spmatrix(lower.data, lower.row.astype(int), lower.col.astype(int), lower.shape)
        self.factor = cholmod.symbolic(A)
        cholmod.numeric(A, self.factor)

    def solve(self, points, forces, at):
        """Displacement at ``at`` (k, 2) under point forces (m, 2) in N at ``points`` (m, 2)."""
        rhs = self._probe(points).T @ np.asarray(forces, float).T.ravel()
        x = matrix(rhs[self.free])
        cholmod.solve(self.factor, x)
        u = np.zeros(self.basis.N)
        u[self.free] = np.array(x).ravel()
        return (self._probe(at) @ u).reshape(2, -1).T

    def _probe(self, points):
        inside = np.clip(points, 1e-9, self.size - 1e-9)  # rounding on the outline would count as outside
        return self.basis.probes(np.ascontiguousarray(inside.T))


def needle(entry, angle, depth, tip=0.4, friction=5e-3, pieces=400):
    """Points and forces (N) of a needle: its tip, and friction (N/mm) along its shaft."""
    axis = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    s = (np.arange(pieces) + 0.5) / pieces * depth
    points = np.asarray(entry) + np.r_[s, depth][:, None] * axis
    return points, np.r_[np.full(pieces, friction * depth / pieces), tip][:, None] * axis


def _energy(u, v, w):
    (exx, eyy, gxy), (vxx, vyy, hxy) = (
        (f.grad[0][0], f.grad[1][1], f.grad[0][1] + f.grad[1][0]) for f in (u, v)
    )
    return w["lam"] * (exx + eyy) * (vxx + vyy) + w["mu"] * (2 * exx * vxx + 2 * eyy * vyy + gxy * hxy)
