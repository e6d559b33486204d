"""Scenes in space as pages: their packs, the page's engine against the package, and the page in a browser."""

from __future__ import annotations

import json
import shutil
import subprocess

import numpy as np
import pytest

import page_scene
from echospline.errors import InputError
from echospline.page import Pack, bundle, packed_space
from echospline.page.packing_space import pose_of
from echospline.picture import NeedleEcho
from echospline.picture.slices import SliceDrawing
from echospline.scenario import Scenario
from echospline.scenario.space_models import build_spatial_model
from echospline.scenario.space_scene import SpatialScene
from echospline.scene import SpatialPose, Tissue, probe_plane
from node_here import NODE, STEADY
from test_page_engine import WASM
from test_slices import smooth_volume

ALONG, ASIDE = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [2.0, 0.0, 1.0, 70.0, 10.0, -8.0]
HANDS = [
    [[-9.0, 0.0, 0.0], [-9.0, 0.0, 0.0], 10, ALONG],
    [[-9.0, 0.0, 0.0], [0.0, 11.0, 1.0], 70, ALONG],
    [[-9.0, 0.0, 0.0], [3.0, 14.0, 2.0], 50, ASIDE],
]


def opened(kind: str = "green", shape: str = "linear") -> SpatialScene:
    values = {
        "model.kind": kind,
        "space.mesh.nodes": (9, 9, 9)
        if kind == "green"
        else (19, 19, 19),  # landmarks: within delta of needles
        "space.probe.shape": shape,
        "space.probe.width": 24.0,
        "space.probe.radius": 30.0,
        "space.probe.opening": 45.0,
        "space.probe.depth": 24.0,
        "space.probe.pixel": 0.2,
        "space.needle.entry": (-9.0, 0.0, 0.0),
        "space.needle.direction": (0.6, 0.8, 0.0),
    }
    return SpatialScene(Scenario().with_values(values, "test"), smooth_volume(), Tissue(10.0, 0.45), ())


@pytest.fixture(
    scope="module", params=[("green", "linear"), ("green", "curved"), ("elastic", "linear")], ids="-".join
)
def case(request):
    kind, shape = request.param
    scene = opened(kind, shape)
    return kind, scene, packed_space(scene)


# --- packs


def test_a_pack_in_space_is_read_as_it_was_written(case):
    _, scene, pack = case
    again = Pack.from_bytes(pack.to_bytes())
    assert again.manifest == pack.manifest
    assert again.dimension == 3
    np.testing.assert_array_equal(again.arrays["voxels"], scene.volume.voxels)


def test_the_pose_of_a_plane_is_what_places_the_probe_there():
    rng = np.random.default_rng(4)
    for _ in range(50):
        given = [*rng.uniform(-20, 20, 3), rng.uniform(-180, 180), *rng.uniform(-80, 80, 2)]
        np.testing.assert_allclose(pose_of(probe_plane(given[:3], *given[3:])), given, atol=1e-9)


@pytest.mark.parametrize(
    "harm",
    [
        {"volume": None},
        {"probe": None},
        {"volume.shape": [47, 48, 48]},
        {"mesh.shape": [9, 9]},
        {"needle.entry": [0.0, 0.0]},
        {"models.0.response.low": [0.0, 0.0, 0.0]},
        {"models.0.arrays.answers": "green.sources"},
        {"exercises": [page_scene.EXERCISE.model_dump(mode="json")]},
    ],
    ids=lambda harm: next(iter(harm)),
)
def test_a_pack_in_space_that_does_not_fit_is_refused(harm):
    import struct  # noqa: PLC0415

    data = packed_space(opened()).to_bytes()
    (length,) = struct.unpack_from("<I", data, 8)
    head = json.loads(data[12 : 12 + length])
    for path, value in harm.items():
        *way, last = [int(part) if part.isdigit() else part for part in path.split(".")]
        place = head
        for part in way:
            place = place[part]
        place[last] = value
    text = json.dumps(head).encode()
    start = 12 + length + -(12 + length) % 8
    bad = b"ECHOPACK" + struct.pack("<I", len(text)) + text
    bad += bytes(-len(bad) % 8) + data[start:]
    with pytest.raises(InputError):
        Pack.from_bytes(bad)


# --- the engine


