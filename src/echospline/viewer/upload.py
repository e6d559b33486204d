"""Uploads: one per client at a time, each with a deadline and a rate floor, so that a bad line delays its own client alone."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from starlette.requests import ClientDisconnect, Request

from echospline.errors import EchosplineError
from echospline.viewer.aside import Ending


class UploadError(EchosplineError):
    """An upload is refused; the message is for the page.

    Parameters
    ----------
    status : int
        HTTP status.
    reason : str
        One sentence.
    """

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class UploadLimits:
    """Limits of uploads.

    Parameters
    ----------
    size : int
        Bytes of a file.
    deadline : float
        Time for a whole file, s.
    stall : float
        Time without a byte, s.
    floor : float
        Bytes per second that a client sends at least, on average after `grace`.
    grace : float
        s.
    at_once : int
        Files received at a time, from all clients; they wait on disk, so this bounds the disk.
    reading : float
        Time for decoding a file and building its scene, s.
    """

    size: int = 64 * 2**20
    deadline: float = 180.0
    stall: float = 10.0
    floor: float = 16 * 1024
    grace: float = 5.0
    at_once: int = 16
    reading: float = 60.0


class Turns:
    """Who is being served now: each client once at a time.

    Parameters
    ----------
    what : str
        What is served, for messages.
    at_once : int
        Clients at a time.
    """

    def __init__(self, what: str, at_once: int) -> None:
        self._what, self._at_once = what, at_once
        self._busy: set[str] = set()

    @contextmanager
    def turn(self, client: str) -> Iterator[None]:
        """Hold a client's turn.

        Raises
        ------
        UploadError
            If the client, or too many clients, are being served already.
        """
        if client in self._busy:
            raise UploadError(429, f"{self._what}: your last one is not done: try again in a moment")
        if len(self._busy) >= self._at_once:
            raise UploadError(503, f"{self._what}: {len(self._busy)} are under way: try again in a moment")
        self._busy.add(client)
        try:
            yield
        finally:
            self._busy.discard(client)


class Uploads(Turns):
    """Who is uploading now."""

    def __init__(self, limits: UploadLimits) -> None:
        super().__init__("files", limits.at_once)
        self.limits = limits
        self.ending = Ending()

    async def receive(self, request: Request, path: Path) -> str:
        """Write the body of a request to a file; returns its SHA-256, hexadecimal.

        Raises
        ------
        UploadError
            If it is too large, too slow, or ends early.
        """
        digest = hashlib.sha256()
        with path.open("wb") as file:
            async for piece in self.pieces(request, self.limits.size):
                digest.update(piece)
                file.write(piece)
        return digest.hexdigest()

    async def body(self, request: Request, most: int) -> bytes:
        """Return the body of a request of at most this many bytes.

        Raises
        ------
        UploadError
            If it is too large, too slow, or ends early.
        """
        data = bytearray()
        async for piece in self.pieces(request, most):
            data += piece
        return bytes(data)

    async def pieces(self, request: Request, most: int) -> AsyncIterator[bytes]:
        """Receive the body of a request, of at most this many bytes, piece by piece.

        Raises
        ------
        UploadError
            If it is too large, too slow, or ends early.
        """
        limits, clock = self.limits, asyncio.get_running_loop().time
        size_ = f"{most // 2**20} MiB" if most >= 2**20 else f"{most} bytes"
        too_large = UploadError(413, f"what is sent here has at most {size_}")
        announced = request.headers.get("content-length", "")
        if announced.isdigit() and int(announced[:20]) > most:
            raise too_large
        size, start = 0, clock()
        chunks = aiter(request.stream())
        while True:
            left = max(0.0, start + limits.deadline - clock())
            coming = asyncio.ensure_future(anext(chunks, b""))
            if not await self.ending.first(coming, min(limits.stall, left)):
                coming.cancel()
                if self.ending.begun:
                    raise ended()
                raise UploadError(
                    408, f"the file came too slowly: {size} bytes in {clock() - start:.0f} s; try again"
                )
            try:
                chunk = coming.result()
            except ClientDisconnect:
                raise UploadError(400, "the connection ended before the file did") from None
            if not chunk:  # the stream ends with an empty piece
                return
            size += len(chunk)
            if size > most:
                raise too_large
            late = clock() - start - limits.grace
            if size < limits.floor * late:
                raise UploadError(
                    408,
                    f"the file came too slowly: expected {limits.floor / 1024:.0f} KiB/s or more; "
                    f"got {size / (clock() - start) / 1024:.1f}",
                )
            yield chunk


def ended() -> UploadError:
    """Return the refusal of an upload that the end of the server cuts short."""
    return UploadError(503, "the server is ending")
