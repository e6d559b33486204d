"""Identification in space: what a picture shows of a run gives back the parameters of the run."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.errors import InputError
from echospline.io import read_spatial_displacement
from echospline.io.volume_writing import write_volume
from echospline.picture.simulate_space import simulate_space
from echospline.picture.slices import lattice_of
from echospline.scenario import load, open_spatial
from echospline.scenario.space_models import build_spatial_model
from echospline.scene import Volume
from echospline.study.calibrate import _report
from echospline.study.spatial_fit import PictureRuns, SeenRun, fit_in_space
from echospline.study.unit_fields import Observation

TRUE = {"tip": 0.2, "friction_limit": 0.02}
SCENE = """
[image]
file = "block.mha"
[space.mesh]
nodes = [9, 9, 9]
[space.probe]
width = 20.0
depth = 18.0
pixel = 0.25
path = [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [2.0, 0.5, 0.0, 0.3, 4.0, 0.0, 2.0]]
[space.needle]
entry = [-7.0, 0.0, 0.0]
direction = [1.0, 1.0, 0.0]
depth = 10.0
speed = 8.0
dwell = 0.3
retract = false
[model.forces]
tip = 0.2
friction_limit = 0.02
[output]
fps = 5.0
formats = ["mha"]
figure = false
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    grey = np.random.default_rng(0).integers(20, 200, (31, 25, 31)).astype(np.uint8)
    write_volume(folder / "block.mha", Volume(grey, (0.8, 0.8, 0.8)))
    (folder / "scene.toml").write_text(SCENE)
    (folder / "start.toml").write_text(
        SCENE.replace("tip = 0.2\n", "tip = 0.4\n").replace("friction_limit = 0.02", "friction_limit = 0.006")
    )
    done = CliRunner().invoke(
        app, ["simulate", str(folder / "scene.toml"), "--out", str(folder / "run"), "--json"]
    )
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture(scope="module")
def opened(scene):
    return open_spatial(load(scene / "scene.toml"), scene)


@pytest.fixture(scope="module")
def frames(opened):
    space = opened.scenario.space
    insertion, grid = space.needle.insertion(), space.grid(opened.volume)
    model = build_spatial_model(opened.scenario, grid, opened.tissue)
    probe = space.probe.probe()
    return list(
        simulate_space(opened.volume, probe, space.probe.planes(insertion), insertion, model, fps=5.0)
    )


def runs(opened, frames, chosen, noise=0.0, **values):
    probe = opened.scenario.space.probe.probe()
    seen = [frame.seen_from(frames[0], probe, opened.volume) for frame in frames]
    u = np.array([np.where(s.valid[:, None], s.displacement, np.nan) for s in seen])[chosen]
    u += noise * np.random.default_rng(1).normal(size=u.shape)
    observed = SeenRun(lattice_of(probe).nodes, np.array([f.time for f in frames]), np.array(chosen), u)
    scenario = opened.scenario.with_values({f"model.forces.{n}": v for n, v in values.items()})
    return PictureRuns(scenario, opened.scenario.space.grid(opened.volume), opened.tissue, observed)


def test_a_simulated_picture_moves_as_the_run_that_it_repeats(opened, frames):
    repeated = runs(opened, frames, [2, 5, 8])
    found = repeated.run(TRUE)
    known = np.isfinite(repeated.seen.displacement)
    assert known.mean() > 0.3
    np.testing.assert_allclose(found[known], repeated.seen.displacement[known], atol=1e-9)


def test_parameters_come_back_from_the_motion_in_the_picture(opened, frames):
    found = fit_in_space(runs(opened, frames, [2, 4, 6, 8], tip=0.4, friction_limit=0.006), "rmse")
    assert found.values == pytest.approx(TRUE, rel=0.01)
    assert found.error.mae < 2e-4
    assert found.method == "simulated"


def test_noise_stays_in_the_error_and_its_intervals_hold_the_truth(opened, frames):
    found = fit_in_space(
        runs(opened, frames, [2, 3, 4, 5, 6, 7, 8], 0.02, tip=0.3, friction_limit=0.03), "mae"
    )
    assert found.values == pytest.approx(TRUE, rel=0.1)
    assert found.error.rmse == pytest.approx(0.02 * np.sqrt(2), rel=0.1)
    for name, (low, high) in found.intervals.items():
        assert low < found.values[name] < high
        assert low - 0.02 * TRUE[name] < TRUE[name] < high + 0.02 * TRUE[name]


