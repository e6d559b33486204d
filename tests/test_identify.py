"""Identification: parameters that made a field are found again, by every model, against independent optimisers."""

import numpy as np
import pytest
from scipy.optimize import minimize

from echospline.errors import InputError
from echospline.mechanics import (
    Elastic,
    FEMModel,
    GreenModel,
    ThinPlate,
    TPSModel,
    TPSParameters,
    ViscousForces,
)
from echospline.scene import Insertion, RegularGrid, Tissue, distance, field_error
from echospline.study import ForceFields, Observation, SplineFields, identify
from echospline.study.identify import grid_search

GRID = RegularGrid((25, 19), (40 / 24, 30 / 18))
PRINTED = {"loading": "immediate", "drag": 0.0, "tip": "point", "contact_spacing": 0.0, "anchor_spacing": 3.0}
PUSH = Insertion.straight((12, 0), 60, 20, 5)


def printed(**values):
    return TPSParameters(**{**PRINTED, **values})


def observe(model, insertion=PUSH, frames=12, noise=0.0, rest=0.0):
    """Step a model through an insertion; the fields it shows are the observation."""
    times = np.linspace(0, insertion.duration, frames + 1)
    if rest:
        times = np.concatenate(
            [
                np.linspace(0, insertion.duration - rest, frames),
                insertion.duration - rest + np.linspace(0, rest, 6)[1:],
            ]
        )
    poses = [insertion.pose(t) for t in times]
    state, fields = model.rest(), []
    for k, pose in enumerate(poses):
        state = model.advance(state, pose, 0.0 if k == 0 else times[k] - times[k - 1])
        fields.append(model.displacement(state))
    u = np.array(fields)
    return Observation(
        model.grid.nodes, u + noise * np.random.default_rng(3).normal(size=u.shape), times, poses
    )


@pytest.fixture(scope="module")
def fem_truth():
    return observe(FEMModel(GRID, forces=ViscousForces(0.4, 1e-4, ramp=0.0)))


@pytest.mark.parametrize("kernel", [ThinPlate(), Elastic(0.45, 1.0)], ids=["thin plate", "elastic"])
@pytest.mark.parametrize("solver", ["refit", "response"])
def test_spline_fields_are_what_the_model_shows(kernel, solver):
    """Unit fields times parameters against the model stepped through the same poses, rest included."""
    parameters = printed(sigma=0.8, delta=2.0, alpha1=0.03, alpha2=0.11, alpha3=0.6, length=1.7)
    model = TPSModel(GRID, parameters=parameters, kernel=kernel, precision="double")
    seen = observe(model, Insertion.straight((12, 0), 60, 20, 5, dwell=2.0), rest=2.0)
    values = {"delta": 2.0, "length": 1.7, "alpha3": 0.6, "sigma": 0.8}
    field = SplineFields(model, seen).fields(values) @ np.array([0.03, 0.11, 0.8])
    np.testing.assert_allclose(field, seen.displacement, atol=1e-8)


@pytest.mark.parametrize("make", [FEMModel, GreenModel])
def test_force_fields_are_what_the_model_shows(make):
    model = make(GRID, forces=ViscousForces(0.3, 2e-3, alpha3=0.8, ramp=0.0))
    seen = observe(model, Insertion.straight((12, 0), 60, 20, 5, dwell=2.0), rest=2.0)
    field = ForceFields(model, seen).fields({"alpha3": 0.8}) @ np.array([0.3, 2e-3])
    np.testing.assert_allclose(field, seen.displacement, atol=1e-9)


@pytest.mark.parametrize("objective", ["mae", "rmse"])
def test_spline_parameters_are_found_again(objective):
    truth = printed(sigma=0.8, delta=2.0, alpha1=0.03, alpha2=0.11, alpha3=0.6, length=1.0)
    model = TPSModel(GRID, parameters=truth)
    seen = observe(model, Insertion.straight((12, 0), 60, 20, 5, dwell=2.0), rest=2.0)
    found = identify(
        SplineFields(TPSModel(GRID, parameters=printed()), seen, delta=(1.5, 2.0, 2.5)),
        objective,
        bootstrap=0,
    )
    assert found.values["delta"] == 2.0
    assert found.values["sigma"] == pytest.approx(0.8, rel=1e-3)
    assert found.values["alpha3"] == pytest.approx(0.6, rel=0.02)
    assert found.error.mae_percent < 0.5


