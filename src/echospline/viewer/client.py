"""One page's connection: its engine, its frames (pulled, at most two in flight) and its exercise."""

from __future__ import annotations

import asyncio
import json
import logging
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from echospline.errors import EchosplineError, InputError, ProtocolError
from echospline.live import LiveEngine, Numbered, Pacer, Recorder, Snapshot, Trace
from echospline.scene import NeedlePose
from echospline.viewer import protocol
from echospline.viewer.aside import aside
from echospline.viewer.exercise import Exercise
from echospline.viewer.guard import Allowance
from echospline.viewer.scoring import Score, score
from echospline.viewer.served_scene import Scene, tip_of
from echospline.viewer.sessions import Session, Sessions
from echospline.viewer.words import for_page

log = logging.getLogger(__name__)

IN_FLIGHT = 2
"""Frames sent and not yet drawn; with two, one is on its way while the other is drawn."""
PLOT_POINTS = 400
"""Points of the summary's plot."""
FASTEST_DISPLAY, AHEAD = 1 / 60, 0.008
"""s; a frame is sent this long before the next refresh of the page (predicted from its reports) and not sooner:
a snapshot sent at once would be outdated by then, and a second one would have to follow it."""
STILL, KEEP_ALIVE = 5e-4, 0.1
"""mm and s: while nothing moves further than that from the picture shown, frames are sent only at this interval."""
NODES_UP_TO = 4000
"""Mesh nodes beyond which a spline's weights are sent instead, where the model offers them: fitting them takes the
server longer than sending 9.6 kB of 1200 nodes, and less than the 160 kB of 20 000."""
HISTORY = 50
"""Earlier sessions of the same exercise in the summary."""


@dataclass
class Training:
    """A running exercise, or the replay of one (of a stored session)."""

    exercise: Exercise
    recorder: Recorder
    trainee: str = ""
    session: int | None = None


class Seat:
    """An engine with its scene and exercise; it is kept for a while after its page closes, so that a reload resumes."""

    def __init__(self, scene: Scene, rate: float) -> None:
        self.scene = scene
        self.engine = LiveEngine(scene.models, scene.names[0][0], scene.home, rate=rate)
        self.training: Training | None = None
        self.model, self.compared = scene.names[0][0], ""

    def end_training(self) -> None:
        """Stop recording and stop watching the targets."""
        if self.training is not None:
            self.engine.unobserve(self.training.recorder)
            self.training = None
            self.engine.watch(np.empty((0, 2)))


