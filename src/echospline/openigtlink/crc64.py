"""The check sum of an OpenIGTLink body: CRC-64 of ECMA-182 (polynomial 0x42F0E1EBA9EA3693, no reflection, start 0)."""

from __future__ import annotations

from fastcrc.crc64 import ecma_182


def crc64(data: bytes | bytearray | memoryview) -> int:
    """Check sum of ``data``, 0 <= value < 2**64."""
    return int(ecma_182(data))
