"""The server of the page: its files, scenes, sessions, finite elements, and what steers it from outside."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable, Iterable
from urllib.parse import urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.routing import Route, WebSocketRoute

from echospline.errors import InputError
from echospline.scene import Floats, NeedlePose, SpatialPose
from echospline.viewer import routes, sockets
from echospline.viewer.class_routes import Classroom, Instructor, class_routes
from echospline.viewer.guard import Guard
from echospline.viewer.idle import close_idle
from echospline.viewer.room import Room
from echospline.viewer.served_files import ServedFile, core_file, page_file, phone_file
from echospline.viewer.served_scene import Scene, SceneOpener
from echospline.viewer.sessions import Sessions
from echospline.viewer.settings import LOOPBACK, Settings
from echospline.viewer.upload import UploadError, Uploads


def build_app(
    scene: Scene, sessions: Sessions, settings: Settings | None = None, opener: SceneOpener | None = None
) -> Starlette:
    """Build the ASGI application of the page.

    Parameters
    ----------
    scene : Scene
        What a page shows first.
    sessions : Sessions
        Storage of finished exercises.
    settings : Settings, optional
        Loopback, port 8750.
    opener : callable, optional
        Builds scenes from uploaded files; without it uploads are refused.

    Raises
    ------
    InputError
        If the core in WebAssembly has not been built.
    """
    settings = settings or Settings()
    language = scene.pack.manifest.language
    files = {
        "page": page_file(language),
        "phone": phone_file(language),
        "core": core_file(),
        "pack": ServedFile.of(scene.pack.to_bytes(), "application/octet-stream"),
    }
    room = Room(scene, sessions, settings, Uploads(settings.uploads), files, opener)
    instructor = Instructor(settings.instructor, alone=not settings.reached_by_others)
    classroom = Classroom(sessions, room.find, instructor, ending=room.ending)
    sessions.pictures.sweep(sessions.needs)
    outside = {str(urlsplit(origin).hostname) for origin in settings.origins}
    hosts = LOOPBACK | {settings.host} | outside if settings.host in LOOPBACK else None
    app = Starlette(
        routes=[
            Route("/", routes.served("page")),
            Route("/core.wasm", routes.served("core")),
            Route("/pack", routes.served("pack")),
            Route("/phone", routes.served("phone")),
            Route("/favicon.ico", routes.favicon),
            Route("/api/hello", routes.hello),
            Route("/api/open", routes.open_picture, methods=["POST"]),
            Route("/api/fem", routes.fem, methods=["POST"]),
            Route("/api/dicom", routes.dicom, methods=["POST"]),
            WebSocketRoute("/poses", sockets.poses),
            WebSocketRoute("/phone", sockets.phone),
            *class_routes(classroom),
        ],
        middleware=[Middleware(Guard, hosts=hosts, tokens=settings.tokens, origins=settings.origins)],
        exception_handlers={InputError: routes.input_error, UploadError: routes.refusal},
    )
    app.state.room, app.state.classroom = room, classroom
    return app


def steer(app: Starlette, pose: NeedlePose | SpatialPose, appears: bool) -> None:
    """Move the needle of every page, as a tracker commands; any thread may call.

    Parameters
    ----------
    app : Starlette
        From `build_app`.
    pose : NeedlePose or SpatialPose
        Pose of the needle.
    appears : bool
        Whether tracking of it has just begun: then it is placed there, not pushed there.
    """
    _room(app).hub.steer(pose, appears)


def turn(app: Starlette, plane: Floats | Iterable[float]) -> None:
    """Move the plane of every page, as a tracker on the probe commands; any thread may call.

    Parameters
    ----------
    app : Starlette
        From `build_app`.
    plane : sequence of float
        16 numbers of a matrix from plane to scene row by row, or x, y, z, yaw, pitch, roll (mm, degrees).
    """
    _room(app).hub.turn(plane)


def announce(app: Starlette, text: str) -> None:
    """Show the state of the tracker on every page; any thread may call.

    Parameters
    ----------
    app : Starlette
        From `build_app`.
    text : str
        What is wrong with it; empty when it works.
    """
    _room(app).hub.announce(text)


def serve(
    app: Starlette,
    settings: Settings,
    ready: Callable[[str, str], None],
    stop: Callable[[], bool] = lambda: False,
) -> None:
    """Run the server until interrupted.

    Parameters
    ----------
    app : Starlette
        From `build_app` with the same settings.
    settings : Settings
        Address and port.
    ready : callable
        Called with the page's address, and the instructor's where it differs, once connections are accepted.
    stop : callable
        Called ten times a second; true stops the server.

    Raises
    ------
    InputError
        If the address cannot be bound.
    """
    room = _room(app)
    listener = _listen(settings)
    port = listener.getsockname()[1]
    name = f"[{settings.host}]" if ":" in settings.host else settings.host
    if settings.host in ("0.0.0.0", "::"):
        name = socket.gethostname()
    inside = f"http://{name}:{port}"
    outside = f"{(*settings.origins, inside)[0]}/"
    address = outside + (f"#token={settings.token}" if settings.token else "")
    teaching = outside + (f"#token={settings.instructor}" if settings.instructor else "")
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            ws_per_message_deflate=False,  # messages are short
            ws_max_size=sockets.LARGEST_MESSAGE,
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
            ready(address, teaching)
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


def _room(app: Starlette) -> Room:
    room: Room = app.state.room
    return room
