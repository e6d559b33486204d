"""Probe and needle of a tracker in a volume: the chain of transforms, its faults, and the way through sockets and other libraries."""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import SimpleITK
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.errors import InputError
from echospline.io.volume_place import LPS_TO_RAS, scene_to_file
from echospline.io.volume_reading import read_volume
from echospline.io.volume_writing import write_volume
from echospline.openigtlink import (
    Looks,
    Message,
    Naming,
    Rates,
    Session,
    SessionOptions,
    SpatialStage,
    Status,
    String,
    Transform,
    read_calibration,
)
from echospline.openigtlink.image import Image
from echospline.openigtlink.tools import Tool, TrackingData
from echospline.openigtlink.tracking_space import SpatialTracking
from echospline.scene import (
    AXIAL,
    ImagingPlane,
    Probe,
    SpatialInsertion,
    SpatialPose,
    Volume,
    picture_plane,
    probe_plane,
    tip_frame,
)
from space_link import HOME, PROBE, expected_picture, make_engine, make_stage, rigid, smooth_volume
from test_openigtlink_peers import free_port, lines, peer, run, start
from test_openigtlink_session import Console
from test_openigtlink_session import make_stage as make_flat_stage

__all__ = ["peer"]  # a fixture
angle = st.floats(-3, 3)
length = st.floats(-100, 100)
away = st.floats(10, 100)  # mm; nearer than 3 mm to the tracker metres are suspected
motion = st.builds(rigid, st.tuples(angle, angle, angle), st.tuples(away, length, length))
PIXELS = PROBE.grid
PICTURE = ImagingPlane(np.eye(4)).image_matrix(PIXELS)  # pixel to the picture's frame
PLANE = probe_plane((1.0, 1.0, -1.0), 25.0, 8.0, -4.0)
DEEP = SpatialPose((-5.0, 0.0, -1.0), (2.0, 8.0, 0.5))
QUICK = SessionOptions(port=0, looks=Looks(), rates=Rates(image=100, mesh=0, status=50), silence=3600)


def seen(message: Message) -> np.ndarray:
    """Places in the scene of every pixel of an IMAGE by its own matrix, shape (rows, columns, 3): RAS to scene by AXIAL."""
    assert isinstance(message.content, Image)
    rows, columns = message.content.voxels.shape[1:3]
    r, c = np.mgrid[:rows, :columns]
    places = np.stack([c, r, np.zeros_like(c), np.ones_like(c)], axis=-1) @ message.content.matrix.T
    return (places @ np.linalg.inv(AXIAL).T)[..., :3]


def shows_volume(message: Message) -> bool:
    """Whether each pixel has the brightness that the volume has where IMAGE's matrix puts it."""
    if not isinstance(message.content, Image):
        return False
    expected = smooth_volume().sample(seen(message).reshape(-1, 3)).reshape(PIXELS.shape[::-1])
    inside = expected > 0
    return bool(np.abs(message.content.voxels[0] - expected)[inside].max() < 2.5)


def at(plane: ImagingPlane):
    def wanted(message: Message) -> bool:
        if not isinstance(message.content, Image):
            return False
        return bool(np.abs(message.content.matrix - AXIAL @ plane.image_matrix(PIXELS)).max() < 1e-3)

    return wanted


def said(*words: str, error: str | None = None, code: int | None = None):
    def wanted(message: Message) -> bool:
        content = message.content
        return (
            isinstance(content, Status)
            and all(word in content.text for word in words)
            and error in (None, content.error)
            and code in (None, content.code)
        )

    return wanted


def probe_message(plane: ImagingPlane, **more) -> Message:
    return Message(Transform(AXIAL @ plane.matrix), "ProbeToReference", time.time(), **more)


def needle_message(pose: SpatialPose, name: str = "NeedleTipToReference", **more) -> Message:
    return Message(Transform(AXIAL @ tip_frame(pose)), name, time.time(), **more)


# ---- the chain of transforms


