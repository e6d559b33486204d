"""A recorded sweep with a needle, replayed through a volume: against the run that it was made from, and a real sweep of PLUS."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from echospline import scenario as scenario_room
from echospline.cli.app import app
from echospline.errors import InputError
from echospline.io.sequence import read_sequence
from echospline.io.sequence_space import SKEWED, face_grid, paths_in_scene
from echospline.io.volume_writing import write_volume
from echospline.picture.simulate_space import SpatialFrame, simulate_space
from echospline.scenario.space_models import build_spatial_model
from echospline.scene import (
    AXIAL,
    PlanePath,
    RegularGrid,
    SpatialInsertion,
    picture_plane,
    probe_angles,
    probe_plane,
    tip_frame,
)
from space_link import PROBE, rigid, smooth_volume
from test_reconstruct import CALIBRATION

FPS = 10.0
SCENE = """
[image]
file = "volume.mha"
[space.mesh]
nodes = [7, 6, 5]
[space.probe]
width = 16.0
depth = 14.0
pixel = 0.25
elevation = 0.0
"""
FACE_AT = {"width": 16.0, "depth": 14.0, "pixel": 0.25}
REFERENCE = rigid((0.4, -0.2, 1.1), (310.0, -120.0, 55.0))  # ReferenceToTracker
FACE = rigid((-1.0, 0.3, 0.2), (4.0, -30.0, 12.0))  # from the picture's frame to the marker on the probe
NEEDLE = rigid((0.1, 0.7, -0.3), (3.0, 5.0, -140.0))  # from the tip to the marker on the needle
PLANES = PlanePath(
    np.array([0.0, 0.6, 1.5]),
    (
        probe_plane((-1.0, 0.0, -4.0), 10.0),
        probe_plane((0.0, 0.0, 0.0), 25.0, 5.0),
        probe_plane((1.0, 0.5, 2.0), 40.0, -6.0, 8.0),
    ),
)
# above the skin until 0.2 s, at rest from 1 s
INSERTION = SpatialInsertion(
    np.array([0.0, 0.2, 1.0, 1.5]),
    np.array([(-7.0, 0.0, -1.0)] * 4),
    np.array([(-7.0, 0.0, -1.0), (-7.0, 0.0, -1.0), (1.0, 9.0, 0.0), (1.0, 9.0, 0.0)]),
)


def numbers(matrix: np.ndarray) -> str:
    return " ".join(f"{v:.12g}" for v in np.asarray(matrix).ravel())


def write_config(path: Path, image_to_probe: np.ndarray) -> Path:
    path.write_text(
        "<PlusConfiguration><CoordinateDefinitions>"
        f'<Transform From="Image" To="Probe" Matrix="{numbers(image_to_probe)}"/>'
        f'<Transform From="NeedleTip" To="Needle" Matrix="{numbers(NEEDLE)}"/>'
        "</CoordinateDefinitions></PlusConfiguration>"
    )
    return path


def to_probe(pixel: float = PROBE.pixel) -> np.ndarray:
    """ImageToProbe of the small probe, by hand: column 0 lies half a picture to the left of the face's middle."""
    columns = PROBE.grid.shape[0]
    return FACE @ np.array(
        [[pixel, 0, 0, -(columns - 1) / 2 * pixel], [0, pixel, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    )


def write_recording(path: Path, frames: list[SpatialFrame], changes=None) -> Path:
    """As PLUS lays it out: everything in the tracker's frame, a status for each; ``changes`` maps (frame, tool) to a matrix or a status."""
    changes = changes or {}
    rows, columns = frames[0].image.pixels.shape
    lines = [
        "ObjectType = Image", "NDims = 3", "BinaryData = True", "BinaryDataByteOrderMSB = False",
        "CompressedData = False", f"DimSize = {columns} {rows} {len(frames)}", "ElementSpacing = 1 1 1",
        "ElementType = MET_UCHAR", "UltrasoundImageOrientation = MFA",
    ]  # fmt: skip
    there = REFERENCE @ AXIAL  # scene to tracker
    for i, frame in enumerate(frames):
        tools = {
            "Reference": REFERENCE,
            "Probe": there @ frame.plane.matrix @ np.linalg.inv(FACE),
            "Needle": there @ _needle_frame(frame) @ np.linalg.inv(NEEDLE),
        }
        for tool, true in tools.items():
            change = changes.get((i, tool), "OK")
            status, matrix = (change, true) if isinstance(change, str) else ("OK", true @ change)
            lines += [
                f"Seq_Frame{i:04d}_{tool}ToTrackerTransform = {numbers(matrix)}",
                f"Seq_Frame{i:04d}_{tool}ToTrackerTransformStatus = {status}",
            ]
        lines += [
            f"Seq_Frame{i:04d}_Timestamp = {50 + frame.time:.9g}",
            f"Seq_Frame{i:04d}_ImageStatus = OK",
        ]
    pixels = np.stack([f.image.pixels for f in frames]).tobytes()
    path.write_bytes("\n".join([*lines, "ElementDataFile = LOCAL", ""]).encode() + pixels)
    return path


def _needle_frame(frame: SpatialFrame) -> np.ndarray:
    """At the tip, +Z along the planned direction even while the needle waits above the skin."""
    matrix = tip_frame(INSERTION.pose(1.0))
    matrix[:3, 3] = frame.pose.tip
    return matrix


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    write_volume(folder / "volume.mha", smooth_volume())
    (folder / "scene.toml").write_text(SCENE)
    return folder


@pytest.fixture(scope="module")
def made(scene) -> list[SpatialFrame]:
    opened = scenario_room.open_spatial(scenario_room.load(scene / "scene.toml"), scene)
    space = opened.scenario.space
    model = build_spatial_model(opened.scenario, space.grid(opened.volume), opened.tissue)
    return list(
        simulate_space(
            opened.volume,
            space.probe.probe(),
            PLANES,
            INSERTION,
            model,
            fps=FPS,
            needle=opened.scenario.needle_echo(),
        )
    )


@pytest.fixture(scope="module")
def recording(scene, made) -> Path:
    write_config(scene / "plus.xml", to_probe())
    return write_recording(scene / "run.igs.mha", made)


def replay(recording: Path, out: Path, *words: str, volume: str = "scene.toml", config: str = "plus.xml"):
    command = ["recorded", recording, "--volume", recording.parent / volume, "--out", out]
    if config:
        command += ["--config", recording.parent / config]
    return CliRunner().invoke(app, [str(word) for word in [*command, *words]])


def table(out: Path) -> dict[str, np.ndarray]:
    with (out / "comparison.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


# ---- there and back


@pytest.fixture(scope="module")
def replayed(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("replayed") / "out"
    result = replay(recording, out, "--no-figure", "--formats", "mha", "--json")
    assert result.exit_code == 0, result.output
    return out, json.loads(result.stdout)


def test_a_run_tracked_and_replayed_gives_its_own_pictures(replayed, made):
    """The same probe, needle and tissue through tracker, calibrations and file: each picture comes back to a grey level."""
    out, told = replayed
    pictures = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(out / "cine.mha")))
    assert told["frames"] == len(pictures) == len(made) == 16
    worst = max(
        np.abs(a.astype(int) - f.image.pixels.astype(int)).max() for a, f in zip(pictures, made, strict=True)
    )
    assert worst <= 1
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 30  # and there was something to see


def test_probe_and_needle_are_written_where_they_were(replayed, made):
    out, told = replayed
    with np.load(out / "displacement.npz") as record:
        np.testing.assert_allclose(record["plane"], [f.plane.matrix for f in made], atol=1e-6)
        np.testing.assert_allclose(record["tip"], [f.pose.tip for f in made], atol=1e-6)
        np.testing.assert_allclose(record["entry"], [f.pose.entry for f in made], atol=1e-6)
        np.testing.assert_allclose(record["displacement"], [f.displacement for f in made], atol=1e-4)
        assert np.abs(record["displacement"]).max() > 0.3
    seen = table(out)
    np.testing.assert_allclose(seen["time_s"], [f.time for f in made], atol=1e-6)
    np.testing.assert_allclose(seen["depth_mm"], [f.pose.depth for f in made], atol=1e-6)
    away = [f.pose.seen_from(f.plane)[1][2] for f in made]
    np.testing.assert_allclose(seen["tip_from_plane_mm"], away, atol=1e-6)
    assert seen["correlation_simulated"].min() > 0.9999
    assert seen["correlation_still"][-1] < 0.9
    assert told["deepest_mm"] == pytest.approx(INSERTION.pose(1.0).depth)


def test_the_resolved_scenario_is_the_procedure_itself(replayed, tmp_path):
    """`simulate` of the scenario that a replay leaves gives the same motion, without the recording."""
    out, _ = replayed
    result = CliRunner().invoke(
        app, ["simulate", str(out / "scenario.toml"), "--no-figure", "--out", str(tmp_path / "again")]
    )
    assert result.exit_code == 0, result.output
    with (
        np.load(out / "displacement.npz") as first,
        np.load(tmp_path / "again" / "displacement.npz") as again,
    ):
        np.testing.assert_allclose(first["displacement"], again["displacement"], atol=1e-6)
        np.testing.assert_allclose(first["plane"], again["plane"], atol=1e-9)


def test_without_a_probe_the_picture_is_the_recordings(recording, tmp_path):
    (recording.parent / "bare.toml").write_text(
        '[image]\nfile = "volume.mha"\n[space.mesh]\nnodes = [7, 6, 5]\n[space.probe]\nelevation = 0.0\n'
    )
    result = replay(recording, tmp_path / "out", "--no-figure", volume="bare.toml")
    assert result.exit_code == 0, result.output
    probe = scenario_room.load(tmp_path / "out" / "scenario.toml").space.probe
    assert {name: getattr(probe, name) for name in FACE_AT} == pytest.approx(FACE_AT)
    assert table(tmp_path / "out")["correlation_simulated"].min() > 0.9999


@pytest.mark.parametrize("tool", ["Probe", "Needle"])
def test_pictures_in_which_a_tool_is_lost_are_bridged_and_said(made, scene, tmp_path, tool):
    write_config(scene / "plus.xml", to_probe())
    lost = {(4, tool): "INVALID", (5, tool): np.diag([0.0, 0.0, 0.0, 1.0]), (6, tool): "MISSING"}
    path = write_recording(scene / f"lost{tool}.igs.mha", made, lost)
    result = replay(path, tmp_path / "out", "--no-figure")
    assert result.exit_code == 0, result.output
    assert f"the {tool.lower()} is bridged in 3 of 16 pictures" in result.stderr
    with np.load(tmp_path / "out" / "displacement.npz") as record:
        tips, planes = record["tip"], record["plane"]
    # both go straight between picture 3 and 7, so that bridging them loses nothing of the needle and little of the probe
    np.testing.assert_allclose(tips, [f.pose.tip for f in made], atol=1e-6)
    expected = np.array([f.plane.matrix for f in made])
    if tool == "Probe":
        expected[4:7] = [PlanePath([3, 7], [made[3].plane, made[7].plane]).at(i).matrix for i in (4, 5, 6)]
    np.testing.assert_allclose(planes, expected, atol=1e-6)


def test_a_recording_that_begins_with_the_needle_inside_is_said_and_ends_as_the_whole_one(
    made, scene, tmp_path
):
    write_config(scene / "plus.xml", to_probe())
    path = write_recording(scene / "late.igs.mha", made[8:])
    result = replay(path, tmp_path / "out", "--no-figure")
    assert result.exit_code == 0, result.output
    assert f"the needle is {made[8].pose.depth:.1f} mm deep when the recording begins" in result.stderr
    with np.load(tmp_path / "out" / "displacement.npz") as record:
        assert not record["displacement"][0].any()
        last = record["displacement"][-1]
    whole = made[-1].displacement
    assert np.linalg.norm(last - whole) < 0.05 * np.linalg.norm(whole)


def test_a_file_with_numbers_that_are_none_is_refused(made, tmp_path):
    path = write_recording(tmp_path / "nan.igs.mha", made[:3], {(1, "Probe"): np.full((4, 4), np.nan)})
    with pytest.raises(InputError, match="Seq_Frame0001_ProbeToTrackerTransform must be 16 finite numbers"):
        read_sequence(path)


# ---- the calibration


@given(
    st.floats(0.05, 0.5), st.floats(0.05, 0.5), st.floats(-0.9 * SKEWED, 0.9 * SKEWED),
    st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-100, 100)] * 3),
    st.tuples(st.floats(0, 99), st.floats(0, 79)),
)  # fmt: skip
def test_every_pixel_of_a_skewed_calibration_keeps_its_place(dx, dy, skew, turn, shift, face):
    y = np.array([skew, np.sqrt(1 - skew**2), 0.0])
    matrix = rigid(turn, shift)
    matrix[:3, :2] = matrix[:3, :3] @ np.column_stack((np.array([dx, 0, 0]), dy * y))
    grid = RegularGrid((100, 80), (dx, dy), (-face[0] * dx, -face[1] * dy))
    plane = picture_plane(matrix, grid, SKEWED)
    step = plane.matrix[:3, :2].T @ matrix[:3, :2]
    index = np.array([(0.0, 0.0), (99.0, 0.0), (0.0, 79.0), (99.0, 79.0), face])
    expected = index @ matrix[:3, :2].T + matrix[:3, 3]
    np.testing.assert_allclose(plane.lift((index - face) @ step.T), expected, atol=1e-6)
    # no axis is preferred: both turn by half of the skew
    x, down = step[:, 0] / dx, step[:, 1] / dy
    assert x[0] == pytest.approx(down[1], abs=1e-9)


