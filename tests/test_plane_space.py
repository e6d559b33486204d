"""A plane against space: what the study says of plane models when tissue is a block."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from echospline.study.plane_space import SPACE_SCENES, best_factor, plane_space_rows

NODES = (40, 30)


def rows(scene, cell=5.0):
    index = [s.name for s in SPACE_SCENES].index(scene)
    found = plane_space_rows(scene=index, nodes=NODES, cell=cell)["rows"]
    return {row["model"]: row for row in found}


@pytest.fixture(scope="module")
def slab():
    return rows("40 mm thick, front and back free")


def test_a_slab_moves_as_another_library_says(slab):
    # benchmarks/slab.py: 27-node hexahedra of scikit-fem without any closed form, entry moved by half the width
    for plane, moves, factor, error in (("stress", 57, 40 / 26, 32), ("strain", 29, 40 / 13, 36)):
        row = slab[f"plane {plane}"]
        assert row["moves_percent"] == pytest.approx(moves, abs=1.5)
        assert row["best_factor"] == pytest.approx(factor, rel=0.04)
        assert row["error_with_factor_percent"] == pytest.approx(error, abs=1)


def test_a_needle_in_the_plane_moves_nothing_out_of_it_and_one_aside_does(slab):
    assert slab["plane stress"]["out_of_plane_percent"] < 1e-6
    aside = rows("walls clamped, needle 4 mm beside the plane")
    assert 20 < aside["plane stress"]["out_of_plane_percent"] < 45


def test_green_in_space_is_far_closer_than_any_plane(slab):
    turned = rows("walls clamped, needle turned 30 degrees out of the plane")
    for found, most in ((slab, 6.0), (turned, 3.5)):
        ours = found["green in space"]["error_percent"]
        assert ours < most
        for plane in ("plane stress", "plane strain"):
            assert found[plane]["error_with_factor_percent"] > 5 * ours


def test_no_other_factor_is_closer():
    rng = np.random.default_rng(0)
    for scale in (0.02, 1.0, 40.0):
        u = rng.normal(size=(60, 2))
        truth = scale * (u + rng.normal(size=(60, 2)))
        found = minimize_scalar(
            lambda f, u=u, truth=truth: np.linalg.norm(f * u - truth, axis=1).sum(),
            bounds=(0, 3 * scale),
            method="bounded",
            options={"xatol": 1e-9 * scale},
        )
        assert best_factor(u, truth) == pytest.approx(found.x, rel=1e-4)
