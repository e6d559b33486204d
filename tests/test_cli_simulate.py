"""The main job from the command line: what is written, what is said, and what happens to bad input."""

from __future__ import annotations

import inspect
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from echospline.atomic import LOCK
from echospline.io import read, read_displacement
from echospline.mechanics import NeoHookeanModel, describe_core
from echospline.mechanics.finite_elements import METHOD
from echospline.scenario import load

SMALL = [
    *("--mesh", "12x10", "--entry", "10,0", "--angle", "60", "--depth", "6", "--speed", "12"),
    *("--dwell", "0.2", "--fps", "10"),
]


def echospline(*words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "echospline", *words], capture_output=True, text=True, cwd=cwd, check=False
    )


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    answer = echospline(
        "simulate", "sample:calf", "--out", str(out), *SMALL, "--formats", "mp4,gif,png,mha", "--json"
    )
    assert answer.returncode == 0, answer.stderr
    return out, json.loads(answer.stdout)


def test_a_run_leaves_everything_it_names(done):
    out, report = done
    assert {"cine.mp4", "cine.gif", "frames", "cine.mha", "displacement.npz", "summary.png"} < set(
        report["files"]
    )
    for name in report["files"]:
        assert (out / name).exists(), name
    assert not list(out.glob("*.part"))
    assert json.loads((out / "run.json").read_text()) == report
    assert report["parameters"]["needle"]["depth"] == 6.0
    assert report["core"] == describe_core()
    assert set(report["milliseconds_per_frame"]) == {
        "interaction", "spline", "picture", "write",
    }  # fmt: skip


def test_the_written_motion_is_that_of_the_frames(done):
    out, report = done
    record = read_displacement(out / "displacement.npz")
    cine = read(out / "cine.mha")
    assert record.displacement.shape == (report["frames"], 120, 2) == (len(cine), 120, 2)
    assert np.hypot(*record.displacement.reshape(-1, 2).T).max() == pytest.approx(
        report["largest_displacement_mm"]
    )
    np.testing.assert_allclose(record.times, np.arange(report["frames"]) / 10)
    assert np.hypot(*(record.tip - record.entry).T).max() == pytest.approx(6.0)
    assert record.speed.max() == pytest.approx(12.0)


def test_the_resolved_scenario_gives_the_same_numbers(done, tmp_path):
    out, _ = done
    assert load(out / "scenario.toml").needle.depth == 6.0
    again = echospline("simulate", str(out / "scenario.toml"), "--out", str(tmp_path), "--formats", "mha")
    assert again.returncode == 0, again.stderr
    a, b = (read_displacement(folder / "displacement.npz") for folder in (out, tmp_path))
    np.testing.assert_array_equal(a.displacement, b.displacement)
    np.testing.assert_array_equal(read(out / "cine.mha").frames, read(tmp_path / "cine.mha").frames)


def test_forces_are_printed_reported_and_recorded(tmp_path):
    words = (
        "--model",
        "fem",
        "--mesh",
        "12x10",
        "--depth",
        "6",
        "--dwell",
        "0",
        "--no-retract",
        "--fps",
        "5",
        "--formats",
        "mha",
    )
    answer = echospline(
        "simulate", "sample:calf", "--out", str(tmp_path), "--no-figure", "--dead-band", "0.1", *words
    )
    assert answer.returncode == 0, answer.stderr
    report = json.loads((tmp_path / "run.json").read_text())
    loads = read_displacement(tmp_path / "displacement.npz").loads
    assert f"largest tip force {loads['tip_force_N'].max():.3f} N" in answer.stdout
    assert report["largest_forces"] == {name: np.abs(values).max() for name, values in loads.items()}
    assert 0.3 < loads["tip_force_N"].max() <= 0.4
    assert loads["tip_force_N"][0] == 0


