"""Packs of scenes in space, and forced models of hostile packs: read whole or refused, and run by the native core as in Python."""

from __future__ import annotations

import base64
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import page_scene
from echospline.errors import EchosplineError, InputError
from echospline.live import Trace
from echospline.page import Exercise, Pack, packed_space, parsed_sessions, score, verify
from echospline.page.pack import ProbePart
from echospline.page.probe import in_picture
from echospline.page.replay import tissue_of
from echospline.scenario import Scenario, SpatialScene
from echospline.scenario.space_models import build_spatial_model
from echospline.scenario.space_scene import spatial_tissue
from echospline.scene import NeedlePose, Probe, SpatialPose, Volume, probe_plane
from node_here import NODE, STEADY
from test_page_pack import changed, put
from test_page_replay import WASM

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
    "an exercise of the plane": (put("exercises", [page_scene.EXERCISE.model_dump(mode="json")]), "must lie in the image"),
    "a target outside": (put("exercises", 0, "target", "centre", [0.0, 5.0, 99.0]), "z from -8 to 7.5"),
    "an entry by lot": (put("exercises", 0, "entry_between", [1.0, 2.0]), "in the plane alone"),
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
    whole = page_scene.small(**{"model.kind": "green"}) if dimension == 2 else page_scene.uncoded(pack)
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
    assert whole.manifest.models[0].name == "green"
    assert run(whole) == ""


# --- sessions in space


def rows_in(pack, seconds=2.0):
    """In and out again along the pack's own needle."""
    rate, (entry, way) = (
        pack.manifest.rate,
        (np.array(pack.manifest.needle.entry), np.array(pack.manifest.needle.direction)),
    )
    times = np.arange(1, round(seconds * rate) + 1) / rate
    depth = 5.0 * (1 - np.cos(np.pi * times / seconds * 1.4))
    speed = np.diff(depth, prepend=0.0) * rate
    return np.column_stack([np.tile(entry, (len(times), 1)), entry + depth[:, None] * way, speed])


def told(pack, rows, planes=None, **more):
    """A session in space as its page records it."""
    given = page_scene.session(pack, rows, "green", planes=planes, attempt=1, **more)
    (session,) = parsed_sessions(json.dumps(given).encode(), "test")
    return {**given, "score": verify(pack, session).score.to_dict()}


def checked(pack, given):
    (session,) = parsed_sessions(json.dumps(given).encode(), "test")
    return verify(pack, session)


def base64_of(rows):
    return base64.b64encode(np.array(rows, dtype="<f8").tobytes()).decode()


def test_a_session_in_space_is_verified_and_a_flattering_one_is_not(pack):
    rows = rows_in(pack)
    still = [0, *pack.manifest.probe.pose]
    aside = [120, 0.0, 0.0, 6.0, 20.0, 0.0, 0.0]  # from then on the needle is out of the picture
    honest = told(pack, rows, base64_of([still, aside]))
    found = checked(pack, honest)
    assert found.differences == ()
    assert found.trace.dimension == 3
    assert np.abs(found.trace.watched - np.array(pack.manifest.exercises[0].landmarks)).max() > 1e-3
    watching = told(pack, rows, base64_of([still]))["score"]["picture_time"]
    assert 0 < honest["score"]["picture_time"] < watching
    lie = {**honest, "score": {**honest["score"], "picture_time": watching}}
    assert "picture_time" in " ".join(checked(pack, lie).differences)
    quick = told(pack, rows[::3], steps=len(rows[::3]))
    assert any("speed" in said or "jumps" in said for said in checked(pack, quick).differences)


@pytest.mark.parametrize(
    "planes",
    [[[1, 0, 0, 0, 0, 0, 0]], [[0] * 7, [0] * 7], [[0] * 7, [1e6, 0, 0, 0, 0, 0, 0]], [[0.5] + [0] * 6]],
)
def test_planes_that_make_no_sense_are_refused(pack, planes):
    rows = rows_in(pack)
    given = page_scene.session(pack, rows, "green", planes=base64_of(planes))
    with pytest.raises(InputError, match="planes of a session"):
        checked(pack, given)


