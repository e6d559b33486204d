"""What a page asks over HTTP: its files, scenes of its own pictures, sessions, finite elements, recordings as DICOM."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable
from importlib.metadata import version
from math import isfinite
from threading import Event

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response

from echospline.errors import EchosplineError, InputError
from echospline.scene import Floats
from echospline.viewer import reference
from echospline.viewer.aside import aside
from echospline.viewer.class_routes import Classroom
from echospline.viewer.recordings import as_dicom
from echospline.viewer.room import UNUSED_PICTURES, Room
from echospline.viewer.served_scene import Scene
from echospline.viewer.upload import UploadError
from echospline.viewer.words import for_page

_KEY = re.compile(r"[0-9a-f]{16,64}")
_SUFFIX = re.compile(r"(\.[A-Za-z0-9]{1,8}){1,3}$")


def room_of(request: Request) -> Room:
    """Return the state of the server."""
    room: Room = request.app.state.room
    return room


def served(name: str) -> Callable[[Request], Awaitable[Response]]:
    """Make the answer that is a file of the server."""

    async def answer(request: Request) -> Response:
        return room_of(request).files[name].answer(request)

    return answer


async def favicon(_: Request) -> Response:
    """Answer that there is none beside the page's own."""
    return Response(status_code=204)


async def hello(request: Request) -> Response:
    """Say what this server offers to this page."""
    room = room_of(request)
    classroom: Classroom = request.app.state.classroom
    return JSONResponse(
        {
            "version": version("echospline"),
            "instructor": classroom.instructor.admits(request),
            "fem": room.scene.fem is not None,
            "tracker": room.hub.tracker,
            "uploads": room.opener is not None,
        }
    )


async def open_picture(request: Request) -> Response:
    """Receive an image file and answer with its pack; the readers and checks are those of the command line."""
    room = room_of(request)
    if room.opener is None:
        return PlainTextResponse("this server takes no uploads", 403)
    suffix = _SUFFIX.search(request.query_params.get("name", ""))
    if suffix is None:
        return PlainTextResponse("the file's name needs an ending such as .png or .mha", 422)
    spacing = spacing_of(request.query_params.get("spacing", ""))
    pictures = room.sessions.pictures
    with room.uploads.turn(client_of(request)):
        part = await aside(pictures.part)
        try:
            digest = await room.uploads.receive(request, part)
            path = await aside(pictures.keep, part, digest, suffix.group().lower())
        finally:
            part.unlink(missing_ok=True)
        try:
            scene = await room.read(path, spacing)
            await aside(pictures.record, scene.upload, path, spacing)
        except UploadError:
            raise
        except EchosplineError as error:
            return PlainTextResponse(for_page(str(error), path), 422)
        finally:
            await aside(pictures.release, path)
        room.hold(scene)
        await aside(pictures.prune, room.sessions.needs, UNUSED_PICTURES)
    data = await aside(scene.pack.to_bytes)
    return Response(data, media_type="application/octet-stream")


async def fem(request: Request) -> Response:
    """Answer the displacement of finite elements after a page's poses, float32, node by node."""
    room = room_of(request)
    asked = await aside(reference.asked, await room.uploads.body(request, reference.LARGEST_REQUEST))
    scene = await room.find(asked.pack)
    if scene is None or scene.fem is None:
        return PlainTextResponse("there are no finite elements of this scene here", 404)
    rows = reference.rows_of(asked, scene.pack.dimension)
    with room.following.turn(client_of(request)):
        moved = await room.compute(lambda: _followed(request, scene, rows))
    return Response(moved.astype("<f4").tobytes(), media_type="application/octet-stream")


async def _followed(request: Request, scene: Scene, rows: Floats) -> Floats:
    """Run finite elements beside the loop; they stop when the page leaves."""
    stopped = Event()
    work = asyncio.ensure_future(aside(reference.displacement, scene, rows, stopped))
    try:
        while not (await asyncio.wait([work], timeout=0.5))[0]:
            if await request.is_disconnected():
                raise UploadError(400, "the page left")
        return work.result()
    finally:
        stopped.set()
        work.cancel()


async def dicom(request: Request) -> Response:
    """Answer frames of a page as a DICOM file."""
    room = room_of(request)
    with room.recordings.turn(client_of(request)):
        data = await room.uploads.body(request, room.settings.uploads.size)
        file = await room.compute(lambda: aside(as_dicom, data, request.query_params.get("rate", "30")))
    return Response(
        file, media_type="application/dicom",
        headers={"Content-Disposition": 'attachment; filename="echospline.dcm"'},
    )  # fmt: skip


def client_of(request: Request) -> str:
    """Return who asks: the page's own key where it gives one, else its address."""
    key = request.query_params.get("page", "")
    return key if _KEY.fullmatch(key) else request.client.host if request.client else "?"


def spacing_of(text: str) -> tuple[float, float] | None:
    """Parse a spacing "0.1" or "0.1,0.2" in mm; None where none was given (the file may carry its own).

    Raises
    ------
    InputError
        If it is anything else.
    """
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


async def input_error(request: Request, error: Exception) -> Response:
    """Answer what was wrong with a request, without paths and options."""
    return PlainTextResponse(
        for_page(str(error), room_of(request).sessions.path, otherwise="not possible"), 422
    )


async def refusal(_: Request, error: Exception) -> Response:
    """Answer that a request is refused."""
    assert isinstance(error, UploadError)
    # A slow body ends with its connection; what is left of others is passed over, so that the answer is read.
    headers = {"Connection": "close"} if error.status == 408 else None
    return PlainTextResponse(str(error), error.status, headers=headers)