@given(st.floats(-180, 180), st.floats(-90, 90), st.floats(-180, 180))
def test_the_angles_of_a_plane_turn_a_probe_to_it(yaw, pitch, roll):
    plane = probe_plane((1.0, 2.0, 3.0), yaw, pitch, roll)
    again = probe_plane((1.0, 2.0, 3.0), *probe_angles(plane))
    np.testing.assert_allclose(again.matrix, plane.matrix, atol=1e-6)


@pytest.mark.parametrize(
    ("depth", "down"), [("z", True), ("-z", False)], ids=["beam into the skin", "beam out of it"]
)
def test_the_spine_sweep_sees_in_plus_volume_what_it_saw(recordings, tmp_path, depth, down):
    """Pictures of a real tracker against the volume that PLUS made of them; the sides of the volume are turned, so that only the place can be right."""
    spine = recordings / "pluslib"
    config = tmp_path / "plus.xml"
    config.write_text(
        "<PlusConfiguration><CoordinateDefinitions>"
        f'<Transform From="Image" To="Probe" Matrix="{CALIBRATION}"/>'
        "</CoordinateDefinitions></PlusConfiguration>"
    )
    words = [
        "recorded", spine / "SpinePhantomFreehand.igs.mha", "--volume", spine / "SpinePhantomFreehandReconstructed.mha",
        "--config", config, "--place", "file", f"--depth-axis={depth}", "--no-figure", "--json", "--out", tmp_path / "out",
    ]  # fmt: skip
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["frames"] == told["frames_compared"] == 21
    assert told["median_correlation_simulated"] > 0.97
    assert told["median_correlation_simulated"] > told["median_correlation_still"] + 0.04
    assert "has no needle, tissue stays at rest" in result.stderr
    assert ("points out of the skin" in result.stderr) is not down


