"""How far plane elasticity is from a slab in space: the paper's scene in both, the needle in the middle plane.

    python benchmarks/slab.py            # a minute or two
    python benchmarks/slab.py --quick    # coarser elements, thickness 40 mm alone

The slab is 40 x 30 mm and as thick as said, clamped left, right and at the bottom like the plane scene, free at the top and at its two faces;
homogeneous, E 10 kPa, nu 0.45. It is solved with quadratic hexahedra (27 nodes, scikit-fem, half of it by symmetry), the plane with the
package's own elements. The needle: 0.4 N at the tip, and 5e-3 N/mm along its shaft.

Printed per thickness and plane law, at the nodes of the 40 x 30 mesh in the plane of the needle: mean displacement as a share of the slab's
within 3 mm of the needle and beyond; the factor that fits best and the error it leaves; and the thickness of the plane
scene that this factor amounts to.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from kvxopt import cholmod, matrix, spmatrix
from scipy import sparse
from scipy.optimize import minimize_scalar
from skfem import Basis, BilinearForm, ElementHex2, ElementVector, MeshHex

from echospline.mechanics import Clamps
from echospline.mechanics.fem_response import FEMResponse
from echospline.scene import NeedlePose, RegularGrid, Tissue

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
YOUNG, POISSON, TIP, FRICTION = 10.0, 0.45, 0.4, 5e-3
NEEDLES = (((12.0, 0.0), 60.0, 22.0), ((26.0, 0.0), 115.0, 22.0), ((20.0, 0.0), 90.0, 20.0))
NEAR = 3.0
"""mm from the needle's axis; closer, the field is that of a point force and depends on how it is spread."""