@given(motion, motion, motion, motion)
def test_the_plane_is_the_product_of_calibration_tracker_and_place(probe, reference, offset, place):
    """ImageToScene = SceneToReference^-1 ReferenceToTracker^-1 ProbeToTracker ImageToProbe, written out here by hand."""
    calibration = {"ImageToProbe": offset @ PICTURE, "NeedleTipToNeedle": rigid((0, 0, 0), (0, 0, 120))}
    tracking = SpatialTracking(PIXELS, place, Naming(calibration=calibration))
    tracking.put("ProbeToTracker", probe)
    tracking.put("NeedleToTracker", offset)
    assert tracking.locate().plane is None  # no reference yet
    tracking.put("ReferenceToTracker", reference)
    located = tracking.locate()
    to_scene = np.linalg.inv(place) @ np.linalg.inv(reference)
    np.testing.assert_allclose(located.plane.matrix, to_scene @ probe @ offset, atol=1e-7)
    tip = to_scene @ offset @ calibration["NeedleTipToNeedle"]
    np.testing.assert_allclose(located.needle.tip, tip[:3, 3], atol=1e-7)
    np.testing.assert_allclose(located.needle.direction, tip[:3, 2], atol=1e-7)
    assert (located.fault, located.held) == ("", False)


def test_without_a_calibration_the_probes_frame_is_the_pictures():
    tracking = SpatialTracking(PIXELS, AXIAL, Naming())
    tracking.put("ProbeToReference", AXIAL @ PLANE.matrix)
    np.testing.assert_allclose(tracking.locate().plane.matrix, PLANE.matrix, atol=1e-9)


def test_a_calibration_in_steps_is_not_passed_by():
    steps = {
        "ImageToTransducerOrigin": rigid((0, 0, 0), (0, 4, 0)) @ PICTURE,
        "TransducerOriginToProbe": rigid((0, 0, 0.5), (0, 0, 30)),
    }
    tracking = SpatialTracking(PIXELS, np.eye(4), Naming(calibration=steps))
    tracking.put("ProbeToReference", np.eye(4))
    expected = steps["TransducerOriginToProbe"] @ rigid((0, 0, 0), (0, 4, 0))
    np.testing.assert_allclose(tracking.locate().plane.matrix, expected, atol=1e-9)


def test_a_picture_that_says_its_own_place_needs_no_probe():
    tracking = SpatialTracking(PIXELS, AXIAL, Naming())
    tracking.put("ImageToReference", AXIAL @ PLANE.image_matrix(PIXELS))
    np.testing.assert_allclose(tracking.locate().plane.matrix, PLANE.matrix, atol=1e-9)


@pytest.mark.parametrize("name", ["SceneToReference", "SceneToTracker"])
def test_a_registered_scene_goes_before_its_place(name):
    there = rigid((0.1, 0.2, 0.3), (50, 60, 70))
    tracking = SpatialTracking(PIXELS, AXIAL, Naming())
    tracking.put("ReferenceToTracker", rigid((0, 1, 0), (1, 2, 3)))
    tracking.put("ProbeToTracker", there @ PLANE.matrix)
    tracking.put(name, there)
    located = tracking.locate()
    reference = rigid((0, 1, 0), (1, 2, 3))
    if name == "SceneToTracker":
        np.testing.assert_allclose(located.plane.matrix, PLANE.matrix, atol=1e-9)
        np.testing.assert_allclose(located.scene, np.linalg.inv(reference) @ there, atol=1e-9)
    else:
        np.testing.assert_allclose(located.scene, there, atol=1e-9)
        expected = np.linalg.inv(there) @ np.linalg.inv(reference) @ there @ PLANE.matrix
        np.testing.assert_allclose(located.plane.matrix, expected, atol=1e-9)


