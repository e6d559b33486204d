"""A scene has a scale: what none can have is refused before anything is made, what is unlikely is said."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from echospline import (
    Deformation,
    FEMModel,
    Insertion,
    NeedleEcho,
    NeedlePose,
    RegularGrid,
    TPSModel,
    UltrasoundImage,
    simulate,
    warp,
)  # fmt: skip
from echospline.errors import InputError
from echospline.io import open_writer, read, read_image
from echospline.scenario import (
    Scenario,
    check,
    check_store,
    load,
    needle_doubts,
    size_doubts,
)
from echospline.scenario.scale import _inside

QUICK = ["--depth", "3", "--speed", "10", "--dwell", "0", "--no-retract", "--no-figure", "--mesh", "12x10"]
GRID = RegularGrid((321, 241), (0.1, 0.1))


def echospline(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "echospline", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


@pytest.fixture(scope="module")
def picture(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scale") / "sample.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (240, 320), np.uint8)).save(path)
    return path


def image_of(dtype: str, top: float, channels: int = 1) -> UltrasoundImage:
    shape = (240, 320) if channels == 1 else (240, 320, channels)
    pixels = (np.random.default_rng(0).random(shape) * top).astype(dtype)
    return UltrasoundImage.from_array(pixels, (0.1, 0.1))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--spacing", "86.6,86.6"], ["27,712 mm wide", "5 to 500 mm", "micrometres", "0.0866,0.0866"]),
        (["--spacing", "0.0001,0.0001"], ["0.032 mm wide", "metres", "0.1,0.1"]),
        (["--spacing", "0.1,0.1", "--speed", "0.000001"], ["frames", "1,000,000 at most", "needle.speed"]),
        (["--spacing", "0.1,0.1", "--fps", "0.01", "--speed", "0.0000001"], ["steps", "output.longest_step"]),
        (["--spacing", "0.1,0.1", "--border", "300"], ["from 0 to 255", "uint8", "300"]),
        (["--spacing", "0.1,0.1", "--border", "1e9"], ["from 0 to 255"]),
        (["--spacing", "0.1,0.1", "--border", "nan"], ["--border", "finite"]),
        (["--spacing", "0.1,0.1", "--model", "fem", "--mesh", "4096x4096"], ["GiB of memory", "mesh.nodes"]),
        (["--spacing", "0.1,0.1", "--clamped", "none"], ["leaves it free to slide along x", "clamp one edge"]),
    ],
    ids=lambda value: " ".join(value[-2:]) if value[0].startswith("--") else None,
)  # fmt: skip
def test_what_no_scene_can_have_is_refused_in_one_sentence_and_nothing_is_made(
    picture, tmp_path, options, words
):
    done = echospline("simulate", picture, *QUICK, *options, "--out", tmp_path / "out")
    assert done.returncode == 2, done.stderr
    lines = [line for line in done.stderr.splitlines() if "doubt" not in line]
    assert len(lines) == 1, done.stderr
    for word in words:
        assert word in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("spacing", [(0.1, 0.1), (5 / 320, 5 / 240), (500 / 320, 500 / 240)])
def test_pictures_of_5_to_500_mm_are_taken_without_a_word(spacing):
    assert size_doubts(RegularGrid((320, 240), spacing)) == []


@pytest.mark.parametrize(
    ("spacing", "unit"), [((0.01, 0.01), "centimetres"), ((3.0, 3.0), None), ((0.012, 0.1), None)]
)
def test_unlikely_sizes_are_doubts(spacing, unit):
    (doubt,) = size_doubts(RegularGrid((320, 240), spacing))
    assert "expected 5 to 500 mm a side" in doubt
    assert unit is None or unit in doubt


@pytest.mark.parametrize(
    ("insertion", "word"),
    [
        (Insertion.straight((900.0, 0.0), 90, 20), "it enters at (900, 0) mm"),
        (Insertion.straight((10.0, 0.0), -90, 20), "an angle of -90 degrees leads out of it"),
        (Insertion.straight((10.0, -30.0), 90, 20), "it is 30 mm away, and the needle is 20 mm long"),
        (Insertion.straight((10.0, 0.0), 90, 0.2), "only 0.2 mm of the needle"),
        (Insertion.straight((-5.0, 10.0), 0, 5.3), "only 0.3 mm of the needle"),
        (
            Insertion([0.0, 1.0], (5.0, -1.0), [(5.0, -1.0), (5.0, -0.5)]),
            "away, and the needle is 0.5 mm long",
        ),
    ],
)
def test_a_needle_that_never_meets_the_tissue_is_said(insertion, word):
    (doubt,) = needle_doubts(insertion, GRID)
    assert word in doubt


@pytest.mark.parametrize(
    "insertion",
    [
        Insertion.straight((10.0, 0.0), 90, 20),
        Insertion.straight((-5.0, 10.0), 10, 20),
        Insertion.straight((10.0, -5.0), 90, 20, retract=True),
        Insertion([0.0, 1.0, 2.0], (10.0, 0.0), [(10.0, 0.0), (12.0, 8.0), (10.0, 0.0)]),
    ],
)
def test_a_needle_that_meets_it_is_not(insertion):
    assert needle_doubts(insertion, GRID) == []


def test_the_length_inside_is_that_of_points_counted_along_the_shaft():
    rng = np.random.default_rng(1)
    for _ in range(200):
        entry, tip = rng.uniform(-20, 50, (2, 2))
        along = entry + np.linspace(0, 1, 20001)[:, None] * (tip - entry)
        counted = GRID.contains(along).mean() * np.hypot(*(tip - entry))
        assert _inside(entry, tip, GRID) == pytest.approx(counted, abs=0.01)


def test_doubts_are_said_and_kept_in_the_report(picture, tmp_path):
    done = echospline(
        "simulate", picture, "--spacing", "0.1,0.1", *QUICK, "--entry", "900,0", "--out", tmp_path, "--json"
    )
    assert done.returncode == 0, done.stderr
    (line,) = (said for said in done.stderr.splitlines() if ": doubt: " in said)
    assert line.startswith("echospline: doubt: the needle never meets the tissue")
    assert json.loads(done.stdout)["doubts"] == [line.removeprefix("echospline: doubt: ")]


def test_a_long_run_says_what_it_will_cost():
    long = Scenario().with_values({"needle.speed": 0.005, "output.formats": ["mp4"]})
    doubts = check(long, image_of("uint8", 255))
    (said,) = [doubt for doubt in doubts if "long run" in doubt]
    for word in ("frames", "GiB on the disk", "min on a machine", "0.005 m/s meant"):
        assert word in said
    assert check(Scenario(), image_of("uint8", 255)) == []
    scattered = Scenario().with_values({"output.image_model": "rescatter", "needle.speed": 1.0})
    assert any("long run" in doubt for doubt in check(scattered, image_of("uint8", 255)))


@pytest.mark.parametrize(
    ("dtype", "top"),
    [("uint16", 4095), ("int16", 900), ("float32", 1.0), ("float64", 0.25), ("int32", 70000)],
)
def test_pictures_of_any_type_simulate_with_the_defaults(tmp_path, dtype, top):
    """What is dark and bright in the file is dark and bright in the cine, and the window is written down."""
    image = image_of(dtype, top)
    with open_writer(tmp_path / "a.mha", image.grid, 10) as writer:
        writer.add(image.pixels, 0.0)
        writer.add(image.pixels, 0.1)
    given = Scenario().with_values({"image.file": "a.mha"})
    scenario, taken = given.opened(tmp_path, eight_bit=None)
    low, high = float(image.pixels.min()), float(image.pixels.max())
    assert scenario.image.window == (low, high)
    assert any(f"values {low:g} to {high:g} are shown as black to white" in note for note in taken.notes)
    with open_writer(tmp_path / "a.gif", image.grid, 10) as writer:
        writer.add(taken.pixels, 0.0)
    shown = read_image(str(tmp_path / "a.gif"), spacing=(0.1, 0.1)).pixels
    expected = np.rint(255 * (image.pixels.astype(float) - low) / (high - low))
    np.testing.assert_allclose(shown, expected, atol=0.5)
    kept, raw = given.with_values({"output.formats": ["mha"]}).opened(tmp_path, eight_bit=None)
    assert kept.image.window is None
    np.testing.assert_array_equal(raw.pixels, image.pixels)


def test_a_picture_of_values_that_are_not_finite_is_refused_in_one_sentence(tmp_path):
    for fill, word in (
        (np.where(np.arange(320) % 7 == 0, np.nan, 1.0), "not finite"),
        (np.full(320, np.nan), "finite"),
    ):
        pixels = np.broadcast_to(fill, (240, 320)).astype("float32")
        with open_writer(tmp_path / "a.mha", RegularGrid((320, 240), (0.1, 0.1)), 10) as writer:
            writer.add(pixels, 0.0)
            writer.add(pixels, 0.1)
        with pytest.raises(InputError, match=word):
            Scenario().with_values({"image.file": "a.mha"}).opened(tmp_path, eight_bit=None)


def test_a_window_holds_for_the_phantom_too():
    values = {
        "image.file": "sample:phantom",
        "phantom.size": [10, 10],
        "phantom.pixel": [0.2, 0.2],
        "phantom.per_cell": 1,
    }
    plain = Scenario().with_values(values)
    raw = plain.opened(Path())[1].pixels
    shown = plain.with_values({"image.window": [50, 150]}).opened(Path())[1].pixels
    np.testing.assert_array_equal(shown, np.clip(np.rint((raw - 50.0) * 2.55), 0, 255))


@pytest.mark.parametrize("kind", ["grey16", "rgb", "float"])
def test_the_command_takes_grey16_rgb_and_float(tmp_path, kind):
    if kind == "float":
        file = tmp_path / "a.mha"
        with open_writer(file, RegularGrid((320, 240), (0.1, 0.1)), 10) as writer:
            writer.add(image_of("float32", 3.0).pixels, 0.0)
            writer.add(image_of("float32", 3.0).pixels, 0.1)
    else:
        file = tmp_path / "a.png"
        image = image_of("uint16", 40000) if kind == "grey16" else image_of("uint8", 255, 3)
        Image.fromarray(image.pixels).save(file)
    spacing = [] if kind == "float" else ["--spacing", "0.1,0.1"]
    done = echospline("simulate", file, *spacing, *QUICK, "--out", tmp_path / "out", "--json")
    assert done.returncode == 0, done.stderr
    scenario = load(tmp_path / "out" / "scenario.toml")
    assert (scenario.image.window is None) == (kind == "rgb")
    cine = read(tmp_path / "out" / "cine.mp4")
    assert cine.frames.max() > 240
    assert not list((tmp_path / "out").glob("*.part"))
    again = echospline("simulate", tmp_path / "out" / "scenario.toml", "--out", tmp_path / "again", "--json")
    assert again.returncode == 0, again.stderr
    np.testing.assert_array_equal(read(tmp_path / "again" / "cine.mp4").frames, cine.frames)


def test_too_many_samples_are_refused_before_they_are_laid_out(tmp_path):
    with pytest.raises(InputError, match=r"samples of .* are free"):
        check_store(10_000_000, 2**30, tmp_path)
    assert check_store(10, 1000, tmp_path) == []
    assert "GiB" in check_store(2000, 2**20, tmp_path)[0]


def test_tracking_refuses_a_picture_of_no_size_and_doubts_an_unlikely_one(tmp_path):
    with open_writer(tmp_path / "a.mp4", RegularGrid((64, 64), (0.2, 0.2)), 10) as writer:
        for k in range(2):
            writer.add(np.roll(np.random.default_rng(0).integers(0, 256, (64, 64), np.uint8), k, 0), k / 10)
    far = echospline("track", tmp_path / "a.mp4", "--spacing", "86.6,86.6", "--out", tmp_path / "t.npz")
    assert far.returncode == 2
    assert "micrometres" in far.stderr
    for grid, limit, word in (("0.0001", 10_000_000, "points"), ("0.01", 100, "--limit")):
        many = echospline(
            "track", tmp_path / "a.mp4", "--grid", grid, "--limit", limit, "--out", tmp_path / "t.npz"
        )
        assert many.returncode == 2
        assert word in many.stderr
        assert len(many.stderr.splitlines()) == 1
    assert not (tmp_path / "t.npz").exists()


@pytest.mark.parametrize(("spacing", "said"), [(0.1, False), (3.0, True), (86.6, True)])
def test_info_says_of_the_size_what_simulate_says(tmp_path, spacing, said):
    with open_writer(tmp_path / "a.mha", RegularGrid((320, 240), (spacing, spacing)), 10) as writer:
        for k in range(2):
            writer.add(np.zeros((240, 320), np.uint8), k / 10)
    notes = json.loads(echospline("info", tmp_path / "a.mha", "--json").stdout)["notes"]
    words = ("expected 5 to 500 mm a side", "no distance of pixels")
    found = [note for note in notes if any(word in note for word in words)]
    assert bool(found) == said
    done = echospline("simulate", tmp_path / "a.mha", *QUICK, "--out", tmp_path / "out")
    assert not found or found[0] in done.stderr


def test_the_demo_writes_no_file_beyond_5_mb(tmp_path):
    assert echospline("demo", "--out", tmp_path).returncode == 0
    assert max(file.stat().st_size for file in tmp_path.iterdir()) < 5_000_000


@pytest.mark.parametrize("border", [300, -1, float("nan"), float("inf"), 1e9, "black", None])
def test_a_border_that_the_pixels_cannot_hold_is_refused(border):
    image = image_of("uint8", 255)
    mesh = RegularGrid.covering(image.grid, (5, 5))
    model = TPSModel(mesh)
    path = Insertion.straight((8.0, 0.0), 45, 5)
    with pytest.raises(InputError, match="border must be a number from 0 to 255"):
        next(simulate(image, path, model, border=border))
    with pytest.raises(InputError, match="border must be a number from 0 to 255"):
        warp(image, Deformation(mesh, np.zeros((25, 2))), border=border)


@pytest.mark.parametrize("value", ["a", None, float("nan"), (1.0,)])
def test_what_is_no_number_is_said_in_the_words_of_the_others(value):
    image = image_of("uint8", 255)
    mesh = RegularGrid.covering(image.grid, (5, 5))
    model, fem, path = TPSModel(mesh), FEMModel(mesh), Insertion.straight((8.0, 0.0), 45, 5)
    pose = NeedlePose((8.0, 0.0), (9.0, 1.0), 1.0)
    for call, word in (
        (lambda: model.advance(model.rest(), pose, value), "dt must be"),
        (lambda: fem.advance(fem.rest(), pose, value), "dt must be"),
        (lambda: next(simulate(image, path, model, fps=value)), "fps must be"),
        (lambda: next(simulate(image, path, model, longest_step=value)), "longest_step must be"),
        (lambda: NeedleEcho(lateral=value), "lateral of a needle must be"),
        (lambda: NeedleEcho(seed=value), "seed"),
        (lambda: NeedleEcho(apex=value) if value is not None else NeedleEcho(apex="x"), "apex"),
        (lambda: Insertion.straight((8.0, 0.0), value, 5), "angle must be"),
        (lambda: Insertion.straight((8.0, 0.0), 45, value), "depth must be"),
        (lambda: NeedlePose((value, 0.0), (1.0, 1.0)), "pose must be finite"),
        (lambda: RegularGrid((value, 3), (1.0, 1.0)), "shape must be"),
        (lambda: RegularGrid((3, 3), (value, 1.0)), "spacing must be"),
        (lambda: RegularGrid((3, 3), (1.0, 1.0), (value, 0.0)), "origin must be"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=word):
            call()
