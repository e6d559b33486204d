"""Cines on the disk: what is written comes back, with its times, and only whole files carry their name."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
import pytest
import SimpleITK
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from echospline.errors import InputError
from echospline.io import DisplacementWriter, open_writer, read, read_displacement
from echospline.io.displacement import LOADS
from echospline.scene import NeedlePose, RegularGrid

GRID = RegularGrid((33, 21), (0.1, 0.2), (1.5, -2.0))


def frames(count: int = 6, shape: tuple[int, ...] = (21, 33), dtype: type = np.uint8) -> np.ndarray:
    """Smooth moving pattern with black, white and the greys between."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    waves = [127.5 + 127.5 * np.sin(x / 5 + y / 7 + k / 3) for k in range(count)]
    grey = np.rint(waves).astype(dtype)
    return np.stack([grey, grey[::-1], 255 - grey], axis=-1) if len(shape) == 3 else grey


def write(
    path: Path,
    cine: Sequence[np.ndarray] | np.ndarray,
    times: np.ndarray,
    grid: RegularGrid = GRID,
    fps: float = 25,
) -> None:
    with open_writer(path, grid, fps) as writer:
        for pixels, t in zip(cine, times, strict=True):
            writer.add(pixels, float(t))


def test_gif_keeps_every_grey_exactly_and_its_times(tmp_path: Path) -> None:
    cine, times = frames(), np.arange(6) / 30
    write(tmp_path / "a.gif", cine, times)
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.n_frames == 6
        assert gif.info["loop"] == 0
        delays = []
        for k in range(6):
            gif.seek(k)
            delays.append(gif.info["duration"])
            np.testing.assert_array_equal(np.asarray(gif.convert("L")), cine[k])
    starts = np.cumsum([0, *delays[:-1]])
    assert np.abs(starts - 1000 * times).max() <= 5  # hundredths of a second, and errors do not add up


def test_gif_above_fifty_frames_per_second_leaves_frames_out_and_keeps_the_speed(tmp_path: Path) -> None:
    times = np.arange(101) / 100
    write(tmp_path / "a.gif", frames(101), times, fps=100)
    with Image.open(tmp_path / "a.gif") as gif:
        delays = []
        for k in range(gif.n_frames):
            gif.seek(k)
            delays.append(gif.info["duration"])
    assert min(delays) >= 20
    assert sum(delays[:-1]) == pytest.approx(1000, abs=10)


def test_gif_in_colour_stays_close(tmp_path: Path) -> None:
    cine = frames(3, (21, 33, 3))
    write(tmp_path / "a.gif", cine, np.arange(3) / 25)
    with Image.open(tmp_path / "a.gif") as gif:
        gif.seek(2)
        error = np.abs(np.asarray(gif.convert("RGB")).astype(int) - cine[2])
    assert error.mean() < 6
    assert np.argmax(cine[2].reshape(-1, 3).var(0)) == np.argmax(
        np.asarray(gif.convert("RGB")).reshape(-1, 3).var(0)
    )


def test_mp4_is_what_browsers_play_with_greys_and_times_kept(tmp_path: Path) -> None:
    cine = frames(8)
    times = np.array([0, 1, 2, 4, 5, 6, 8, 11]) / 30  # not every interval is the same
    write(tmp_path / "a.mp4", cine, times, fps=30)
    assert (tmp_path / "a.mp4").read_bytes().find(b"moov") < (tmp_path / "a.mp4").read_bytes().find(b"mdat")
    with av.open(str(tmp_path / "a.mp4")) as movie:
        stream = movie.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        decoded = list(movie.decode(video=0))
    np.testing.assert_allclose([f.time for f in decoded], times, atol=1e-4)
    for frame, expected in zip(decoded, cine, strict=True):
        grey = frame.to_ndarray(format="gray")
        assert grey.shape == (22, 34)  # an odd row and column are shown twice
        error = np.abs(grey[:21, :33].astype(int) - expected)
        assert error.mean() < 2.5
        assert error.max() < 20


