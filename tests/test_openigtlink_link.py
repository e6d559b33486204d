"""The link on loopback: many peers, slow peers, hostile peers, and peers that go without a word."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest

from echospline.errors import InputError
from echospline.openigtlink import Link, LinkLimits, Message, Status, String, Transform
from echospline.openigtlink.decoder import Decoder
from echospline.openigtlink.header import Header
from echospline.openigtlink.image import Image
from echospline.openigtlink.message import Request, encode
from echospline.openigtlink.peer import Patience, Peer
from echospline.openigtlink.text import NOT_FOUND, Capability

GOLDEN = {
    p.stem: p.read_bytes() for p in sorted((Path(__file__).parent / "openigtlink" / "golden").glob("*.bin"))
}
MINUTE = 60.0


def run(scene: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(scene(), MINUTE))


async def until(true: Callable[[], bool]) -> None:
    while not true():
        await asyncio.sleep(0.002)


class Inbox:
    """Collects what a link receives."""

    def __init__(self) -> None:
        self.messages: list[Message] = []

    def __call__(self, peer: Peer, message: Message) -> None:
        self.messages.append(message)


class Client:
    """A plain socket with a decoder."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer, self._decoder = reader, writer, Decoder()
        self._ready: list[Message] = []

    def send(self, *messages: Message | bytes) -> None:
        for message in messages:
            self.writer.write(message if isinstance(message, bytes) else encode(message))

    async def next(self) -> Message:
        while not self._ready:
            data = await self.reader.read(1 << 20)
            if not data:
                raise EOFError
            self._ready += self._decoder.feed(data)
        return self._ready.pop(0)

    async def ends(self) -> bool:
        """Read to the end of the stream."""
        try:
            while True:
                await self.next()
        except (EOFError, ConnectionError):
            return True


@asynccontextmanager
async def serving(limits: LinkLimits | None = None) -> AsyncIterator[tuple[Link, int, Inbox]]:
    inbox = Inbox()
    link = Link(inbox, lambda: Status(text="at your service"), limits)
    port = await link.serve("127.0.0.1", 0)
    try:
        yield link, port, inbox
    finally:
        await link.close()


async def client(port: int, receive_buffer: int | None = None) -> Client:
    connection = socket.socket()
    if receive_buffer:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
    connection.setblocking(False)
    await asyncio.get_running_loop().sock_connect(connection, ("127.0.0.1", port))
    return Client(*await asyncio.open_connection(sock=connection))


def picture(level: int, side: int = 512) -> Message:
    return Message(Image(np.full((1, side, side), level, np.uint8), np.eye(4)), "Image", float(level))


def test_messages_go_both_ways_among_several_peers() -> None:
    async def scene() -> None:
        async with serving() as (link, port, inbox):
            first, second = await client(port), await client(port)
            await until(lambda: len(link.peers) == 2)
            link.publish(picture(7))
            for one in (first, second):
                message = await one.next()
                assert isinstance(message.content, Image)
                assert message.content.voxels[0, 3, 4] == 7
            first.send(GOLDEN["NeedleToReference"])
            second.send(GOLDEN["String"])
            await until(lambda: len(inbox.messages) == 2)
            assert {m.device for m in inbox.messages} == {"NeedleToReference", "String"}
            first.writer.close()
            await until(lambda: len(link.peers) == 1)
            link.publish(picture(8))
            assert (await second.next()).timestamp == 8

    run(scene)


def test_who_joins_late_sees_the_newest_of_each_device() -> None:
    async def scene() -> None:
        async with serving() as (link, port, _):
            for level in range(5):
                link.publish(picture(level, 8))
            link.publish(Message(Transform(np.eye(4)), "ImageToReference", 4.0))
            late = await client(port)
            got = [await late.next(), await late.next()]
            assert [(m.device, m.timestamp) for m in got] == [("Image", 4.0), ("ImageToReference", 4.0)]

    run(scene)


