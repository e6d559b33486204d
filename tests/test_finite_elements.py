"""Plane elasticity against what mechanics knows for certain: patches, manufactured and fundamental solutions."""

import subprocess
import sys

import numpy as np
import pytest

from echospline import sample_image
from echospline.errors import InputError, MissingExtraError
from echospline.mechanics.finite_elements import (
    element_centres,
    factor,
    interpolate,
    lame,
    line_loads,
    point_loads,
    shape_functions,
    stiffness,
)
from echospline.scenario import Scenario, check
from echospline.scene import RegularGrid

E, NU, THICKNESS = 10.0, 0.45, 5.0  # kPa, 1, mm
GRID = RegularGrid((13, 9), (1.5, 2.0), (-9.0, 0.0))
BOX = ("left", "right", "bottom")


def moment(points, forces):
    return points[:, 0] * forces[:, 1] - points[:, 1] * forces[:, 0]


def around(grid):
    return grid.boundary(("left", "right", "top", "bottom"))


def random_loads(grid, seed=0):
    return np.random.default_rng(seed).normal(size=(grid.size, 2))


@pytest.mark.parametrize("method", ["cholmod", "superlu"])
@pytest.mark.parametrize(
    ("plane", "integration"),
    [("stress", "full"), ("strain", "full"), ("strain", "selective")],
)
def test_patch_of_uniform_strain_is_reproduced(plane, integration, method):
    gradient = np.array([[0.02, -0.013], [0.007, 0.011]])
    exact = GRID.nodes @ gradient.T + [0.3, -0.2]
    K = stiffness(GRID, E, NU, THICKNESS, plane, integration)
    u = factor(K, around(GRID), method).solve(np.zeros((GRID.size, 2)), exact)
    np.testing.assert_allclose(u, exact, atol=1e-10)


def test_patch_stress_is_hookes_law():
    """The reactions on one side add up to the exact traction of equation (19) times its area."""
    strain = np.array([0.01, -0.004, 0.006])
    exact = GRID.nodes @ np.array([[strain[0], strain[2] / 2], [strain[2] / 2, strain[1]]])
    reactions = (stiffness(GRID, E, NU, THICKNESS) @ exact.ravel()).reshape(-1, 2)
    C = E / (1 - NU**2) * np.array([[1, NU, 0], [NU, 1, 0], [0, 0, (1 - NU) / 2]])
    sxx, _, sxy = C @ strain * 1e-3  # N/mm^2
    height = GRID.extent[3] - GRID.extent[2]
    # The rows of the corner nodes also carry what acts on half a cell of top and bottom; the two cancel.
    right = reactions[GRID.boundary(["right"])].sum(axis=0)
    np.testing.assert_allclose(right, np.array([sxx, sxy]) * height * THICKNESS, rtol=1e-10)


def test_rigid_motions_cost_nothing():
    K = stiffness(GRID, E, NU, THICKNESS)
    rotation = (GRID.nodes - [1.0, 7.0]) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    for motion in (np.tile([1.0, 0.0], (GRID.size, 1)), np.tile([0.0, 1.0], (GRID.size, 1)), rotation):
        assert np.abs(K @ motion.ravel()).max() < 1e-12 * np.abs(K).max() * np.abs(motion).max()


def test_stiffness_has_no_other_free_motion():
    values = np.linalg.eigvalsh(stiffness(RegularGrid((5, 4), (1.0, 1.3)), E, NU, THICKNESS).toarray())
    assert (values[:3] < 1e-12 * values[-1]).all()
    assert values[3] > 1e-4 * values[-1]


