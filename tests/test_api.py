"""The public face: one screen of names, and examples that run."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import echospline

ROOT = Path(__file__).resolve().parent.parent


def test_the_public_names_are_these():
    assert sorted(echospline.__all__) == echospline.__all__
    assert len(echospline.__all__) <= 40
    assert all(hasattr(echospline, name) for name in echospline.__all__)


def test_first_example(capsys):
    after = runpy.run_path(str(ROOT / "examples" / "01_first_insertion.py"))
    assert after["frame"].pose.depth == pytest.approx(30.0)
    assert 0.5 < after["largest"] < 1.5
    assert len(capsys.readouterr().out.splitlines()) == 31


def test_importing_prints_nothing_and_draws_nothing():
    code = "import echospline, sys; assert 'matplotlib.pyplot' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
