"""Files that every page fetches, made once: plain and compressed, each with the tag by which a browser knows that it has them."""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from importlib.resources import files

from starlette.requests import Request
from starlette.responses import Response

from echospline import page as page_room

PHONE_FILES = {"index.html": "phone.html", "style.css": "phone.css", "main.js": "phone.js"}


@dataclass(frozen=True)
class ServedFile:
    """A file as it is sent.

    Parameters
    ----------
    data, small : bytes
        Plain, and compressed by gzip.
    digest : str
        SHA-256 of the plain bytes, hexadecimal: the ETag.
    media : str
        Media type.
    policy : str
        Content-Security-Policy of a page; empty for the server's own.
    """

    data: bytes
    small: bytes
    digest: str
    media: str
    policy: str = ""

    @classmethod
    def of(cls, data: bytes, media: str, policy: str = "") -> ServedFile:
        """Make a file from its bytes."""
        return cls(data, gzip.compress(data, 9, mtime=0), hashlib.sha256(data).hexdigest(), media, policy)

    def answer(self, request: Request) -> Response:
        """Answer a request for it: compressed where the browser takes that, and with nothing where it has it already."""
        small = takes_gzip(request.headers.get("accept-encoding", ""))
        tag = f'"{self.digest}-gzip"' if small else f'"{self.digest}"'
        headers = {"ETag": tag, "Vary": "Accept-Encoding"}
        if self.policy:
            headers["Content-Security-Policy"] = f"{self.policy}; frame-ancestors 'none'"
        known = {
            part.strip().removeprefix("W/") for part in request.headers.get("if-none-match", "").split(",")
        }
        if known & {tag, "*"}:
            return Response(status_code=304, headers=headers)
        if small:
            headers["Content-Encoding"] = "gzip"
        return Response(self.small if small else self.data, media_type=self.media, headers=headers)


def takes_gzip(accepted: str) -> bool:
    """Test whether a browser that sent this Accept-Encoding takes gzip."""
    for part in accepted.lower().split(","):
        name, *parameters = (piece.strip() for piece in part.split(";"))
        if name == "gzip":
            return not any(p.replace(" ", "") in ("q=0", "q=0.0", "q=0.00", "q=0.000") for p in parameters)
    return False


def page_file(language: str) -> ServedFile:
    """Return the page, without core and scene."""
    html, policy = page_room.served_page(language)
    return ServedFile.of(html.encode(), "text/html; charset=utf-8", policy)


def phone_file(language: str) -> ServedFile:
    """Return the page that a phone opens to hold the probe."""

    def read(name: str) -> str:
        return files("echospline.viewer").joinpath("static", PHONE_FILES[name]).read_text(encoding="utf-8")

    html, policy = page_room.assembled(read, {}, language, served=True)
    return ServedFile.of(html.encode(), "text/html; charset=utf-8", policy)


def core_file() -> ServedFile:
    """Return the core in WebAssembly."""
    return ServedFile.of(page_room.core_bytes(), "application/wasm")