@pytest.mark.skipif(NODE is None or not WASM.exists(), reason="Node or echospline.wasm is missing")
def test_the_pages_engine_moves_tissue_and_draws_planes_as_the_package_does(case, tmp_path):
    kind, scene, pack = case
    (tmp_path / "scene.pack").write_bytes(pack.to_bytes())
    out = tmp_path / "out"
    done = subprocess.run(
        [NODE, STEADY, "tests/node/run_engine.mjs", str(tmp_path / "scene.pack"), kind, json.dumps(HANDS), str(out)],
        cwd=page_scene.ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    space = scene.scenario.space
    probe, grid = space.probe.probe(), space.grid(scene.volume)
    columns, rows = probe.grid.shape
    poses = np.fromfile(f"{out}.poses").reshape(-1, 7)
    fields = np.fromfile(f"{out}.fields").reshape(len(poses) // 10, -1, 3)
    pictures = np.fromfile(f"{out}.grey", np.uint8).reshape(len(HANDS), rows, columns)
    model = build_spatial_model(scene.scenario, grid, scene.tissue, kind=kind)
    drawing, state = SliceDrawing(scene.volume, probe), model.rest()
    ends = np.cumsum([steps for _, _, steps, _ in HANDS]).tolist()
    moved = 0.0
    for k, row in enumerate(poses.tolist(), 1):
        pose = SpatialPose(tuple(row[:3]), tuple(row[3:6]), row[6])
        state = model.advance(state, pose, 1 / 120)
        if k % 10 == 0:
            expected = model.field(state)(grid.nodes)
            np.testing.assert_allclose(fields[k // 10 - 1], expected, rtol=0, atol=1e-4)
            moved = max(moved, float(np.abs(expected).max()))
        if k in ends:
            plane = HANDS[ends.index(k)][3]
            drawn = drawing.draw(
                probe_plane(plane[:3], *plane[3:]), model.field(state), pose,
                NeedleEcho() if pose.depth > 1e-9 else None,
            ).image.pixels  # fmt: skip
            apart = np.abs(pictures[ends.index(k)].astype(int) - drawn.astype(int))
            assert apart.max() <= 1, (
                f"{apart.max()} grey levels at {np.unravel_index(apart.argmax(), apart.shape)}"
            )
    assert moved > 0.1


@pytest.mark.skipif(NODE is None, reason="Node is not installed")
def test_planes_of_the_page_are_those_of_the_package(tmp_path):
    rng = np.random.default_rng(6)
    poses = [[*rng.uniform(-20, 20, 3), rng.uniform(-180, 180), *rng.uniform(-80, 80, 2)] for _ in range(20)]
    script = f"""import {{ planeMatrix, lowered, raised, poseOfMatrix, turnedBy }} from "{page_scene.ROOT}/src/echospline/page/static/probe.js";
    const poses = {json.dumps(poses)};
    console.log(JSON.stringify(poses.map((pose, k) => {{
      const m = planeMatrix(pose), p = [3, 4, 5];
      return {{ m, back: poseOfMatrix(m), round: lowered(m, raised(m, p)), twice: planeMatrix(turnedBy(pose, [10, -5, k])) }};
    }})));"""
    (tmp_path / "planes.mjs").write_text(script)
    done = subprocess.run(
        [NODE, STEADY, str(tmp_path / "planes.mjs")], capture_output=True, text=True, timeout=60, check=True
    )
    for k, (pose, found) in enumerate(zip(poses, json.loads(done.stdout), strict=True)):
        matrix = probe_plane(pose[:3], *pose[3:]).matrix
        np.testing.assert_allclose(found["m"], matrix.ravel(), atol=1e-12)
        np.testing.assert_allclose(found["back"], pose, atol=1e-9)
        np.testing.assert_allclose(found["round"], [3, 4, 5], atol=1e-9)
        turn = probe_plane((0.0, 0.0, 0.0), 10.0, -5.0, float(k)).matrix
        np.testing.assert_allclose(found["twice"], (matrix @ turn).ravel(), atol=1e-9)


def test_the_page_of_a_volume_is_one_file(tmp_path):
    if not WASM.exists() or shutil.which("node") is None:
        pytest.skip("echospline.wasm is not built")
    html = bundle(packed_space(opened()))
    assert 'id="scene"' in html
    assert len(html) < 12_000_000
