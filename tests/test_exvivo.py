"""Files and commands of the laboratory: phantom to track to field, needle paths, regions."""

import json
import zipfile

import numpy as np
import pytest
import SimpleITK
from scipy import stats
from scipy.interpolate import RegularGridInterpolator
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.cli.track import load
from echospline.errors import InputError
from echospline.io import EchoWriter, open_writer, read, read_displacement, read_echoes, read_needle
from echospline.scene import Echo, NeedlePose, RegularGrid
from echospline.study.exvivo import paired
from echospline.tracking import Track, grid_over, inside_ahead, read_track, region_ahead, write_track

SCENARIO = """
[model]
kind = "fem"
[model.forces]
tip = 0.2
ramp = 0.0
[needle]
entry = [8.0, 0.0]
angle = 70.0
depth = 12.0
speed = 6.0
dwell = 0.0
retract = false
[output]
fps = 3.0
formats = ["mha"]
figure = false
needle = false
[mesh]
nodes = [25, 25]
[probe]
snr = 25.0
attenuation = 0.0
[phantom]
size = [20.0, 20.0]
"""


def run(*arguments):
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def cine(tmp_path_factory):
    """A phantom's folder, made by the command."""
    folder = tmp_path_factory.mktemp("phantom")
    (folder / "scene.toml").write_text(SCENARIO)
    report = json.loads(run("phantom", folder / "scene.toml", "--out", folder / "out", "--rf", "--json"))
    assert report["frames"] == 7
    return folder / "out"


def truth_at(folder, points, frame):
    record = read_displacement(folder / "displacement.npz")
    grid = record.grid()
    field = record.displacement[frame].reshape(*grid.shape[::-1], 2)
    return RegularGridInterpolator((grid.y, grid.x), field)(points[:, ::-1])


@pytest.mark.parametrize(
    ("arguments", "limit"),
    [
        (("echoes.npz",), 0.015),
        (("cine.mha",), 0.02),
        (("rf.mha", "--rf", "5.0"), 0.015),
        (("cine.mha", "--method", "block", "--grid", "1.5"), 0.04),
    ],
)
@pytest.mark.parametrize("suffix", ["npz", "mha"])
def test_tracked_phantom_moves_as_its_truth(cine, tmp_path, arguments, limit, suffix):
    if suffix == "mha" and "block" in arguments:
        suffix = "npz"  # points near the border are lost to it, nothing about files differs
    out = tmp_path / f"field.{suffix}"
    name, *rest = arguments
    run("track", cine / name, *rest, "--out", out, "--needle", cine / "displacement.npz", "--json")
    found = read_track(out)
    m, last = found.motion, len(found.motion) - 1
    inside = (m.points > 2.0).all(axis=1) & (m.points < 18.0).all(axis=1)
    far = inside & (m.pose(last).closest(m.points)[1] > 2.0) & (found.confidence[last] > 0.3)
    assert far.sum() > 0.4 * inside.sum()
    error = m.displacement[last][far] - truth_at(cine, m.points[far], last)
    assert np.sqrt((error**2).mean()) < limit
    assert np.abs(truth_at(cine, m.points[far], last)).max() > 0.1  # there was something to track
    near = m.pose(last).closest(m.points)[1] < 0.8
    assert (found.confidence[last][near] == 0).all()
    assert out.with_suffix(".png").stat().st_size > 10_000


def test_region_ahead_of_the_tip_travels(cine, tmp_path):
    out = tmp_path / "ahead.npz"
    run(
        "track",
        cine / "echoes.npz",
        "--out",
        out,
        "--needle",
        cine / "displacement.npz",
        "--ahead",
        "4",
        "--json",
    )
    found = read_track(out)
    for k in range(2, 7):
        used = found.confidence[k] > 0
        assert used.any()
        assert inside_ahead(found.motion.points[used], found.motion.pose(k), 4.0).all()
    assert (found.confidence[2] > 0).tolist() != (found.confidence[6] > 0).tolist()


def test_phantom_repeats_exactly_and_its_cine_is_its_echoes(cine, tmp_path):
    report = json.loads(run("phantom", cine / "scenario.toml", "--out", tmp_path / "again", "--json"))
    again, first = read_echoes(tmp_path / "again" / "echoes.npz"), read_echoes(cine / "echoes.npz")
    assert np.array_equal(again.iq, first.iq)
    assert report["phantom"]["speckle"]["envelope_snr"] == pytest.approx(1.913, rel=0.1)
    pictures = read(cine / "cine.mha")
    for k in (0, 6):
        shown = first[k].b_mode(grid=RegularGrid((200, 200), (0.1, 0.1))).pixels
        assert np.array_equal(pictures.frames[k], shown)


