"""The command line tells what a file says of itself: the same notes everywhere, windows, opacity, own results."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from PIL import Image
from typer.testing import CliRunner

from echospline import viewer
from echospline.cli.app import app
from echospline.cli.info import describe
from echospline.errors import InputError
from echospline.io import EchoWriter, open_writer, read, read_image, read_needle
from echospline.scenario import Scenario, load
from echospline.scene import Echo, RegularGrid, UltrasoundImage
from written_inputs import FRAMES, STACK, dicom, oriented, sequence, video, volume_header

SMALL = [
    "--mesh",
    "6x5",
    "--entry",
    "1,0",
    "--angle",
    "60",
    "--depth",
    "2",
    "--speed",
    "10",
    "--dwell",
    "0",
    "--no-retract",
]
QUICK = [*SMALL, "--fps", "5", "--no-figure"]


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})


def told(*words: object) -> str:
    """What a command that must succeed says."""
    result = run(*words)
    assert result.exit_code == 0, result.output + str(result.exception)
    return result.output


def refused(*words: object) -> str:
    """The sentence of a command that must be refused."""
    result = run(*words)
    assert isinstance(result.exception, InputError), result.output + repr(result.exception)
    return str(result.exception)


# --- the same notes everywhere


def test_simulate_track_and_live_say_what_info_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = video(tmp_path / "a.mp4", matrix=(-1, 0, 0, -1), aspect=(8, 9))
    notes = [note for note in describe(str(path))["notes"] if "--" not in note]
    assert len(notes) == 2
    monkeypatch.setattr(viewer, "serve", lambda *a: None)
    spacing = ("--spacing", "0.08,0.09")
    for words in (
        ("simulate", path, *spacing, "--out", tmp_path / "out", *QUICK),
        ("track", path, *spacing, "--out", tmp_path / "t.npz"),
        ("live", path, *spacing, "--sessions", tmp_path / "s.sqlite", "--no-browser", *SMALL),
    ):
        text = told(*words)
        for note in notes:
            assert f"note: {note}" in text, words[0]
    assert json.loads((tmp_path / "out" / "run.json").read_text())["image"]["notes"] == notes


def test_notes_of_labels_are_printed_by_dataset(tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    oriented(tmp_path / "labels.png", 6, np.zeros((8, 8), np.uint8))
    (tmp_path / "a.toml").write_text(
        "[phantom]\nsize = [10, 10]\npixel = [0.2, 0.2]\nper_cell = 1\n[mesh]\nnodes = [5, 5]\n[needle]\nentry = [5, 0]\ndepth = 4\n"
        '[[tissue.region]]\nyoung = 20\n[tissue.region.labels]\nfile = "labels.png"\nvalue = 1\n'
    )
    text = told("dataset", tmp_path / "a.toml", "--out", tmp_path / "d", "--n", "1", "--frames", "2")
    assert "labels.png: the EXIF orientation 6 is followed" in text
    about = describe(str(tmp_path / "d"))
    assert about["format"] == "dataset (Zarr)"
    assert about["samples"] == 1


def test_a_volume_asks_simulate_and_track_which(tmp_path: Path) -> None:
    path = volume_header(tmp_path / "a.mha")
    assert "--frame" in refused("simulate", path, "--out", tmp_path / "out", *QUICK)
    assert "--fps" in refused("track", path, "--out", tmp_path / "t.npz")
    assert "--frame" not in refused("track", path, "--out", tmp_path / "t.npz")
    told("simulate", path, "--frame", "2", "--out", tmp_path / "out", *QUICK)
    assert load(tmp_path / "out" / "scenario.toml").image.frame == 2


def test_track_without_times_names_options_that_it_has(tmp_path: Path) -> None:
    sentence = refused("track", dicom(tmp_path / "a.dcm"), "--out", tmp_path / "t.npz")
    assert "--fps" in sentence
    assert "--frame" not in sentence


def test_the_first_good_frame_is_the_tissue_at_rest(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a.igs.mha", status=lambda i: "INVALID" if i < 2 else "OK")
    text = told("simulate", path, "--out", tmp_path / "out", *QUICK, "--no-needle", "--formats", "mha")
    assert "frame 2 taken, the first good one" in text
    assert load(tmp_path / "out" / "scenario.toml").image.frame == 2
    first = read(tmp_path / "out" / "cine.mha").frames[0]
    np.testing.assert_array_equal(first, STACK[2])


def test_unknown_spacing_is_asked_for_by_simulate_and_track(tmp_path: Path) -> None:
    path = sequence(tmp_path / "a.igs.mha", spacing="1 1 1")
    for words in (("simulate", path, "--out", tmp_path / "o"), ("track", path, "--out", tmp_path / "t.npz")):
        assert "1 x 1 mm" in refused(*words)


def test_a_byte_order_mark_is_no_fault(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b'\xef\xbb\xbf[image]\nfile = "sample:calf"\n')
    assert load(tmp_path / "a.toml").image.file == "sample:calf"
    assert describe(str(tmp_path / "a.toml"))["format"] == "TOML scenario"


# --- windows


@pytest.mark.parametrize("dtype", [np.uint16, np.int32, np.float32])
def test_deep_pictures_simulate_with_the_defaults(tmp_path: Path, dtype: type) -> None:
    deep = (STACK[0].astype(np.float64) * 100 + 7).astype(dtype)
    Image.fromarray(deep).save(tmp_path / "a.tif")
    out = tmp_path / "out"
    text = told(
        "simulate", tmp_path / "a.tif", "--spacing", "0.1,0.1", "--out", out, *QUICK, "--formats", "mp4,png"
    )
    window = load(out / "scenario.toml").image.window
    assert window == (float(deep.min()), float(deep.max()))
    assert f"values {deep.min():g} to {deep.max():g} are shown as black to white" in text
    first = np.asarray(Image.open(out / "frames" / "frame_00000.png"))
    right = np.rint((deep.astype(float) - deep.min()) / (float(deep.max()) - deep.min()) * 255)
    np.testing.assert_array_equal(first, right)
    again = tmp_path / "again"
    told("simulate", out / "scenario.toml", "--out", again, "--no-figure")
    np.testing.assert_array_equal(
        np.asarray(Image.open(again / "frames" / "frame_00001.png")),
        np.asarray(Image.open(out / "frames" / "frame_00001.png")),
    )


def test_formats_that_hold_deep_pixels_keep_them(tmp_path: Path) -> None:
    deep = STACK[0].astype(np.uint16) * 100
    Image.fromarray(deep).save(tmp_path / "a.png")
    words = (
        "simulate",
        tmp_path / "a.png",
        "--spacing",
        "0.1,0.1",
        "--out",
        tmp_path / "o",
        *QUICK,
        "--no-needle",
    )
    told(*words, "--formats", "png,mha")
    np.testing.assert_array_equal(read(tmp_path / "o" / "cine.mha").frames[0], deep)
    assert load(tmp_path / "o" / "scenario.toml").image.window is None
    told(*words, "--formats", "mha", "--window", "5000,20000")  # asked for, so done
    cine = read(tmp_path / "o" / "cine.mha").frames[0]
    assert cine.dtype == np.uint8
    assert (cine[deep <= 5000] == 0).all()
    assert (cine[deep >= 20000] == 255).all()


def test_colour_simulates_as_its_luma(tmp_path: Path) -> None:
    Image.fromarray(np.repeat(STACK[0][..., None], 3, 2)).save(tmp_path / "a.png")
    told("simulate", tmp_path / "a.png", "--spacing", "0.1,0.1", "--out", tmp_path / "o", *QUICK)


def test_the_files_own_window_goes_first(tmp_path: Path) -> None:
    # a window of centre 100 and width 51 ends at 74.5 and 124.5: DICOM PS3.3 C.11.2.1.2
    deep = STACK[:1].astype(np.uint16)
    path = dicom(
        tmp_path / "a.dcm", frames=1, BitsAllocated=16, BitsStored=16, HighBit=15, PixelData=deep.tobytes(),
        WindowCenter="100", WindowWidth="51",
    )  # fmt: skip
    scenario = Scenario().with_values({"image.file": str(path)})
    resolved, image = scenario.opened(tmp_path, eight_bit=True)
    assert resolved.image.window == (74.5, 124.5)
    outside = ((deep < 74.5) | (deep > 124.5)).mean()
    assert any(f"{outside:.2%} of the pixels lie outside" in note for note in image.notes)
    assert image.pixels.dtype == np.uint8


def test_a_window_ascends(tmp_path: Path) -> None:
    sentence = refused("simulate", "sample:calf", "--window", "9,3", "--out", tmp_path)
    assert "low before high" in sentence
    with pytest.raises(InputError, match="low before high"):
        UltrasoundImage(STACK[0], RegularGrid((80, 48), (0.1, 0.1))).windowed(3, 3)


def test_one_shade_is_no_division_by_zero(tmp_path: Path) -> None:
    Image.fromarray(np.full((40, 40), 700, np.uint16)).save(tmp_path / "a.png")
    told("simulate", tmp_path / "a.png", "--spacing", "0.1,0.1", "--out", tmp_path / "o", *QUICK)


# --- opacity


def test_transparency_that_a_format_cannot_hold_is_refused_with_those_that_can(tmp_path: Path) -> None:
    for formats in ("mp4", "gif,png", "igs.mha"):
        sentence = refused(
            "simulate",
            "sample:calf",
            "--border",
            "transparent",
            "--formats",
            formats,
            "--out",
            tmp_path / "o",
        )
        assert "png, mha" in sentence
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("deep", [False, True])
def test_transparency_is_written_where_it_can_be(tmp_path: Path, deep: bool) -> None:
    Image.fromarray(STACK[0].astype(np.uint16) * 100 if deep else STACK[0]).save(tmp_path / "a.png")
    out = tmp_path / "out"
    told(
        "simulate", tmp_path / "a.png", "--spacing", "0.1,0.1", "--out", out, *QUICK, "--border", "transparent",
        "--formats", "png,mha",
    )  # fmt: skip
    with Image.open(out / "frames" / "frame_00000.png") as picture:
        assert picture.mode == "RGBA"
        assert (np.asarray(picture)[..., 3] == 255).all()
    cine = read(out / "cine.mha", colour=True)
    assert cine.frames.shape[-1] == 3
    assert "transparency is left out" in cine.source


# --- own results


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    Image.fromarray(STACK[0]).save(folder / "a.png")
    told("simulate", folder / "a.png", "--spacing", "0.1,0.1", "--out", folder / "out", *QUICK)
    return folder / "out"


def test_info_knows_the_folder_of_a_run_and_its_report(results: Path) -> None:
    for name in (results, results / "run.json"):
        about = describe(str(name))
        assert about["model"] == "tps"
        assert about["frames"] == 2
        assert "cine.mp4" in about["files"]
        said = json.loads((results / "run.json").read_text())
        assert about["notes"] == said["image"]["notes"] + said["doubts"]
        assert any("4.8 mm deep" in note for note in about["notes"])
        assert "tps" in told("info", name)


def test_info_says_which_results_are_gone_or_unfinished(results: Path, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_bytes((results / "run.json").read_bytes())
    (tmp_path / "cine.mp4.part").write_bytes(b"x")
    notes = describe(str(tmp_path))["notes"]
    assert "cine.mp4 is no longer there" in notes
    assert "cine.mp4.part is unfinished" in notes


def test_info_knows_tracks_echoes_and_other_json(results: Path, tmp_path: Path) -> None:
    grid = RegularGrid((4, 8), (0.3, 0.02))
    with EchoWriter(tmp_path / "echoes.npz", 3, grid, 6.5) as writer:
        for k in range(3):
            writer.add(Echo(np.full((8, 4), 1 + 1j, np.complex64), grid, 6.5), 0.1 * k)
    about = describe(str(tmp_path / "echoes.npz"))
    assert (about["frames"], about["duration_s"], about["carrier_per_mm"]) == (3, 0.2, 6.5)
    assert "4 lines of 8 samples" in told("info", tmp_path / "echoes.npz")
    (tmp_path / "b.json").write_text('{"a": 1}')
    assert describe(str(tmp_path / "b.json"))["keys"] == ["a"]
    (tmp_path / "c.json").write_text("{")
    with pytest.raises(InputError, match="no valid JSON"):
        describe(str(tmp_path / "c.json"))


def test_an_empty_name_is_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.fromarray(STACK[0]).save(tmp_path / "a.png")
    monkeypatch.chdir(tmp_path)
    for words in (("info", ""), ("info", " "), ("track", ""), ("simulate", "")):
        assert "empty" in refused(*words)
    for take in (read, read_image):
        with pytest.raises(InputError, match="empty name"):
            take("", spacing=(0.1, 0.1))


# --- headers alone


def test_info_of_a_cine_beyond_the_limit_needs_its_header_alone(tmp_path: Path) -> None:
    # 1440 frames of 1280 x 960 without their pixels: a sparse file takes no disk
    head = (
        volume_header(tmp_path / "a.mha", "Kinds = domain domain list", spacing="0.1 0.1 0.03")
        .read_bytes()
        .split(b"LOCAL\n")[0]
    )
    head = head.replace(b"DimSize = 80 48 10", b"DimSize = 1280 960 1800") + b"LOCAL\n"
    with (tmp_path / "long.mha").open("wb") as file:
        file.write(head)
        file.truncate(len(head) + 1280 * 960 * 1800)
    about = describe(str(tmp_path / "long.mha"))
    assert about["frames"] == 1800
    assert about["decoded_mib"] == pytest.approx(2109.4, abs=0.1)
    assert any("one by one" in note for note in about["notes"])
    with pytest.raises(InputError, match="more than the limit"):
        read(tmp_path / "long.mha", fps=30)


# --- needle paths


def test_a_needles_path_may_be_written_by_a_spreadsheet(tmp_path: Path) -> None:
    rows = [[0.0, 1.5, 0.0, 1.5, 0.25], [0.5, 1.5, 0.0, 2.0, 4.75]]
    names = ["time_s", "entry_x_mm", "entry_y_mm", "tip_x_mm", "tip_y_mm"]
    for mark, point, start in (
        (",", ".", ""),
        (";", ".", "# made here\n"),
        (";", ",", "\ufeff"),
        ("\t", ".", ""),
    ):
        lines = [mark.join(names), *(mark.join(f"{v:g}".replace(".", point) for v in row) for row in rows)]
        (tmp_path / "a.csv").write_text(start + "\n".join(lines) + "\n", encoding="utf-8")
        path = read_needle(tmp_path / "a.csv")
        np.testing.assert_array_equal(path.times, [0.0, 0.5])
        np.testing.assert_array_equal(path.tip, [[1.5, 0.25], [2.0, 4.75]])
    (tmp_path / "b.csv").write_text(";".join(names) + "\n0,0;1\n")
    with pytest.raises(InputError, match="five numbers"):
        read_needle(tmp_path / "b.csv")


def test_a_written_picture_with_opacity_must_fit_its_format(tmp_path: Path) -> None:
    rgba = np.zeros((48, 80, 4), np.uint8)
    for name in ("a.mp4", "a.gif"):
        with open_writer(tmp_path / name, RegularGrid((80, 48), (0.1, 0.1))) as writer:
            with pytest.raises(InputError, match="must be"):
                writer.add(rgba, 0.0)
            writer.add(STACK[0], 0.0)
    assert FRAMES == 10