class Slab:
    """Half of a slab, from its middle plane z = 0 to the face z = thickness / 2; x lateral, y depth; mm and N."""

    def __init__(self, thickness: float, size: float) -> None:
        z = [0.0]
        while z[-1] < thickness / 2 - 1e-9:  # finer towards the needle
            step = min(
                size * (0.5 if z[-1] < size else 1.0 if z[-1] < 3 * size else 2.0), thickness / 2 - z[-1]
            )
            z.append(thickness / 2 if thickness / 2 - z[-1] - step < 0.3 * size else z[-1] + step)
        x, y = (np.linspace(0, w, round(w / size) + 1) for w in (40.0, 30.0))
        self.basis = Basis(MeshHex.init_tensor(x, y, np.array(z)), ElementVector(ElementHex2()), intorder=4)
        K = _energy.assemble(self.basis)
        held = np.zeros(self.basis.N, dtype=bool)
        place = self.basis.doflocs
        on = (np.abs(place[0] * (place[0] - 40)) < 1e-6) | (np.abs(place[1] - 30) < 1e-9)
        held[on] = True
        component = np.empty(self.basis.N, dtype=int)
        for dofs in (
            self.basis.nodal_dofs,
            self.basis.edge_dofs,
            self.basis.facet_dofs,
            self.basis.interior_dofs,
        ):
            for c in range(3):
                component[dofs[c]] = c
        held[(component == 2) & (np.abs(place[2]) < 1e-9)] = True
        self.free = ~held
        lower = sparse.tril(K[self.free][:, self.free]).tocoo()
        A = spmatrix(lower.data, lower.row.astype(int), lower.col.astype(int), lower.shape)
        self.factor = cholmod.symbolic(A)
        cholmod.numeric(A, self.factor)

    def solve(self, places: np.ndarray, forces: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Displacement (k, 2) in the middle plane under forces (m, 2) there."""
        load = np.zeros((len(places), 3))
        load[:, :2] = forces / 2  # half of the slab carries half of it
        rhs = self._probe(places).T @ load.T.ravel()
        x = matrix(rhs[self.free])
        cholmod.solve(self.factor, x)
        u = np.zeros(self.basis.N)
        u[self.free] = np.array(x).ravel()
        return (self._probe(at) @ u).reshape(3, -1).T[:, :2]

    def _probe(self, points: np.ndarray) -> sparse.csr_matrix:
        inside = np.clip(points, 1e-6, np.array([40.0, 30.0]) - 1e-6)
        return self.basis.probes(np.vstack([inside.T, np.full(len(points), 1e-6)]))


@BilinearForm
def _energy(u, v, w):
    mu = YOUNG * 1e-3 / (2 * (1 + POISSON))
    lam = 2 * mu * POISSON / (1 - 2 * POISSON)
    e, f = (g.grad + np.swapaxes(g.grad, 0, 1) for g in (u, v))
    trace = (e[0][0] + e[1][1] + e[2][2]) * (f[0][0] + f[1][1] + f[2][2]) / 4
    return lam * trace + mu / 2 * sum(e[i][j] * f[i][j] for i in range(3) for j in range(3))


def needle(entry: tuple[float, float], angle: float, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Places (m, 2) and forces (m, 2): the shaft in pieces of a quarter of a millimetre, then the tip."""
    axis = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    pieces = round(4 * depth)
    s = (np.arange(pieces) + 0.5) / pieces * depth
    forces = np.r_[np.full(pieces, FRICTION * depth / pieces), TIP]
    return np.asarray(entry) + np.r_[s, depth][:, None] * axis, forces[:, None] * axis


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    clamps = Clamps.of(GRID, ("left", "right", "bottom"))
    for thickness in (40.0,) if quick else (10.0, 20.0, 40.0):
        truths = {size: _fields(Slab(thickness, size)) for size in ((5.0,) if quick else (3.75, 2.5))}
        *coarser, truth = truths.values()
        for other in coarser:
            difference = np.linalg.norm(other - truth, axis=-1) * _far()
            print(
                f"thickness {thickness:g} mm: elements of 3.75 against 2.5 mm, beyond {NEAR:g} mm: "
                f"{100 * difference.sum() / (np.linalg.norm(truth, axis=-1) * _far()).sum():.1f} %"
            )
        for plane in ("stress", "strain"):
            response = FEMResponse(GRID, clamps, Tissue(YOUNG, POISSON, thickness=thickness, plane=plane))
            fields = []
            for each in NEEDLES:
                places, forces = needle(*each)
                fields.append(response.answer(places, forces[..., None], places)[0][..., 0])
            _compare(f"thickness {thickness:g} mm, plane {plane}", np.array(fields), truth, thickness)


def _fields(slab: Slab) -> np.ndarray:
    return np.array([slab.solve(*needle(*each), GRID.nodes) for each in NEEDLES])


def _far() -> np.ndarray:
    """Which nodes are further than NEAR from each needle, shape (needles, n)."""
    rows = []
    for entry, angle, depth in NEEDLES:
        axis = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        pose = NeedlePose(entry, tuple(np.asarray(entry) + depth * axis), 1.0)
        rows.append(pose.closest(GRID.nodes)[1] > NEAR)
    return np.array(rows)


def _compare(name: str, u: np.ndarray, truth: np.ndarray, thickness: float) -> None:
    far, size = _far(), np.linalg.norm(truth, axis=-1)
    shares = [np.linalg.norm(u, axis=-1)[part].mean() / size[part].mean() for part in (~far, far)]

    def error(factor: float) -> float:
        return float(np.linalg.norm(factor * u - truth, axis=-1)[far].mean() / size[far].mean())

    found = minimize_scalar(error, bounds=(0.1, 10.0), method="bounded")
    factor, best, left = found.x, found.fun, error(1.0)
    print(
        f"{name}: mean displacement {100 * shares[0]:.0f} % of the slab's within {NEAR:g} mm, {100 * shares[1]:.0f} % beyond; error beyond "
        f"{100 * left:.0f} %, {100 * best:.0f} % with the best factor {factor:.2f}: a plane scene {thickness / factor:.0f} mm thick"
    )


if __name__ == "__main__":
    main()
