"""State of a server: its scene and those of uploaded pictures, uploads, and the pages that listen."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from echospline.errors import EchosplineError
from echospline.viewer.aside import Ending, aside
from echospline.viewer.hub import Hub
from echospline.viewer.pictures import Picture
from echospline.viewer.served_files import ServedFile
from echospline.viewer.served_scene import Scene, SceneOpener
from echospline.viewer.sessions import Sessions
from echospline.viewer.settings import Settings
from echospline.viewer.upload import Turns, UploadError, Uploads, ended

log = logging.getLogger(__name__)

T = TypeVar("T")
UPLOADED_SCENES = 8
"""Uploaded scenes kept in memory; an older one is opened again from its stored picture when a session of it comes."""
UNUSED_PICTURES = 64
"""Stored pictures without a session; the oldest beyond them is deleted."""
READ_AT_ONCE, STRAYS = 2, 4
"""Pictures decoded at a time, and decodings beyond their time after which no further one is begun."""
COMPUTED_AT_ONCE, MOST_WAITING = 2, 64
"""Pages that finite elements follow at a time, and those that wait for it."""
RECORDED_AT_ONCE = 4
"""Recordings received and written as DICOM at a time; each is in memory, up to the size of an upload."""


@dataclass
class Room:
    """State of the server while it runs."""

    scene: Scene
    sessions: Sessions
    settings: Settings
    uploads: Uploads
    files: dict[str, ServedFile]
    opener: SceneOpener | None = None
    opened: OrderedDict[str, Scene] = field(default_factory=OrderedDict)
    reading: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(READ_AT_ONCE))
    computing: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(COMPUTED_AT_ONCE))
    waiting: int = 0
    strays: int = 0
    opening: dict[str, asyncio.Task[Scene | None]] = field(default_factory=dict)
    hub: Hub = field(default_factory=Hub)
    following: Turns = field(default_factory=lambda: Turns("finite elements", MOST_WAITING))
    recordings: Turns = field(default_factory=lambda: Turns("recordings", RECORDED_AT_ONCE))

    @property
    def ending(self) -> Ending:
        """Whether the server is ending."""
        return self.uploads.ending

    async def find(self, digest: str) -> Scene | None:
        """Return the scene of a pack, opened again from its stored picture if it is not in memory (after a restart)."""
        if digest == self.scene.pack.digest:
            return self.scene
        if digest in self.opened:
            self.opened.move_to_end(digest)
            return self.opened[digest]
        if self.opener is None:
            return None
        if digest not in self.opening:
            picture = await aside(self.sessions.pictures.find, digest[:16])
            if picture is None:
                return None
            self.opening.setdefault(digest, asyncio.create_task(self._open_again(picture, digest)))
        return await asyncio.shield(self.opening[digest])

    async def _open_again(self, picture: Picture, digest: str) -> Scene | None:
        try:
            scene = await self.read(picture.path, picture.spacing)
        except EchosplineError as error:
            log.warning("the stored picture %s cannot be opened: %s", picture.path, error)
            return None
        finally:
            self.opening.pop(digest, None)
        if (
            scene.pack.digest != digest
        ):  # the server was started with another tissue, or is of another version
            return None
        self.hold(scene)
        return scene

    async def read(self, path: Path, spacing: tuple[float, float] | None) -> Scene:
        """Read a picture and build its scene.

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
            reading = asyncio.ensure_future(aside(self.opener, path, spacing))
            if await self.ending.first(reading, self.settings.uploads.reading):
                scene = reading.result()
                return replace(scene, upload=scene.pack.digest[:16])
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

    def hold(self, scene: Scene) -> None:
        """Keep the scene of an uploaded picture in memory; the one that was longest not asked for makes room."""
        self.opened[scene.pack.digest] = scene
        self.opened.move_to_end(scene.pack.digest)
        while len(self.opened) > UPLOADED_SCENES:
            self.opened.popitem(last=False)

    async def compute(self, work: Callable[[], Awaitable[T]]) -> T:
        """Call a function beside the loop when it is its turn; ``work`` makes the awaitable.

        Raises
        ------
        UploadError
            If too many wait, or the server ends.
        """
        if self.waiting >= MOST_WAITING:
            raise UploadError(503, "this server is busy: try again in a moment")
        self.waiting += 1
        try:
            async with self.computing:
                running: asyncio.Future[T] = asyncio.ensure_future(work())
                if await self.ending.first(running, None):
                    return running.result()
        finally:
            self.waiting -= 1
        raise ended()
