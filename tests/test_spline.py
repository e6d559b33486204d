"""The spline: equations (2) to (9), both kernels in the plane and in space, exact and approximating."""

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

PLATES = [ThinPlate(), ThinPlate(dimension=3)]
SOLIDS = [
    Elastic(0.45, 1.5),
    Elastic(0.3, 0.7, "strain"),
    Elastic(0.45, 1.5, dimension=3),
    Elastic(0.5, 0.7, dimension=3),
]
KERNELS = [*PLATES, *SOLIDS]


def scattered(m: int = 40, seed: int = 1, dimension: int = 2) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 40, (m, dimension)), rng.normal(0, 1, (m, dimension))


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
def test_landmarks_reach_their_targets(kernel):
    points, d = scattered(dimension=kernel.dimension)
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


def test_thin_plate_in_space_equals_scipy():
    points, d = scattered(60, dimension=3)
    x = np.random.default_rng(2).uniform(-5, 45, (500, 3))
    theirs = RBFInterpolator(points, d, kernel="linear", degree=1)(x)
    np.testing.assert_allclose(factor(ThinPlate(dimension=3), points).solve(d)(x), theirs, atol=1e-8)


def test_approximating_thin_plate_in_space_equals_scipy_smoothing():
    # scipy's linear kernel is -r, too; a spring of stiffness k adds 8 pi / k
    points, d = scattered(60, dimension=3)
    x = np.random.default_rng(3).uniform(0, 40, (200, 3))
    smoothing = np.random.default_rng(4).uniform(0.1, 20, 60)
    theirs = RBFInterpolator(points, d, kernel="linear", degree=1, smoothing=smoothing)(x)
    ours = factor(ThinPlate(dimension=3), points, stiffness=8 * np.pi / smoothing).solve(d)(x)
    np.testing.assert_allclose(ours, theirs, atol=1e-8)


@pytest.mark.parametrize("kernel", PLATES, ids=repr)
def test_affine_motion_is_reproduced(kernel):
    D = kernel.dimension
    points, _ = scattered(dimension=D)
    x = np.random.default_rng(5).uniform(-50, 90, (100, D))
    A = np.array([[0.1, -0.2, 0.15], [0.05, 0.3, -0.1], [0.2, 0.0, -0.3]])[:D, :D]
    b = np.array([1.0, -2.0, 0.5])[:D]
    np.testing.assert_allclose(factor(kernel, points).solve(points @ A.T + b)(x), x @ A.T + b, atol=1e-9)


@pytest.mark.parametrize("kernel", SOLIDS, ids=repr)
def test_rigid_motion_is_reproduced(kernel):
    D = kernel.dimension
    points, _ = scattered(dimension=D)
    x = np.random.default_rng(5).uniform(-50, 90, (100, D))
    turn = np.array([[0.0, -0.1, 0.2], [0.1, 0.0, -0.3], [-0.2, 0.3, 0.0]])[:D, :D]

    def move(p):
        return p @ turn.T + np.array([1.0, -2.0, 0.5])[:D]

    np.testing.assert_allclose(factor(kernel, points).solve(move(points))(x), move(x), atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
def test_gradient_equals_central_differences(kernel):
    D = kernel.dimension
    points, d = scattered(dimension=D)
    spline = factor(kernel, points).solve(d)
    x, h = np.random.default_rng(6).uniform(0, 40, (50, D)), 1e-5
    numeric = np.stack([(spline(x + h * e) - spline(x - h * e)) / (2 * h) for e in np.eye(D)], axis=-1)
    np.testing.assert_allclose(spline.gradient(x), numeric, atol=1e-7 * np.abs(numeric).max())


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
@pytest.mark.parametrize("stiffness", [np.inf, 2.0])
def test_change_of_unit_and_origin_changes_nothing(kernel, stiffness):
    D = kernel.dimension
    points, d = scattered(dimension=D)
    x = np.random.default_rng(7).uniform(0, 40, (50, D))
    metres = kernel if isinstance(kernel, ThinPlate) else kernel.scaled(1000.0)
    firm = stiffness * 1000.0**kernel.length_power
    here = factor(kernel, points, stiffness).solve(d)(x)
    there = factor(metres, points / 1000 + 7, firm).solve(d / 1000)(x / 1000 + 7)
    np.testing.assert_allclose(there * 1000, here, atol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS, ids=repr)
def test_other_interpolants_bend_more(kernel):
    # the spline minimises its energy: adding landmarks that it misses can only raise it
    D = kernel.dimension
    points, d = scattered(30, dimension=D)
    extra, e = scattered(5, seed=9, dimension=D)
    assert factor(kernel, np.vstack([points, extra])).solve(np.vstack([d, e])).energy() > 0
    fewer = factor(kernel, points).solve(d)
    same = factor(kernel, np.vstack([points, extra])).solve(np.vstack([d, fewer(extra)]))
    x = np.random.default_rng(8).uniform(0, 40, (50, D))
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


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])
def test_elastic_kernel_in_space_becomes_kelvins_solution(nu):
    # u = ((3 - 4 nu) f / r + x (x . f) / r^3) / (16 pi mu (1 - nu)); 16 pi mu is in the weights
    rng = np.random.default_rng(12)
    x, f = rng.normal(0, 3, (40, 3)), rng.normal(0, 1, 3)
    r = np.linalg.norm(x, axis=1)[:, None]
    kelvin = ((3 - 4 * nu) * f / r + x * (x @ f)[:, None] / r**3) / (1 - nu)
    errors = []
    for radius in (0.1, 0.05):
        u = (Elastic(nu, radius, dimension=3).matrix(x, np.zeros((1, 3))) @ f).reshape(3, -1).T
        errors.append(np.abs(u - kelvin).max())
    assert 1.8 < np.log2(errors[0] / errors[1]) < 2.2
    exact = (Elastic(nu, 1e-9, dimension=3).matrix(x, np.zeros((1, 3))) @ f).reshape(3, -1).T
    np.testing.assert_allclose(exact, kelvin, rtol=1e-12)