def test_a_calibration_for_another_picture_is_refused_before_it_is_used():
    wrong = Naming(calibration={"ImageToProbe": np.diag([0.4, 0.4, 1, 1])})
    with pytest.raises(InputError, match=r"ImageToProbe: expected the picture's 0\.25 x 0\.25 mm per pixel"):
        SpatialTracking(PIXELS, AXIAL, wrong)
    skewed = PICTURE.copy()
    skewed[0, 1] = 0.05
    with pytest.raises(InputError, match="perpendicular"):
        picture_plane(skewed / np.array([1, np.hypot(0.25, 0.05) / 0.25, 1, 1]), PIXELS)
    with pytest.raises(InputError, match=r"in mm; got 1e\+200"):
        picture_plane(np.diag([1e200, 0.25, 1, 1]), PIXELS)
    with pytest.raises(InputError, match="a length"):
        picture_plane(np.zeros((4, 4)), PIXELS)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrored"),
        (np.diag([1e-3, 1e-3, 1e-3, 1.0]), "no scale"),
        (np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), "perpendicular"),
        (np.diag([0.0, 0.0, 0.0, 1.0]), "axes of length 1; got 0, 0, 0"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
@pytest.mark.parametrize("name", ["NeedleTipToNeedle", "SceneToReference"])
def test_a_calibration_that_is_not_rigid_is_refused_before_it_is_used(name, matrix, words):
    with pytest.raises(InputError, match=words) as refusal:
        SpatialTracking(PIXELS, AXIAL, Naming(calibration={name: matrix}))
    assert "\n" not in str(refusal.value)


def moved(x: float) -> np.ndarray:
    return AXIAL @ probe_plane((x, 0.0, 0.0)).matrix


@pytest.mark.parametrize("status", ["INVALID", "MISSING", "OUT_OF_VIEW", "REQ_TIMEOUT"])
def test_a_probe_that_is_not_ok_stays_while_the_needle_goes_on(status):
    tracking = SpatialTracking(PIXELS, AXIAL, Naming())
    tracking.put("ProbeToReference", moved(1.0), "OK")
    tracking.put("ProbeToReference", moved(5.0), status)
    tracking.put("NeedleTipToReference", AXIAL @ tip_frame(DEEP), "OK")
    located = tracking.locate()
    assert located.plane.matrix[0, 3] == 1.0
    assert located.needle.tip == pytest.approx(DEEP.tip)
    assert (located.fault, located.about) == ("Invalid", "ProbeToReference")
    assert (located.probe_held, located.needle_held) == (True, False)
    assert f"ProbeToReference is {status}; the probe stays where it was" in located.trouble
    tracking.put("ProbeToReference", moved(5.0), "OK")
    assert tracking.locate().plane.matrix[0, 3] == 5.0
    assert tracking.locate().fault == ""


def test_silence_is_stale_for_the_tool_that_is_silent():
    tracking = SpatialTracking(PIXELS, AXIAL, Naming())
    for t in (0.0, 0.1):
        tracking.put("ProbeToReference", moved(1.0), now=t)
        tracking.put("NeedleTipToReference", AXIAL @ tip_frame(DEEP), now=t)
    tracking.put("ProbeToReference", moved(2.0), now=0.7)
    located = tracking.locate(0.8)
    assert (located.fault, located.about) == ("Stale", "NeedleTipToReference")
    assert (located.probe_held, located.needle_held) == (False, True)
    assert located.plane.matrix[0, 3] == 2.0
    both = tracking.locate(5.0)
    assert both.trouble.endswith("the probe and the needle stay where they were")


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([25.4, 25.4, 25.4, 1.0]), "no scale"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "mirrored"),
        (np.diag([0.0, 0.0, 0.0, 1.0]), "not seen"),
        (np.full((4, 4), np.nan), "finite numbers"),
        (rigid((0, 0, 0), (2e4, 0, 0)), "farther than any tracker"),
    ],
)
def test_a_matrix_that_no_probe_can_have_is_refused(matrix, words):
    tracking = SpatialTracking(PIXELS, AXIAL, Naming())
    tracking.put("ProbeToReference", moved(1.0))
    with pytest.raises(InputError, match=words):
        tracking.put("ProbeToReference", matrix)
    located = tracking.locate()
    assert located.plane.matrix[0, 3] == 1.0
    assert located.probe_held
    assert located.fault == "Refused"


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([1e200, 0.25, 1.0, 1.0]), "the picture's place in mm; got 1e"),
        (np.full((4, 4), np.inf), "finite numbers"),
    ],
)
def test_a_place_that_no_picture_can_have_is_refused(matrix, words):
    tracking = SpatialTracking(PIXELS, AXIAL, Naming())
    tracking.put("ImageToReference", AXIAL @ PLANE.image_matrix(PIXELS))
    with pytest.raises(InputError, match=words):
        tracking.put("ImageToReference", matrix)
    assert tracking.locate().probe_held
    np.testing.assert_allclose(tracking.locate().plane.matrix, PLANE.matrix, atol=1e-9)


