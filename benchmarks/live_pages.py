"""What 64 pages cost the server of `echospline live`: connected, steered by a tracker, and handing in their sessions.

    python benchmarks/live_pages.py --pages 64 --seconds 20

A page simulates by itself; the server sends it its files once, tells it what a tracker does and runs its sessions again. The numbers are
shares of one core that the server's process takes (its own threads included, the pages are in this process), and seconds of processor a
session.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np
from websockets.asyncio.client import connect

from echospline.page import Pack, parsed_sessions, verify

TICKS = os.sysconf("SC_CLK_TCK")
SERVER = """
import sys, threading, time
from pathlib import Path
from echospline.cli.live import scene_of
from echospline.cli.options import scenario_from
from echospline.scene import NeedlePose
from echospline.viewer import Sessions, Settings, build_app, serve, steer

rate = float(sys.argv[1])
scenario, folder = scenario_from("sample:calf", {})
scenario, image = scenario.opened(folder, eight_bit=True)
app = build_app(scene_of(scenario, image, folder), Sessions(Path(sys.argv[2])), Settings(port=0))

def track():
    depth, begun = 0.0, time.monotonic()
    for k in range(10**9):
        steer(app, NeedlePose((20.0, 0.0), (20.0, 10.0 + 0.001 * (k % 5000))), k == 0)
        time.sleep(max(0.0, begun + (k + 1) / rate - time.monotonic()))

if rate:
    threading.Thread(target=track, daemon=True).start()
serve(app, Settings(port=0), lambda address, _: print(address, flush=True))
"""


def processor(pid: int) -> float:
    """Seconds of processor that a process has taken."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


async def listen(address: str, heard: list[int], line_up: asyncio.Semaphore) -> None:
    """One page: it listens, and counts what it hears."""
    async with connect(f"ws{address[4:]}poses?room={os.urandom(16).hex()}", compression=None) as line:
        line_up.release()
        async for _ in line:
            heard[0] += 1


async def share(address: str, pid: int, pages: int, seconds: float) -> tuple[float, float]:
    """Share of a core that the server takes while pages listen, and messages a second and page."""
    heard, up = [0], asyncio.Semaphore(0)
    tasks = [asyncio.create_task(listen(address, heard, up)) for _ in range(pages)]
    for _ in range(pages):
        await up.acquire()
    await asyncio.sleep(2.0)
    before, count, begun = processor(pid), heard[0], time.monotonic()
    await asyncio.sleep(seconds)
    took, messages, passed = processor(pid) - before, heard[0] - count, time.monotonic() - begun
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return took / passed, messages / passed / pages


def session(pack: Pack, model: str, seconds: float) -> bytes:
    """A session of an exercise: in and out again, with the score that its page computes."""
    rate, (x, y) = pack.manifest.rate, pack.manifest.needle.entry
    depth = 12.0 * (1 - np.cos(np.linspace(0, 6 * np.pi, round(rate * seconds)))) / 2
    speed = np.diff(depth, prepend=0.0) * rate
    rows = np.column_stack(
        [np.full_like(depth, x), np.full_like(depth, y), np.full_like(depth, x), y + depth, speed]
    )
    told = {
        "format": 1, "kind": "echospline session", "version": "0", "core": "0" * 64, "scene": {"title": pack.manifest.title, "pack": pack.digest},
        "model": model, "exercise": pack.manifest.exercises[0].model_dump(mode="json"), "trainee": "Bench", "attempt": 1,
        "started": "2026-03-01T10:00:00Z", "rate": rate, "ended": "finished", "steps": len(rows),
        "poses": base64.b64encode(rows.astype("<f8").tobytes()).decode(), "planes": None, "events": [], "score": None,
    }  # fmt: skip
    (read,) = parsed_sessions(json.dumps(told).encode(), "bench")
    return json.dumps({**told, "score": verify(pack, read).score.to_dict()}).encode()


def main() -> None:
    """Measure and print."""
    arguments = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    arguments.add_argument("--pages", type=int, default=64)
    arguments.add_argument("--seconds", type=float, default=20.0)
    given = arguments.parse_args()
    resource.setrlimit(resource.RLIMIT_NOFILE, (4096, 4096))
    print(f"{given.pages} pages, load average {os.getloadavg()[0]:.1f}")
    for rate in (0.0, 60.0, 120.0):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-c", SERVER, str(rate), str(Path(folder) / "sessions.sqlite")]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
                assert server.stdout is not None
                address = server.stdout.readline().strip()
                assert re.match(r"http://", address), "the server did not start"
                try:
                    took, messages = asyncio.run(share(address, server.pid, given.pages, given.seconds))
                    what = f"steered at {rate:.0f}/s" if rate else "connected"
                    print(f"{what}: {took:.3f} cores, {messages:.0f} messages a second to each page")
                    if rate == 0:
                        hand_in(address, server.pid)
                finally:
                    server.terminate()


def hand_in(address: str, pid: int) -> None:
    """Hand in a minute's session of every model."""
    with urllib.request.urlopen(f"{address}pack") as answer:
        pack = Pack.from_bytes(answer.read())
    for model in [model.name for model in pack.manifest.models]:
        body = session(pack, model, 60.0)
        before, begun = processor(pid), time.monotonic()
        with urllib.request.urlopen(
            urllib.request.Request(f"{address}api/sessions", body, method="POST")
        ) as answer:
            told = json.load(answer)
        assert told["verified"], told
        print(
            f"a session of 60 s by {model} ({len(body) / 1000:.0f} kB): {processor(pid) - before:.2f} s of processor, "
            f"answered after {time.monotonic() - begun:.2f} s"
        )


if __name__ == "__main__":
    main()