def test_force_and_relaxation_are_found_again_in_noise():
    model = FEMModel(GRID, forces=ViscousForces(0.3, 2e-3, alpha3=0.8, ramp=0.0))
    seen = observe(model, Insertion.straight((12, 0), 60, 20, 5, dwell=2.0), rest=2.0, noise=0.02)
    found = identify(ForceFields(model, seen), "rmse", bootstrap=100)
    assert found.values["tip"] == pytest.approx(0.3, rel=0.02)
    assert found.values["alpha3"] == pytest.approx(0.8, rel=0.05)
    low, high = found.intervals["friction"]
    assert low < 2e-3 < high


def test_least_distances_agree_with_a_general_optimiser(fem_truth):
    """The convex MAE problem, solved by BFGS on a smoothed sum, from another start."""
    fields = SplineFields(TPSModel(GRID, parameters=printed()), fem_truth, delta=(2.0,), length=(1.0, 1.0001))
    found = identify(fields, "mae", bootstrap=0)
    A = fields.fields(found.values)
    moved = distance(fem_truth.displacement, 0 * fem_truth.displacement) > 1e-9

    def cost(x):
        r = (A @ x - fem_truth.displacement)[moved]
        return np.sqrt((r**2).sum(-1) + 1e-14).mean()

    other = minimize(cost, np.array([0.1, 0.1, 0.5]), method="BFGS", options={"gtol": 1e-9})
    assert found.error.mae <= other.fun * (1 + 1e-5)


@pytest.mark.parametrize("objective", ["mae", "rmse"])
@pytest.mark.parametrize("kernel", [ThinPlate(), Elastic()], ids=["thin plate", "elastic"])
def test_friction_is_never_negative(kernel, objective):
    """Above a table alone everything moves along with the needle, and the free minimum asks for friction of the wrong sign."""
    seen = observe(
        FEMModel(GRID, ("bottom",), forces=ViscousForces(0.4, 1e-4, ramp=0.0)),
        Insertion.straight((12, 0), 90, 20, 5),
    )
    edges = ("bottom",) if kernel.components == 2 else ("bottom", "left")
    fields = SplineFields(TPSModel(GRID, edges, printed(), kernel), seen, delta=(1.5,), length=(4.0, 5.0))
    values = identify(fields, objective, bootstrap=0).values
    a1, a2, sigma = (values[n] for n in ("alpha1", "alpha2", "sigma"))
    assert min(a1, a1 + a2 / 2, sigma) >= -1e-12

    # and is the least there is: a general optimiser under the same bounds, from another start, finds none better
    moved = distance(seen.displacement, 0 * seen.displacement) > 1e-9
    A, b = fields.fields(values)[moved], seen.displacement[moved]
    free = np.linalg.lstsq(A.reshape(-1, 3), b.ravel(), rcond=None)[0]
    assert min(free[0], free[0] + free[1] / 2) < 0

    def cost(x):
        r2 = ((A @ x - b) ** 2).sum(axis=-1)
        return float(np.sqrt(r2 + 1e-12).mean() if objective == "mae" else r2.mean())

    bounds = [
        {"type": "ineq", "fun": lambda x, row=row, low=low: row @ x - low}
        for row, low in zip(*fields.least, strict=True)
    ]
    best = minimize(
        cost, [0.05, 0.05, 0.5], method="SLSQP", constraints=bounds, options={"maxiter": 500, "ftol": 1e-12}
    )
    assert cost([a1, a2, sigma]) <= best.fun * (1 + 1e-4)


def test_closed_form_is_no_worse_than_the_grid_and_needs_far_fewer_runs(fem_truth):
    seen = fem_truth.frames(np.array([4, 8, 12]))
    closed = identify(SplineFields(TPSModel(GRID, parameters=printed()), seen, delta=(2.0,)), bootstrap=0)

    def run(values):
        model = TPSModel(GRID, parameters=printed(delta=2.0, length=1.0, **values))
        return np.array([model.displacement(model.advance(model.rest(), pose, 0.1)) for pose in seen.poses])

    axes = {
        "sigma": np.linspace(0.2, 1.2, 6),
        "alpha1": np.linspace(0, 0.2, 5),
        "alpha2": np.linspace(0, 0.4, 4),
    }
    grid = grid_search(run, axes, seen.displacement)
    assert grid.runs == 120
    assert closed.error.mae <= grid.error.mae


