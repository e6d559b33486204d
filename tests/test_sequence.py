"""Recordings of PLUS and Slicer: read whole or refused, written so that others read them, and simulated again."""

from __future__ import annotations

import gzip
import json
import tracemalloc
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.errors import InputError
from echospline.io.sequence import SequenceWriter, read_sequence
from echospline.picture import simulate
from echospline.scene import ImagingPlane, Insertion, NeedlePose, RegularGrid, UltrasoundImage

GRID = RegularGrid((48, 40), (0.5, 0.4))
MESH = RegularGrid.covering(GRID, (13, 11))
ENDINGS = [".igs.mha", ".seq.nrrd"]


def tilted_plane() -> ImagingPlane:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec((0.3, -0.8, 1.2)).as_matrix()
    matrix[:3, 3] = (10, -20, 30)
    return ImagingPlane(matrix)


@dataclass(frozen=True)
class Dragged:
    """Stand-in tissue: what is near the tip goes with it."""

    grid: RegularGrid = MESH

    def rest(self):
        return NeedlePose((10.0, 0.0), (10.0, 0.0))

    def advance(self, state, pose, dt):
        return pose

    def displacement(self, state):
        return self.displacement_at(state, self.grid.nodes)

    def displacement_at(self, state, points):
        r2 = ((np.asarray(points) - state.tip) ** 2).sum(axis=1)
        return 0.05 * state.depth * np.exp(-r2 / 20.0)[:, None] * np.asarray(state.axis)


def speckle(dtype: str = "u1", colour: bool = False) -> np.ndarray:
    shape = (GRID.shape[1], GRID.shape[0]) + ((3,) if colour else ())
    return np.random.default_rng(3).integers(0, 200, shape).astype(dtype)


def write(path: Path, frames: int = 5, plane: ImagingPlane | None = None, **kind: object) -> Insertion:
    insertion = Insertion.straight((6.0, 0.0), 60.0, 12.0, 6.0)
    with SequenceWriter(path, GRID, plane) as writer:
        for i in range(frames):
            t = i * insertion.duration / (frames - 1)
            writer.add(np.roll(speckle(**kind), i, axis=0), t, insertion.pose(t))  # type: ignore[arg-type]
    return insertion


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("dtype", ["u1", "i2", "f4"])
def test_what_was_written_is_read(tmp_path: Path, ending: str, dtype: str) -> None:
    path = tmp_path / f"run{ending}"
    insertion = write(path, plane=tilted_plane(), dtype=dtype)
    sequence = read_sequence(path)
    assert len(sequence) == 5
    assert sequence.frames.dtype == np.dtype(dtype)
    for i in range(5):
        np.testing.assert_array_equal(sequence.frames[i], np.roll(speckle(dtype), i, axis=0))
    back = sequence.insertion()
    np.testing.assert_allclose(back.times, np.linspace(0, insertion.duration, 5), atol=1e-12)
    for t in np.linspace(0, insertion.duration, 17):
        np.testing.assert_allclose(back.pose(t).tip, insertion.pose(t).tip, atol=1e-9)
        np.testing.assert_allclose(back.pose(t).entry, insertion.pose(t).entry, atol=1e-9)
    np.testing.assert_allclose(sequence.grid().spacing, GRID.spacing, rtol=1e-12)
    assert sorted(p.name for p in tmp_path.iterdir()) == [path.name]


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("colour", [False, True])
def test_itk_reads_the_same_pixels_and_spacing(tmp_path: Path, ending: str, colour: bool) -> None:
    path = tmp_path / f"run{ending}"
    write(path, plane=tilted_plane(), colour=colour)
    image = SimpleITK.ReadImage(str(path))
    pixels = SimpleITK.GetArrayFromImage(image)
    if (
        image.GetNumberOfComponentsPerPixel() == 5
    ):  # ITK takes the list of a grey NRRD sequence for components
        pixels = np.moveaxis(pixels, -1, 0)
    pixels = pixels.reshape(read_sequence(path).frames.shape)
    np.testing.assert_array_equal(pixels, read_sequence(path).frames)
    np.testing.assert_allclose(image.GetSpacing()[:2], GRID.spacing, rtol=1e-9)
    if ending == ".seq.nrrd":  # it also says where the picture lies: LPS, as files do
        np.testing.assert_allclose(image.GetOrigin()[:3], np.diag([-1, -1, 1]) @ (10, -20, 30), atol=1e-9)
        n = image.GetDimension()
        columns = np.reshape(image.GetDirection(), (n, n))[:3, :3]
        np.testing.assert_allclose(columns, np.diag([-1, -1, 1]) @ tilted_plane().matrix[:3, :3], atol=1e-9)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_recorded_run_simulated_again_gives_the_same_pictures(tmp_path: Path, ending: str) -> None:
    """Keyframes read from the file drive the model through the same poses: the pictures agree to the last bit."""
    image = UltrasoundImage(speckle(), GRID)
    insertion = Insertion.straight((6.0, 0.0), 60.0, 12.0, 6.0, dwell=0.5, retract=True)
    path = tmp_path / f"run{ending}"
    with SequenceWriter(path, GRID, tilted_plane()) as writer:
        for frame in simulate(image, insertion, Dragged(), fps=10):
            writer.add(frame.image.pixels, frame.time, frame.pose)
    sequence = read_sequence(path)
    again = list(simulate(sequence.image(), sequence.insertion(), Dragged(), fps=10))
    assert len(again) == len(sequence)
    worst = max(
        np.abs(f.image.pixels.astype(int) - g.astype(int)).max()
        for f, g in zip(again, sequence.frames, strict=True)
    )
    assert worst <= 1  # rounding of the last grey level
    assert (
        np.abs(sequence.frames[-20].astype(int) - sequence.frames[0]).max() > 20
    )  # and there was something to see