def test_a_needle_without_its_tip_is_explained_and_the_probe_goes_on():
    tracking = SpatialTracking(PIXELS, AXIAL, Naming())
    tracking.put("ProbeToReference", moved(3.0))
    assert tracking.locate().fault == ""  # a sweep without a needle is no fault
    tracking.put("NeedleToReference", np.eye(4))
    located = tracking.locate()
    assert "no transform leads from NeedleTip or StylusTip" in located.trouble
    assert not located.held
    assert located.plane.matrix[0, 3] == 3.0


# ---- the place of a file


@pytest.mark.parametrize("depth", ["x", "-x", "y", "-y", "z", "-z"])
@given(st.permutations([0, 1, 2]), st.lists(st.booleans(), min_size=3, max_size=3), st.floats(-0.1, 0.1))
def test_a_voxel_keeps_its_place_through_every_turn(tmp_path_factory, depth, order, flips, slant):
    """One bright voxel, placed by ITK: the motion takes it from the scene to the same point."""
    direction = np.eye(3)[:, order] * np.where(flips, -1.0, 1.0)
    if np.linalg.det(direction) < 0:
        direction[:, 0] *= -1
    direction = rigid((slant, slant / 2, -slant), (0, 0, 0))[:3, :3] @ direction
    voxels = np.zeros((5, 7, 9), np.uint8)
    voxels[3, 1, 6] = 200
    image = SimpleITK.GetImageFromArray(voxels)
    image.SetSpacing((0.5, 0.75, 2.0))
    image.SetOrigin((11.0, -22.0, 33.0))
    image.SetDirection(direction.ravel())
    path = tmp_path_factory.mktemp("place") / "v.nrrd"
    SimpleITK.WriteImage(image, str(path))
    volume = read_volume(path, depth)
    z, y, x = np.argwhere(volume.voxels == 200)[0]
    scene = np.array(volume.origin) + np.array([x, y, z]) * volume.spacing
    there = scene_to_file(path, depth, volume) @ [*scene, 1.0]
    np.testing.assert_allclose(there[:3], image.TransformIndexToPhysicalPoint((6, 1, 3)), atol=1e-6)


def test_a_file_that_cannot_say_where_it_stands_gets_a_sentence(tmp_path):
    path = write_volume(tmp_path / "v.mha", smooth_volume())
    with pytest.raises(InputError, match="does not say where it stands"):
        scene_to_file(path, "y", Volume(smooth_volume().voxels, (5.0, 0.5, 0.5)))


# ---- through sockets


@pytest.fixture
def console():
    insertion = SpatialInsertion.straight(HOME.entry, (1.0, 1.0, 0.0), 8.0, 20.0)
    with Session(make_stage(insertion=insertion), QUICK) as session:
        peer = Console(session.port)
        yield peer
        peer.close()


def test_every_pixel_of_the_image_lies_where_its_matrix_says(console):
    assert shows_volume(console.wait(lambda m: isinstance(m.content, Image)))
    for plane in (
        PLANE,
        probe_plane((0.0, 2.0, 0.0), 90.0),
        probe_plane((-2.0, 0.5, 3.0), -60.0, 20.0, 15.0),
    ):
        console.send(probe_message(plane))
        assert shows_volume(console.wait(at(plane)))


def test_image_to_reference_comes_with_every_picture_and_agrees_with_it(console):
    console.send(probe_message(PLANE))
    image = console.wait(at(PLANE))
    transform = console.wait(lambda m: m.device == "ImageToReference")
    np.testing.assert_allclose(transform.content.matrix, image.content.matrix, atol=1e-4)
    assert transform.timestamp == pytest.approx(image.timestamp)


