"""Edges that are clamped, sliding or free in the landmark models: every combination, both kernels."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echospline.errors import InputError
from echospline.mechanics import (
    AnchoredKernel,
    Clamps,
    Elastic,
    ThinPlate,
    TPSModel,
    TPSParameters,
    anchors_for,
    landmark_stiffness,
)
from echospline.mechanics.spline import factor
from echospline.scene import Circle, NeedlePose, Region, RegularGrid, Tissue

GRID = RegularGrid((81, 61), (0.5, 0.5))  # three nodes on an edge from one anchor to the next
SIDES = ("left", "right", "top", "bottom")
NORMAL = {"left": 0, "right": 0, "top": 1, "bottom": 1}
OPPOSITE = {"left": "right", "right": "left", "top": "top", "bottom": "bottom"}
KERNELS = {"thin plate": ThinPlate(), "elastic": Elastic()}
BETWEEN = {"thin plate": (0.04, 0.013), "elastic": (0.21, 0.03)}
"""Normal displacement between anchors 1.5 and 1 mm apart, at the edge that a needle enters: share of the path's largest displacement."""
FARTHEST = {"thin plate": 0.25, "elastic": 0.6}
"""The same on any path, also where the needle drags nodes half a millimetre beside the edge along or through it; 1.5 mm."""
every_kernel = pytest.mark.parametrize("kernel", KERNELS)


def edges_of(kinds):
    """Clamped and sliding edges of a word such as "csff"."""
    clamped = tuple(side for side, kind in zip(SIDES, kinds, strict=True) if kind == "c")
    return clamped, tuple(side for side, kind in zip(SIDES, kinds, strict=True) if kind == "s")


def is_loose(kinds):
    """Whether tissue could move as a whole: no clamped edge, and none that slides across x or across y."""
    left, right, top, bottom = kinds
    return "c" not in kinds and not ("s" in (left, right) and "s" in (top, bottom))


COMBINATIONS = ["".join(kinds) for kinds in product("csf", repeat=4)]
HELD = [kinds for kinds in COMBINATIONS if not is_loose(kinds)]


def in_and_out(entry, axis, depth, step=1.0, speed=10.0):
    """Poses of a needle that is pushed in and withdrawn, and the time of a step."""
    entry, axis = np.array(entry), np.array(axis) / np.linalg.norm(axis)
    depths = np.arange(step, depth, step)
    for d, v in [(d, speed) for d in depths] + [(d, -speed) for d in depths[::-1]]:
        yield NeedlePose(tuple(entry), tuple(entry + d * axis), v), step / speed


def drive(model, poses):
    """States of a path."""
    state = model.rest()
    for pose, dt in poses:
        state = model.advance(state, pose, dt)
        yield state


def model_of(kernel, kinds, **options):
    clamped, sliding = edges_of(kinds)
    return TPSModel(GRID, clamped, kernel=KERNELS[kernel], sliding=sliding, precision="double", **options)


def normal_displacement(u, kinds):
    """Largest displacement of nodes on held edges in the held components, mm."""
    return max(
        np.abs(u[GRID.boundary((side,))][:, [NORMAL[side]] if kind == "s" else [0, 1]]).max()
        for side, kind in zip(SIDES, kinds, strict=True)
        if kind != "f"
    )


def test_seven_combinations_are_loose_and_say_so():
    assert len(HELD) == 74
    for kinds in set(COMBINATIONS) - set(HELD):
        clamped, sliding = edges_of(kinds)
        for kernel in KERNELS.values():
            with pytest.raises(InputError, match="leaves it free to"):
                TPSModel(GRID, clamped, kernel=kernel, sliding=sliding)


