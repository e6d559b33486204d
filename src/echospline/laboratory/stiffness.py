"""The stiffness of a volume whose tissue is known, as the tissue models take it."""

from __future__ import annotations

import numpy as np

from echospline.laboratory.kidney_recipe import LabelledTissue
from echospline.scene import Region, SpatialGrid, Tissue, VolumeLabel

FLUIDS = ("urine", "blood")
"""Kinds that are fluid: nearly incompressible, and bearing no needle."""
FLUID_POISSON = 0.49


def tissue_of(known: LabelledTissue, poisson: float = 0.45) -> Tissue:
    """Return the tissue with one region for every kind that the volume holds.

    Parameters
    ----------
    known : LabelledTissue
        Labels of the voxels, and Young's modulus of each kind.
    poisson : float
        Poisson's ratio of what is solid; fluids take `FLUID_POISSON` where that is more.
    """
    labels = known.labels
    grid = SpatialGrid(labels.shape, labels.spacing, labels.origin)
    values = np.asarray(labels.voxels, dtype=np.uint8)
    counts = np.bincount(values.ravel(), minlength=len(known.kinds))
    regions = [
        Region(
            VolumeLabel(values, grid, value), kind.young,
            max(poisson, FLUID_POISSON) if kind.name in FLUIDS else poisson, kind.name, kind.name in FLUIDS,
        )
        for value, kind in enumerate(known.kinds) if counts[value]
    ]  # fmt: skip
    return Tissue(known.kinds[int(counts.argmax())].young, poisson, regions)