def test_a_real_recording_of_plus_is_read(recordings: Path) -> None:
    sequence = read_sequence(recordings / "pluslib" / "BkCurvilinearScanConvertedData.igs.mha")
    assert sequence.frames.shape == (1, 400, 600)
    assert sequence.times[0] == 15.462571
    assert sorted(sequence.transforms) == ["ReferenceToTracker", "StylusToTracker"]
    np.testing.assert_allclose(sequence.transforms["StylusToTracker"][0, :3, 3], (51.4141, 433.638, 770.265))
    with pytest.raises(InputError, match="no spacing"):
        sequence.cine()
    assert sequence.cine((0.2, 0.2)).grid.spacing == (0.2, 0.2)
    with pytest.raises(InputError, match="StylusTip near the image in 0 of 1 frames"):
        sequence.insertion("StylusTip", spacing=(0.2, 0.2))


def mat(m: np.ndarray) -> str:
    return " ".join(f"{v:.12g}" for v in m.ravel())


def plus_like(
    data: bytes,
    *,
    orientation: str = "MF",
    compressed: bool = False,
    element: str = "LOCAL",
    lost: int | None = None,
) -> bytes:
    """A recording as PLUS lays it out: needle and probe in the tracker's frame, spacing 1 1, status for each."""
    probe = np.eye(4)
    probe[:3, :3] = Rotation.from_rotvec((0.2, 0.5, -0.4)).as_matrix()
    probe[:3, 3] = (100, 200, -300)
    image_to_probe = np.array([[0, 0.4, 0, 3], [0.5, 0, 0, -7], [0, 0, -0.5, 2], [0, 0, 0, 1]])
    lines = [
        "ObjectType = Image", "NDims = 3", "BinaryData = True", "BinaryDataByteOrderMSB = False",
        f"CompressedData = {compressed}", f"CompressedDataSize = {len(data)}", "DimSize = 48 40 4",
        "ElementSpacing = 1 1 1", "ElementType = MET_UCHAR", f"UltrasoundImageOrientation = {orientation}",
    ]  # fmt: skip
    for i in range(4):
        tip = np.eye(4)  # +Z of the needle is the row axis of the image
        tip[:3, :3] = np.column_stack(((0, 0, 1), (0, 1, 0), (-1, 0, 0)))
        x_axis, y_axis = image_to_probe[:3, 0] / 0.5, image_to_probe[:3, 1] / 0.4
        tip[:3, :3] = np.column_stack((x_axis, np.cross(y_axis, x_axis), y_axis))
        tip[:3, 3] = image_to_probe[:3, 3] + 10 * x_axis + 3 * i * y_axis
        lines += [
            f"Seq_Frame{i:04d}_ProbeToTrackerTransform = {mat(probe)}",
            f"Seq_Frame{i:04d}_ProbeToTrackerTransformStatus = OK",
            f"Seq_Frame{i:04d}_StylusTipToTrackerTransform = {mat(probe @ tip)}",
            f"Seq_Frame{i:04d}_StylusTipToTrackerTransformStatus = {'INVALID' if i == lost else 'OK'}",
            f"Seq_Frame{i:04d}_Timestamp = {100 + 0.5 * i}",
            f"Seq_Frame{i:04d}_ImageStatus = OK",
        ]
    return "\n".join([*lines, f"ElementDataFile = {element}", ""]).encode() + (
        data if element == "LOCAL" else b""
    )


