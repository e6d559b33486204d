"""Elements that a boundary between two tissues crosses: as stiff as a laminate of both.

A mean of moduli gives such a cell a stiffness that depends on no direction: the arithmetic mean is too stiff where the
boundary is crossed, the harmonic mean too soft along it. Here the cell is a stack of layers parallel to the boundary
inside it (Milton, The Theory of Composites, chapter 9): traction across the layers and stretch along them are common to all,
everything else is averaged. That is exact for a straight boundary in a uniform field. The stiffness is split into the isotropic
lower bound of `Tissue.in_cells` and an excess that is never negative, so that reduced integration and large strains
(`neo_hookean`) apply to the isotropic part alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from echospline.mechanics.finite_elements import Plane, lame
from echospline.scene import Floats, RegularGrid, Tissue

SEARCH = 8
"""Points per direction by which a cell is found to be cut; a sliver thinner than a sixteenth of it is not seen."""
SAMPLES = 16
"""Points per direction in a cut cell: its shares are good to about one per cent."""
TILTED = 1e-3
"""Least first moment of the moduli, as a share of the greatest possible, that gives the boundary's direction."""


class Elements(NamedTuple):
    """Material of every element.

    Attributes
    ----------
    young, poisson : ndarray, shape (elements,)
        Of the isotropic part, kPa and 1.
    cells : ndarray of int, shape (c,)
        Elements that a boundary crosses, ascending.
    excess : ndarray, shape (c, 3, 3)
        What they have beyond the isotropic part, kPa, for strains (xx, yy, xy) with the engineering shear.
    """

    young: Floats
    poisson: Floats
    cells: NDArray[np.intp]
    excess: Floats


def elements_of(tissue: Tissue, grid: RegularGrid) -> Elements:
    """Return the material of every cell of a mesh, x fastest."""
    count = (grid.shape[0] - 1) * (grid.shape[1] - 1)
    if tissue.homogeneous:
        young, poisson = tissue.in_cells(grid)
        return Elements(young, poisson, np.empty(0, dtype=np.intp), np.empty((0, 3, 3)))
    E, nu = tissue.sampled(grid, np.arange(count), SEARCH)
    young, poisson = E[:, 0].copy(), nu[:, 0].copy()
    cells = np.flatnonzero(((E[:, :1] != E) | (nu != nu[:, :1])).any(axis=1))
    E, nu = tissue.sampled(grid, cells, SAMPLES)
    young[cells] = 1.0 / (1.0 / E).mean(axis=1)
    poisson[cells] = young[cells] * (nu / E).mean(axis=1)
    layered = laminate(E, nu, normals(E, grid.spacing), tissue.plane)
    return Elements(young, poisson, cells, layered - isotropic(young[cells], poisson[cells], tissue.plane))


def isotropic(young: Floats, poisson: Floats, plane: Plane) -> Floats:
    """Elasticity of isotropic material, equation (19), shape (..., 3, 3), kPa."""
    lam, mu = lame(young, poisson, plane)
    D = np.zeros((*lam.shape, 3, 3))
    D[..., 0, 0] = D[..., 1, 1] = lam + 2 * mu
    D[..., 0, 1] = D[..., 1, 0] = lam
    D[..., 2, 2] = mu
    return D


def normals(young: Floats, spacing: tuple[float, float]) -> Floats:
    """Unit normals (c, 2) of the boundaries in cells, from samples (c, s^2) of their moduli.

    The first moment of log E points across a boundary. It vanishes for a layer in the middle of a cell; the second moments
    give the direction there.
    """
    s = round(young.shape[1] ** 0.5)
    offset = (np.arange(s) + 0.5) / s - 0.5
    place = np.stack(np.meshgrid(offset * spacing[0], offset * spacing[1]), axis=-1).reshape(-1, 2)
    deviation = np.log(young) - np.log(young).mean(axis=1, keepdims=True)
    first = deviation @ place
    size = np.hypot(first[:, 0], first[:, 1])
    values, vectors = np.linalg.eigh(np.einsum("cs,si,sj->cij", deviation, place, place))
    strongest = np.abs(values).argmax(axis=1)
    across: Floats = vectors[np.arange(len(young)), :, strongest]
    tilted = size > TILTED * np.abs(deviation) @ np.hypot(*place.T)
    across[tilted] = first[tilted] / size[tilted, None]
    return across


def laminate(young: Floats, poisson: Floats, normal: Floats, plane: Plane) -> Floats:
    """Elasticity (c, 3, 3) in kPa of cells made of equal layers (c, m) stacked along their normals (c, 2).

    In the axes of the layers (n across, s along), stresses nn and ns and the strain ss are common to all layers.
    """
    D = isotropic(young, poisson, plane)
    common, along = [0, 2], [1]
    nn, ns, ss = D[..., common, :][..., common], D[..., common, :][..., along], D[..., along, :][..., along]
    inverse = np.linalg.inv(nn)
    P = np.linalg.inv(inverse.mean(axis=1))
    Q = (inverse @ ns).mean(axis=1)
    R = (ss - ns.swapaxes(-1, -2) @ inverse @ ns).mean(axis=1)
    L = np.zeros((len(young), 3, 3))
    L[:, [[0], [2]], common] = P
    L[:, common, 1] = L[:, 1, common] = (P @ Q)[..., 0]
    L[:, 1, 1] = (R + Q.swapaxes(-1, -2) @ P @ Q)[:, 0, 0]
    c, s = normal[:, 0], normal[:, 1]
    turn = np.array([[c * c, s * s, c * s], [s * s, c * c, -c * s], [-2 * c * s, 2 * c * s, c * c - s * s]])
    turn = np.moveaxis(turn, -1, 0)  # strains (xx, yy, xy) to (nn, ss, ns)
    turned: Floats = turn.swapaxes(-1, -2) @ L @ turn
    return turned
