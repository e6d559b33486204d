"""From a recorded displacement to a scenario that runs: the command as a user gives it."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.errors import InputError
from echospline.io import read_displacement
from echospline.scenario import load
from echospline.study import calibrate
from echospline.tracking import Track, write_track

SCENE = """
[image]
file = "sample:calf"
[mesh]
nodes = [21, 16]
[needle]
entry = [8.0, 0.0]
angle = 50.0
depth = 15.0
speed = 10.0
dwell = 0.5
retract = false
[output]
fps = 10.0
formats = []
figure = false
[model]
kind = "fem"
[model.forces]
tip = 0.3
friction = 2e-3
alpha3 = 0.9
ramp = 0.0
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "scene.toml").write_text(SCENE)
    ran = CliRunner().invoke(app, ["simulate", str(folder / "scene.toml"), "--out", str(folder / "run")])
    assert ran.exit_code == 0, ran.output
    return folder / "run"


def test_identified_forces_are_those_of_the_recording(recorded, tmp_path):
    report = calibrate(field=str(recorded), out=str(tmp_path), bootstrap=20)
    assert report["values"]["tip"] == pytest.approx(0.3, rel=1e-4)
    assert report["values"]["friction"] == pytest.approx(2e-3, rel=1e-3)
    assert report["values"]["alpha3"] == pytest.approx(0.9, rel=0.02)
    assert json.loads((tmp_path / "identification.json").read_text()) == json.loads(json.dumps(report))
    assert {p.name for p in tmp_path.iterdir()} == {
        "identified.toml", "identification.json", "error_map.png", "error_map.svg"
    }  # fmt: skip


def test_a_material_that_is_not_linear_is_refused(recorded, tmp_path):
    scene = (
        (recorded / "scenario.toml").read_text().replace('material = "linear"', 'material = "neo-hookean"')
    )
    (tmp_path / "scene.toml").write_text(scene)
    with pytest.raises(InputError, match=r"set tissue\.material = 'linear'"):
        calibrate(field=str(recorded), out=str(tmp_path), scenario=str(tmp_path / "scene.toml"))


def test_simulate_runs_what_was_identified_and_shows_the_recorded_motion(recorded, tmp_path):
    """The whole circle on the command line: record, identify another model, simulate it, compare."""
    runner = CliRunner()
    found = runner.invoke(
        app, ["identify", str(recorded), "--model", "green", "--out", str(tmp_path / "found"), "--json"]
    )
    assert found.exit_code == 0, found.output
    (report,) = json.loads(found.stdout)["reports"].values()
    ran = runner.invoke(
        app, ["simulate", str(tmp_path / "found" / "identified.toml"), "--out", str(tmp_path / "again")]
    )
    assert ran.exit_code == 0, ran.output
    a, b = (read_displacement(p / "displacement.npz").displacement for p in (recorded, tmp_path / "again"))
    share = np.hypot(*np.moveaxis(a - b, -1, 0)).mean() / np.hypot(*np.moveaxis(a, -1, 0)).mean()
    assert 100 * share == pytest.approx(report["mae_percent_of_mean"], abs=1.5)
    assert share < 0.05


def test_spline_is_identified_with_the_laws_that_it_was_fitted_under(recorded, tmp_path):
    report = calibrate(
        field=str(recorded / "displacement.npz"), out=str(tmp_path), model="tps", bootstrap=0, frames=8
    )
    landmarks = load(tmp_path / "identified.toml").model.landmarks
    assert (landmarks.loading, landmarks.drag) == ("immediate", 0.0)
    assert landmarks.sigma == report["values"]["sigma"]
    assert report["frames"] <= 10


def test_brute_force_is_a_method_too(recorded, tmp_path):
    report = calibrate(field=str(recorded), out=str(tmp_path), method="grid", runs=16, frames=4)
    assert (report["method"], report["runs"]) == ("grid", 16)


def test_a_cohort_gives_one_folder_per_recording_and_resumes(recorded, tmp_path):
    runner = CliRunner()
    copies = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        for file in ("displacement.npz", "scenario.toml"):
            (folder / file).write_bytes((recorded / file).read_bytes())
        copies.append(str(folder))
    command = ["identify", *copies, "--bootstrap", "0", "--out", str(tmp_path / "out")]
    assert runner.invoke(app, command).exit_code == 0
    before = (tmp_path / "out" / "tasks" / "first.json").stat().st_mtime_ns
    assert runner.invoke(app, command).exit_code == 0
    assert (tmp_path / "out" / "tasks" / "first.json").stat().st_mtime_ns == before
    assert (tmp_path / "out" / "second" / "identified.toml").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"field": "nothing.npz", "scenario": "nothing.toml"}, "nothing.toml"),
        ({"field": "nothing.npz"}, "--scenario"),
        ({"model": "rubber"}, "a model is one of"),
        ({"method": "guess"}, "method is"),
        ({"frames": -1}, "frames must be"),
        ({"method": "grid", "runs": 2}, "8 runs or more"),
    ],
)
def test_bad_input_is_refused(recorded, tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        calibrate(**{"field": str(recorded), "out": str(tmp_path), **changes})


@pytest.mark.parametrize("suffix", [".npz", ".mha"])
def test_tracked_motion_is_identified_without_the_points_that_were_lost(recorded, tmp_path, suffix):
    """Half of the points carry nonsense and say so by their confidence; the needle comes from a path of its own."""
    record = read_displacement(recorded / "displacement.npz")
    confidence = np.ones(record.displacement.shape[:2])
    confidence[:, ::2] = 0.1
    spoilt = record.displacement + np.where(confidence < 0.5, 3.0, 0.0)[..., None]
    write_track(tmp_path / f"track{suffix}", Track(record.points, record.times, spoilt, confidence))
    scene = str(recorded / "scenario.toml")
    with pytest.raises(InputError, match="--needle"):
        calibrate(field=str(tmp_path / f"track{suffix}"), out=str(tmp_path / "a"), scenario=scene)
    report = calibrate(
        field=str(tmp_path / f"track{suffix}"), out=str(tmp_path / "b"), scenario=scene, bootstrap=0,
        needle=str(recorded / "displacement.npz"),
    )  # fmt: skip
    assert report["values"]["tip"] == pytest.approx(0.3, rel=1e-2)
    everything = calibrate(
        field=str(tmp_path / f"track{suffix}"), out=str(tmp_path / "c"), scenario=scene, bootstrap=0,
        needle=str(recorded / "displacement.npz"), confidence=0.0,
    )  # fmt: skip
    assert everything["mae_mm"] > 10 * report["mae_mm"]