def test_mp4_in_colour_has_the_right_channels(tmp_path: Path) -> None:
    cine = np.zeros((3, 40, 48, 3), dtype=np.uint8)
    cine[..., :24, :] = (200, 40, 30)
    cine[..., 24:, :] = (30, 60, 190)
    write(tmp_path / "a.mp4", cine, np.arange(3) / 25, RegularGrid((48, 40), (0.1, 0.1)))
    with av.open(str(tmp_path / "a.mp4")) as movie:
        shown = next(movie.decode(video=0)).to_ndarray(format="rgb24")
    np.testing.assert_allclose(shown[20, 8], (200, 40, 30), atol=6)
    np.testing.assert_allclose(shown[20, 40], (30, 60, 190), atol=6)


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.uint16, np.int32, np.float32, np.float64])
def test_mha_is_exact_for_itk(tmp_path: Path, dtype: type) -> None:
    cine = frames(5, dtype=dtype)
    write(tmp_path / "a.mha", cine, np.arange(5) * 0.04)
    image = SimpleITK.ReadImage(str(tmp_path / "a.mha"))
    np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image), cine)
    np.testing.assert_allclose(image.GetSpacing(), (0.1, 0.2, 0.04))
    np.testing.assert_allclose(image.GetOrigin()[:2], (1.5, -2.0))
    assert float(image.GetMetaData("Seq_Frame0003_Timestamp")) == pytest.approx(0.12)


def test_mha_in_colour_is_exact_for_itk(tmp_path: Path) -> None:
    cine = frames(3, (21, 33, 3))
    write(tmp_path / "a.mha", cine, np.arange(3) * 0.04)
    np.testing.assert_array_equal(
        SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(tmp_path / "a.mha"))), cine
    )


@pytest.mark.parametrize("shape", [(21, 33), (21, 33, 3)])
def test_frames_folder_holds_exact_pictures_and_their_times(tmp_path: Path, shape: tuple[int, ...]) -> None:
    cine, times = frames(4, shape), np.array([0.0, 0.1, 0.25, 0.3])
    for _ in range(2):  # a second run replaces the first
        write(tmp_path / "frames", cine, times)
    names = sorted(p.name for p in (tmp_path / "frames").iterdir())
    assert names == [*(f"frame_{k:05d}.png" for k in range(4)), "times.csv"]
    for k in range(4):
        np.testing.assert_array_equal(
            np.asarray(Image.open(tmp_path / "frames" / f"frame_{k:05d}.png")), cine[k]
        )
    table = np.loadtxt(tmp_path / "frames" / "times.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table, np.column_stack([np.arange(4), times]))


def test_frames_never_replace_a_folder_with_other_things_in_it(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="thesis"):
        write(tmp_path / "frames", frames(2), np.arange(2) / 30)
    assert (tmp_path / "frames" / "thesis.txt").read_text() == "mine"


def test_values_beyond_eight_bits_need_a_window(tmp_path: Path) -> None:
    cine = np.linspace(-500, 1500, 21 * 33).reshape(1, 21, 33)
    with pytest.raises(InputError, match="window"):
        write(tmp_path / "a.gif", cine, np.zeros(1))
    with open_writer(tmp_path / "a.gif", GRID, 25, window=(0.0, 1000.0)) as writer:
        writer.add(cine[0], 0.0)
    shown = np.asarray(Image.open(tmp_path / "a.gif").convert("L"))
    np.testing.assert_array_equal(shown, np.rint(np.clip(cine[0] / 1000, 0, 1) * 255))


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.mha", "frames"])
@pytest.mark.parametrize(
    ("second", "at", "message"),
    [
        (np.zeros((20, 33), np.uint8), 1.0, "must be"),
        (np.zeros((21, 33), np.uint16), 1.0, "must be"),
        (np.zeros((21, 33, 3), np.uint8), 1.0, "must be"),
        (np.zeros((21, 33), np.uint8), 0.0, "later"),
        (np.zeros((21, 33), np.uint8), float("nan"), "later"),
    ],
)
def test_a_frame_that_does_not_fit_is_refused_and_leaves_no_final_file(
    tmp_path: Path, name: str, second: np.ndarray, at: float, message: str
) -> None:
    cine = [frames(1)[0], second]
    with pytest.raises(InputError, match=message):
        write(tmp_path / name, cine, np.array([0.0, at]))
    assert not (tmp_path / name).exists()
    assert list(tmp_path.glob(f"{name}.*.part"))


@pytest.mark.parametrize("name", ["a.avi", "a.webm", "a.txt", ".hidden.png"])
def test_unknown_suffix_names_the_known_ones(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"\.mp4, \.gif, \.mha"):
        open_writer(tmp_path / name, GRID, 25)


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.mha", "frames"])
def test_a_cine_without_frames_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="no frame"), open_writer(tmp_path / name, GRID, 25):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_gives_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(InputError, match="cannot write"):
        write(tmp_path / "taken" / "a.mp4", frames(1), np.zeros(1))


