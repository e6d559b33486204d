"""The server of the live page: static files, the image, stored sessions, uploads and one web socket a client."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import socket
from collections import OrderedDict
from collections.abc import Callable
from importlib.resources import files
from math import isfinite
from pathlib import Path
from urllib.parse import urlsplit

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
from echospline.viewer.aside import aside
from echospline.viewer.class_answers import sessions_csv, trace_csv
from echospline.viewer.client import Client
from echospline.viewer.guard import SUBPROTOCOL, Guard
from echospline.viewer.idle import close_idle
from echospline.viewer.protocol import COMMAND_BYTES, REQUEST_BYTES
from echospline.viewer.room import LOOPBACK, Room, Settings
from echospline.viewer.served_scene import Scene, SceneOpener, grey_bytes
from echospline.viewer.sessions import Sessions
from echospline.viewer.upload import UploadError, Uploads
from echospline.viewer.words import for_page

log = logging.getLogger(__name__)

STATIC = Path(str(files("echospline.viewer").joinpath("static")))
_KEY = re.compile(r"[0-9a-f]{32}")
_SUFFIX = re.compile(r"(\.[A-Za-z0-9]{1,8}){1,3}$")


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
    room = Room(OrderedDict({"": scene}), sessions, settings, Uploads(settings.uploads), opener)
    sessions.pictures.sweep(sessions.needs)
    outside = {str(urlsplit(origin).hostname) for origin in settings.origins}
    hosts = LOOPBACK | {settings.host} | outside if settings.host in LOOPBACK else None
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
        middleware=[Middleware(Guard, hosts=hosts, token=settings.token, origins=settings.origins)],
        exception_handlers={InputError: _input_error, UploadError: _refusal},
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


def announce(app: Starlette, text: str) -> None:
    """Show the state of the tracker on every page of the first scene; any thread may call.

    Parameters
    ----------
    app : Starlette
        From `build_app`.
    text : str
        What is wrong with it; empty when it works.
    """
    room: Room = app.state.room
    room.tracker = text
    for page in list(room.pages):
        if page.seat.scene is room.scene(""):
            page.tell("tracker", text=text)


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
    room: Room = app.state.room
    listener = _listen(settings)
    port = listener.getsockname()[1]
    name = f"[{settings.host}]" if ":" in settings.host else settings.host
    if settings.host in ("0.0.0.0", "::"):
        name = socket.gethostname()
    inside = f"http://{name}:{port}"
    address = f"{(*settings.origins, inside)[0]}/" + (f"#token={settings.token}" if settings.token else "")
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
            timeout_graceful_shutdown=1,
        )
    )

    async def run() -> None:
        serving = asyncio.create_task(server.serve(sockets=[listener]))
        while not server.started and not serving.done():
            await asyncio.sleep(0.01)
        if server.started:
            ready(address)
        watching = asyncio.create_task(close_idle(server.server_state.connections))
        while not serving.done():
            await asyncio.wait([serving], timeout=0.1)
            server.should_exit = server.should_exit or stop()
            if server.should_exit:
                room.ending.begin()
        watching.cancel()
        await serving

    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(run())


def _listen(settings: Settings) -> socket.socket:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # a line that is cut: bytes that nobody acknowledges
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 15_000)
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
    scene = await _room(request).find(request.query_params.get("scene", ""))
    if scene is None:
        return PlainTextResponse("this scene is gone: upload the file again", 404)
    return Response(await aside(grey_bytes, scene.image), media_type="application/octet-stream")


async def _sessions(request: Request) -> Response:
    stored = await aside(_room(request).sessions.newest)
    return JSONResponse([session.to_dict() for session in stored])


async def _sessions_csv(request: Request) -> Response:
    stored = await aside(_room(request).sessions.newest, 100_000)
    return _csv(sessions_csv(stored), "echospline-sessions.csv")


async def _trace_csv(request: Request) -> Response:
    number = int(request.path_params["number"])
    _, _, trace = await aside(_room(request).sessions.load, min(number, 2**53))
    return _csv(await aside(trace_csv, trace), f"echospline-session-{number}.csv")


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
    seat = request.query_params.get("seat", "")
    client = seat if _KEY.fullmatch(seat) else request.client.host if request.client else "?"
    pictures = room.sessions.pictures
    with room.uploads.turn(client):
        part = await aside(pictures.part)
        try:
            digest = await room.uploads.receive(request, part)
            picture = await aside(pictures.keep, part, digest, suffix.group().lower(), spacing)
        finally:
            part.unlink(missing_ok=True)
        if room.scene(picture.name) is None:
            try:
                await room.open(picture)
            except EchosplineError as error:
                await aside(room.forget, picture.name)
                if isinstance(error, UploadError):
                    raise
                return PlainTextResponse(for_page(str(error), picture.path), 422)
    return JSONResponse({"scene": picture.name})


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


async def _input_error(request: Request, error: Exception) -> Response:
    return PlainTextResponse(
        for_page(str(error), _room(request).sessions.path, otherwise="not possible"), 422
    )


async def _refusal(_: Request, error: Exception) -> Response:
    assert isinstance(error, UploadError)
    # A slow body ends with its connection; what is left of others is passed over, so that the answer is read.
    headers = {"Connection": "close"} if error.status == 408 else None
    return PlainTextResponse(str(error), error.status, headers=headers)


async def _live(websocket: WebSocket) -> None:
    room = _room(websocket)
    offered = websocket.scope.get("subprotocols", [])
    await websocket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    name, key = websocket.query_params.get("scene", ""), websocket.query_params.get("seat", "")
    if offered and SUBPROTOCOL not in offered:
        await websocket.close(1008, f"this server speaks {SUBPROTOCOL}: reload the page")
        return
    scene = await room.find(name)
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
        await _serve_page(websocket, room, scene, key if _KEY.fullmatch(key) else "")
    except WebSocketDisconnect:
        pass
    except EchosplineError as error:
        log.exception("a seat could not be made")
        reason = for_page(str(error), otherwise="the server has a fault; its log says more")
        await websocket.close(1011, reason.encode()[:120].decode("utf-8", "ignore"))
    finally:
        room.clients -= 1


async def _serve_page(websocket: WebSocket, room: Room, scene: Scene, key: str) -> None:
    """Serve an accepted page until it leaves; with a key its seat is kept for a reload."""
    if key in room.leaving:  # a reload that is quicker than the end of its engine's thread
        await room.leaving[key].wait()
    taking = asyncio.ensure_future(aside(room.take_seat, key, scene))
    if not await room.ending.first(taking, None):  # building a model may take longer than the end may
        return
    seat, resumed = taking.result()
    page = Client(websocket, seat, room.sessions, nodes=room.settings.nodes)
    room.taken.append(seat)
    room.pages.append(page)
    if room.tracker and scene is room.scene(""):
        page.tell("tracker", text=room.tracker)
    try:
        await page.serve(resumed)
    finally:
        left = asyncio.Event()
        if key:
            room.leaving[key] = left
        try:
            await page.leave()
        finally:
            room.taken.remove(seat)
            room.pages.remove(page)
            if key:
                room.park(key, seat)
            left.set()
            if room.leaving.get(key) is left:
                del room.leaving[key]
