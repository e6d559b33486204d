"""Datasets: every sample from its own scenario, resumable, the same whoever makes it."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.errors import InputError
from echospline.io import read, read_displacement
from echospline.scenario import load
from echospline.scene import NeedlePose, RegularGrid
from echospline.study import make_sample
from echospline.study.dataset import Variation, drawn, needle_mask

zarr = pytest.importorskip("zarr")

BASE = """
[model]
kind = "fem"
[mesh]
nodes = [17, 17]
[needle]
entry = [10.0, 0.0]
angle = 90.0
depth = 10.0
[phantom]
size = [20.0, 20.0]
pixel = [0.2, 0.1]
[output]
formats = ["mha"]
figure = false
"""


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    path = tmp_path_factory.mktemp("base") / "base.toml"
    path.write_text(BASE)
    return path


@pytest.fixture(scope="module")
def store(base):
    out = base.parent / "set.zarr"
    report = json.loads(run("dataset", base, "--n", 3, "--frames", 4, "--seed", 5, "--out", out, "--json"))
    assert report["made"] == 3
    return out


def test_arrays_are_chunked_by_sample(store):
    group = zarr.open_group(str(store), mode="r")
    assert group["image"].shape == (3, 4, 200, 100)
    assert group["image"].chunks == (1, 4, 200, 100)
    assert group["displacement"].shape == (3, 4, 17, 17, 2)
    assert group.attrs["frames"] == 4
    images, motion = group["image"][:], group["displacement"][:]
    assert len({image.tobytes() for image in images}) == 3
    assert (motion[:, 0] == 0).all()
    assert (np.abs(motion[:, -1]).max(axis=(1, 2, 3)) > 0.05).all()
    assert (np.diff(group["times"][:], axis=1) > 0).all()


def test_a_sample_is_made_again_by_its_own_scenario(store, tmp_path):
    group = zarr.open_group(str(store), mode="r")
    run("phantom", store / "scenarios" / "0000001.toml", "--out", tmp_path, "--no-echoes", "--json")
    assert np.array_equal(read(tmp_path / "cine.mha").frames, group["image"][1])
    again = read_displacement(tmp_path / "displacement.npz")
    assert np.allclose(again.displacement.reshape(4, 17, 17, 2), group["displacement"][1], atol=1e-6)
    assert np.allclose(again.tip, group["tip"][1])


def test_needle_mask_covers_the_needle(store):
    group = zarr.open_group(str(store), mode="r")
    mask, tip, entry = group["needle_mask"][2, -1], group["tip"][2, -1], group["entry"][2, -1]
    grid = RegularGrid((100, 200), (0.2, 0.1))
    distance = NeedlePose(tuple(entry), tuple(tip)).closest(grid.nodes)[1].reshape(200, 100)
    assert mask.any()
    assert distance[mask].max() <= 1.27 / 2 + 1e-9  # 18 gauge
    assert distance[~mask].min() > 1.27 / 2 - 1e-9
    assert not group["needle_mask"][2, 0].any()


def test_interrupted_run_goes_on_and_more_samples_change_none(store):
    group = zarr.open_group(str(store), mode="r")
    before = group["image"][:]
    lost = store / "tasks" / "0000001.json"
    lost.unlink()  # the state after a kill between two samples
    group = zarr.open_group(str(store), mode="r+")
    group["image"][1] = 0
    report = json.loads(
        run(
            "dataset",
            store.parent / "base.toml",
            "--n",
            4,
            "--frames",
            4,
            "--seed",
            5,
            "--out",
            store,
            "--json",
        )
    )
    assert (report["made"], report["resumed"]) == (2, 2)
    after = zarr.open_group(str(store), mode="r")["image"][:]
    assert np.array_equal(after[:3], before)
    assert after[3].any()


def test_workers_make_the_same_dataset(store, tmp_path):
    pytest.importorskip("distributed")
    out = tmp_path / "other.zarr"
    run(
        "dataset",
        store.parent / "base.toml",
        "--n",
        2,
        "--frames",
        4,
        "--seed",
        5,
        "--out",
        out,
        "--workers",
        2,
        "--json",
    )
    a, b = (zarr.open_group(str(p), mode="r") for p in (store, out))
    for name in ("image", "displacement", "tip", "needle_mask"):
        assert np.array_equal(a[name][:2], b[name][:2])


def test_draws_depend_on_base_index_and_seed_alone(base):
    scene = load(base)
    assert drawn(scene, 7, 1, 8) == drawn(scene, 7, 1, 8)
    others = [drawn(scene, i, s, 8) for i, s in ((7, 2), (8, 1), (71, 0))]
    assert all(other != drawn(scene, 7, 1, 8) for other in others)


def test_draws_stay_within_the_variation(base):
    scene, v = load(base), Variation()
    for index in range(200):
        s = drawn(scene, index, 0, 8)
        assert v.young[0] <= s.tissue.young / scene.tissue.young <= v.young[1]
        assert v.snr[0] <= s.probe.snr <= v.snr[1]
        assert v.entry[0] * 20 <= s.needle.entry[0] <= v.entry[1] * 20
        assert len(s.phantom.region) <= v.inclusions[1]
        assert s.insertion().duration > 0


def test_another_layout_is_refused(store, base):
    result = CliRunner().invoke(app, ["dataset", str(base), "--n", "2", "--frames", "5", "--out", str(store)])
    assert isinstance(result.exception, InputError)
    assert "holds a dataset with other" in str(result.exception)


def test_missing_zarr_names_the_command(monkeypatch, base, tmp_path):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr("echospline.study.dataset.import_module", absent)
    with pytest.raises(ImportError, match="echospline\\[dataset\\]"):
        make_sample(store=str(tmp_path), bases=[str(base)], index=0, seed=0, frames=3)


def test_mask_of_a_needle_of_no_length_is_empty():
    assert not needle_mask(RegularGrid((5, 5), (1.0, 1.0)), (2.0, 0.0), (2.0, 0.0), 1.0).any()