@every_kernel
@pytest.mark.parametrize("kinds", HELD)
def test_held_components_stay_and_free_ones_move(kernel, kinds):
    model = model_of(kernel, kinds, parameters=TPSParameters(anchor_spacing=1.0))
    anchors, edge = model.anchors, np.abs(model.grid.nodes[model.lattice] - [20, 15]) - [20, 15]
    held_edges = [side for side, kind in zip(SIDES, kinds, strict=True) if kind != "f"]
    assert not set(model.lattice) & set(GRID.boundary(held_edges))
    assert (edge <= 0).all()
    largest, worst, slid, lifted = 0.0, 0.0, 0.0, 0.0
    for k, state in enumerate(drive(model, in_and_out((15, 0), (0.5, 1), 20))):
        u = model.displacement(state)
        largest, worst = max(largest, np.abs(u).max()), max(worst, normal_displacement(u, kinds))
        slid = max(slid, np.abs(u[GRID.boundary(("top",)), 0]).max())
        lifted = max(lifted, np.abs(u[GRID.boundary(("top",)), 1]).max())
        if k % 6 == 5:
            at = model.displacement_at(state, anchors.places)
            assert np.abs(at[anchors.held]).max() < 1e-9
    assert largest > 0.5
    assert worst < BETWEEN[kernel][1] * largest
    top = kinds[2]
    assert (slid > 0.1) == (top != "c")
    assert (lifted > 0.2) == (top == "f")


@every_kernel
@pytest.mark.parametrize("axis", [(0, 1), (0.5, 1), (1, 1), (1, 0.5)])
def test_closer_anchors_let_less_tissue_through_the_edge_that_a_needle_enters(kernel, axis):
    grid = RegularGrid((161, 121), (0.25, 0.25))
    shares = []
    for spacing in (1.5, 1.0):
        parameters = TPSParameters(anchor_spacing=spacing)
        model = TPSModel(grid, ("left", "right", "bottom"), parameters, KERNELS[kernel], sliding=("top",))
        largest, worst = 0.0, 0.0
        for state in drive(model, in_and_out((12.3, 0), axis, 20)):
            u = model.displacement(state)
            largest, worst = (
                max(largest, np.abs(u).max()),
                max(worst, np.abs(u[grid.boundary(("top",)), 1]).max()),
            )
        shares.append(worst / largest)
    for share, bound in zip(shares, BETWEEN[kernel], strict=True):
        assert share < bound


@every_kernel
@pytest.mark.parametrize("kinds", HELD)
def test_mirrored_scene_gives_mirrored_field(kernel, kinds):
    mirrored = "".join(dict(zip((OPPOSITE[s] for s in SIDES), kinds, strict=True))[side] for side in SIDES)
    here, there = model_of(kernel, kinds), model_of(kernel, mirrored)
    a = [here.displacement(s) for s in drive(here, in_and_out((13.013, 0), (0.4, 1), 14, 2.0))]
    b = [there.displacement(s) for s in drive(there, in_and_out((26.987, 0), (-0.4, 1), 14, 2.0))]
    for u, v in zip(a, b, strict=True):
        turned = v.reshape(*GRID.shape[::-1], 2)[:, ::-1] * [-1, 1]
        assert np.abs(turned.reshape(-1, 2) - u).max() < 1e-8


@every_kernel
def test_anchors_that_slid_feel_no_force_along_the_edge(kernel):
    # Hold the anchors of an ordinary spline where those of the sliding edge have slid to: the same field, and no force there.
    clamps = Clamps.of(GRID, ("left", "bottom"), None, ("top",))
    anchors = anchors_for(clamps, KERNELS[kernel], 3.0)
    rng = np.random.default_rng(1)
    inside, q = rng.uniform([5, 3], [35, 25], (12, 2)), rng.normal(size=(12, 2))
    places, moves = np.vstack([anchors.places, inside]), np.vstack([np.zeros((len(anchors), 2)), q])
    held = np.vstack([anchors.held, np.ones((12, 2), dtype=bool)])
    slid = factor(KERNELS[kernel], places, held=held).solve(moves)
    moves[: len(anchors)] = slid(anchors.places)
    assert np.abs(moves[: len(anchors)][~anchors.held]).max() > 0.1
    every = factor(KERNELS[kernel], places).solve(moves)
    points = rng.uniform([0, 0], [40, 30], (200, 2))
    assert np.abs(every(points) - slid(points)).max() < 1e-8
    weights = every.weights if kernel == "thin plate" else every.weights.reshape(2, -1).T
    free = weights[: len(anchors)][~anchors.held]
    assert np.abs(free).max() < 1e-8 * np.abs(weights).max()


