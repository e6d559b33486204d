"""State and settings of a server: scenes, uploads, seats and pages."""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from collections import OrderedDict
from dataclasses import dataclass, field, replace

from echospline.errors import EchosplineError, InputError
from echospline.viewer.aside import Ending, aside
from echospline.viewer.client import Client, Seat
from echospline.viewer.guard import checked_origin
from echospline.viewer.pictures import Picture
from echospline.viewer.served_scene import Scene, SceneOpener
from echospline.viewer.sessions import Sessions
from echospline.viewer.upload import UploadError, UploadLimits, Uploads, ended

log = logging.getLogger(__name__)

LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})
UPLOADED_SCENES = 8
"""Uploaded scenes kept in memory; the oldest is dropped, and opened again from its stored picture if it has sessions."""
READ_AT_ONCE, STRAYS = 2, 4
"""Pictures decoded at a time, and decodings beyond their time after which no further one is begun."""
PARKED, PARKED_FOR = 8, 60.0
"""Seats kept after their page has closed, and for how many seconds: a reload resumes."""


@dataclass(frozen=True)
class Settings:
    """Settings of the server.

    Parameters
    ----------
    host : str
        Address to bind to; for an address other than loopback, a token is required.
    port : int
        0 binds any free one.
    rate : float
        Engine steps per second.
    clients : int
        Most pages at once.
    token : str or None
        Token that a page must present; generated when the host is not loopback and none is given.
    nodes : bool or None
        Send the displacement of every node even where the model is a spline; None decides by the mesh's size.
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
    rate: float = 120.0
    clients: int = 64
    token: str | None = None
    nodes: bool | None = None
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
        needed = self.host not in LOOPBACK or bool(self.origins)
        if self.token is None and needed and not self.open_door:
            object.__setattr__(self, "token", secrets.token_urlsafe(24))


@dataclass
class Room:
    """State of the server while it runs."""

    scenes: OrderedDict[str, Scene]
    sessions: Sessions
    settings: Settings
    uploads: Uploads
    opener: SceneOpener | None = None
    clients: int = 0
    reading: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(READ_AT_ONCE))
    strays: int = 0
    opening: dict[str, asyncio.Task[Scene | None]] = field(default_factory=dict)
    parked: OrderedDict[str, tuple[float, Seat]] = field(default_factory=OrderedDict)
    taken: list[Seat] = field(default_factory=list)
    pages: list[Client] = field(default_factory=list)
    leaving: dict[str, asyncio.Event] = field(default_factory=dict)
    tracker: str = ""

    @property
    def ending(self) -> Ending:
        """Whether the server is ending."""
        return self.uploads.ending

    def scene(self, name: str) -> Scene | None:
        """Return a scene in memory; the empty name is the scene that the server was started with."""
        return self.scenes.get(name)

    async def find(self, name: str) -> Scene | None:
        """Return a scene, opened again from its stored picture if it is not in memory (after a restart)."""
        known = self.scene(name)
        if known is not None or self.opener is None:
            return known
        if name not in self.opening:
            picture = await aside(self.sessions.pictures.find, name)
            if picture is None:
                return self.scene(name)
            self.opening.setdefault(name, asyncio.create_task(self._open_again(picture)))
        return await asyncio.shield(self.opening[name])

    async def _open_again(self, picture: Picture) -> Scene | None:
        try:
            return await self.open(picture)
        except EchosplineError as error:
            log.warning("the stored picture %s cannot be opened: %s", picture.path, error)
            return None
        finally:
            self.opening.pop(picture.name, None)

    async def open(self, picture: Picture) -> Scene:
        """Read a picture, build its scene and keep it; the oldest is dropped where there are too many.

        Raises
        ------
        InputError
            If it is not readable.
        UploadError
            If that takes too long.
        """
        assert self.opener is not None  # checked by the callers
        if self.strays >= STRAYS:
            raise UploadError(503, "this server reads no more files: too many did not come to an end")
        async with self.reading:
            scene = await self._read(self.opener, picture)
        scene = replace(scene, upload=picture.name)
        self.scenes[picture.name] = scene
        while len(self.scenes) > 1 + UPLOADED_SCENES:
            oldest = next(key for key in self.scenes if key)
            del self.scenes[oldest]
            await aside(self.forget, oldest)
        return scene

    async def _read(self, opener: SceneOpener, picture: Picture) -> Scene:
        reading = asyncio.ensure_future(aside(opener, picture.path, picture.spacing))
        if await self.ending.first(reading, self.settings.uploads.reading):
            return reading.result()
        # A thread cannot be ended: this one goes on, and is counted until it ends by itself.
        self.strays += 1
        reading.add_done_callback(self._back)
        if self.ending.begun:
            raise ended()
        raise UploadError(
            422, f"this file could not be read within {self.settings.uploads.reading:g} s: save it as a PNG"
        )

    def _back(self, reading: asyncio.Future[Scene]) -> None:
        self.strays -= 1
        if not reading.cancelled():
            reading.exception()  # looked at, so that asyncio does not complain of it

    def forget(self, name: str) -> None:
        """Delete the stored picture of an uploaded scene that no session was recorded in."""
        if not self.sessions.needs(name):
            self.sessions.pictures.drop(name)

    def take_seat(self, key: str, scene: Scene) -> tuple[Seat, bool]:
        """Return the parked seat of a page that comes back to its scene, or a new one."""
        self._forget()
        _, seat = self.parked.pop(key, (0.0, None))
        if seat is not None and seat.scene is scene:
            return seat, True
        return Seat(scene, self.settings.rate), False

    def park(self, key: str, seat: Seat) -> None:
        """Keep a seat for its page's return; its engine does not run."""
        self.parked[key] = time.monotonic() + PARKED_FOR, seat
        self._forget()

    def _forget(self) -> None:
        now = time.monotonic()
        for key in [key for key, (until, _) in self.parked.items() if until < now]:
            del self.parked[key]
        while len(self.parked) > PARKED:
            self.parked.popitem(last=False)