IMAGE_TO_PROBE = {
    "ImageToProbe": np.array([[0, 0.4, 0, 3], [0.5, 0, 0, -7], [0, 0, -0.5, 2], [0, 0, 0, 1.0]])
}
RAW = np.stack([np.roll(speckle(), i, axis=1) for i in range(4)]).tobytes()


@pytest.mark.parametrize("lost", [None, 2])
def test_a_stylus_in_the_trackers_frame_is_found_by_the_calibration(tmp_path: Path, lost: int | None) -> None:
    path = tmp_path / "plus.igs.mha"
    path.write_bytes(plus_like(RAW, lost=lost))
    sequence = read_sequence(path)
    insertion = sequence.insertion("StylusTip", spacing=(0.5, 0.4), calibration=IMAGE_TO_PROBE)
    assert len(insertion.times) == (4 if lost is None else 3)
    for t in (0.0, 0.5, 1.0, 1.5):  # a lost frame is bridged
        np.testing.assert_allclose(insertion.pose(t).tip, (10, 6 * t), atol=1e-6)
    np.testing.assert_allclose(insertion.pose(1.5).entry, (10, 0), atol=1e-6)


def test_transforms_are_in_the_frame_of_the_mf_picture_whatever_the_file_stores(tmp_path: Path) -> None:
    pictures = {}
    for orientation in ("MF", "UFA", "MN", "UND"):
        path = tmp_path / f"{orientation}.mha"
        path.write_bytes(plus_like(RAW, orientation=orientation))
        pictures[orientation] = read_sequence(path).frames
    np.testing.assert_array_equal(pictures["UFA"], pictures["MF"][:, :, ::-1])
    np.testing.assert_array_equal(pictures["MN"], pictures["MF"][:, ::-1])
    np.testing.assert_array_equal(pictures["UND"], pictures["MF"][:, ::-1, ::-1])
    assert not np.array_equal(pictures["UFA"], pictures["MF"])


def test_compressed_and_separate_pixels_are_read(tmp_path: Path) -> None:
    whole, packed, header = tmp_path / "a.mha", tmp_path / "b.mha", tmp_path / "c.mhd"
    whole.write_bytes(plus_like(RAW))
    packed.write_bytes(plus_like(zlib.compress(RAW), compressed=True))
    header.write_bytes(plus_like(b"", element="c.zraw", compressed=True))
    (tmp_path / "c.zraw").write_bytes(zlib.compress(RAW))
    nrrd = tmp_path / "d.seq.nrrd"
    write(nrrd)
    head, _, raw = nrrd.read_bytes().partition(b"\n\n")
    gz = tmp_path / "e.seq.nrrd"
    gz.write_bytes(head.replace(b"encoding: raw", b"encoding: gzip") + b"\n\n" + gzip.compress(raw))
    for path in (packed, header):
        np.testing.assert_array_equal(read_sequence(path).frames, read_sequence(whole).frames)
    np.testing.assert_array_equal(read_sequence(gz).frames, read_sequence(nrrd).frames)


