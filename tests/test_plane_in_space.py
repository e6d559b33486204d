"""A picture's plane as the middle of a slab in space: against the model it stands on, and against plane elasticity where that holds."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.mechanics import (
    GreenModel,
    NeedleForces,
    PlaneInSpace,
    SpatialForceModel,
    SpatialLandmarkModel,
)
from echospline.mechanics.fem_response import FEMResponse
from echospline.mechanics.forces import NeedleLoad
from echospline.mechanics.landmarks import Clamps
from echospline.mechanics.plane_in_space import MOST_LAYERS, extruded, faces, slab
from echospline.scenario import MODELS, Scenario, build_model
from echospline.scene import Circle, Layer, NeedlePose, Region, RegularGrid, SpatialPose, Tissue

GRID = RegularGrid((21, 16), (2.0, 2.0), (-20.0, 3.0))
BOX = ("left", "right", "bottom")
LAW = NeedleForces(tip=0.3, friction_limit=0.01)
ENTRY, TIP = (-8.0, 3.0), (2.0, 17.0)


def inserted(model, entry=ENTRY, tip=TIP, steps=8):
    """The model's state after a needle has gone in evenly."""
    state = model.advance(model.rest(), NeedlePose(entry, entry, 0.0), 0.0)
    for s in np.arange(1, steps + 1) / steps:
        at = tuple(np.add(entry, s * np.subtract(tip, entry)))
        state = model.advance(state, NeedlePose(entry, at, 5.0), 0.5)
    return state


def space(kind="green", thickness=40.0, sides="clamped", tissue=None, law=LAW, **more):
    grid, tissue = slab(GRID, thickness), extruded(tissue or Tissue(), GRID.extent[2])
    make = SpatialForceModel.green if kind == "green" else SpatialForceModel.fem
    held = faces(BOX, sides, "clamped")
    return PlaneInSpace(GRID, make(grid, held, tissue, law, sliding=faces((), sides, "sliding"), **more))


def test_the_plane_moves_as_the_middle_of_the_slab_does():
    """Against the model in space driven by hand, with its surface at y = 0 and the picture's at 3 mm."""
    plane = space()
    state = inserted(plane)
    inner = plane.model.rest()
    below = np.array([0.0, -3.0])
    for s in np.arange(9) / 8:
        tip = np.add(ENTRY, s * np.subtract(TIP, ENTRY)) + below
        pose = SpatialPose((ENTRY[0], 0.0, 0.0), (*tip, 0.0), 5.0 if s else 0.0)
        inner = plane.model.advance(inner, pose, 0.5 if s else 0.0)
    p = np.array([[1.0, 20.0], [-11.0, 4.0], [17.0, 30.0]])
    u = plane.model.field(inner)(np.column_stack([p + below, np.zeros(3)]))
    np.testing.assert_allclose(plane.displacement_at(state, p), u[:, :2], rtol=1e-9, atol=1e-12)
    assert np.abs(u).max() > 0.05


@pytest.mark.parametrize("kind", ["green", "fem"])
def test_the_plane_stays_plane(kind):
    tissue = Tissue(10.0, 0.45, [Region(Circle((4.0, 18.0), 5.0), 40.0)]) if kind == "fem" else None
    plane = space(kind, tissue=tissue)
    state = inserted(plane)
    lifted = np.column_stack([GRID.nodes - [0.0, 3.0], np.zeros(GRID.size)])
    u = plane.model.field(state.inner)(lifted)
    assert np.abs(u[:, 2]).max() < 1e-6 * np.abs(u).max()


def test_layers_lie_between_nodes_of_the_slab_evenly_and_the_plane_on_one():
    for thickness in (0.5, 7.0, 40.0, 400.0):
        mesh = slab(GRID, thickness)
        low, high = mesh.corners
        np.testing.assert_allclose([low, high], [[-20, 0, -thickness / 2], [20, 30, thickness / 2]])
        assert mesh.shape[2] % 2 == 1
        assert mesh.shape[2] <= MOST_LAYERS
        assert np.isclose(mesh.nodes[:, 2], 0.0).sum() == GRID.size
    with pytest.raises(InputError, match="thickness of the tissue must be a positive number"):
        slab(GRID, 0.0)


