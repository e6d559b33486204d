"""A tracker drives the needle and gets the deforming image back: the whole way through sockets and threads."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from echospline.cli.app import app
from echospline.cli.link import oriented
from echospline.errors import InputError
from echospline.live import LiveEngine
from echospline.openigtlink import (
    Looks,
    Message,
    Naming,
    Position,
    Rates,
    Session,
    SessionOptions,
    Stage,
    Status,
    String,
    Transform,
    read_calibration,
)
from echospline.openigtlink.decoder import Decoder
from echospline.openigtlink.image import Image
from echospline.openigtlink.message import Request, encode
from echospline.openigtlink.orders import answer, order_of
from echospline.openigtlink.polydata import Points, PolyData
from echospline.openigtlink.text import CommandMessage, CommandReply
from echospline.openigtlink.transforms import Tracking
from echospline.picture import Deformation, Drawing
from echospline.scene import AXIAL, ImagingPlane, Insertion, NeedlePose, Reach, RegularGrid, UltrasoundImage

GRID = RegularGrid((64, 48), (0.5, 0.5))
MESH = RegularGrid.covering(GRID, (17, 13))
PLANE = ImagingPlane(AXIAL)
PATIENCE = 30.0


@dataclass(frozen=True)
class Dragged:
    """Stand-in tissue: what is near the tip goes with it; `share` tells models apart."""

    share: float = 0.05
    grid: RegularGrid = MESH

    def rest(self):
        return NeedlePose((16.0, 0.0), (16.0, 0.0))

    def advance(self, state, pose, dt):
        return pose

    def displacement(self, state):
        return self.displacement_at(state, self.grid.nodes)

    def displacement_at(self, state, points):
        r2 = ((np.asarray(points) - state.tip) ** 2).sum(axis=1)
        return self.share * state.depth * np.exp(-r2 / 40.0)[:, None] * np.asarray(state.axis)


def make_stage(insertion: Insertion | None = None) -> Stage:
    pixels = np.random.default_rng(8).integers(0, 200, (48, 64), dtype=np.uint8)
    models = {"soft": Dragged(), "stiff": Dragged(0.01)}
    engine = LiveEngine(lambda name: models[name], "soft", NeedlePose((16.0, 0.0), (16.0, 0.0)), rate=200.0)
    return Stage(UltrasoundImage(pixels, GRID), engine, ("soft", "stiff"), insertion)


class Console:
    """A blocking peer: what Slicer is to the session."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE)
        self._decoder = Decoder()

    def send(self, message: Message) -> None:
        self._socket.sendall(encode(message))

    def wait(self, wanted: Callable[[Message], bool]) -> Message:
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            data = self._socket.recv(1 << 20)
            assert data, "the session closed the connection"
            for message in self._decoder.feed(data):
                if wanted(message):
                    return message
        raise AssertionError("nothing of the kind came")

    def tip(self, pose: NeedlePose, name: str = "NeedleTipToReference") -> None:
        self.send(Message(Transform(PLANE.tip_matrix(pose)), name, time.time()))

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def options() -> SessionOptions:
    return SessionOptions(port=0, looks=Looks(echo=None), rates=Rates(image=100, mesh=20, status=20))


@pytest.fixture
def console(options: SessionOptions) -> Iterator[Console]:
    insertion = Insertion.straight((16.0, 0.0), 90.0, 10.0, 20.0)
    with Session(make_stage(insertion), options) as session:
        peer = Console(session.port)
        yield peer
        peer.close()


def pose_at(depth: float) -> NeedlePose:
    return NeedlePose((10.0, 0.0), (10.0 + 0.6 * depth, 0.8 * depth))


def shows(pose: NeedlePose) -> Callable[[Message], bool]:
    """A mesh that answers exactly this pose."""

    def wanted(message: Message) -> bool:
        if not isinstance(message.content, PolyData):
            return False
        expected = PLANE.lift(MESH.nodes + Dragged().displacement(pose))
        return bool(np.abs(message.content.points - expected).max() < 1e-3)

    return wanted


