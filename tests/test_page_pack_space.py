"""Packs of scenes in space, and forced models of hostile packs: read whole or refused, and run by the native core as in Python."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import page_scene
from echospline.errors import EchosplineError, InputError
from echospline.page import Pack, packed_space
from echospline.page.replay import tissue_of
from echospline.scenario import Scenario, SpatialScene
from echospline.scenario.space_models import build_spatial_model
from echospline.scenario.space_scene import spatial_tissue
from echospline.scene import NeedlePose, SpatialPose, Volume, probe_plane
from test_page_pack import changed, put

RNG = np.random.default_rng(9)


def opened():
    """A block of speckle, 24 x 20 x 16 mm, under a linear probe."""
    scenario = Scenario().with_values(
        {
            "title": "Block",
            "model.kind": "green",
            "space.needle.entry": (0.0, 0.0, 0.0),
            "space.needle.direction": (0.3, 0.9, 0.1),
            "space.probe.position": (0.0, 0.0, 0.0),
            "space.probe.yaw": 20.0,
            "space.probe.depth": 18.0,
            "space.probe.width": 20.0,
        },
        "test",
    )
    voxels = RNG.integers(0, 200, (32, 40, 48), dtype=np.uint8)
    volume = Volume(voxels, (0.5, 0.5, 0.5), (-12.0, 0.0, -8.0))
    return SpatialScene(scenario, volume, spatial_tissue(scenario), ())


@pytest.fixture(scope="module")
def scene():
    return opened()


@pytest.fixture(scope="module")
def pack(scene):
    return packed_space(scene)


@pytest.fixture(scope="module")
def data(pack):
    return pack.to_bytes()


def test_a_pack_in_space_comes_back_from_its_bytes(scene, pack, data):
    read = Pack.from_bytes(data)
    assert read.digest == pack.digest
    assert read.to_bytes() == data
    assert read.dimension == 3
    np.testing.assert_array_equal(read.arrays["voxels"], scene.volume.voxels)
    m = read.manifest
    space = scene.scenario.space
    wanted = space.probe.planes(space.needle.insertion()).at(0.0)
    x, y, z, yaw, pitch, roll = m.probe.pose
    np.testing.assert_allclose(probe_plane((x, y, z), yaw, pitch, roll).matrix, wanted.matrix, atol=1e-12)
    assert m.models[0].name == "green"


@pytest.mark.parametrize("kind", ["green", "elastic"])
def test_tissue_of_a_pack_in_space_moves_as_pythons_own(scene, data, kind):
    read = Pack.from_bytes(data)
    tissue = tissue_of(read, read.model(kind))
    own = build_spatial_model(
        scene.scenario, scene.scenario.space.grid(scene.volume), scene.tissue, kind=kind
    )
    state, exact = tissue.rest(), own.rest()
    entry, way = np.array(read.manifest.needle.entry), np.array(read.manifest.needle.direction)
    for k in range(1, 40):
        pose = SpatialPose(tuple(entry), tuple(entry + 0.3 * k * way), 36.0)
        state, exact = tissue.advance(state, pose, 1 / 120), own.advance(exact, pose, 1 / 120)
        if k == 25:
            early = state
    points = entry + way * np.linspace(1.0, 14.0, 8)[:, None] + [0.0, 0.0, 0.4]
    moved = own.field(exact)(points)
    assert np.abs(moved).max() > 0.05
    np.testing.assert_allclose(tissue.displacement_at(state, points), moved, atol=2e-4)
    back = tissue.displacement_at(early, points)  # an earlier state goes on as it was
    assert np.abs(back - moved).max() > 1e-3
    np.testing.assert_array_equal(
        tissue.displacement_at(state, points), tissue.displacement_at(state, points)
    )


HOSTILE = {
    "no probe": (lambda tree: tree.pop("probe") and tree, "a probe"),
    "an image as well": (put("image", {"columns": 2, "rows": 2, "spacing": [1, 1], "origin": [0, 0], "pixels": "voxels"}), "an image"),
    "a volume larger than its array": (put("volume", "shape", [48, 40, 33]), "volume"),
    "a mesh of the plane": (put("mesh", "shape", [4, 4]), "mesh|image"),
    "a probe of another shape": (put("probe", "shape", "round"), "shape"),
    "a pose of five numbers": (put("probe", "pose", [0, 0, 0, 0, 0]), "pose"),
    "corners of another mesh": (put("models", 0, "response", "low", [0, 0, 0]), "low"),
    "a corner that is a number": (put("models", 0, "response", "high", 3), "high"),
    "a lattice of two axes": (put("models", 0, "response", "lattice_shape", [4, 4]), "needs 3 numbers"),
    "no stiffness": (lambda tree: tree["models"][0]["response"].pop("poisson") and tree, "poisson"),
    "an unknown number": (put("models", 0, "response", "level", 9), "level"),
    "a law that is none": (put("models", 0, "options", "source_count", 10**9), "options of a forced tissue"),
    "a table under another name": (put("models", 0, "arrays", {"sources": "green.answers", "conditions": "green.sources", "condition_faces": "green.condition_faces", "answers": "green.conditions"}), "fit"),
    "needle in the plane": (put("needle", "entry", [0.0, 0.0]), "3 numbers"),
    "exercises": (put("exercises", [page_scene.EXERCISE.model_dump(mode="json")]), "no exercises"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_pack_in_space_is_refused_in_one_sentence(data, name):
    change, said = HOSTILE[name]
    with pytest.raises(InputError, match=said) as refused:
        Pack.from_bytes(changed(data, change))
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 500


def run(pack):
    """Step the first model; a refusal in words is an end as good as a number."""
    D = pack.dimension
    try:
        tissue = tissue_of(pack, pack.manifest.models[0])
        state = tissue.rest()
        entry, way = np.array(pack.manifest.needle.entry), np.array(pack.manifest.needle.direction)
        for k in range(1, 8):
            tip = tuple(entry + 0.5 * k * way)
            pose = NeedlePose(tuple(entry), tip, 60.0) if D == 2 else SpatialPose(tuple(entry), tip, 60.0)
            state = tissue.advance(state, pose, 1 / 120)
        tissue.displacement_at(state, entry[None] + way)
    except EchosplineError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("dimension", [2, 3])
def test_tables_with_wild_numbers_end_in_a_step_or_a_sentence(pack, dimension):
    """The core reads tables of strangers: indices, sizes and places that make no sense crash nothing."""
    whole = page_scene.small(**{"model.kind": "green"}) if dimension == 2 else pack
    assert run(whole) == ""
    model = whole.manifest.models[0]
    assert model.kind == "forced"
    rng = np.random.default_rng(4)
    ends = {"stepped": 0, "refused": 0}
    for _ in range(60):
        arrays = dict(whole.arrays)
        role = str(rng.choice(sorted(model.arrays)))
        name = model.arrays[role]
        array = np.array(arrays[name])
        wild = rng.choice(
            [-1, 0, 1, 7, 255, 2**31 - 1, -(2**31)]
            if array.dtype.kind in "iu"
            else [0.0, -1.0, 1e-300, 1e9, -1e300, 1e300]
        )
        if array.dtype == np.uint8:
            wild = abs(int(wild)) % 256
        with np.errstate(over="ignore"):
            array.flat[rng.integers(0, array.size, 3)] = (
                np.clip(wild, -3e38, 3e38) if array.dtype == np.float32 else wild
            )
        arrays[name] = array
        try:
            said = run(Pack(whole.manifest, arrays))
        except InputError as error:
            said = str(error)
        ends["refused" if said else "stepped"] += 1
    assert min(ends.values()) > 0, ends


def test_a_number_of_the_response_out_of_its_range_is_said():
    data = page_scene.small(**{"model.kind": "green"}).to_bytes()
    for key, value in (
        ("radius", 0.0),
        ("radius", -1.0),
        ("weight", -1.0),
        ("band_count", 10**6),
        ("clamped", 4096),
        ("method", 77),
    ):
        try:
            said = run(Pack.from_bytes(changed(data, put("models", 0, "response", key, value))))
        except InputError as error:
            said = str(error)
        assert said, key


def test_the_shipped_spine_is_packed(tmp_path):
    from echospline.scenario import open_spatial  # noqa: PLC0415

    scenario = Scenario().with_values({"image.file": "sample:spine"}, "test")
    whole = packed_space(open_spatial(scenario, Path()))
    assert [model.name for model in whole.manifest.models][0] == "green"
    assert run(whole) == ""
