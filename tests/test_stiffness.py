"""The stiffness of a volume that knows its tissues, as the tissue models take it."""

from __future__ import annotations

import numpy as np
import pytest

from echospline.laboratory.kidney_recipe import TISSUES, LabelledTissue
from echospline.laboratory.stiffness import FLUIDS, tissue_of
from echospline.mechanics import NeedleForces
from echospline.mechanics.spread import least_near, radius_for, softest
from echospline.scene import Region, SpatialGrid, Sphere, Tissue, Volume


@pytest.fixture
def known():
    labels = np.random.default_rng(5).integers(0, len(TISSUES), (7, 8, 9)).astype(np.uint8)
    labels[labels == 3] = 9  # one kind is not there
    return LabelledTissue(Volume(labels, (0.5, 0.4, 1.5), (-2.0, 0.0, -4.5)), TISSUES)


def test_every_voxel_has_the_modulus_of_its_label(known):
    tissue = tissue_of(known, 0.4)
    z, y, x = (axis.ravel() for axis in np.indices(known.labels.voxels.shape))
    points = np.stack([x, y, z], axis=1) * known.labels.spacing + known.labels.origin
    young, poisson = tissue.at(points)
    np.testing.assert_array_equal(young, known.young_at(points))
    fluid = np.isin(known.label_at(points), [i for i, k in enumerate(TISSUES) if k.name in FLUIDS])
    np.testing.assert_array_equal(poisson, np.where(fluid, 0.49, 0.4))
    assert {r.name for r in tissue.regions} == {k.name for k in TISSUES} - {"perirenal fat"}


def test_a_force_is_spread_for_the_softest_solid_and_not_for_fluid(known):
    tissue = tissue_of(known)
    assert softest(tissue) == 4.0  # fat; urine has 0.5 and blood 2
    assert least_near(tissue) == 4.0
    grid = SpatialGrid((5, 5, 5), (15.0, 15.0, 15.0), (-30.0, 0.0, -30.0))
    forces = NeedleForces()
    assert radius_for(forces, tissue, grid) == radius_for(forces, Tissue(4.0), grid)
    soft = Tissue(10.0, 0.45, [Region(Sphere((0.0, 20.0, 0.0), 5.0), 5.0)])
    assert least_near(soft) == 0.0
    assert softest(soft) == 5.0
