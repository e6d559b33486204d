"""Live exchanges on loopback with other implementations: the reference C++ library, its example programs, pyigtl."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import subprocess
import threading
import zlib
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest

from echospline.openigtlink import Link, LinkLimits, Message, Position, Status, String, Transform
from echospline.openigtlink.image import Image
from echospline.openigtlink.message import Request
from echospline.openigtlink.ndarray import NDArrayMessage
from echospline.openigtlink.peer import Peer
from echospline.openigtlink.polydata import Attribute, Point, Points, PolyData
from echospline.openigtlink.text import Capability

HERE = Path(__file__).parent / "openigtlink"
EXAMPLES = Path("/usr/share/doc/openigtlink-examples/examples")
INCLUDE = Path("/usr/include/openigtlink")
MATRIX = np.array([[0, -0.3, 0, 12.5], [0.2, 0, 0, -7.25], [0, 0, 1, 3.125], [0, 0, 0, 1]])
RIGID = np.array([[0, -1, 0, 12.5], [1, 0, 0, -7.25], [0, 0, 1, 3.125], [0, 0, 0, 1]])
PICTURE = np.random.default_rng(5).integers(0, 256, (1, 240, 320), dtype=np.uint8)


def compiled(source: Path, folder: Path) -> Path:
    missing = [str(p) for p in (source, INCLUDE) if not p.exists()] + ([] if shutil.which("g++") else ["g++"])
    if missing:
        pytest.skip(
            f"the C++ peer cannot be built: {', '.join(missing)} is missing; run tests/install-system as root"
        )
    program = folder / source.stem
    flags = ["-O1", "-w", f"-I{INCLUDE}", "-o", str(program), str(source), "-lOpenIGTLink", "-lpthread"]
    subprocess.run(["g++", *flags], check=True)
    return program


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(HERE / "peer.cxx", tmp_path_factory.mktemp("peer"))


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    folder = tmp_path_factory.mktemp("examples")
    return lambda name: compiled(EXAMPLES / name, folder)


async def start(program: Path, *arguments: object) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        program, *map(str, arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


async def lines(process: asyncio.subprocess.Process) -> list[dict[str, object]]:
    assert process.stdout is not None
    return [json.loads(line) async for line in process.stdout]


def run(scene: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(scene(), 60))


async def until(true: Callable[[], bool]) -> None:
    while not true():
        await asyncio.sleep(0.002)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Inbox(list[Message]):
    def __call__(self, _: Peer, message: Message) -> None:
        self.append(message)

    def of(self, device: str) -> Message | None:
        return next((m for m in self if m.device == device), None)


SENT = [
    Message(Image(PICTURE, MATRIX), "Image", 1700000000.25),
    Message(Image(PICTURE.astype(np.uint16) * 200, MATRIX), "Image16", 1.5),
    Message(Transform(RIGID), "NeedleTipToReference", 2.5),
    Message(Position((1.5, -2.5, 3.5), (0.5, -0.5, 0.5, 0.5)), "Tip", 3.5),
    Message(Status(1, 5, "none", "needle 0.4 mm out of plane"), "echospline", 4.5),
    Message(String("naïve µm"), "Text", 5.5),
    Message(Points((Point("Target", (1.25, 2.5, -3.75), 0.5, "Landmark"),)), "Target", 6.5),
    Message(
        PolyData(
            np.arange(12.0).reshape(4, 3),
            polygons=((0, 1, 3, 2),),
            attributes=(Attribute("displacement", 1, np.ones((4, 3), np.float32)),),
        ),
        "Mesh",
        7.5,
    ),
    Message(NDArrayMessage(np.arange(6, dtype=np.float32).reshape(2, 3)), "Displacement", 8.5),
]


def test_the_c_library_reads_every_message_with_a_sound_check_sum(peer: Path) -> None:
    async def scene() -> None:
        link = Link(Inbox())
        port = await link.serve("127.0.0.1", 0)
        for message in SENT:
            link.publish(message)
        process = await start(peer, "receive", "127.0.0.1", port, len(SENT))
        got = {m["device"]: m for m in await lines(process)}
        await link.close()
        assert list(got) == [m.device for m in SENT]
        assert all(m["crc"] is True for m in got.values())
        assert [m["time"] for m in got.values()] == [m.timestamp for m in SENT]

        image = got["Image"]
        assert (image["size"], image["scalar"], image["space"], image["components"]) == (
            [320, 240, 1],
            3,
            1,
            1,
        )
        np.testing.assert_allclose(image["spacing"], [0.2, 0.3, 1], rtol=1e-6)
        assert image["adler"] == zlib.adler32(PICTURE.tobytes())
        # the library's matrix: unit axes and the centre of the image
        expected = MATRIX.copy()
        expected[:3, 3] = (MATRIX @ [319 / 2, 239 / 2, 0, 1])[:3]
        expected[:3, :3] /= (0.2, 0.3, 1)
        np.testing.assert_allclose(image["matrix"], expected, rtol=1e-6)
        assert got["Image16"]["adler"] == zlib.adler32((PICTURE.astype("<u2") * 200).tobytes())
        np.testing.assert_array_equal(got["NeedleTipToReference"]["matrix"], RIGID)
        assert (got["Tip"]["position"], got["Tip"]["quaternion"]) == ([1.5, -2.5, 3.5], [0.5, -0.5, 0.5, 0.5])
        status = got["echospline"]
        assert (status["code"], status["subcode"], status["error"]) == (1, 5, "none")
        assert status["text"] == "needle 0.4 mm out of plane"
        assert (got["Text"]["encoding"], got["Text"]["bytes"]) == (106, len("naïve µm".encode()))
        assert got["Target"]["points"] == [
            {"name": "Target", "group": "Landmark", "position": [1.25, 2.5, -3.75], "radius": 0.5}
        ]
        assert (got["Mesh"]["polygons"], got["Mesh"]["attributes"]) == (1, ["displacement"])
        np.testing.assert_array_equal(got["Mesh"]["points"], np.arange(12).reshape(4, 3))
        assert (got["Displacement"]["scalar"], got["Displacement"]["axes"]) == (10, 2)

    run(scene)


def test_what_the_c_library_sends_is_received_as_server_and_as_client(peer: Path) -> None:
    async def scene() -> None:
        questions = ("Get", "Start", "Stop")  # the link itself answers these
        files = sorted(p for p in (HERE / "golden").glob("*.bin") if not p.stem.startswith(questions))
        expected = [f.stem for f in files]
        inbox = Inbox()
        server = Link(inbox)
        port = await server.serve("127.0.0.1", 0)
        sender = await start(peer, "send", "127.0.0.1", port, *files)
        await until(lambda: len(inbox) == len(files))
        assert [m.device for m in inbox] == expected
        await server.close()
        await sender.wait()

        inbox.clear()
        there = free_port()
        client = Link(inbox, limits=LinkLimits(retry=0.05))
        client.connect("127.0.0.1", there)  # before the server is up
        served = await start(peer, "serve", there, *files)
        await until(lambda: len(inbox) == len(files))
        assert [m.device for m in inbox] == expected
        client.publish(SENT[0])
        await until(lambda: client.peers[0].sent > 0)
        await client.close()
        (answer,) = await lines(served)
        assert (answer["device"], answer["crc"]) == ("Image", True)

    run(scene)


def test_the_c_librarys_questions_are_answered(peer: Path) -> None:
    async def scene() -> None:
        link = Link(Inbox(), lambda: Status(text="ready"))
        port = await link.serve("127.0.0.1", 0)
        (status,) = await lines(await start(peer, "ask", "127.0.0.1", port, "GET_STATUS"))
        assert (status["code"], status["text"], status["crc"]) == (1, "ready", True)
        process = await start(peer, "ask", "127.0.0.1", port, "GET_CAPABIL")
        process_lines = asyncio.create_task(lines(process))
        await until(lambda: bool(link.peers) and link.peers[-1].sent > 0)
        await asyncio.sleep(0.1)
        await link.close()  # it waits for a CAPABIL that the protocol calls CAPABILITY
        (capability,) = await process_lines
        assert capability["crc"] is True
        assert {"TRANSFORM", "IMAGE", "COMMAND"} <= set(capability["types"])  # type: ignore[call-overload]

    run(scene)


def test_the_example_receiver_prints_our_stream(example: Callable[[str], Path]) -> None:
    async def scene() -> None:
        program = example("Receiver/ReceiveClient.cxx")
        link = Link(Inbox())
        port = await link.serve("127.0.0.1", 0)
        for message in (SENT[0], SENT[2], SENT[4]):
            link.publish(message)
        process = await start(program, "127.0.0.1", port)
        await until(lambda: bool(link.peers) and link.peers[0].sent == 3)
        await asyncio.sleep(0.2)
        await link.close()
        printed, text = (stream.decode() for stream in await process.communicate())
        assert "Dimensions            : (320, 240, 1)" in text
        assert "Spacing               : (0.2, 0.3, 1)" in text
        numbers = [float(n) for n in re.findall(r"-?\d+(?:\.\d+)?", printed)]
        np.testing.assert_array_equal(np.reshape(numbers, (4, 4)), RIGID)
        assert "Status    : needle 0.4 mm out of plane" in text

    run(scene)


def test_the_example_tracker_client_is_followed(example: Callable[[str], Path]) -> None:
    async def scene() -> None:
        inbox = Inbox()
        link = Link(inbox)
        port = await link.serve("127.0.0.1", 0)
        process = await start(example("Tracker/TrackerClient.cxx"), "127.0.0.1", port, 200)
        await until(lambda: len(inbox) >= 20)
        process.kill()
        await until(lambda: not link.peers)
        await link.close()
        # it circles with a radius of 50 mm and turns as it goes
        for message in inbox:
            assert isinstance(message.content, Transform)
            rotation, position = message.content.matrix[:3, :3], message.content.matrix[:3, 3]
            assert np.hypot(*position[:2]) == pytest.approx(50, rel=1e-5)
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
        assert len({m.content.matrix.tobytes() for m in inbox if isinstance(m.content, Transform)}) == len(
            inbox
        )

    run(scene)


def test_the_example_image_server_is_seen(example: Callable[[str], Path]) -> None:
    async def scene() -> None:
        program, there, inbox = example("Imager/ImagerServer.cxx"), free_port(), Inbox()
        process = await start(program, there, 100, EXAMPLES / "Imager" / "img")
        link = Link(inbox, limits=LinkLimits(retry=0.05))
        link.connect("127.0.0.1", there)
        await until(lambda: len(inbox) >= 5)
        process.kill()
        await link.close()
        for i, message in enumerate(inbox[:5]):
            raw = (EXAMPLES / "Imager" / "img" / f"igtlTestImage{i + 1}.raw").read_bytes()
            assert isinstance(message.content, Image)
            assert message.content.size == (256, 256, 1)
            np.testing.assert_array_equal(
                message.content.voxels.ravel(), np.frombuffer(raw, np.uint8)[: 256 * 256]
            )
            np.testing.assert_allclose(
                np.linalg.norm(message.content.matrix[:3, :3], axis=0), [1, 1, 5], rtol=1e-5
            )

    run(scene)


def test_pyigtl_gets_images_and_drives_the_needle_while_another_peer_listens() -> None:
    pyigtl = pytest.importorskip("pyigtl", reason="pyigtl, the second peer, is not installed")
    inbox = Inbox()
    port = free_port()
    ready, stop = threading.Event(), threading.Event()

    async def serve() -> None:
        link = Link(inbox)
        await link.serve("127.0.0.1", port)
        link.publish(
            Message(Image(PICTURE, MATRIX), "Image", 12.25, metadata={"UltrasoundImageOrientation": "MF"})
        )
        ready.set()
        while not stop.is_set():
            await asyncio.sleep(0.005)
        await link.close()

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    first = second = None
    try:
        assert ready.wait(30)
        first, second = (pyigtl.OpenIGTLinkClient("127.0.0.1", port) for _ in range(2))
        for peer in (first, second):
            image = peer.wait_for_message("Image", timeout=20)
            np.testing.assert_array_equal(image.image, PICTURE)
            np.testing.assert_allclose(image.ijk_to_world_matrix, MATRIX, atol=1e-4)
            assert (image.world_coordinate_system, image.timestamp) == ("ras", 12.25)
        first.send_message(pyigtl.TransformMessage(RIGID, device_name="NeedleTipToReference"), wait=True)
        second.send_message(pyigtl.StringMessage("start", device_name="Command"), wait=True)
        while len(inbox) < 2:
            assert thread.is_alive()
            stop.wait(0.01)
        transform, string = inbox.of("NeedleTipToReference"), inbox.of("Command")
        assert transform is not None
        assert isinstance(transform.content, Transform)
        np.testing.assert_array_equal(transform.content.matrix, RIGID)
        assert string is not None
        assert string.content == String("start")
    finally:
        stop.set()
        for peer in (first, second):
            if peer is not None:
                peer.stop()
        thread.join(30)


def test_capability_is_read_by_our_own_client() -> None:
    async def scene() -> None:
        server, inbox = Link(Inbox()), Inbox()
        port = await server.serve("127.0.0.1", 0)
        client = Link(inbox)
        client.connect("127.0.0.1", port)
        await until(lambda: bool(client.peers))
        client.publish(Message(Request("GET_CAPABIL"), "anyone"))
        await until(lambda: bool(inbox))
        assert isinstance(inbox[0].content, Capability)
        await client.close()
        await server.close()

    run(scene)
