"""A session: a tracker moves the needle of a live engine, and its peers receive the deformed picture."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

import numpy as np

from echospline.errors import EchosplineError, InputError
from echospline.live import LiveEngine, Pacer, SpatialEngine
from echospline.openigtlink.followed import Fault, Followed, FollowedPlane
from echospline.openigtlink.followed_volume import FollowedVolume
from echospline.openigtlink.link import Link
from echospline.openigtlink.message import Message, Request
from echospline.openigtlink.orders import Order, answer, carry_out, order_of
from echospline.openigtlink.peer import Peer
from echospline.openigtlink.pose import Position, Transform
from echospline.openigtlink.stage import AnyStage, SessionOptions, SpatialStage
from echospline.openigtlink.text import Status
from echospline.openigtlink.tools import (
    STREAMED_ON_REQUEST,
    TRACKER_FRAME,
    QuaternionTrackingData,
    StartTracking,
    TrackingData,
    transform_name,
)
from echospline.scene import Floats, ImagingPlane, NeedlePose, SpatialPose

log = logging.getLogger("echospline.openigtlink")

STATUS_KEY = "TransformStatus"
"""Metadata of a transform in which PLUS gives its status."""


class Session:
    """Runs a link and a stage; use it as a context.

    Three threads work beside the caller's: the engine steps, the link sends and receives, and one draws pictures; each
    passes only its newest result on, so that none waits for another.

    Parameters
    ----------
    stage : Stage or SpatialStage
        The simulated scene.
    options : SessionOptions
        Options of link and pictures.
    load : callable, optional
        Builds the stage of the name in a LoadScenario order; without it such orders are refused.
    moved : callable, optional
        Called with the pose whenever the tracker moves the needle, and whether tracking of it has just begun (a page follows it).
    tracked : callable, optional
        Called with a sentence when the needle's tracking is lost, and with an empty one when it returns.
    placed : callable, optional
        Called with the probe's plane whenever the tracker moves it in a volume.
    """

    def __init__(
        self,
        stage: AnyStage,
        options: SessionOptions | None = None,
        load: Callable[[str], AnyStage] | None = None,
        moved: Callable[[NeedlePose | SpatialPose, bool], None] | None = None,
        tracked: Callable[[str], None] | None = None,
        placed: Callable[[ImagingPlane], None] | None = None,
    ) -> None:
        self.options = options or SessionOptions()
        self.port = 0
        """Port actually bound, once the context is entered."""
        self._load, self._moved, self._tracked, self._placed = load, moved, tracked, placed
        self._stop = threading.Event()
        self._ready = threading.Event()
        self._error: BaseException | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._following = False
        self._followed = 0.0
        self._scene, self._pacer = self._followed_of(stage), Pacer(stage.engine)
        self._link = Link(
            self._received,
            self.status,
            self.options.limits,
            frozenset(STREAMED_ON_REQUEST),
            start_and_stop(self.options, stage.engine.period),
        )
        self._threads = [
            threading.Thread(target=self._run_link, name="echospline-link", daemon=True),
            threading.Thread(target=self._draw, name="echospline-picture", daemon=True),
        ]

    # ---- for the caller

    def __enter__(self) -> Self:
        self._pacer.start()
        for thread in self._threads:
            thread.start()
        self._ready.wait()
        if self._error is not None:
            self.stop()
            raise self._error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def stop(self) -> None:
        """End all threads."""
        self._stop.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(5.0)
        self._pacer.stop()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the session ends; returns whether it did."""
        return self._stop.wait(timeout)

    @property
    def peers(self) -> tuple[str, ...]:
        """Addresses of the programs connected now."""
        return tuple(peer.name for peer in self._link.peers)

    @property
    def engine(self) -> LiveEngine | SpatialEngine:
        """The engine in use."""
        return self._scene.stage.engine

    def status(self) -> Status:
        """Return the answer to GET_STATUS: the needle, the model and faults."""
        return self._scene.status()

    def _followed_of(self, stage: AnyStage) -> Followed:
        if isinstance(stage, SpatialStage):
            return FollowedVolume(stage, self.options, self._moved, self._placed)
        return FollowedPlane(stage, self.options, self._moved)

    # ---- the link's thread

    def _run_link(self) -> None:
        try:
            asyncio.run(self._serve_link())
        except BaseException as error:  # handed to the thread that waits in __enter__, or logged
            if self._ready.is_set():
                log.exception("the link ended")
            self._error = error
        finally:
            self._stop.set()
            self._ready.set()

    async def _serve_link(self) -> None:
        self._loop = asyncio.get_running_loop()
        try:
            if self.options.host:
                self.port = await self._link.serve(self.options.host, self.options.port)
            for host, port in self.options.connect:
                self._link.connect(host, port)
            self._ready.set()
            while not self._stop.is_set():
                self._locate()  # silence is noticed without a message
                await asyncio.sleep(0.05)
        finally:
            await self._link.close()

    def _received(self, peer: Peer, message: Message) -> None:
        content = message.content
        if isinstance(content, Transform):
            self._put(message, message.device, content.matrix)
        elif isinstance(content, Position):
            try:
                matrix = content.matrix()
            except InputError:
                matrix = np.full((4, 4), np.nan)  # refused as every matrix that no tool can have
            self._put(message, message.device, matrix)
        elif isinstance(content, TrackingData | QuaternionTrackingData):
            self._put_tools(message, content)
        else:
            try:
                order = order_of(message)
            except InputError as error:
                peer.answer(answer(message, str(error), done=False))
                return
            if order is not None:
                self._carry_out(peer, message, order)

    def _put(self, message: Message, name: str, matrix: Floats) -> None:
        now = self._now()
        try:
            self._scene.put(name, matrix, message.metadata.get(STATUS_KEY, ""), now)
        finally:
            self._follow_soon()

    def _put_tools(self, message: Message, content: TrackingData | QuaternionTrackingData) -> None:
        """Take every tool that can be taken; then raise for the first that cannot."""
        refused: InputError | None = None
        for tool in content.tools:
            try:
                self._put(message, transform_name(tool), tool.matrix)
            except InputError as error:
                refused = refused or error
        if refused is not None:
            raise refused

    def _now(self) -> float:
        assert self._loop is not None  # messages come while it runs
        return self._loop.time()

    def _follow_soon(self) -> None:
        """Follow the newest transforms once per step, however many come."""
        if self._following or self._loop is None:
            return
        self._following = True
        pause = self._followed + self._scene.stage.engine.period - self._loop.time()
        self._loop.call_later(max(0.0, pause), self._follow)

    def _follow(self) -> None:
        self._following, self._followed = False, self._now()
        self._locate()
        self._scene.follow()

    def _locate(self) -> Fault:
        """Locate plane and needle; a change of their fault is logged once, and told once to the pages."""
        before, now = self._scene.located, self._scene.locate(self._now())
        if (now.fault, now.about) != (before.fault, before.about):
            if now.fault == "":
                log.info("tracking is back: %s", before.about or "the needle")
            elif now.fault != "Refused":  # the peer's refusal has logged that
                log.warning("%s", now.trouble)
            if self._tracked is not None and (now.held or before.held):
                self._tracked(f"The tracker: {now.trouble}" if now.held else "")
        return now

    def _carry_out(self, peer: Peer, message: Message, order: Order) -> None:
        log.info("%s orders: %s %s", peer.name, order.name, order.argument)
        if order.name == "load":
            asyncio.get_running_loop().create_task(self._load_stage(peer, message, order.argument))
            return
        try:
            text, done = carry_out(order, self._scene.stage), True
        except InputError as error:
            text, done = str(error), False
        peer.answer(answer(message, text, done=done))

    async def _load_stage(self, peer: Peer, message: Message, name: str) -> None:
        try:
            if self._load is None:
                raise InputError(
                    "scenarios are not loaded from afar here; start with --scenarios FOLDER to allow it"
                )
            stage = await asyncio.to_thread(self._load, name)
        except EchosplineError as error:
            peer.answer(answer(message, str(error), done=False))
            return
        except Exception as error:  # a scenario may fail in any way; the link and its peers go on
            log.exception("loading %s failed", name)
            peer.answer(answer(message, f"{name} failed: {type(error).__name__}: {error}", done=False))
            return
        old, self._pacer = self._pacer, Pacer(stage.engine)
        self._scene = self._followed_of(stage)
        self._pacer.start()
        await asyncio.to_thread(old.stop)
        peer.answer(answer(message, f"{name} is loaded", done=True))

    def _publish(self, messages: list[Message]) -> None:
        for message in messages:
            self._link.publish(message)

    # ---- the picture's thread

    def _draw(self) -> None:
        self._ready.wait()
        while not self._stop.is_set():
            messages = self._scene.messages(self._stop)
            if messages is None:
                continue
            if self._loop is None or self._loop.is_closed():
                return
            try:
                self._loop.call_soon_threadsafe(self._publish, messages)
            except RuntimeError:  # closed since the check above
                return


def start_and_stop(options: SessionOptions, period: float) -> tuple[Message, Message] | None:
    """Build the messages that start and end the stream of a server that a session connects to; None where it is not asked.

    Parameters
    ----------
    options : SessionOptions
        Its ``ask`` names the type.
    period : float
        Shortest time between two messages, s.
    """
    kind = options.ask
    if not kind:
        return None
    # QTRANS and POSITION are started without a word on the rate
    body = StartTracking(round(1000 * period), TRACKER_FRAME).pack() if kind.endswith("DATA") else b""
    return Message(Request(f"STT_{kind}", body), "echospline"), Message(Request(f"STP_{kind}"), "echospline")
