"""Access to the server: Host, Origin and token are checked before anything else, and messages are counted."""

from __future__ import annotations

import hmac
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from echospline.errors import InputError

log = logging.getLogger(__name__)

DEFAULT_PORTS = {"http": 80, "https": 443}
SUBPROTOCOL = "echospline.1"
"""Offered by the page; a token is sent with it as ``token.<token>``, because a page cannot set headers there."""

SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
PUBLIC = frozenset({"/", "/core.wasm", "/phone", "/favicon.ico"})
"""Paths without secrets: the page itself must load before it can present its token."""


class Guard:
    """Refuses requests with foreign host names, from foreign pages and without a token, and adds the security headers.

    A page of another site may make a browser connect here, and may give its own name this machine's address;
    the checks of Origin and Host prevent that.

    Parameters
    ----------
    app : ASGI application
        The guarded application.
    hosts : frozenset of str, or None
        Host names that are accepted (without port); None accepts any and relies on the token.
    tokens : tuple of str
        Tokens of which a client must present one; none where everyone may come in.
    origins : tuple of str
        Origins of reverse proxies, from `checked_origin`: their pages are this server's, whatever Host the proxy sends on.
    """

    def __init__(
        self,
        app: ASGIApp,
        hosts: frozenset[str] | None,
        tokens: tuple[str, ...] = (),
        origins: tuple[str, ...] = (),
    ) -> None:
        self.app, self.hosts, self.tokens, self.origins = app, hosts, tokens, frozenset(origins)
        self._refused: set[str] = set()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve or refuse one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        refusal = self.refusal(scope)
        if refusal is not None:
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008, "reason": refusal[1]})
            else:
                await PlainTextResponse(refusal[1], refusal[0])(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)  # a page brings the policy of its own script
            await send(message)

        await self.app(scope, receive, send_with_headers)

    def refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Return the status and reason if this connection is refused."""
        headers = Headers(scope=scope)
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1:
            return 400, "exactly one Host header is needed"
        name = _host_name(hosts[0])
        if name is None or (self.hosts is not None and name not in self.hosts):
            return 421, "this server does not answer to that Host name"
        if len(origins) > 1 or (origins and not self._is_own(origins[0], hosts[0])):
            self._log_refused(origins[0])
            return 403, "pages of another origin may not connect"
        secret = scope["type"] == "websocket" or scope["path"] not in PUBLIC
        if self.tokens and secret:
            given = tokens_of(headers)
            if not any(given.hold(token) for token in self.tokens):
                return 401, "the token is missing or wrong: open the address that the server printed"
        return None

    def _is_own(self, origin: str, host: str) -> bool:
        try:
            return urlsplit(origin).netloc.lower() == host.lower() or checked_origin(origin) in self.origins
        except (InputError, ValueError):
            return False

    def _log_refused(self, origin: str) -> None:
        """Tell the operator once, not the page, what to do if this is a proxy of theirs."""
        if origin not in self._refused and len(self._refused) < 20:
            self._refused.add(origin)
            log.warning(
                "a page of %.100r was refused; if it is this server's behind a proxy, start with --origin",
                origin,
            )


@dataclass(frozen=True)
class Tokens:
    """Tokens that a client presents."""

    given: tuple[str, ...]

    def hold(self, secret: str) -> bool:
        """Test whether one is this, in a time that does not tell how much of it is right."""
        return any(hmac.compare_digest(secret.encode(), value.encode()) for value in self.given)


def tokens_of(headers: Headers) -> Tokens:
    """Return the tokens of a request: those among its web socket's subprotocols, and its bearer."""
    offered = [part.strip() for part in headers.get("sec-websocket-protocol", "").split(",")]
    given = [part.removeprefix("token.") for part in offered if part.startswith("token.")]
    scheme, _, bearer = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        given.append(bearer)
    return Tokens(tuple(given))


def checked_origin(text: str) -> str:
    """Return an origin in the form in which browsers send it: scheme and host in small letters, no default port.

    Raises
    ------
    InputError
        If it is not ``http://HOST``, ``https://HOST`` or one of them with a port.
    """
    try:
        parts = urlsplit(text.strip().lower())
        number = parts.port
    except ValueError:
        parts, number = urlsplit(""), None
    if (
        parts.scheme not in DEFAULT_PORTS
        or not parts.hostname
        or parts.username is not None
        or parts.path not in ("", "/")
        or parts.query
        or parts.fragment
    ):
        raise InputError(
            f"an origin is https://HOST or https://HOST:PORT, without a path; got {text[:100]!r}"
        )
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    port = "" if number in (None, DEFAULT_PORTS[parts.scheme]) else f":{number}"
    return f"{parts.scheme}://{host}{port}"


def _host_name(host: str) -> str | None:
    """Return the name in a Host header without the port, lower case; None if it is malformed."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port
    except ValueError:
        return None
    if parts.username is not None or parts.path or parts.query or parts.fragment:
        return None
    return parts.hostname


class Allowance:
    """A budget of messages that refills with time; a client that empties it is flooding.

    Parameters
    ----------
    rate : float
        Sustained messages per second.
    burst : float
        Messages allowed at once.
    clock : callable
        s.
    """

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate, self.burst, self._clock = rate, burst, clock
        self._left, self._last = burst, clock()

    def take(self) -> bool:
        """Count one message; returns False if it is one too many."""
        now = self._clock()
        self._left = min(self.burst, self._left + self.rate * (now - self._last))
        self._last = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
