"""The closed forms in space obey elasticity, their surfaces' conditions and their limits."""

import numpy as np
import pytest

from echospline.mechanics.half_space import gradient, kelvinlet, tractions

RNG = np.random.default_rng(5)
SOURCES = np.column_stack([RNG.uniform(-10, 10, 6), RNG.uniform(2, 12, 6), RNG.uniform(-10, 10, 6)])
POINTS = np.column_stack([RNG.uniform(-15, 15, 40), RNG.uniform(0.5, 20, 40), RNG.uniform(-15, 15, 40)])
SURFACE = POINTS * [1.0, 0.0, 1.0]
every_nu = pytest.mark.parametrize("nu", [0.0, 0.3, 0.45, 0.49])
every_top = pytest.mark.parametrize("top", [None, "free", "sliding"])


@every_nu
@every_top
@pytest.mark.parametrize("radius", [0.0, 0.7])
def test_the_field_is_in_equilibrium_with_the_spread_force(nu, top, radius):
    # mu (laplace u + grad div u / (1 - 2 nu)) = - body force; the Kelvinlet's is 15 e^4 / (8 pi r^7) f, times 16 pi mu (1 - nu)
    h = 1e-3

    def second(i, j):  # fourth-order difference of an exact first derivative
        e = h * np.eye(3)[j]
        g = [gradient(POINTS + k * e, SOURCES, nu, radius, top)[..., i] for k in (-2, -1, 1, 2)]
        return (g[0] - 8 * g[1] + 8 * g[2] - g[3]) / (12 * h)

    H = np.array([[second(i, j) for j in range(3)] for i in range(3)])
    laplace = H[0, 0] + H[1, 1] + H[2, 2]
    grad_div = np.stack([sum(H[i, k][:, k] for k in range(3)) for i in range(3)], axis=1)
    r2 = ((POINTS[:, None] - SOURCES) ** 2).sum(-1) + radius**2
    force = 16 * np.pi * (1 - nu) * 15 * radius**4 / (8 * np.pi * r2**3.5)
    if top == "sliding":  # the image is spread as well
        mirror = SOURCES * [1, -1, 1]
        R2 = ((POINTS[:, None] - mirror) ** 2).sum(-1) + radius**2
        image = 16 * np.pi * (1 - nu) * 15 * radius**4 / (8 * np.pi * R2**3.5)
    residual = laplace + grad_div / (1 - 2 * nu)
    for i in range(3):
        residual[:, i, :, i] += force
        if top == "sliding":
            residual[:, i, :, i] += image * (-1 if i == 1 else 1)
    assert np.abs(residual).max() < 1e-9 * np.abs(H).max() / (1 - 2 * nu)


@every_nu
def test_a_free_surface_carries_no_traction(nu):
    down = np.tile([0.0, -1.0, 0.0], (len(SURFACE), 1))
    with_image = tractions(gradient(SURFACE, SOURCES, nu, top="free"), down, nu)
    without = tractions(gradient(SURFACE, SOURCES, nu), down, nu)
    assert np.abs(with_image).max() < 1e-12 * np.abs(without).max()


@every_nu
def test_a_sliding_surface_does_not_move_along_its_normal_nor_shear(nu):
    u = kelvinlet(SURFACE, SOURCES, nu, 0.7, "sliding")
    down = np.tile([0.0, -1.0, 0.0], (len(SURFACE), 1))
    t = tractions(gradient(SURFACE, SOURCES, nu, 0.7, "sliding"), down, nu)
    assert np.abs(u[:, 1]).max() < 1e-14 * np.abs(u).max()
    assert np.abs(t[:, [0, 2]]).max() < 1e-12 * np.abs(t).max()


@every_nu
@every_top
def test_displacement_is_reciprocal(nu, top):
    # by Betti: what a force at A does at B along any direction, the same force at B does at A
    there = kelvinlet(POINTS, SOURCES, nu, top=top)
    back = kelvinlet(SOURCES, POINTS, nu, top=top)
    np.testing.assert_allclose(there, back.transpose(2, 3, 0, 1), rtol=1e-9, atol=1e-12)


@every_nu
def test_shallow_sources_give_boussinesq_s_and_cerruti_s_surfaces(nu):
    # surface displacement by a normal force P: (1 - nu) P / (2 pi mu r) along it (Boussinesq); by a tangential force along x,
    # along x: P (1 - nu + nu x^2 / r^2) / (2 pi mu r) (Cerruti); K. L. Johnson, Contact Mechanics, 1985, chapter 3
    source = np.array([[0.0, 1e-7, 0.0]])
    u = kelvinlet(SURFACE, source, nu, top="free")[:, :, 0] / (16 * np.pi * (1 - nu))
    r = np.hypot(SURFACE[:, 0], SURFACE[:, 2])
    np.testing.assert_allclose(u[:, 1, 1], (1 - nu) / (2 * np.pi * r), rtol=1e-6)
    cosine = SURFACE[:, 0] / r
    np.testing.assert_allclose(u[:, 0, 0], (1 - nu + nu * cosine**2) / (2 * np.pi * r), rtol=1e-6)


@every_nu
def test_a_deep_source_does_not_feel_the_surface(nu):
    down = np.array([0.0, 1e6, 0.0])
    deep, near = SOURCES + down, POINTS + down
    for top in ("free", "sliding"):
        np.testing.assert_allclose(
            kelvinlet(near, deep, nu, 0.7, top), kelvinlet(near, deep, nu, 0.7), rtol=0, atol=1e-5
        )


def test_a_sliding_half_space_is_half_of_a_space_with_two_forces():
    force = np.array([0.3, -0.8, 0.5])
    half = kelvinlet(POINTS, SOURCES, 0.45, 0.7, "sliding") @ force
    whole = kelvinlet(POINTS, SOURCES, 0.45, 0.7) @ force
    whole += kelvinlet(POINTS, SOURCES * [1, -1, 1], 0.45, 0.7) @ (force * [1, -1, 1])
    np.testing.assert_allclose(half, whole, rtol=1e-12, atol=1e-14)
