"""Decoder of one stream: bytes in pieces of any size in, messages out."""

from __future__ import annotations

from collections.abc import Mapping

from echospline.errors import ProtocolError
from echospline.openigtlink.header import HEADER_SIZE, Header
from echospline.openigtlink.message import Message, decode

BOUNDS = {"IMAGE": 64 * 2**20, "NDARRAY": 64 * 2**20, "POLYDATA": 4 * 2**20}
"""Bytes that the body of a type may have: an image volume of 400 x 400 x 400 bytes, a mesh of 100 000 points."""
BOUND = 2**20
"""Bytes that the body of any other type may have."""


class Decoder:
    """Splits a stream into messages.

    The size that a header announces is checked before its body is read; memory grows with the
    bytes received, never with the size announced. After a `ProtocolError` the position in the stream is lost and
    every further call raises again.
    """

    def __init__(self, bounds: Mapping[str, int] = BOUNDS, bound: int = BOUND) -> None:
        self.complete: list[Message] = []
        self._bounds, self._bound = bounds, bound
        self._buffer = bytearray()
        self._header: Header | None = None
        self._broken: ProtocolError | None = None

    @property
    def waiting_for(self) -> str:
        """Description of the incomplete message; empty between messages."""
        if self._header is not None:
            return f"{self._header.type}: {len(self._buffer)} of {self._header.body_size} bytes"
        return f"a header: {len(self._buffer)} of {HEADER_SIZE} bytes" if self._buffer else ""

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages that ``data`` completes, in order.

        Raises
        ------
        ProtocolError
            If the stream is not OpenIGTLink; `complete` holds the messages before the fault.
        """
        if self._broken is not None:
            raise self._broken
        self._buffer += data
        self.complete = []
        try:
            while (message := self._next()) is not None:
                self.complete.append(message)
        except ProtocolError as error:
            self._broken = error
            self._buffer.clear()
            raise
        return self.complete

    def _next(self) -> Message | None:
        if self._header is None:
            if len(self._buffer) < HEADER_SIZE:
                return None
            header = Header.unpack(self._buffer)
            bound = self._bounds.get(header.type, self._bound)
            if header.body_size > bound:
                raise ProtocolError(
                    f"a {header.type} from {header.device!r} announces {header.body_size} bytes; at most {bound} are taken"
                )
            self._header = header
            del self._buffer[:HEADER_SIZE]
        if len(self._buffer) < self._header.body_size:
            return None
        body = bytes(memoryview(self._buffer)[: self._header.body_size])
        del self._buffer[: self._header.body_size]
        header, self._header = self._header, None
        return decode(header, body)