def strain_of(kernel, x, f):
    gradient = (kernel.gradient(x, np.zeros((1, 3))) @ f).reshape(3, 3, -1).transpose(2, 1, 0)
    return 0.5 * (gradient + gradient.transpose(0, 2, 1))


def test_incompressible_kernel_in_space_has_no_divergence():
    x, f = np.random.default_rng(13).normal(0, 2, (50, 3)), np.array([0.3, -1.0, 0.5])
    strain = strain_of(Elastic(0.5, 0.7, dimension=3), x, f)
    assert np.abs(np.trace(strain, axis1=1, axis2=2)).max() < 1e-14
    compressible = strain_of(Elastic(0.3, 0.7, dimension=3), x, f)
    assert np.abs(np.trace(compressible, axis1=1, axis2=2)).max() > 1e-2


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_tractions_on_a_sphere_balance_the_force(nu):
    # sigma = 2 mu (strain + nu / (1 - 2 nu) tr(strain) I); the blob's share of the force inside radius r is that of its density
    # 15 e^4 / (8 pi (r^2 + e^2)^(7/2)), r^3 (2 r^2 + 5 e^2) / (2 (r^2 + e^2)^(5/2))
    kernel, f = Elastic(nu, 0.8, dimension=3), np.array([0.3, -1.0, 0.5])
    z, weight = np.polynomial.legendre.leggauss(12)
    angle = np.arange(24) * 2 * np.pi / 24
    rho = np.sqrt(1 - z**2)
    normal = np.stack(
        [np.outer(np.cos(angle), rho), np.outer(np.sin(angle), rho), np.outer(np.ones(24), z)], axis=-1
    ).reshape(-1, 3)
    area = np.tile(weight, 24) * 2 * np.pi / 24
    for r in (0.5, 1.7, 6.0):
        strain = strain_of(kernel, r * normal, f) / (16 * np.pi)  # mu = 1
        stress = 2 * strain + 2 * nu / (1 - 2 * nu) * np.trace(strain, axis1=1, axis2=2)[
            :, None, None
        ] * np.eye(3)
        total = r**2 * np.einsum("i,ijk,ik->j", area, stress, normal)
        s = r**2 + 0.8**2
        np.testing.assert_allclose(total, -f * r**3 * (2 * r**2 + 5 * 0.8**2) / (2 * s**2.5), atol=1e-10)


@pytest.mark.parametrize("kernel", PLATES, ids=repr)
def test_softer_landmarks_are_missed_more(kernel):
    points, d = scattered(dimension=kernel.dimension)
    misfit = [np.abs(factor(kernel, points, k).solve(d)(points) - d).max() for k in (1e6, 10.0, 1.0, 0.1)]
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


CUBE = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)


@pytest.mark.parametrize(
    ("kernel", "points", "reason"),
    [
        (ThinPlate(dimension=3), CUBE[:3], "at least 4"),
        (ThinPlate(dimension=3), CUBE[:4], "in one plane"),
        (Elastic(dimension=3), CUBE[:2], "at least 3"),
        (Elastic(dimension=3), np.outer(np.arange(5.0), [1, 2, 3]), "on one line"),
        (Elastic(dimension=3), [*CUBE, CUBE[5]], r"landmarks 5 and 8 coincide at \(1, 0, 1\) mm"),
        (Elastic(dimension=3), np.zeros((4, 2)), r"shape \(n, 3\)"),
        (ThinPlate(), CUBE, r"shape \(n, 2\)"),
    ],
)
def test_degenerate_landmarks_in_space_are_refused_with_the_reason(kernel, points, reason):
    with pytest.raises(InputError, match=reason):
        factor(kernel, points)


def test_a_kernel_of_another_dimension_is_refused():
    for kernel in (ThinPlate, Elastic):
        with pytest.raises(InputError, match="dimension of a kernel is 2"):
            kernel(dimension=4)
    with pytest.raises(InputError, match=r"\[0, 0.5\]; got 0.6"):
        Elastic(0.6, dimension=3)


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
