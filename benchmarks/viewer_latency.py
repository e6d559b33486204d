"""From the pointer to the drawn frame, in headless Chromium: real mouse events, the page's own clock.

The page sends a command with its clock at the animation frame that follows the mouse event; the server returns that
time with the first snapshot that shows the command; the page takes the difference when it draws that frame. One
display frame (16.7 ms) is the floor. Without a graphics card Chromium draws in software.

    python benchmarks/viewer_latency.py --model tps --size 700x520
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from math import sin

import numpy as np
from playwright.sync_api import sync_playwright

FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
GATHER = """() => {
  window.samples = [];
  new MutationObserver(() => {
    const list = document.getElementById('stage').dataset.latency;
    if (list) window.samples.push(...JSON.parse(list));
  }).observe(document.getElementById('stage'), { attributes: true, attributeFilter: ['data-latency'] });
}"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="tps")
    parser.add_argument("--mesh", default="40x30")
    parser.add_argument("--size", default="700x520", help="of the window in pixels")
    parser.add_argument("--seconds", type=float, default=8.0)
    options = parser.parse_args()
    width, height = (int(part) for part in options.size.split("x"))
    with tempfile.TemporaryDirectory() as folder:
        server = subprocess.Popen(
            [sys.executable, "-m", "echospline", "live", "--no-browser", "--port", "0", "--model", options.model,
             "--mesh", options.mesh, "--sessions", f"{folder}/sessions.sqlite"],
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            assert server.stderr is not None
            found = None
            while not found:
                line = server.stderr.readline()
                assert line, "the server did not start"
                found = re.search(r"http://\S+", line)
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
                page = browser.new_page(viewport={"width": width, "height": height})
                page.goto(found.group())
                page.wait_for_selector("#stage[data-ready=true][data-step]", timeout=60_000)
                page.evaluate(GATHER)
                box = page.locator("#stage").bounding_box()
                x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
                page.mouse.move(x, y)
                page.mouse.down()
                begun = time.perf_counter()
                first = int(page.get_attribute("#stage", "data-step"))
                while (t := time.perf_counter() - begun) < options.seconds:
                    page.mouse.move(x + 60 * sin(2 * t), y + 60 * sin(2 * t))
                last = int(page.get_attribute("#stage", "data-step"))
                page.mouse.up()
                page.wait_for_timeout(700)
                samples = page.evaluate("window.samples")
                step = page.text_content("#step")
                browser.close()
        finally:
            server.terminate()
            server.wait(10)
    p50, p99 = np.percentile(samples, [50, 99])
    print(
        json.dumps(
            {"model": options.model, "mesh": options.mesh, "window": options.size, "samples": len(samples),
             "p50_ms": round(p50, 1), "p99_ms": round(p99, 1), "frames_sent_per_second": round((last - first) / options.seconds, 1),
             "model_step_ms": step, "load_average": round(os.getloadavg()[0], 1)}
        )
    )  # fmt: skip


if __name__ == "__main__":
    main()
