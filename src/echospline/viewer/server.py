"""The server of the live page: static files, the image, stored sessions, uploads and one web socket a client."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import secrets
import socket
import tempfile
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.resources import files
from math import isfinite
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from echospline.errors import EchosplineError, InputError
from echospline.scene import NeedlePose
from echospline.viewer.client import Client, Seat
from echospline.viewer.guard import SUBPROTOCOL, Guard
from echospline.viewer.protocol import COMMAND_BYTES, REQUEST_BYTES
from echospline.viewer.served_scene import Scene, SceneOpener, grey_bytes
from echospline.viewer.sessions import Sessions, sessions_csv, trace_csv

log = logging.getLogger(__name__)

LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})
UPLOAD_BYTES = 64 * 2**20
"""Largest uploaded file."""
UPLOADED_SCENES = 8
"""Uploaded scenes kept; the oldest is dropped."""
PARKED, PARKED_FOR = 8, 60.0
"""Seats kept after their page has closed, and for how many seconds: a reload resumes."""
STATIC = Path(str(files("echospline.viewer").joinpath("static")))
_KEY = re.compile(r"[0-9a-f]{32}")
_SUFFIX = re.compile(r"(\.[A-Za-z0-9]{1,8}){1,3}$")


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
    """

    host: str = "127.0.0.1"
    port: int = 8750
    rate: float = 120.0
    clients: int = 64
    token: str | None = None
    nodes: bool | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise InputError(f"port must be from 0 to 65535; got {self.port}")
        if self.clients < 1:
            raise InputError(f"clients must be 1 or more; got {self.clients}")
        if self.token is None and self.host not in LOOPBACK:
            object.__setattr__(self, "token", secrets.token_urlsafe(24))


@dataclass
class Room:
    """State of the server while it runs."""

    scenes: OrderedDict[str, Scene]
    sessions: Sessions
    settings: Settings
    opener: SceneOpener | None = None
    clients: int = 0
    uploading: asyncio.Lock = field(default_factory=asyncio.Lock)
    parked: OrderedDict[str, tuple[float, Seat]] = field(default_factory=OrderedDict)
    taken: list[Seat] = field(default_factory=list)

    def scene(self, name: str) -> Scene | None:
        """Return a scene; the empty name is the scene that the server was started with."""
        return self.scenes.get(name)

    def take_seat(self, key: str, name: str, scene: Scene) -> tuple[Seat, bool]:
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


def build_app(
    scene: Scene, sessions: Sessions, settings: Settings | None = None, opener: SceneOpener | None = None
) -> Starlette:
    """Build the ASGI application of the live page.

    Parameters
    ----------
    scene : Scene
        The first scene of a page.
    sessions : Sessions
        Storage of finished exercises.
    settings : Settings, optional
        Loopback, port 8750.
    opener : callable, optional
        Builds scenes from uploaded files; without it uploads are refused.
    """
    settings = settings or Settings()
    room = Room(OrderedDict({"": scene}), sessions, settings, opener)
    hosts = LOOPBACK | {settings.host} if settings.host in LOOPBACK else None
    app = Starlette(
        routes=[
            Route("/", _index),
            Route("/favicon.ico", _favicon),
            Route("/api/image", _image),
            Route("/api/sessions", _sessions),
            Route("/api/sessions.csv", _sessions_csv),
            Route("/api/sessions/{number:int}.csv", _trace_csv),
            Route("/api/upload", _upload, methods=["POST"]),
            WebSocketRoute("/live", _live),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[Middleware(Guard, hosts=hosts, token=settings.token)],
        exception_handlers={InputError: _input_error},
    )
    app.state.room = room
    return app


def steer(app: Starlette, pose: NeedlePose, appears: bool) -> None:
    """Move the needle of every page that shows the first scene, as a tracker commands.

    Parameters
    ----------
    app : Starlette
        From `build_app`.
    pose : NeedlePose
        Pose of the needle.
    appears : bool
        Whether tracking of it has just begun: then it is placed there, not pushed there.
    """
    room: Room = app.state.room
    for seat in list(room.taken):
        if seat.scene is room.scene(""):
            (seat.engine.place if appears else seat.engine.command)(pose.entry, pose.tip)


def serve(
    app: Starlette, settings: Settings, ready: Callable[[str], None], stop: Callable[[], bool] = lambda: False
) -> None:
    """Run the server until interrupted.

    Parameters
    ----------
    app : Starlette
        From `build_app` with the same settings.
    settings : Settings
        Address and port.
    ready : callable
        Called with the page's address once connections are accepted.
    stop : callable
        Called ten times a second; true stops the server.

    Raises
    ------
    InputError
        If the address cannot be bound.
    """
    listener = _listen(settings)
    port = listener.getsockname()[1]
    name = f"[{settings.host}]" if ":" in settings.host else settings.host
    if settings.host in ("0.0.0.0", "::"):
        name = socket.gethostname()
    address = f"http://{name}:{port}/" + (f"#token={settings.token}" if settings.token else "")
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            ws_per_message_deflate=False,  # 8 to 15 ms for a frame of 20 000 nodes, to save a quarter
            ws_max_size=max(COMMAND_BYTES, REQUEST_BYTES),
            ws_ping_interval=5.0,
            ws_ping_timeout=10.0,
            log_level="warning",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=2,
        )
    )

    async def run() -> None:
        serving = asyncio.create_task(server.serve(sockets=[listener]))
        while not server.started and not serving.done():
            await asyncio.sleep(0.01)
        if server.started:
            ready(address)
        while not serving.done():
            await asyncio.wait([serving], timeout=0.1)
            server.should_exit = server.should_exit or stop()
        await serving

    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(run())


