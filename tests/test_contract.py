"""What every tissue model owes, whoever makes it: one list of models against one list of scenes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import echospline
from echospline.mechanics import (
    Elastic,
    FEMModel,
    GreenModel,
    NeedleForces,
    SpatialForceModel,
    ThinPlate,
    TPSModel,
    TPSParameters,
    ViscousForces,
)
from echospline.mechanics.plane_in_space import PlaneInSpace, slab
from echospline.picture import Deformation
from echospline.scenario import MODELS as NAMES
from echospline.scenario import build_model, load
from echospline.scene import Insertion, NeedlePose, RegularGrid, Tissue

GRID = RegularGrid((21, 16), (2.0, 2.0))
BOX = ("left", "right", "bottom")
STICKING = NeedleForces()
VISCOUS = ViscousForces(0.4, 1e-3, alpha3=1.0, ramp=1.0)
POWERS = {  # of the scene's scale: stress is force per area, so for the same strain in larger tissue forces grow with its square
    "tip": 2, "friction_limit": 1, "tip_stiffness": 1, "station_spacing": 1, "substep": 1, "dead_band": 1, "ramp": 1,
}  # fmt: skip
LANDMARKS = TPSParameters(sigma=0.8, contact_spacing=0.0, anchor_spacing=2.0)


def landmark_model(kernel):
    def make(grid, clamped, scale=1.0):
        lengths = ("sigma", "delta", "length", "anchor_spacing", "friction_speed")
        parameters = replace(LANDMARKS, **{name: scale * getattr(LANDMARKS, name) for name in lengths})
        scaled = Elastic(kernel.nu, kernel.radius * scale) if isinstance(kernel, Elastic) else kernel
        return TPSModel(grid, clamped, parameters, scaled)

    return make


def force_model(kind, law, **lengths):
    def make(grid, clamped, scale=1.0):
        powers = {name: power for name, power in POWERS.items() if hasattr(law, name)}
        forces = replace(law, **{name: getattr(law, name) * scale**power for name, power in powers.items()})
        tissue = Tissue(thickness=40.0 * scale)
        return kind(grid, clamped, tissue, forces, **{name: scale * value for name, value in lengths.items()})

    return make


def in_space(kind, **lengths):
    """The plane z = 0 of a model in space."""

    def make(grid, clamped, scale=1.0):
        powers = {name: power for name, power in POWERS.items() if hasattr(STICKING, name)}
        forces = replace(
            STICKING, **{name: getattr(STICKING, name) * scale**power for name, power in powers.items()}
        )
        tissue = Tissue(thickness=40.0 * scale)
        scaled = {name: scale * value for name, value in lengths.items()}
        whole = slab(grid, tissue.thickness)
        return PlaneInSpace(grid, kind(whole, (*clamped, "front", "back"), tissue, forces, **scaled))

    return make


MODELS = {
    "tps": landmark_model(ThinPlate()),
    "elastic": landmark_model(Elastic(0.45, 1.0)),
    "green": force_model(GreenModel, STICKING, radius=0.4),
    "fem": force_model(FEMModel, STICKING),
    "green, viscous": force_model(GreenModel, VISCOUS, radius=0.4, station_spacing=1.0),
    "fem, viscous": force_model(FEMModel, VISCOUS),
    "green, in space": in_space(SpatialForceModel.green),
    "fem, in space": in_space(SpatialForceModel.fem, cell=5.0),
}
GIVES = {"green, in space": 0.08}
"""Of the largest displacement, by which an edge gives way, if more than 0.02: forces outside a face 8 mm apart do not hold it beside a needle that
enters through it or within 4 mm of it."""
SCENES = {
    "oblique": (BOX, Insertion.straight((12.0, 0.0), 60, 20, 5, dwell=0.5)),
    "straight down": (BOX, Insertion.straight((20.0, 0.0), 90, 18, 8, dwell=0.5)),
    "shallow": (BOX, Insertion.straight((4.0, 0.0), 30, 16, 3, dwell=0.5)),
    "in and out": (BOX, Insertion.straight((26.0, 0.0), 110, 15, 10, dwell=0.3, retract=True)),
    "probe held too": (("top", *BOX), Insertion.straight((14.0, 0.0), 75, 16, 5, dwell=0.5)),
}
SHIPPED = sorted((Path(echospline.__file__).parent / "data").glob("*.toml"))
every_model = pytest.mark.parametrize("model", MODELS)
every_scene = pytest.mark.parametrize("scene", SCENES)


def run(model, insertion, frames=12):
    """States at evenly spaced times."""
    times = np.linspace(0.0, insertion.duration, frames + 1)
    state, states = model.rest(), []
    for k, t in enumerate(times):
        state = model.advance(state, insertion.pose(float(t)), 0.0 if k == 0 else t - times[k - 1])
        states.append(state)
    return states


def size(u):
    return np.hypot(u[:, 0], u[:, 1])


def test_the_list_of_models_is_the_program_s():
    assert {name.partition(",")[0] for name in MODELS} == set(NAMES)


@every_model
@every_scene
def test_rest_is_a_fixed_point(model, scene):
    clamped, insertion = SCENES[scene]
    made = MODELS[model](GRID, clamped)
    still = insertion.pose(0.0)
    state = made.advance(made.rest(), NeedlePose(still.entry, still.tip, 0.0), 0.5)
    assert not made.displacement(made.rest()).any()
    assert not made.displacement(state).any()


@every_model
@every_scene
def test_tissue_follows_the_needle_and_clamped_edges_stay(model, scene):
    clamped, insertion = SCENES[scene]
    made = MODELS[model](GRID, clamped)
    inserted = [
        s
        for s, t in zip(run(made, insertion), range(13), strict=True)
        if insertion.pose(t * insertion.duration / 12).speed > 0
    ]
    u = made.displacement(inserted[-1])
    axis = np.array(insertion.pose(insertion.times[1]).axis)
    largest = size(u).argmax()
    assert np.isfinite(u).all()
    assert size(u).max() > 0.1
    assert u[largest] @ axis > 0.7 * size(u)[largest]
    assert size(u)[GRID.boundary(clamped)].max() < GIVES.get(model, 0.02) * size(u).max()


@every_model
@every_scene
def test_mirrored_scene_gives_mirrored_field(model, scene):
    clamped, insertion = SCENES[scene]
    made = MODELS[model](GRID, clamped)
    middle = np.array([40.0, 0.0])
    turned = Insertion(insertion.times, middle + insertion.entry * [-1, 1], middle + insertion.tip * [-1, 1])
    a, b = (made.displacement(run(made, i)[-1]).reshape(16, 21, 2) for i in (insertion, turned))
    np.testing.assert_allclose(b[:, ::-1] * [-1, 1], a, atol=2e-4)


@every_model
@every_scene
def test_relaxation_does_not_depend_on_the_time_step(model, scene):
    clamped, insertion = SCENES[scene]
    made = MODELS[model](GRID, clamped)
    reached = run(made, insertion)[-1]
    last = insertion.pose(insertion.duration)
    still = NeedlePose(last.entry, last.tip, 0.0)
    at_once = made.advance(reached, still, 0.4)
    in_steps = reached
    for _ in range(8):
        in_steps = made.advance(in_steps, still, 0.05)
    np.testing.assert_allclose(made.displacement(in_steps), made.displacement(at_once), atol=2e-3)


@every_model
@every_scene
def test_smaller_steps_converge(model, scene):
    clamped, insertion = SCENES[scene]
    made = MODELS[model](GRID, clamped)
    coarse, middle, fine = (made.displacement(run(made, insertion, n)[-1]) for n in (25, 50, 100))
    assert size(fine - middle).max() < max(0.75 * size(middle - coarse).max(), 0.03 * size(fine).max() + 1e-3)


@every_model
@every_scene
def test_a_needle_that_has_left_is_forgotten(model, scene):
    clamped, insertion = SCENES[scene]
    made = MODELS[model](GRID, clamped)
    state = run(made, insertion)[-1]
    largest = size(made.displacement(state)).max()
    pose = insertion.pose(insertion.duration)
    steps = 30
    for k in range(1, steps + 1):
        tip = np.asarray(pose.tip) + k / steps * np.subtract(pose.entry, pose.tip)
        state = made.advance(
            state,
            NeedlePose(pose.entry, tuple(tip), -5.0 if pose.depth else 0.0),
            pose.depth / 5 / steps + 1e-3,
        )
    for _ in range(60):
        state = made.advance(state, NeedlePose(pose.entry, pose.entry, 0.0), 0.5)
    assert size(made.displacement(state)).max() < 2e-3 * max(largest, 1.0)


@every_model
@every_scene
def test_another_unit_of_length_changes_nothing(model, scene):
    """The same scene written in units of a tenth: every length ten times the number, every strain the same."""
    clamped, insertion = SCENES[scene]
    large = RegularGrid(GRID.shape, (20.0, 20.0))
    scaled = Insertion(insertion.times, insertion.entry * 10, insertion.tip * 10)
    small_model, large_model = MODELS[model](GRID, clamped), MODELS[model](large, clamped, 10.0)
    a, b = (
        small_model.displacement(run(small_model, insertion)[-1]),
        large_model.displacement(run(large_model, scaled)[-1]),
    )
    np.testing.assert_allclose(b / 10, a, atol=1e-3 * max(size(a).max(), 0.1))


@every_model
@every_scene
def test_a_step_leaves_the_state_before_it_alone(model, scene):
    clamped, insertion = SCENES[scene]
    made = MODELS[model](GRID, clamped)
    states = run(made, insertion, 6)
    kept = made.displacement(states[3]).copy()
    made.advance(states[3], insertion.pose(insertion.duration), 0.2)
    np.testing.assert_array_equal(made.displacement(states[3]), kept)


@every_model
@every_scene
def test_field_at_nodes_is_the_field_at_points(model, scene):
    clamped, insertion = SCENES[scene]
    made = MODELS[model](GRID, clamped)
    state = run(made, insertion, 7)[4]
    np.testing.assert_allclose(made.displacement_at(state, GRID.nodes), made.displacement(state), atol=2e-4)


@every_model
@every_scene
def test_same_steps_give_the_same_field(model, scene):
    clamped, insertion = SCENES[scene]
    a, b = (MODELS[model](GRID, clamped) for _ in range(2))
    np.testing.assert_array_equal(
        a.displacement(run(a, insertion)[-1]), b.displacement(run(b, insertion)[-1])
    )


@pytest.mark.parametrize("scenario", SHIPPED, ids=lambda path: path.stem)
@pytest.mark.parametrize("model", NAMES)
def test_no_picture_folds_in_the_shipped_scenarios(model, scenario):
    scene = load(scenario)
    image = scene.read_image(scenario.parent)
    grid = scene.grid(image)
    made, insertion = build_model(scene, grid, kind=model, folder=scenario.parent), scene.insertion()
    for state in run(made, insertion, 24):
        assert Deformation(grid, made.displacement(state)).folds is None
