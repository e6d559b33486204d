"""Neo-Hookean tissue against closed forms, its own energy, and linear elasticity under small loads."""

import numpy as np
import pytest
from scipy.optimize import brentq

from echospline.errors import InputError, SolverError
from echospline.mechanics import Clamps, FEMModel, NeedleForces, NeoHookeanModel
from echospline.mechanics.fem_response import FEMResponse
from echospline.mechanics.finite_elements import line_loads, point_loads
from echospline.mechanics.neo_hookean import NeoHookean, thickening
from echospline.scenario import build_model, validated
from echospline.scene import Circle, Insertion, Region, RegularGrid, Tissue

GRID = RegularGrid((9, 7), (1.5, 2.0))  # 12 x 12 mm
HEIGHT, THICKNESS, E = 12.0, 5.0, 10.0
BOX = ("left", "right", "bottom")
LESION = [Region(Circle((6.2, 5.3), 3.1), 40.0, 0.3)]


def tissue(nu=0.45, plane="stress", regions=()):
    return Tissue(E, nu, regions, THICKNESS, plane)


def material(nu=0.45, plane="stress", regions=(), clamped=BOX, sliding=(), grid=GRID, solver="cholmod"):
    return NeoHookean(
        grid, Clamps.of(grid, clamped, None, sliding), tissue(nu, plane, regions), solver=solver
    )


def stress(F, nu):
    """First Piola-Kirchhoff stress in kPa of a 3 x 3 deformation gradient, by the law in space."""
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    inverse = np.linalg.inv(F).T
    return mu * (F - inverse) + lam * np.log(np.linalg.det(F)) * inverse


@pytest.mark.parametrize("stretch", [0.8, 1.2, 1.8])
@pytest.mark.parametrize("plane", ["stress", "strain"])
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_a_pulled_block_stretches_as_the_law_in_space_says(stretch, plane, nu):
    """A closed form: free sides carry no stress, which gives the other stretches; the force on the pulled side follows."""

    def traction_free(side):  # the stretch across, for one out of the plane
        across = brentq(lambda s: stress(np.diag([stretch, s, side]), nu)[1, 1], 0.2, 5.0, xtol=1e-14)
        return np.diag([stretch, across, side])

    if plane == "stress":  # both sides are alike
        side = brentq(lambda s: stress(np.diag([stretch, s, s]), nu)[1, 1], 0.2, 5.0, xtol=1e-14)
        F = np.diag([stretch, side, side])
    else:
        F = traction_free(1.0)
    pull = stress(F, nu)[0, 0] * 1e-3 * THICKNESS  # N per mm of side
    block = material(nu, plane, clamped=(), sliding=("left", "top"))
    found = block.solve(line_loads(GRID, (12.0, 0.0), (12.0, HEIGHT), (pull, 0.0)))
    np.testing.assert_allclose(found.displacement, GRID.nodes @ (F[:2, :2] - np.eye(2)).T, atol=1e-9)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_forces_on_any_uniformly_deformed_block_are_those_of_the_law_in_space(nu):
    """Also far in compression, where a block under dead loads would buckle before it could be solved for."""
    F = np.array([[0.55, 0.2, 0.0], [-0.1, 0.8, 0.0], [0.0, 0.0, 1.0]])
    u = GRID.nodes @ (F[:2, :2] - np.eye(2)).T
    P = {"strain": stress(F, nu)}
    F[2, 2] = brentq(lambda s: stress(F * [1, 1, s], nu)[2, 2], 0.2, 5.0, xtol=1e-14)
    P["stress"] = stress(F, nu)
    right = GRID.boundary(["right"])
    for plane, expected in P.items():
        found = material(nu, plane).forces(u)[right].sum(axis=0)
        # Rows of the corner nodes also carry half a cell of top and bottom; the two cancel.
        np.testing.assert_allclose(found, expected[:2, 0] * 1e-3 * HEIGHT * THICKNESS, rtol=1e-11)