def record(path: Path, count: int = 5) -> np.ndarray:
    mesh = RegularGrid((4, 3), (2.0, 3.0), (1.0, -1.0))
    fields = np.random.default_rng(3).normal(size=(count, 12, 2))
    with DisplacementWriter(path, mesh.nodes) as writer:
        for k, field in enumerate(fields):
            writer.add(field, 0.1 * k, NeedlePose((1.0, 0.0), (2.0, 3.0 + k), 5.0 - k))
    return fields


def test_displacement_record_comes_back_whole(tmp_path: Path) -> None:
    fields = record(tmp_path / "displacement.npz")
    with np.load(tmp_path / "displacement.npz", allow_pickle=False) as plain:  # as anyone would load it
        assert set(plain) == {"points", "displacement", "times", "tip", "entry", "speed"}
        np.testing.assert_array_equal(plain["displacement"], fields)
        np.testing.assert_array_equal(plain["tip"], [[2.0, 3.0 + k] for k in range(5)])
    found = read_displacement(tmp_path / "displacement.npz")
    np.testing.assert_array_equal(found.displacement, fields)
    np.testing.assert_allclose(found.times, 0.1 * np.arange(5))
    assert found.pose(2) == NeedlePose((1.0, 0.0), (2.0, 5.0), 3.0)
    assert found.grid() == RegularGrid((4, 3), (2.0, 3.0), (1.0, -1.0))
    assert [p.name for p in tmp_path.iterdir()] == ["displacement.npz"]


def test_forces_are_recorded_for_every_frame_or_for_none(tmp_path: Path) -> None:
    mesh, at, still = RegularGrid((2, 2), (1.0, 1.0)), NeedlePose((0, 0), (0, 1), 1.0), np.zeros((4, 2))
    loads = [dict(zip(LOADS, 10.0 * k + np.arange(5), strict=True)) for k in range(3)]
    with DisplacementWriter(tmp_path / "a.npz", mesh.nodes) as writer:
        for k, load in enumerate(loads):
            writer.add(still, float(k), at, load)
    with np.load(tmp_path / "a.npz") as plain:
        np.testing.assert_array_equal(plain["torque_N_mm"], [3, 13, 23])
    found = read_displacement(tmp_path / "a.npz")
    assert {name: values.tolist() for name, values in found.loads.items()} == {
        name: [load[name] for load in loads] for name in LOADS
    }
    with DisplacementWriter(tmp_path / "b.npz", mesh.nodes) as writer:
        writer.add(still, 0.0, at)
        with pytest.raises(InputError, match="every frame or for none"):
            writer.add(still, 1.0, at, loads[0])
        with pytest.raises(InputError, match=r"force of the needle at 1\.0 s is not finite"):
            DisplacementWriter(tmp_path / "c.npz", mesh.nodes).add(
                still, 1.0, at, loads[0] | {"cut_mm": np.nan}
            )
    assert read_displacement(tmp_path / "b.npz").loads == {}


KILLED = """
import sys, numpy as np
from echospline.scene import RegularGrid
from echospline.io import open_writer, DisplacementWriter
from echospline.scene import NeedlePose
name = sys.argv[1]
rng = np.random.default_rng(0)
if name.endswith(".npz"):
    writer = DisplacementWriter(name, rng.normal(size=(50, 2)))
    def add(k): writer.add(np.full((50, 2), float(k)), k / 30, NeedlePose((0, 0), (0, 1), 1))
else:
    writer = open_writer(name, RegularGrid((64, 48), (0.1, 0.1)), 30)
    def add(k): writer.add(np.full((48, 64), (k * 3) % 256, np.uint8), k / 30)
k = 0
while True:
    add(k)
    k += 1
    if k == 200:
        print("enough", flush=True)
"""


