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