@pytest.mark.parametrize(
    ("plane", "nu", "integration"), [("stress", 0.45, "full"), ("strain", 0.4999, "selective")]
)
def test_manufactured_solution_converges_with_second_order(plane, nu, integration):
    """u = sin sin with its body force by hand; the observed order in L2 is 2, also close to incompressible."""
    L = 10.0
    k = np.pi / L
    lam, mu = (float(m) * 1e-3 for m in lame(E, nu, plane))

    def exact(p):
        # A stream function's curl plus a small compression that fades as 1/lambda, so stresses stay bounded.
        sx, cx, sy, cy = np.sin(k * p[:, 0]), np.cos(k * p[:, 0]), np.sin(k * p[:, 1]), np.cos(k * p[:, 1])
        c = mu / (lam + mu)
        return np.stack([sx**2 * sy * cy + c * sx * sy, -(sy**2) * sx * cx + c * sx * sy], axis=1)

    def body_force(p):
        x, y = k * p[:, 0], k * p[:, 1]
        c = mu / (lam + mu)
        ss, cc = np.sin(x) * np.sin(y), np.cos(x) * np.cos(y)
        # Solenoidal part v = (sin^2 x sin y cos y, -sin^2 y sin x cos x): only mu Laplacian v remains.
        lap_x = k**2 * (np.cos(2 * x) * np.sin(2 * y) - 2 * np.sin(2 * y) * np.sin(x) ** 2)
        lap_y = -(k**2) * (np.cos(2 * y) * np.sin(2 * x) - 2 * np.sin(2 * x) * np.sin(y) ** 2)
        # Compressive part c (ss, ss): mu Laplacian + (lam + mu) grad div.
        grad_div = k**2 * (cc - ss)
        f = mu * np.stack([lap_x, lap_y], axis=1)
        both = (-2 * mu * k**2 * ss + (lam + mu) * grad_div) * c
        return -(f + both[:, None]) * THICKNESS

    errors = []
    for n in (9, 17, 33):
        grid = RegularGrid((n, n), (L / (n - 1), L / (n - 1)))
        g = (np.arange(n - 1)[:, None] + 0.5 + np.array([-1, 1]) / np.sqrt(12)).ravel() * grid.spacing[0]
        points = np.stack(np.meshgrid(g, g), axis=-1).reshape(-1, 2)
        weight = (grid.spacing[0] / 2) ** 2
        loads = point_loads(grid, points, body_force(points) * weight)
        K = stiffness(grid, E, nu, THICKNESS, plane, integration)
        u = factor(K, around(grid)).solve(loads)
        difference = interpolate(grid, u, points) - exact(points)
        errors.append(np.sqrt((difference**2).sum() * weight))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] == pytest.approx(2.0, abs=0.1)


def test_full_integration_locks_and_is_refused():
    with pytest.raises(InputError, match=r"lock.*selective"):
        stiffness(GRID, E, 0.4999, THICKNESS, "strain")


def test_incompressible_limit_of_plane_strain_is_refused_and_of_plane_stress_is_not():
    with pytest.raises(InputError, match=r"\(-1, 0.5\); got 0.5"):
        stiffness(GRID, E, 0.5, THICKNESS, "strain", "selective")
    stiffness(GRID, E, 0.5, THICKNESS, "stress")


def test_compliance_is_symmetric():
    """Maxwell and Betti: force at a, displacement at b equals force at b, displacement at a."""
    solver = factor(stiffness(GRID, E, NU, THICKNESS), GRID.boundary(BOX))
    nodes = np.array([4, 17, 43, 58])
    rows = np.stack([2 * nodes, 2 * nodes + 1], axis=1).ravel()
    C = solver.compliance(nodes).columns[rows]
    np.testing.assert_allclose(C, C.T, rtol=1e-11, atol=1e-13 * np.abs(C).max())
    assert (np.linalg.eigvalsh(C) > 0).all()


def test_compliance_columns_give_the_solved_field_and_refuse_other_loads():
    solver = factor(stiffness(GRID, E, NU, THICKNESS), GRID.boundary(BOX))
    loads = point_loads(GRID, [(0.2, 5.1), (3.3, 2.0)], [(0.1, 0.4), (-0.2, 0.1)])
    columns = solver.compliance(np.flatnonzero(loads.any(axis=1)))
    np.testing.assert_allclose(columns.solve(loads), solver.solve(loads), atol=1e-12)
    with pytest.raises(InputError, match="no column for the loaded node"):
        columns.solve(np.ones((GRID.size, 2)))


def kelvin(p, force, source, nu):
    """Displacement in an infinite sheet in plane stress per (force / (E thickness)), up to a rigid shift.

    Timoshenko and Goodier, Theory of Elasticity, section 42, with mu = E / (2 (1 + nu)).
    """
    d = p - source
    r = np.hypot(*d.T)
    along = d @ force / r
    return (
        (1 + nu)
        / (4 * np.pi)
        * (-(3 - nu) * np.log(r)[:, None] * force + (1 + nu) * (along / r)[:, None] * d)
    )


def test_field_away_from_a_point_force_is_kelvins():
    """The edge is held where Kelvin's field is; inside, away from the load, the mesh must reproduce it."""
    grid = RegularGrid((81, 81), (0.5, 0.5), (-20.0, -20.0))
    source, force = np.array([0.13, -0.21]), np.array([0.12, 0.4])
    exact = kelvin(grid.nodes, force, source, NU) / (E * 1e-3 * THICKNESS)
    u = factor(stiffness(grid, E, NU, THICKNESS), around(grid)).solve(point_loads(grid, source, force), exact)
    r = np.hypot(*(grid.nodes - source).T)
    away = r > 3.0
    error = np.linalg.norm(u - exact, axis=1)[away].max()
    assert error < 3e-3 * np.linalg.norm(exact[away] - exact[away].mean(axis=0), axis=1).max()


