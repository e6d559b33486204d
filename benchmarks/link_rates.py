"""Rates and ages of the OpenIGTLink link on loopback, everything in one run: python benchmarks/link_rates.py [--seconds 5]

Peers are processes of their own. The age of an image is the time from its stamp to the moment when the peer has it
decoded, check sum included. "bare sockets" moves the same bytes with nothing around them: the floor on this machine in
this minute. CPU is of the sending process, in cores.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.cli.link import make_stage
from echospline.cli.link_space import make_spatial_stage
from echospline.openigtlink import Link, Looks, Message, Rates, Session, SessionOptions, Transform
from echospline.openigtlink.crc64 import crc64
from echospline.openigtlink.decoder import Decoder
from echospline.openigtlink.image import Image
from echospline.openigtlink.message import encode
from echospline.openigtlink.outgoing import draw
from echospline.openigtlink.peer import Peer
from echospline.picture import Drawing
from echospline.scenario import Scenario
from echospline.scene import AXIAL, Visible, probe_plane

SIDE, WARM_UP = 512, 0.5
PICTURE = np.random.default_rng(1).integers(0, 256, (1, SIDE, SIDE), dtype=np.uint8)


def needle(now: float) -> np.ndarray:
    """Tip of a needle that goes straight down and up again, 2 to 22 mm deep, in the default (axial) plane."""
    depth = 12 + 10 * np.sin(now)
    return np.array([[1, 0, 0, -25.0], [0, 0, -1, -depth], [0, 1, 0, 0], [0, 0, 0, 1]])


def probe(now: float) -> np.ndarray:
    """Frame of a probe that sweeps and turns over the middle of a volume in its default place."""
    return AXIAL @ probe_plane((3 * np.sin(now), 0.0, 2 * np.cos(now)), 10 * np.sin(now)).matrix


def listen(
    port: int, seconds: float, pause: float, transforms: float, pipe: Connection, space: bool = False
) -> None:
    """Peer process: read images (sleeping ``pause`` after each), send transforms (in space the probe's too); report ages and counts."""
    sys.setswitchinterval(0.0005)  # the peer's two threads shall not wait 5 ms for each other
    connection = socket.create_connection(("127.0.0.1", port))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    until = time.time() + seconds
    sent = 0

    def speak() -> None:
        nonlocal sent
        due = time.monotonic()
        while time.time() < until:
            connection.sendall(
                encode(Message(Transform(needle(time.time())), "NeedleTipToReference", time.time()))
            )
            if space:
                connection.sendall(
                    encode(Message(Transform(probe(time.time())), "ProbeToReference", time.time()))
                )
            sent += 1
            due += 1 / transforms
            time.sleep(max(0.0, due - time.monotonic()))

    speaker = threading.Thread(target=speak)
    if transforms:
        speaker.start()
    decoder, ages, stamps, began = Decoder(), [], [], time.time()
    connection.settimeout(1.0)
    while time.time() < until:
        try:
            data = connection.recv(1 << 16)
        except TimeoutError:
            continue
        if not data:
            break
        for message in decoder.feed(data):
            if message.type == "IMAGE":
                now = time.time()
                if now - began > WARM_UP:
                    ages.append(now - message.timestamp)
                    stamps.append(message.timestamp)
                if pause:
                    time.sleep(pause)
    if transforms:
        speaker.join()
    pipe.send((ages, stamps, sent))
    connection.close()


def bare(seconds: float, rate: float) -> list[float]:
    """Ages of the same bytes over a bare socket pair, sender and receiver in processes of their own."""
    server = socket.create_server(("127.0.0.1", 0))
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.Process(target=_bare_peer, args=(server.getsockname()[1], theirs))
    process.start()
    connection, _ = server.accept()
    blob, due = bytes(PICTURE), time.monotonic()
    until = due + seconds
    while time.monotonic() < until:
        connection.sendall(struct.pack("d", time.time()) + blob)
        due += 1 / rate
        time.sleep(max(0.0, due - time.monotonic()))
    connection.close()
    ages: list[float] = ours.recv()
    process.join()
    return ages[int(WARM_UP * rate) :]


def _bare_peer(port: int, pipe: Connection) -> None:
    connection = socket.create_connection(("127.0.0.1", port))
    size, buffer, ages = 8 + SIDE * SIDE, bytearray(), []
    while data := connection.recv(1 << 20):
        buffer += data
        while len(buffer) >= size:
            ages.append(time.time() - struct.unpack_from("d", buffer)[0])
            del buffer[:size]
    pipe.send(ages)


def linked(seconds: float, rate: float, peers: list[tuple[float, float]]) -> dict[str, Any]:
    """Run the link with peers of (pause after each image, transforms per second); first peer's numbers and the link's."""
    arrived: list[float] = []

    def received(_: Peer, message: Message) -> None:
        arrived.append(time.time() - message.timestamp)

    async def run() -> dict[str, Any]:
        link = Link(received)
        port = await link.serve("127.0.0.1", 0)
        pipes, processes = [], []
        for pause, transforms in peers:
            ours, theirs = multiprocessing.Pipe()
            processes.append(
                multiprocessing.Process(target=listen, args=(port, seconds + 1.5, pause, transforms, theirs))
            )
            pipes.append(ours)
            processes[-1].start()
        while len(link.peers) < len(peers):
            await asyncio.sleep(0.01)
        due, cpu = time.monotonic(), time.process_time()
        began, published = due, 0
        while time.monotonic() < began + seconds:
            link.publish(Message(Image(PICTURE, np.eye(4)), "Image", time.time()))
            published += 1
            due += 1 / rate
            await asyncio.sleep(max(0.0, due - time.monotonic()))
        cpu = (time.process_time() - cpu) / (time.monotonic() - began)
        skipped = [p.skipped for p in link.peers]
        results = []
        for pipe, process in zip(pipes, processes, strict=True):
            while not pipe.poll():
                await asyncio.sleep(0.01)
            results.append(pipe.recv())
            process.join()
        await link.close()
        return {
            "published": published,
            "cpu": cpu,
            "skipped": skipped,
            "peers": results,
            "arrived": list(arrived),
        }

    return asyncio.run(run())


def whole(seconds: float) -> None:
    """Run the whole session: a tracked needle in the sample image, 30 pictures per second, tissue, picture and link together."""
    stage = make_stage(Scenario(), Path())
    stage.engine.step()
    with threadpool_limits(limits=1), Session(stage, SessionOptions(port=0, rates=Rates(30.0))) as session:
        ours, theirs = multiprocessing.Pipe()
        arguments = (session.port, seconds + 1.5, 0.0, 250.0, theirs)
        process = multiprocessing.Process(target=listen, args=arguments)
        began, cpu = time.monotonic(), time.process_time()
        process.start()
        ages, _, _ = ours.recv()
        cores = (time.process_time() - cpu) / (time.monotonic() - began)
        process.join()
        drawing = Drawing(stage.image, stage.engine.model.grid)
        snapshot, draws = stage.engine.snapshots.latest().value, []
        for _ in range(50):
            start = time.thread_time()
            draw(drawing, snapshot, Visible(0.0, 150.0, 1.0), Looks())
            draws.append(1e3 * (time.thread_time() - start))
    print(
        f"\nwhole session, {stage.image.pixels.shape} pixels, {stage.engine.model.grid.size} nodes, 30 images and 250 transforms per "
        f"second:\n  {len(ages) / seconds:.1f} images/s, age from before drawing {milliseconds(ages)} ms, {cores:.2f} cores; drawing takes "
        f"{np.median(draws):.1f} ms of CPU"
    )


def in_volume(seconds: float, source: str) -> None:
    """Run the whole session in space: a tracked probe that sweeps and a tracked needle, 25 pictures per second."""
    stage = make_spatial_stage(Scenario().with_values({"image.file": source}), Path())
    with threadpool_limits(limits=1), Session(stage, SessionOptions(port=0, rates=Rates(25.0))) as session:
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.Process(
            target=listen, args=(session.port, seconds + WARM_UP, 0.0, 250.0, theirs, True)
        )
        began, cpu = time.monotonic(), time.process_time()
        process.start()
        ages, _, _ = ours.recv()
        cores = (time.process_time() - cpu) / (time.monotonic() - began)
        process.join()
        newest = stage.engine.snapshots.latest().value
    print(
        f"\nwhole session in {source}, {newest.drawn.image.pixels.shape} pixels, {stage.engine.model.grid.size} nodes, 25 pictures and 250 places "
        f"of probe and needle per second:\n  {len(ages) / seconds:.1f} images/s, {cores:.2f} cores"
    )


def milliseconds(ages: list[float]) -> str:
    if not ages:
        return "none"
    p50, p99 = np.percentile(np.array(ages) * 1e3, [50, 99])
    return f"{p50:6.2f} / {p99:6.2f}"


def median_ms(call: Callable[[], object], repeat: int = 200) -> float:
    call()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times)) * 1e3