@every_kernel
def test_a_line_of_symmetry_is_a_sliding_edge(kernel):
    # Landmarks and their mirror images across y = 0: nothing crosses the line, and anchors that slide along it change nothing.
    rng, flip = np.random.default_rng(2), np.array([1, -1])
    inside, q = rng.uniform([5, 3], [35, 25], (10, 2)), rng.normal(size=(10, 2))
    places, moves = np.vstack([inside, flip * inside]), np.vstack([q, flip * q])
    doubled = factor(KERNELS[kernel], places).solve(moves)
    line = np.stack([np.linspace(0, 40, 27), np.zeros(27)], axis=1)
    points = rng.uniform([0, -30], [40, 30], (200, 2))
    assert np.abs(doubled(line)[:, 1]).max() < 1e-10
    assert np.abs(doubled(line)[:, 0]).max() > 0.1
    held = np.ones((len(places) + len(line), 2), dtype=bool)
    held[len(places) :, 0] = False
    sliding = factor(KERNELS[kernel], np.vstack([places, line]), held=held)
    sliding = sliding.solve(np.vstack([moves, np.zeros_like(line)]))
    assert np.abs(sliding(points) - doubled(points)).max() < 1e-8
    # half of the landmarks with that line are another spline: beyond the line its plane is free
    half = np.r_[np.arange(10), np.arange(20, 47)]
    alone = factor(KERNELS[kernel], np.vstack([places, line])[half], held=held[half])
    alone = alone.solve(np.vstack([moves, np.zeros_like(line)])[half])
    assert np.abs(alone(line)[:, 1]).max() < 1e-10
    assert np.abs(alone(points[points[:, 1] > 0]) - doubled(points[points[:, 1] > 0])).max() > 1e-3


def test_where_all_edges_are_clamped_the_two_thin_plates_are_one():
    scene = {"kernel": ThinPlate(), "places": anchors_for(Clamps.of(GRID, SIDES), ThinPlate(), 3.0).places}
    rng = np.random.default_rng(3)
    inside, q = rng.uniform([5, 3], [35, 25], (12, 2)), rng.normal(size=(12, 2))
    places = np.vstack([scene["places"], inside])
    moves = np.vstack([np.zeros_like(scene["places"]), q])
    one = factor(ThinPlate(), places).solve(moves)
    two = factor(ThinPlate().apart(), places).solve(moves)
    points = rng.uniform([0, 0], [40, 30], (200, 2))
    assert np.abs(one(points) - two(points)).max() < 1e-10
    assert np.abs(one.gradient(points) - two.gradient(points)).max() < 1e-10
    assert one.energy() == pytest.approx(two.energy(), rel=1e-9)


def test_one_edge_holds_the_slope_of_a_plate_by_a_second_row_and_two_do_not_need_it():
    parameters = TPSParameters(anchor_spacing=2.0)

    def anchors(kernel, clamped, sliding=()):
        return TPSModel(GRID, clamped, parameters, KERNELS[kernel], sliding=sliding).anchors

    one = anchors("thin plate", ("bottom",))
    assert one.held.all()
    assert set(one.places[:, 1]) == {30.0, 32.0}
    assert set(anchors("elastic", ("bottom",)).places[:, 1]) == {30.0}
    assert anchors("thin plate", ("left", "right", "bottom")).places.min() == 0.0
    mixed = anchors("thin plate", ("bottom",), ("top",))
    outside = mixed.places[:, 1] > 30.0
    assert outside.any()
    assert (mixed.held[outside] == [True, False]).all()  # y is held at both edges, x at one
    point = TPSModel(GRID, ("bottom",), parameters, clamped_points=[(20.0, 10.0)]).anchors
    assert point.places[:, 1].max() == 30.0  # the point holds the slope
    point = TPSModel(GRID, ("bottom",), parameters, clamped_points=[(20.0, 29.0)]).anchors
    assert point.places[:, 1].max() == 32.0  # too near to the edge for that


