"""Texts between peers: STRING, STATUS, COMMAND with its answer RTS_COMMAND, CAPABILITY."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar, Self

from echospline.errors import InputError, ProtocolError
from echospline.openigtlink.header import pack_name, unpack_name
from echospline.openigtlink.metadata import decode_text, encode_text

_STRING = struct.Struct(">HH")
_STATUS = struct.Struct(">Hq20s")
_COMMAND_NAMES = (128, 32, 20)
"""Bytes of a command's name: the C++ library 3.0, an earlier state of it, and the protocol's text."""

OK, UNKNOWN_ERROR, NOT_FOUND, UNKNOWN_INSTRUCTION, NOT_READY = 1, 2, 4, 12, 13
"""Status codes of the protocol that echospline sends."""


@dataclass(frozen=True)
class String:
    """STRING: a text."""

    TYPE: ClassVar[str] = "STRING"
    text: str

    def pack(self) -> bytes:
        """Pack character set, length and text."""
        encoding, data = encode_text(self.text)
        if len(data) > 0xFFFF:
            raise InputError(f"a STRING has at most 65535 bytes; got {len(data)}")
        return _STRING.pack(encoding, len(data)) + data

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        """Unpack a text."""
        if len(content) < _STRING.size:
            raise ProtocolError(f"a STRING has 4 bytes or more; got {len(content)}")
        encoding, length = _STRING.unpack_from(content)
        if length > len(content) - _STRING.size:
            raise ProtocolError(f"a STRING says {length} bytes and brings {len(content) - _STRING.size}")
        return cls(decode_text(content[_STRING.size : _STRING.size + length], encoding).rstrip("\0"))


@dataclass(frozen=True)
class Status:
    """STATUS: a code (1 is OK), a sub-code, the name of the error and a text."""

    TYPE: ClassVar[str] = "STATUS"
    code: int = OK
    subcode: int = 0
    error: str = ""
    text: str = ""

    def pack(self) -> bytes:
        """Pack 30 bytes and the text, ended by a zero as C programs expect."""
        head = _STATUS.pack(self.code, self.subcode, pack_name(self.error, 20, "error name"))
        return head + self.text.encode("utf-8") + b"\0"

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        """Unpack a status."""
        if len(content) < _STATUS.size:
            raise ProtocolError(f"a STATUS has 30 bytes or more; got {len(content)}")
        code, subcode, error = _STATUS.unpack_from(content)
        text = bytes(content[_STATUS.size :]).split(b"\0", 1)[0].decode("utf-8", "replace")
        return cls(code, subcode, unpack_name(error, "error name"), text)


@dataclass(frozen=True)
class CommandMessage:
    """COMMAND: a numbered order; its text is free, Slicer and PLUS write XML."""

    TYPE: ClassVar[str] = "COMMAND"
    id: int
    name: str
    text: str = ""

    def pack(self) -> bytes:
        """Pack number, name in 128 bytes, character set, length and text."""
        encoding, data = encode_text(self.text)
        name = pack_name(self.name, 127, "command name")
        return struct.pack(">I128sHI", self.id, name, encoding, len(data)) + data

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        """Unpack a command; the width of the name is the one that fits the length."""
        for width in _COMMAND_NAMES:
            layout = struct.Struct(f">I{width}sHI")
            if len(content) < layout.size:
                continue
            number, name, encoding, length = layout.unpack_from(content)
            if layout.size + length == len(content):
                text = decode_text(content[layout.size :], encoding).rstrip("\0")
                return cls(number, unpack_name(name, "command name"), text)
        raise ProtocolError(f"a {cls.TYPE} of {len(content)} bytes has no length that fits its text")


@dataclass(frozen=True)
class CommandReply(CommandMessage):
    """RTS_COMMAND: the answer to the `CommandMessage` of the same number; its name is the error's, empty if none."""

    TYPE: ClassVar[str] = "RTS_COMMAND"


@dataclass(frozen=True)
class Capability:
    """CAPABILITY: the types of messages that a peer understands."""

    TYPE: ClassVar[str] = "CAPABILITY"
    types: tuple[str, ...]

    def pack(self) -> bytes:
        """Pack 12 bytes for each name; the body size gives their number."""
        return b"".join(pack_name(t, 12, "message type").ljust(12, b"\0") for t in self.types)

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        """Unpack the types."""
        if len(content) % 12:
            raise ProtocolError(f"a CAPABILITY has a multiple of 12 bytes; got {len(content)}")
        starts = range(0, len(content), 12)
        return cls(tuple(unpack_name(bytes(content[i : i + 12]), "message type") for i in starts))