@given(st.integers(0, 2**32 - 1))
def test_a_motion_of_the_plane_scores_the_same_wherever_its_plane_lies_in_space(seed):
    """Every metric is one of space: a planar session, turned and moved anywhere, keeps them all."""
    rng = np.random.default_rng(seed)
    n = 400
    turns = np.repeat(rng.normal(0, 4, 8), n // 8)
    angle = np.radians(80 + np.cumsum(np.convolve(turns, np.ones(20) / 20, "same") / 20))
    depth = np.clip(np.cumsum(rng.normal(0.03, 0.15, n)), 0, None)
    entry = np.column_stack([10 + 0.001 * np.arange(n), np.zeros(n)])
    tip = entry + depth[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    watched = rng.normal(0, 0.2, (n, 2, 2)).cumsum(axis=0) * 0.02 + [[12.0, 9.0], [9.0, 4.0]]
    flat = Exercise.model_validate(
        {
            "name": "a",
            "title": "A",
            "target": {"centre": (12.0, 9.0), "radius": 2.0},
            "vessels": [{"centre": (9.0, 4.0), "radius": 1.0}],
        }
    )
    R, shift = Rotation.random(random_state=seed % 2**31).as_matrix()[:, :2], rng.normal(0, 30, 3)
    deep = flat.model_copy(
        update={"target": flat.target.model_copy(update={"centre": tuple(R @ flat.target.centre + shift)})}
    )
    plane = score(Trace(0.01, np.column_stack([entry, tip, depth]), watched), flat).to_dict()
    raised = Trace(
        0.01, np.column_stack([entry @ R.T + shift, tip @ R.T + shift, depth]), watched @ R.T + shift
    )
    space = score(raised, deep, np.ones(n, dtype=bool)).to_dict()
    assert space.pop("picture_time") == pytest.approx(plane["tissue_time"])
    for name, value in plane.items():
        assert space[name] == pytest.approx(value, rel=1e-6, abs=1e-6), name
    again = Trace.from_bytes(raised.to_bytes())
    np.testing.assert_array_equal(again.poses, raised.poses)
    np.testing.assert_array_equal(again.watched, raised.watched)


@pytest.mark.parametrize("shape", ["linear", "curved"])
def test_a_tip_is_in_the_picture_where_the_probe_sees_it_and_its_slice_is_thick_enough(shape):
    probe = Probe(shape, width=30.0, radius=25.0, opening=50.0, depth=28.0, pixel=0.2, elevation=0.6)
    (columns, rows), grid = probe.grid.shape, probe.grid
    part = ProbePart(
        shape=shape, columns=columns, rows=rows, spacing=list(grid.spacing), origin=list(grid.origin), radius=25.0, opening=50.0, depth=28.0,
        pose=[0] * 6, elevation=0.6, elevation_depth=probe.elevation_depth, element_height=probe.element_height,
    )  # fmt: skip
    pose = [3.0, 1.0, -2.0, 35.0, 12.0, -20.0]
    local = np.column_stack([RNG.uniform(-20, 20, 3000), RNG.uniform(-5, 35, 3000), RNG.uniform(-4, 4, 3000)])
    plane = probe_plane(pose[:3], *pose[3:])
    tips = local @ plane.matrix[:3, :3].T + plane.matrix[:3, 3]
    wanted = probe.sees(local[:, :2]) & (
        np.abs(local[:, 2]) <= np.maximum(2 * probe.thickness(local[:, 1]), 0.5)
    )
    seen = in_picture(part, np.array([[0, *pose]]), tips)
    assert 100 < wanted.sum() < 2900
    edge = np.abs(local[:, 0]) > probe.width / 2 - 0.4 if shape == "linear" else np.zeros(3000, bool)
    np.testing.assert_array_equal(seen[~edge], wanted[~edge])


@pytest.mark.skipif(NODE is None or not WASM.exists(), reason="Node or echospline.wasm is missing")
@pytest.mark.parametrize("kind", ["green", "elastic"])
def test_every_metric_of_the_page_in_space_is_that_of_the_replay(pack, kind, tmp_path):
    (tmp_path / "scene.pack").write_bytes(pack.to_bytes())
    entry, probe = list(pack.manifest.needle.entry), pack.manifest.probe.pose
    target = list(pack.manifest.exercises[0].target.centre)
    rng = np.random.default_rng(3)
    hands = [[[entry, entry, 10, probe], [entry, target, 150, probe]]]
    for _ in range(7):
        x, z = rng.uniform(-3, 3, 2)
        begin = [float(x), 0.0, float(z)]
        hand = [[begin, begin, 15, probe]]
        for _ in range(rng.integers(2, 6)):
            tip = [float(v) for v in rng.uniform((-6, 3, -4), (6, 14, 4))]
            held = [float(v) for v in np.array(probe) + rng.normal(0, (1, 0, 1.5, 20, 4, 4))]
            hand.append([begin, tip, int(rng.integers(20, 90)), held])
        hands.append([*hand, [begin, begin, 40, probe]] if rng.random() < 0.4 else hand)
    done = subprocess.run(
        [NODE, STEADY, "tests/node/record_session.mjs", str(tmp_path / "scene.pack"), kind, json.dumps(hands)],
        cwd=page_scene.ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = [verify(pack, session) for session in parsed_sessions(done.stdout.encode(), "page")]
    assert [one.differences for one in found] == [()] * len(hands)
    scores = [one.score for one in found]
    assert len({round(s.picture_time, 2) for s in scores}) > 4
    assert len({s.redirections for s in scores}) > 2
    assert max(s.target_shift for s in scores) > 0.05
    assert min(s.final_error for s in scores) < 3.0
    assert found[2].session.planes is not None
