"""What a page cannot compute of a scene is said when it is written: never left out in silence."""

from __future__ import annotations

import subprocess
import sys


def page(out, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "echospline", "page", *words, "--out", str(out / "trainer.html")],
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip


def test_a_page_that_begins_with_another_model_says_so(tmp_path):
    done = page(tmp_path, "--model", "fem")
    assert done.returncode == 0
    assert "model.kind = fem is not among what a page computes" in done.stderr
    assert "begins with Green" in done.stderr
    assert "begins with" not in page(tmp_path, "--model", "tps").stderr


def test_a_slab_and_material_of_the_plane_are_refused_in_one_sentence(tmp_path):
    for words, said in (
        (("--mechanics", "space"), "a page computes a picture by plane elasticity"),
        (("sample:spine", "--material", "neo-hookean"), "is computed in the plane alone"),
    ):
        done = page(tmp_path, *words)
        assert done.returncode != 0
        assert said in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
        assert not list(tmp_path.iterdir())


def test_values_of_the_plane_are_told_in_space(tmp_path):
    done = page(tmp_path, "sample:spine", "--angle", "30")
    assert done.returncode == 0
    assert "needle.angle is of scenes in the plane" in done.stderr
