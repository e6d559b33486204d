"""What a run in space says before it computes: needles that miss, tips that cannot be seen, words of the plane, and scales that no tissue has."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.io.volume_writing import write_volume
from echospline.scenario import Scenario, check_space, load
from echospline.scenario.space_scale import UNUSED, needle_doubts_in_space
from echospline.scene import SpatialInsertion, Volume

BLOCK = Volume(
    np.random.default_rng(2).integers(20, 200, (61, 81, 101)).astype(np.uint8), (0.5, 0.5, 0.5)
).with_depth("y")  # x -25 to 25, y 0 to 40, z -15 to 15 mm


def scene(**values):
    return Scenario().with_values({"image.file": "v.mha", "space.probe.pixel": 0.4} | values)


@pytest.mark.parametrize(
    ("entry", "direction", "depth", "said"),
    [
        ((-14, 0, 0), (1, 1, 0), 28, None),
        ((-14, 0, 0), (1, -1, 0), 28, "so that nothing moves"),  # upwards
        ((100, 0, 0), (1, 1, 0), 28, "so that nothing moves"),  # beside it
        ((-14, 0, 16), (1, 1, 0), 28, "so that nothing moves"),  # before it
        ((0, 0, 0), (0, 1, 0), 0.4, "no more than 0.4 mm"),
        ((0, -5, 0), (0, 1, 0), 20, None),  # held above the skin
        ((-14, 0, 0), (1, 1, 0), 400, "out of it"),
        ((0, 0, 0), (0, 1, 0), 40.3, None),  # it rests on the bottom
    ],
)
def test_a_needle_that_misses_the_tissue_or_leaves_it_is_told(entry, direction, depth, said):
    doubts = needle_doubts_in_space(SpatialInsertion.straight(entry, direction, depth, 8.0), BLOCK)
    assert [said in doubt for doubt in doubts] == ([] if said is None else [True])


@pytest.mark.parametrize("view", ["longitudinal", "transverse"])
def test_a_view_that_does_not_reach_the_tip_is_told(view):
    deep = {"space.probe.view": view, "space.needle.depth": 45.0}  # 31.8 mm below the skin
    assert check_space(scene(**deep), BLOCK) == []
    (doubt,) = check_space(scene(**deep, **{"space.probe.depth": 30.0}), BLOCK)
    assert "31.82 mm deep" in doubt
    assert "space.probe.depth" in doubt


def test_words_of_the_plane_are_not_dropped_in_silence():
    given = {
        "image.spacing": [0.1, 0.1],
        "image.frame": 3,
        "image.region": [0, 0, 10, 10],
        "mesh.nodes": [5, 5],
        "mesh.clamped": ["left"],
        "mesh.sliding": [],
        "mesh.clamped_points": [[0.0, 0.0]],
        "mesh.sides": "free",
        "needle.entry": [3.0, 0.0],
        "needle.angle": 20.0,
        "needle.depth": 5.0,
        "needle.speed": 3.0,
        "needle.dwell": 0.2,
        "needle.retract": False,
        "needle.retract_speed": 3.0,
        "needle.path": [[0.0, 0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0, 2.0]],
        "tissue.thickness": 20.0,
        "output.border": 7.0,
    }
    assert set(given) == set(UNUSED)
    assert check_space(scene(), BLOCK) == []
    for key, value in given.items():
        told = check_space(scene(**{key: value}), BLOCK)
        assert told[:1] == [
            f"{key} is of scenes in the plane, and this scene in space does not read it: {UNUSED[key]}"
        ], key


def test_what_no_run_in_space_can_have_is_refused():
    for values, said in (
        ({"tissue.material": "neo-hookean"}, "in the plane alone"),
        ({"space.needle.speed": 1e-4}, "frames; expected"),
        ({"space.needle.speed": 0.01, "output.fps": 1.0, "output.longest_step": 1e-5}, "steps; expected"),
    ):
        with pytest.raises(InputError, match=said):
            check_space(scene(**values), BLOCK)
    (doubt,) = check_space(scene(), Volume(BLOCK.voxels, (1.0, 1.0, 1.0)).with_depth("y"))
    assert "put where nothing is known" in doubt
    for spacing in (1e-3, 1e3):  # metres and micrometres for mm
        volume = Volume(BLOCK.voxels, (spacing,) * 3).with_depth("y")
        with pytest.raises(InputError, match="check the spacing in its file, whose unit is mm"):
            check_space(scene(), volume)


def test_a_long_run_is_told_before_it_begins():
    (doubt,) = check_space(scene(**{"output.fps": 1000.0}), BLOCK)
    assert doubt.startswith("a long run: 8,001 frames, about 104 s")


def simulate(*words):
    return subprocess.run(
        [sys.executable, "-m", "echospline", "simulate", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )


def test_speed_dwell_and_window_mean_the_same_in_space(tmp_path):
    path = write_volume(tmp_path / "v.mha", BLOCK)
    words = "--view longitudinal --speed 14 --dwell 0.25 --no-retract --window 40,160 --fps 2 --no-figure --no-displacement"
    done = simulate(path, *words.split(), "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "doubt" not in done.stderr
    space = load(tmp_path / "out" / "scenario.toml").space
    assert (space.needle.speed, space.needle.dwell, space.needle.retract) == (14.0, 0.25, False)
    assert space.window == (40.0, 160.0)


def test_errors_name_the_option_that_was_typed_and_how_a_volume_is_taken(tmp_path):
    path = write_volume(tmp_path / "v.mha", BLOCK)
    for words, said in (
        (["--view", "longitudinal", "--speed", "0"], "echospline: --speed = '0'"),
        (["--needle-entry", "1,2"], "echospline: --needle-entry.2 is missing"),
        ([], "--view longitudinal"),
    ):
        done = simulate(path, *words, "--out", tmp_path / "out")
        assert done.returncode != 0
        assert said in done.stderr
        assert not (tmp_path / "out").exists()