def test_rf_file_is_readable_by_itk_and_demodulates_to_the_echoes(cine):
    image = SimpleITK.ReadImage(str(cine / "rf.mha"))
    assert image.GetSpacing()[:2] == pytest.approx((0.1, 1.54 / 2 / 40))
    frames = load(str(cine / "rf.mha"), rf=5.0)
    echoes = read_echoes(cine / "echoes.npz")
    a = frames[3].envelope()[100:-100]
    b = np.stack(
        [np.interp(frames.grid.y[100:-100], echoes.grid.y, column) for column in echoes[3].envelope().T],
        axis=1,
    )
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.99


@pytest.mark.parametrize("suffix", ["npz", "mha"])
def test_identification_from_the_tracked_cine_finds_the_forces(cine, tmp_path, suffix):
    # the phantom was driven by 0.2 N and 1e-3 N s/mm^2; the region around the needle is masked
    out = tmp_path / f"field.{suffix}"
    run("track", cine / "echoes.npz", "--out", out, "--needle", cine / "displacement.npz", "--json")
    report = json.loads(
        run(
            "identify", out, "--scenario", cine / "scenario.toml", "--model", "fem", "--out", tmp_path / "id",
            "--objective", "rmse", "--bootstrap", "0", "--json",
        )
    )["reports"]["field"]  # fmt: skip
    assert report["values"]["tip"] == pytest.approx(0.2, rel=0.1)
    assert report["values"]["friction"] == pytest.approx(1e-3, rel=0.25)
    assert report["rmse_mm"] < 0.03


@pytest.fixture(scope="module")
def protocol(tmp_path_factory):
    """The paper's experiment on a small phantom, by the command."""
    folder = tmp_path_factory.mktemp("exvivo")
    scene = SCENARIO.replace('formats = ["mha"]', "formats = []")
    (folder / "scene.toml").write_text(scene)
    result = json.loads(
        run("study", "exvivo", "--scenario", folder / "scene.toml", "--out", folder / "out", "--depths", "3",
            "--distance", "3.5", "--json")
    )  # fmt: skip
    return folder, result


def test_protocol_tells_the_tracker_from_the_models(protocol):
    folder, result = protocol
    means = result["means"]
    assert means["tracker_rmse_mm"] < 0.02
    # the phantom is driven by finite elements: they must explain it best, seen or unseen
    assert means["fem_rmse_mm"] < min(means["tps_rmse_mm"], means["elastic_rmse_mm"])
    assert means["fem_held_out_true_mm"] < min(
        means["tps_held_out_true_mm"], means["elastic_held_out_true_mm"]
    )
    wide = result["fitted to the whole field"]["means"]
    assert wide["fem_held_out_field_mm"] < 0.03
    page = (folder / "out" / "report.html").read_text()
    assert page.count("data:image/png") == 3
    assert "http" not in page.replace("http-equiv", "")


def test_protocol_runs_on_a_recording_with_its_needle(protocol, tmp_path):
    folder, first = protocol
    phantom = folder / "out" / "phantom"
    result = json.loads(
        run("study", "exvivo", "--cine", phantom / "echoes.npz", "--needle", phantom / "displacement.npz", "--scenario",
            folder / "scene.toml", "--out", tmp_path, "--depths", "3", "--distance", "3.5", "--json")
    )  # fmt: skip
    assert "tracker_rmse_mm" not in result["rows"][0]  # the truth is not known to it
    for mine, known in zip(result["rows"], first["rows"], strict=True):
        assert mine["fem_rmse_mm"] == pytest.approx(known["fem_rmse_mm"], rel=1e-6)


def test_study_without_a_subcommand_is_still_the_study():
    text = CliRunner().invoke(app, ["study", "--help"], env={"COLUMNS": "120"}).output
    assert "--quick" in text
    assert "exvivo" in text


def test_paired_test_against_its_definition():
    rng = np.random.default_rng(0)
    b = rng.random(12)
    a = b + 0.05 + 0.02 * rng.normal(size=12)
    d = a - b
    found = paired(a, b)
    t = d.mean() / (d.std(ddof=1) / np.sqrt(12))
    assert found["p_t"] == pytest.approx(2 * stats.t.sf(abs(t), 11))
    low, high = found["interval_95_mm"]
    assert low < d.mean() < high
    assert (high - low) / 2 == pytest.approx(2.201 * d.std(ddof=1) / np.sqrt(12), rel=1e-3)
    assert paired(b, b)["p_t"] is None  # no difference at all: there is nothing to test


