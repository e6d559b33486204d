"""Load on the live page's server: clients against frames per second, latency and processor time.

Each client behaves as the page does: sixty times a second it draws the newest frame, reports it and moves the
needle. Beside them, one client stops drawing for two seconds (and must get the present afterwards, not the past)
and one never answers. Traffic stays on 127.0.0.1.

    python benchmarks/viewer_load.py --clients 1,8,24 --model tps
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from math import sin
from pathlib import Path

import numpy as np
from websockets.asyncio.client import connect

from echospline.viewer.protocol import PoseCommand, decode_frame, encode_command

FRAME = 1 / 60
TICKS = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100


class Span:
    """What is measured: it begins a second after every client has its first frame (models are built by then)."""

    def __init__(self, clients: int, seconds: float) -> None:
        self.missing, self.seconds, self.all_here = clients, seconds, asyncio.Event()
        self.start = self.end = float("inf")

    def here(self) -> None:
        self.missing -= 1
        if not self.missing:
            self.start = time.perf_counter() + 1.0
            self.end = self.start + self.seconds
            self.all_here.set()

    async def wait(self) -> None:
        async with asyncio.timeout(120):
            await self.all_here.wait()


class Client:
    """One page."""

    def __init__(self, phase: float) -> None:
        self.phase, self.newest, self.received = phase, None, 0
        self.drawn_times: list[float] = []
        self.latencies: list[float] = []
        self.bytes = self.asleep = 0

    async def run(self, address: str, span: Span, *, sleeps: float = 0.0, dead: bool = False) -> None:
        self.span = span
        async with connect(
            f"ws{address[4:]}live", compression=None, max_size=None, open_timeout=60
        ) as socket:
            reader = asyncio.create_task(self._read(socket))
            try:
                if dead:
                    await span.wait()
                    await asyncio.sleep(span.end - time.perf_counter())
                    return
                await self._draw(socket, span, sleeps)
            finally:
                reader.cancel()

    async def _read(self, socket) -> None:
        async for message in socket:
            if isinstance(message, bytes):
                if not self.received:
                    self.span.here()
                self.newest, self.received = message, self.received + 1
                self.bytes += len(message)

    async def _draw(self, socket, span: Span, sleeps: float) -> None:
        number, last, due = 0, 0, time.perf_counter() + self.phase * FRAME
        slept = False
        while (now := time.perf_counter()) < span.end:
            if sleeps and not slept and now > (span.start + span.end) / 2:
                before, slept = self.received, True
                await asyncio.sleep(sleeps)
                self.asleep, now = self.received - before, time.perf_counter()
            drawn = 0
            if self.newest is not None:
                frame = decode_frame(self.newest)
                drawn = frame.number
                if drawn != last and now > span.start:
                    self.drawn_times.append(now)
                    if frame.sent:
                        self.latencies.append(now - frame.sent)
                last = drawn
            number += 1
            t = now + self.phase
            pose = (10.0, 0.0, 50.0 + 3 * sin(0.7 * t), 14.0 + 9.0 * sin(0.9 * t))
            await socket.send(encode_command(PoseCommand(drawn, number, time.perf_counter(), pose)))
            due = max(due + FRAME, now)
            await asyncio.sleep(max(0.0, due - time.perf_counter()))


def processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


async def measure(address: str, pid: int, count: int, seconds: float) -> dict[str, float]:
    clients = [Client(k / max(count, 1)) for k in range(count)]
    slow, dead = Client(0.3), Client(0.6)
    span = Span(len(clients) + 2, seconds)
    jobs = [client.run(address, span) for client in clients]
    jobs += [slow.run(address, span, sleeps=2.0), dead.run(address, span, dead=True)]

    async def watch() -> float:
        await span.wait()
        await asyncio.sleep(span.start - time.perf_counter())
        before = processor_seconds(pid)
        await asyncio.sleep(span.end - time.perf_counter())
        return (processor_seconds(pid) - before) / seconds

    used, *_ = await asyncio.gather(watch(), *jobs)
    latencies = np.concatenate([client.latencies for client in clients]) * 1e3
    gaps = np.concatenate([np.diff(client.drawn_times) for client in clients]) * 1e3
    return {
        "clients": count,
        "frames_per_second": float(np.mean([len(c.drawn_times) for c in clients]) / seconds),
        "slowest_client": float(np.min([len(c.drawn_times) for c in clients]) / seconds),
        "latency_p50_ms": float(np.percentile(latencies, 50)),
        "latency_p99_ms": float(np.percentile(latencies, 99)),
        "gap_p99_ms": float(np.percentile(gaps, 99)),
        "server_cores": used,
        "bytes_per_frame": float(np.sum([c.bytes for c in clients]) / max(1, np.sum([c.received for c in clients]))),
        "dead_client_got_frames": dead.received,
        "frames_while_asleep": slow.asleep,
        "server_ms_per_frame": 1e3 * used * seconds / max(1, sum(len(c.drawn_times) for c in clients)),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clients", default="1,8,24", help="counts, separated by commas")
    parser.add_argument("--model", default="tps")
    parser.add_argument("--mesh", default="40x30")
    parser.add_argument("--seconds", type=float, default=8.0, help="measured for each count, at most 60")
    parser.add_argument("--rate", default="120", help="model steps per second")
    parser.add_argument("--wire", choices=("automatic", "nodes", "splines"), default="automatic")
    parser.add_argument("--json", type=Path, help="write the rows here too")
    options = parser.parse_args()
    counts = [min(int(text), 128) for text in options.clients.split(",")]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "echospline", "live", "--no-browser", "--port", "0", "--model", options.model,
                   "--mesh", options.mesh, "--rate", options.rate, "--clients", "256",
                   "--sessions", f"{folder}/sessions.sqlite"]  # fmt: skip
        command += [] if options.wire == "automatic" else [f"--{options.wire}"]
        server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert server.stderr is not None
            found = None
            while not found:
                line = server.stderr.readline()
                assert line, "the server did not start"
                found = re.search(r"http://\S+", line)
            print(
                f"model {options.model}, mesh {options.mesh}, {options.rate} steps/s, load average {os.getloadavg()[0]:.1f}"
            )
            print(
                "clients   fps  slowest  latency p50   p99 ms   gap p99 ms  server cores  ms/frame  kB/frame"
            )
            for count in counts:
                row = asyncio.run(measure(found.group(), server.pid, count, min(options.seconds, 60.0)))
                rows.append(row)
                print(
                    f"{row['clients']:7d} {row['frames_per_second']:5.1f} {row['slowest_client']:8.1f} {row['latency_p50_ms']:12.1f}"
                    f" {row['latency_p99_ms']:8.1f} {row['gap_p99_ms']:12.1f} {row['server_cores']:13.2f} {row['server_ms_per_frame']:9.2f} {row['bytes_per_frame'] / 1e3:9.1f}",
                    flush=True,
                )
            last = rows[-1]
            print(
                f"the client that never draws got {last['dead_client_got_frames']} frames; "
                f"the one that slept for 2 s got {last['frames_while_asleep']} meanwhile"
            )
        finally:
            server.terminate()
            server.wait(10)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
