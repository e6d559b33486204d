"""One connection: its stream of bytes, the messages that wait for it, and the reason of its end."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from echospline.errors import InputError, ProtocolError
from echospline.openigtlink.decoder import Decoder
from echospline.openigtlink.message import Message, Unread, encode

log = logging.getLogger("echospline.openigtlink")

Key = tuple[str, str]
"""Type and device: of two messages with the same key only the newer is kept."""

_SLICE = 16 * 1024
"""Bytes of one peer handled before those of the others."""


@dataclass(frozen=True)
class Patience:
    """Time limits of a peer, and the amount of data that may wait for it.

    Parameters
    ----------
    partial : float
        Seconds in the middle of a message before the stream counts as truncated.
    stall : float
        Seconds without reading a byte while bytes wait before the peer counts as gone.
    lost : float
        Seconds after which the system gives up a connection whose other end no longer answers
        (keep-alive probes, unacknowledged bytes): the protocol itself has no heartbeat.
    buffer : int
        Bytes that the system may hold for the peer; a larger buffer would hold only outdated images.
    answers : int
        Answers to questions that may wait; a peer that asks and never reads is closed.
    """

    partial: float = 10.0
    stall: float = 20.0
    lost: float = 15.0
    buffer: int = 256 * 1024
    answers: int = 256


class Outgoing:
    """A message for several peers: packed once for each header version needed."""

    def __init__(self, message: Message) -> None:
        self.message = message
        self._bytes: dict[int, bytes] = {}

    @property
    def key(self) -> Key:
        """Type and device."""
        return self.message.type, self.message.device

    def packed(self, version: int) -> bytes:
        """Encode for a peer that understands header ``version``."""
        if version not in self._bytes:
            self._bytes[version] = encode(self.message, version)
        return self._bytes[version]


class Peer(asyncio.Protocol):
    """A connected program.

    A streamed message waits in one slot per type and device, where a newer message replaces an older
    one that was not sent yet: a peer that reads slowly skips messages without an effect on the others.

    Parameters
    ----------
    received : callable
        Called with (peer, message) for each message.
    left : callable
        Called with (peer, reason) once, when the connection ends.
    joined : callable
        Called with the peer when the connection is made.
    patience : Patience
        Its limits.
    """

    def __init__(
        self,
        joined: Callable[[Peer], None],
        received: Callable[[Peer, Message], None],
        left: Callable[[Peer, str], None],
        patience: Patience,
    ) -> None:
        self._joined, self._received, self._left = joined, received, left
        self._patience = patience
        self.name = "?"
        self.version = 1
        """Header version sent to it: 1 until it sends version 2."""
        self.muted: set[str] = set()
        """Types that it asked not to receive (STP_)."""
        self.started: dict[str, float] = {}
        """Types that it asked to receive (STT_), with the shortest time between two messages, s."""
        self._due: dict[Key, float] = {}
        self.sends: set[Key] = set()
        """Type and device of the messages that it sends."""
        self.messages = 0
        """Messages received."""
        self.sent = 0
        """Messages handed to the system for sending."""
        self.skipped = 0
        """Messages that a newer one replaced before they were sent."""
        self._decoder = Decoder()
        self._pending = bytearray()
        self._working = False
        self._answers: deque[Outgoing] = deque()
        self._slots: dict[Key, Outgoing] = {}
        self._writable = True
        self._transport: asyncio.Transport | None = None
        self._reason = ""
        self._complained: set[Key] = set()
        self._heard = self._moved = 0.0
        self._waiting = 0

    # ---- called by the link

    def offer(self, outgoing: Outgoing) -> None:
        """Send as soon as the peer can take it, unless a newer one of its kind comes first."""
        if outgoing.message.type in self.muted or self._transport is None:
            return
        interval = self.started.get(outgoing.message.type, 0.0)
        if interval > 0.0:
            now = asyncio.get_running_loop().time()
            if now < self._due.get(outgoing.key, 0.0):
                return
            self._due[outgoing.key] = now + interval
        if outgoing.key in self._slots:
            self.skipped += 1
        self._slots[outgoing.key] = outgoing
        self._flush()

    def answer(self, message: Message) -> None:
        """Send this message, even if newer ones follow."""
        if len(self._answers) >= self._patience.answers:
            self.close(f"it asked {len(self._answers)} questions and read no answer")
            return
        self._answers.append(Outgoing(message))
        self._flush()

    def close(self, reason: str, *, politely: bool = False) -> None:
        """End the connection; ``politely`` sends waiting messages first."""
        if self._transport is None:
            return
        self._reason = self._reason or reason
        if politely:
            self._transport.close()
        else:
            self._transport.abort()

    def check(self, now: float) -> None:
        """Close the connection if the peer has done nothing for too long (called every second or so)."""
        if self._transport is None:
            return
        if self._decoder.waiting_for and now - self._heard > self._patience.partial:
            self.close(
                f"truncated: {self._patience.partial:g} s without the rest of {self._decoder.waiting_for}"
            )
        waiting = self._transport.get_write_buffer_size()
        if waiting == 0 or waiting != self._waiting:
            self._waiting, self._moved = waiting, now
        elif now - self._moved > self._patience.stall:
            self.close(f"stalled: it took no byte for {self._patience.stall:g} s while {waiting} waited")

    # ---- called by asyncio

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Set up the connection."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        # above one byte the transport pauses writing: the newest message then waits in its slot, not in a queue
        transport.set_write_buffer_limits(high=0)
        self._set_socket(transport.get_extra_info("socket"))
        host, port, *_ = transport.get_extra_info("peername") or ("?", 0)
        self.name = f"{host}:{port}"
        self._heard = self._moved = asyncio.get_running_loop().time()
        self._joined(self)

    def _set_socket(self, connection: socket.socket) -> None:
        p = self._patience
        options = [
            (socket.SOL_SOCKET, "SO_KEEPALIVE", 1),
            (socket.SOL_SOCKET, "SO_SNDBUF", p.buffer // 2),  # Linux counts the number twice
            (socket.IPPROTO_TCP, "TCP_NODELAY", 1),
            (socket.IPPROTO_TCP, "TCP_KEEPIDLE", max(1, round(p.lost / 3))),
            (socket.IPPROTO_TCP, "TCP_KEEPINTVL", max(1, round(p.lost / 6))),
            (socket.IPPROTO_TCP, "TCP_KEEPCNT", 4),
            (socket.IPPROTO_TCP, "TCP_USER_TIMEOUT", round(p.lost * 1000)),
        ]
        for level, name, value in options:
            if hasattr(socket, name):  # some systems lack some of these options
                connection.setsockopt(level, getattr(socket, name), value)

    def data_received(self, data: bytes) -> None:
        """Decode bytes received."""
        self._heard = asyncio.get_running_loop().time()
        self._pending += data
        if not self._working:
            self._work()

    def _work(self) -> None:
        self._working = False
        if self._transport is None or self._transport.is_closing():
            return
        piece = bytes(self._pending[:_SLICE])
        del self._pending[:_SLICE]
        try:
            messages, fault = self._decoder.feed(piece), None
        except ProtocolError as error:
            messages, fault = self._decoder.complete, error
        for message in messages:
            self._take(message)
        if fault is not None:
            self.close(str(fault))
        elif self._pending:
            self._working = True
            self._transport.pause_reading()
            asyncio.get_running_loop().call_soon(self._work)
        elif not self._transport.is_closing():
            self._transport.resume_reading()

    def _take(self, message: Message) -> None:
        self.messages += 1
        self.version = max(self.version, min(message.version, 2))
        content = message.content
        if isinstance(content, Unread):
            self._log_once(message, "passed over", content.reason or "echospline does not know this type")
            return
        if len(self.sends) < 1000:
            self.sends.add((message.type, message.device))
        try:
            self._received(self, message)
        except InputError as error:
            self._log_once(message, "refused", str(error))

    def _log_once(self, message: Message, fate: str, reason: str) -> None:
        """Log once per reason: a tracker repeats the same fault a thousand times a second."""
        if (message.type, reason) not in self._complained and len(self._complained) < 100:
            self._complained.add((message.type, reason))
            log.warning("a %s of %s from %s is %s: %s", message.type, message.device, self.name, fate, reason)

    def pause_writing(self) -> None:
        """Hold further messages: the system has no room."""
        self._writable = False

    def resume_writing(self) -> None:
        """Resume sending."""
        self._writable = True
        self._flush()

    def _flush(self) -> None:
        transport = self._transport
        while transport is not None and self._writable and not transport.is_closing():
            if self._answers:
                outgoing = self._answers.popleft()
            elif self._slots:
                outgoing = self._slots.pop(next(iter(self._slots)))
            else:
                return
            self.sent += 1
            transport.write(outgoing.packed(self.version))

    def eof_received(self) -> bool:
        """Close the connection: the other end sends nothing more."""
        unfinished = self._decoder.waiting_for
        self._reason = self._reason or (
            f"it closed in the middle of {unfinished}" if unfinished else "it closed the connection"
        )
        return False

    def connection_lost(self, exc: Exception | None) -> None:
        """Report the end of the connection."""
        self._transport = None
        self._slots.clear()
        self._answers.clear()
        self._pending.clear()
        self._left(self, self._reason or (str(exc) if exc else "closed"))
