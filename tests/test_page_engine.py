"""The engine of the page, steered in Node as a hand steers it, against the package: the field, the picture and the needle that follows."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

import page_scene
from echospline.page import Pack, packed
from echospline.page.exercise import default_exercises_space
from echospline.picture import Drawing, NeedleEcho
from echospline.scenario import Scenario, build_model
from echospline.scene import NeedlePose
from node_here import NODE, STEADY

WASM = page_scene.ROOT / "src" / "echospline" / "_native" / "echospline.wasm"
HANDS = [
    [[8.0, 0.0], [8.0, 0.0], 20],
    [[8.0, 0.0], [13.0, 7.0], 80],
    [[8.0, 0.0], [16.0, 10.0], 60],
    [[8.0, 0.0], [18.0, 9.0], 40],
    [[8.0, 0.0], [15.0, 9.0], 100],
]

ARRIVED = 1.1e-4
"""mm; the core takes the last tenth of a micrometre at once, so that a needle under a hand at rest is at rest."""

pytestmark = [
    pytest.mark.skipif(
        NODE is None, reason="Node is not installed: the engine runs in the browser's test only"
    ),
    pytest.mark.skipif(not WASM.exists(), reason="echospline.wasm is not built; run make wasm"),
]


def steered(pack: Pack, model: str, folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Steer the engine in Node; returns rows of poses, fields of every tenth step, and a picture after each hand."""
    (folder / "scene.pack").write_bytes(pack.to_bytes())
    out = folder / "out"
    done = subprocess.run(
        [NODE, STEADY, "tests/node/run_engine.mjs", str(folder / "scene.pack"), model, json.dumps(HANDS), str(out)],
        cwd=page_scene.ROOT, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = np.fromfile(f"{out}.poses").reshape(-1, 5)
    fields = np.fromfile(f"{out}.fields").reshape(len(rows) // 10, -1, 2)
    image = pack.manifest.image
    return rows, fields, np.fromfile(f"{out}.grey", np.uint8).reshape(len(HANDS), image.rows, image.columns)


@pytest.mark.parametrize("kind", ["tps", "elastic"])
def test_field_and_picture_of_the_page_are_pythons_over_a_session(kind, tmp_path):
    pack = page_scene.small()
    rows, fields, pictures = steered(pack, kind, tmp_path)
    assert len(rows) == sum(steps for *_, steps in HANDS)
    own, drawing = (
        build_model(page_scene.scenario(), pack.mesh, kind=kind),
        Drawing(page_scene.image(), pack.mesh),
    )
    state, ends = own.rest(), np.cumsum([steps for *_, steps in HANDS])
    moved = 0.0
    for k, (x, y, tx, ty, speed) in enumerate(rows, 1):
        pose = NeedlePose((x, y), (tx, ty), speed)
        state = own.advance(state, pose, 1 / 120)
        if k % 10 == 0:
            expected = own.displacement(state)
            np.testing.assert_allclose(fields[k // 10 - 1], expected, rtol=0, atol=1e-4)
            moved = max(moved, float(np.abs(expected).max()))
        if k in ends:
            shown = pictures[list(ends).index(k)].astype(int)
            inside = NeedleEcho() if np.hypot(tx - x, ty - y) > 1e-9 else None
            python = drawing.draw(own.displacement(state), pose, inside).image.pixels.astype(int)
            assert np.abs(shown - python).max() <= 1
    assert moved > 0.3


def test_the_needle_follows_the_hand_as_in_the_live_loop(tmp_path):
    pack = page_scene.small()
    rows, _, _ = steered(pack, "tps", tmp_path)
    lag, fastest, dt = pack.manifest.needle.lag, pack.manifest.needle.fastest, 1 / 120
    tip, k = np.array([8.0, 0.0]), 0
    for _, wanted, steps in HANDS:
        for _ in range(steps):
            way = (np.array(wanted) - tip) * (1 - np.exp(-dt / lag))
            length = float(np.hypot(*way))
            tip = tip + way * min(1.0, fastest * dt / length) if length > 0 else tip
            np.testing.assert_allclose(rows[k, 2:4], tip, atol=ARRIVED)
            k += 1


def test_the_sample_explains_its_models_and_exercises_in_both_languages():
    scenario, image = Scenario().opened(Path(), eight_bit=True)
    pack = packed(scenario, image, Path())
    words = (page_scene.ROOT / "src/echospline/page/static/words.js").read_text(encoding="utf-8")
    for exercise in [*pack.manifest.exercises, *default_exercises_space((0, 0, 0), (40, 40, 40))]:
        assert f'"{exercise.title}": "' in words, "an exercise that every scene is given has a German title"
        assert f'"{exercise.goal}": "' in words
    for model in pack.manifest.models:
        assert set(model.sentence) == {"en", "de"}
        assert model.sentence["en"].endswith(".")
