"""The native step against the plain reading of Algorithm 2 that refits at every step."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from threadpoolctl import threadpool_limits

from echospline.errors import InputError
from echospline.mechanics import Elastic, ThinPlate, TPSModel, TPSParameters
from echospline.scene import NeedlePose, RegularGrid
from paths import wandering

GRID = RegularGrid((27, 21), (40 / 26, 30 / 20))
KERNELS = [ThinPlate(), Elastic()]
DEFAULT = TPSParameters()
PRINTED = TPSParameters(loading="immediate", drag=0.0, contact_spacing=0.0)


@pytest.fixture(autouse=True)
def one_thread():
    # small systems: the threads of two BLAS libraries would only wait for each other
    with threadpool_limits(1):
        yield


def pair(precision="double", parameters=DEFAULT, **kw):
    return (
        TPSModel(GRID, parameters=parameters, solver="refit", **kw),
        TPSModel(GRID, parameters=parameters, precision=precision, **kw),
    )


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
@pytest.mark.parametrize(
    ("parameters", "precision", "within"),
    [
        (DEFAULT, "double", 1e-7),
        (DEFAULT, "single", 1e-5),
        (replace(DEFAULT, tip="node"), "double", 1e-7),
        (PRINTED, "double", 1e-7),
        (replace(PRINTED, tip="node"), "single", 1e-5),
    ],
)
def test_the_fast_step_gives_the_numbers_of_algorithm_2(kernel, parameters, precision, within):
    slow, fast = pair(precision, parameters, kernel=kernel)
    for seed in (1, 2):
        a, b = slow.rest(), fast.rest()
        for pose in wandering(seed, 1 / 20, 5.0):
            a, b = slow.advance(a, pose, 1 / 20), fast.advance(b, pose, 1 / 20)
            assert np.abs(slow.displacement(a) - fast.displacement(b)).max() < within
            assert a.held_back == b.held_back
        anywhere = np.random.default_rng(seed).uniform([0, 0], [40, 30], size=(30, 2))
        assert np.abs(slow.displacement_at(a, anywhere) - fast.displacement_at(b, anywhere)).max() < within


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
@pytest.mark.parametrize("tip", ["point", "node"])
def test_the_fast_step_knows_the_stiffness_of_landmarks(kernel, tip):
    stiffness = np.random.default_rng(1).uniform(0.5, 5.0, GRID.size)
    slow, fast = pair(parameters=replace(DEFAULT, tip=tip), kernel=kernel, stiffness=stiffness)
    a, b = slow.rest(), fast.rest()
    for pose in wandering(4, 1 / 20, 4.0):
        a, b = slow.advance(a, pose, 1 / 20), fast.advance(b, pose, 1 / 20)
        assert np.abs(slow.displacement(a) - fast.displacement(b)).max() < 1e-7


@pytest.mark.parametrize("grid", [GRID, RegularGrid((81, 61), (0.5, 0.5))], ids=["1.5 mm", "0.5 mm"])
def test_single_precision_is_enough_at_a_haptic_rate(grid):
    slow, fast = TPSModel(grid, solver="refit"), TPSModel(grid)
    a, b = slow.rest(), fast.rest()
    for i in range(400):
        pose = NeedlePose((15.0, 0.0), (15.0 + 0.004 * i, 0.02 * i), 20.4)
        a, b = slow.advance(a, pose, 1e-3), fast.advance(b, pose, 1e-3)
        assert np.abs(slow.displacement(a) - fast.displacement(b)).max() < 1e-5
    assert fast.native.statistics.allocations == 0


def test_an_old_state_stays_valid_whatever_happened_since():
    _, model = pair()
    states, poses = [model.rest()], list(wandering(7, 1 / 20, 5.0))
    for pose in poses:
        states.append(model.advance(states[-1], pose, 1 / 20))
    kept = [s.mesh.copy() for s in states]
    for i in (80, 3, 41, 0, 99):
        again = model.advance(states[i], poses[i], 1 / 20)
        assert np.abs(model.displacement(again) - kept[i + 1]).max() < 1e-9
    for state, mesh in zip(states, kept, strict=True):
        assert np.array_equal(model.displacement(state), mesh)


def test_a_step_does_not_change_the_state_it_starts_from():
    _, model = pair("single")
    state = model.rest()
    for pose in wandering(8, 1 / 20, 2.0):
        saved, mesh = bytes(state.saved), state.mesh.copy()
        after = model.advance(state, pose, 1 / 20)
        assert state.saved == saved
        assert np.array_equal(state.mesh, mesh)
        state = after


def jumping(seed, steps):
    """Poses that have nothing to do with each other: at every step most contacts leave and others join."""
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        entry, angle, depth = rng.uniform(6, 34), rng.uniform(0.9, 2.2), rng.uniform(3, 24)
        tip = (float(entry + depth * np.cos(angle)), float(depth * np.sin(angle)))
        yield NeedlePose(
            (float(entry), 0.0), (min(max(tip[0], 2.0), 38.0), tip[1]), float(rng.uniform(-8, 8))
        )


@pytest.mark.parametrize("kernel", KERNELS, ids=["thin plate", "elastic"])
@pytest.mark.parametrize(("precision", "within"), [("double", 1e-7), ("single", 1e-5)])
def test_hundreds_of_joins_and_leaves_leave_no_trace_of_rounding(kernel, precision, within):
    parameters = replace(PRINTED, contact_spacing=1.5, delta=1.3)
    slow, fast = pair(precision, parameters, kernel=kernel)
    state = fast.rest()
    for pose in jumping(6, 60):
        state = fast.advance(state, pose, 0.1)
    done = fast.native.statistics
    assert done.joined > 500
    assert done.left > 500
    assert done.residual < 1e-7  # at the landmarks, for displacements of 1 mm
    field = slow.reference.spline(fast.landmarks(state))  # the core's landmarks, fitted anew
    assert np.abs(field(GRID.nodes) - fast.displacement(state)).max() < within


def test_states_advanced_from_several_threads_are_those_of_one():
    _, model = pair("single")
    paths = [list(wandering(seed, 1 / 20, 3.0)) for seed in range(4)]

    def states(poses):
        state, meshes = model.rest(), []
        for pose in poses:
            state = model.advance(state, pose, 1 / 20)
            meshes.append(model.displacement(state))
        return np.array(meshes)

    alone = [states(poses) for poses in paths]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(states, paths))
    for one, two in zip(alone, together, strict=True):
        assert np.abs(one).max() > 0.1
        # going from one thread's state to another's loads bytes, and rounds differently
        assert np.abs(one - two).max() < 1e-5


def test_a_still_needle_changes_nothing_in_no_time():
    _, model = pair()
    state, poses = model.rest(), list(wandering(9, 1 / 20, 4.0))
    for pose in poses:
        state = model.advance(state, pose, 1 / 20)
        again = model.advance(state, replace(pose, speed=0.0), 0.0)
        assert np.abs(again.mesh - state.mesh).max() < 1e-12


def test_a_tip_beside_a_clamped_edge_is_refitted_in_effect():
    slow, fast = pair("single")
    a, b = slow.rest(), fast.rest()
    for y in np.arange(0.5, 31.0, 0.5):
        pose = NeedlePose((20.0, 0.0), (20.2, float(y)), 5.0)
        a, b = slow.advance(a, pose, 0.1), fast.advance(b, pose, 0.1)
        # in the last millimetre the weights of contacts and anchors are hundreds, of both signs
        within = 1e-5 if y < 29.0 else 2e-5
        assert np.abs(slow.displacement(a) - fast.displacement(b)).max() < within


def test_states_of_one_solver_are_refused_by_the_other():
    slow, fast = pair()
    with pytest.raises(InputError, match="refit"):
        slow.advance(fast.rest(), NeedlePose((20.0, 0.0), (20.0, 1.0), 1.0), 0.1)
    with pytest.raises(InputError, match="response"):
        fast.advance(slow.rest(), NeedlePose((20.0, 0.0), (20.0, 1.0), 1.0), 0.1)
    with pytest.raises(InputError, match="solver is one of response, refit"):
        TPSModel(GRID, solver="magic")


def test_a_node_at_delta_itself_is_touched_as_the_plain_reading_has_it():
    # the node (10, 0) is 2 mm from the entry (12, 0) but for rounding, which depends on the way there
    grid, parameters = RegularGrid((25, 19), (5 / 3, 5 / 3)), replace(PRINTED, delta=2.0)
    slow = TPSModel(grid, parameters=parameters, solver="refit")
    fast = TPSModel(grid, parameters=parameters, precision="double")
    a, b = slow.rest(), fast.rest()
    for depth in np.linspace(0.0, 20.0, 56):
        tip = (12.0 + depth * np.cos(np.pi / 3), depth * np.sin(np.pi / 3))
        pose = NeedlePose((12.0, 0.0), tip, 5.0)
        a, b = slow.advance(a, pose, 0.1), fast.advance(b, pose, 0.1)
        assert np.array_equal(a.contacts, fast.landmarks(b).contacts), depth


class Handling(RuleBasedStateMachine):
    """Whatever a hand does, in any order, the fast step equals the refit."""

    @initialize(kernel=st.sampled_from(KERNELS), x=st.floats(5.0, 35.0))
    def begin(self, kernel, x):
        self.limits = threadpool_limits(1)
        self.slow, self.fast = pair(kernel=kernel)
        self.a, self.b = self.slow.rest(), self.fast.rest()
        self.entry, self.depth, self.angle = (x, 0.0), 0.0, 1.57

    def teardown(self):
        if hasattr(self, "limits"):
            self.limits.restore_original_limits()

    @rule(by=st.floats(0.05, 4.0), dt=st.floats(0.0, 0.5))
    def insert(self, by, dt):
        self.depth = min(self.depth + by, 28.0)
        self._go(by / max(dt, 0.05), dt)

    @rule(share=st.floats(0.0, 1.0), dt=st.floats(0.001, 0.5))
    def withdraw(self, share, dt):
        by = self.depth * (1 - share)
        self.depth *= share
        self._go(-by / max(dt, 0.05), dt)

    @rule(by=st.floats(-0.3, 0.3))
    def redirect(self, by):
        self.angle = min(max(self.angle + by, 0.5), 2.6)
        self._go(0.0, 0.1)

    @rule(dt=st.floats(0.0, 3.0))
    def rest(self, dt):
        self._go(0.0, dt)

    def _go(self, speed, dt):
        tip = (
            self.entry[0] + self.depth * float(np.cos(self.angle)),
            self.depth * float(np.sin(self.angle)),
        )
        pose = NeedlePose(self.entry, tip, speed)
        self.a, self.b = self.slow.advance(self.a, pose, dt), self.fast.advance(self.b, pose, dt)
        assert np.abs(self.slow.displacement(self.a) - self.fast.displacement(self.b)).max() < 1e-7


TestHandling = Handling.TestCase
TestHandling.settings = settings(
    max_examples=12,
    stateful_step_count=30,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    derandomize=True,
)
