"""The spline: equations (2) to (9), both kernels, exact and approximating."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.interpolate import RBFInterpolator

from echospline.errors import EchosplineError, InputError
from echospline.mechanics import Elastic, ThinPlate
from echospline.mechanics.spline import factor

KERNELS = [ThinPlate(), Elastic(0.45, 1.5), Elastic(0.3, 0.7, "strain")]


def scattered(m: int = 40, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 40, (m, 2)), rng.normal(0, 1, (m, 2))


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
def test_landmarks_reach_their_targets(kernel):
    points, d = scattered()
    np.testing.assert_allclose(factor(kernel, points).solve(d)(points), d, atol=1e-9)


def test_thin_plate_equals_scipy():
    points, d = scattered(60)
    x = np.random.default_rng(2).uniform(-5, 45, (500, 2))
    theirs = RBFInterpolator(points, d, kernel="thin_plate_spline")(x)
    np.testing.assert_allclose(factor(ThinPlate(), points).solve(d)(x), theirs, atol=1e-8)


def test_approximating_thin_plate_equals_scipy_smoothing():
    # scipy adds `smoothing` to r^2 log r; ours is r^2 log r^2, twice that
    points, d = scattered(60)
    x = np.random.default_rng(3).uniform(0, 40, (200, 2))
    smoothing = np.random.default_rng(4).uniform(0.1, 20, 60)
    theirs = RBFInterpolator(points, d, kernel="thin_plate_spline", smoothing=smoothing)(x)
    ours = factor(ThinPlate(), points, stiffness=16 * np.pi / (2 * smoothing)).solve(d)(x)
    np.testing.assert_allclose(ours, theirs, atol=1e-8)


def test_affine_motion_is_reproduced():
    points, _ = scattered()
    x = np.random.default_rng(5).uniform(-50, 90, (100, 2))
    A, b = np.array([[0.1, -0.2], [0.05, 0.3]]), np.array([1.0, -2.0])
    np.testing.assert_allclose(factor(ThinPlate(), points).solve(points @ A.T + b)(x), x @ A.T + b, atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS[1:], ids=repr)
def test_rigid_motion_is_reproduced(kernel):
    points, _ = scattered()
    x = np.random.default_rng(5).uniform(-50, 90, (100, 2))

    def rotate(p):
        return 0.1 * np.column_stack([-p[:, 1], p[:, 0]]) + [1.0, -2.0]

    np.testing.assert_allclose(factor(kernel, points).solve(rotate(points))(x), rotate(x), atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
def test_gradient_equals_central_differences(kernel):
    points, d = scattered()
    spline = factor(kernel, points).solve(d)
    x, h = np.random.default_rng(6).uniform(0, 40, (50, 2)), 1e-5
    numeric = np.stack([(spline(x + h * e) - spline(x - h * e)) / (2 * h) for e in np.eye(2)], axis=-1)
    np.testing.assert_allclose(spline.gradient(x), numeric, atol=1e-7 * np.abs(numeric).max())


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
def test_change_of_unit_and_origin_changes_nothing(kernel):
    points, d = scattered()
    x = np.random.default_rng(7).uniform(0, 40, (50, 2))
    metres = kernel if isinstance(kernel, ThinPlate) else kernel.scaled(1000.0)
    here = factor(kernel, points).solve(d)(x)
    there = factor(metres, points / 1000 + 7).solve(d / 1000)(x / 1000 + 7)
    np.testing.assert_allclose(there * 1000, here, atol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
def test_other_interpolants_bend_more(kernel):
    # the spline minimises its energy: adding landmarks that it misses can only raise it
    points, d = scattered(30)
    extra, e = scattered(5, seed=9)
    assert factor(kernel, np.vstack([points, extra])).solve(np.vstack([d, e])).energy() > 0
    fewer = factor(kernel, points).solve(d)
    same = factor(kernel, np.vstack([points, extra])).solve(np.vstack([d, fewer(extra)]))
    x = np.random.default_rng(8).uniform(0, 40, (50, 2))
    np.testing.assert_allclose(same(x), fewer(x), atol=1e-7)


def test_elastic_kernel_solves_the_equations_of_elasticity():
    # Navier-Cauchy away from the force: (1 - 2 nu) lap(u) + grad(div u) = 0, plane strain, radius -> 0
    nu, h = 0.3, 1e-3
    kernel = Elastic(nu, 1e-9, "strain")
    stencil = np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=float) * h + [1.3, 0.7]
    for f in (0, 1):
        u = kernel.matrix(stencil, np.zeros((1, 2)))[:, f].reshape(2, 3, 3)
        dxx = (u[:, 2, 1] - 2 * u[:, 1, 1] + u[:, 0, 1]) / h**2
        dyy = (u[:, 1, 2] - 2 * u[:, 1, 1] + u[:, 1, 0]) / h**2
        dxy = (u[:, 2, 2] - u[:, 2, 0] - u[:, 0, 2] + u[:, 0, 0]) / (4 * h**2)
        lap, grad_div = dxx + dyy, np.array([dxx[0] + dxy[1], dxy[0] + dyy[1]])
        np.testing.assert_allclose((1 - 2 * nu) * lap + grad_div, 0, atol=1e-4 * np.abs(dxx).max())


def test_softer_landmarks_are_missed_more():
    points, d = scattered()
    misfit = [
        np.abs(factor(ThinPlate(), points, k).solve(d)(points) - d).max() for k in (1e6, 10.0, 1.0, 0.1)
    ]
    assert misfit == sorted(misfit)
    assert misfit[0] < 1e-2 < misfit[-1]


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((0, 2)), "at least 3"),
        ([[0, 0], [1, 1]], "at least 3"),
        ([[0, 0], [1, 1], [2, 2], [3, 3]], "one line"),
        ([[0, 0], [1, 0], [0, 1], [1, 0]], "landmarks 1 and 3 coincide at \\(1, 0\\) mm"),
        ([[0, 0], [1, 0], [0, np.nan]], "finite"),
        ([0.0, 1.0, 2.0], r"shape \(n, 2\)"),
    ],
)
def test_degenerate_landmarks_are_refused_with_the_reason(points, reason):
    with pytest.raises(InputError, match=reason):
        factor(ThinPlate(), points)


def test_wrong_number_of_displacements_is_refused():
    points, d = scattered()
    with pytest.raises(InputError, match="40 landmarks, 39 displacements"):
        factor(ThinPlate(), points).solve(d[:-1])


@example(np.array([[0.0, 8.98846567e307]] * 3 + [[8.98846567e307, -8.98846567e307]] * 3))
@given(arrays(np.float64, (6, 2), elements=st.floats(allow_nan=True, allow_infinity=True, width=64)))
def test_any_landmarks_are_fitted_or_refused(points):
    d = np.arange(12.0).reshape(6, 2) / 12
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            fitted = factor(ThinPlate(), points).solve(d)
        except EchosplineError:
            return
        np.testing.assert_allclose(fitted(points), d, atol=1e-6)
