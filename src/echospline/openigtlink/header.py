"""The 58 bytes before every OpenIGTLink body: version, type, device, time, size and check sum of the body."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from echospline.errors import InputError, ProtocolError

PORT = 18944
"""The port of OpenIGTLink."""
HEADER_SIZE = 58
VERSIONS = (1, 2, 3)
"""Header versions read: 1 (protocols 1 and 2) has no extended header, 2 (protocol 3) and later have one."""

_HEADER = struct.Struct(">H12s20sQQQ")
_FRACTION = 1 << 32


@dataclass(frozen=True, slots=True)
class Header:
    """Header of a body.

    Parameters
    ----------
    version : int
        Header version, 1 to 3.
    type : str
        Kind of message, at most 12 ASCII characters ("TRANSFORM", "GET_STATUS").
    device : str
        Name of the device, at most 20 ASCII characters.
    timestamp : float
        Seconds since 1970; 0 when the sender has no clock.
    body_size : int
        Bytes that follow.
    crc : int
        CRC-64 of these bytes.
    """

    version: int
    type: str
    device: str
    timestamp: float
    body_size: int
    crc: int

    def pack(self) -> bytes:
        """Pack into 58 bytes, big-endian.

        Raises
        ------
        InputError
            If a name is too long or not ASCII: it would change on the way.
        """
        if not (math.isfinite(self.timestamp) and 0 <= self.timestamp < _FRACTION):
            raise InputError(
                f"a time stamp is seconds since 1970 (0 to {_FRACTION - 1}); got {self.timestamp}"
            )
        # 32 bits of seconds, 32 bits of fraction: split first, because a float cannot hold 64 bits
        seconds = int(self.timestamp)
        fraction = min(round((self.timestamp - seconds) * _FRACTION), _FRACTION - 1)
        return _HEADER.pack(
            self.version,
            pack_name(self.type, 12, "message type"),
            pack_name(self.device, 20, "device name"),
            seconds << 32 | fraction,
            self.body_size,
            self.crc,
        )

    @classmethod
    def unpack(cls, data: bytes | bytearray | memoryview) -> Header:
        """Unpack the first 58 bytes.

        Raises
        ------
        ProtocolError
            If they are not an OpenIGTLink header.
        """
        version, kind, device, stamp, size, crc = _HEADER.unpack_from(data)
        if version not in VERSIONS:
            raise ProtocolError(
                f"the stream is not OpenIGTLink: expected header version 1 to 3; got {version}"
            )
        message_type = unpack_name(kind, "message type")
        if not message_type or not message_type.replace("_", "").isalnum():
            raise ProtocolError(f"the stream is not OpenIGTLink: {message_type!r} is no message type")
        # a device may be called anything, "µ-probe" in Latin-1 as well: no reason to close the connection
        name = device.split(b"\0", 1)[0].decode("utf-8", "replace")
        timestamp = (stamp >> 32) + (stamp & (_FRACTION - 1)) / _FRACTION
        return cls(version, message_type, name, timestamp, size, crc)


def pack_name(text: str, size: int, what: str) -> bytes:
    """Encode a name as ASCII bytes that must fit ``size`` bytes (the packing pads with zeros).

    Raises
    ------
    InputError
        If it does not fit.
    """
    if not text.isascii() or "\0" in text:
        raise InputError(f"an OpenIGTLink {what} is plain ASCII; got {text!r}")
    if len(text) > size:
        raise InputError(f"an OpenIGTLink {what} has at most {size} characters; got {len(text)} in {text!r}")
    return text.encode("ascii")


def unpack_name(field: bytes, what: str) -> str:
    """Decode the text of a zero-padded ASCII field.

    Raises
    ------
    ProtocolError
        If it is not printable ASCII.
    """
    raw = bytes(field).split(b"\0", 1)[0]
    if not raw.isascii() or not (text := raw.decode("ascii").rstrip()).isprintable():
        raise ProtocolError(f"a {what} must be printable ASCII; got {raw!r}")
    return text