def test_slicers_own_index_values_serve_as_times(tmp_path: Path) -> None:
    path = tmp_path / "a.seq.nrrd"
    write(path)
    lines = [line for line in path.read_bytes().split(b"\n") if b"Timestamp" not in line]
    path.write_bytes(b"\n".join(lines))
    np.testing.assert_allclose(read_sequence(path).times, np.linspace(0, 2, 5))


GOOD = plus_like(RAW)
BROKEN = {
    "pixels cut short": (GOOD[:-1], "is not whole"),
    "header without end": (GOOD[:500], "does not end"),
    "not a header": (b"\x89PNG\r\n\x1a\n" + bytes(100), "does not end|neither MetaImage"),
    "petabytes": (GOOD.replace(b"48 40 4\n", b"99999999 99999999 4\n"), "at most 2048 MiB"),
    "a billion frames": (GOOD.replace(b"48 40 4\n", b"1 1 999999999\n"), "1 to 1000000 pictures"),
    "no width": (GOOD.replace(b"48 40 4\n", b"0 40 4\n"), "1 to 1000000 pictures"),
    "sizes of words": (GOOD.replace(b"48 40 4\n", b"many\n"), "no sequence that echospline can read"),
    "unknown pixels": (GOOD.replace(b"MET_UCHAR", b"MET_OTHER"), "ElementType must be one of"),
    "no sizes": (GOOD.replace(b"DimSize", b"Size"), "DimSize"),
    "sideways": (GOOD.replace(b"Orientation = MF", b"Orientation = FM"), "orientation FM"),
    "matrix of words": (
        GOOD.replace(b"ProbeToTrackerTransform = ", b"ProbeToTrackerTransform = x "),
        "16 finite numbers",
    ),
    "matrix of infinities": (GOOD.replace(b"Timestamp = 100.5", b"Timestamp = inf"), "1 finite number"),
    "no time": (GOOD.replace(b"Seq_Frame0002_Timestamp", b"Seq_Frame0002_When"), "no time stamp for frame 2"),
    "frame beyond the last": (
        GOOD.replace(b"Seq_Frame0003_Time", b"Seq_Frame0009_Time"),
        "beyond the last frame 3",
    ),
    "tool without a name": (GOOD.replace(b"_ProbeToTrackerT", b"_ProbeT"), "<From>To<To>"),
    "path out of its folder": (plus_like(b"", element="../../etc/passwd"), "only a file beside it"),
    "absolute path": (plus_like(b"", element="/etc/passwd"), "only a file beside it"),
    "missing pixels": (plus_like(b"", element="gone.raw"), "is not there"),
    "damaged compression": (plus_like(b"garbage" * 100, compressed=True), "damaged"),
    "endless line": (b"ObjectType = " + b"x" * 100_000 + b"\n", "line beyond"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_refused_with_a_reason(tmp_path: Path, name: str) -> None:
    data, reason = BROKEN[name]
    path = tmp_path / "broken.mha"
    path.write_bytes(data)
    with pytest.raises(InputError, match=reason):
        read_sequence(path)


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.mha"
    path.write_bytes(plus_like(zlib.compress(bytes(200_000_000)), compressed=True))
    tracemalloc.start()
    assert not read_sequence(path).frames.any()  # the declared 7680 bytes, no more
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 3_000_000


@settings(max_examples=150)
@given(st.lists(st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)), min_size=1, max_size=6))
def test_a_mutated_file_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, changes: list[tuple[int, int]]
) -> None:
    data = bytearray(GOOD)
    for at, value in changes:
        data[at] = value
    path = tmp_path_factory.getbasetemp() / "mutated.mha"
    path.write_bytes(data)
    with suppress(InputError):
        assert len(read_sequence(path)) >= 1