def test_the_image_that_comes_back_is_the_one_that_the_tracked_needle_deforms(console: Console) -> None:
    for depth in (2.0, 6.0, 12.0):
        console.tip(pose_at(depth))
        time.sleep(0.02)
    final = pose_at(12.0)
    console.wait(shows(final))
    message = console.wait(lambda m: m.type == "IMAGE")
    assert isinstance(message.content, Image)
    stage = make_stage()
    expected = Drawing(stage.image, MESH).draw(Dragged().displacement(final)).image.pixels
    np.testing.assert_allclose(message.content.voxels[0].astype(int), expected.astype(int), atol=1)
    assert np.abs(expected.astype(int) - stage.image.pixels).max() > 20  # the needle did something
    np.testing.assert_allclose(message.content.matrix, PLANE.image_matrix(GRID), atol=1e-5)
    assert message.device == "Image"


def test_slicers_three_ways_to_say_where_the_needle_is_agree(options: SessionOptions) -> None:
    calibration = {
        "NeedleTipToNeedle": np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 120.0], [0, 0, 0, 1]])
    }
    looks = Looks(Naming(calibration=calibration), echo=None)
    tip = PLANE.tip_matrix(pose_at(8.0))
    needle = tip @ np.linalg.inv(calibration["NeedleTipToNeedle"])
    tracker = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1.0]])
    ways = [
        [("NeedleTipToReference", tip)],
        [("NeedleToReference", needle)],
        [("NeedleToTracker", tracker @ needle), ("ReferenceToTracker", tracker)],
        [("StylusTipToReference", tip)],
    ]
    for way in ways:
        with Session(make_stage(), SessionOptions(port=0, looks=looks, rates=options.rates)) as session:
            peer = Console(session.port)
            for name, matrix in way:
                peer.send(Message(Transform(matrix), name))
            peer.wait(shows(pose_at(8.0)))
            peer.close()


def test_position_messages_move_the_needle_too(console: Console) -> None:
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    tip = PLANE.tip_matrix(pose_at(9.0))
    x, y, z = tip[:3, 3]
    quaternion = tuple(float(q) for q in Rotation.from_matrix(tip[:3, :3]).as_quat())
    console.send(Message(Position((x, y, z), quaternion), "NeedleTipToReference"))  # type: ignore[arg-type]
    console.wait(shows(pose_at(9.0)))


def test_the_image_follows_a_moved_probe(console: Console) -> None:
    moved = np.array([[0, 0, 1, 10], [1, 0, 0, 20], [0, 1, 0, 30], [0, 0, 0, 1.0]])
    plane = ImagingPlane(moved)
    console.send(Message(Transform(plane.image_matrix(GRID)), "ImageToReference"))
    console.send(Message(Transform(plane.tip_matrix(pose_at(7.0))), "NeedleTipToReference"))
    message = console.wait(
        lambda m: (
            isinstance(m.content, Image)
            and np.allclose(m.content.matrix, plane.image_matrix(GRID), atol=1e-4)
        )
    )
    assert message.device == "Image"
    console.wait(lambda m: isinstance(m.content, Status) and "depth 7.0 mm" in m.content.text)


def test_what_is_wrong_with_the_transforms_is_told(console: Console) -> None:
    console.send(Message(Transform(np.eye(4)), "NeedleToTracker"))
    message = console.wait(lambda m: isinstance(m.content, Status) and m.content.error == "Transforms")
    assert isinstance(message.content, Status)
    assert (
        "no transform leads from NeedleTip or StylusTip to Reference; there are NeedleToTracker"
        in message.content.text
    )
    console.send(Message(Transform(np.diag([9.0, 9.0, 1, 1])), "ImageToReference"))
    console.wait(
        lambda m: (
            isinstance(m.content, Status) and "9 x 9 mm per pixel, the image 0.5 x 0.5" in m.content.text
        )
    )