def test_a_peer_that_does_not_read_delays_nobody_and_gets_the_newest_when_it_does() -> None:
    async def scene() -> None:
        async with serving() as (link, port, _):
            slow, quick = await client(port, 65536), await client(port)
            await until(lambda: len(link.peers) == 2)
            frames = 100
            for level in range(frames):
                link.publish(picture(level))
                assert (await quick.next()).timestamp == level  # it gets every single one
            assert [p.skipped > frames // 2 for p in link.peers].count(True) == 1
            stale = []
            while not stale or stale[-1] != frames - 1:
                stale.append((await slow.next()).timestamp)
            # what the kernel's buffers held, then the newest at once: nobody kept a queue of a hundred
            assert len(stale) < 10
            assert stale == sorted(stale)

    run(scene)


def test_what_waits_for_a_slow_peer_waits_in_its_slot_not_in_a_queue() -> None:
    async def scene() -> None:
        async with serving(LinkLimits(patience=Patience(buffer=8192))) as (link, port, _):
            slow = await client(port, 4096)
            await until(lambda: len(link.peers) == 1)
            for level in range(200):
                link.publish(picture(level, 64))
            (peer,) = link.peers
            assert peer._transport is not None
            assert peer._transport.get_write_buffer_size() <= len(encode(picture(0, 64)))
            assert peer.skipped > 100
            slow.writer.close()

    run(scene)


def test_a_burst_before_a_silence_is_received_whole() -> None:
    async def scene() -> None:
        async with serving() as (_, port, inbox):
            peer = await client(port)
            peer.send(picture(5), *[GOLDEN["Status"]] * 100)
            await until(lambda: len(inbox.messages) == 101)
            content = inbox.messages[0].content
            assert isinstance(content, Image)
            assert (content.voxels == 5).all()

    run(scene)


def test_a_flood_of_messages_from_one_peer_leaves_room_for_another() -> None:
    async def scene() -> None:
        async with serving() as (link, port, inbox):
            loud, quiet = await client(port), await client(port)
            await until(lambda: len(link.peers) == 2)
            loud.send(GOLDEN["NeedleToReference"] * 40_000)
            quiet.send(GOLDEN["String"])
            await until(lambda: any(m.device == "String" for m in inbox.messages))
            assert len(inbox.messages) < 20_000  # it did not wait for the whole flood
            loud.writer.close()

    run(scene)


@pytest.mark.parametrize(
    ("bytes_sent", "reason"),
    [
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" + bytes(60), "not OpenIGTLink"),
        (GOLDEN["Status"][:-1] + b"X", "check sum"),
        (Header(1, "IMAGE", "Huge", 0.0, 2**63, 0).pack(), "announces 9223372036854775808 bytes"),
        (b"\xff" * 1000, "header version"),
    ],
    ids=["web browser", "wrong check sum", "huge announcement", "noise"],
)
def test_a_hostile_stream_is_closed_with_a_logged_reason_and_the_others_lose_nothing(
    bytes_sent: bytes, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="echospline.openigtlink")

    async def scene() -> None:
        async with serving() as (link, port, inbox):
            good, bad = await client(port), await client(port)
            await until(lambda: len(link.peers) == 2)
            bad.send(GOLDEN["String"], bytes_sent)
            assert await bad.ends()
            await until(lambda: len(link.peers) == 1)
            assert reason in link.departures[-1][1]
            assert reason in caplog.text
            assert [m.device for m in inbox.messages] == ["String"]  # what came before the fault counts
            link.publish(picture(3))
            assert (await good.next()).timestamp == 3
            good.send(GOLDEN["NeedleToReference"])
            await until(lambda: inbox.messages[-1].device == "NeedleToReference")

    run(scene)


def test_a_malformed_content_is_passed_over_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    async def scene() -> None:
        async with serving() as (_, port, inbox):
            peer = await client(port)
            peer.send(*[Message(Request("TRANSFORM", b"short"), "Broken")] * 50, GOLDEN["String"])
            await until(lambda: bool(inbox.messages))
            assert [m.device for m in inbox.messages] == ["String"]

    run(scene)
    assert caplog.text.count("passed over: a TRANSFORM has 48 bytes; got 5") == 1


def test_a_stream_that_ends_inside_a_message_says_so() -> None:
    async def scene() -> None:
        async with serving() as (link, port, inbox):
            peer = await client(port)
            peer.send(GOLDEN["Status"], GOLDEN["Point"][:200])
            await peer.writer.drain()
            peer.writer.close()
            await until(lambda: bool(link.departures))
            assert "in the middle of POINT: 142 of 272 bytes" in link.departures[0][1]
            assert [m.device for m in inbox.messages] == ["Status"]

    run(scene)


def test_a_peer_silent_inside_a_message_is_closed_as_truncated() -> None:
    async def scene() -> None:
        async with serving(LinkLimits(patience=Patience(partial=0.2))) as (link, port, _):
            idle, stuck = await client(port), await client(port)
            stuck.send(GOLDEN["Point"][:100])
            assert await stuck.ends()
            assert "truncated" in link.departures[0][1]
            assert len(link.peers) == 1  # silence between messages is no fault: Slicer sends on change only
            idle.writer.close()

    run(scene)


def test_a_peer_that_takes_nothing_for_too_long_is_closed_as_stalled() -> None:
    async def scene() -> None:
        async with serving(LinkLimits(patience=Patience(stall=0.3))) as (link, port, _):
            dead = await client(port, 4096)
            await until(lambda: len(link.peers) == 1)
            for level in range(60):
                link.publish(picture(level % 250, 1024))
                await asyncio.sleep(0.005)
            await until(lambda: bool(link.departures))
            assert "stalled" in link.departures[0][1]
            dead.writer.close()

    run(scene)


def test_the_system_is_told_to_find_half_open_connections() -> None:
    async def scene() -> None:
        async with serving(LinkLimits(patience=Patience(lost=12.0))) as (link, port, _):
            peer = await client(port)
            await until(lambda: len(link.peers) == 1)
            assert link.peers[0]._transport is not None
            connection = link.peers[0]._transport.get_extra_info("socket")
            assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
            if hasattr(socket, "TCP_USER_TIMEOUT"):
                assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 12_000
                idle = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE)
                interval = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL)
                assert idle + 4 * interval <= 12
            peer.writer.close()

    run(scene)