def _listen(settings: Settings) -> socket.socket:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        listener.bind((settings.host, settings.port))
    except OSError as error:
        listener.close()
        raise InputError(
            f"cannot listen on {settings.host} port {settings.port}: {error.strerror or error}; "
            "choose another with --port (0 takes any free one)"
        ) from error
    return listener


def _room(request: Request | WebSocket) -> Room:
    room: Room = request.app.state.room
    return room


async def _index(_: Request) -> Response:
    return FileResponse(STATIC / "index.html")


async def _favicon(_: Request) -> Response:
    return FileResponse(STATIC / "icon.svg", media_type="image/svg+xml")


async def _image(request: Request) -> Response:
    scene = _room(request).scene(request.query_params.get("scene", ""))
    if scene is None:
        return PlainTextResponse("this scene is gone: upload the file again", 404)
    return Response(grey_bytes(scene.image), media_type="application/octet-stream")


async def _sessions(request: Request) -> Response:
    stored = await asyncio.to_thread(_room(request).sessions.newest)
    return JSONResponse([session.to_dict() for session in stored])


async def _sessions_csv(request: Request) -> Response:
    stored = await asyncio.to_thread(_room(request).sessions.newest, 100_000)
    return _csv(sessions_csv(stored), "echospline-sessions.csv")


async def _trace_csv(request: Request) -> Response:
    number = int(request.path_params["number"])
    _, _, trace = await asyncio.to_thread(_room(request).sessions.load, min(number, 2**53))
    return _csv(await asyncio.to_thread(trace_csv, trace), f"echospline-session-{number}.csv")


def _csv(text: str, name: str) -> Response:
    return Response(
        text, media_type="text/csv", headers={"Content-Disposition": f'attachment; filename="{name}"'}
    )


async def _upload(request: Request) -> Response:
    """Receive an image file; the readers and checks are those of the command line."""
    room = _room(request)
    if room.opener is None:
        return PlainTextResponse("this server takes no uploads", 403)
    suffix = _SUFFIX.search(request.query_params.get("name", ""))
    if suffix is None:
        return PlainTextResponse("the file's name needs an ending such as .png or .mha", 422)
    spacing = _spacing(request.query_params.get("spacing", ""))
    if room.uploading.locked():  # one at a time: reading a picture needs memory
        return PlainTextResponse("another file is being read: try again in a moment", 429)
    async with room.uploading:
        return await _open_upload(request, room, room.opener, suffix.group().lower(), spacing)


async def _open_upload(
    request: Request, room: Room, opener: SceneOpener, suffix: str, spacing: tuple[float, float] | None
) -> Response:
    with tempfile.TemporaryDirectory(prefix="echospline-") as folder:
        path = Path(folder) / f"upload{suffix}"
        size = 0
        with path.open("wb") as file:
            async for chunk in request.stream():
                size += len(chunk)
                if size > UPLOAD_BYTES:
                    return PlainTextResponse(f"an upload has at most {UPLOAD_BYTES // 2**20} MiB", 413)
                file.write(chunk)
        scene = await asyncio.to_thread(opener, path, spacing)
    name = secrets.token_hex(8)
    room.scenes[name] = scene
    while len(room.scenes) > 1 + UPLOADED_SCENES:
        oldest = next(key for key in room.scenes if key)
        del room.scenes[oldest]
    return JSONResponse({"scene": name})


def _spacing(text: str) -> tuple[float, float] | None:
    """Parse a spacing "0.1" or "0.1,0.2" in mm; None where none was given (the file may carry its own)."""
    if not text:
        return None
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not 1 <= len(values) <= 2 or not all(isfinite(v) and v > 0 for v in values):
        raise InputError(
            f"spacing must be one or two positive numbers in mm (lateral, depth); got {text[:40]!r}"
        )
    return values[0], values[-1]


async def _input_error(_: Request, error: Exception) -> Response:
    return PlainTextResponse(str(error), 422)


async def _live(websocket: WebSocket) -> None:
    room = _room(websocket)
    offered = websocket.scope.get("subprotocols", [])
    await websocket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    name, key = websocket.query_params.get("scene", ""), websocket.query_params.get("seat", "")
    scene = room.scene(name)
    if offered and SUBPROTOCOL not in offered:
        await websocket.close(1008, f"this server speaks {SUBPROTOCOL}: reload the page")
        return
    if scene is None:
        await websocket.close(4404, "this scene is gone: upload the file again")
        return
    if room.clients >= room.settings.clients:
        await websocket.close(
            1013, f"this server takes {room.settings.clients} pages at once: try again later"
        )
        return
    room.clients += 1
    try:
        seat, resumed = await asyncio.to_thread(room.take_seat, key, name, scene)
        room.taken.append(seat)
        try:
            await Client(websocket, seat, room.sessions, nodes=room.settings.nodes).serve(resumed)
        finally:
            room.taken.remove(seat)
            if _KEY.fullmatch(key):
                room.park(key, seat)
    except WebSocketDisconnect:
        pass
    except EchosplineError as error:
        log.exception("a seat could not be made")
        await websocket.close(1011, str(error).encode()[:120].decode("utf-8", "ignore"))
    finally:
        room.clients -= 1
