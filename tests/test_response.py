"""The incremental response against a spline refitted from all its landmarks (Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from numba import njit

from echospline.errors import InputError, SolverError
from echospline.mechanics import AnchoredKernel, Elastic, Kernel, ThinPlate
from echospline.mechanics.response import NO_TIP, Precision, Response
from echospline.mechanics.row_sums import BLOCK, sum_block, sum_block_twice
from echospline.mechanics.spline import factor
from echospline.mechanics.tip_patch import COEFFICIENTS, DEGREE, NODES, PARTS, chebyshev
from echospline.scene import Floats, RegularGrid

GRID = RegularGrid((17, 13), (2.0, 2.0))
KERNELS = [ThinPlate(), Elastic(0.45, 1.5)]


def anchors() -> Floats:
    return GRID.nodes[GRID.boundary(("left", "right", "bottom"))]


def inner() -> Floats:
    return np.setdiff1d(np.arange(GRID.size), GRID.boundary(("left", "right", "bottom", "top")))


def response_of(
    kernel: Kernel, precision: Precision, held: Floats | None = None, soft: Floats | None = None
) -> Response:
    scene = AnchoredKernel.factor(kernel, anchors(), GRID.nodes, held, sources=GRID.nodes[inner()])
    return Response(scene, inner(), precision, None if soft is None else scene.compliance(soft))


def ask(
    response: Response,
    nodes: Floats,
    q: Floats,
    tip: Floats | None = None,
    e: Floats | None = None,
    soft: float = 0.0,
) -> Floats:
    table = contacts(nodes)
    response.set_contacts(table[:, 0])
    at = NO_TIP
    if tip is not None:
        at = np.array([1.0, *tip, *e, 1.0, 0, 0, 0, 0, 0, 0])
        response.prepare(at, at, PARTS)
    return response.field(table, q, at, soft)[0]


def contacts(nodes: Floats) -> Floats:
    table = np.zeros((len(nodes), 7))
    table[:, 0] = np.searchsorted(inner(), nodes)
    return table


def refit(
    kernel: Kernel, nodes: Floats, q: Floats, tip: Floats | None = None, e: Floats | None = None, **kw: Floats
) -> Callable[[Floats], Floats]:
    landmarks, values = [anchors(), GRID.nodes[nodes]], [np.zeros((len(anchors()), 2)), q]
    if tip is not None:
        landmarks.append(tip[None])
        values.append(e[None])
    return factor(kernel, np.vstack(landmarks), **kw).solve(np.vstack(values))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("precision", "within"), [("double", 1e-9), ("single", 1e-5)])
def test_field_is_that_of_a_refitted_spline(kernel: Kernel, precision: Precision, within: float) -> None:
    rng = np.random.default_rng(3)
    response = response_of(kernel, precision)
    tip = np.array([15.3, 9.1])
    for turn in range(40):
        nodes = rng.choice(inner(), size=int(rng.integers(0, 14)), replace=False)
        nodes = nodes[np.hypot(*(GRID.nodes[nodes] - tip).T) > 0.3]
        q, e = rng.normal(size=(len(nodes), 2)), rng.normal(size=2)
        got = ask(response, nodes, q, tip, e)
        expected = refit(kernel, nodes, q, tip, e)(GRID.nodes)
        scale = max(1.0, float(np.abs(expected).max()))
        assert np.abs(got - expected).max() < within * scale, turn
        anywhere = rng.uniform([0, 0], [32, 24], size=(20, 2))
        exact = response.spline(contacts(nodes), q, np.array([1.0, *tip, *e, 1.0, 0, 0, 0, 0, 0, 0]))(
            anywhere
        )
        assert np.abs(exact - refit(kernel, nodes, q, tip, e)(anywhere)).max() < 1e-9 * scale
        tip = np.clip(tip + rng.normal(size=2) * 0.1, [4, 2], [28, 20])
    patched = response.statistics.patches
    assert 0 < patched < 40 if precision == "single" else response.statistics.direct == 40


@pytest.mark.parametrize("kernel", KERNELS)
def test_stiffness_of_anchors_contacts_and_tip_is_that_of_the_spline(kernel: Kernel) -> None:
    rng = np.random.default_rng(4)
    held, soft = rng.uniform(0.5, 5.0, len(anchors())), rng.uniform(0.5, 5.0, len(inner()))
    response = response_of(kernel, "double", held, soft)
    which = rng.choice(len(inner()), 6, replace=False)
    nodes, q = inner()[which], rng.normal(size=(6, 2))
    tip, e, yielding = np.array([13.1, 7.7]), np.array([0.2, 0.9]), 2.0
    added = float(response.scene.compliance(np.array([yielding]))[0])
    got = ask(response, nodes, q, tip, e, added)
    stiffness = np.concatenate([held, soft[which], [yielding]])
    expected = refit(kernel, nodes, q, tip, e, stiffness=stiffness)(GRID.nodes)
    assert np.abs(got - expected).max() < 1e-10


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_tip_close_to_an_anchor_is_evaluated_directly(kernel: Kernel) -> None:
    response = response_of(kernel, "single")
    tip, e = np.array([16.1, 23.9]), np.array([0.0, 0.05])
    nodes = inner()[[3, 30]]
    got = ask(response, nodes, np.ones((2, 2)), tip, e)
    expected = refit(kernel, nodes, np.ones((2, 2)), tip, e)(GRID.nodes)
    assert response.statistics.direct == 1
    assert np.abs(got - expected).max() < 1e-5


def test_a_contact_that_joins_at_its_own_value_changes_nothing() -> None:
    response = response_of(ThinPlate(), "double")
    nodes = inner()[[20, 34, 51]]
    q = np.array([[0.3, 0.1], [0.0, 0.7], [-0.2, 0.4]])
    before = ask(response, nodes, q)
    more = np.append(nodes, inner()[40])
    after = ask(response, more, np.vstack([q, before[inner()[40]]]))
    assert np.abs(after - before).max() < 1e-12


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_rows_are_the_newton_basis_of_the_contacts_whatever_came_and_went(kernel: Kernel) -> None:
    rng, response = np.random.default_rng(6), response_of(kernel, "single")
    scene = response.scene
    tip = np.array([1.0, 15.3, 9.1, 0, 0, 1.0, 0, 0, 0, 0, 0, 0])
    for turn in range(80):
        response.set_contacts(rng.choice(len(inner()), size=int(rng.integers(0, 14)), replace=False))
        response.prepare(tip, tip, 3)
        n = response.count * scene.components
        sources = scene.sources[response.source_of[: response.count]]
        M, gram = np.triu(response.MT[:n, :n]).T, scene.between(sources, sources)
        assert np.abs(M @ gram @ M.T - np.eye(n)).max(initial=0.0) < 1e-11, turn
        E, width = M @ scene.rows(sources), len(GRID.nodes) * scene.components
        assert np.abs(response.rows[response.head :][:n, :width] - E).max(initial=0.0) < 1e-11, turn
        # the rows of a patch and what the basis carries of them are the columns of its nodes
        there = np.tile(np.arange(len(GRID.nodes)) < response.built[0], scene.components)
        of_patch = slice(0, len(NODES) * scene.components)
        carried = response.nodes_newton[0, :, :n] @ E
        error = response.rows[of_patch, :width] + carried - scene.rows(response.nodes[0])
        assert np.abs(error[:, there]).max() < 1e-11, turn
        assert np.array_equal(response.single[of_patch], response.rows[of_patch].astype(np.float32))
    assert response.built[0] == len(GRID.nodes)
    assert response.statistics.rebuilt == 0


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("lines", [1, 2])
def test_sums_of_rows_are_those_of_numpy(kind: type, lines: int) -> None:
    rng = np.random.default_rng(7)
    rows, weights = rng.normal(size=(40, 256)).astype(kind), rng.normal(size=(lines, 40)).astype(kind)
    order = rng.permutation(40)[:33]
    out = np.full((lines, BLOCK), np.nan, dtype=kind)
    loop = sum_block if lines == 1 else sum_block_twice

    @njit
    def call(rows: Floats, offsets: Floats, weights: Floats, count: int, start: int, out: Floats) -> None:
        loop(rows, offsets, weights, count, start, out)

    for count in (0, 1, 33):
        for start in (0, 64, 192):
            call(rows, order * 256, weights, count, start, out)
            expected = weights[:, :count] @ rows[order[:count], start : start + BLOCK]
            np.testing.assert_allclose(out, expected, rtol=1e-4 if kind == np.float32 else 1e-12, atol=1e-5)


def test_rounding_past_the_limit_rebuilds_and_says_so() -> None:
    response = response_of(ThinPlate(), "double")
    nodes, q = inner()[[20, 34, 51]], np.ones((3, 2))
    expected = ask(response, nodes, q)
    response.MT[0, 0] *= 1.0 + 1e-3
    response.rows[response.head] *= 1.0 + 1e-3
    again = ask(response, inner()[[20, 34, 51, 60]], np.vstack([q, expected[inner()[60]]]))
    assert response.statistics.rebuilt == 1
    assert np.abs(again - expected).max() < 1e-12


def test_landmarks_that_cannot_be_told_apart_are_refused() -> None:
    twice = GRID.nodes[[60, 60]]
    scene = AnchoredKernel.factor(ThinPlate(), anchors(), GRID.nodes, sources=twice)
    with pytest.raises(SolverError, match=r"too close together"):
        Response(scene, np.array([60, 60]), "double").set_contacts([0, 1])


def test_anchors_on_one_line_are_refused_with_the_way_out() -> None:
    line = GRID.nodes[GRID.boundary(("bottom",))]
    with pytest.raises(InputError, match='solver "refit"'):
        AnchoredKernel.factor(ThinPlate(), line, GRID.nodes)


def test_the_patch_reproduces_every_polynomial_of_its_degree() -> None:
    rng = np.random.default_rng(5)
    powers = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    a = rng.normal(size=len(powers))

    def f(p: Floats) -> Floats:
        return sum(a[m] * p[:, 0] ** i * p[:, 1] ** j for m, (i, j) in enumerate(powers))

    p = rng.uniform(-1, 1, size=(50, 2))
    assert np.abs(chebyshev(p, DEGREE) @ COEFFICIENTS @ f(NODES) - f(p)).max() < 1e-12


class Insertions(RuleBasedStateMachine):
    """Any order of insertion, withdrawal and redirection keeps the response equal to a refit."""

    @initialize(kernel=st.sampled_from(KERNELS))
    def scene(self, kernel: Kernel) -> None:
        self.kernel = kernel
        self.response = response_of(kernel, "double")
        self.rng = np.random.default_rng(0)
        self.entry, self.tip = np.array([15.0, 0.0]), np.array([15.0, 0.5])
        self.nodes = np.empty(0, dtype=int)

    @rule(by=st.floats(0.3, 6.0))
    def insert(self, by: float) -> None:
        self._move(self.tip + by * self._axis())

    @rule(share=st.floats(0.0, 1.0))
    def withdraw(self, share: float) -> None:
        self._move(self.entry + share * (self.tip - self.entry))

    @rule(angle=st.floats(-0.4, 0.4))
    def redirect(self, angle: float) -> None:
        a = self.tip - self.entry
        turned = [np.cos(angle) * a[0] - np.sin(angle) * a[1], np.sin(angle) * a[0] + np.cos(angle) * a[1]]
        self._move(self.entry + np.array(turned))

    def _axis(self) -> Floats:
        a = self.tip - self.entry
        length = np.hypot(*a)
        return a / length if length > 1e-6 else np.array([0.0, 1.0])

    def _move(self, tip: Floats) -> None:
        self.tip = np.clip(tip, [4.0, 0.0], [28.0, 21.0])
        p, a = GRID.nodes, self.tip - self.entry
        t = np.clip((p - self.entry) @ a / max(float(a @ a), 1e-12), 0.0, 1.0)
        close = np.flatnonzero(np.hypot(*(p - self.entry - t[:, None] * a).T) < 2.2)
        self.nodes = np.intersect1d(close, inner())

    @invariant()
    def response_equals_refit(self) -> None:
        if not hasattr(self, "nodes") or not len(self.nodes):
            return
        q = self.rng.normal(size=(len(self.nodes), 2))
        nodes, tip, e = self.nodes, None, None
        if np.hypot(*(GRID.nodes[nodes] - self.tip).T).min() > 0.2:
            tip, e = self.tip, self.rng.normal(size=2)
        got = ask(self.response, nodes, q, tip, e)
        assert np.abs(got - refit(self.kernel, nodes, q, tip, e)(GRID.nodes)).max() < 1e-7


TestInsertions = Insertions.TestCase
TestInsertions.settings = settings(
    max_examples=30,
    stateful_step_count=40,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    derandomize=True,
)
