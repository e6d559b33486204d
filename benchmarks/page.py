"""The page of one file in headless Chromium with software rendering: rates, delays, sizes, memory, and the engine against the native core.

Every figure is of one run on one machine; the engine is a ratio to the native core of the same run, on the same scene and the same poses.
The pointer is moved by synthetic events on the stage; "drawn" is the end of the frame that showed them.

    python benchmarks/page.py                 # a speckle picture of 512 x 512 over a mesh of 1200 nodes
    python benchmarks/page.py --minutes 10    # memory over so many minutes
    python benchmarks/page.py --page trainer.html --skip-engine
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from playwright.sync_api import Browser, CDPSession, Page, sync_playwright

FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
SIZES = {"1440 x 900": (1440, 900, 1, 55), "390 x 844 at ratio 3": (390, 844, 3, 45)}
"""Width, height, device pixels per CSS pixel, frames/s that are wanted."""
WATCH = """new MutationObserver((_, watch) => {
  if (document.getElementById('stage')?.dataset.ready) { window.firstPicture ??= performance.now(); watch.disconnect(); }
}).observe(document, { attributes: true, subtree: true, attributeFilter: ['data-ready'] });"""
STEER = """(seconds) => new Promise((done) => {
  const stage = document.getElementById('stage'), box = stage.getBoundingClientRect(), start = performance.now();
  const send = (kind, x, y) => stage.dispatchEvent(new PointerEvent(kind, { pointerId: 7, clientX: x, clientY: y, button: 0, buttons: 1, bubbles: true }));
  stage.setPointerCapture = () => {};
  const x0 = box.left + 0.35 * box.width, y0 = box.top + 0.35 * box.height;
  send('pointerdown', x0, y0);
  const drawn = Number(stage.dataset.drawn), steps = Number(stage.dataset.steps), gaps = [];
  let last = 0;
  const tick = (now) => {
    if (last) gaps.push(now - last);
    last = now;
    const part = 0.5 - 0.5 * Math.cos((now - start) / 900);
    send('pointermove', x0 + part * 0.2 * box.width, y0 + part * 0.35 * box.height);
    if (now - start < 1000 * seconds) return void requestAnimationFrame(tick);
    send('pointerup', x0, y0);
    const spent = (performance.now() - start) / 1000;
    done({ frames: (Number(stage.dataset.drawn) - drawn) / spent, steps: (Number(stage.dataset.steps) - steps) / spent, gaps });
  };
  requestAnimationFrame(tick);
})"""
DELAY = """async (count) => {
  const stage = document.getElementById('stage'), box = stage.getBoundingClientRect(), found = [];
  const send = (kind, x, y) => stage.dispatchEvent(new PointerEvent(kind, { pointerId: 7, clientX: x, clientY: y, button: 0, buttons: 1, bubbles: true }));
  stage.setPointerCapture = () => {};
  const x = box.left + 0.4 * box.width, y = box.top + 0.4 * box.height;
  send('pointerdown', x, y);
  for (let k = 0; k < count; ++k) {
    await new Promise((done) => setTimeout(done, 300 + 40 * Math.random()));
    const drawn = stage.dataset.drawn, at = performance.now();
    send('pointermove', x + (k % 2 ? 12 : 0), y + (k % 2 ? 20 : 4));
    await new Promise((done) => {
      const channel = new MessageChannel();
      channel.port1.onmessage = () => (stage.dataset.drawn !== drawn ? done() : requestAnimationFrame(() => channel.port2.postMessage(0)));
      requestAnimationFrame(() => channel.port2.postMessage(0));
    });
    found.push(performance.now() - at);
  }
  send('pointerup', x, y);
  return found;
}"""
ENGINE = """import { Engine, poseOf } from "./engine.js";
import { inflated } from "./bytes.js";
const bytes = await Promise.all(["core", "scene", "poses"].map((id) => inflated(document.getElementById(id).textContent)));
const poses = new Float64Array(bytes[2].buffer), rows = poses.length / 5, found = {};
const engine = await Engine.open(bytes[0], bytes[1]), look = { gain: 0, timeGain: [0, 0, 0, 0, 0, 0], dynamicRange: 60, invert: false };
for (const model of engine.pack.models) {
  engine.choose(model.name);
  const step = [], drawing = [], shading = [];
  for (let round = 0; round < 6; ++round) {
    engine.reset();
    const a = performance.now();
    for (let row = 0; row < rows; ++row) engine.take(poseOf(poses, row, 1 / 120));
    if (round) step.push((performance.now() - a) / rows);
  }
  for (let round = 0; round < 3; ++round) {
    engine.reset();
    for (let row = 0; row < rows; ++row) {
      engine.take(poseOf(poses, row, 1 / 120));
      if (row % 4 !== 3) continue;
      const b = performance.now();
      engine.grey();
      const c = performance.now();
      engine.draw(look);
      if (round) { drawing.push(c - b); shading.push(performance.now() - c); }
    }
  }
  found[model.name] = { step, drawing, shading };
}
document.body.textContent = "";
document.body.dataset.found = JSON.stringify(found);
"""


def main() -> None:
    """Measure, and print what was measured beside what is wanted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--page", type=Path, help="a page that exists, instead of the speckle picture")
    parser.add_argument("--seconds", type=float, default=6.0, help="of steering")
    parser.add_argument("--minutes", type=float, default=0.0, help="of steering for the memory")
    parser.add_argument("--skip-engine", action="store_true")
    options = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        parser.error("Chromium is not installed")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = options.page or speckle_page(Path(folder) / "trainer.html")
        browser = playwright.chromium.launch(
            executable_path=chromium, args=[*FLAGS, "--enable-precise-memory-info"]
        )
        load = os.getloadavg()[0]
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB; load of the machine {load:.1f}")
        for name, (width, height, ratio, wanted) in SIZES.items():
            page, session = opened(browser, path, width, height, ratio)
            session.send("Performance.enable", {"timeDomain": "threadTicks"})
            first = page.evaluate("window.firstPicture")
            before = used(session)
            steered = page.evaluate(STEER, options.seconds)
            spent = (used(session) - before) / max(steered["frames"] * options.seconds, 1)
            delays = page.evaluate(DELAY, 30)
            print(
                f"{name}: first picture {first:.0f} ms; {steered['frames']:.1f} frames/s (wanted {wanted}), longest gap "
                f"{max(steered['gaps']):.0f} ms, {1000 * spent:.1f} ms of the page's thread a frame; {steered['steps']:.0f} steps/s; pointer to drawn p50 {median(delays):.1f} ms, "
                f"p95 {np.percentile(delays, 95):.1f} ms"
            )
            page.context.close()
        if options.minutes:
            memory(browser, path, options.minutes)
        if not options.skip_engine and options.page is None:
            engine(browser, Path(folder))
        browser.close()


