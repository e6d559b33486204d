"""A message: content, device and time, with conversion to bytes and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

from echospline.errors import InputError, ProtocolError
from echospline.openigtlink.crc64 import crc64
from echospline.openigtlink.header import Header
from echospline.openigtlink.image import Image
from echospline.openigtlink.metadata import unwrap, wrap
from echospline.openigtlink.ndarray import NDArrayMessage
from echospline.openigtlink.polydata import Points, PolyData
from echospline.openigtlink.pose import Position, QuaternionTransform, Transform
from echospline.openigtlink.text import Capability, CommandMessage, CommandReply, Status, String
from echospline.openigtlink.tools import QuaternionTrackingData, TrackingData

PREFIXES = ("GET_", "STT_", "STP_", "RTS_")
"""A question, the start and the end of a stream, and the answer to these."""


class Content(Protocol):
    """Interface of every kind of message."""

    @property
    def TYPE(self) -> str:
        """Its name in the header."""
        ...

    def pack(self) -> bytes:
        """Pack the bytes between the headers."""
        ...


@dataclass(frozen=True)
class Request:
    """GET_, STT_, STP_ (and RTS_) of any type; its content depends on the type and is kept as bytes."""

    type: str
    body: bytes = b""

    @property
    def TYPE(self) -> str:
        """Its name in the header, ``GET_STATUS``."""
        return self.type

    def pack(self) -> bytes:
        """Return the bytes unchanged."""
        return self.body


@dataclass(frozen=True)
class Unread:
    """A message of an unknown type, or one whose content is invalid."""

    type: str
    size: int
    reason: str = ""

    @property
    def TYPE(self) -> str:
        """Its name in the header."""
        return self.type

    def pack(self) -> bytes:
        """Raise: a message that was not read cannot be sent."""
        raise InputError(f"a {self.type} that was not read cannot be sent on")


class _Readable(Protocol):
    TYPE: ClassVar[str]

    @classmethod
    def unpack(cls, content: memoryview) -> Content: ...


READABLE: tuple[type[_Readable], ...] = (
    Transform, Position, QuaternionTransform, TrackingData, QuaternionTrackingData, Image, Status, String,
    CommandMessage, CommandReply, Points, PolyData, NDArrayMessage, Capability,
)  # fmt: skip
_READERS = {kind.TYPE: kind for kind in READABLE}


@dataclass(frozen=True)
class Message:
    """Content with its envelope.

    Parameters
    ----------
    content : Content
        Content of the message.
    device : str
        The device or object that it describes; for a transform its name (``NeedleToReference``).
    timestamp : float
        Seconds since 1970 at which it was true; 0 if unknown.
    version : int
        Header version 1 to 3; metadata and message id need 2.
    metadata : mapping of str to str
        Free texts.
    message_id : int
        The sender's number.
    """

    content: Content
    device: str = ""
    timestamp: float = 0.0
    version: int = 1
    metadata: Mapping[str, str] = field(default_factory=dict)
    message_id: int = 0

    @property
    def type(self) -> str:
        """Name of the kind of message."""
        return self.content.TYPE


def encode(message: Message, version: int | None = None) -> bytes:
    """Encode a message as bytes.

    Parameters
    ----------
    message : Message
        The message.
    version : int, optional
        Header version instead of the message's own: version 1, which old peers need, drops the metadata,
        for which it has no room.
    """
    version = message.version if version is None else version
    content = message.content.pack()
    body = content if version == 1 else wrap(content, message.metadata, message.message_id)
    header = Header(version, message.type, message.device, message.timestamp, len(body), crc64(body))
    return header.pack() + body


def decode(header: Header, body: bytes) -> Message:
    """Decode a message from its header and whole body.

    An invalid content becomes `Unread`, with the reason: the stream itself is sound.

    Raises
    ------
    ProtocolError
        If the check sum is wrong: nothing that follows is reliable.
    """
    if (actual := crc64(body)) != header.crc:
        raise ProtocolError(
            f"the check sum of a {header.type} from {header.device!r} is wrong: "
            f"header {header.crc:016x}, body {actual:016x}"
        )
    content, number = memoryview(body), 0
    metadata: dict[str, str] = {}
    try:
        if header.version > 1:
            content, metadata, number = unwrap(content)
        said = _read(header.type, content)
    except ProtocolError as error:
        said = Unread(header.type, len(body), str(error))
    return Message(said, header.device, header.timestamp, header.version, metadata, number)


def _read(kind: str, content: memoryview) -> Content:
    if kind in _READERS:
        return _READERS[kind].unpack(content)
    if kind.startswith(PREFIXES):
        return Request(kind, bytes(content))
    return Unread(kind, len(content))