def test_a_probe_that_moves_over_still_tissue_identifies_nothing(opened, frames):
    still = runs(opened, frames, [2, 4])
    seen = still.seen
    moved = still.still()
    assert np.abs(moved).max() > 0.2
    same = PictureRuns(
        still.scenario, still.grid, still.tissue, SeenRun(seen.points, seen.times, seen.chosen, moved)
    )
    with pytest.raises(InputError, match="no motion but the probe's own"):
        fit_in_space(same)


def test_identify_takes_a_run_in_space_and_writes_a_scenario_that_repeats_it(scene):
    out = scene / "found"
    words = ["identify", scene / "run", "--scenario", scene / "start.toml", "--out", out, "--bootstrap", 0]
    done = CliRunner().invoke(app, [str(w) for w in words])
    assert done.exit_code == 0, done.output
    told = json.loads((out / "identification.json").read_text())
    assert told["in_space"]
    assert told["values"] == pytest.approx(TRUE, rel=0.02)
    assert told["mae_percent_of_mean"] < 2
    again = scene / "again"
    done = CliRunner().invoke(app, ["simulate", str(out / "identified.toml"), "--out", str(again), "--json"])
    assert done.exit_code == 0, done.output
    first, second = (
        read_spatial_displacement(folder / "displacement.npz") for folder in (scene / "run", again)
    )
    difference = np.linalg.norm(first.displacement - second.displacement, axis=2)
    assert difference.max() < 0.03 * np.linalg.norm(first.displacement, axis=2).max()


@pytest.mark.parametrize("rounding", [0.0, 1e-14])
def test_a_moment_at_which_nothing_moves_but_by_rounding_has_no_error(opened, frames, rounding):
    chosen = [0, 4, 8]
    observed = runs(opened, frames, chosen)
    found = fit_in_space(observed, "mae", bootstrap=0)
    seen = observed.seen.displacement - observed.still()
    seen[0] = rounding
    motion = Observation(observed.seen.points, seen, observed.seen.times[chosen], [None] * 3)
    told = _report("green", "mae", Path("run.npz"), motion, found)["per_frame"]
    assert told[0]["mae_mm"] is None
    assert told[-1]["mae_mm"] < 2e-4


def test_the_methods_of_the_plane_are_refused(scene):
    for words in (["--method", "grid"], ["--needle", str(scene / "run" / "displacement.npz")]):
        done = CliRunner().invoke(app, ["identify", str(scene / "run"), "--out", str(scene / "x"), *words])
        assert done.exit_code != 0
        assert "leave out --method and --needle" in str(done.exception) + done.output


@pytest.mark.parametrize("kind", ["elastic", "tps"])
@pytest.mark.parametrize("where", ["along a row of nodes", "askew"])
def test_landmark_models_give_back_what_the_data_determine_and_name_what_they_do_not(opened, where, kind):
    true = {"sigma": 0.8, "alpha1": 0.3, "alpha2": 0.2}
    start = {"sigma": 0.5, "alpha1": 0.5, "alpha2": 0.1}
    needle = (
        {}
        if where == "askew"
        else {"space.needle.entry": [-8.0, 0.0, 0.0], "space.needle.direction": [0.0, 1.0, 0.0]}
    )
    coarse = opened.scenario.with_values({"model.kind": kind, "space.mesh.nodes": [13, 11, 13], **needle})
    grid = coarse.space.grid(opened.volume)
    points = lattice_of(coarse.space.probe.probe()).nodes[::7]
    times, chosen = np.arange(0, 2.01, 0.2), np.array([2, 4, 6, 8])
    empty = SeenRun(points, times, chosen, np.zeros((4, len(points), 2)))
    u = PictureRuns(coarse, grid, opened.tissue, empty).run(true)
    begun = coarse.with_values({f"model.landmarks.{n}": v for n, v in start.items()})
    seen = SeenRun(points, times, chosen, u)
    found = fit_in_space(PictureRuns(begun, grid, opened.tissue, seen), "rmse", bootstrap=0)
    assert found.error.rmse < 1e-3
    assert found.values["sigma"] == pytest.approx(true["sigma"], rel=1e-3)
    if where == "askew" and kind == "tps":  # contacts at several distances tell the two apart
        assert found.values == pytest.approx(true, rel=1e-3)
        assert not found.confounded
        return
    # what the data determine: friction (15) at the axis where contacts lie there, a little aside of it otherwise
    share = 0.5 if where != "askew" else 0.34
    assert found.values["alpha1"] + share * found.values["alpha2"] == pytest.approx(
        0.3 + share * 0.2, rel=0.01
    )
    assert any("alpha1 and alpha2 cannot be told apart" in sentence for sentence in found.confounded)