@pytest.mark.parametrize("suffix", ["npz", "mha"])
def test_track_survives_its_file(tmp_path, suffix):
    rng = np.random.default_rng(1)
    grid = RegularGrid((7, 5), (0.5, 0.25), (1.0, 2.0))
    wanted = Track(grid.nodes, np.array([0.0, 0.1, 0.3]), rng.normal(size=(3, 35, 2)), rng.random((3, 35)))
    poses = [NeedlePose((1.0, 0.0), (1.0 + k, 2.0 * k), 3.0) for k in range(3)]
    write_track(tmp_path / f"t.{suffix}", wanted, poses)
    got = read_track(tmp_path / f"t.{suffix}")
    for name in ("points", "times", "displacement"):
        assert np.allclose(getattr(got.motion, name), getattr(wanted, name), atol=1e-6)
    assert np.allclose(got.confidence, wanted.confidence, atol=1e-6)
    assert got.motion.pose(2) == poses[2]


def test_simulated_motion_is_read_with_full_confidence(cine):
    found = read_track(cine / "displacement.npz")
    assert (found.confidence == 1).all()
    assert len(found.motion) == 7


def test_needle_path_from_csv(tmp_path):
    path = tmp_path / "needle.csv"
    path.write_text("time_s,entry_x_mm,entry_y_mm,tip_x_mm,tip_y_mm\n0,1,0,1,0\n2,1,0,1,10\n")
    pose = read_needle(path).pose(1.0)
    assert pose.tip == pytest.approx((1.0, 5.0))
    assert pose.speed == pytest.approx(5.0)


def test_paper_region_has_200_points_in_two_by_three_millimetres():
    pose = NeedlePose((10.0, 40.0), (10.0, 30.0))  # upwards, towards the probe, as in the paper
    points = region_ahead(pose)
    assert len(points) == 200
    assert np.ptp(points, axis=0) == pytest.approx([2.0, 3.0])
    assert points.mean(axis=0) == pytest.approx([10.0, 26.0])
    assert inside_ahead(points, pose).all()


def test_grid_over_stays_inside():
    grid = grid_over((0.0, 10.2, 0.0, 5.1), 0.5)
    assert grid.shape == (21, 11)
    assert grid.extent == pytest.approx((0.1, 10.1, 0.05, 5.05))


def _broken(tmp_path, text):
    path = tmp_path / "x.csv"
    path.write_text(text)
    return path


def _cut(tmp_path):
    path = tmp_path / "e.npz"
    grid = RegularGrid((4, 6), (0.1, 0.05))
    with EchoWriter(path, 2, grid, 6.5) as writer:
        for k in range(2):
            writer.add(Echo(np.ones((6, 4), np.complex64), grid, 6.5), float(k))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return path


def _huge(tmp_path):
    path = tmp_path / "h.npz"
    with zipfile.ZipFile(path, "w") as archive, archive.open("iq.npy", "w") as member:
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<c8", "fortran_order": False, "shape": (10**6, 10**6, 10**3)}
        )
    with zipfile.ZipFile(path, "a") as archive:
        for name in ("times", "spacing", "origin", "carrier"):
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, np.zeros(2))
    return path


def _single(tmp_path):
    with open_writer(tmp_path / "one.mha", RegularGrid((40, 40), (0.1, 0.1)), 1.0) as writer:
        writer.add(np.zeros((40, 40), np.uint8), 0.0)
    return tmp_path / "one.mha"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda t: read_needle(_broken(t, "a,b\n1,2\n")), "first line must be time_s"),
        (lambda t: read_needle(_broken(t, "time_s,entry_x_mm,entry_y_mm,tip_x_mm,tip_y_mm\n0,1,0,x,0\n")), "five numbers"),
        (lambda t: read_echoes(_cut(t)), "damaged or cut short"),
        (lambda t: read_echoes(_huge(t)), "but holds 0 bytes"),
        (lambda t: load(str(_single(t))), "two frames or more"),
        (lambda t: grid_over((0, 10, 0, 10), 0.5, (5, 5, 20, 20)), "inside of"),
        (lambda t: grid_over((0, 10, 0, 10), 1e-5), "2 x 2 to 4 million"),
        (lambda t: region_ahead(NeedlePose((0, 0), (0, 0))), "in the tissue"),
        (
            lambda t: write_track(
                t / "a.mha", Track(np.array([[0.0, 0], [1, 2], [5, 1]]), np.arange(2.0), np.zeros((2, 3, 2)), np.ones((2, 3)))
            ),
            "regular grid",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_refused_with_a_reason(tmp_path, make, words):
    with pytest.raises(InputError, match=words):
        make(tmp_path)


def test_half_written_echoes_never_carry_the_final_name(tmp_path):
    grid = RegularGrid((4, 6), (0.1, 0.05))
    with (
        pytest.raises(InputError, match="1 of 2 frames"),
        EchoWriter(tmp_path / "e.npz", 2, grid, 6.5) as writer,
    ):
        writer.add(Echo(np.ones((6, 4), np.complex64), grid, 6.5), 0.0)
    assert not (tmp_path / "e.npz").exists()
    assert list(tmp_path.glob("e.npz.*.part"))
