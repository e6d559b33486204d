"""``echospline info`` of files in space: volumes, scenes, tracked sequences and records, against the runs that wrote them."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.cli.info import describe
from echospline.cli.info_space import moves
from echospline.io.volume_writing import write_volume
from echospline.scene import Volume, probe_plane

SCENE = """
[image]
file = "block.mha"
[space.mesh]
nodes = [5, 6, 7]
[space.probe]
width = 20.0
depth = 18.0
pixel = 0.5
path = [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 3.0, 0.0, 4.0, 30.0, 0.0, 0.0]]
[space.needle]
entry = [-7.0, 0.0, 0.0]
depth = 8.0
dwell = 0.0
retract = false
[output]
fps = 4.0
formats = ["igs.mha", "seq.nrrd"]
figure = false
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("info")
    grey = np.random.default_rng(0).integers(20, 200, (31, 25, 29)).astype(np.uint8)
    write_volume(folder / "block.mha", Volume(grey, (0.8, 0.9, 0.7)))
    (folder / "scene.toml").write_text(SCENE)
    done = CliRunner().invoke(
        app, ["simulate", str(folder / "scene.toml"), "--out", str(folder / "run"), "--json"]
    )
    assert done.exit_code == 0, done.output
    return folder


def test_a_volume_is_described_in_the_scenes_frame(folder):
    found = describe(str(folder / "block.mha"))
    assert found["voxels"] == [29, 25, 31, "uint8"]
    assert found["voxel_mm"] == pytest.approx([0.8, 0.9, 0.7])
    assert found["block_mm"] == pytest.approx([28 * 0.8, 24 * 0.9, 30 * 0.7])
    assert any("simulate" in note for note in found["notes"])


def test_a_scene_names_its_probe_mesh_and_needle(folder):
    found = describe(str(folder / "scene.toml"))
    assert found["mesh"] == [5, 6, 7]
    assert found["probe"] == "linear, 20 mm wide, 18 mm deep, on a path of 2 poses"
    assert found["picture"] == "41 x 37 pixels of 0.5 mm"
    assert found["needle"] == "8 mm deep"


@pytest.mark.parametrize("name", ["run.igs.mha", "run.seq.nrrd"])
def test_a_sequence_says_how_far_probe_and_needle_went(folder, name):
    found = describe(str(folder / "run" / name))
    probe = found["transforms"]["ImageToReference"]
    assert probe["frames"] == found["frames"]
    assert probe["turns_degrees"] == pytest.approx(30, abs=0.01)
    needle = found["transforms"]["NeedleTipToReference"]
    assert needle["moves_mm"] == pytest.approx(8, abs=0.01)
    assert any("reconstruct" in note for note in found["notes"])


def test_a_record_lists_every_array_of_its_file_and_the_probes_path(folder):
    path = folder / "run" / "displacement.npz"
    found = describe(str(path))
    with np.load(path) as kept:
        assert found["arrays"] == {name: list(kept[name].shape) for name in kept.files if name != "kind"}
        seen = kept["picture_valid"][:, kept["picture_valid"][0]].mean(axis=1).min()
        assert found["followed_share"] == pytest.approx(seen, abs=1e-4)
    assert found["nodes"] == 5 * 6 * 7
    assert found["probe"] == {"moves_mm": 5.0, "turns_degrees": 30.0}
    assert "mesh" not in found


def test_the_results_of_a_run_name_voxels_and_people_read_the_same(folder):
    found = describe(str(folder / "run"))
    assert found["voxels"] == [29, 25, 31]
    shown = CliRunner().invoke(app, ["info", str(folder / "run")], env={"COLUMNS": "120"}).output
    assert "29 x 25 x 31" in shown
    assert "0.8 lateral, 0.9 along depth, 0.7 across" in shown
    shown = (
        CliRunner()
        .invoke(app, ["info", str(folder / "run" / "displacement.npz")], env={"COLUMNS": "120"})
        .output
    )
    assert "moves 5 mm, turns 30 degrees" in shown


def test_the_samples_are_described_and_the_kidney_is_not_made_for_it(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    kidney = describe("sample:kidney")
    assert kidney["block_mm"] == [112.0, 90.0, 60.0]
    assert "first use" in kidney["format"]
    assert not list(tmp_path.iterdir())
    spine = json.loads(CliRunner().invoke(app, ["info", "sample:spine", "--json"]).output)
    assert spine["block_mm"] == [73.0, 51.5, 52.5]


def test_poses_go_as_far_as_they_were_made_to():
    poses = np.stack([probe_plane((x, 0, 0), yaw).matrix for x, yaw in ((0, 0), (3, 10), (-4, -50))])
    assert moves(poses) == {"moves_mm": 4.0, "turns_degrees": 50.0}