def test_a_picture_of_ones_own_with_spacing(tmp_path):
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (80, 100), np.uint8)).save(tmp_path / "my.png")
    answer = echospline(
        *("simulate", "my.png", "--spacing", "0.2,0.2", "--entry", "5,0", "--depth", "5", "--mesh", "10x8"),
        *("--no-retract", "--dwell", "0", "--model", "fem", "--no-figure", "--out", "o"),
        cwd=tmp_path,
    )
    assert answer.returncode == 0, answer.stderr
    assert "largest displacement" in answer.stdout
    assert load(tmp_path / "o" / "scenario.toml").read_image(tmp_path / "o").spacing == (0.2, 0.2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["simulate", "nowhere.png"], "nowhere.png"),
        (["simulate", "my.png"], "--spacing"),
        (["simulate", "sample:calf", "--depth", "-1"], "--depth = -1.0: should be greater than 0"),
        (["simulate", "sample:calf", "--depth", "deep"], "expected a number in mm"),
        (["simulate", "sample:calf", "--mesh", "40"], "--mesh.1 is missing"),
        (["simulate", "sample:calf", "--mesh", "a x b"], "--mesh expects NXxNY"),
        (["simulate", "sample:calf", "--entry", "1;2"], "--entry expects X,Y"),
        (["simulate", "sample:calf", "--clamped", "left,west"], "'west'"),
        (["simulate", "sample:calf", "--clamped", ""], "leaves it free to slide"),
        (["simulate", "sample:calf", "--model", "jelly"], "--model = 'jelly'"),
        (["simulate", "sample:brain"], "brain"),
        (["simulate", "/"], "folder"),
    ],
)
def test_bad_input_is_one_clear_sentence_and_exit_code_2(tmp_path, words, message):
    Image.fromarray(np.zeros((20, 20), np.uint8)).save(tmp_path / "my.png")
    answer = echospline(*words, cwd=tmp_path)
    assert answer.returncode == 2
    assert message in answer.stderr
    assert len(answer.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_results_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "o").write_text("mine")
    answer = echospline("simulate", "sample:calf", "--out", str(tmp_path / "o"), *SMALL)
    assert answer.returncode == 2
    assert "cannot write" in answer.stderr
    assert (tmp_path / "o").read_text() == "mine"


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_killed_run_leaves_no_broken_file_under_a_final_name(tmp_path):
    running = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "echospline",
            "simulate",
            "sample:calf",
            "--out",
            str(tmp_path),
            "--fps",
            "60",
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    until = time.monotonic() + 60
    while time.monotonic() < until and not any(
        f.stat().st_size > 50_000 for f in tmp_path.iterdir() if f.is_file()
    ):
        time.sleep(0.1)
    running.send_signal(signal.SIGKILL)
    assert running.wait() == -signal.SIGKILL
    assert list(tmp_path.glob("*.part"))
    assert not [f for f in tmp_path.iterdir() if f.suffix != ".part" and f.name != LOCK]


def test_help_reads_like_a_manual():
    answer = echospline("simulate", "--help")
    for words in ("--entry", "mm", "range", "default", "--no-retract", "--alpha3", "1/s"):
        assert words in answer.stdout


def test_green_goes_on_when_the_tip_leaves_the_picture_and_comes_back(tmp_path):
    out, run = tmp_path / "out", ["--no-figure", "--fps", "10", "--mesh", "20x15", "--dwell", "0"]
    answer = echospline(
        *["simulate", "sample:calf", "--entry", "40,0", "--angle", "50", "--out", str(out), *run]
    )
    assert answer.returncode == 0, answer.stderr
    record = read_displacement(out / "displacement.npz")
    assert record.tip[:, 0].max() > 50.0  # the picture is 49.8 mm wide
    assert np.hypot(*record.displacement[-1].T).max() < 0.05  # out again


def test_a_run_says_how_green_solved_the_tissue_and_what_it_doubts(tmp_path):
    scenario = tmp_path / "lesion.toml"
    scenario.write_text(
        "[mesh]\nnodes = [20, 15]\n[needle]\nentry = [12.0, 0.0]\nangle = 60.0\ndepth = 20.0\n"
        "[[tissue.region]]\nyoung = 40.0\ncircle = { centre = [22.0, 17.0], radius = 5.0 }\n"
        '[output]\nfps = 10.0\nfigure = false\nformats = ["png"]\n'
    )
    answer = echospline(*["simulate", str(scenario), "--out", str(tmp_path / "out"), "--json"])
    assert answer.returncode == 0, answer.stderr
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert report["solved_by"].startswith("Green's function, regions: ")
    assert any("from an edge or interface" in doubt for doubt in report["doubts"])
    assert "UserWarning" not in answer.stderr
    assert "echospline: doubt: a force at" in answer.stderr
    assert "echospline: note: Green's function, regions" in answer.stderr


def test_neo_hookean_tissue_needs_no_extra_and_says_its_forces(tmp_path):
    run = [
        "--model",
        "fem",
        "--material",
        "neo-hookean",
        "--mesh",
        "12x9",
        "--fps",
        "5",
        "--depth",
        "8",
        "--no-figure",
    ]
    answer = echospline(*["simulate", "sample:calf", "--out", str(tmp_path), *run])
    assert answer.returncode == 0, answer.stderr
    report = json.loads((tmp_path / "run.json").read_text())
    assert report["largest_forces"]["tip_force_N"] == pytest.approx(0.4)
    assert "neo-Hookean" in report["solved_by"]
    assert inspect.signature(NeoHookeanModel).parameters["solver"].default == METHOD


def test_no_edge_is_said_by_none(tmp_path):
    answer = echospline(
        *["simulate", "sample:calf", "--clamped", "none", "--sliding", "none", "--out", str(tmp_path)]
    )
    assert answer.returncode == 2
    assert "no edge" in answer.stderr