def test_a_picture_in_pixels_has_its_place_beside_it():
    options = SessionOptions(port=0, looks=Looks(embed=False), rates=QUICK.rates)
    with Session(make_stage(), options) as session:
        peer = Console(session.port)
        image = peer.wait(lambda m: isinstance(m.content, Image))
        np.testing.assert_allclose(image.content.matrix, np.eye(4), atol=1e-6)
        place = peer.wait(lambda m: m.device == "ImageToReference").content.matrix
        np.testing.assert_allclose(place, AXIAL @ probe_plane((0, 0, 0)).image_matrix(PIXELS), atol=1e-4)
        peer.close()


def test_the_tracked_needle_deforms_the_picture_of_the_tracked_plane(console):
    console.send(probe_message(PLANE))
    console.send(needle_message(DEEP))
    expected = expected_picture(PLANE, DEEP)
    inside = (expected > 0) & (expected_picture(PLANE) > 0)
    assert np.abs(expected - expected_picture(PLANE))[inside].max() > 10

    def wanted(message: Message) -> bool:
        return at(PLANE)(message) and np.abs(message.content.voxels[0] - expected)[inside].max() < 4

    console.wait(wanted)
    text = console.wait(said("soft, live", "tip 2.0 8.0 0.5 mm", code=1)).content.text
    away = DEEP.seen_from(PLANE)[1][2]
    assert f"{away:+.1f} mm from the plane" in text


def test_tools_in_one_tdata_move_both(console):
    tools = (
        Tool("ProbeToReference", AXIAL @ PLANE.matrix),
        Tool("ReferenceToTracker", np.eye(4)),
        Tool("NeedleTip", AXIAL @ tip_frame(DEEP)),
    )
    console.send(Message(TrackingData(tools), "tracker"))
    console.wait(at(PLANE))
    console.wait(said("tip 2.0 8.0 0.5 mm"))


def test_a_lost_probe_is_said_in_the_status_and_stays(console):
    console.send(probe_message(PLANE, metadata={"TransformStatus": "OK"}, version=2))
    console.wait(at(PLANE))
    lost = probe_message(probe_plane((9.0, 0.0, 0.0)), metadata={"TransformStatus": "MISSING"}, version=2)
    console.send(lost)
    console.wait(said("ProbeToReference is MISSING; the probe stays where it was", error="Invalid", code=13))
    assert at(PLANE)(console.wait(lambda m: isinstance(m.content, Image)))


def test_a_probe_outside_the_volume_shows_black_and_says_so_once(console, caplog):
    with caplog.at_level(logging.INFO, logger="echospline.openigtlink"):
        away = probe_plane((0.0, 200.0, 0.0))
        console.send(probe_message(away))
        assert not console.wait(at(away)).content.voxels.any()
        console.wait(said("outside the volume and is black", error="Outside", code=13))
        for k in range(5):
            other = probe_plane((float(k), 200.0, 0.0))
            console.send(probe_message(other))
            console.wait(at(other))
        console.send(probe_message(PLANE))
        console.wait(at(PLANE))
        console.wait(said("no tracked needle yet", code=1))
    told = [r.message for r in caplog.records]
    assert sum("outside the volume and is black" in t for t in told) == 1
    assert sum("sees the volume again" in t for t in told) == 1


def test_a_part_outside_is_said_with_its_share(console):
    half = probe_plane((15.0, 0.0, 0.0))
    console.send(probe_message(half))
    text = console.wait(said("of the picture is outside the volume", code=1)).content.text
    share = (expected_picture(half) == 0).mean()
    assert f"{100 * share:.0f} %" in text


def test_orders_work_in_space(console):
    console.send(Message(String("model stiff"), "Command"))
    console.wait(said("the tissue is stiff now"))
    console.wait(said("stiff, live"))
    console.send(Message(String("start"), "Command"))
    console.wait(said("the planned insertion runs, 0.4 s"))
    console.wait(said("depth 8.0 mm"))
    console.send(Message(String("freeze"), "Command"))
    console.wait(said("frozen"))
    console.send(Message(String("reset"), "Command"))
    console.wait(said("live", "depth 0.0 mm"))