def test_an_interrupted_run_leaves_the_old_file_alone(tmp_path: Path) -> None:
    def interrupted() -> None:
        with SequenceWriter(path, GRID) as writer:
            writer.add(speckle(), 0.0, NeedlePose((6.0, 0.0), (6.0, 1.0)))
            raise RuntimeError("the lights went out")

    path = tmp_path / "run.igs.mha"
    write(path)
    before = path.read_bytes()
    with pytest.raises(RuntimeError):
        interrupted()
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.igs.mha"]


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        ([(speckle(), 0.0), (speckle("i2"), 1.0)], "as the first"),
        ([(speckle(), 0.0), (speckle(), 0.0)], "later"),
        ([(speckle().T, 0.0)], "needs a grid"),
        ([], "no frame"),
    ],
    ids=["other type", "same time", "other shape", "none"],
)
def test_frames_that_do_not_belong_are_refused(
    tmp_path: Path, frames: list[tuple[np.ndarray, float]], reason: str
) -> None:
    def write_them() -> None:
        with SequenceWriter(tmp_path / "a.igs.mha", GRID) as writer:
            for pixels, time in frames:
                writer.add(pixels, time, NeedlePose((6.0, 0.0), (6.0, 1.0)))

    with pytest.raises(InputError, match=reason):
        write_them()
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"NAME\.igs\.mha"):
        SequenceWriter(tmp_path / "a.mp4", GRID)


def test_simulate_writes_recordings_that_carry_the_needle(tmp_path: Path) -> None:
    words = [
        "--mesh",
        "12x10",
        "--entry",
        "10,0",
        "--angle",
        "60",
        "--depth",
        "6",
        "--speed",
        "12",
        "--dwell",
        "0",
    ]
    extra = [
        "--no-retract",
        "--fps",
        "5",
        "--formats",
        "igs.mha,seq.nrrd",
        "--no-figure",
        "--no-displacement",
        "--json",
    ]
    answer = CliRunner().invoke(app, ["simulate", "sample:calf", "--out", str(tmp_path), *words, *extra])
    assert answer.exit_code == 0
    for name in ("run.igs.mha", "run.seq.nrrd"):
        insertion = read_sequence(tmp_path / name).insertion()
        np.testing.assert_allclose(insertion.entry[0], (10, 0), atol=1e-9)
        depth = np.hypot(*(insertion.tip - insertion.entry).T)
        np.testing.assert_allclose(depth, 12 * insertion.times, atol=1e-9)


def test_a_recorded_procedure_is_simulated_again_and_compared(tmp_path: Path) -> None:
    words = ["--mesh", "16x12", "--model", "tps", "--needle-frame", "NeedleTip"]
    tissue = [
        "--model",
        "tps",
        "--mesh",
        "16x12",
        "--entry",
        "10,0",
        "--angle",
        "60",
        "--depth",
        "12",
        "--speed",
        "12",
        "--dwell",
        "0",
    ]
    extra = [
        "--no-retract",
        "--fps",
        "10",
        "--formats",
        "igs.mha",
        "--no-figure",
        "--no-displacement",
        "--json",
    ]
    first = CliRunner().invoke(app, ["simulate", "sample:calf", "--out", str(tmp_path), *tissue, *extra])
    assert first.exit_code == 0
    recording = str(tmp_path / "run.igs.mha")
    answer = CliRunner().invoke(
        app, ["recorded", recording, "--out", str(tmp_path / "again"), *words, "--json"]
    )
    assert answer.exit_code == 0
    told = json.loads(answer.output)
    assert told["frames"] == 11
    assert told["deepest_mm"] == pytest.approx(12)
    assert told["median_correlation_simulated"] > 0.999  # the very run comes out again
    assert told["median_correlation_still"] < 0.9
    np.testing.assert_allclose(
        read_sequence(tmp_path / "again" / "resimulated.igs.mha").insertion().tip,
        read_sequence(recording).insertion().tip,
        atol=1e-9,
    )
    lines = (tmp_path / "again" / "comparison.csv").read_text().splitlines()
    assert lines[0].startswith("time_s,tip_x_mm,tip_y_mm,depth_mm,correlation_simulated")
    assert len(lines) == 12
