"""The core's own tests (core/tests) and its compiler warnings, run through Python."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "core"))
import build  # noqa: E402


@pytest.mark.skipif(
    build.system_compiler() is None, reason="no C++20 compiler here: the core's own tests are not run"
)
def test_the_cores_own_tests_pass():
    run = subprocess.run(
        [sys.executable, "core/tests/run.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