# ---- what makes no sense


@pytest.mark.parametrize(
    ("matrix", "sentence"),
    [
        (np.diag([25.4, 25.4, 25.4, 1.0]), "expected axes of length 1; got 25.4"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "expected a right-handed rotation; got a mirrored one"),
        (np.array([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "expected perpendicular axes"),
    ],
)
@pytest.mark.parametrize("tool", ["Probe", "Needle", "Reference"])
def test_a_transform_that_no_tool_can_have_is_refused_with_its_picture(
    made, scene, tmp_path, tool, matrix, sentence
):
    write_config(scene / "plus.xml", to_probe())
    path = write_recording(tmp_path / "bad.igs.mha", made[:4], {(2, tool): matrix})
    result = CliRunner().invoke(
        app,
        ["recorded", str(path), "--volume", str(scene / "scene.toml"), "--config", str(scene / "plus.xml"), "--out", str(tmp_path / "out")],
    )  # fmt: skip
    assert isinstance(result.exception, InputError)
    said = str(result.exception)
    assert sentence in said
    assert said.startswith(f"bad.igs.mha, picture 2, {tool}ToTracker: ")
    assert "\n" not in said
    assert not (tmp_path / "out").exists()


def test_a_calibration_with_more_skew_than_a_fit_leaves_is_refused(recording, tmp_path):
    skewed = to_probe()
    skewed[:3, 1] += 0.12 * skewed[:3, 0]
    write_config(recording.parent / "skewed.xml", skewed)
    result = replay(recording, tmp_path / "out", config="skewed.xml")
    assert "perpendicular columns and rows, within 5.7 degrees; got 6.8 degrees" in str(result.exception)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--fps", "5"], "output.fps has no meaning here, because the recording moves probe and needle"),
        (["--view", "transverse"], "space.probe.view has no meaning here"),
        (["--needle-depth", "9"], "has no meaning here"),
        (["--face", "999,0"], "is a pixel COLUMN,ROW of the picture, 65 x 57; got 999,0"),
        (["--face", "left"], "--face expects two numbers A,B; got 'left'"),
        (["--place", "moon"], "--place is one of axial, file, lps; got 'moon'"),
        (["--reference", "Patient"], "a chain of transforms must lead from Image to Patient"),
    ],
)  # fmt: skip
def test_what_a_replay_cannot_use_gets_one_sentence(recording, tmp_path, words, sentence):
    result = replay(recording, tmp_path / "out", *words)
    assert isinstance(result.exception, InputError), result.output
    assert sentence in str(result.exception)
    assert "\n" not in str(result.exception)


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (["--volume", "sample:calf", "--config", "plus.xml"], "sample:calf is a picture"),
        (["--volume", "scene.toml"], "has no spacing"),
        (["--volume", "scene.toml", "--spacing", "0.25,0.25"], "has the place of its picture in 0 of 16 good pictures"),
        (["--place", "file"], "--place, --face and --reference belong to a volume"),
        (["--face", "3,0"], "--place, --face and --reference belong to a volume"),
    ],
)  # fmt: skip
def test_a_recording_that_leads_to_no_volume_is_explained(
    recording, tmp_path, monkeypatch, command, sentence
):
    monkeypatch.chdir(recording.parent)
    result = CliRunner().invoke(app, ["recorded", recording.name, *command, "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, InputError), result.output
    assert sentence in str(result.exception)


def test_a_volume_that_the_probe_never_saw_has_nothing_to_compare(made, scene, tmp_path):
    """The sweep is 300 mm away: black pictures, said as a doubt and without a number for likeness."""
    write_config(scene / "plus.xml", to_probe())
    far = {(i, "Reference"): rigid((0, 0, 0), (300.0, 0.0, 0.0)) for i in range(4)}
    path = write_recording(scene / "far.igs.mha", made[:4], far)
    result = replay(path, tmp_path / "out", "--no-figure", "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["frames_compared"] == 0
    assert told["median_correlation_simulated"] is None
    assert "100 % of the picture lies outside the volume" in result.stderr
    assert np.isnan(table(tmp_path / "out")["correlation_simulated"]).all()


def test_times_that_do_not_ascend_are_refused(made, tmp_path):
    path = write_recording(tmp_path / "r.igs.mha", made[:3])
    path.write_bytes(
        path.read_bytes().replace(b"Seq_Frame0002_Timestamp = 50.2", b"Seq_Frame0002_Timestamp = 50.1")
    )
    sequence = read_sequence(path)
    calibration = {"ImageToProbe": to_probe(), "NeedleTipToNeedle": NEEDLE}
    grid = face_grid(sequence, calibration=calibration)
    with pytest.raises(InputError, match="times that do not ascend"):
        paths_in_scene(
            sequence,
            grid,
            AXIAL,
            (np.array([-15.0, 0, -10]), np.array([15.0, 24, 10])),
            calibration=calibration,
        )