@pytest.mark.parametrize("talking", [False, True], ids=["while nothing is said", "while images go out"])
def test_a_peer_that_vanishes_without_a_word_is_found(talking: bool) -> None:
    """As when its machine is switched off and on: no FIN, no RST, until keep-alive or an image finds nobody there."""

    async def scene() -> None:
        async with serving(LinkLimits(patience=Patience(lost=3.0))) as (link, port, _):
            gone, stays = await client(port), await client(port)
            await until(lambda: len(link.peers) == 2)
            connection = gone.writer.get_extra_info("socket")
            repair = 19  # TCP_REPAIR of linux/tcp.h: a socket in repair closes in silence
            try:
                connection.setsockopt(socket.IPPROTO_TCP, repair, 1)
            except OSError as error:
                pytest.skip(
                    f"a socket cannot be made to vanish here: {error.strerror} (it takes CAP_NET_ADMIN)"
                )
            gone.writer.transport.abort()
            await asyncio.sleep(0.2)
            assert len(link.peers) == 2  # nobody has noticed yet: it was silent indeed
            if talking:
                link.publish(picture(1))
            await until(lambda: len(link.peers) == 1)
            link.publish(picture(2))
            while (await stays.next()).timestamp != 2:
                pass

    run(scene)


def test_questions_are_answered() -> None:
    async def scene() -> None:
        async with serving() as (link, port, inbox):
            link.publish(picture(9, 8))
            peer = await client(port)
            await peer.next()
            peer.send(
                *(
                    Message(Request(t), "Image")
                    for t in ("GET_STATUS", "GET_CAPABIL", "GET_IMAGE", "GET_POINT")
                )
            )
            status, capability, image, nothing = [await peer.next() for _ in range(4)]
            assert status.content == Status(text="at your service")
            assert isinstance(capability.content, Capability)
            assert {"IMAGE", "TRANSFORM", "GET_STATUS"} <= set(capability.content.types)
            assert (image.type, image.timestamp) == ("IMAGE", 9)
            assert isinstance(nothing.content, Status)
            assert nothing.content.code == NOT_FOUND
            assert inbox.messages == []

    run(scene)