def test_a_plate_on_one_edge_does_not_tilt():
    model = TPSModel(GRID, ("bottom",), precision="double")
    *_, state = drive(model, list(in_and_out((20, 0), (0, 1), 20))[:19])
    u = model.displacement(state)
    far = np.abs(u[GRID.nodes[:, 0] < 2.0]).max()
    assert np.abs(u).max() < 1.5
    assert far < 0.7 * np.abs(u).max()


def test_both_kinds_of_edges_count_against_the_most_anchors():
    grid = RegularGrid((81, 61), (5.0, 5.0))  # 400 x 300 mm
    assert len(TPSModel(grid, ("bottom",), sliding=("top",)).anchors) > 700
    with pytest.raises(InputError, match=r"needs 15\d\d: check the image's spacing"):
        TPSModel(grid, ("bottom",), TPSParameters(anchor_spacing=0.8), sliding=("top",))


def test_the_push_fades_along_the_needle_towards_a_sliding_edge():
    clamps = Clamps.of(GRID, ("bottom",), None, ("top", "right"))
    down, aslant = np.array([0.0, 1.0]), np.array([0.6, 0.8])
    assert clamps.clearance((20.0, 4.0), down) == 4.0  # as to a clamped edge
    assert clamps.clearance((10.0, 4.0), aslant) == pytest.approx(5.0)  # along the needle
    assert clamps.clearance((38.0, 10.0), down) == 10.0  # along the right edge: only the top counts
    assert clamps.clearance((20.0, 28.0), (1.0, 0.0)) == 2.0  # a clamped edge counts from everywhere
    assert clamps.clearance((20.0, 0.0), (1.0, 0.0)) == 0.0
    assert clamps.clearance((41.0, 10.0), down) == 0.0
    free = Clamps.of(GRID, ("bottom",), [(3.0, 4.0)])
    assert free.clearance((0.0, 0.0), down) == 5.0


@every_kernel
def test_stiffness_of_a_lesion_works_beside_sliding_edges(kernel):
    grid, chosen = RegularGrid((21, 16), (2.0, 2.0)), KERNELS[kernel]
    tissue = Tissue(10.0, regions=(Region(Circle((20.0, 12.0), 6.0), 50.0),))
    clamps = Clamps.of(grid, ("bottom",), None, ("top",))
    anchors = anchors_for(clamps, chosen, 2.0)
    stiffness = landmark_stiffness(tissue, grid, chosen, anchors)
    inside = np.isfinite(stiffness)
    assert inside.any()
    assert (stiffness > 0).all()
    # one landmark alone moves by E_min / E of what is asked, on average over its components
    i = int(np.flatnonzero(inside)[3])
    scene = AnchoredKernel.factor(chosen, anchors.places, grid.nodes[:1], held=anchors.held)
    x = scene.conditioned(grid.nodes[i : i + 1])
    own = np.diag(scene.between(x, x))
    soft = scene.compliance(stiffness[i : i + 1])[0]
    assert soft == pytest.approx(4.0 * own.mean(), rel=1e-9)
    parameters = TPSParameters(contact_spacing=0.0, anchor_spacing=2.0)
    make = {"parameters": parameters, "kernel": chosen, "sliding": ("top",), "precision": "double"}
    soft_model = TPSModel(grid, ("bottom",), **make)
    hard_model = TPSModel(grid, ("bottom",), stiffness=stiffness, **make)
    oracle = TPSModel(
        grid, ("bottom",), parameters, chosen, sliding=("top",), stiffness=stiffness, solver="refit"
    )
    poses = list(in_and_out((20, 0), (0.05, 1), 14))[:13]
    *_, a = drive(soft_model, poses)
    *_, b = drive(hard_model, poses)
    *_, c = drive(oracle, poses)
    assert np.abs(hard_model.displacement(b) - oracle.displacement(c)).max() < 1e-7
    within = [
        np.abs(model.displacement(state)[inside]).mean()
        for model, state in ((soft_model, a), (hard_model, b))
    ]
    assert within[1] < within[0]


