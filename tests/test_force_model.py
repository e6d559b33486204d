"""The model around the law: states are values, columns are shared, batches and threads change nothing, old numbers stay."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.mechanics import (
    FEMModel,
    ForceModel,
    GreenModel,
    ThinPlate,
    TPSModel,
    ViscousForces,
    force_model,
)
from echospline.mechanics.protocol import needle_load
from echospline.scene import Insertion, NeedlePose, RegularGrid, Tissue
from forced_paths import GRID, depths, model, pose, response

IN = np.linspace(0.2, 16, 80)


def test_a_state_can_be_gone_on_from_many_times():
    made = model()
    half = depths(made, IN[:40])[-1]
    once = depths(made, IN[40:], state=half)[-1]
    depths(made, np.linspace(8, 0, 41), state=half)
    again = depths(made, IN[40:], state=half)[-1]
    np.testing.assert_array_equal(again.displacement, once.displacement)
    assert again.load == once.load


def test_a_state_goes_on_in_another_model_and_after_pickling():
    made = model()
    half = depths(made, IN[:40])[-1]
    other, moved = model(), pickle.loads(pickle.dumps(half))
    a, b = (depths(m, IN[40:], state=s)[-1] for m, s in ((made, half), (other, moved)))
    np.testing.assert_allclose(b.displacement, a.displacement, atol=1e-12)


@pytest.mark.parametrize("kind", [FEMModel, GreenModel])
def test_models_pickle(kind):
    made = kind(GRID, ("left", "bottom"), Tissue(5.0), clamped_points=[(30.0, 10.0)])
    copy = pickle.loads(pickle.dumps(made))
    a, b = (depths(m, IN)[-1] for m in (made, copy))
    np.testing.assert_array_equal(a.displacement, b.displacement)


def test_states_share_the_columns_of_their_stations():
    made = model()
    states = depths(made, IN)
    for k, a in enumerate(states[40].track):
        assert states[-1].track[k].columns is a.columns


@pytest.mark.parametrize("ahead", [2, 4, 9])
def test_the_number_of_columns_computed_at_once_changes_nothing(monkeypatch, ahead):
    expected = depths(model(), IN)[-1]
    monkeypatch.setattr(force_model, "AHEAD", ahead)
    found = depths(model(), IN)[-1]
    np.testing.assert_allclose(found.displacement, expected.displacement, atol=1e-7)
    assert found.load.cut == pytest.approx(expected.load.cut, abs=1e-9)


def test_threads_share_a_model():
    made = model()
    paths = [[pose(d, angle, x) for d in IN] for angle, x in ((90, 20), (70, 12), (110, 28), (80, 20))]

    def last(path):
        state = made.rest()
        for at in path:
            state = made.advance(state, at, 0.01)
        return state

    alone = [last(path) for path in paths]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(last, paths))
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a.displacement, b.displacement)


def test_a_needle_that_turns_round_at_the_skin_has_been_drawn_out():
    made = model()
    state = depths(made, IN)[-1]
    for d in (4.0, 0.1):
        state = made.advance(state, pose(d), 0.1)
    above = made.advance(state, NeedlePose((20.0, 0.0), (20.0, -3.0)), 0.1)
    assert not above.displacement.any()
    assert above.load.cut == state.load.cut


def test_a_step_that_is_refused_leaves_the_model_as_it_was():
    made = model()
    half = depths(made, IN[:40])[-1]
    with pytest.raises(InputError, match="dt must be"):
        made.advance(half, pose(9), -1.0)
    with pytest.raises(InputError, match="below 1e9"):
        made.advance(half, pose(1e12), 0.1)
    expected = depths(model(), IN)[-1]
    np.testing.assert_allclose(
        depths(made, IN[40:], state=half)[-1].displacement, expected.displacement, atol=1e-12
    )


def test_states_of_another_law_solver_or_mesh_are_refused():
    sticking, viscous = FEMModel(GRID), FEMModel(GRID, forces=ViscousForces())
    for made, state in ((sticking, viscous.rest()), (viscous, sticking.rest())):
        with pytest.raises(InputError, match="other law"):
            made.advance(state, pose(5), 0.1)
    plain = ForceModel(response(), solver="reference")
    with pytest.raises(InputError, match="another solver"):
        plain.advance(sticking.rest(), pose(5), 0.1)
    other = ForceModel(response(grid=RegularGrid((11, 9), (4.0, 4.0))))
    with pytest.raises(InputError, match="same options"):
        other.advance(sticking.rest(), pose(5), 0.1)
    with pytest.raises(InputError, match="mesh of 336 nodes; the model has 99"):
        other.displacement(sticking.rest())
    with pytest.raises(InputError, match="solver is one of"):
        ForceModel(response(), solver="fast")


def test_points_outside_the_tissue_are_refused():
    made = model()
    for state in (made.rest(), depths(made, IN)[-1]):
        with pytest.raises(InputError, match="must lie in the mesh"):
            made.displacement_at(state, [(50.0, 3.0)])


def test_every_model_of_forces_says_them_and_landmarks_say_none():
    for made in (model(), FEMModel(GRID), GreenModel(GRID), FEMModel(GRID, forces=ViscousForces())):
        state = made.advance(made.rest(), NeedlePose((20, 0), (20, 8), 5.0), 1.0)
        assert needle_load(made, made.rest()).tip == 0
        assert needle_load(made, state).tip == pytest.approx(0.4, rel=1e-3)
    landmarks = TPSModel(GRID, kernel=ThinPlate())
    assert needle_load(landmarks, landmarks.rest()) is None


GOLDEN = {  # of the version before forces stuck and slipped
    "FEMModel": [
        0.127719884929,
        0.618007832166,
        0.26453399633,
        0.775627306752,
        0.257951497227,
        0.324737613028,
        0.0909838806217,
        0.420906263617,
        0.169047224074,
        0.494557865968,
        0.158181893536,
        0.329185519929,
        -0.0333397516686,
        -0.109999148534,
        -0.0472358258359,
        -0.0895602340467,
        -0.0289589062082,
        -0.0374374721851,
        -0.0307091498905,
        -0.0906282484721,
        -0.0363925946114,
        -0.070967087251,
        -0.0238307921358,
        -0.0314849042499,
    ],
}


@pytest.mark.parametrize("kind", [FEMModel])
def test_the_viscous_law_gives_the_numbers_it_always_gave(kind):
    made = kind(GRID, forces=ViscousForces(0.4, 1e-3, alpha3=0.7, ramp=1.0))
    insertion = Insertion.straight((12.0, 0.0), 60, 20, 5, dwell=0.5, retract=True)
    state, found = made.rest(), []
    for k in range(1, 51):
        state = made.advance(state, insertion.pose(k * 0.15), 0.15)
        if k in (20, 30, 34, 50):
            found += made.displacement(state)[[30, 115, 160]].ravel().tolist()
    np.testing.assert_allclose(found, GOLDEN[kind.__name__], rtol=1e-9, atol=1e-12)
