"""The kernel with its anchors built in, against a spline refitted from all its landmarks (Algorithm 1)."""

from __future__ import annotations

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.mechanics import AnchoredKernel, Elastic, Kernel, ThinPlate
from echospline.mechanics.spline import factor
from echospline.scene import Floats, RegularGrid

GRID = RegularGrid((17, 13), (2.0, 2.0))
ANCHORS = GRID.nodes[GRID.boundary(("left", "right", "bottom"))]
INNER = np.setdiff1d(np.arange(GRID.size), GRID.boundary(("left", "right", "bottom", "top")))
KERNELS = [ThinPlate(), Elastic(0.45, 1.5)]


def weights(scene: AnchoredKernel, points: Floats, q: Floats, soft: Floats | None = None) -> Floats:
    """Weights of landmarks at conditioned points that give them the displacements q."""
    gram, right = scene.between(points, points), q if scene.components == 1 else q.reshape(-1, 1)
    if soft is not None:
        gram = gram + np.diag(np.repeat(scene.compliance(soft), scene.components))
    return np.linalg.solve(gram, right)


def refit(q: Floats, landmarks: Floats, kernel: Kernel, stiffness: Floats | None = None):
    places, moves = np.vstack([ANCHORS, landmarks]), np.vstack([np.zeros_like(ANCHORS), q])
    return factor(kernel, places, stiffness).solve(moves)


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
def test_fields_are_those_of_a_refitted_spline(kernel):
    rng, scene = np.random.default_rng(3), AnchoredKernel.factor(kernel, ANCHORS, GRID.nodes)
    for _ in range(20):
        chosen = rng.choice(INNER, size=int(rng.integers(1, 14)), replace=False)
        landmarks = np.vstack([GRID.nodes[chosen], rng.uniform([4, 2], [28, 20], (1, 2)) + 0.01])
        q, points = rng.normal(size=(len(landmarks), 2)), scene.conditioned(landmarks)
        w, expected = weights(scene, points, q), refit(q, landmarks, kernel)
        field = w.T @ scene.rows(points)
        on_mesh = field.T if scene.components == 1 else field.reshape(2, -1).T
        largest = max(1.0, float(np.abs(q).max()), float(np.abs(on_mesh).max()))
        assert np.abs(on_mesh - expected(GRID.nodes)).max() < 1e-8 * largest
        anywhere = rng.uniform([0, 0], [32, 24], size=(20, 2))
        assert np.abs(scene.spline(points, w)(anywhere) - expected(anywhere)).max() < 1e-8 * largest


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
def test_stiffness_of_anchors_and_landmarks_is_that_of_the_spline(kernel):
    rng = np.random.default_rng(4)
    held, soft = rng.uniform(0.5, 5.0, len(ANCHORS)), rng.uniform(0.5, 5.0, 6)
    scene = AnchoredKernel.factor(kernel, ANCHORS, GRID.nodes, held)
    landmarks, q = GRID.nodes[rng.choice(INNER, 6, replace=False)], rng.normal(size=(6, 2))
    points = scene.conditioned(landmarks)
    found = scene.spline(points, weights(scene, points, q, soft))(GRID.nodes)
    expected = refit(q, landmarks, kernel, np.concatenate([held, soft]))(GRID.nodes)
    assert np.abs(found - expected).max() < 1e-9


def test_anchors_on_one_line_are_refused_with_the_way_out():
    line = GRID.nodes[GRID.boundary(("bottom",))]
    with pytest.raises(InputError, match='solver "refit"'):
        AnchoredKernel.factor(ThinPlate(), line, GRID.nodes)