def test_parameters_that_the_data_cannot_tell_are_named(fem_truth):
    """With a band so thin that every contact is equally far, alpha1 and alpha2 act alike."""
    straight = observe(
        FEMModel(GRID, forces=ViscousForces(0.4, 1e-4, ramp=0.0)), Insertion.straight((20, 0), 90, 20, 5)
    )
    found = identify(SplineFields(TPSModel(GRID, parameters=printed()), straight, delta=(0.5,)), bootstrap=0)
    assert found.condition > 30
    assert any("alpha1 and alpha2 cannot be told apart" in s for s in found.confounded)


def test_a_needle_at_rest_tells_nothing_of_friction(fem_truth):
    still = FEMModel(GRID, forces=ViscousForces(0.4, 0.0, ramp=0.0))
    seen = observe(still)
    slow = Observation(
        seen.points, seen.displacement, seen.times, [type(p)(p.entry, p.tip, 0.0) for p in seen.poses]
    )
    found = identify(ForceFields(still, slow), "rmse", bootstrap=0)
    assert found.values["tip"] == pytest.approx(0.4, rel=1e-6)
    assert "friction leaves no trace in these frames" in found.confounded


def test_green_with_known_modulus_finds_the_force_that_made_the_finite_element_field(fem_truth):
    found = identify(ForceFields(GreenModel(GRID), fem_truth), "mae", bootstrap=0)
    assert found.values["tip"] == pytest.approx(0.4, rel=0.02)
    assert found.error.mae_percent < 3


def test_untracked_points_are_left_out(fem_truth):
    u = fem_truth.displacement.copy()
    u[:, ::3] = np.nan
    seen = Observation(fem_truth.points, u, fem_truth.times, fem_truth.poses)
    found = identify(ForceFields(FEMModel(GRID), seen), "rmse", bootstrap=0)
    assert found.values["tip"] == pytest.approx(0.4, rel=1e-6)
    assert np.isnan(found.error_map[::3]).all()
    assert np.isfinite(np.delete(found.error_map, np.s_[::3])).all()


def test_same_seed_gives_the_same_answer(fem_truth):
    a, b = (identify(ForceFields(FEMModel(GRID), fem_truth), seed=5, bootstrap=20) for _ in range(2))
    assert (a.values, a.intervals) == (b.values, b.intervals)


def test_modulus_scales_the_identified_force(fem_truth):
    found = identify(ForceFields(FEMModel(GRID, tissue=Tissue(20.0)), fem_truth), "rmse", bootstrap=0)
    assert found.values["tip"] == pytest.approx(0.8, rel=1e-6)


def test_errors_are_those_of_equation_24_over_moved_nodes():
    reference = np.array([[0.0, 0.0], [3.0, 4.0], [0.0, 2.0]])
    field = np.array([[9.0, 9.0], [3.0, 1.0], [0.0, 1.0]])
    error = field_error(field, reference)
    assert (error.nodes, error.mae, error.worst, error.mean_displacement) == (2, 2.0, 3.0, 3.5)
    assert error.rmse == pytest.approx(np.sqrt(5))
    assert error.mae_percent == pytest.approx(200 / 3.5)


def test_bad_input_is_refused(fem_truth):
    with pytest.raises(InputError, match="loading='immediate'"):
        SplineFields(TPSModel(GRID), fem_truth)
    with pytest.raises(InputError, match="displaces no point"):
        Observation(fem_truth.points, 0 * fem_truth.displacement, fem_truth.times, fem_truth.poses)
    with pytest.raises(InputError, match="one shape"):
        field_error(np.zeros((3, 2)), np.zeros((4, 2)))
    with pytest.raises(InputError, match="objective"):
        identify(ForceFields(FEMModel(GRID), fem_truth), "median")
