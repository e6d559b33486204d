"""Compiled code on disk: never older than the source that it was made from."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import echospline


def test_code_compiled_before_the_last_change_is_dropped(tmp_path):
    package = tmp_path / "echospline"
    shutil.copytree(Path(echospline.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    cache = package / "mechanics" / "__pycache__"
    cache.mkdir()
    for name, age in (("old.nbi", 1000.0), ("young.nbi", -1000.0)):
        (cache / name).touch()
        changed = max(f.stat().st_mtime for f in package.rglob("*.py"))
        os.utime(cache / name, (changed - age, changed - age))
    code = "from echospline.mechanics.compiled import forget_stale_code as f; f()"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, cwd=tmp_path)
    assert not (cache / "old.nbi").exists()
    assert (cache / "young.nbi").exists()


LOOP = """
import importlib
from numba.core.dispatcher import Dispatcher
from echospline.scene import RegularGrid
from echospline.mechanics import TPSModel
from echospline.scene import NeedlePose
from paths import wandering

names = ("basis", "compiled", "compiled_step", "contacts", "mesh_field", "tip_column", "touch")
modules = [importlib.import_module("echospline.mechanics." + name) for name in names]

def known():
    every = [(m.__name__, n, f) for m in modules for n, f in vars(m).items() if isinstance(f, Dispatcher)]
    return {(m, n): len(f.signatures) for m, n, f in every}

model = TPSModel(RegularGrid((27, 21), (40 / 26, 30 / 20)))
before, state = known(), model.rest()
for pose in wandering(2, 1 / 20, 5.0):
    state = model.advance(state, pose, 1 / 20)
assert state.held_back > 0
state = model.advance(model.rest(), NeedlePose((20, 0), (20, 3), 5), 1)
model.spline(state)
print({name: count for name, count in known().items() if count != before[name]})
"""


def test_nothing_is_compiled_or_loaded_once_there_is_a_model():
    # in a process of its own, that has compiled nothing else; steps held back, contacts released, whole numbers
    done = subprocess.run(
        [sys.executable, "-c", LOOP], capture_output=True, text=True, check=True, cwd=Path(__file__).parent
    )
    assert done.stdout.strip() == "{}"