def test_field_under_a_free_surface_is_flamants():
    """A normal force on the surface of a half-plane gives a simple radial stress; shifts and turns aside.

    Timoshenko and Goodier, section 36: u_r = -(2 P / (pi E)) cos(a) ln(r) - (1 - nu) P / (pi E) a sin(a),
    u_a = (2 nu P / (pi E)) sin(a) + (2 P / (pi E)) ln(r) sin(a) + (1 - nu) P / (pi E) (sin(a) - a cos(a)).
    """
    grid = RegularGrid((121, 61), (0.5, 0.5), (-30.0, 0.0))
    P = 0.4 / (E * 1e-3 * THICKNESS)
    x, y = grid.nodes.T
    r, a = np.hypot(x, y), np.arctan2(x, y)
    r[r == 0] = np.nan
    ur = -(2 * P / np.pi) * np.cos(a) * np.log(r) - (1 - NU) * P / np.pi * a * np.sin(a)
    ua = (
        (2 * NU * P / np.pi) * np.sin(a)
        + (2 * P / np.pi) * np.log(r) * np.sin(a)
        + (1 - NU) * P / np.pi * (np.sin(a) - a * np.cos(a))
    )
    exact = np.stack([ur * np.sin(a) + ua * np.cos(a), ur * np.cos(a) - ua * np.sin(a)], axis=1)
    held = grid.boundary(BOX)
    u = factor(stiffness(grid, E, NU, THICKNESS), held).solve(
        point_loads(grid, (0.0, 0.0), (0.0, 0.4)), np.nan_to_num(exact)
    )
    away = r > 4.0
    error = np.linalg.norm(u - exact, axis=1)[away].max()
    assert error < 5e-3 * np.linalg.norm(exact[away] - exact[away].mean(axis=0), axis=1).max()


def test_bar_of_two_materials_stretches_as_springs_in_series():
    grid = RegularGrid((21, 5), (1.0, 1.0))
    left = element_centres(grid)[:, 0] < 8
    young = np.where(left, 5.0, 40.0)
    tension = 0.02  # N/mm^2
    K = stiffness(grid, young, 0.0, THICKNESS)  # nu = 0: the bar does not bulge, so one dimension is exact
    loads = line_loads(grid, (20.0, 0.0), (20.0, 4.0), (tension * THICKNESS, 0.0))
    u = factor(K, grid.boundary(["left"])).solve(loads)
    x = grid.nodes[:, 0]
    exact = tension / 1e-3 * (np.minimum(x, 8) / 5.0 + np.maximum(x - 8, 0) / 40.0)
    np.testing.assert_allclose(u[:, 0], exact, atol=1e-9)
    np.testing.assert_allclose(u[:, 1], 0, atol=1e-10)


def test_work_of_the_loads_is_twice_the_strain_energy_and_reactions_balance():
    K = stiffness(GRID, np.linspace(3, 30, 96), NU, THICKNESS)
    clamped = GRID.boundary(BOX)
    loads = random_loads(GRID)
    loads[clamped] = 0
    u = factor(K, clamped).solve(loads)
    internal = (K @ u.ravel()).reshape(-1, 2)
    assert (loads * u).sum() == pytest.approx(u.ravel() @ K @ u.ravel(), rel=1e-11)
    reactions = internal[clamped]
    np.testing.assert_allclose(reactions.sum(axis=0), -loads.sum(axis=0), rtol=1e-10)
    assert moment(GRID.nodes[clamped], reactions).sum() == pytest.approx(
        -moment(GRID.nodes, loads).sum(), rel=1e-10
    )


def test_point_loads_keep_force_and_moment_wherever_they_act():
    rng = np.random.default_rng(1)
    x0, x1, y0, y1 = GRID.extent
    points = rng.uniform((x0, y0), (x1, y1), (20, 2))
    forces = rng.normal(size=(20, 2))
    loads = point_loads(GRID, points, forces)
    np.testing.assert_allclose(loads.sum(axis=0), forces.sum(axis=0))
    assert moment(GRID.nodes, loads).sum() == pytest.approx(moment(points, forces).sum())