def opened(browser: Browser, path: Path, width: int, height: int, ratio: float) -> tuple[Page, CDPSession]:
    """Open the page offline and wait for its first picture."""
    context = browser.new_context(
        viewport={"width": width, "height": height}, device_scale_factor=ratio, offline=True
    )
    page = context.new_page()
    page.add_init_script(WATCH)
    page.goto(path.absolute().as_uri())
    while not page.evaluate("Boolean(window.firstPicture)"):
        page.wait_for_timeout(20)
    return page, context.new_cdp_session(page)


def used(session: CDPSession) -> float:
    """Return the processor's time that the page's main thread has taken, s."""
    metrics = session.send("Performance.getMetrics")["metrics"]
    return float(next(m["value"] for m in metrics if m["name"] == "TaskDuration"))


def memory(browser: Browser, path: Path, minutes: float) -> None:
    """Print the memory of a page that is steered, after garbage collection."""
    page, session = opened(browser, path, 1440, 900, 1)
    host = browser.new_browser_cdp_session()
    for k in range(int(2 * minutes) + 1):
        if k:
            page.evaluate(STEER, 30.0)
        session.send("HeapProfiler.collectGarbage")
        heap = page.evaluate("performance.memory.usedJSHeapSize") / 1e6
        renderers = [
            p["id"] for p in host.send("SystemInfo.getProcessInfo")["processInfo"] if p["type"] == "renderer"
        ]
        resident = max(
            int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in renderers
        ) * os.sysconf("SC_PAGE_SIZE")
        print(f"memory after {k / 2:.1f} min: heap {heap:.2f} MB, renderer resident {resident / 1e6:.0f} MB")
    page.context.close()