def count_frames(part: Path) -> int:
    """Frames in a partial file, as an independent reader sees them."""
    if part.is_dir():
        return sum(1 for p in part.glob("frame_*.png") if np.asarray(Image.open(p)).shape == (48, 64))
    if ".mp4" in part.name:
        with av.open(str(part), format="mp4") as movie:
            return sum(1 for _ in movie.decode(video=0))
    if ".gif" in part.name:
        with Image.open(part) as gif:
            return gif.n_frames
    if ".mha" in part.name:
        renamed = part.with_name("partial.mha")
        part.rename(renamed)
        return SimpleITK.ReadImage(str(renamed)).GetSize()[2]
    fields = np.load(part, allow_pickle=False)
    np.testing.assert_array_equal(fields[:, 0, 0], np.arange(len(fields)))
    return len(fields)


@pytest.mark.skipif(sys.platform == "win32", reason="kills a process by signal")
@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.mha", "frames", "displacement.npz"])
def test_a_killed_run_leaves_the_old_file_and_a_readable_part(tmp_path: Path, name: str) -> None:
    target = tmp_path / name
    if name != "frames":
        target.write_bytes(b"from an earlier run")
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, str(target)], stdout=subprocess.PIPE, text=True
    ) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "enough\n"
        time.sleep(0.05)  # die somewhere in the middle
        run.send_signal(signal.SIGKILL)
    if name == "frames":
        assert not target.exists()
    else:
        assert target.read_bytes() == b"from an earlier run"
    (part,) = tmp_path.glob(f"{name}.*.part")
    assert count_frames(part) >= 120


@pytest.mark.parametrize("name", ["a.mp4", "frames"])
def test_what_is_written_here_knows_its_spacing(tmp_path: Path, name: str) -> None:
    write(tmp_path / name, frames(), np.arange(6) / 25)
    path = tmp_path / name if name == "a.mp4" else tmp_path / name / "frame_00002.png"
    assert read(path, frame=0).grid.spacing == GRID.spacing
    assert read(path, frame=0, spacing=(1.0, 2.0)).grid.spacing == (1.0, 2.0)


@pytest.mark.parametrize(
    "lengths", ["0 0", "-0.1 0.1", "nan 0.1", "1e999 0.1", "0.1.1 0.1", "0.1 0.1 and more"]
)
def test_a_comment_that_is_no_spacing_is_left_alone(tmp_path: Path, lengths: str) -> None:
    first, second = lengths.split(" ", 1)
    note = PngInfo()
    note.add_text("Comment", f"echospline: pixels of {first} mm lateral, {second} mm depth")
    Image.fromarray(frames()[0]).save(tmp_path / "a.png", pnginfo=note)
    with pytest.raises(InputError, match="--spacing LAT,DEPTH"):
        read(tmp_path / "a.png")


BOUNDED = """
import resource, sys, numpy as np
from echospline.scene import RegularGrid
from echospline.io import DisplacementWriter, open_writer
from echospline.scene import NeedlePose
name, few, many = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
grid = RegularGrid((300, 200), (0.1, 0.1))
rng = np.random.default_rng(0)
field, pixels = rng.normal(size=(grid.size, 2)), rng.integers(0, 256, (200, 300), dtype=np.uint8)
npz = name.endswith(".npz")
with DisplacementWriter(name, grid.nodes) if npz else open_writer(name, grid, 30) as writer:
    for k in range(many):
        if k == few:
            early = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if npz:
            writer.add(field, k / 30, NeedlePose((0, 0), (0, 1), 1))
        else:
            writer.add(np.roll(pixels, k), k / 30)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - early)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of memory as Linux counts it")
@pytest.mark.parametrize(
    ("name", "few", "many"), [("a.mp4", 60, 300), ("a.gif", 60, 300), ("a.mha", 60, 900), ("a.npz", 10, 110)]
)
def test_a_longer_cine_takes_no_more_memory(tmp_path: Path, name: str, few: int, many: int) -> None:
    command = [sys.executable, "-c", BOUNDED, str(tmp_path / name), str(few), str(many)]
    grown = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    held = 200 * 300 * (16 if name == "a.npz" else 1) * (many - few) / 1024  # KiB, were the frames kept
    assert grown < 0.3 * held