def test_every_section_of_the_slab_is_like_the_picture():
    plane = Tissue(
        10.0,
        0.45,
        [Region(Layer(12.0, 20.0), 30.0, 0.4, "muscle"), Region(Circle((2.0, 22.0), 4.0), 80.0), ],
    )  # fmt: skip
    inside = extruded(plane, 3.0)
    p = np.random.default_rng(2).uniform((-20, 3), (20, 33), (500, 2))
    for z in (-9.0, 0.0, 14.0):
        lifted = np.column_stack([p - [0.0, 3.0], np.full(500, z)])
        np.testing.assert_array_equal(inside.at(lifted), plane.at(p))
    assert len(np.unique(plane.at(p)[0])) == 3


@pytest.mark.parametrize(("sides", "kind", "most"), [("sliding", "strain", 0.02), ("free", "stress", 0.05)])
def test_far_from_forces_a_thin_slab_is_plane_elasticity(sides, kind, most):
    """Sliding sides are plane strain, free ones plane stress but for the ends that walls hold in z too: St. Venant.

    The forces are given, for a needle's depend on how stiff tissue is beside it. Bilinear plane elements against hexahedra.
    """
    thickness, fine = 3.0, RegularGrid((81, 61), (0.5, 0.5), GRID.origin)
    places = np.array([[-1.0, 13.5], [0.0, 15.0], [1.0, 16.5]])
    forces = np.array([[1.0, 1.5], [2.0, 3.0], [3.0, -1.0]]) * 1e-3
    response = space("fem", thickness, sides, cell=2.0, radius=0.7).model.response
    columns = [response.column(np.array([[x, y - 3.0, 0.0]]), np.ones(1)) for x, y in places]
    far = GRID.nodes[np.linalg.norm(GRID.nodes - places[1], axis=1) > 6.5]
    lifted = np.column_stack([far - [0.0, 3.0], np.zeros(len(far))])
    u = response.field_of(columns, np.column_stack([forces, np.zeros(3)]))(lifted)[:, :2]

    def error(of):
        tissue = Tissue(thickness=thickness, plane=of)
        plane = FEMResponse(fine, Clamps.of(fine, BOX), tissue)
        v = plane.answer(places, forces[:, :, None], far)[1][:, :, 0]
        return np.linalg.norm(u - v, axis=1).mean() / np.linalg.norm(v, axis=1).mean()

    assert error(kind) < most
    assert error("stress" if kind == "strain" else "strain") > 0.5


def test_plane_elasticity_is_far_off_where_tissue_is_thick_and_the_model_in_space_is_not():
    """What the model is for: 1 / r against ln r. Finer elements in space are the truth."""
    truth, ours = space("fem", 30.0, cell=2.75), space("green", 30.0)
    plane = GreenModel(GRID, BOX, Tissue(thickness=30.0), LAW, radius=ours.model.response.radius)
    v = truth.displacement(inserted(truth))

    def error(model):
        u = model.displacement(inserted(model))
        return np.linalg.norm(u - v, axis=1).mean() / np.linalg.norm(v, axis=1).mean()

    assert error(ours) < 0.03
    assert error(plane) > 0.25


