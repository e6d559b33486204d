"""HTTP of a class: a page hands in a session and reads its own, the instructor reads everybody's; `class_answers` decides what each sees."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import re
import secrets
import tempfile
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route

from echospline.errors import EchosplineError, InputError
from echospline.page import parsed_sessions, verify
from echospline.viewer.aside import Ending, aside
from echospline.viewer.class_answers import (
    class_answer,
    curves_csv,
    may_see,
    own_answer,
    session_file,
    sessions_csv,
    trace_csv,
)
from echospline.viewer.learning_curve import Criterion
from echospline.viewer.served_scene import Scene
from echospline.viewer.sessions import Kept, Sessions
from echospline.viewer.upload import UploadError, UploadLimits, Uploads
from echospline.viewer.words import for_page

COOKIE = "echospline-trainee"
"""Holds the key of a browser. Scripts cannot read it, other sites cannot send it, and no page has to handle it."""
KEPT_FOR = 400 * 24 * 3600
"""s; the longest that browsers keep a cookie."""
REPLAYED_AT_ONCE = 2
"""Sessions that are run again at a time; others wait."""
LIMITS = UploadLimits(size=16 * 2**20, deadline=60.0, at_once=64)
"""Of a session that is handed in: half an hour at 120 steps a second takes 11.5 MB."""
LARGEST_NUMBER = 2**53
_KEY = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Instructor:
    """Who is taken for the instructor.

    Parameters
    ----------
    token : str or None
        Who presents it is.
    alone : bool
        Without a token: whether everybody is, because the server listens to this machine alone and no proxy is in front.
    """

    token: str | None
    alone: bool

    def admits(self, request: Request) -> bool:
        """Test whether a request is the instructor's."""
        if self.token is None:
            return self.alone
        scheme, _, given = request.headers.get("authorization", "").partition(" ")
        return scheme.lower() == "bearer" and hmac.compare_digest(self.token.encode(), given.strip().encode())


@dataclass(frozen=True)
class Classroom:
    """What the routes of a class need of the server.

    Parameters
    ----------
    sessions : Sessions
        Where they are stored.
    scene_of : coroutine function
        Returns the scene of the SHA-256 of a pack, or None where this server does not have it.
    instructor : Instructor
        Who sees the class.
    criterion : Criterion
        Of the learning curves.
    ending : Ending
        Of the server.
    """

    sessions: Sessions
    scene_of: Callable[[str], Awaitable[Scene | None]]
    instructor: Instructor
    criterion: Criterion = field(default_factory=Criterion)
    ending: Ending = field(default_factory=Ending)

    @cached_property
    def uploads(self) -> Uploads:
        """Sessions that are coming in."""
        uploads = Uploads(LIMITS)
        uploads.ending = self.ending
        return uploads

    @cached_property
    def replaying(self) -> asyncio.Semaphore:
        """Turns of replays."""
        return asyncio.Semaphore(REPLAYED_AT_ONCE)

    async def store(self, data: bytes, owner: str) -> Kept:
        """Run a session that a page recorded again, and store it.

        Raises
        ------
        InputError
            If it is no session, or one of a scene that this server does not have.
        """
        given = await aside(parsed_sessions, data, "this session")
        if len(given) != 1:
            raise InputError(f"sessions are handed in one at a time; got {len(given)}")
        (session,) = given
        scene = await self.scene_of(session.scene.pack)
        if scene is None:
            raise InputError(
                "this session was recorded in a scene that this server does not have: export it, and import it with "
                "echospline sessions import and its page"
            )

        def kept() -> Kept:
            return self.sessions.keep(
                verify(scene.pack, session), scene=scene.title, source=scene.source, upload=scene.upload,
                owner=owner,
            )  # fmt: skip

        return await aside(kept)


