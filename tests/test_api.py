"""The public face: one screen of names, and examples that run."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
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


def test_a_probe_that_sweeps_across_a_needle_finds_its_tip_within_the_beam():
    after = runpy.run_path(str(ROOT / "examples" / "02_find_the_tip.py"))
    beam = echospline.scene.FWHM * after["probe"].elevation
    assert abs(after["frame"].pose.depth - 24.0) < 1e-9
    np.testing.assert_allclose(after["tip"], after["frame"].pose.tip, atol=beam)


def test_the_plane_and_space_are_not_mixed_in_one_run():
    flat = echospline.UltrasoundImage(np.zeros((20, 20), np.uint8), echospline.RegularGrid((20, 20), (1, 1)))
    block = echospline.Volume(np.zeros((9, 9, 9), np.uint8), (2.0, 2.0, 2.0))
    path = echospline.Insertion.straight((5.0, 0.0), 90.0, 5.0)
    deep = echospline.SpatialInsertion.straight((8.0, 0.0, 8.0), (0, 1, 0), 5.0)
    model = echospline.SpatialForceModel.green(block.mesh((5, 5, 5)))
    probe, plane = echospline.Probe(width=10, depth=10), echospline.probe_plane((8, 0, 8))
    with pytest.raises(echospline.InputError, match="takes an Insertion, and no probe"):
        echospline.simulate(flat, deep, model)
    with pytest.raises(echospline.InputError, match="no probe and no plane; got Insertion, a probe"):
        echospline.simulate(flat, path, model, probe=probe)
    with pytest.raises(echospline.InputError, match="takes a SpatialInsertion, a probe and a plane"):
        echospline.simulate(block, path, model, probe=probe, plane=plane)
    with pytest.raises(echospline.InputError, match="takes a SpatialInsertion, a probe and a plane"):
        echospline.simulate(block, deep, model, probe=probe)
    with pytest.raises(echospline.InputError, match="for images of the plane"):
        echospline.simulate(block, deep, model, probe=probe, plane=plane, border="transparent")


def test_importing_prints_nothing_and_draws_nothing():
    code = "import echospline, sys; assert 'matplotlib.pyplot' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