class Client:
    """Serves one web socket until it closes.

    Parameters
    ----------
    socket : WebSocket
        Accepted.
    seat : Seat
        The engine; this client runs it while it is connected.
    sessions : Sessions
        Storage of finished exercises.
    nodes : bool, optional
        Send node displacements even where the model offers a spline; by default up to `NODES_UP_TO` nodes.
    """

    def __init__(
        self, socket: WebSocket, seat: Seat, sessions: Sessions, *, nodes: bool | None = None
    ) -> None:
        self._nodes = seat.scene.grid.size <= NODES_UP_TO if nodes is None else nodes
        self.socket, self.seat, self.sessions = socket, seat, sessions
        self._sent = self._drawn = self._number = 0
        self._credit, self._sending = asyncio.Event(), asyncio.Lock()
        self._commands, self._requests = Allowance(400, 400), Allowance(20, 40)
        self._reported, self._intervals = 0.0, deque([FASTEST_DISPLAY], maxlen=16)
        self._failure: str | None = None
        self._pacer = Pacer(seat.engine)
        self._told: asyncio.Queue[tuple[str, dict[str, object]]] = asyncio.Queue()
        self._loop = asyncio.get_running_loop()
        self._credit.set()

    async def serve(self, resumed: bool) -> None:
        """Serve until the page closes or breaks the protocol; `leave` then ends the engine's thread."""
        await self._send_text("scene", **self._describe(resumed))
        self._pacer.start()
        tasks = [
            asyncio.create_task(self._receive()),
            asyncio.create_task(self._send_frames()),
            asyncio.create_task(self._send_told()),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        for error in results:
            await self._close(error)

    async def leave(self) -> None:
        """End the engine's thread; it may be building a model, and nobody else waits for that."""
        await aside(self._pacer.stop)

    def tell(self, what: str, **content: object) -> None:
        """Send a message to the page; any thread may call."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._told.put_nowait, (what, content))

    async def _send_told(self) -> None:
        while True:
            what, content = await self._told.get()
            await self._send_text(what, **content)

    def _describe(self, resumed: bool) -> dict[str, Any]:
        newest = self.seat.engine.snapshots.latest()
        assert newest is not None  # the engine puts one when it is made
        pose = newest.value.pose
        training = self.seat.training
        return {
            "scene": self.seat.scene.describe(),
            "period": self.seat.engine.period,
            "resumed": resumed,
            "pose": {"entry": pose.entry, "tip": pose.tip},
            "model": newest.value.model,
            "frozen": newest.value.frozen,
            "running": training.exercise.name if training and training.session is None else None,
        }

    # --- from the page

    async def _receive(self) -> None:
        while True:
            message = await self.socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            if (data := message.get("bytes")) is not None:
                if not self._commands.take():
                    raise ProtocolError("too many messages: this page was closed for flooding")
                self._take_command(protocol.decode_command(data))
            else:
                if not self._requests.take():
                    raise ProtocolError("too many requests: this page was closed for flooding")
                await self._answer(protocol.decode_request(message["text"]))

    def _take_command(self, command: protocol.PoseCommand) -> None:
        if command.drawn > self._sent or command.drawn < self._drawn:
            raise ProtocolError(
                f"frames {self._drawn} to {self._sent} can have been drawn now; got {command.drawn}"
            )
        if command.number <= self._number:
            raise ProtocolError(f"command numbers ascend; got {command.number} after {self._number}")
        if command.drawn > self._drawn:
            now = asyncio.get_running_loop().time()
            self._intervals.append(now - self._reported)
            self._reported = now
        self._drawn, self._number = command.drawn, command.number
        if self._sent - self._drawn < IN_FLIGHT:
            self._credit.set()
        if command.pose is not None:
            x, y, angle, depth = command.pose
            self.seat.engine.command((x, y), tip_of((x, y), angle, depth), command.number, command.sent)

    async def _answer(self, request: protocol.Request) -> None:
        engine, names = self.seat.engine, [name for name, _ in self.seat.scene.names]
        match request:
            case protocol.Reset():
                if self.seat.training and self.seat.training.session is not None:
                    self.seat.end_training()
                engine.reset()
            case protocol.Freeze(on=on):
                engine.freeze(on)
            case protocol.SwitchModel(name=name) if name in names:
                engine.switch(name)
            case protocol.Compare(name=name) if name is None or name in names:
                engine.compare(name)
            case protocol.SwitchModel(name=name) | protocol.Compare(name=name):
                await self._send_text(
                    "notice", text=f"there is no model {name!r} here; it has {', '.join(names)}"
                )
            case protocol.StartExercise():
                await self._start(request)
            case protocol.FinishExercise(keep=keep):
                await self._finish(keep)
            case protocol.Replay(session=number):
                await self._replay(number)

    # --- training

    async def _start(self, request: protocol.StartExercise) -> None:
        exercise = self.seat.scene.exercise(request.exercise)
        if exercise is None:
            await self._send_text("notice", text=f"there is no exercise {request.exercise!r} here")
            return
        self._begin(
            Training(exercise, Recorder(self.seat.engine.period, exercise.time_limit), request.trainee)
        )
        self.seat.engine.reset()
        await self._send_text("running", exercise=exercise.name, replay=False)

    def _begin(self, training: Training) -> None:
        self.seat.end_training()
        self.seat.training = training
        self.seat.engine.watch(training.exercise.landmarks)
        self.seat.engine.observe(training.recorder)

    async def _finish(self, keep: bool) -> None:
        training, newest = self.seat.training, self.seat.engine.snapshots.latest()
        if training is None or newest is None:
            await self._send_text("notice", text="no exercise is running")
            return
        trace, model = training.recorder.trace(), newest.value.model
        self.seat.end_training()
        if not keep:
            await self._send_text("stopped")
            return
        summary = await aside(self._summary, training, trace, model)
        await self._send_text("summary", **summary)

    def _summary(self, training: Training, trace: Trace, model: str) -> dict[str, Any]:
        result = score(trace, training.exercise)
        number, again = training.session, training.session is not None
        if number is None:
            number = self.sessions.add(
                training.exercise,
                trace,
                result,
                trainee=training.trainee,
                scene=self.seat.scene.title,
                model=model,
                source=self.seat.scene.source,
                picture=self.seat.scene.picture,
                upload=self.seat.scene.upload,
            )
        history = [
            {"id": s.id, "started": s.started, "score": s.score}
            for s in self.sessions.newest()
            if s.exercise == training.exercise.name and s.trainee == training.trainee
        ]
        return summary_of(number, training.exercise, trace, result) | {
            "replayed": again, "model": model, "trainee": training.trainee, "history": history[:HISTORY],
        }  # fmt: skip

    async def _replay(self, number: int) -> None:
        try:
            session, exercise, trace = await aside(self.sessions.load, number)
            poses = resampled(trace, self.seat.engine.period)
        except EchosplineError as error:
            await self._send_text("notice", text=for_page(str(error), self.sessions.path))
            return
        if not self._shows(session, exercise):
            await self._send_text("elsewhere", session=number, scene=session.upload, text=(
                f"session {number} was recorded in another picture, {session.scene}: it is not replayed in this one"
            ))  # fmt: skip
            return
        recorder = Recorder(self.seat.engine.period, self.seat.engine.period * len(poses))
        self._begin(Training(exercise, recorder, session.trainee, number))
        if session.model in [name for name, _ in self.seat.scene.names]:
            self.seat.engine.switch(session.model)
        self.seat.engine.replay(poses)
        await self._send_text("running", exercise=exercise.model_dump(), replay=True, model=session.model)

    def _shows(self, session: Session, exercise: Exercise) -> bool:
        """Test whether this scene shows the picture of a session; sessions of schema 1 know only its title."""
        scene = self.seat.scene
        if session.picture:
            return session.picture == scene.picture
        return session.scene == scene.title and bool(scene.grid.contains(exercise.landmarks).all())

    # --- to the page

    async def _send_frames(self) -> None:
        number, shown, shown_at = 0, None, 0.0
        loop = asyncio.get_running_loop()
        while True:
            await self._credit.wait()
            refresh = min(FASTEST_DISPLAY, *self._intervals)
            await asyncio.sleep(max(0.0, self._reported + refresh - AHEAD - loop.time()))
            number, snapshot = await self._newer_than(number)
            if shown is not None and loop.time() - shown_at < KEEP_ALIVE and is_still(shown, snapshot):
                continue
            shown, shown_at = snapshot, loop.time()
            if snapshot.failure != self._failure:
                self._failure = snapshot.failure
                if snapshot.failure is not None:
                    await self._send_text(
                        "failure", text=for_page(snapshot.failure, otherwise="its log says why")
                    )
            self._sent += 1
            if self._sent - self._drawn >= IN_FLIGHT:
                self._credit.clear()
            training = self.seat.training
            data = protocol.encode_frame(
                snapshot,
                self._sent,
                recording=training is not None and training.session is None,
                nodes=self._nodes,
            )
            async with self._sending:
                await self.socket.send_bytes(data)
            if training is not None and training.recorder.over:
                await self._finish(keep=True)

    async def _newer_than(self, number: int) -> Numbered[Snapshot]:
        """Wait, without a thread, for a snapshot that this client has not seen."""
        slot, loop, here = self.seat.engine.snapshots, asyncio.get_running_loop(), asyncio.Event()
        newest = slot.latest()
        if newest is not None and newest.number > number:
            return newest

        def wake() -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(here.set)

        slot.call_when_newer(number, wake)
        await here.wait()
        newest = slot.latest()
        assert newest is not None  # the callback has announced it
        return newest

    async def _send_text(self, what: str, **content: object) -> None:
        async with self._sending:
            await self.socket.send_text(json.dumps({"tell": what, **content}, allow_nan=False))

    async def _close(self, error: object) -> None:
        """Close with the reason, if the page is still there."""
        if error is None or isinstance(error, asyncio.CancelledError | WebSocketDisconnect):
            return
        if isinstance(error, ProtocolError):
            log.warning("client closed: %s", error)
            code, reason = 1008, str(error)
        else:
            assert isinstance(error, BaseException)  # a task ends with None or an exception
            log.error("client closed by a fault", exc_info=error)
            code, reason = 1011, "the server has a fault; its log says more"
        if self.socket.application_state is WebSocketState.CONNECTED:
            await self.socket.close(code, reason.encode()[:120].decode("utf-8", "ignore"))


def is_still(shown: Snapshot, now: Snapshot) -> bool:
    """Test whether a frame of ``now`` would look like that of ``shown``: same needle, tissue within `STILL` mm."""
    same = shown.pose == now.pose and shown.command == now.command and shown.model == now.model
    flags = (shown.frozen, shown.replaying, shown.failure) == (now.frozen, now.replaying, now.failure)
    if not (same and flags and len(shown.watched) == len(now.watched)):
        return False
    if (shown.reference is None) != (now.reference is None):
        return False
    return float(np.abs(shown.displacement - now.displacement).max(initial=0.0)) < STILL


def resampled(trace: Trace, period: float) -> list[NeedlePose]:
    """Resample the poses of a trace at an engine's period; unchanged when the periods are equal."""
    if len(trace) == 0:
        raise InputError("this session holds no motion")
    if abs(trace.period - period) < 1e-12:
        return [trace.pose(row) for row in range(len(trace))]
    times = np.arange(1, int(trace.times[-1] / period) + 1) * period
    columns = np.stack([np.interp(times, trace.times, column) for column in trace.poses.T], axis=1)
    return [
        trace.__class__(period, columns, np.empty((len(columns), 0, 2))).pose(k) for k in range(len(columns))
    ]


def summary_of(number: int, exercise: Exercise, trace: Trace, result: Score) -> dict[str, Any]:
    """Build the summary for the page, with few enough points for its plots."""
    if len(trace) == 0:
        rows, distance = np.empty(0, dtype=int), np.empty(0)
    else:
        rows = np.unique(np.linspace(0, len(trace) - 1, PLOT_POINTS).astype(int))
        distance = np.hypot(*(trace.tip - trace.watched[:, 0]).T)
    return {
        "session": number,
        "exercise": exercise.model_dump(),
        "score": result.to_dict(),
        "plot": {
            "time": [round(float(trace.times[row]), 4) for row in rows],
            "depth": [round(float(trace.depth[row]), 4) for row in rows],
            "distance": [round(float(distance[row]), 4) for row in rows],
            "tip": [[round(float(v), 4) for v in trace.tip[row]] for row in rows],
        },
    }
