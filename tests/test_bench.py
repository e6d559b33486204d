"""The benchmark that users run: what it measures and how it prints it, not how fast this machine is."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.mechanics import Elastic, describe_core
from echospline.study import bench
from echospline.study.bench import MESHES, PERIODS, Row, bare_product, native, path, scene, time_steps

KEYS = ["name", "nodes", "landmarks", "median_ms", "p99_ms", "limit_ms", "ratio_to_limit", "level"]


def test_json_rows_have_the_keys_promised(monkeypatch):
    monkeypatch.setattr(bench, "MESHES", {63: (9, 7), 108: (12, 9)})
    monkeypatch.setattr(bench, "PIXELS", 64)
    rows = json.loads(CliRunner().invoke(app, ["bench", "--json"]).stdout)
    assert [list(row) for row in rows] == [KEYS] * len(rows)
    steps = ["step at 1 kHz", "step at 60 Hz", "contact change", "step from Python"]
    names = {*steps, *(f"elastic {step}" for step in steps)}
    for nodes in (63, 108):
        found = {row["name"] for row in rows if row["nodes"] == nodes}
        assert found >= names
        assert any(name.startswith("frame") for name in found)
    for row in rows:
        assert row["median_ms"] <= row["p99_ms"]
        np.testing.assert_allclose(row["ratio_to_limit"], row["median_ms"] / row["limit_ms"])
        assert row["level"] == describe_core()["level"]


def test_the_table_says_what_fits_and_at_which_level(monkeypatch):
    rows = [
        Row("step at 1 kHz", 1200, 51, 0.02, 0.05, 0.004, 5.0, "AVX2"),
        Row("frame", 4524, 51, 20.0, 30.0, 0.01, 2000.0, "AVX2"),
    ]
    monkeypatch.setattr("echospline.study.benchmark", lambda _: rows)
    lines = CliRunner().invoke(app, ["bench"]).stdout.splitlines()
    step = next(line.split() for line in lines if line.startswith("step at"))
    frame = next(line.split() for line in lines if line.startswith("frame "))
    assert step == ["step", "at", "1", "kHz", "1200", "0.020", "0.050", "50000", "5.0", "yes", "yes"]
    assert frame == ["frame", "4524", "20.000", "30.000", "50", "2000.0", "no", "-"]
    core = describe_core()
    assert lines[0] == f"core {core['version']}, level {core['level']}, one thread"


def test_the_scene_is_the_size_that_is_claimed():
    assert all(nodes == nx * ny for nodes, (nx, ny) in MESHES.items())
    model = scene(MESHES[1200])
    poses = list(path(5e-3))
    seconds, landmarks = time_steps(model, poses, 5e-3)
    assert 45 <= landmarks <= 60  # about 50 in contact
    assert 100 <= landmarks + len(model.anchors) <= 150
    assert len(seconds) == len(poses)
    assert bare_product(1200, landmarks, repeats=3) > 0


@pytest.mark.parametrize("kernel", [None, Elastic()], ids=["thin plate", "elastic"])
def test_the_core_alone_is_timed_on_the_path_that_python_makes(kernel):
    model, period = scene((12, 9), kernel), PERIODS["60 Hz"]
    poses, step = list(path(period)), native(model)
    time_steps(model, poses, period)
    before = step.statistics
    seconds, changed = step.time_steps(poses, period)
    after = step.statistics
    assert len(seconds) == len(changed) == len(poses)
    assert after.steps - before.steps == len(poses)
    assert 0 < changed.sum() <= after.joined - before.joined + after.left - before.left
    # states from before the timing are still valid
    assert not model.displacement(model.rest()).any()
    fresh = scene((12, 9), kernel)
    again = model.advance(model.rest(), poses[9], period)
    assert np.array_equal(again.mesh, fresh.advance(fresh.rest(), poses[9], period).mesh)