def scene() -> tuple[Any, Any, np.ndarray]:
    """Return the scenario, the image of 512 x 512 and rows of poses."""
    from echospline.scenario import Scenario  # noqa: PLC0415
    from echospline.scene import RegularGrid, UltrasoundImage  # noqa: PLC0415

    rng = np.random.default_rng(3)
    pixels = np.clip(rng.rayleigh(60, (512, 512)), 0, 255).astype(np.uint8)
    scenario = Scenario().with_values(
        {"title": "Speckle", "mesh.nodes": (40, 30), "needle.entry": (12.0, 0.0)}, "here"
    )
    part = 0.5 - 0.5 * np.cos(np.arange(480) / 120 * 2)
    tip = np.stack([12 + 14 * part, 22 * part], 1)
    speed = np.gradient(np.hypot(tip[:, 0] - 12, tip[:, 1])) * 120
    rows = np.column_stack([np.full((480, 1), 12.0), np.zeros((480, 1)), tip, speed])
    return scenario, UltrasoundImage(pixels, RegularGrid((512, 512), (0.08, 0.08)), "speckle"), rows


def speckle_page(path: Path) -> Path:
    """Write the page of the speckle picture."""
    from echospline.page import bundle, packed  # noqa: PLC0415

    scenario, image, _ = scene()
    path.write_text(bundle(packed(scenario, image, Path())), encoding="utf-8")
    return path


def engine(browser: Browser, folder: Path) -> None:
    """Time the engine in Chromium, and the native core on the same scene and poses."""
    from echospline.page import packed  # noqa: PLC0415
    from echospline.page.bundle import assembled, shipped  # noqa: PLC0415
    from echospline.picture import Drawing, NeedleEcho  # noqa: PLC0415
    from echospline.scenario import build_model  # noqa: PLC0415
    from echospline.scene import NeedlePose  # noqa: PLC0415

    scenario, image, rows = scene()
    pack = packed(scenario, image, Path())
    core = Path(shipped.__globals__["__file__"]).parents[1] / "_native" / "echospline.wasm"
    data = {"core": core.read_bytes(), "scene": pack.to_bytes(), "poses": rows.astype("<f8").tobytes()}
    html = assembled(lambda name: ENGINE if name == "main.js" else shipped(name), data)
    path = folder / "engine.html"
    path.write_text(html if isinstance(html, str) else html[0], encoding="utf-8")
    page = browser.new_page()
    page.goto(path.as_uri())
    while not page.evaluate("document.body.dataset.found ?? ''"):
        page.wait_for_timeout(200)
    found = json.loads(page.evaluate("document.body.dataset.found"))
    page.close()
    grid = pack.mesh
    for name, times in found.items():
        own, drawing = build_model(scenario, grid, kind=name), Drawing(image, grid)
        state, steps, pictures = own.rest(), [], []
        for row in rows.tolist():  # warm: columns of stations, pages of memory
            state = own.advance(state, NeedlePose(tuple(row[:2]), tuple(row[2:4]), row[4]), 1 / 120)
        state = own.rest()
        for k, (x, y, tx, ty, speed) in enumerate(np.tile(rows, (2, 1)).tolist()):
            pose = NeedlePose((x, y), (tx, ty), speed)
            a = time.perf_counter()
            state = own.advance(state, pose, 1 / 120)
            b = time.perf_counter()
            if k % 4 == 3:
                drawing.draw(own.displacement(state), pose, NeedleEcho())
                pictures.append(1000 * (time.perf_counter() - b))
            steps.append(1000 * (b - a))
        wasm = [
            float(np.mean(times[key])) if key == "step" else median(times[key])
            for key in ("step", "drawing", "shading")
        ]
        print(
            f"{name}, {grid.size} nodes, 512 x 512: step {wasm[0]:.3f} ms, native {np.mean(steps):.3f} ({wasm[0] / np.mean(steps):.1f}x); picture "
            f"{wasm[1]:.2f} ms, native {median(pictures):.2f} ({wasm[1] / median(pictures):.1f}x); with shading {wasm[1] + wasm[2]:.2f} ms; "
            f"step and picture {(wasm[0] + wasm[1]) / (np.mean(steps) + median(pictures)):.1f}x; {1000 / wasm[0]:.0f} steps/s at most"
        )


if __name__ == "__main__":
    main()