def test_a_scene_in_the_plane_gives_way_to_one_in_space():
    with Session(make_flat_stage(), QUICK, lambda name: make_stage()) as session:
        peer = Console(session.port)
        peer.send(Message(String("load space.toml"), "Command"))
        peer.wait(said("space.toml is loaded"))
        peer.send(probe_message(PLANE))
        assert shows_volume(peer.wait(at(PLANE)))
        peer.close()


def test_a_place_that_is_no_motion_is_refused():
    with pytest.raises(InputError, match="right-handed"):
        SpatialStage(make_engine(), place=np.diag([-1.0, 1.0, 1.0, 1.0]))


# ---- with other libraries


def test_pyigtl_moves_the_probe_and_gets_each_pixel_in_its_place():
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl, the second peer, is not installed")
    with Session(make_stage(), QUICK) as session:
        client = pyigtl.OpenIGTLinkClient("127.0.0.1", session.port)
        try:
            matrix = AXIAL @ PLANE.matrix
            client.send_message(pyigtl.TransformMessage(matrix, device_name="ProbeToReference"), wait=True)
            until = time.monotonic() + 30
            while time.monotonic() < until:
                image = client.wait_for_message("Image", timeout=20)
                if np.abs(image.ijk_to_world_matrix - AXIAL @ PLANE.image_matrix(PIXELS)).max() < 1e-3:
                    break
            else:
                raise AssertionError("the plane did not follow")
            transform = client.wait_for_message("ImageToReference", timeout=20)
            np.testing.assert_allclose(transform.matrix, image.ijk_to_world_matrix, atol=1e-4)
            assert client.wait_for_message("NeedleTipToReference", timeout=20).matrix.shape == (4, 4)
            # ten pixels, one by one, in the client's own words
            for row, column in np.random.default_rng(3).integers(5, 50, (10, 2)):
                ras = image.ijk_to_world_matrix @ [column, row, 0, 1]
                scene = np.linalg.inv(AXIAL) @ ras
                expected = smooth_volume().sample(scene[None, :3])[0]
                assert abs(float(image.image[0, row, column]) - expected) < 2.5
        finally:
            client.stop()


def test_the_c_library_moves_the_probe_and_reads_the_plane(peer):
    async def scene() -> None:
        with Session(make_stage(), QUICK) as session:
            numbers = (AXIAL @ PLANE.matrix)[:3].ravel()
            process = await start(peer, "move", "127.0.0.1", session.port, 60, "ProbeToReference", *numbers)
            got = await lines(process)
        assert all(m["crc"] is True for m in got)
        assert "ProbeToReference" not in {m["device"] for m in got[-20:]}  # it is not sent back
        images = [m for m in got if m["device"] == "Image"]
        matrix = AXIAL @ PLANE.image_matrix(PIXELS)
        # the library's matrix of an image: unit axes, and the place of its centre
        columns, rows = PIXELS.shape
        centre = matrix @ [(columns - 1) / 2, (rows - 1) / 2, 0, 1]
        expected = np.column_stack((matrix[:, :2] / 0.25, matrix[:, 2], centre))
        np.testing.assert_allclose(images[-1]["matrix"], expected, atol=1e-4)
        assert images[-1]["size"] == [columns, rows, 1]
        np.testing.assert_allclose(images[-1]["spacing"], [0.25, 0.25, 1.0], rtol=1e-5)
        transforms = [m for m in got if m["device"] == "ImageToReference"]
        np.testing.assert_allclose(transforms[-1]["matrix"], matrix, atol=1e-4)

    run(scene)


# ---- from the command line


