"""The core's list of scenes (tests/core/scenes.json): every processor level and WebAssembly agree."""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from echospline import _native
from node_here import NODE, STEADY

ROOT = Path(__file__).resolve().parent.parent
SCENES = json.loads((ROOT / "tests" / "core" / "scenes.json").read_text(encoding="utf-8"))["scenes"]
# mm; columns in single precision are rounded differently by every level, by up to a few units in the last place
TOLERANCE = {_native.Precision.SINGLE: 2e-5, _native.Precision.DOUBLE: 1e-6}


def run(scene: dict[str, Any], level: int) -> list[np.ndarray]:
    """Displacement after every command, natively at one level."""
    library = _native.library()
    options = _native.SceneOptions(struct_size=ctypes.sizeof(_native.SceneOptions))
    library.echospline_scene_defaults(options)
    points = np.asarray(scene["options"].get("clamped_points", []), dtype=float)
    for name, value in scene["options"].items():
        if name == "clamped_points":
            options.clamped_points = points.ctypes.data
            options.clamped_point_count = points.size // options.dimension
        elif isinstance(value, list):
            getattr(options, name)[: len(value)] = value
        else:
            setattr(options, name, value)
    options.level = level
    handle, tissue = ctypes.c_void_p(), ctypes.c_void_p()
    status = library.echospline_scene_create(options, handle)
    _native.check(status, library.echospline_scene_message, handle)
    try:
        assert library.echospline_scene_level(handle) == level
        status = library.echospline_tissue_create(handle, tissue)
        _native.check(status, library.echospline_tissue_message, tissue)
        field = np.empty((library.echospline_scene_node_count(handle), options.dimension))
        pose = _native.Pose(speed=0.0, dt=scene["dt"])
        pose.entry[: options.dimension] = scene["start"]["entry"]
        pose.tip[: options.dimension] = scene["start"]["tip"]
        fields = []
        for given in scene["commands"]:
            command = _native.Command(lag=given["lag"], fastest=given["fastest"])
            command.entry[: options.dimension] = given["entry"]
            command.tip[: options.dimension] = given["tip"]
            for _ in range(given["steps"]):
                assert library.echospline_follow(pose, command, pose) == _native.Status.OK
                _native.check(
                    library.echospline_advance(tissue, pose), library.echospline_tissue_message, tissue
                )
            status = library.echospline_displacement(tissue, field.ctypes.data, field.size)
            _native.check(status, library.echospline_tissue_message, tissue)
            fields.append(field.copy())
        statistics = _native.Statistics(struct_size=ctypes.sizeof(_native.Statistics))
        library.echospline_tissue_statistics(tissue, statistics)
        assert statistics.allocations == 0
        return fields
    finally:
        library.echospline_tissue_destroy(tissue)
        library.echospline_scene_destroy(handle)


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene["name"])
def test_every_level_agrees_with_the_best(scene):
    library = _native.library()
    best = library.echospline_level_best()
    expected = run(scene, best)
    assert all(np.abs(field).max() > 0.01 for field in expected)
    others = [level for level in range(1, 6) if level != best and library.echospline_level_available(level)]
    for level in others:
        for one, other in zip(run(scene, level), expected, strict=True):
            worst = np.abs(one - other).max()
            assert worst <= TOLERANCE[scene["options"]["precision"]], _native.Level(level).name


@pytest.mark.skipif(NODE is None, reason="Node is not installed: WebAssembly is not compared with native")
def test_webassembly_agrees_with_native(tmp_path):
    wasm = ROOT / "src" / "echospline" / "_native" / "echospline.wasm"
    if not wasm.exists():
        pytest.skip("echospline.wasm is not built; run make wasm")
    best = _native.library().echospline_level_best()
    results = {scene["name"]: [field.ravel().tolist() for field in run(scene, best)] for scene in SCENES}
    path = tmp_path / "native.json"
    path.write_text(json.dumps({"results": results, "tolerance": TOLERANCE}), encoding="utf-8")
    done = subprocess.run(
        [NODE, STEADY, "--test", "--test-reporter=tap", "tests/js/core.test.js"],
        cwd=ROOT,
        env={**os.environ, "ECHOSPLINE_NATIVE_RESULTS": str(path)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "# fail 0" in done.stdout
    compared = json.loads(Path(f"{path}.compared").read_text(encoding="utf-8"))
    assert set(compared) == {scene["name"] for scene in SCENES}