def test_line_load_is_the_limit_of_many_point_loads():
    start, end, force = np.array([-7.3, 0.4]), np.array([6.1, 13.7]), np.array([0.02, 0.05])
    length = np.hypot(*(end - start))
    m = 200_000
    middle = start + (np.arange(m)[:, None] + 0.5) / m * (end - start)
    many = point_loads(GRID, middle, force * length / m)
    np.testing.assert_allclose(line_loads(GRID, start, end, force), many, atol=1e-9)


def test_line_load_along_a_mesh_line_is_not_counted_twice():
    loads = line_loads(GRID, (0.0, 0.0), (0.0, 16.0), (0.0, 0.1))
    np.testing.assert_allclose(loads.sum(axis=0), (0.0, 1.6))
    assert set(np.flatnonzero(loads.any(axis=1))) == set(np.flatnonzero(GRID.nodes[:, 0] == 0.0))


def test_only_the_shaft_inside_the_mesh_is_loaded():
    loads = line_loads(GRID, (0.0, -10.0), (0.0, 8.0), (0.0, 0.1))
    np.testing.assert_allclose(loads.sum(axis=0), (0.0, 0.8))


def test_interpolation_is_exact_for_linear_fields_and_refuses_points_outside():
    values = GRID.nodes @ np.array([[1.0, 2.0], [3.0, -1.0]]) + 1.0
    p = np.array([[0.3, 4.4], [-9.0, 0.0], [9.0, 16.0]])
    np.testing.assert_allclose(interpolate(GRID, values, p), p @ np.array([[1.0, 2.0], [3.0, -1.0]]) + 1.0)
    with pytest.raises(InputError, match=r"must lie in the mesh.*got \(9.1, 3.0\)"):
        shape_functions(GRID, [(9.1, 3.0)])


def test_both_factorisations_agree_and_say_who_they_are():
    K = stiffness(GRID, E, NU, THICKNESS)
    a, b = (factor(K, GRID.boundary(BOX), m) for m in ("cholmod", "superlu"))
    assert (a.method, b.method) == ("cholmod", "superlu")
    loads = random_loads(GRID)
    np.testing.assert_allclose(a.solve(loads), b.solve(loads), rtol=1e-9, atol=1e-9)


def test_several_load_cases_are_solved_like_one_by_one():
    solver = factor(stiffness(GRID, E, NU, THICKNESS), GRID.boundary(BOX))
    cases = np.stack([random_loads(GRID, s) for s in range(3)], axis=2)
    together = solver.solve(cases)
    for i in range(3):
        np.testing.assert_allclose(together[:, :, i], solver.solve(cases[:, :, i]), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"young": -1.0, "poisson": NU, "thickness": 1.0},
            "Young's modulus must be positive numbers in kPa; got -1.0",
        ),
        ({"young": [1.0, 2.0], "poisson": NU, "thickness": 1.0}, "one per element"),
        ({"young": E, "poisson": NU, "thickness": 0.0}, "thickness must be a positive number in mm"),
        ({"young": E, "poisson": NU, "thickness": 1.0, "plane": "curved"}, 'plane is "stress" or "strain"'),
        ({"young": E, "poisson": 0.51, "thickness": 1.0}, r"\(-1, 0.5\]; got 0.51"),
    ],
)
def test_bad_input_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        stiffness(GRID, **arguments)


def test_a_floating_tissue_is_refused():
    with pytest.raises(InputError, match="two or more"):
        factor(stiffness(GRID, E, NU, THICKNESS), [3])


def test_without_the_extra_superlu_is_the_default_and_cholmod_explains_itself(monkeypatch):
    def absent(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr("echospline.mechanics.finite_elements.import_module", absent)
    K = stiffness(GRID, 10.0, 0.3, 1.0)
    with pytest.raises(MissingExtraError, match=r"kvxopt.*pip install 'echospline\[cholmod\]'"):
        factor(K, GRID.boundary(BOX), "cholmod")
    assert factor(K, GRID.boundary(BOX), "superlu").method == "superlu"
    code = (
        "import sys; sys.modules['kvxopt'] = None; import importlib.util as u; found = u.find_spec\n"
        "u.find_spec = lambda name, *a: None if name == 'kvxopt' else found(name, *a)\n"
        "import echospline as es; print(es.FEMModel(es.RegularGrid((9, 9), (5.0, 5.0))).factored.method)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "superlu"


def test_a_command_says_that_superlu_factors(monkeypatch):
    monkeypatch.setattr("echospline.scenario.scale.find_spec", lambda name: None)
    doubts = check(Scenario().with_values({"model.kind": "fem"}), sample_image())
    assert any("SuperLU" in doubt and "echospline[cholmod]" in doubt for doubt in doubts)
    assert check(Scenario(), sample_image()) == []