@pytest.mark.parametrize("plane", ["stress", "strain"])
@pytest.mark.parametrize("shear", [0.2, 1.0])
def test_simple_shear_takes_mu_times_shear_on_every_side_and_no_pressure(plane, shear):
    """F = (1, s; 0, 1) keeps volume: P = mu (F - F^-T), whose entries are mu s off the diagonal and zero on it."""
    u = GRID.nodes @ np.array([[0.0, shear], [0.0, 0.0]]).T
    forces = material(plane=plane).forces(u)
    inside = np.setdiff1d(np.arange(GRID.size), GRID.boundary(("left", "right", "top", "bottom")))
    np.testing.assert_allclose(forces[inside], 0, atol=1e-15)
    tau = E / 2.9 * 1e-3 * shear * THICKNESS
    bottom = forces[GRID.boundary(["bottom"])]
    right = forces[GRID.boundary(["right"])]
    # Rows of corner nodes also carry half a cell of the neighbouring sides; those at both ends cancel.
    np.testing.assert_allclose(bottom.sum(axis=0), [tau * 12.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(right.sum(axis=0), [0.0, tau * 12.0], atol=1e-12)


@pytest.mark.parametrize("nu", [0.0, 0.2, 0.45, 0.5])
def test_thickness_leaves_no_stress_out_of_the_plane(nu):
    J = np.array([0.3, 0.8, 1.0, 1.7, 4.0])
    a = thickening(J, nu)
    if nu == 0.5:
        np.testing.assert_allclose(a, J**-2.0, rtol=1e-12)
        return
    for change, out in zip(J, np.sqrt(a), strict=True):
        F = np.diag([1.3, change / 1.3, out])
        assert stress(F, nu)[2, 2] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("nu", "plane"), [(0.45, "stress"), (0.5, "stress"), (0.0, "stress"), (0.49, "strain")]
)
@pytest.mark.parametrize("regions", [(), LESION])
def test_forces_are_the_slope_of_the_energy_and_the_tangent_theirs(nu, plane, regions):
    rng = np.random.default_rng(0)
    body = material(nu, plane, regions)
    u, way = 0.25 * rng.normal(size=(2, GRID.size, 2))
    h = 1e-5
    slope = (body.energy(u + h * way) - body.energy(u - h * way)) / (2 * h)
    assert (body.forces(u) * way).sum() == pytest.approx(slope, rel=1e-7)
    bend = (body.forces(u + h * way) - body.forces(u - h * way)) / (2 * h)
    K = body.tangent(u)
    np.testing.assert_allclose((K @ way.ravel()).reshape(-1, 2), bend, atol=1e-7 * np.abs(bend).max())
    assert abs(K - K.T).max() < 1e-12 * abs(K).max()


@pytest.mark.parametrize(("nu", "plane"), [(0.45, "stress"), (0.5, "stress"), (0.4999, "strain")])
@pytest.mark.parametrize("regions", [(), LESION])
def test_at_rest_the_tangent_is_the_stiffness_of_linear_elasticity(nu, plane, regions):
    body = material(nu, plane, regions)
    K = FEMResponse(GRID, body.clamps, body.tissue).stiffness
    assert abs(body.tangent(np.zeros((GRID.size, 2))) - K).max() < 1e-10 * abs(K).max()


@pytest.mark.parametrize("plane", ["stress", "strain"])
def test_the_distance_to_linear_elasticity_falls_linearly_with_the_load(plane):
    body = material(plane=plane, regions=LESION)
    linear = FEMResponse(GRID, body.clamps, body.tissue)
    shares = []
    for force in (0.04, 0.02, 0.01, 0.005):
        loads = point_loads(GRID, [(5.1, 4.2)], [(0.5 * force, force)])
        u = linear.factored.solve(loads)
        shares.append(np.abs(body.solve(loads).displacement - u).max() / np.abs(u).max())
    assert shares[-1] > 1e-4  # there is something to fall
    np.testing.assert_allclose(np.divide(shares[:-1], shares[1:]), 2.0, atol=0.12)


@pytest.mark.parametrize("solver", ["cholmod", "superlu"])
def test_equilibrium_holds_and_does_not_depend_on_the_way_there(solver):
    body = material(regions=LESION, solver=solver)
    loads = point_loads(GRID, [(5.1, 4.2)], [(0.05, 0.1)])
    once = body.solve(loads)
    free = ~body.clamps.held
    np.testing.assert_allclose((body.forces(once.displacement) - loads)[free], 0, atol=1e-10)
    assert (once.displacement[~free] == 0).all()
    by_detour = body.solve(loads, body.solve(-loads, body.solve(0.3 * loads)))
    np.testing.assert_allclose(by_detour.displacement, once.displacement, atol=1e-9)
    np.testing.assert_allclose(body.solve(0 * loads, once).displacement, 0, atol=1e-9)


def test_a_load_beyond_what_the_tissue_carries_says_how_far_it_came():
    body = material()
    with pytest.raises(
        SolverError, match=r"no equilibrium beyond [\d.]+ N of the 50 N.*element at \(.*lower the force"
    ):
        body.solve(point_loads(GRID, [(6.0, 6.0)], [(0.0, 50.0)]))


def test_bad_input_is_refused():
    with pytest.raises(InputError, match=r"Poisson's ratios of 0 or more; got -0\.2"):
        material(-0.2)
    with pytest.raises(InputError, match=r"loads must be \(63, 2\) finite numbers"):
        material().solve(np.zeros((3, 2)))


def test_a_needle_in_stiff_tissue_moves_it_as_linear_elasticity_does_and_soft_tissue_otherwise():
    grid = RegularGrid((21, 16), (2.0, 2.0))
    insertion = Insertion.straight((12.0, 0.0), 60, 18, 5, retract=True)
    shares = []
    for young in (1000.0, 4.0):
        linear = FEMModel(grid, BOX, Tissue(young), NeedleForces(), sliding=["top"])
        large = NeoHookeanModel(linear)
        a, b = linear.rest(), large.rest()
        assert not large.displacement(b).any()
        for t in (1.0, 2.0, 3.0):
            a, b = linear.advance(a, insertion.pose(t), 1.0), large.advance(b, insertion.pose(t), 1.0)
        u, v = linear.displacement(a), large.displacement(b)
        shares.append(np.abs(u - v).max() / np.abs(u).max())
        np.testing.assert_allclose(large.displacement_at(b, grid.nodes[[77]]), v[[77]], atol=1e-14)
    assert shares[0] < 0.002
    assert 0.02 < shares[1] < 0.3


def test_the_scenario_names_the_material_and_other_models_refuse_it():
    grid = RegularGrid((9, 7), (5.0, 5.0))
    scene = validated({"tissue": {"material": "neo-hookean", "young": 20.0}}, "test")
    model = build_model(scene, grid, kind="fem")
    assert isinstance(model, NeoHookeanModel)
    assert model.material.tissue.young == 20.0
    for kind in ("tps", "elastic", "green"):
        with pytest.raises(InputError, match=rf"choose model fem, or material linear; got model {kind}"):
            build_model(scene, grid, kind=kind)
    assert isinstance(
        build_model(scene.with_values({"tissue.material": "linear"}), grid, kind="fem"), FEMModel
    )
    with pytest.raises(InputError, match=r"tissue.material = 'rubber': should be 'linear' or 'neo-hookean'"):
        validated({"tissue": {"material": "rubber"}}, "test")
