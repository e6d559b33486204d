"""The core's step against the plain reading of Algorithm 2, which refits at every step, in the plane and in space."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from threadpoolctl import threadpool_limits
from tissues import FACES, Box, Pose, Session, given, handling

from echospline.errors import InputError, SolverError

DT = 1 / 15
WITHIN = {"double": 1e-7, "single": 1e-5}  # mm


@pytest.fixture(autouse=True)
def one_thread():
    with threadpool_limits(1):
        yield


def assert_same_landmarks(state, session, within):
    marks = session.landmarks()
    contacts, D = [m for m in marks if m.node >= 0], session.dimension
    assert [m.node for m in contacts] == state.contacts.tolist()
    assert [m.kind == 0 for m in contacts] == state.touching.tolist()
    for name, ours in (("displacement", state.q), ("grip", state.grip)):
        theirs = np.array([list(getattr(m, name))[:D] for m in contacts]).reshape(-1, D)
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=within)
    np.testing.assert_allclose([m.along for m in contacts], state.along, rtol=0, atol=within)
    tip = marks[len(contacts) :]
    assert len(tip) == (state.tip is not None)
    if state.tip is not None:
        assert (tip[0].kind == 2) == state.tip.pushed
        np.testing.assert_allclose(tip[0].place[:D], state.tip.point, rtol=0, atol=1e-12)
        np.testing.assert_allclose(tip[0].displacement[:D], state.tip.q, rtol=0, atol=within)


CASES = list(
    product(
        (2, 3), ("thin plate", "elastic"), ("stick", "follow", "immediate"), ("point", "node"), (False, True)
    )
)


@pytest.mark.parametrize(("dimension", "kernel", "loading", "tip", "stiff"), CASES)
def test_the_step_gives_the_numbers_of_algorithm_2(dimension, kernel, loading, tip, stiff):
    scene = given(dimension, kernel, stiff=stiff, loading=loading, tip=tip)
    oracle = scene.oracle()
    sessions = {precision: Session(scene, precision) for precision in WITHIN}
    errors = dict.fromkeys(WITHIN, 0.0)
    rng, nodes = np.random.default_rng(2), scene.grid.nodes
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    state = oracle.rest()
    for step, pose in enumerate(handling(dimension, scene.grid, DT)):
        state = oracle.advance(state, pose, DT)
        # at every step where contacts may be, and anywhere; at some steps all of the mesh
        points = np.vstack([nodes[oracle.lattice], rng.uniform(low, high, (40, dimension))])
        expected = oracle.displacement_at(state, points)
        whole = oracle.displacement_at(state, nodes) if dimension == 2 or step % 20 == 12 else None
        for precision, session in sessions.items():
            session.advance(pose, DT)
            error = np.abs(session.displacement_at(points) - expected).max()
            if whole is not None:
                error = max(error, np.abs(session.displacement() - whole).max())
            errors[precision] = max(errors[precision], error)
            assert_same_landmarks(state, session, WITHIN[precision])
            assert session.statistics().held_back == state.held_back
    for precision, within in WITHIN.items():
        assert errors[precision] < within, errors


@pytest.mark.parametrize("kernel", ["thin plate", "elastic"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_what_is_given_shares_nothing_with_what_happened_before(dimension, kernel):
    # the field that a state has is that of its landmarks alone, wherever it is asked for
    scene = given(dimension, kernel)
    oracle, session = scene.oracle(), Session(scene)
    state = oracle.rest()
    for pose in list(handling(5, scene.grid, DT))[:20]:
        state = oracle.advance(state, pose, DT)
        session.advance(pose, DT)
    nodes = scene.grid.nodes
    np.testing.assert_allclose(session.displacement_at(nodes), session.displacement(), rtol=0, atol=1e-9)
    beyond = nodes.mean(axis=0) + 1.5 * (nodes[::11] - nodes.mean(axis=0))
    expected = oracle.displacement_at(state, beyond)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(session.displacement_at(beyond), expected, rtol=0, atol=1e-7)


def rows(points):
    """Points as a set, to 1e-9 mm."""
    return {tuple(np.round(p, 9) + 0.0) for p in points}


@pytest.mark.parametrize("dimension", [2, 3])
def test_anchors_and_sources_are_those_of_the_plain_reading(dimension):
    scene = given(dimension, "thin plate")
    sides = ("left", "right", "top", "bottom", "front", "back")[: 2 * dimension]
    inside = np.array([[7.3, 11.2, 6.1], [20.4, 8.7, 13.3], [13.1, 17.9, 9.4], [25.6, 21.5, 19.8]])[
        :, :dimension
    ]
    cases = [
        (faces, points)
        for n in (2, 3, len(sides))
        for faces in combinations(sides, n)
        for points in (None, inside)
    ]
    for case, (faces, points) in enumerate(cases):
        spacing = (0.0, 1.25, 3.1, 4.2)[case % 4]
        chosen = replace(scene.parameters, contact_spacing=spacing, anchor_spacing=8.0 + case % 3)
        this = replace(scene, clamped=faces, points=points, parameters=chosen)
        oracle, session = this.oracle(), Session(this)
        assert len(rows(oracle.anchors.places)) == len(oracle.anchors.places) == len(session.anchors())
        assert rows(session.anchors()) == rows(oracle.anchors.places)
        assert session.sources().tolist() == oracle.lattice.tolist()


@pytest.mark.parametrize("kernel", ["thin plate", "elastic"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_one_edge_and_sliding_edges_have_the_anchors_of_the_plain_reading(dimension, kernel):
    scene = given(dimension, kernel, anchor_spacing=8.0)
    sides = ("left", "right", "top", "bottom", "front", "back")[: 2 * dimension]
    inside = np.array([[7.3, 11.2, 6.1], [20.4, 8.7, 13.3]])[:, :dimension]
    near = np.array([[7.3, 28.0, 6.1]])[:, :dimension]
    cases = [((side,), ()) for side in sides]
    cases += [(("bottom",), tuple(s for s in sides if s != "bottom"))]
    cases += [(("bottom",), ("top",)), ((), ("left", "top", "front")[:dimension]), ((), sides)]
    for faces, sliding in cases:
        for points in (None, inside, near):
            this = replace(scene, clamped=faces, sliding=sliding, points=points)
            oracle, session = this.oracle(), Session(this)
            assert rows(session.anchors()) == rows(oracle.anchors.places)
            assert len(session.anchors()) == len(oracle.anchors)
            assert session.sources().tolist() == oracle.lattice.tolist()


@pytest.mark.parametrize("dimension", [2, 3])
def test_what_leaves_a_thin_plate_free_is_refused_with_the_direction(dimension):
    scene = given(dimension, "thin plate")
    sliding = ("top", "bottom", "front")[:dimension]
    loose = replace(
        scene, sliding=sliding, points=np.array([[7.3, 11.2, 6.1], [20.4, 8.7, 13.3]])[:, :dimension]
    )
    with pytest.raises(InputError, match="no edge holds the x direction"):
        loose.oracle()
    with pytest.raises(SolverError, match="along x the 2 anchors lie on one"):
        Session(loose)
    assert len(Session(replace(loose, kernel=given(dimension, "elastic").kernel)).anchors()) > 2


SLIDING = {
    2: [
        (("left", "right", "bottom"), ("top",)),
        (("bottom",), ()),
        (("bottom",), ("left", "right", "top")),
        ((), ("left", "top")),
    ],
    3: [(("bottom",), ("top", "left", "right", "front", "back")), ((), ("left", "top", "back"))],
}


@pytest.mark.parametrize("stiff", [False, True])
@pytest.mark.parametrize("kernel", ["thin plate", "elastic"])
@pytest.mark.parametrize(("dimension", "edges"), [(D, edges) for D in (2, 3) for edges in SLIDING[D]])
def test_sliding_edges_give_the_numbers_of_algorithm_2(dimension, edges, kernel, stiff):
    clamped, sliding = edges
    scene = replace(given(dimension, kernel, stiff=stiff), clamped=clamped, sliding=sliding)
    oracle = scene.oracle()
    sessions = {precision: Session(scene, precision) for precision in WITHIN}
    errors = dict.fromkeys(WITHIN, 0.0)
    state, nodes = oracle.rest(), scene.grid.nodes
    where = np.arange(0, len(nodes), 1 if dimension == 2 else 23)
    for step, pose in enumerate(handling(2, scene.grid, DT)):
        state = oracle.advance(state, pose, DT)
        expected = None if dimension == 3 and step % 4 else oracle.displacement_at(state, nodes[where])
        for precision, session in sessions.items():
            session.advance(pose, DT)
            assert_same_landmarks(state, session, WITHIN[precision])
            assert session.statistics().held_back == state.held_back
            if expected is not None:
                error = np.abs(session.displacement_at(nodes[where]) - expected).max()
                error = max(error, np.abs(session.displacement()[where] - expected).max())
                errors[precision] = max(errors[precision], error)
    for precision, within in WITHIN.items():
        assert errors[precision] < within, errors


@pytest.mark.parametrize("kernel", ["thin plate", "elastic"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_tip_beside_a_clamped_side_is_refitted_in_effect(dimension, kernel):
    # in the last millimetres the weights of contacts and anchors are large and of both signs
    scene = given(dimension, kernel, anchor_spacing=4.0 if dimension == 2 else 7.0)
    oracle = scene.oracle()
    sessions = {precision: Session(scene, precision) for precision in WITHIN}
    state, high = oracle.rest(), scene.grid.nodes.max(axis=0)
    entry = np.where(np.arange(dimension) == 1, 0.0, 0.52 * high)
    axis = np.array([0.06, 1.0, -0.04])[:dimension]
    points = np.random.default_rng(3).uniform(scene.grid.nodes.min(axis=0), high, (300, dimension))
    for depth in np.arange(1.0, high[1] + 1.0, 0.8):
        pose = Pose(entry, entry + depth * axis, 8.0)
        state = oracle.advance(state, pose, 0.1)
        expected = oracle.displacement_at(state, points)
        for precision, within in WITHIN.items():
            sessions[precision].advance(pose, 0.1)
            assert np.abs(sessions[precision].displacement_at(points) - expected).max() < within, depth
    assert pose.tip[1] > high[1]


@pytest.mark.parametrize("contact_spacing", [1.0, 2.0])
def test_many_contacts_in_space_are_held_in_single_precision(contact_spacing):
    # hundreds of weights of both signs: terms are far larger than their sum
    dense = given(3, "thin plate", delta=2.5, contact_spacing=contact_spacing, anchor_spacing=8.0)
    dense = replace(dense, grid=Box((29, 23, 21), (1.0, 1.0, 1.0)))
    oracle, session = dense.oracle(), Session(dense, "single")
    state, entry, axis = oracle.rest(), np.array([12.0, 0.0, 9.0]), np.array([0.3, 0.93, 0.2])
    points = np.random.default_rng(3).uniform([0, 0, 0], [28, 22, 20], (300, 3))
    for depth in np.arange(1.5, 21.0, 1.5):
        pose = Pose(entry, entry + depth * axis, 10.0)
        state = oracle.advance(state, pose, 0.15)
        session.advance(pose, 0.15)
        assert np.abs(session.displacement_at(points) - oracle.displacement_at(state, points)).max() < 1e-5
    assert len(state.contacts) > (300 if contact_spacing == 1.0 else 30)


def driven(scene, poses, precision):
    session = Session(scene, precision)
    for pose in poses:
        session.advance(pose, DT)
    return session


# mm; the mirrored field is computed from other numbers: rounding differs
SYMMETRIC = {"double": 1e-9, "single": 1e-5}


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("kernel", ["thin plate", "elastic"])
@pytest.mark.parametrize("axis", [0, 2])
def test_mirrored_box_gives_mirrored_field(axis, kernel, precision):
    scene = given(3, kernel)
    flip = np.where(np.arange(3) == axis, -1.0, 1.0)
    centre = 0.5 * (scene.grid.nodes.min(axis=0) + scene.grid.nodes.max(axis=0))

    def mirror(p):
        return centre + flip * (p - centre)

    poses = list(handling(6, scene.grid, DT))
    here = driven(scene, poses, precision)
    there = driven(scene, [Pose(mirror(p.entry), mirror(p.tip), p.speed) for p in poses], precision)
    u = here.displacement()
    assert np.abs(u).max() > 0.3
    shape = (*scene.grid.shape[::-1], 3)
    mirrored = np.flip(there.displacement().reshape(shape), 2 - axis).reshape(-1, 3) * flip
    assert np.abs(mirrored - u).max() < SYMMETRIC[precision]


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("kernel", ["thin plate", "elastic"])
def test_shifted_box_gives_the_same_field(kernel, precision):
    scene = given(3, kernel)
    by = np.array([100.0, -7.0, 31.0])
    moved = replace(scene, grid=Box(scene.grid.shape, scene.grid.spacing, tuple(by)))
    poses = list(handling(6, scene.grid, DT))
    here = driven(scene, poses, precision)
    there = driven(moved, [Pose(p.entry + by, p.tip + by, p.speed) for p in poses], precision)
    assert np.abs(there.displacement() - here.displacement()).max() < SYMMETRIC[precision]


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("kernel", ["thin plate", "elastic"])
def test_a_needle_in_the_plane_of_symmetry_moves_nothing_out_of_it(kernel, precision):
    scene = given(3, kernel)
    scene = replace(scene, grid=Box((25, 21, 19), (1.5, 1.4, 1.5), (0.0, 0.0, -13.5)))
    plane = np.flatnonzero(np.abs(scene.grid.nodes[:, 2]) < 1e-12)
    assert len(plane) == 25 * 21
    session = Session(scene, precision)
    flat = [
        Pose(p.entry * [1, 1, 0], p.tip * [1, 1, 0], p.speed)
        for p in handling(7, Box((25, 21, 19), (1.5, 1.4, 1.5)), DT)
    ]
    for step, pose in enumerate(flat):
        session.advance(pose, DT)
        if step % 5 == 4:
            u = session.displacement()
            assert np.abs(u[plane, 2]).max() < {"double": 1e-13, "single": 1e-6}[precision]
    assert np.abs(u[:, :2]).max() > 0.3
    assert np.abs(u[:, 2]).max() > (0.01 if kernel == "elastic" else -1.0)


def test_every_side_of_a_box_can_be_clamped_alone_with_points():
    scene = replace(
        given(3, "elastic"), points=np.array([[7.3, 11.2, 6.1], [20.4, 8.7, 13.3], [13.1, 17.9, 9.4]])
    )
    for face in (*FACES[3], "top"):
        this = replace(scene, clamped=(face,))
        oracle, session = this.oracle(), Session(this)
        state = oracle.rest()
        for pose in list(handling(8, scene.grid, DT))[:16]:
            state = oracle.advance(state, pose, DT)
            session.advance(pose, DT)
        held = np.vstack([oracle.anchors.places, scene.grid.nodes[::101]])
        np.testing.assert_allclose(
            session.displacement_at(held), oracle.displacement_at(state, held), rtol=0, atol=1e-7
        )
