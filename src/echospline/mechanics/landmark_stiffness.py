"""Heterogeneous tissue for splines: how firmly a landmark in tissue of some modulus holds its displacement."""

from __future__ import annotations

import numpy as np

from echospline.mechanics.anchored_kernel import AnchoredKernel
from echospline.mechanics.kernels import Kernel
from echospline.mechanics.landmarks import Anchors
from echospline.scene import Floats, RegularGrid, SpatialGrid, Tissue


def landmark_stiffness(
    tissue: Tissue, grid: RegularGrid | SpatialGrid, kernel: Kernel, anchors: Anchors
) -> Floats:
    """Stiffness per mesh node of an approximating spline, from Young's modulus there.

    A needle that pushes with the same force moves tissue in inverse proportion to its modulus. For one landmark alone
    the spline moves by G / (G + 16 pi / k) of what is asked, with G its own response under the anchors; this is
    E_min / E for 16 pi / k = G (E / E_min - 1). Where the tissue is softest the landmark interpolates. G is the mean over the
    components: near a sliding edge one of them answers more than the other.

    Parameters
    ----------
    tissue : Tissue
        Young's modulus per region.
    grid : RegularGrid
        Mesh; a node in its clamped edges interpolates.
    kernel : Kernel
        Of the spline.
    anchors : Anchors
        From `Clamps.anchors`.

    Returns
    -------
    ndarray, shape (n,)
        For `TPSModel`: thin plate 1/mm^2, elastic relative to the shear modulus; infinite where E is least.
    """
    young, _ = tissue.at(grid.nodes)
    excess = young / young.min() - 1.0
    stiffness = np.full(grid.size, np.inf)
    stiff = np.flatnonzero(excess > 0)
    if not len(stiff):
        return stiffness
    scene = AnchoredKernel.factor(kernel, anchors.places, grid.nodes[:1], held=anchors.held)
    c, unit = scene.components, scene.scale**kernel.length_power
    for i in stiff:
        x = scene.conditioned(grid.nodes[i : i + 1])
        own = abs(float(np.trace(scene.between(x, x)))) / c * unit
        if own > 0:  # a node on an anchor cannot move at all
            stiffness[i] = kernel.per_spring / (own * excess[i])
    return stiffness
