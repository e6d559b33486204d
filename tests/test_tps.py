"""The paper's tissue model: equations (10) to (17), Algorithm 2, and that the picture never jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from echospline.errors import InputError
from echospline.mechanics import Elastic, ThinPlate, TPSModel, TPSParameters
from echospline.mechanics.interaction import friction, needle_travel, relax
from echospline.scene import Insertion, NeedlePose, RegularGrid
from paths import wandering

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
LITERAL = TPSParameters(loading="immediate", drag=0.0, contact_spacing=0.0, alpha1=0.05, alpha2=0.3)


def drive(model, insertion, dt, duration=None):
    state, t = model.rest(), 0.0
    for i in range(round((duration or insertion.duration) / dt)):
        t = (i + 1) * dt
        state = model.advance(state, insertion.pose(insertion.times[0] + t), dt)
    return state


@pytest.mark.parametrize("kernel", [ThinPlate(), Elastic()], ids=["thin plate", "elastic"])
def test_rest_is_a_fixed_point(kernel):
    model = TPSModel(GRID, kernel=kernel)
    assert not model.displacement(model.rest()).any()
    still = model.advance(model.rest(), NeedlePose((20, 0), (20, 0)), 1.0)
    assert not model.displacement(still).any()


def test_a_kernel_of_space_is_refused_in_the_plane():
    with pytest.raises(InputError, match="kernel of the plane"):
        TPSModel(GRID, kernel=ThinPlate(dimension=3))


def test_one_step_equals_algorithm_1_by_another_library():
    # landmarks and targets written down from (12)-(15), the spline by scipy
    model = TPSModel(GRID, parameters=LITERAL, precision="double")
    pose = NeedlePose((12.0, 0.0), (22.0, 14.0), 5.0)
    ours = model.displacement(model.advance(model.rest(), pose, 0.1))
    a = np.array(pose.axis)
    offset = GRID.nodes - pose.entry
    along = offset @ a
    d = np.hypot(*(offset - np.clip(along, 0, pose.depth)[:, None] * a).T)
    clamped = (GRID.nodes[:, 0] < 1e-9) | (GRID.nodes[:, 0] > 40 - 1e-9) | (GRID.nodes[:, 1] > 30 - 1e-9)
    near = (d <= 1.5) & (along <= pose.depth - 0.25 * 40 / 39) & ~clamped
    assert near.sum() > 20
    f = (0.05 + 0.3 / (1 + np.exp(d[near]))) * 5.0
    landmarks = np.vstack([model.anchors.places, GRID.nodes[near], [pose.tip]])
    moves = np.vstack([np.zeros_like(model.anchors.places), f[:, None] * a, [a]])
    theirs = RBFInterpolator(landmarks, moves, kernel="thin_plate_spline")(GRID.nodes)
    np.testing.assert_allclose(ours, theirs, atol=1e-8)


def test_node_tip_moves_the_nearest_node_to_its_target():
    model = TPSModel(GRID, parameters=replace(LITERAL, tip="node", delta=0.0))
    pose = NeedlePose((12.0, 0.0), (22.3, 14.2), 5.0)
    u = model.displacement(model.advance(model.rest(), pose, 0.1))
    node = GRID.nearest(pose.tip)
    target = np.add(pose.tip, pose.axis)
    np.testing.assert_allclose(GRID.nodes[node] + u[node], target, atol=1e-9)


def test_anchors_hold():
    model = TPSModel(GRID)
    u = model.displacement_at(drive(model, Insertion.straight((12, 0), 55, 20), 1 / 60), model.anchors.places)
    assert np.abs(u).max() < 1e-9


def test_field_is_linear_in_the_alphas_when_loading_is_immediate():
    pose = NeedlePose((12.0, 0.0), (22.0, 14.0), 5.0)

    def field(a1, a2):
        model = TPSModel(GRID, parameters=replace(LITERAL, alpha1=a1, alpha2=a2), precision="double")
        return model.displacement(model.advance(model.rest(), pose, 0.1))

    base = field(0, 0)
    both = base + 3 * (field(0.05, 0) - base) + 2 * (field(0, 0.2) - base)
    np.testing.assert_allclose(field(0.15, 0.4), both, atol=1e-9)


def test_friction_does_not_know_the_time_step_and_changes_sign_with_the_speed():
    d = np.array([0.0, 1.0, 1e4])
    np.testing.assert_allclose(friction(d, 4.0, 0.1, 0.2, 1.0)[[0, 2]], [0.8, 0.4])
    np.testing.assert_allclose(friction(d, -4.0, 0.1, 0.2, 1.0), -friction(d, 4.0, 0.1, 0.2, 1.0))


def test_halving_dt_changes_nothing_in_relaxation():
    q, target = np.array([[1.0, -2.0]]), np.array([[0.25, 0.0]])
    once = relax(q, target, 1.7, 0.4)
    np.testing.assert_allclose(relax(relax(q, target, 1.7, 0.2), target, 1.7, 0.2), once, rtol=1e-14)


def test_at_rest_the_field_keeps_its_shape_and_fades():
    path = Insertion.straight((8, 0), 40, 25, 8.0, dwell=3.0)
    follow = TPSParameters(loading="follow")
    for model in (TPSModel(GRID, parameters=follow), TPSModel(GRID, parameters=follow, solver="refit")):
        state = model.advance(drive(model, path, 1 / 40, duration=3.125), path.pose(3.2), 0.0)
        before, after = model.displacement(state), []
        for _ in range(4):
            state = model.advance(state, path.pose(3.3), 0.5)
            after.append(model.displacement(state))
        for k, u in enumerate(after):
            np.testing.assert_allclose(u, before * np.exp(-0.5 * (k + 1)), atol=1e-6)


@pytest.mark.parametrize("loading", ["stick", "follow", "immediate"])
def test_rest_after_a_push_does_not_depend_on_the_frame_rate(loading):
    parameters = TPSParameters(loading=loading)
    model = TPSModel(GRID, parameters=parameters, precision="double")
    path = Insertion.straight((12, 0), 60, 12, 5.0, dwell=1.0)
    pushed = drive(model, path, 1 / 20, duration=2.4)
    resting = [pushed, pushed]
    for i, dt in enumerate((0.25, 0.05)):
        for k in range(round(1.0 / dt)):
            resting[i] = model.advance(resting[i], path.pose(2.4 + (k + 1) * dt), dt)
    np.testing.assert_allclose(model.displacement(resting[0]), model.displacement(resting[1]), atol=1e-9)


def test_a_finer_step_approaches_one_answer():
    model = TPSModel(GRID)
    path = Insertion.straight((12, 0), 60, 15, 5.0)
    u = [model.displacement(drive(model, path, dt)) for dt in (1 / 30, 1 / 60, 1 / 240)]
    coarse, fine = (np.abs(v - u[2]).max() for v in u[:2])
    assert max(coarse, fine) < 0.01  # mm, of a largest displacement of 1 mm


@pytest.mark.parametrize(("precision", "within"), [("double", 1e-9), ("single", 5e-6)])
def test_mirrored_scene_gives_mirrored_field(precision, within):
    model = TPSModel(GRID, precision=precision)
    left = model.displacement(drive(model, Insertion.straight((12, 0), 60, 15), 1 / 30)).reshape(30, 40, 2)
    right = model.displacement(drive(model, Insertion.straight((28, 0), 120, 15), 1 / 30)).reshape(30, 40, 2)
    assert np.abs(right[:, ::-1] * [-1, 1] - left).max() < within


@pytest.mark.parametrize(("precision", "within"), [("double", 1e-9), ("single", 5e-6)])
def test_shifted_scene_gives_the_same_field(precision, within):
    moved = RegularGrid(GRID.shape, GRID.spacing, (100.0, -7.0))
    here, there = TPSModel(GRID, precision=precision), TPSModel(moved, precision=precision)
    a = here.displacement(drive(here, Insertion.straight((12, 0), 60, 15), 1 / 30))
    b = there.displacement(drive(there, Insertion.straight((112, -7), 60, 15), 1 / 30))
    assert np.abs(a - b).max() < within


def test_withdrawal_drags_tissue_back_and_leaves_it_at_rest_in_the_end():
    model = TPSModel(GRID, solver="refit")
    path = Insertion.straight((20, 0), 90, 15, 5.0, retract=True)
    axis = np.array([0.0, 1.0])
    inserted = drive(model, path, 1 / 30, duration=3.0)
    assert (inserted.q @ axis).max() > 0.5
    withdrawing = inserted
    for i in range(30):
        withdrawing = model.advance(withdrawing, path.pose(3.0 + (i + 1) / 30), 1 / 30)
    assert (withdrawing.q @ axis).min() < -0.3
    out = drive(model, path, 1 / 30)
    for _ in range(60):
        out = model.advance(out, path.pose(99.0), 0.5)
    assert np.abs(model.displacement(out)).max() < 1e-3


def test_tilting_drags_the_tissue_sideways_as_far_as_drag_says():
    turned = []
    for drag in (0.0, 1.0):
        model = TPSModel(GRID, parameters=TPSParameters(drag=drag, loading="follow"))
        state = drive(model, Insertion.straight((20, 0), 90, 15, 5.0), 1 / 30)
        for k in range(20):
            angle = np.radians(90 - 0.5 * (k + 1))
            state = model.advance(
                state, NeedlePose((20, 0), (20 + 15 * np.cos(angle), 15 * np.sin(angle))), 1 / 30
            )
        turned.append(model.displacement_at(state, [(20.0, 9.0)])[0, 0])
    shaft_moved = 9 * np.tan(np.radians(10))
    assert abs(turned[0]) < 0.1  # the axial displacement turns with the axis, nothing more
    assert turned[1] == pytest.approx(shaft_moved, rel=0.2)


@pytest.mark.parametrize("kernel", [ThinPlate(), Elastic()], ids=["thin plate", "elastic"])
@pytest.mark.parametrize(("seed", "dt"), [(0, 1 / 30), (4, 1 / 60), (3, 0.5)])
def test_the_picture_never_jumps(kernel, seed, dt):
    model = TPSModel(GRID, kernel=kernel, solver="refit")
    state, before = model.rest(), None
    u, largest = model.displacement(state), 0.0
    for pose in wandering(seed, dt, 4.0):
        moved = needle_travel(before or NeedlePose(pose.entry, pose.entry), pose)
        q = np.vstack([state.q, np.zeros((1, 2)) if state.tip is None else state.tip.q])
        relaxed = np.hypot(*q.T).max() * -np.expm1(-model.parameters.alpha3 * dt)
        state = model.advance(state, pose, dt)
        new = model.displacement(state)
        assert np.hypot(*(new - u).T).max() <= 3 * (moved + relaxed) + 1e-3, pose
        u, before = new, pose
        largest = max(largest, float(np.hypot(*u.T).max()))
    assert largest > 0.5


def test_a_straight_push_is_held_back_at_most_while_it_enters():
    model = TPSModel(GRID)
    path = Insertion.straight((12, 0), 55, 20, 5.0)
    entered, state = None, model.rest()
    for i in range(240):
        pose = path.pose((i + 1) / 60)
        state = model.advance(state, pose, 1 / 60)
        if entered is None and pose.depth > 1.0:
            entered = state.held_back
    assert entered <= 4
    assert state.held_back == entered


@pytest.mark.parametrize(
    "pose",
    [
        NeedlePose((-20, -5), (-10, -5), 5.0),
        NeedlePose((20, 0), (20, 0), 5.0),
        NeedlePose((20, 25), (20, 40), 5.0),
        NeedlePose((20, 29), (20, 30), 5.0),
        NeedlePose((-5, 10), (60, 12), 5.0),
    ],
    ids=["outside", "zero length", "through a clamped edge", "on a clamped edge", "right through the image"],
)
def test_odd_places_give_finite_fields(pose):
    model = TPSModel(GRID)
    state = model.rest()
    for _ in range(3):
        state = model.advance(state, pose, 0.1)
        u = model.displacement(state)
        assert np.isfinite(u).all()
        assert np.abs(u).max() < 20
    assert np.abs(model.displacement_at(state, model.anchors.places)).max() < 1e-6


def test_the_push_fades_towards_a_clamped_edge():
    model = TPSModel(GRID, parameters=replace(LITERAL, delta=0.0))
    largest = [
        np.abs(model.displacement(model.advance(model.rest(), NeedlePose((20, 5), (20, y), 5.0), 0.1))).max()
        for y in (20.0, 29.0, 29.9, 30.1)
    ]
    assert largest == sorted(largest, reverse=True)
    assert largest[-1] == 0.0


def test_soft_landmarks_move_less():
    pose = NeedlePose((12.0, 0.0), (22.0, 14.0), 5.0)
    most = []
    for k in (np.inf, 5.0, 0.5):
        model = TPSModel(GRID, parameters=LITERAL, stiffness=k)
        most.append(np.abs(model.displacement(model.advance(model.rest(), pose, 0.1))).max())
    assert most == sorted(most, reverse=True)
    assert most[2] < 0.8 * most[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": -1.0}, "sigma must be a finite number from 0"),
        ({"alpha3": float("nan")}, "alpha3"),
        ({"drag": 1.5}, "drag must be a finite number from 0 to 1"),
        ({"tip": "blunt"}, "point"),
        ({"loading": "slow"}, "follow"),
    ],
)
def test_parameters_out_of_range_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        TPSParameters(**change)


def test_a_scene_that_nothing_holds_is_refused():
    with pytest.raises(InputError, match="leaves it free to slide"):
        TPSModel(GRID, clamped=())
    with pytest.raises(InputError, match="no edge holds the x direction, and 1 clamped point on one line"):
        TPSModel(GRID, clamped=(), sliding=("top",), clamped_points=[(8.0, 12.0)])
    with pytest.raises(InputError, match="dt must be"):
        TPSModel(GRID).advance(TPSModel(GRID).rest(), NeedlePose((0, 0), (0, 0)), -1.0)


def test_default_friction_throws_no_tissue_backwards():
    # a steep profile across the shaft makes a thin plate swing back beside the needle; the defaults must not
    path = Insertion.straight((8, 0), 45, 25, 10.0)
    axis = np.array([1.0, 1.0]) / np.sqrt(2)
    along = TPSModel(GRID).displacement(drive(TPSModel(GRID), path, 1 / 20)) @ axis
    assert along.max() > 0.9
    assert along.min() > -0.05
    steep = TPSModel(GRID, parameters=TPSParameters(alpha1=0.04, alpha2=0.2))
    assert (steep.displacement(drive(steep, path, 1 / 20)) @ axis).min() < -0.5
