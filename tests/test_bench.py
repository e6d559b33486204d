"""The benchmark that users run: what it measures and how it prints it, not how fast this machine is."""

from __future__ import annotations

import json

import numpy as np
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.study import bench
from echospline.study.bench import MESHES, Row, bare_product, path, scene, time_steps

KEYS = ["name", "nodes", "landmarks", "median_ms", "p99_ms", "limit_ms", "ratio_to_limit"]


def test_json_rows_have_the_keys_promised(monkeypatch):
    monkeypatch.setattr(bench, "MESHES", {63: (9, 7), 4524: (12, 9)})
    rows = json.loads(CliRunner().invoke(app, ["bench", "--json"]).stdout)
    assert [list(row) for row in rows] == [KEYS] * len(rows)
    assert {"step", "contact change", "elastic step", "frame"} <= {row["name"] for row in rows}
    for row in rows:
        assert row["median_ms"] <= row["p99_ms"]
        np.testing.assert_allclose(row["ratio_to_limit"], row["median_ms"] / row["limit_ms"])


def test_the_table_says_what_fits(monkeypatch):
    rows = [Row("step", 1200, 51, 0.02, 0.05, 0.004, 5.0), Row("frame", 4524, 51, 20.0, 30.0, 0.01, 2000.0)]
    monkeypatch.setattr("echospline.cli.bench.benchmark", lambda _: rows)
    lines = CliRunner().invoke(app, ["bench"]).stdout.splitlines()
    step = next(line.split() for line in lines if line.startswith("step "))
    frame = next(line.split() for line in lines if line.startswith("frame "))
    assert step == ["step", "1200", "0.020", "0.050", "50000", "5.0", "yes", "yes"]
    assert frame == ["frame", "4524", "20.000", "30.000", "50", "-", "no", "-"]


def test_the_scene_is_the_size_that_is_claimed():
    assert all(nodes == nx * ny for nodes, (nx, ny) in MESHES.items())
    model = scene(MESHES[1200])
    poses = list(path(5e-3))
    times, kinds, landmarks = time_steps(model, poses, 5e-3)
    assert 45 <= landmarks <= 60  # about 50 in contact
    assert 100 <= landmarks + len(model.anchors) <= 150
    assert len(times) == len(kinds) == len(poses)
    assert {"plain", "contacts change", "patch"} >= set(kinds)
    assert bare_product(model.fast, repeats=3) > 0
