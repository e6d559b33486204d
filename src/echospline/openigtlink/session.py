"""The session: a tracker drives the needle of a live engine, and its peers see the tissue that answers."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import Self

from echospline.errors import EchosplineError, InputError
from echospline.image import Pixels
from echospline.live import LiveEngine, Metronome, Pacer, Snapshot
from echospline.needle import NeedlePose
from echospline.openigtlink.link import Link
from echospline.openigtlink.message import Message
from echospline.openigtlink.orders import Order, answer, order_of
from echospline.openigtlink.peer import Peer
from echospline.openigtlink.picture import (
    draw,
    image_message,
    mesh_message,
    needle_message,
    target_message,
)
from echospline.openigtlink.pose import Position, Transform
from echospline.openigtlink.scene import TrackedNeedle, Visible
from echospline.openigtlink.stage import SessionOptions, Stage
from echospline.openigtlink.text import NOT_READY, UNKNOWN_ERROR, Status
from echospline.openigtlink.tracking import Located, Tracking

log = logging.getLogger("echospline.openigtlink")

ARRIVES = 1.0
"""mm; a needle first seen deeper than this is put there rather than thrust there."""


class Session:
    """Runs a link and a stage together; use it as a context.

    Three threads work beside the caller's: the engine steps, the link talks, and one draws pictures; each gives
    the next only its newest, so that none waits for another.

    Parameters
    ----------
    stage : Stage
        What is simulated.
    options : SessionOptions
        How.
    load : callable, optional
        Makes a stage of the name that a LoadScenario order gives; without it such orders are refused.
    moved : callable, optional
        Called with the pose whenever the tracker moves the needle, and whether it has just come into sight (a page
        beside it follows).
    """

    def __init__(
        self,
        stage: Stage,
        options: SessionOptions | None = None,
        load: Callable[[str], Stage] | None = None,
        moved: Callable[[NeedlePose, bool], None] | None = None,
    ) -> None:
        self.options = options or SessionOptions()
        self.port = 0
        """Port that was had, once the context is entered."""
        self._load, self._moved = load, moved
        self._stop = threading.Event()
        self._ready = threading.Event()
        self._error: BaseException | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._following = False
        self._followed = 0.0
        self._away = True
        self._stage, self._pacer = stage, Pacer(stage.engine)
        self._tracking = Tracking(stage.image.grid, self.options.looks.naming)
        self._located = self._tracking.locate()
        self._link = Link(self._received, self.status, self.options.limits)
        self._threads = [
            threading.Thread(target=self._talk, name="echospline-link", daemon=True),
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
        """Wait until the session ends; whether it did."""
        return self._stop.wait(timeout)

    @property
    def peers(self) -> tuple[str, ...]:
        """Addresses of the programs connected now."""
        return tuple(peer.name for peer in self._link.peers)

    @property
    def engine(self) -> LiveEngine:
        """The engine in use."""
        return self._stage.engine

    def status(self) -> Status:
        """What GET_STATUS is told: the needle, the model, what is wrong."""
        newest = self._stage.engine.snapshots.latest()
        assert newest is not None  # an engine begins with one
        snapshot, located = newest.value, self._located
        if snapshot.failure:
            return Status(
                UNKNOWN_ERROR,
                0,
                "ModelFailed",
                f"{snapshot.model} failed: {snapshot.failure}; reset to go on",
            )
        if located.trouble:
            return Status(NOT_READY, 0, "Transforms", located.trouble)
        state = "frozen" if snapshot.frozen else "playing" if snapshot.replaying else "live"
        x, y = snapshot.pose.tip
        told = f"{snapshot.model}, {state}; tip {x:.1f} {y:.1f} mm, depth {snapshot.pose.depth:.1f} mm"
        if located.needle is None:
            return Status(text=f"{told}; no tracked needle yet")
        seen = located.needle.seen(self._skin, self.options.reach)
        brightness = 0.0 if seen is None else seen.brightness
        away = "" if located.needle.pose(self._stage.image.grid, self.options.reach) else ", too far to touch"
        return Status(
            text=f"{told}; {located.needle.out_of_plane:+.1f} mm out of plane, tilt {located.needle.tilt:.0f} deg, "
            f"echo {100 * brightness:.0f} %{away}"
        )

    @property
    def _skin(self) -> float:
        return self._stage.image.grid.extent[2]

    # ---- the link's thread

    def _talk(self) -> None:
        try:
            asyncio.run(self._converse())
        except BaseException as error:  # handed to the thread that waits in __enter__, or logged
            if self._ready.is_set():
                log.exception("the link ended")
            self._error = error
        finally:
            self._stop.set()
            self._ready.set()

    async def _converse(self) -> None:
        self._loop = asyncio.get_running_loop()
        try:
            if self.options.host:
                self.port = await self._link.serve(self.options.host, self.options.port)
            for host, port in self.options.connect:
                self._link.connect(host, port)
            self._ready.set()
            while not self._stop.is_set():
                await asyncio.sleep(0.05)
        finally:
            await self._link.close()

    def _received(self, peer: Peer, message: Message) -> None:
        content = message.content
        if isinstance(content, Transform):
            self._tracking.put(message.device, content.matrix)
            self._follow_soon()
        elif isinstance(content, Position):
            self._tracking.put(message.device, content.matrix())
            self._follow_soon()
        else:
            try:
                order = order_of(message)
            except InputError as error:
                peer.answer(answer(message, str(error), done=False))
                return
            if order is not None:
                self._carry_out(peer, message, order)

    def _follow_soon(self) -> None:
        """Follow the newest transforms once per step, however many come."""
        if self._following or self._loop is None:
            return
        self._following = True
        pause = self._followed + self._stage.engine.period - self._loop.time()
        self._loop.call_later(max(0.0, pause), self._follow)

    def _follow(self) -> None:
        assert self._loop is not None  # it calls us
        self._following, self._followed = False, self._loop.time()
        before, self._located = self._located, self._tracking.locate()
        if self._located.trouble != before.trouble and self._located.trouble:
            log.warning("%s", self._located.trouble)
        needle = self._located.needle
        if needle is None:
            return
        engine, pose = self._stage.engine, needle.pose(self._stage.image.grid, self.options.reach)
        # A needle that comes into sight already inserted was not thrust there in this instant.
        appears, self._away = self._away and pose is not None and pose.depth > ARRIVES, pose is None
        pose = pose or engine.home
        (engine.place if appears else engine.command)(pose.entry, pose.tip)
        if self._moved is not None:
            self._moved(pose, appears)

    def _carry_out(self, peer: Peer, message: Message, order: Order) -> None:
        log.info("%s orders: %s %s", peer.name, order.name, order.argument)
        if order.name == "load":
            asyncio.get_running_loop().create_task(self._load_stage(peer, message, order.argument))
            return
        try:
            text, done = self._do(order), True
        except InputError as error:
            text, done = str(error), False
        peer.answer(answer(message, text, done=done))

    def _do(self, order: Order) -> str:
        engine, insertion = self._stage.engine, self._stage.insertion
        if order.name == "start":
            if insertion is None:
                raise InputError("there is no planned insertion to start: load a scenario that has one")
            engine.freeze(False)
            times = (k * engine.period for k in range(1, int(insertion.duration / engine.period) + 1))
            engine.replay(insertion.pose(float(insertion.times[0]) + t) for t in times)
            return f"the planned insertion runs, {insertion.duration:.1f} s"
        if order.name == "stop":
            engine.freeze(True)
            return "time stands still"
        if order.name == "reset":
            engine.reset()
            return "needle and tissue are at rest"
        if order.name in ("freeze", "unfreeze"):
            on = order.name == "freeze" and order.argument.lower() not in ("off", "false", "0")
            engine.freeze(on)
            return "time stands still" if on else "time runs"
        if order.argument not in self._stage.models:
            raise InputError(f"a model is one of {', '.join(self._stage.models)}; got {order.argument!r}")
        engine.switch(order.argument)
        return f"the tissue is {order.argument} now"

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
        except Exception as error:  # a scenario may fail in any way; the link and its peers live on
            log.exception("loading %s failed", name)
            peer.answer(answer(message, f"{name} failed: {type(error).__name__}: {error}", done=False))
            return
        old, self._pacer = self._pacer, Pacer(stage.engine)
        self._tracking = Tracking(stage.image.grid, self.options.looks.naming)
        self._located = replace(self._tracking.locate(), needle=None)
        self._stage, self._away = stage, True
        self._pacer.start()
        await asyncio.to_thread(old.stop)
        peer.answer(answer(message, f"{name} is loaded", done=True))

    def _publish(self, messages: list[Message]) -> None:
        for message in messages:
            self._link.publish(message)

    # ---- the picture's thread

    def _draw(self) -> None:
        self._ready.wait()
        rates = self.options.rates
        clock = Metronome(1.0 / rates.image, time.monotonic())
        last: tuple[Stage, Snapshot, Visible | None] | None = None
        pixels: Pixels | None = None
        mesh_due = status_due = 0.0
        while not self._stop.wait(clock.wait(time.monotonic())):
            stage, located, now = self._stage, self._located, time.time()
            newest = stage.engine.snapshots.latest()
            assert newest is not None  # an engine begins with one
            snapshot, visible = newest.value, self._visible(located.needle)
            try:
                if pixels is None or last is None or _differs(last, (stage, snapshot, visible)):
                    pixels = draw(stage.image, stage.engine.model.grid, snapshot, visible, self.options.looks)
                last = (stage, snapshot, visible)
                messages = self._tell(stage, snapshot, located, pixels, now)
                if rates.mesh and now >= mesh_due:
                    mesh_due = now + 1.0 / rates.mesh
                    messages.append(mesh_message(snapshot, stage.engine.model.grid, located.plane, now))
            except EchosplineError as error:
                log.warning("no picture: %s", error)
                continue
            if rates.status and now >= status_due:
                status_due = now + 1.0 / rates.status
                messages.append(Message(self.status(), "echospline", now))
            if self._loop is None or self._loop.is_closed():
                return
            try:
                self._loop.call_soon_threadsafe(self._publish, messages)
            except RuntimeError:  # closed since we looked
                return

    def _visible(self, needle: TrackedNeedle | None) -> Visible | None:
        """A needle that nobody tracks (a planned insertion, a page) lies in the plane."""
        if needle is None:
            return Visible(0.0, self.options.reach.shaft, 1.0)
        return needle.seen(self._skin, self.options.reach)

    def _tell(
        self, stage: Stage, snapshot: Snapshot, located: Located, pixels: Pixels, now: float
    ) -> list[Message]:
        looks = self.options.looks
        messages = image_message(pixels, stage.image.grid, located.plane, looks, now)
        messages.append(needle_message(snapshot, located.plane, looks.naming, now))
        targets = target_message(snapshot, located.plane, looks.naming, now)
        return messages if targets is None else [*messages, targets]


def _differs(
    last: tuple[Stage, Snapshot, Visible | None], now: tuple[Stage, Snapshot, Visible | None]
) -> bool:
    (stage, snapshot, visible), (new_stage, new, new_visible) = last, now
    return (
        stage is not new_stage
        or visible != new_visible
        or snapshot.pose != new.pose
        or not (snapshot.displacement == new.displacement).all()
    )