@every_kernel
def test_the_anchored_kernel_holds_what_its_anchors_hold(kernel):
    grid, chosen = RegularGrid((21, 16), (2.0, 2.0)), KERNELS[kernel]
    anchors = anchors_for(Clamps.of(grid, ("bottom",), None, ("top", "left")), chosen, 2.0)
    scene = AnchoredKernel.factor(chosen, anchors.places, grid.nodes, held=anchors.held)
    rng = np.random.default_rng(4)
    landmarks, q = rng.uniform([4, 3], [36, 26], (8, 2)), rng.normal(size=(8, 2))
    points = scene.conditioned(landmarks)
    weights = np.linalg.solve(scene.between(points, points), q.reshape(-1, 1))
    held = np.vstack([anchors.held, np.ones((8, 2), dtype=bool)])
    expected = factor(chosen, np.vstack([anchors.places, landmarks]), held=held)
    expected = expected.solve(np.vstack([np.zeros((len(anchors), 2)), q]))(grid.nodes)
    on_mesh = (weights.T @ scene.rows(points)).reshape(2, -1).T
    assert np.abs(on_mesh - expected).max() < 1e-8
    assert np.abs(scene.spline(points, weights)(grid.nodes) - expected).max() < 1e-8


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_node_per_pixel_slides_like_a_coarse_mesh(kernel):
    # above 20 000 nodes the field is interpolated and corrected around every landmark
    coarse, fine = RegularGrid((21, 16), (2.0, 2.0)), RegularGrid((201, 151), (0.2, 0.2))
    fields = []
    for grid in (coarse, fine):
        parameters = TPSParameters(contact_spacing=2.0)
        model = TPSModel(grid, ("bottom",), parameters, KERNELS[kernel], sliding=("top", "left"))
        *_, state = drive(model, list(in_and_out((14, 0), (0.2, 1), 14))[:13])
        spline = model.spline(state)
        u = model.displacement(state)
        assert np.abs(u - spline(grid.nodes)).max() < 0.005
        fields.append(np.abs(u).max())
    assert fields[1] == pytest.approx(fields[0], rel=0.1)


paths = st.fixed_dictionaries(
    {
        "kinds": st.sampled_from(HELD),
        "kernel": st.sampled_from(sorted(KERNELS)),
        "side": st.sampled_from(SIDES),
        "at": st.floats(0.02, 0.98),
        "tilt": st.floats(-1.2, 1.2),
        "depth": st.floats(4.0, 45.0),
        "speed": st.floats(2.0, 40.0),
        "step": st.floats(0.2, 2.0),
    }
)


@given(paths)
@settings(max_examples=60, deadline=None)
def test_no_tissue_passes_through_a_held_edge_whatever_the_needle_does(path):
    inward = {"left": (1, 0), "right": (-1, 0), "top": (0, 1), "bottom": (0, -1)}[path["side"]]
    turn = np.array(
        [[np.cos(path["tilt"]), -np.sin(path["tilt"])], [np.sin(path["tilt"]), np.cos(path["tilt"])]]
    )
    entry = np.array([40.0, 30.0]) * np.where(np.array(inward) == 0, path["at"], np.array(inward) < 0)
    model = model_of(path["kernel"], path["kinds"])
    poses = list(in_and_out(entry, turn @ inward, path["depth"], path["step"], path["speed"]))
    if not poses:
        return
    largest, worst = 0.0, 0.0
    for state in drive(model, poses):
        u = model.displacement(state)
        assert np.isfinite(u).all()
        largest, worst = max(largest, np.abs(u).max()), max(worst, normal_displacement(u, path["kinds"]))
    at = model.displacement_at(state, model.anchors.places)
    assert np.abs(at[model.anchors.held]).max(initial=0.0) < 1e-6
    assert worst < FARTHEST[path["kernel"]] * largest