def test_a_needle_that_leaves_the_plane_fades_and_lets_go_of_the_tissue() -> None:
    options = SessionOptions(
        port=0, rates=Rates(image=100, mesh=20, status=20), reach=Reach(thickness=4, contact=6)
    )
    bright = make_stage()
    dark = UltrasoundImage(bright.image.pixels // 2, GRID)  # speckle ends at 99
    with Session(Stage(dark, bright.engine), options) as session:
        peer = Console(session.port)

        def brightest(z: float, *words: str) -> int:
            tip = PLANE.tip_matrix(pose_at(12.0))
            tip[2, 3] += z  # the axial plane's z is the patient's S
            peer.send(Message(Transform(tip), "NeedleTipToReference"))
            peer.wait(lambda m: isinstance(m.content, Status) and all(w in m.content.text for w in words))
            image = peer.wait(lambda m: isinstance(m.content, Image)).content
            assert isinstance(image, Image)
            return int(image.voxels.max())

        full = brightest(0.0, "depth 12.0 mm", "0.0 mm out of plane, tilt 0 deg, echo 100 %")
        half = brightest(1.9, "depth 12.0 mm", "+1.9 mm out of plane, tilt 0 deg, echo 53 %")
        faint = brightest(-3.8, "depth 12.0 mm", "-3.8 mm out of plane, tilt 0 deg, echo 0 %")
        assert full > 180
        assert 99 < half < full - 15  # half the amplitude is 6 of the 60 dB
        assert faint == 99
        brightest(6.5, "too far to touch")
        peer.wait(shows(NeedlePose((16.0, 0.0), (16.0, 0.0))))  # the tissue is at rest again
        peer.close()


def test_a_needle_that_appears_inserted_is_not_thrust_there() -> None:
    """Tissue that remembers the fastest needle it met: coming into sight at depth must not count as speed."""

    class Remembers(Dragged):
        def rest(self):
            return (0.0, super().rest())

        def advance(self, state, pose, dt):
            return (max(state[0], abs(pose.speed)), pose)

        def displacement_at(self, state, points):
            return super().displacement_at(state[1], points) * 0 + state[0] / 1000

    engine = LiveEngine(lambda _: Remembers(), "one", NeedlePose((16.0, 0.0), (16.0, 0.0)), rate=100.0)
    stage = Stage(make_stage().image, engine)
    with Session(stage, SessionOptions(port=0, rates=Rates(100, 20, 20))) as session:
        peer = Console(session.port)
        peer.tip(pose_at(20.0))
        peer.wait(lambda m: isinstance(m.content, Status) and "depth 20.0 mm" in m.content.text)
        snapshot = engine.snapshots.latest()
        assert snapshot is not None
        assert 1000 * snapshot.value.displacement.max() <= 10.001  # the straight insertion's 10 mm/s
        peer.close()


def order(console: Console, text: str) -> Status:
    console.send(Message(String(text), "Command"))
    content = console.wait(lambda m: m.device == "Command" and isinstance(m.content, Status)).content
    assert isinstance(content, Status)
    return content


def test_orders_start_stop_reset_freeze_and_switch_the_model(console: Console) -> None:
    assert order(console, "start").text == "the planned insertion runs, 0.5 s"
    console.wait(shows(NeedlePose((16.0, 0.0), (16.0, 10.0))))
    assert order(console, "model stiff").text == "the tissue is stiff now"
    console.wait(lambda m: isinstance(m.content, Status) and m.content.text.startswith("stiff, live"))
    assert order(console, "freeze").code == 1
    console.wait(lambda m: isinstance(m.content, Status) and "frozen" in m.content.text)
    assert order(console, "reset").code == 1
    console.wait(lambda m: isinstance(m.content, Status) and "live; tip 16.0 0.0 mm" in m.content.text)
    assert order(console, "stop").text == "time stands still"
    assert order(console, "unfreeze").text == "time runs"
    assert order(console, "model jelly").text == "a model is one of soft, stiff; got 'jelly'"
    assert "orders are start, stop" in order(console, "explode").text
    assert "start with --scenarios" in order(console, "load ../../etc/passwd").text


def test_commands_are_answered_in_the_form_they_came(console: Console) -> None:
    console.send(Message(CommandMessage(7, "Freeze"), "Slicer", version=2))
    reply = console.wait(lambda m: m.type == "RTS_COMMAND")
    assert reply.content == CommandReply(
        7, "", '<CommandReply Status="SUCCESS" Message="time stands still" />'
    )
    assert reply.metadata["Status"] == "SUCCESS"
    console.send(Message(String('<Command Name="SwitchModel" Model="jelly" />'), "CMD_42"))
    acknowledged = console.wait(lambda m: m.device == "ACK_42").content
    assert isinstance(acknowledged, String)
    assert 'Status="FAIL"' in acknowledged.text
    assert "soft, stiff" in acknowledged.text
    console.send(Message(Request("GET_STATUS"), "me"))
    console.wait(lambda m: m.device == "me" and isinstance(m.content, Status))


def test_scenarios_are_loaded_by_name_where_it_is_allowed(options: SessionOptions) -> None:
    asked = []

    def load(name: str) -> Stage:
        asked.append(name)
        if name != "liver.toml":
            raise InputError(f"there is no scenario {name}")
        small = RegularGrid((20, 10), (1.0, 1.0))
        engine = LiveEngine(lambda _: Dragged(), "soft", NeedlePose((5.0, 0.0), (5.0, 0.0)))
        return Stage(UltrasoundImage(np.zeros((10, 20), np.uint8), small), engine)

    with Session(make_stage(), options, load) as session:
        peer = Console(session.port)
        assert order(peer, "load heart.toml").text == "there is no scenario heart.toml"
        assert order(peer, "load liver.toml").text == "liver.toml is loaded"
        image = peer.wait(lambda m: isinstance(m.content, Image) and m.content.size == (20, 10, 1))
        assert image.device == "Image"
        peer.close()
    assert asked == ["heart.toml", "liver.toml"]


def test_targets_move_with_the_tissue() -> None:
    stage = make_stage()
    stage.engine.watch(np.array([[14.0, 10.0], [30.0, 20.0]]))
    with Session(stage, SessionOptions(port=0, rates=Rates(100, 0, 20))) as session:
        peer = Console(session.port)
        peer.tip(pose_at(0.5))
        peer.tip(pose_at(12.0))
        moved = Deformation(MESH, Dragged().displacement(pose_at(12.0))).forward(np.array([[14.0, 10.0]]))
        expected = PLANE.lift(moved)[0]
        message = peer.wait(
            lambda m: (
                isinstance(m.content, Points)
                and np.allclose(m.content.points[0].position, expected, atol=1e-3)
            )
        )
        assert isinstance(message.content, Points)
        assert [p.name for p in message.content.points] == ["Target", "Target2"]
        assert np.linalg.norm(expected - PLANE.lift(np.array([[14.0, 10.0]]))[0]) > 0.2
        peer.close()


def test_an_image_that_is_not_embedded_comes_with_its_transform() -> None:
    options = SessionOptions(port=0, looks=Looks(embed=False), rates=Rates(100, 0, 0))
    with Session(make_stage(), options) as session:
        peer = Console(session.port)
        image = peer.wait(lambda m: m.type == "IMAGE")
        assert isinstance(image.content, Image)
        np.testing.assert_allclose(image.content.matrix, np.eye(4), atol=1e-6)
        place = peer.wait(lambda m: m.device == "ImageToReference")
        assert isinstance(place.content, Transform)
        np.testing.assert_allclose(place.content.matrix, PLANE.image_matrix(GRID), atol=1e-6)
        peer.close()


def test_the_session_ends_with_its_threads() -> None:
    with Session(make_stage(), SessionOptions(port=0)) as session:
        peer = Console(session.port)
        peer.wait(lambda m: m.type == "IMAGE")
    assert not [t.name for t in threading.enumerate() if t.name.startswith("echospline-")]
    with Session(make_stage(), SessionOptions(port=0)) as first:
        taken = SessionOptions(port=first.port)
        with pytest.raises(InputError, match="cannot listen"), Session(make_stage(), taken):
            pass
    assert not [t.name for t in threading.enumerate() if t.name.startswith("echospline-")]


@pytest.mark.parametrize(
    ("message", "name", "argument"),
    [
        (Message(String("freeze"), "Command"), "freeze", ""),
        (Message(String("Load liver.toml"), "CMD_7"), "load", "liver.toml"),
        (Message(String("<Command Name='LoadScenario' File='a.toml'/>"), "anything"), "load", "a.toml"),
        (Message(CommandMessage(1, "switch_model", "fem")), "model", "fem"),
        (Message(CommandMessage(1, "", "<Command Name='Reset'/>")), "reset", ""),
    ],
)
def test_orders_are_understood(message: Message, name: str, argument: str) -> None:
    found = order_of(message)
    assert found is not None
    assert (found.name, found.argument) == (name, argument)


@pytest.mark.parametrize(
    "message",
    [Message(String("freeze"), "Note"), Message(Status()), Message(CommandReply(1, "freeze"))],
    ids=str,
)
def test_other_texts_are_no_orders(message: Message) -> None:
    assert order_of(message) is None


@pytest.mark.parametrize(
    "text",
    [
        "<Command Name='explode'/>",
        "<Command",
        "<Command Name='reset'/>" + " " * 20_000,
        "<!DOCTYPE x [<!ENTITY a 'b'>]><Command/>",
    ],
)
def test_bad_orders_are_refused_and_the_refusal_fits_its_message(text: str) -> None:
    message = Message(CommandMessage(3, "", text))
    with pytest.raises(InputError) as refusal:
        order_of(message)
    assert Decoder().feed(encode(answer(message, str(refusal.value), done=False)))[0].type == "RTS_COMMAND"


def test_a_flood_of_transform_names_is_bounded() -> None:
    tracking = Tracking(GRID, Naming())
    for i in range(100):
        tracking.put(f"Tool{i}ToTracker", np.eye(4))
    with pytest.raises(InputError, match="at most 100"):
        tracking.put("Tool100ToTracker", np.eye(4))
    tracking.put("Tool7ToTracker", np.eye(4))  # those that are known go on


def test_the_calibration_of_a_plus_file_is_read(tmp_path: Path) -> None:
    shipped = Path(__file__).parent.parent / "examples" / "plus-echospline.xml"
    assert set(read_calibration(shipped)) == {"NeedleTipToNeedle", "ImageToProbe"}
    for text, reason in [
        ("<PlusConfiguration/>", "no <Transform>"),
        ("<Other/>", "PlusConfiguration"),
        ("not xml", "no XML"),
        ("<!DOCTYPE a [<!ENTITY x 'y'>]><PlusConfiguration/>", "entities"),
        (
            "<PlusConfiguration><CoordinateDefinitions><Transform From='A' To='B' Matrix='1 2'/></CoordinateDefinitions></PlusConfiguration>",
            "16 numbers",
        ),
    ]:
        path = tmp_path / "config.xml"
        path.write_text(text)
        with pytest.raises(InputError, match=reason):
            read_calibration(path)


@pytest.mark.parametrize(
    ("orientation", "corner"), [("MF", (0, 0)), ("UF", (0, -1)), ("MN", (-1, 0)), ("UN", (-1, -1))]
)
def test_an_asymmetric_picture_of_any_orientation_is_turned_to_mf(
    orientation: str, corner: tuple[int, int]
) -> None:
    pixels = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    turned = oriented(UltrasoundImage(pixels, GRID), orientation).pixels
    assert turned[0, 0] == pixels[corner]
    assert turned.shape == pixels.shape


def test_pages_follow_the_tracker_that_steers_the_link(tmp_path: Path) -> None:
    """`echospline live --link`: what the tracker does is told to every page."""
    from echospline.viewer import steer  # noqa: PLC0415
    from live_scene import listening, running  # noqa: PLC0415

    with (
        running(tmp_path) as (address, _, app),
        listening(address) as page,
        Session(
            make_stage(), SessionOptions(port=0), moved=lambda pose, new: steer(app, pose, new)
        ) as session,
    ):
        console = Console(session.port)
        console.tip(pose_at(0.5))
        console.tip(pose_at(9.0))
        while not np.allclose(page.hear("tip")["tip"], pose_at(9.0).tip, atol=1e-3):
            pass
        console.close()


def test_the_command_runs_and_refuses_in_words() -> None:
    runner = CliRunner()
    good = runner.invoke(app, ["link", "--port", "0", "--duration", "0.3", "--mesh-rate", "0"])
    assert good.exit_code == 0
    assert "OpenIGTLink on 127.0.0.1:" in good.output
    for arguments, reason in [
        (["--orientation", "FM"], "MF, UF, MN, UN"),
        (["--needle-axis", "q"], "x, -x"),
        (["--connect", "host:port"], "HOST:PORT"),
        (["--no-serve"], "nothing to do"),
        (["--target", "1"], "X,Y in mm"),
        (["--fps", "0"], "--fps"),
        (["--silence", "0"], "silence"),
        (["--ask", "IMAGE"], "TDATA, QTDATA, QTRANS, POSITION"),
    ]:
        bad = runner.invoke(app, ["link", "--port", "0", "--duration", "0.1", *arguments])
        assert isinstance(bad.exception, InputError)
        assert reason in str(bad.exception)