def test_a_stream_stops_and_starts_on_request() -> None:
    async def scene() -> None:
        async with serving() as (link, port, _):
            link.publish(picture(1, 8))
            peer = await client(port)
            await peer.next()
            peer.send(Message(Request("STP_IMAGE"), "Image"))
            assert (await peer.next()).content == Request("RTS_IMAGE", b"\0")
            link.publish(picture(2, 8))
            peer.send(Message(Request("STT_IMAGE"), "Image"))
            assert (await peer.next()).content == Request("RTS_IMAGE", b"\0")
            link.publish(picture(3, 8))
            assert (await peer.next()).timestamp == 3
            peer.send(Message(Request("STT_VIDEO"), "Image"))
            assert (await peer.next()).content == Request("RTS_VIDEO", b"\1")

    run(scene)


def test_header_version_1_is_spoken_until_the_peer_shows_2() -> None:
    async def scene() -> None:
        async with serving() as (link, port, inbox):
            old, new = await client(port), await client(port)
            await until(lambda: len(link.peers) == 2)
            new.send(Message(String("hello"), version=2))
            await until(lambda: bool(inbox.messages))
            link.publish(Message(Status(), "echospline", metadata={"UltrasoundImageOrientation": "MF"}))
            first, second = await old.next(), await new.next()
            assert (first.version, first.metadata) == (1, {})
            assert (second.version, second.metadata) == (2, {"UltrasoundImageOrientation": "MF"})

    run(scene)


def test_a_peer_does_not_get_its_own_words_back() -> None:
    async def scene() -> None:
        async with serving() as (link, port, inbox):
            tracker, display = await client(port), await client(port)
            tracker.send(Message(Transform(np.eye(4)), "NeedleTipToReference", 1.0))
            await until(lambda: bool(inbox.messages) and len(link.peers) == 2)
            link.publish(Message(Transform(np.eye(4)), "NeedleTipToReference", 2.0))
            link.publish(Message(Status(), "echospline", 3.0))
            assert (await display.next()).timestamp == 2
            assert (await tracker.next()).timestamp == 3

    run(scene)


def test_a_peer_that_asks_without_reading_is_closed() -> None:
    async def scene() -> None:
        limits = LinkLimits(patience=Patience(answers=50, buffer=8192))
        async with serving(limits) as (link, port, _):
            link.publish(picture(1, 1024))
            rude = await client(port, 4096)
            await until(lambda: len(link.peers) == 1)
            rude.send(*[Message(Request("GET_IMAGE"))] * 200)
            await until(lambda: bool(link.departures))
            assert "read no answer" in link.departures[0][1]
            rude.writer.close()

    run(scene)


def test_peers_beyond_the_limit_are_refused() -> None:
    async def scene() -> None:
        async with serving(LinkLimits(peers=2)) as (link, port, _):
            first, second = await client(port), await client(port)
            await until(lambda: len(link.peers) == 2)
            third = await client(port)
            assert await third.ends()
            assert "refused" in link.departures[0][1]
            link.publish(picture(1, 8))
            await first.next()
            await second.next()

    run(scene)


def test_a_client_connects_waits_for_its_server_and_returns_after_it_was_lost() -> None:
    async def scene() -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        inbox = Inbox()
        ours = Link(inbox, limits=LinkLimits(retry=0.05))
        ours.connect("127.0.0.1", port)  # nobody is there yet
        await asyncio.sleep(0.15)
        for visit in range(2):
            theirs = Link(Inbox())
            await theirs.serve("127.0.0.1", port)
            theirs.publish(Message(Transform(np.eye(4)), "NeedleTipToReference", float(visit)))
            await until(lambda n=visit: len(inbox.messages) > n)
            await theirs.close()
        assert [m.timestamp for m in inbox.messages] == [0, 1]
        await ours.close()

    run(scene)


def test_a_port_in_use_is_an_input_error() -> None:
    async def scene() -> None:
        async with serving() as (_, port, _inbox):
            other = Link(Inbox())
            with pytest.raises(InputError, match=f"cannot listen on 127.0.0.1:{port}"):
                await other.serve("127.0.0.1", port)
            await other.close()

    run(scene)
