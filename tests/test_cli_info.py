"""``echospline info``: what it says is what other readers find, for people and for machines."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from echospline.cli import main
from echospline.cli.app import app
from echospline.cli.info import describe
from echospline.errors import InputError
from echospline.io import DisplacementWriter, read
from echospline.scene import NeedlePose, RegularGrid


def shown(*words: str) -> str:
    result = CliRunner().invoke(app, ["info", *words], env={"COLUMNS": "120"})
    assert result.exit_code == 0, result.output
    return result.output


def test_a_png_is_described_as_pillow_sees_it(recordings: Path) -> None:
    path = recordings / "timtrack" / "gastroc_jumping_048.png"
    found = json.loads(shown(str(path), "--json"))
    with Image.open(path) as image:
        assert (found["pixels"]["columns"], found["pixels"]["rows"]) == image.size
    assert found["bytes"] == path.stat().st_size
    assert found["spacing_mm"] is None
    assert any("--spacing LAT,DEPTH" in note for note in found["notes"])


def test_a_dicom_cine_is_described_as_it_is_read(recordings: Path) -> None:
    path = recordings / "pydicom" / "examples_ybr_color.dcm"
    found = json.loads(shown(str(path), "--json"))
    cine = read(path)
    left, top, right, bottom = found["region"]
    assert (right - left, bottom - top) == cine.grid.shape
    assert found["spacing_mm"] == list(cine.grid.spacing)
    assert found["frames"] == len(cine)
    assert found["fps"] == pytest.approx(30, abs=0.01)
    # The scanner wrote its depth, 19 cm, into the lower right corner of the picture.
    assert found["size_mm"][1] == pytest.approx(190, abs=6)
    assert "PLA" not in json.dumps(found)  # the patient's name stays in the file


def test_the_table_says_the_same_for_people(recordings: Path) -> None:
    text = shown(str(recordings / "pydicom" / "examples_ybr_color.dcm"))
    for words in (
        "DICOM, JPEG Baseline",
        "320 x 240, RGB, uint8",
        "1.02099 lateral",
        "2-D tissue",
        "2 times as large",
    ):
        assert words in text


def test_the_shipped_image_is_described() -> None:
    found = describe("sample:calf")
    assert found["size_mm"] == pytest.approx([49.9, 39.5], abs=0.05)
    assert "CC0" in shown("sample:calf")


def test_a_displacement_record_is_described(tmp_path: Path) -> None:
    mesh = RegularGrid((4, 3), (2.0, 2.0))
    with DisplacementWriter(tmp_path / "displacement.npz", mesh.nodes) as writer:
        for k in range(5):
            writer.add(
                np.tile([0.3 * k, 0.4 * k], (12, 1)), k / 10, NeedlePose((0, 0), (3.0 * k, 4.0 * k), 50.0)
            )
    found = json.loads(shown(str(tmp_path / "displacement.npz"), "--json"))
    assert found["arrays"]["displacement"] == [5, 12, 2]
    assert found["mesh"] == [4, 3]
    assert (found["frames"], found["duration_s"]) == (5, 0.4)
    assert found["largest_displacement_mm"] == pytest.approx(2.0)
    assert found["deepest_insertion_mm"] == pytest.approx(20.0)
    assert "4 x 3" in shown(str(tmp_path / "displacement.npz"))


def test_a_scenario_is_told_from_other_toml(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('[needle]\ndepth = 20\n[image]\nfile = "sample:calf"\n')
    (tmp_path / "b.toml").write_text("[project]\nname = 'x'\n")
    (tmp_path / "c.toml").write_text("[needle\n")
    (tmp_path / "d.toml").write_text("[needle]\ndepth = -3\n")
    found = describe(str(tmp_path / "a.toml"))
    assert (found["format"], found["image"], found["notes"]) == ("TOML scenario", "sample:calf", [])
    assert found["tables"] == {"needle": ["depth"], "image": ["file"]}
    assert describe(str(tmp_path / "b.toml"))["format"] == "TOML, no scenario"
    assert "depth" in describe(str(tmp_path / "d.toml"))["notes"][0]
    with pytest.raises(InputError, match="no valid TOML"):
        describe(str(tmp_path / "c.toml"))


def test_names_with_markup_in_them_are_printed_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "a[bold]b[red].png"
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(path)
    assert "a[bold]b[red].png" in shown(str(path)).replace("\n", "")


def test_bad_input_ends_with_one_sentence_and_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.png").write_bytes(b"%PDF-1.4")
    (tmp_path / "b.nrrd").write_bytes(b"NRRD0004\ntype: uint8\n")
    for name in ("a.png", "b.nrrd", "missing.dcm", ".", "sample:liver"):
        path = name if name.startswith("sample") else str(tmp_path / name)
        monkeypatch.setattr(sys, "argv", ["echospline", "info", path])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capfd.readouterr()
        assert ended.value.code == 2
        assert out == ""
        assert err.startswith("echospline: ")
        assert err.count("\n") == 1