def class_routes(classroom: Classroom) -> list[Route]:
    """Return the routes of a class; the server includes them behind its guard.

    | | |
    |---|---|
    | POST /api/sessions | a session as a page exports it; answers number, attempt, verified, difference |
    | GET /api/sessions?trainee=NAME | what this browser handed in under that name, its curves, experts without a name |
    | GET /api/sessions/NUMBER | one whole session, to be replayed: an own one, an expert's, for the instructor any |
    | GET /api/class, /api/class.csv, /api/class/curves.csv, /api/class/NUMBER.csv | for the instructor: everything |
    | POST /api/class/expert | for the instructor: {"number": 3, "expert": true} makes a benchmark |
    """

    async def hand_in(request: Request) -> Response:
        key = _key_of(request) or secrets.token_hex(32)
        with (
            classroom.uploads.turn(secrets.token_hex(8)),
            tempfile.TemporaryDirectory(prefix="echospline-session-") as folder,
        ):
            path = Path(folder) / "session.json"
            await classroom.uploads.receive(request, path)
            async with classroom.replaying:
                kept = await classroom.store(await aside(path.read_bytes), _owner(key))
        answer = JSONResponse(
            {
                "number": kept.number,
                "attempt": kept.attempt,
                "verified": kept.verified,
                "difference": kept.difference,
            }
        )
        answer.set_cookie(
            COOKIE, key, max_age=KEPT_FOR, path="/api", httponly=True, samesite="strict",
            secure=request.headers.get("origin", "").startswith("https:"),
        )  # fmt: skip
        return answer

    async def own(request: Request) -> Response:
        owner, trainee = _owner(_key_of(request)), request.query_params.get("trainee", "")

        def answered() -> dict[str, Any]:
            return own_answer(classroom.sessions.owned(owner), owner, trainee, classroom.criterion)

        return JSONResponse(await aside(answered))

    async def one(request: Request) -> Response:
        number = min(int(request.path_params["number"]), LARGEST_NUMBER)
        owner, instructor = _owner(_key_of(request)), classroom.instructor.admits(request)

        def answered() -> dict[str, Any] | None:
            session = classroom.sessions.find(number)
            if session is None or not (instructor or may_see(session, owner)):
                return None
            loaded = classroom.sessions.load(number)
            return session_file(*loaded, named=instructor or session.owner == owner)

        answer = await aside(answered)
        if answer is None:  # the same words whether there is none or it is another's
            return PlainTextResponse(f"you have no session {number}", 404)
        return JSONResponse(answer)

    async def whole(request: Request) -> Response:
        return JSONResponse(await aside(_class, classroom))

    async def table(request: Request) -> Response:
        return _csv(await aside(lambda: sessions_csv(classroom.sessions.every())), "echospline-sessions.csv")

    async def curves(request: Request) -> Response:
        return _csv(await aside(lambda: curves_csv(_class(classroom))), "echospline-curves.csv")

    async def trace(request: Request) -> Response:
        number = min(int(request.path_params["number"]), LARGEST_NUMBER)
        _, _, recorded = await aside(classroom.sessions.load, number)
        return _csv(await aside(trace_csv, recorded), f"echospline-session-{number}.csv")

    async def expert(request: Request) -> Response:
        number, on = _marked(await _small_body(request))
        await aside(classroom.sessions.mark_expert, [number], on)
        return JSONResponse({"number": number, "expert": on})

    def guarded(answer: Callable[[Request], Any], *, instructor: bool = False) -> Callable[[Request], Any]:
        async def guard(request: Request) -> Response:
            if instructor and not classroom.instructor.admits(request):
                return PlainTextResponse(
                    "the class is shown to the instructor alone: open the address with the instructor's token",
                    403,
                )
            try:
                response: Response = await answer(request)
            except UploadError as error:  # a slow body ends with its connection
                headers = {"Connection": "close"} if error.status == 408 else None
                return PlainTextResponse(str(error), error.status, headers=headers)
            except EchosplineError as error:
                words = for_page(str(error), classroom.sessions.path, otherwise="not possible")
                return PlainTextResponse(words, 422)
            response.headers["Cache-Control"] = "no-store"
            return response

        return guard

    return [
        Route("/api/sessions", guarded(hand_in), methods=["POST"]),
        Route("/api/sessions", guarded(own)),
        Route("/api/sessions/{number:int}", guarded(one)),
        Route("/api/class", guarded(whole, instructor=True)),
        Route("/api/class.csv", guarded(table, instructor=True)),
        Route("/api/class/curves.csv", guarded(curves, instructor=True)),
        Route("/api/class/{number:int}.csv", guarded(trace, instructor=True)),
        Route("/api/class/expert", guarded(expert, instructor=True), methods=["POST"]),
    ]


def _class(classroom: Classroom) -> dict[str, Any]:
    return class_answer(classroom.sessions.every(), classroom.criterion)


def _key_of(request: Request) -> str:
    """Return the key of the browser, empty where it has none."""
    given = request.cookies.get(COOKIE, "")
    return given if _KEY.fullmatch(given) else ""


def _owner(key: str) -> str:
    """Return what is stored of a key: whoever reads the file of sessions cannot be that browser."""
    return hashlib.sha256(key.encode()).hexdigest() if key else ""


async def _small_body(request: Request) -> bytes:
    data = b""
    try:
        async with asyncio.timeout(10.0):
            async for chunk in request.stream():
                data += chunk
                if len(data) > 1000:
                    raise UploadError(413, "this is more than a number and a choice")
    except TimeoutError:
        raise UploadError(408, "the request came too slowly: try again") from None
    return data


def _marked(data: bytes) -> tuple[int, bool]:
    try:
        given = json.loads(data)
        number, on = given["number"], given["expert"]
    except (ValueError, TypeError, KeyError, RecursionError):
        number, on = None, None
    if type(number) is not int or type(on) is not bool or not 0 < number <= LARGEST_NUMBER:
        raise InputError('expected {"number": 3, "expert": true}')
    return number, on


def _csv(text: str, name: str) -> Response:
    return Response(
        text, media_type="text/csv", headers={"Content-Disposition": f'attachment; filename="{name}"'}
    )
