"""Tracking says what it knows: no trust without signal, any unit of RF, memory that does not grow, arrays of other programs."""

from __future__ import annotations

import json
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import Result
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.io import loadmat, savemat
from scipy.ndimage import gaussian_filter, shift
from typer.testing import CliRunner

from echospline import tracking
from echospline.cli.app import app
from echospline.cli.info import describe
from echospline.errors import EchosplineError, InputError, MissingExtraError
from echospline.io import list_arrays, open_lines
from echospline.picture.summary import tracking_figure
from echospline.scene import Cine, Echo, EchoCine, RegularGrid, UltrasoundImage
from echospline.tracking import BlockMatching, FlowTracker, grid_over, read_track, track
from written_inputs import matlab_7_3, video

CARRIER = 2 * 5.0 / 1.54
"""Cycles per mm of 5 MHz."""
DX, DY = 0.3, 1.54 / 2 / 40
"""mm; lines of a linear array, samples at 40 MHz."""
STEP = 0.03
"""mm; axial motion from frame to frame, about a fifth of a wavelength's echo."""


def lines(frames: int = 3, count: int = 48, samples: int = 600) -> np.ndarray:
    """RF lines of speckle that moves down by `STEP` each frame, shape (frames, samples, lines)."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(samples, count)) + 1j * rng.normal(size=(samples, count))
    envelope = gaussian_filter(noise.real, (8, 1.2)) + 1j * gaussian_filter(noise.imag, (8, 1.2))
    turn = np.exp(2j * np.pi * CARRIER * DY * np.arange(samples))[:, None]
    spectrum = np.fft.fft((envelope * turn).real, axis=0)
    f = np.fft.fftfreq(samples, DY)[:, None]
    return np.stack(
        [np.fft.ifft(spectrum * np.exp(-2j * np.pi * f * STEP * k), axis=0).real for k in range(frames)]
    )


RF = lines()
OPTIONS = ("--rf", "5", "--spacing", f"{DX},{DY}", "--fps", "20", "--roi", "3,2,11,9", "--json")


def run(*words: object) -> Result:
    return CliRunner().invoke(app, ["track", *(str(word) for word in words)])


def report(*words: object) -> dict:
    result = run(*words)
    assert result.exit_code == 0, result.output + repr(result.exception)
    return json.loads(result.stdout)


def moved_down(path: Path) -> None:
    """Check the motion of the last frame against the truth."""
    found = read_track(path)
    u = found.motion.displacement[-1]
    trusted = found.confidence[-1] >= 0.3
    assert trusted.mean() > 0.9
    assert np.abs(u[trusted, 1] - 2 * STEP).mean() < 0.003
    assert np.abs(u[trusted, 0]).mean() < 0.03


# --- trust


@pytest.mark.parametrize("method", ["flow", "block"])
def test_a_black_cine_is_trusted_nowhere(tmp_path: Path, method: str) -> None:
    path = video(tmp_path / "a.mp4", frames=np.zeros((4, 96, 96), np.uint8))
    found = report(path, "--spacing", "0.1,0.1", "--out", tmp_path / "t.npz", "--method", method, "--json")
    assert found["trusted"] == found["trusted_last_frame"] == 0.0
    assert (read_track(tmp_path / "t.npz").confidence == 0).all()


def test_the_share_that_is_trusted_leaves_the_first_frame_out(tmp_path: Path) -> None:
    grey = np.repeat(
        (np.random.default_rng(0).random((3, 96, 96)) * 255).astype(np.uint8), 1, 0
    )  # nothing in common
    path = video(tmp_path / "a.mp4", frames=grey)
    found = report(path, "--spacing", "0.1,0.1", "--out", tmp_path / "t.npz", "--json")
    confidence = read_track(tmp_path / "t.npz").confidence
    assert found["trusted"] == pytest.approx((confidence[1:] >= 0.3).mean())
    assert found["trusted"] < 0.05
    text = run(path, "--spacing", "0.1,0.1", "--out", tmp_path / "t.npz").output
    assert "in the last frame" in text


@pytest.mark.parametrize("tracker", [FlowTracker(), BlockMatching(window=(2, 2), search=0.4)])
@pytest.mark.parametrize("noise", [0, 2])
def test_black_margins_are_trusted_nowhere_and_tissue_is(tracker, noise: int) -> None:
    rng = np.random.default_rng(1)
    still = gaussian_filter(rng.normal(size=(220, 220)), 1.5)
    still = 30 + 200 * (still - still.min()) / np.ptp(still)
    x, y = np.meshgrid(np.arange(220), np.arange(220))
    sector = np.abs(x - 110) < 20 + 0.4 * y
    frames = []
    for k in range(4):
        seen = np.where(sector, shift(still, (1.0 * k, 0), mode="wrap"), 0) + rng.integers(
            0, noise + 1, still.shape
        )
        frames.append(np.clip(seen, 0, 255).astype(np.uint8))
    grid = RegularGrid((220, 220), (0.1, 0.1))
    points = grid_over(grid.extent, 0.5).nodes
    found = track(Cine(np.stack(frames), 0.1 * np.arange(4), grid), points, tracker)
    distance = np.abs(points[:, 0] - 11) - (2 + 0.4 * points[:, 1])  # from the sector's edge along x, mm
    middle = (points[:, 1] > 3) & (points[:, 1] < 19)
    assert (found.confidence[:, (distance > 0.6) & middle] == 0).all()
    inside = (distance < -1.5) & middle
    assert (found.confidence[1:, inside] > 0.3).mean() > 0.9
    assert np.abs(found.displacement[-1, inside, 1] - 0.3).mean() < 0.02


@pytest.mark.parametrize("unit", [1e-22, 1.0, 1e18])
def test_echoes_of_any_unit_give_the_same_motion(unit: float) -> None:
    grid = RegularGrid((RF.shape[2], RF.shape[1]), (DX, DY))
    points = grid_over((3, 11, 2, 9), 1.0).nodes
    echoes = [Echo.from_rf(frame, grid, CARRIER) for frame in RF]
    right = track(echoes, points, FlowTracker(), times=np.arange(3.0))
    iq = np.stack([echo.iq for echo in echoes]).astype(np.complex64) * np.float32(unit)
    found = track(EchoCine(iq, np.arange(3.0), grid, CARRIER), points, FlowTracker())
    np.testing.assert_allclose(found.displacement, right.displacement, atol=1e-4)
    np.testing.assert_allclose(found.confidence, right.confidence, atol=1e-3)
    assert (found.confidence[-1] > 0.3).mean() > 0.9


# --- memory


class Counted:
    """Frames made on demand; knows how many of them are alive."""

    times = 0.1 * np.arange(24)

    def __init__(self) -> None:
        self.alive: weakref.WeakSet[UltrasoundImage] = weakref.WeakSet()
        self.most = 0
        grey = gaussian_filter(np.random.default_rng(0).normal(size=(80, 80)), 1.5)
        self.grey = (grey - grey.min()) / np.ptp(grey) * 255

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[UltrasoundImage]:
        grid = RegularGrid((80, 80), (0.1, 0.1))
        for k in range(len(self)):
            pixels = shift(self.grey, (0.5 * k, 0), mode="wrap").astype(np.uint8)
            image = Weak(pixels, grid)
            self.alive.add(image)
            self.most = max(self.most, len(self.alive))
            yield image
            del image


class Weak(UltrasoundImage):
    __hash__ = object.__hash__
    __eq__ = object.__eq__


@pytest.mark.parametrize("reference", ["keyframe", "first", "previous"])
def test_tracking_holds_a_few_frames_whatever_the_length(reference) -> None:
    frames = Counted()
    found = track(frames, grid_over((1, 7, 1, 7), 1.0).nodes, FlowTracker(check=None), reference=reference)
    assert len(found.times) == 24
    assert frames.most <= 4


def test_a_stream_gives_what_the_whole_cine_gives() -> None:
    frames = Counted()
    points = grid_over((1, 7, 1, 7), 1.0).nodes
    kept = [UltrasoundImage(f.pixels, f.grid) for f in frames]
    a = track(frames, points, FlowTracker(check=None))
    b = track(kept, points, FlowTracker(check=None), times=frames.times)
    np.testing.assert_array_equal(a.displacement, b.displacement)
    assert a.keyframes == b.keyframes
    assert len(a.keyframes) > 1


def test_a_cine_that_ends_early_is_said() -> None:
    class Short(Counted):
        def __iter__(self) -> Iterator[UltrasoundImage]:
            return iter(list(super().__iter__())[:5])

    with pytest.raises(InputError, match="ends after 5 of 24"):
        track(Short(), grid_over((1, 7, 1, 7), 1.0).nodes, FlowTracker(check=None))


def test_track_says_what_it_needs_and_refuses_what_is_too_much(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mp4")
    result = run(path, "--spacing", "0.1,0.1", "--out", tmp_path / "t.npz")
    assert "points in 10 frames: about" in result.output
    result = run(
        path, "--spacing", "0.1,0.1", "--out", tmp_path / "t.npz", "--grid", "0.005", "--limit", "100"
    )
    assert isinstance(result.exception, InputError)
    assert "needs about" in str(result.exception)
    assert "--limit" in str(result.exception)


# --- the preview


def test_the_preview_has_no_lines_between_its_cells(tmp_path: Path) -> None:
    grid = RegularGrid((200, 160), (0.1, 0.1))
    points = grid_over(grid.extent, 0.5).nodes
    n = len(points)
    tracking_figure(
        np.zeros((160, 200), np.uint8),
        grid,
        points,
        np.full((n, 2), 0.3),
        np.full(n, 0.9),
        tmp_path / "a.png",
    )
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    # inside of the two maps one colour alone: that of confidence 0.9 and that of 0.3 mm
    for share in (0.42, 0.75):
        middle = picture[picture.shape[0] // 3 : picture.shape[0] // 2, int(share * picture.shape[1]) :][
            :, :100
        ]
        assert np.ptp(middle.reshape(-1, 3), axis=0).max() <= 2


# --- arrays of other programs


def version_5(path: Path, **arrays: object) -> Path:
    savemat(path, arrays, do_compression=True)
    return path


def test_field_ii_lines_in_matlab_5_are_tracked(tmp_path: Path) -> None:
    # newtons or volts of Field II are tiny; columns are lines, frames come last
    path = version_5(tmp_path / "a.mat", rf_data=np.moveaxis(RF, 0, -1) * 1e-22, fs=40e6, note="made here")
    report(path, *OPTIONS, "--out", tmp_path / "t.npz")
    moved_down(tmp_path / "t.npz")


def test_matlab_7_3_is_read_frame_by_frame_and_tracked(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    counts = np.moveaxis(RF / np.abs(RF).max() * 8000, 0, -1).astype(np.int16)
    path = matlab_7_3(tmp_path / "a.mat", {"fs": np.array([[40.0]])}, {"RcvData": [counts]})
    assert describe(str(path))["arrays"]["RcvData{1}"] == [600, 48, 3, "int16"]
    report(path, *OPTIONS, "--variable", "RcvData{1}", "--out", tmp_path / "t.npz")
    moved_down(tmp_path / "t.npz")
    report(path, *OPTIONS, "--variable", "RcvData", "--out", tmp_path / "t.npz")  # a cell of one


def test_complex_lines_are_baseband(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    grid = RegularGrid((RF.shape[2], RF.shape[1]), (DX, DY))
    iq = np.stack([Echo.from_rf(frame, grid, CARRIER).iq for frame in RF]).astype(np.complex128)
    new = matlab_7_3(tmp_path / "new.mat", {"IQ": np.moveaxis(iq, 0, -1)[:, :, None, :]})
    old = version_5(tmp_path / "old.mat", acq={"IQ": np.moveaxis(iq, 0, -1)})
    for path, name in ((new, "IQ"), (old, "acq.IQ")):
        report(path, *OPTIONS, "--variable", name, "--out", tmp_path / "t.npz")
        moved_down(tmp_path / "t.npz")


def test_hdf5_of_python_has_its_frames_first_unless_axes_say_otherwise(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["group/rf"] = RF
        file["other"] = np.moveaxis(RF, 1, 2)  # frame, line, depth
    report(tmp_path / "a.h5", *OPTIONS, "--variable", "group.rf", "--out", tmp_path / "t.npz")
    moved_down(tmp_path / "t.npz")
    report(
        tmp_path / "a.h5",
        *OPTIONS,
        "--variable",
        "other",
        "--axes",
        "frame,line,depth",
        "--out",
        tmp_path / "t.npz",
    )
    moved_down(tmp_path / "t.npz")


def test_channel_data_of_a_rotating_disk_turn_it(recordings: Path, tmp_path: Path) -> None:
    # PyMUST's PWI_disk: real channel data of plane waves; the disk turns by 0.0064 a frame (test_tracking)
    whole = loadmat(recordings / "pymust" / "PWI_disk.mat")
    path = version_5(tmp_path / "disk.mat", RF=whole["RF"][:, :, :4], param=whole["param"])
    report(
        path, "--rf", "5", "--variable", "RF", "--channels", "0.298",
        "--sampling", str(20 / 3), "--start", "9.95", "--sound-speed", "1.48", "--fps", "100", "--spacing", "0.1,0.05",
        "--roi=-8,15,8,30", "--grid", "1", "--out", tmp_path / "t.npz", "--limit", "4000", "--json",
    )  # fmt: skip
    found = read_track(tmp_path / "t.npz")
    points, u = found.motion.points, found.motion.displacement[3]
    r = points - [-0.8, 22.5]
    disk = np.hypot(*r.T) < 7
    turn = (r[disk, 0] * u[disk, 1] - r[disk, 1] * u[disk, 0]) / (r[disk] ** 2).sum(axis=1)
    assert np.median(turn) == pytest.approx(3 * 0.0064, rel=0.1)


@pytest.mark.parametrize(("options", "says"), [
    ((), "--rf MHZ"),
    (("--variable", "rf"), "give --rf"),
    (("--rf", "5", "--fps", "20"), "0.01925 mm apart in depth: give --spacing"),
    (("--rf", "5", "--spacing", "0.3,0.02"), "--fps"),
    (("--rf", "5", "--variable", "nothing"), "no array 'nothing'; it has rf (600 x 48 x 3 float64)"),
    (("--rf", "5", "--variable", "note"), "not numbers"),
    (("--rf", "5", "--axes", "depth,line"), "give --axes"),
    (("--rf", "5", "--axes", "depth,line,line"), "give --axes"),
    (("--rf", "-5"), "--rf takes a positive number"),
    (("--rf", "40", "--fps", "20", "--spacing", f"0.3,{DY}"), "carrier"),
])  # fmt: skip
def test_what_lines_lack_is_named_with_its_option(
    tmp_path: Path, options: tuple[str, ...], says: str
) -> None:
    path = version_5(tmp_path / "a.mat", rf=np.moveaxis(RF, 0, -1), fs=40e6, note="text")
    result = run(path, *options, "--out", tmp_path / "t.npz")
    assert isinstance(result.exception, InputError), result.output
    assert says in str(result.exception)


def test_several_arrays_are_listed(tmp_path: Path) -> None:
    path = version_5(tmp_path / "a.mat", one=RF[0], two=RF[1])
    with pytest.raises(InputError, match=r"one \(600 x 48 float64\), two .*--variable"):
        open_lines(path)
    frame = next(iter(open_lines(path, variable="two")))
    np.testing.assert_array_equal(frame, RF[1])
    with pytest.raises(InputError, match=r"save it with -v7.3, or raise the limit"):
        open_lines(path, variable="two", limit=0.2)


def test_hdf5_without_h5py_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(1000))
    monkeypatch.setitem(sys.modules, "h5py", None)
    for take in (list_arrays, open_lines):
        with pytest.raises(MissingExtraError, match=r"echospline\[matlab\]"):
            take(tmp_path / "a.h5")


def test_links_to_other_files_are_never_followed(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["rf"] = RF
    RF.tofile(tmp_path / "raw.bin")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["link"] = h5py.ExternalLink("secret.h5", "rf")
        file["soft"] = h5py.SoftLink("/link")
        file.create_dataset("outside", RF.shape, RF.dtype, external=[("raw.bin", 0, RF.nbytes)])
        layout = h5py.VirtualLayout(RF.shape, RF.dtype)
        layout[:] = h5py.VirtualSource("secret.h5", "rf", RF.shape)
        file.create_virtual_dataset("virtual", layout)
    assert list_arrays(tmp_path / "a.h5") == []
    for name in ("link", "soft", "outside", "virtual"):
        with pytest.raises(InputError, match="no array"):
            open_lines(tmp_path / "a.h5", variable=name)


def _small(kind: str, folder: Path) -> bytes:
    tiny = np.arange(24, dtype=np.float32).reshape(4, 3, 2)
    path = folder / f"small.{kind}"
    if kind == "mat":
        version_5(path, rf=tiny, acq={"a": 1.0})
    elif kind == "v73":
        matlab_7_3(path, {"rf": tiny})
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            file.create_dataset("rf", data=tiny, chunks=(2, 3, 2), compression="gzip")
    return path.read_bytes()


@pytest.mark.parametrize("kind", ["mat", "v73", "h5"])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_arrays_give_one_sentence_or_lines(tmp_path: Path, kind: str, data: st.DataObject) -> None:
    if kind != "mat":
        pytest.importorskip("h5py")
    content = bytearray(_small(kind, tmp_path))
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content))) :]
    path = tmp_path / "a.mat"
    path.write_bytes(content)
    said = ""
    try:
        assert all(frame.ndim == 2 for frame in open_lines(path, limit=16))
    except EchosplineError as error:
        said = str(error)
    assert "\n" not in said


@pytest.mark.parametrize(("lasts", "said"), [(2.0, False), (2.2, False), (4.0, True), (1.0, True)])
def test_a_truth_that_lasts_another_time_than_the_cine_is_doubted(lasts: float, said: bool) -> None:
    times = np.linspace(0.0, 2.0, 11)
    found = tracking.Track(np.zeros((1, 2)), times, np.zeros((11, 1, 2)), np.ones((11, 1)), (0,))
    motion = SimpleNamespace(times=np.linspace(5.0, 5.0 + lasts, 7))
    doubts = tracking.truth_doubts(found, SimpleNamespace(motion=motion))
    assert [f"lasts {lasts:g} s and the cine 2 s" in doubt for doubt in doubts] == [True] * said
