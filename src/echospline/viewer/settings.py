"""Settings of a server."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field

from echospline.errors import InputError
from echospline.viewer.guard import checked_origin
from echospline.viewer.upload import UploadLimits

LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})


@dataclass(frozen=True)
class Settings:
    """Settings of the server.

    Parameters
    ----------
    host : str
        Address to bind to; for an address other than loopback, a token is required.
    port : int
        0 binds any free one.
    clients : int
        Most pages at once.
    token : str or None
        Token that a page must present; generated when the host is not loopback and none is given.
    instructor : str or None
        Token of the instructor, who may see the whole class, where others than this machine's users reach the server; generated there.
    origins : tuple of str
        Origins of the reverse proxies in front, as a browser sees them (``https://sim.example.org``). With one, a token is
        required as well, because others than this machine's users reach the page.
    open_door : bool
        Require no token on a loopback address behind a proxy: the proxy knows its users.
    uploads : UploadLimits
        Limits of uploads.

    Raises
    ------
    InputError
        If port, clients or an origin is invalid, or the door is open on an address other than loopback.
    """

    host: str = "127.0.0.1"
    port: int = 8750
    clients: int = 64
    token: str | None = None
    instructor: str | None = None
    origins: tuple[str, ...] = ()
    open_door: bool = False
    uploads: UploadLimits = field(default_factory=UploadLimits)

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise InputError(f"port must be from 0 to 65535; got {self.port}")
        if self.clients < 1:
            raise InputError(f"clients must be 1 or more; got {self.clients}")
        object.__setattr__(self, "origins", tuple(checked_origin(origin) for origin in self.origins))
        if self.open_door and self.host not in LOOPBACK:
            raise InputError(
                f"--no-token is for a server behind a proxy, which listens on this machine alone; got --host {self.host}"
            )
        if self.token is None and self.reached_by_others and not self.open_door:
            object.__setattr__(self, "token", secrets.token_urlsafe(24))
        if self.instructor is None and self.reached_by_others:
            object.__setattr__(self, "instructor", secrets.token_urlsafe(24))

    @property
    def reached_by_others(self) -> bool:
        """Whether others than the users of this machine reach the server."""
        return self.host not in LOOPBACK or bool(self.origins)

    @property
    def tokens(self) -> tuple[str, ...]:
        """Tokens that open the door; none where everyone may come in."""
        return () if self.token is None else tuple(t for t in (self.token, self.instructor) if t is not None)
