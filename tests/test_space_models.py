"""What every tissue model in space owes: one list of models against one list of scenes."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.mechanics import Elastic, NeedleForces, SpatialForceModel, SpatialLandmarkModel, ThinPlate
from echospline.mechanics.landmarks import Clamps, contact_lattice
from echospline.mechanics.spatial_landmark_model import IN_SPACE
from echospline.mechanics.spread import bearable, radius_for
from echospline.scene import Circle, Layer, Region, SpatialGrid, SpatialInsertion, SpatialPose, Sphere, Tissue

GRID = SpatialGrid.spanning((-20, 0, -15), (20, 35, 15), (21, 18, 16))
BOX = ("left", "right", "bottom", "front", "back")
SPHERE = Tissue(10.0, 0.45, [Region(Sphere((6.0, 18.0, 0.0), 5.0), 50.0)])
MODELS = {
    "green": lambda **o: SpatialForceModel.green(GRID, BOX, **o),
    "green, sphere": lambda **o: SpatialForceModel.green(GRID, BOX, SPHERE, **o),
    "fem": lambda **o: SpatialForceModel.fem(GRID, BOX, cell=6.0, **o),
    "tps": lambda **o: SpatialLandmarkModel(GRID, BOX, kernel=ThinPlate(3), **o),
    "elastic": lambda **o: SpatialLandmarkModel(GRID, BOX, kernel=Elastic(0.45, 2.0, dimension=3), **o),
}
SCENES = {
    "crossing": SpatialInsertion.straight((-8, 0, -6), (0.46, 0.79, 0.41), 20, 10),
    "in the plane": SpatialInsertion.straight((-10.3, 0, 0), (0.6, 0.8, 0), 15.2, 8),
}
every_model = pytest.mark.parametrize("name", MODELS)
every_scene = pytest.mark.parametrize("scene", SCENES)
MADE = {}


def model(name, **options):
    """Models are set up once: they keep no state."""
    key = (name, *sorted(options.items()))
    if key not in MADE:
        MADE[key] = MODELS[name](**options)
    return MADE[key]


def run(made, insertion, dt=1 / 30, until=None):
    state = made.rest()
    count = round((insertion.duration if until is None else until) / dt)
    for i in range(1, count + 1):
        state = made.advance(state, insertion.pose(i * dt), dt)
    return state


def size(u):
    return np.linalg.norm(u, axis=1)


@every_model
def test_rest_is_a_fixed_point(name):
    made = model(name)
    still = SpatialPose((0, 0, 0), (0, 0, 0))
    state = made.advance(made.rest(), still, 0.5)
    assert not made.field(made.rest())(GRID.nodes).any()
    assert not made.field(state)(GRID.nodes).any()


@every_model
@every_scene
def test_tissue_follows_the_needle_and_clamped_faces_stay(name, scene):
    made, insertion = model(name), SCENES[scene]
    state = run(made, insertion)
    u = made.field(state)(GRID.nodes)
    low, high = GRID.corners
    beside = ((GRID.nodes == low) | (GRID.nodes == high))[:, [0, 2]].any(axis=1) | (GRID.nodes[:, 1] == 35)
    axis = np.array(insertion.pose(insertion.duration).axis)
    assert np.isfinite(u).all()
    assert size(u).max() > 0.3
    assert u[size(u).argmax()] @ axis > 0.9 * size(u).max()
    # boundary forces hold a face in the mean, and least where it meets the free surface; anchors hold it 4 mm apart, not between
    greatest, mean = {"green": (0.03, 0.003), "tps": (0.02, 0.002), "elastic": (0.05, 0.006)}.get(
        name, (0.01, 0.001)
    )
    assert size(u[beside]).max() < greatest * size(u).max()
    assert size(u[beside]).mean() < mean * size(u).max()


@every_model
@pytest.mark.parametrize("mirror", [(-1, 1, 1), (1, 1, -1)], ids=["left and right", "front and back"])
def test_mirrored_scene_gives_mirrored_field(name, mirror):
    m = np.array(mirror, dtype=float)
    made, insertion = model(name), SCENES["crossing"]
    if name == "green, sphere":
        sphere = Sphere(tuple(m * [6.0, 18.0, 0.0]), 5.0)
        other = SpatialForceModel.green(GRID, BOX, Tissue(10.0, 0.45, [Region(sphere, 50.0)]))
    else:
        other = made
    turned = SpatialInsertion(insertion.times, insertion.entry * m, insertion.tip * m)
    points = GRID.nodes
    a = made.field(run(made, insertion, 0.1))(points)
    b = other.field(run(other, turned, 0.1))(points * m)
    np.testing.assert_allclose(b * m, a, atol=2e-3 * size(a).max())


@every_model
@every_scene
def test_the_same_path_in_other_steps_gives_the_same_field(name, scene):
    made, insertion = model(name), SCENES[scene]
    fine, usual, coarse = (made.field(run(made, insertion, dt))(GRID.nodes) for dt in (0.005, 1 / 30, 0.1))
    for u in (usual, coarse):
        assert size(u - fine).max() < 0.02 * size(fine).max()


@every_model
def test_a_needle_that_has_left_is_forgotten(name):
    made = model(name)
    insertion = SpatialInsertion.straight((-8, 0, -6), (0.46, 0.79, 0.41), 12, 10, retract=True)
    reached = size(made.field(run(made, insertion, until=1.2))(GRID.nodes)).max()
    state = run(made, insertion)
    last = insertion.pose(insertion.duration)
    for _ in range(40):
        state = made.advance(state, SpatialPose(last.entry, last.entry), 0.5)
    assert size(made.field(state)(GRID.nodes)).max() < 2e-3 * reached


@every_model
def test_a_step_leaves_the_state_before_it_alone(name):
    made, insertion = model(name), SCENES["crossing"]
    state = run(made, insertion, 0.1, until=1.0)
    before = made.field(state)(GRID.nodes)
    further = made.advance(state, insertion.pose(1.6), 0.1)
    assert size(made.field(further)(GRID.nodes) - before).max() > 0.05
    np.testing.assert_array_equal(made.field(state)(GRID.nodes), before)


@pytest.mark.parametrize("name", ["green", "fem", "green, sphere"])
def test_no_tissue_passes_through_a_sliding_top(name):
    made = model(name, sliding=("top",))
    x, z = np.meshgrid(np.linspace(-18, 18, 25), np.linspace(-13, 13, 21))
    top = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1)
    u = made.field(run(made, SCENES["crossing"], 0.1))(top)
    assert np.abs(u[:, 1]).max() < 1e-5
    assert np.abs(u[:, 0]).max() > 0.05


@pytest.mark.parametrize("name", ["tps", "elastic"])
def test_anchors_of_a_sliding_top_hold_its_normal(name):
    made = model(name, sliding=("top",))
    on = made.anchors.places[:, 1] == 0
    u = made.field(run(made, SCENES["crossing"], 0.1))(made.anchors.places[on])
    assert np.abs(u[:, 1]).max() < 1e-4
    assert np.abs(u[:, 0]).max() > 0.05


@every_model
def test_a_model_survives_pickling(name):
    made, insertion = model(name), SCENES["crossing"]
    again = pickle.loads(pickle.dumps(made))
    a, b = (m.field(run(m, insertion, 0.1))(GRID.nodes) for m in (made, again))
    np.testing.assert_allclose(b, a, atol=1e-6)


def test_negative_time_is_refused():
    for name in ("green", "tps"):
        with pytest.raises(InputError, match="dt must be"):
            model(name).advance(model(name).rest(), SCENES["crossing"].pose(1.0), -1.0)


# ---- forces ----------------------------------------------------------------------------------------------------------------------


def test_green_and_finite_elements_agree():
    insertion = SCENES["crossing"]
    a, b = (model(name) for name in ("green", "fem"))
    inner = GRID.nodes[(np.abs(GRID.nodes - [0, 17.5, 0]) < [19, 17.4, 14]).all(axis=1)]
    u, v = (m.field(run(m, insertion))(inner) for m in (a, b))
    assert size(u - v).mean() < 0.02 * size(v).mean()
    assert run(a, insertion).load.friction == pytest.approx(run(b, insertion).load.friction, rel=0.02)


def test_a_needle_in_a_plane_of_symmetry_has_no_force_across_that_plane():
    made = model("green")
    insertion = SpatialInsertion(
        np.array([0.0, 1.5, 2.5]),
        np.array([-10.0, 0, 0]),
        np.array([[-10.0, 0, 0], [-1.0, 12, 0], [1.0, 12, 0]]),
    )
    state = run(made, insertion)
    u = made.field(state)(GRID.nodes * [1, 1, 0])
    assert np.abs(u[:, 2]).max() < 1e-4 * size(u).max()
    assert abs(state.force[2]) < 1e-6
    np.testing.assert_allclose(state.torque[:2], 0, atol=1e-5)
    assert abs(state.torque[2]) == pytest.approx(state.load.torque)
    assert state.load.side > 0.05


def test_turning_about_the_axis_of_a_symmetric_scene_turns_the_forces():
    """A block as wide as it is thick, and a needle tilted towards +x or towards +z: the law has no preferred direction across."""
    grid = SpatialGrid.spanning((-15, 0, -15), (15, 35, 15), (7, 8, 7))
    made = SpatialForceModel.green(grid, BOX)

    def tilted(direction):
        down, aside = np.array([0.0, 15, 0]), np.array([0.0, 14.5, 0]) + 4 * np.array(direction)
        return run(
            made, SpatialInsertion(np.array([0, 1.5, 2.5]), np.zeros(3), np.array([np.zeros(3), down, aside]))
        )

    a, b = tilted((1.0, 0, 0)), tilted((0, 0, 1.0))
    np.testing.assert_allclose(a.force[[2, 1, 0]], b.force, atol=1e-5)
    np.testing.assert_allclose(-a.torque[[2, 1, 0]], b.torque, atol=1e-4)
    points = grid.nodes
    u, v = made.field(a)(points), made.field(b)(points[:, [2, 1, 0]])
    np.testing.assert_allclose(v[:, [2, 1, 0]], u, atol=1e-4)


def test_a_needle_led_round_a_cone_comes_back_to_its_forces():
    """Directions across the axis turn with it: a closed way of the tip leaves the elastic force across as it was."""
    made = model("green")
    state = run(made, SpatialInsertion.straight((0, 0, 0), (0.1, 1, 0), 15, 10))
    depth = 15.0

    def at(angle):
        a = np.array([0.1 * np.cos(angle), 1, 0.1 * np.sin(angle)])
        return SpatialPose((0, 0, 0), tuple(depth * a / np.linalg.norm(a)))

    loads = []
    for _turn in range(3):
        for k in range(24):
            state = made.advance(state, at(2 * np.pi * (k + 1) / 24), 0.1)
        loads.append(state.force)
    np.testing.assert_allclose(loads[2], loads[1], atol=3e-3)


def test_softer_tissue_spreads_forces_wider_so_that_it_does_not_fold():
    law = NeedleForces()
    radii = [radius_for(law, Tissue(E, 0.45), GRID) for E in (6.0, 10.0, 20.0, 200.0)]
    assert radii == sorted(radii, reverse=True)
    assert radii[-1] == 0.7
    for E, radius in zip((6.0, 10.0, 20.0), radii, strict=False):
        greatest = law.tip + law.friction_limit * law.station_spacing
        assert bearable(E, radius, law.station_spacing) == pytest.approx(greatest)
    with pytest.raises(InputError, match="lower the force to"):
        radius_for(law, Tissue(1.0, 0.45), GRID)


@pytest.mark.parametrize("young", [10.0, 50.0])
def test_the_map_of_the_tissue_is_one_to_one_under_the_tip(young):
    made = SpatialForceModel.green(GRID, BOX, Tissue(young, 0.45))
    insertion = SCENES["crossing"]
    state = run(made, insertion, 0.1)
    field, h = made.field(state), 0.05
    rng = np.random.default_rng(3)
    tip = np.array(insertion.pose(insertion.duration).tip)
    points = tip + rng.uniform(-6, 6, (4000, 3))
    slope = np.stack([(field(points + h * e) - field(points - h * e)) / (2 * h) for e in np.eye(3)], axis=2)
    assert np.linalg.norm(slope, 2, axis=(1, 2)).max() < 1.05
    assert np.linalg.det(np.eye(3) + slope).min() > 0.2
    assert not made.warnings(state)


def test_a_force_that_folds_tissue_is_said():
    made = SpatialForceModel.green(GRID, BOX, radius=0.7)
    said = made.warnings(run(made, SCENES["crossing"], 0.1))
    assert "times what tissue bears" in said["folding"]


def test_the_tip_cuts_at_its_force_and_friction_reaches_its_limit():
    law = NeedleForces()
    load = run(model("green"), SpatialInsertion.straight((-8, 0, -6), (0.46, 0.79, 0.41), 24, 10)).load
    assert load.tip == pytest.approx(law.tip, abs=1e-6)
    assert load.friction == pytest.approx(law.friction_limit * load.cut, rel=0.02)


# ---- landmarks -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", [ThinPlate(3), Elastic(0.45, 2.0, dimension=3)], ids=["tps", "elastic"])
@pytest.mark.parametrize(
    "options", [{}, {"sliding": ("top",)}, {"tissue": SPHERE}], ids=["walls", "probe", "sphere"]
)
def test_the_core_steps_as_the_reference_does(kernel, options):
    parameters = replace(IN_SPACE, anchor_spacing=8.0)
    made = SpatialLandmarkModel(
        GRID, BOX, parameters=parameters, kernel=kernel, precision="double", **options
    )
    reference, insertion = (
        made.reference(),
        SpatialInsertion.straight((-8, 0, -6), (0.46, 0.79, 0.41), 12, 10, retract=True),
    )
    state, other, points = made.rest(), reference.rest(), GRID.nodes[::5]
    for i in range(1, 13):
        pose = insertion.pose(0.2 * i)
        state, other = made.advance(state, pose, 0.2), reference.advance(other, pose, 0.2)
        np.testing.assert_allclose(
            made.field(state)(points), reference.displacement_at(other, points), atol=1e-7
        )
    assert i * 0.2 == pytest.approx(insertion.duration)


@pytest.mark.parametrize("name", ["tps", "elastic"])
def test_a_shaft_between_rows_of_the_coarsest_mesh_is_followed_all_along(name):
    """Nodes at 1.5 mm times root 2, the most that is taken, and a shaft in the middle between four rows of them."""
    h = 1.5 * np.sqrt(2.0)
    grid = SpatialGrid((16, 15, 13), (h, h, h), (-7.5 * h, 0.0, -5.5 * h))
    kernel = ThinPlate(3) if name == "tps" else Elastic(0.45, 2.0, dimension=3)
    made = SpatialLandmarkModel(grid, BOX, kernel=kernel)
    insertion = SpatialInsertion.straight((0, 0, 0), (0, 1, 0), 18.0, 5.0, dwell=0.0, retract=False)
    state = made.rest()
    for i in range(1, 37):
        state = made.advance(state, insertion.pose(0.1 * i), 0.1)
    beside = np.array([[0.0, y, 0.0] for y in (2.0, 5.0, 8.0, 11.0, 14.0)])
    assert made.field(state)(beside)[:, 1].min() > 0.6


@pytest.mark.parametrize(
    ("nodes", "parameters", "said"),
    [
        ((14, 13, 11), IN_SPACE, "take a mesh of 20 x 18 x 16 nodes or more, or a delta of 2.2 mm"),
        ((21, 18, 9), IN_SPACE, "up to 2.14 mm from the next"),
        ((41, 36, 31), replace(IN_SPACE, contact_spacing=3.0), "take a contact_spacing of 2.1 mm or less"),
    ],
)
def test_a_mesh_between_whose_nodes_a_needle_is_lost_is_refused_and_the_remedy_is_one(
    nodes, parameters, said
):
    grid = SpatialGrid.spanning((-20, 0, -15), (20, 35, 15), nodes)
    with pytest.raises(InputError, match=said):
        SpatialLandmarkModel(grid, BOX, parameters=parameters)
    if "contact_spacing" in said:
        SpatialLandmarkModel(grid, BOX, parameters=replace(parameters, contact_spacing=2.1))
    else:
        SpatialLandmarkModel(SpatialGrid.spanning((-20, 0, -15), (20, 35, 15), (20, 18, 16)), BOX)
        SpatialLandmarkModel(grid, BOX, parameters=replace(parameters, delta=2.2))


def test_the_core_lays_the_lattice_of_the_reference_where_nodes_do_not_divide_its_spacing():
    """At 1.3 mm every node is in it: every second one would be 2.6 mm apart, more than the 2 mm asked for."""
    grid = SpatialGrid((13, 12, 11), (1.3, 1.3, 1.3), (-7.8, 0.0, -6.5))
    parameters = replace(IN_SPACE, anchor_spacing=8.0)
    made = SpatialLandmarkModel(grid, BOX, parameters=parameters, precision="double")
    reference = made.reference()
    insertion = SpatialInsertion.straight((0.6, 0, 0.6), (0, 1, 0), 6.0, 5.0, dwell=0.0, retract=False)
    state, other = made.rest(), reference.rest()
    for i in range(1, 7):
        pose = insertion.pose(0.2 * i)
        state, other = made.advance(state, pose, 0.2), reference.advance(other, pose, 0.2)
    points = grid.nodes[::7]
    np.testing.assert_allclose(made.field(state)(points), reference.displacement_at(other, points), atol=1e-7)


@pytest.mark.parametrize("h", [0.6, 0.9, 1.1, 1.3, 1.9])
def test_the_lattice_in_space_is_never_further_apart_than_asked_and_close_to_it(h):
    grid = SpatialGrid((31, 31, 31), (h, h, h))
    at = grid.nodes[contact_lattice(Clamps.of(grid, ("bottom",)), 2.0)]
    gaps = [np.diff(np.unique(np.round(x, 6))).max() for x in at.T]
    assert np.allclose(gaps, gaps[0])
    assert 1.0 < gaps[0] <= 2.0


# ---- what makes no sense ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: SpatialLandmarkModel(GRID, BOX, kernel=ThinPlate(2)), "kernel of dimension 3"),
        (lambda: SpatialForceModel.fem(GRID, BOX, Tissue(10, 0.5)), "take 0.49"),
        (lambda: SpatialForceModel.fem(GRID, BOX, cell=0.5), "take larger cells"),
        (lambda: SpatialForceModel.fem(GRID, BOX, cell=-1.0), "positive number in mm"),
        (
            lambda: SpatialForceModel.green(GRID, BOX, Tissue(10, 0.45, [Region(Circle((0, 10), 3), 50)])),
            "use a sphere or a layer",
        ),
        (lambda: SpatialForceModel.green(GRID, ("lid",)), "an edge is one of"),
    ],
)
def test_what_makes_no_sense_gets_a_sentence(make, said):
    with pytest.raises(InputError, match=said):
        make()


def test_layers_hold_in_space_as_in_the_plane():
    layered = Tissue(10.0, 0.45, [Region(Layer(12.0, 35.0), 50.0)])
    stiff, soft = (
        size(m.field(run(m, SCENES["crossing"], 0.1))(GRID.nodes)).mean()
        for m in (SpatialForceModel.green(GRID, BOX, layered), model("green"))
    )
    assert stiff < 0.7 * soft
