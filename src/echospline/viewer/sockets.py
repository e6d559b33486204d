"""Web sockets: pages listen at /poses, and a phone that holds the probe speaks at /phone to the page of its key."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Awaitable
from math import isfinite

from starlette.websockets import WebSocket, WebSocketDisconnect

from echospline.errors import ProtocolError
from echospline.viewer.guard import SUBPROTOCOL, Allowance
from echospline.viewer.hub import Hub, Listener, message
from echospline.viewer.room import Room

KEY = re.compile(r"[0-9a-f]{16,64}")
"""Of a page, chosen by it at random."""
LARGEST_MESSAGE = 1024
"""Bytes."""


async def poses(websocket: WebSocket) -> None:
    """Tell a page what steers it: ``{"tracker": text}``, ``{"entry", "tip", "appears"}``, ``{"plane"}``, ``{"phone": present}``, ``{"turn"}``."""
    room: Room = websocket.app.state.room
    if not await _accepted(websocket):
        return
    if len(room.hub.listeners) >= room.settings.clients:
        await websocket.close(
            1013, f"this server takes {room.settings.clients} pages at once: try again later"
        )
        return
    key = websocket.query_params.get("room", "")
    listener = Listener(key if KEY.fullmatch(key) else "")
    room.hub.enter(listener)
    try:
        await _first_of(websocket, _tell(websocket, listener), _hear_nothing(websocket))
    finally:
        room.hub.leave(listener)


async def phone(websocket: WebSocket) -> None:
    """Pass the turn of a phone on to the page of its key: yaw, pitch and roll in degrees since the phone was taken up."""
    room: Room = websocket.app.state.room
    if not await _accepted(websocket):
        return
    key = websocket.query_params.get("room", "")
    if not KEY.fullmatch(key) or not room.hub.of_key(key):
        await websocket.close(4404, "the page of this phone is gone: take its address from the page again")
        return
    _tell_page(room.hub, key, "phone", message(phone=True))
    try:
        await _first_of(websocket, _pass_on(websocket, room.hub, key))
    finally:
        _tell_page(room.hub, key, "phone", message(phone=False))


async def _accepted(websocket: WebSocket) -> bool:
    offered = websocket.scope.get("subprotocols", [])
    await websocket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    if offered and SUBPROTOCOL not in offered:
        await websocket.close(1008, f"this server speaks {SUBPROTOCOL}: reload the page")
        return False
    return True


async def _first_of(websocket: WebSocket, *works: Awaitable[None]) -> None:
    """Run until one ends; a broken rule closes the socket with its reason."""
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for error in results:
        if isinstance(error, ProtocolError):
            await websocket.close(1008, str(error).encode()[:120].decode("utf-8", "ignore"))
        elif isinstance(error, Exception) and not isinstance(error, WebSocketDisconnect):
            raise error


async def _tell(websocket: WebSocket, listener: Listener) -> None:
    while True:
        for text in await listener.heard():
            await websocket.send_text(text)


async def _hear_nothing(websocket: WebSocket) -> None:
    """Wait for the page's end; it has nothing to say but signs of life."""
    signs = Allowance(2, 20)
    while True:
        got = await websocket.receive()
        if got["type"] == "websocket.disconnect":
            return
        if not signs.take():
            raise ProtocolError("too many messages: a page only listens here")


async def _pass_on(websocket: WebSocket, hub: Hub, key: str) -> None:
    allowed = Allowance(120, 240)
    while True:
        got = await websocket.receive()
        if got["type"] == "websocket.disconnect":
            return
        if not allowed.take():
            raise ProtocolError("too many messages: this phone was closed for flooding")
        _tell_page(hub, key, "turn", message(turn=turn_of(got.get("text"))))


def turn_of(text: str | None) -> list[float]:
    """Read the message of a phone: ``{"turn": [yaw, pitch, roll]}``, degrees.

    Raises
    ------
    ProtocolError
        If it is anything else.
    """
    try:
        content = json.loads(text or "")
        if set(content) != {"turn"} or len(content["turn"]) != 3:
            raise ValueError
        angles = [float(v) for v in content["turn"] if not isinstance(v, bool | str)]
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
        angles = []
    if len(angles) != 3 or not all(isfinite(v) and abs(v) <= 360.0 for v in angles):
        raise ProtocolError("a phone says its turn: yaw, pitch and roll in degrees, from -360 to 360")
    return angles


def _tell_page(hub: Hub, key: str, kind: str, text: str) -> None:
    for listener in hub.of_key(key):
        listener.tell(kind, text)
