"""Extended header and metadata of header version 2: key and value texts around the content of a body."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from echospline.errors import InputError, ProtocolError

ENCODINGS = {3: "ascii", 4: "latin-1", 106: "utf-8"}
"""Character sets by their IANA MIBenum, as the protocol numbers them."""

_EXTENDED = struct.Struct(">HHII")  # its own size, metadata index size, metadata size, message id
_ENTRY = struct.Struct(">HHI")  # key size, encoding of the value, value size
_COUNT = struct.Struct(">H")


def wrap(content: bytes, metadata: Mapping[str, str], message_id: int = 0) -> bytes:
    """Build a body of header version 2: extended header, content, metadata.

    Raises
    ------
    InputError
        If there are more entries or longer texts than the fields can count.
    """
    if not 0 <= message_id < 1 << 32:
        raise InputError(f"a message id is a whole number below 2**32; got {message_id}")
    index, texts = [], []
    for key, value in metadata.items():
        name = key.encode("utf-8")
        encoding, text = encode_text(value)
        if len(name) > 0xFFFF:
            raise InputError(f"a metadata key has at most 65535 bytes; got {len(name)}")
        index.append(_ENTRY.pack(len(name), encoding, len(text)))
        texts.append(name + text)
    if len(index) > (0xFFFF - _COUNT.size) // _ENTRY.size:
        raise InputError(f"a message carries at most 8191 metadata entries; got {len(index)}")
    head, tail = _COUNT.pack(len(index)) + b"".join(index), b"".join(texts)
    return b"".join((_EXTENDED.pack(_EXTENDED.size, len(head), len(tail), message_id), content, head, tail))


def unwrap(body: memoryview) -> tuple[memoryview, dict[str, str], int]:
    """Split a body of header version 2 into content, metadata and message id.

    Raises
    ------
    ProtocolError
        If the sizes inside do not fit the body.
    """
    if len(body) < _EXTENDED.size:
        raise ProtocolError(
            f"a body of header version 2 begins with 12 bytes of extended header; got {len(body)} bytes"
        )
    extended, index_size, text_size, message_id = _EXTENDED.unpack_from(body)
    end = len(body) - index_size - text_size
    if extended < _EXTENDED.size or extended > end:
        raise ProtocolError(
            f"extended header {extended}, metadata index {index_size} and metadata {text_size} bytes "
            f"do not fit a body of {len(body)} bytes"
        )
    index, texts = body[end : end + index_size], body[end + index_size :]
    return body[extended:end], _entries(index, texts), message_id


def _entries(index: memoryview, texts: memoryview) -> dict[str, str]:
    if not index:
        return {}
    count = _COUNT.unpack_from(index)[0] if len(index) >= _COUNT.size else -1
    if count < 0 or _COUNT.size + count * _ENTRY.size > len(index):
        raise ProtocolError(f"a metadata index of {len(index)} bytes cannot hold {count} entries")
    metadata, at = {}, 0
    for i in range(count):
        key_size, encoding, value_size = _ENTRY.unpack_from(index, _COUNT.size + i * _ENTRY.size)
        if at + key_size + value_size > len(texts):
            raise ProtocolError(f"metadata entry {i} ends after the body does")
        key = decode_text(texts[at : at + key_size], 106)
        metadata[key] = decode_text(texts[at + key_size : at + key_size + value_size], encoding)
        at += key_size + value_size
    return metadata


def encode_text(text: str) -> tuple[int, bytes]:
    """Encode a text: MIBenum and bytes, ASCII where possible, else UTF-8."""
    return (3, text.encode("ascii")) if text.isascii() else (106, text.encode("utf-8"))


def decode_text(data: memoryview | bytes, encoding: int) -> str:
    """Decode bytes in the character set ``encoding`` (MIBenum).

    Raises
    ------
    ProtocolError
        If the character set is unknown or the bytes are not of it.
    """
    name = ENCODINGS.get(encoding)
    if name is None:
        raise ProtocolError(
            f"a text is in ASCII (3), Latin-1 (4) or UTF-8 (106); got character set {encoding}"
        )
    # The C++ library labels every text as US-ASCII (3), whatever it holds: UTF-8 reads both.
    try:
        return bytes(data).decode("utf-8" if name == "ascii" else name)
    except UnicodeDecodeError as error:
        raise ProtocolError(f"a text labelled {name} is not: {error}") from error