def test_link_in_a_volume_from_the_command_line(tmp_path):
    port = free_port()
    words = ["link", "sample:spine", "--port", str(port), "--duration", "60", "--view", "longitudinal"]
    process = subprocess.Popen(
        [sys.executable, "-m", "echospline", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert "volume 73 x 52 x 52 mm" in process.stdout.readline()
        peer = Console(port)
        first = peer.wait(lambda m: isinstance(m.content, Image))
        plane = ImagingPlane(np.linalg.inv(AXIAL) @ rigid((0, 0, 0), (0, 0, 7)) @ AXIAL)
        peer.send(probe_message(plane))
        other = peer.wait(lambda m: isinstance(m.content, Image) and abs(m.content.matrix[2, 3] - 7) < 1e-3)
        assert first.content.voxels.std() > 5
        assert other.content.voxels.std() > 5
        assert (first.content.voxels != other.content.voxels).mean() > 0.3
        peer.send(needle_message(SpatialPose((-10.0, 0.0, 7.0), (0.0, 12.0, 7.0))))
        peer.wait(said("green, live", "tip 0.0 12.0 7.0 mm"))
        peer.close()
    finally:
        process.terminate()
        process.wait(20)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["link", "sample:spine", "--beam", "2"], "--beam belongs to scenes in the plane"),
        (["link", "sample:spine", "--target", "1,2"], "--target belongs to scenes in the plane"),
        (["link", "sample:spine", "--orientation", "UF"], "--orientation belongs to scenes in the plane"),
        (["link", "sample:spine", "--place", "file"], "sample:spine has none"),
        (["link", "sample:spine", "--place", "moon"], "--place is one of axial, file, lps"),
        (["link", "sample:calf", "--place", "lps"], "--place lps belongs to volumes"),
        (["link", "sample:spine", "--config", "examples/plus-echospline.xml"], "ImageToProbe: expected the picture's 0.12"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_in_space_gets_one_sentence(words, sentence, request, monkeypatch):
    monkeypatch.chdir(request.config.rootpath)
    result = CliRunner().invoke(app, [*words, "--duration", "1", "--port", "0"])
    assert isinstance(result.exception, InputError)
    assert sentence in str(result.exception)
    assert str(result.exception).count("\n") == 0


def test_a_volume_from_slicer_stands_where_slicer_shows_it(tmp_path):
    path = write_volume(tmp_path / "v.mha", smooth_volume())
    volume = read_volume(path, "y")
    np.testing.assert_allclose(
        (LPS_TO_RAS @ scene_to_file(path, "y", volume))[:3, 3], LPS_TO_RAS[:3, :3] @ (0, 0, 0), atol=1e-9
    )


# ---- the device set of PLUS that is shipped

DEVICE_SET = Path(__file__).parent.parent / "examples" / "plus-echospline-space.xml"


def definitions() -> dict[str, np.ndarray]:
    """CoordinateDefinitions, read here by hand."""
    found = ElementTree.parse(DEVICE_SET).getroot().find("CoordinateDefinitions")
    assert found is not None
    return {
        f"{t.get('From')}To{t.get('To')}": np.array(t.get("Matrix", "").split(), dtype=float).reshape(4, 4)
        for t in found
    }


def test_the_shipped_device_set_hangs_together():
    """What its server sends is enough for echospline, and every stream that is named is made by a device."""
    root = ElementTree.parse(DEVICE_SET).getroot()
    made = {o.get("Id") for o in root.iter("OutputChannel")}
    used = {i.get("Id") for i in root.iter("InputChannel")}
    server = root.find("PlusOpenIGTLinkServer")
    assert server is not None
    assert used | {server.get("OutputChannelId")} <= made
    device = next(d for d in root.iter("Device") if d.get("Type") == "OpenIGTLinkVideo")
    assert (device.get("ServerPort"), server.get("ListeningPort")) == ("18944", "18945")
    sources = {s.get("Id"): s.get("PortUsImageOrientation") for s in device.iter("DataSource")}
    assert sources == {"Video": "MF"}
    tracking = SpatialTracking(
        Probe(pixel=0.12).grid, AXIAL, Naming(calibration=read_calibration(DEVICE_SET))
    )
    for name in server.iter("Transform"):
        tracking.put(str(name.get("Name")), rigid((0, 0, 0), (20.0, 30.0, 40.0)))
    located = tracking.locate()
    assert located.plane is not None
    assert located.needle is not None
    assert located.fault == ""


def test_our_reader_takes_the_shipped_device_set_as_it_is_written():
    read = read_calibration(DEVICE_SET)
    assert set(read) == {"NeedleTipToNeedle", "ImageToProbe", "SceneToReference"}
    for name, matrix in definitions().items():
        np.testing.assert_array_equal(read[name], matrix)
    # the middle of the face is where the comment says, and the scene where it is without the transform
    grid = Probe(pixel=0.12).grid
    assert grid.shape[0] == 333
    np.testing.assert_allclose(picture_plane(read["ImageToProbe"], grid).matrix[:3, 3], (0, 60, 0), atol=1e-9)
    np.testing.assert_array_equal(read["SceneToReference"], AXIAL)


def test_the_shipped_device_set_moves_probe_and_needle_from_another_librarys_server():
    """pyigtl's server stands for PlusServer; echospline is started as docs/slicer.md says."""
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl, the second peer, is not installed")
    there, port, defined = free_port(), free_port(), definitions()
    reference = defined["SceneToReference"]
    to_marker = rigid((0, 0, 0), (0, 60, 0))  # the middle of the face, by the comment in the file
    plane = probe_plane((2.0, 0.0, -3.0), 20.0, 5.0)
    needle = SpatialPose((-10.0, 0.0, -3.0), (0.0, 12.0, -2.0))
    sent = {
        "ProbeToReference": reference @ plane.matrix @ np.linalg.inv(to_marker),
        "NeedleToReference": reference @ tip_frame(needle) @ np.linalg.inv(defined["NeedleTipToNeedle"]),
    }
    server = pyigtl.OpenIGTLinkServer(port=there)
    words = [
        "link",
        "sample:spine",
        "--config",
        str(DEVICE_SET),
        "--connect",
        f"127.0.0.1:{there}",
        "--silence",
        "3600",
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "echospline", *words, "--port", str(port), "--duration", "90"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert "OpenIGTLink on" in process.stdout.readline()
        until = time.monotonic() + 60
        while not server.is_connected():
            assert time.monotonic() < until
            time.sleep(0.05)
        for name, matrix in sent.items():
            server.send_message(pyigtl.TransformMessage(matrix, device_name=name), wait=True)
        peer = Console(port)
        expected = sent["ProbeToReference"] @ defined["ImageToProbe"]

        def placed(message: Message) -> bool:
            return isinstance(message.content, Image) and bool(
                np.abs(message.content.matrix[:, [0, 1, 3]] - expected[:, [0, 1, 3]]).max() < 1e-3
            )

        assert peer.wait(placed).content.voxels.std() > 5
        tip = sent["NeedleToReference"] @ defined["NeedleTipToNeedle"]

        def arrived(message: Message) -> bool:
            return message.device == "NeedleTipToReference" and bool(
                np.abs(message.content.matrix[:3, 2:] - tip[:3, 2:]).max() < 1e-3
            )

        peer.wait(arrived)
        peer.wait(said("green, live", "tip 0.0 12.0 -2.0 mm"))
        peer.close()
    finally:
        process.terminate()
        process.wait(20)
        server.stop()


def test_pages_follow_probe_and_needle_of_a_tracker_in_a_volume(tmp_path):
    """`echospline live VOLUME --link`: what the tracker does to both is told to every page."""
    from echospline.viewer import steer, turn  # noqa: PLC0415
    from live_scene import listening, running, waited  # noqa: PLC0415

    with running(tmp_path) as (address, _, served), listening(address) as page:
        waited(served, 1)
        with Session(
            make_stage(),
            QUICK,
            moved=lambda pose, new: steer(served, pose, new),
            placed=lambda plane: turn(served, plane.matrix.ravel()),
        ) as session:
            console = Console(session.port)
            console.send(probe_message(PLANE))
            told = np.array(page.hear("plane")["plane"]).reshape(4, 4)
            np.testing.assert_allclose(told, PLANE.matrix, atol=1e-5)
            console.send(needle_message(DEEP))
            needle = page.hear("tip")
            np.testing.assert_allclose([needle["entry"], needle["tip"]], [DEEP.entry, DEEP.tip], atol=1e-4)
            assert needle["appears"]
            console.close()
