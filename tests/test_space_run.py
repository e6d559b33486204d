"""Scenes in space from the command line: what is written, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.io.volume_writing import write_volume
from echospline.scenario import load, validated
from echospline.scenario.space_section import SpaceNeedleSection, view_of
from echospline.scene import Volume

QUICK = ["--fps", "4", "--needle-entry=-10,0,0", "--needle-depth", "12", "--speed", "8"]


def echospline(*words):
    return subprocess.run(
        [sys.executable, "-m", "echospline", *map(str, words)], capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def spine(tmp_path_factory):
    out = tmp_path_factory.mktemp("spine")
    words = [w for w in QUICK if w not in ("--speed", "8")]
    done = echospline("simulate", "sample:spine", "--view", "longitudinal", "--out", out, *words)
    assert done.returncode == 0, done.stderr
    return out


def test_a_run_in_space_leaves_its_files(spine):
    report = json.loads((spine / "run.json").read_text())
    assert set(report["files"]) == {
        "cine.mp4",
        "displacement.npz",
        "summary.png",
        "scenario.toml",
        "run.json",
    }
    assert all((spine / name).stat().st_size > 500 for name in report["files"])
    assert report["largest_displacement_mm"] > 0.3
    with np.load(spine / "displacement.npz") as record:
        frames = len(record["times"])
        assert record["displacement"].shape == (frames, len(record["points"]), 3)
        assert record["plane"].shape == (frames, 4, 4)
        assert record["picture_origins"].shape == (frames, *record["picture_points"].shape[:2], 3)
        deepest = np.linalg.norm(record["tip"] - record["entry"], axis=1)
        assert deepest.max() == pytest.approx(12.0, abs=2.1)
        assert deepest[-1] < 2.1


def test_the_resolved_scenario_gives_the_same_motion(spine, tmp_path):
    done = echospline("simulate", spine / "scenario.toml", "--out", tmp_path, "--no-figure")
    assert done.returncode == 0, done.stderr
    with np.load(spine / "displacement.npz") as first, np.load(tmp_path / "displacement.npz") as again:
        np.testing.assert_array_equal(first["displacement"], again["displacement"])
    assert load(spine / "scenario.toml").space.probe.view == "longitudinal"


def test_a_volume_of_another_type_gets_a_window_that_is_said(tmp_path):
    grey = np.random.default_rng(0).normal(100, 20, (20, 30, 25)).astype(np.float32)
    path = write_volume(tmp_path / "v.mha", Volume(grey, (1.0, 1.0, 1.0)))
    scenario = tmp_path / "s.toml"
    scenario.write_text(
        f'[image]\nfile = "{path.name}"\n[space.probe]\nwidth = 20.0\ndepth = 20.0\npixel = 0.4\n'
    )
    done = echospline(
        "simulate", scenario, "--out", tmp_path / "out", "--fps", "2", "--no-figure", "--needle-depth", "6"
    )
    assert done.returncode == 0, done.stderr
    assert "depth runs along the volume's y axis" in done.stderr
    assert "are shown as black to white" in done.stderr
    low, high = load(tmp_path / "out" / "scenario.toml").space.window
    assert (low, high) == pytest.approx((grey.min(), grey.max()))


def test_views_lie_along_and_across_the_needle():
    insertion = SpaceNeedleSection(direction=(1.0, 1.0, 0.6)).insertion()
    pose = insertion.pose(3.5)
    entry, tip = pose.seen_from(view_of(insertion, "longitudinal"))
    assert abs(entry[2]) < 1e-9
    assert abs(tip[2]) < 1e-9
    entry, tip = pose.seen_from(view_of(insertion, "transverse"))
    assert np.abs([tip[0], tip[2]]).max() < 1e-9
    assert abs(entry[0]) < 1e-9
    with pytest.raises(InputError, match="straight down"):
        view_of(SpaceNeedleSection(direction=(0.0, 1.0, 0.0)).insertion(), "transverse")


@pytest.mark.parametrize(
    ("tree", "said"),
    [
        ({"space": {"mesh": {"clamped": ["top"], "sliding": ["top"]}}}, "both clamped and sliding"),
        ({"space": {"probe": {"shape": "round"}}}, "'curved'"),
        ({"space": {"needle": {"depth": -1}}}, "greater than 0"),
        ({"space": {"prob": {}}}, "did you mean probe"),
    ],
)
def test_what_makes_no_sense_gets_a_sentence(tree, said):
    with pytest.raises(InputError, match=said):
        validated(tree, "x")
