"""The link: a server and clients on asyncio, many peers, the newest message of each device in and out."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from echospline.errors import InputError, ProtocolError
from echospline.openigtlink.header import PORT
from echospline.openigtlink.message import READABLE, Message, Request
from echospline.openigtlink.peer import Key, Outgoing, Patience, Peer
from echospline.openigtlink.text import NOT_FOUND, Capability, Status
from echospline.openigtlink.tools import StartTracking

log = logging.getLogger("echospline.openigtlink")

QUESTIONS = (
    "GET_STATUS",
    "GET_CAPABIL",
    "GET_IMAGE",
    "GET_TRANS",
    "GET_POINT",
    "GET_POLYDATA",
    "GET_NDARRAY",
)
ABBREVIATED = {"CAPABIL": "CAPABILITY", "TRANS": "TRANSFORM"}
"""Types are cut to 12 characters, prefix included."""


@dataclass(frozen=True)
class LinkLimits:
    """Limits of a link."""

    peers: int = 32
    """Connections at a time; more are refused."""
    retry: float = 1.0
    """Seconds between attempts to connect, in client mode."""
    patience: Patience = field(default_factory=Patience)
    """Time limits and buffer of a peer."""


class Link:
    """The connected peers and the newest message of each device, theirs and echospline's.

    All methods belong to the event loop's thread; from another use ``loop.call_soon_threadsafe``.

    Parameters
    ----------
    received : callable
        Called with (peer, message) for every message that is not answered by the link itself: it answers
        GET_STATUS, GET_CAPABILITY, other GET_ by the newest message of that type, STT_ and STP_.
    status : callable
        Returns the answer to GET_STATUS.
    limits : LinkLimits
        Its limits.
    on_request : frozenset of str
        Types that a peer receives after STT_ alone; all others it receives until STP_.
    asking : (Message, Message), optional
        Sent to a server that the link connects to, when it is connected and when the link closes: the start and the end
        of its stream.
    """

    def __init__(
        self,
        received: Callable[[Peer, Message], None],
        status: Callable[[], Status] = Status,
        limits: LinkLimits | None = None,
        on_request: frozenset[str] = frozenset(),
        asking: tuple[Message, Message] | None = None,
    ) -> None:
        self._received, self._status = received, status
        self.limits = limits or LinkLimits()
        self.peers: list[Peer] = []
        self.departures: list[tuple[str, str]] = []
        """Name and reason of the last hundred closed connections."""
        self._newest: dict[Key, Outgoing] = {}
        self._servers: list[asyncio.Server] = []
        self._tasks: list[asyncio.Task[None]] = []
        self._closing = False
        self._on_request, self._asking = on_request, asking
        self._asked: list[Peer] = []

    async def serve(self, host: str = "127.0.0.1", port: int = PORT) -> int:
        """Listen for peers; returns the port (a free one for port 0).

        Raises
        ------
        InputError
            If the address cannot be bound.
        """
        self._begin()
        loop = asyncio.get_running_loop()
        try:
            server = await loop.create_server(self._peer, host, port)
        except OSError as error:
            raise InputError(
                f"cannot listen on {host}:{port} ({error.strerror or error}); is another program there? Give another --port"
            ) from error
        self._servers.append(server)
        actual = int(server.sockets[0].getsockname()[1])
        log.info("listening on %s:%d", host, actual)
        return actual

    def connect(self, host: str, port: int = PORT) -> None:
        """Connect to a server, and again whenever the connection is lost, until `close`."""
        self._begin()
        self._tasks.append(asyncio.get_running_loop().create_task(self._stay_connected(host, port)))

    def publish(self, message: Message) -> None:
        """Send to every peer; a peer that is still busy with an older one of its kind gets the newest.

        A peer that sends this device itself is left out: it would receive its own message.
        """
        outgoing = Outgoing(message)
        self._newest[outgoing.key] = outgoing
        for peer in list(self.peers):
            if outgoing.key not in peer.sends and self._wanted(peer, outgoing):
                peer.offer(outgoing)

    def _wanted(self, peer: Peer, outgoing: Outgoing) -> bool:
        kind = outgoing.message.type
        return kind not in self._on_request or kind in peer.started

    async def close(self) -> None:
        """Close all connections."""
        self._closing = True
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for server in self._servers:
            server.close()
        for peer in list(self.peers):
            if self._asking is not None and peer in self._asked:
                peer.answer(self._asking[1])
            peer.close("echospline is closing", politely=True)
        for _ in range(20):  # a peer that does not read cannot delay the end of the program
            if not self.peers:
                return
            await asyncio.sleep(0.025)
        for peer in list(self.peers):
            peer.close("echospline is closing")
        await asyncio.sleep(0)

    # ---- peers

    def _begin(self) -> None:
        if not self._tasks:
            self._tasks.append(asyncio.get_running_loop().create_task(self._watch()))

    def _peer(self) -> Peer:
        return Peer(self._join, self._take, self._leave, self.limits.patience)

    def _join(self, peer: Peer) -> None:
        if len(self.peers) >= self.limits.peers:
            log.warning("%s is refused: %d peers are connected already", peer.name, len(self.peers))
            peer.close(f"refused: {len(self.peers)} peers are connected already")
            return
        self.peers.append(peer)
        log.info("%s joined, %d connected", peer.name, len(self.peers))
        for (
            outgoing
        ) in self._newest.values():  # a peer that joins late receives the newest messages, frozen or not
            if self._wanted(peer, outgoing):
                peer.offer(outgoing)

    def _leave(self, peer: Peer, reason: str) -> None:
        if peer in self.peers:
            self.peers.remove(peer)
        self.departures = [*self.departures[-99:], (peer.name, reason)]
        log.info(
            "%s left: %s (%d received, %d sent, %d skipped)",
            peer.name, reason, peer.messages, peer.sent, peer.skipped,
        )  # fmt: skip

    async def _watch(self) -> None:
        p = self.limits.patience
        pause = min(1.0, p.partial / 4, p.stall / 4)
        while True:
            await asyncio.sleep(pause)
            now = asyncio.get_running_loop().time()
            for peer in list(self.peers):
                peer.check(now)

    async def _stay_connected(self, host: str, port: int) -> None:
        loop = asyncio.get_running_loop()
        complained = False
        while not self._closing:
            try:
                _, peer = await loop.create_connection(self._peer, host, port)
            except OSError as error:
                if not complained:
                    log.warning("cannot reach %s:%d (%s); trying on", host, port, error.strerror or error)
                    complained = True
            else:
                complained = False
                if self._asking is not None:
                    peer.answer(self._asking[0])
                    self._asked.append(peer)
                while peer in self.peers:
                    await asyncio.sleep(min(0.1, self.limits.retry))
                self._asked = [one for one in self._asked if one is not peer]
            await asyncio.sleep(self.limits.retry)

    # ---- messages

    def _take(self, peer: Peer, message: Message) -> None:
        if isinstance(message.content, Request):
            self._answer(peer, message, message.content)
        else:
            self._received(peer, message)

    def _answer(self, peer: Peer, message: Message, request: Request) -> None:
        prefix, _, name = request.type.partition("_")
        kind = ABBREVIATED.get(name, name)
        reply = Message(Status(), message.device, time.time(), peer.version)
        if request.type == "GET_STATUS":
            peer.answer(replace(reply, content=self._status()))
        elif kind == "CAPABILITY":
            types = tuple(t.TYPE for t in READABLE)
            streams = tuple(f"{word}_{t}" for t in sorted(self._on_request) for word in ("STT", "STP"))
            peer.answer(replace(reply, content=Capability(types + QUESTIONS + streams)))
        elif prefix == "GET":
            found = [
                o for (t, device), o in self._newest.items() if t == kind and message.device in ("", device)
            ]
            for outgoing in found:
                peer.answer(outgoing.message)
            if not found:
                what = f"no {kind} of {message.device or 'any device'} is sent here"
                peer.answer(replace(reply, content=Status(NOT_FOUND, 0, "NotFound", what)))
        elif kind in self._on_request and prefix in ("STT", "STP"):
            self._stream(peer, reply, request, kind)
        elif prefix in ("STT", "STP"):
            known = any(t == kind for t, _ in self._newest)
            (peer.muted.discard if prefix == "STT" else peer.muted.add)(kind)
            # the byte of RTS_ is 0 for yes and 1 for no
            peer.answer(replace(reply, content=Request(f"RTS_{name}"[:12], b"\0" if known else b"\1")))
        elif prefix == "RTS" and request.body[:1] == b"\1":
            log.warning("%s does not start its %s", peer.name, kind)

    def _stream(self, peer: Peer, reply: Message, request: Request, kind: str) -> None:
        """Start or end a stream of this type to a peer."""
        done = True
        if request.type.startswith("STP"):
            peer.started.pop(kind, None)
        else:
            try:
                start = StartTracking.unpack(request.body) if kind.endswith("DATA") else StartTracking()
            except ProtocolError as error:
                log.warning("%s of %s is refused: %s", request.type, peer.name, error)
                done = False
            else:
                peer.started[kind] = start.resolution / 1000.0
        peer.answer(replace(reply, content=Request(f"RTS_{kind}", b"\0" if done else b"\1")))