def test_forces_have_the_signs_of_the_plane():
    """The same shaft that tilts to the same side: components along and across it, and the torque about the point of entry."""
    ours, plane = space(), GreenModel(GRID, BOX, Tissue(thickness=40.0), LAW)
    loads = []
    for model in (ours, plane):
        state = inserted(model)
        tilted = (TIP[0] + 1.0, TIP[1])
        state = model.advance(state, NeedlePose(ENTRY, tilted, 0.0), 0.5)
        loads.append(model.needle_load(state))
    a, b = loads
    assert isinstance(a, NeedleLoad)
    assert a.tip == pytest.approx(b.tip, rel=0.05)
    assert 0.0 < a.cut < np.hypot(10.0, 14.0)
    assert np.sign(a.side) == np.sign(b.side) != 0
    assert np.sign(a.torque) == np.sign(b.torque) != 0
    still = ours.needle_load(ours.rest())
    assert (still.tip, still.side, still.torque) == (0.0, 0.0, 0.0)


def test_landmarks_have_no_forces_and_a_copy_moves_as_its_model():
    model = PlaneInSpace(GRID, SpatialLandmarkModel(slab(GRID, 24.0), (*BOX, "front", "back")))
    assert model.needle_load(inserted(model)) is None
    copy = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(copy.displacement(inserted(copy)), model.displacement(inserted(model)))


def test_a_mesh_that_is_not_the_picture_s_gets_a_sentence():
    other = slab(RegularGrid((21, 16), (2.0, 2.5)), 20.0)
    with pytest.raises(InputError, match="lay it by slab"):
        PlaneInSpace(GRID, SpatialForceModel.green(other))


def test_too_great_a_force_is_said_once():
    plane = space(law=NeedleForces(tip=4.0), radius=1.0)
    with pytest.warns(UserWarning, match="times what tissue bears") as said:
        inserted(plane)
    assert len(said) == 1


@pytest.mark.parametrize("kind", MODELS)
def test_every_model_of_a_scenario_may_be_in_space(kind):
    scenario = Scenario().with_values({
        "model.kind": kind, "model.mechanics": "space", "tissue.thickness": 24.0, "mesh.sides": "sliding",
    })  # fmt: skip
    model = build_model(scenario, GRID)
    assert isinstance(model, PlaneInSpace)
    assert np.abs(model.displacement(inserted(model))).max() > 0.1
    held = model.model.clamps if kind in ("tps", "elastic") else model.model.response.clamps
    assert held.kind("front") == held.kind("back") == "sliding"
    assert held.kind("bottom") == "clamped"
    assert "in the middle of a slab of 24 mm" in model.describe()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"mesh.clamped_points": [[1.0, 2.0]]}, "in space they would be lines or points"),
        ({"tissue.material": "neo-hookean"}, "in the plane alone"),
        ({"model.forces.law": "viscous"}, "in space the law is"),
        ({"model.mechanics": "solid"}, "plane"),
    ],
)
def test_what_is_of_the_plane_alone_gets_a_sentence(values, said):
    with pytest.raises(InputError, match=said):
        build_model(Scenario().with_values({"model.mechanics": "space", **values}), GRID)


def echospline(*words):
    return subprocess.run(
        [sys.executable, "-m", "echospline", *map(str, words)], capture_output=True, text=True, check=False
    )


def test_a_run_in_space_moves_otherwise_and_says_how(tmp_path):
    """The picture that ships; then what only the plane can do is refused."""
    small = ["--model", "green", "--mesh", "21x16", "--fps", "4", "--no-figure"]
    moved = {}
    for mechanics in ("plane", "space"):
        out = tmp_path / mechanics
        done = echospline("simulate", "sample:calf", *small, "--mechanics", mechanics, "--out", out)
        assert done.returncode == 0, done.stderr
        with np.load(out / "displacement.npz") as record:
            moved[mechanics] = record["displacement"].astype(float)
    assert moved["plane"].shape == moved["space"].shape
    assert np.abs(moved["space"] - moved["plane"]).max() > 0.1 * np.abs(moved["plane"]).max()
    report = json.loads((tmp_path / "space" / "run.json").read_text())
    assert report["solved_by"].startswith("in space, in the middle of a slab of 40 mm: closed form")
    refused = echospline("identify", tmp_path / "space", "--out", tmp_path / "found")
    assert refused.returncode == 2
    assert 'model.mechanics = "plane"' in refused.stderr