def codec() -> dict[str, float]:
    """Median times of the codec, ms."""
    image = Message(Image(PICTURE, np.eye(4)), "Image", 1.0)
    transform = Message(Transform(np.eye(4)), "NeedleTipToReference", 1.0)
    data, small, raw = encode(image), encode(transform), bytes(PICTURE)
    times = {
        "copy 256 KiB": median_ms(lambda: bytearray(raw)),
        "CRC-64 of 256 KiB": median_ms(lambda: crc64(raw)),
        "encode IMAGE 512 x 512": median_ms(lambda: encode(image)),
        "decode IMAGE 512 x 512": median_ms(lambda: Decoder().feed(data)),
        "encode TRANSFORM": median_ms(lambda: encode(transform)),
        "decode TRANSFORM": median_ms(lambda: Decoder().feed(small)),
    }
    try:
        import pyigtl  # noqa: PLC0415
    except ImportError:
        return times
    theirs = pyigtl.ImageMessage(PICTURE, device_name="Image", timestamp=1.0)
    moved = pyigtl.TransformMessage(np.eye(4), device_name="NeedleTipToReference", timestamp=1.0)
    times["pyigtl: encode IMAGE 512 x 512"] = median_ms(theirs.pack)
    times["pyigtl: encode TRANSFORM"] = median_ms(moved.pack)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--rate", type=float, default=60.0)
    parser.add_argument("--out", type=Path)
    parser.add_argument(
        "--volume", help="measure the session in this volume alone: sample:kidney, sample:spine"
    )
    options = parser.parse_args()
    if options.volume:
        in_volume(options.seconds, options.volume)
        return
    report: dict[str, Any] = {"codec_ms": codec(), "rows": []}
    print("codec, median ms")
    for name, ms in report["codec_ms"].items():
        print(f"  {name:32s} {ms:8.4f}")

    floor = bare(options.seconds, options.rate)
    print(f"\n{SIDE} x {SIDE} images offered at {options.rate:g} per second for {options.seconds:g} s")
    print(f"{'':44s} images/s   age ms p50 / p99   transforms/s in   age ms p50 / p99   CPU")
    print(f"{'bare sockets':44s} {len(floor) / (options.seconds - WARM_UP):8.1f}   {milliseconds(floor)}")
    rows = [
        ("one peer", [(0.0, 0.0)]),
        ("one peer that sends 1000 transforms/s", [(0.0, 1000.0)]),
        ("4 peers, each with 250 transforms/s", [(0.0, 250.0)] * 4),
        ("with a second peer that reads 5 images/s", [(0.0, 1000.0), (0.2, 0.0)]),
    ]
    for name, peers in rows:
        result = linked(options.seconds, options.rate, peers)
        ages, _, _ = result["peers"][0]
        into = len(result["arrived"]) / (options.seconds + 1.5)
        print(
            f"{name:44s} {len(ages) / (options.seconds - WARM_UP):8.1f}   {milliseconds(ages)}   "
            f"{into:15.0f}   {milliseconds(result['arrived']):>16s}   {result['cpu']:.2f}"
        )
        row = {"name": name, "ages": ages, "arrived": result["arrived"], "cpu": result["cpu"]}
        if name.startswith("with a second"):
            slow, _, _ = result["peers"][1]
            behind = np.percentile(np.array(slow) * options.rate, [50, 99]) if slow else (np.nan, np.nan)
            print(
                f"{'  the slow peer itself':44s} {len(slow) / (options.seconds - WARM_UP):8.1f}   {milliseconds(slow)}"
                f"   ({behind[0]:.0f} / {behind[1]:.0f} frames behind; {max(result['skipped'])} skipped)"
            )
            row["slow"] = slow
        report["rows"].append(row)
    whole(options.seconds)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(report))


if __name__ == "__main__":
    main()
