"""The instructor's view in a real browser (the system's Chromium, headless), over the routes of a class."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace

import pytest
from playwright.sync_api import expect
from starlette.responses import Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

import page_scene
from echospline.page import score
from echospline.viewer import Record, Sessions
from test_class import served
from test_page_replay import honest
from test_sessions import trace_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
STATIC = page_scene.ROOT / "src" / "echospline" / "page" / "static"
EVIL = '<img src=x onerror="window.broken=1">'
HARNESS = """
import { ClassView } from "./static/class_view.js";
const asked = (path, init = {}) => fetch(path, init);
window.replayed = [];
window.beside = [];
window.view = new ClassView({
  ask: asked, look: () => ({ language: window.language ?? "en", theme: "dark" }), replay: (session) => window.replayed.push(session), expert: (session) => window.beside.push(session),
});
document.getElementById("open").addEventListener("click", () => void window.view.open());
"""
HTML = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>class</title><link rel="stylesheet" href="static/style.css"></head>
<body data-theme="dark"><button id="open" type="button">Class</button><script type="module" src="harness.js"></script></body></html>"""

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="Chromium is not installed; run tests/install-system (needs apt-get and root)"
)
expect.set_options(timeout=20_000)


@pytest.fixture(scope="session")
def browser_type_launch_args(browser_type_launch_args):
    flags = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]  # fmt: skip
    return {**browser_type_launch_args, "executable_path": CHROMIUM, "args": flags}


def class_of(path, pack, rows):
    """Fill a file with a class: three who learn at different speed, an expert, one whose session was changed."""
    stored, trace = Sessions(path), trace_of(rows)
    base = score(trace, page_scene.EXERCISE)
    minute = 0
    for name, since, count, owner in (("Ann", 4, 22, ""), ("Ben", 9, 22, ""), (EVIL, 18, 14, ""), ("Dr. Expert", 0, 3, "")):  # fmt: skip
        for k in range(count):
            error = 0.5 if not since else 0.6 + 3.5 * 0.8 ** (k * 8 / max(since, 4)) + 0.3 * ((7 * k) % 5) / 5
            passed = k >= since or k % 4 == 3
            stored.add(
                page_scene.EXERCISE, trace, replace(base, final_error=error, passed=passed, time=9.0 + 20 / (1 + k)),
                trainee=name, scene="Calf", model="tps",
                record=Record(
                    started=f"2026-03-01T{10 + minute // 60:02}:{minute % 60:02}:00+00:00", owner=owner, verified=True,
                    version="0.1.0", core="c" * 64, pack=pack.digest,
                ),
            )  # fmt: skip
            minute += 1
    stored.mark_expert([s.id for s in stored.every() if s.trainee == "Dr. Expert"], True)
    return stored


def until(page, expression, seconds=20.0):
    """Wait until an expression is true in the page; its policy refuses Playwright's own way."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"never true: {expression}"
        page.wait_for_timeout(30)


@pytest.fixture
def opened(browser, tmp_path, request):
    """Open the harness over a filled class; fails the test on any fault in the page."""
    pack, rows = page_scene.small(), page_scene.poses()
    stored = class_of(tmp_path / "class.sqlite", pack, rows)

    async def page_file(_):
        policy = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'"
        return Response(HTML, media_type="text/html", headers={"Content-Security-Policy": policy})

    async def harness(_):
        return Response(HARNESS, media_type="text/javascript")

    routes = [Route("/", page_file), Route("/harness.js", harness), Mount("/static", StaticFiles(directory=STATIC))]  # fmt: skip
    faults = []
    with served(tmp_path / "class.sqlite", pack, alone=getattr(request, "param", True), more=routes) as ask:
        forged = honest(pack, rows, trainee="Ann")
        forged["score"]["time"] = 1.0
        ask("POST", "/api/sessions", json.dumps(forged).encode())
        context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme="dark")
        page = context.new_page()
        page.set_default_timeout(20_000)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda m: faults.append(m.text) if m.type == "error" else None)
        page.goto(ask.address)
        page.click("#open")
        yield page, stored
        context.close()
    assert [fault for fault in faults if "favicon" not in fault and "403" not in fault] == []


def test_an_instructor_sees_the_class_chooses_and_marks(opened):
    page, stored = opened
    dialog = page.locator("#class")
    expect(dialog).to_be_visible()
    expect(dialog.locator("canvas")).to_have_attribute("aria-label", "Curves over attempts")
    standing = dialog.locator("table").first
    expect(standing.locator("tbody tr")).to_have_count(3)
    expect(standing).to_contain_text("since attempt")
    expect(standing).to_contain_text("not yet")
    expect(standing).to_contain_text(EVIL)  # as text
    assert page.evaluate("window.broken") is None
    sessions = dialog.locator("table").nth(1)
    expect(sessions.locator("tbody tr")).to_have_count(61)
    drawn = "(() => { const c = document.querySelector('#class canvas'); const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0; for (let k = 3; k < d.length; k += 4) n += d[k] > 0; return n; })()"  # fmt: skip
    every = page.evaluate(drawn)
    assert every > 2000
    dialog.locator("select").nth(1).select_option("=Ann")
    expect(dialog.locator("table").nth(1).locator("tbody tr")).to_have_count(22)
    assert page.evaluate(drawn) != every
    dialog.locator("select").nth(2).select_option("final_error")
    assert page.evaluate("document.activeElement.value") == "final_error"  # the keys stay where they were
    first = dialog.locator("table").nth(1).locator("tbody tr").nth(1)
    number = int(first.locator("td").first.inner_text())
    first.get_by_text("Benchmark").click()
    expect(dialog.locator("table").nth(1).locator("tbody tr").nth(1).get_by_text("Benchmark")).to_have_attribute("aria-pressed", "true")  # fmt: skip
    assert stored.find(number).expert is True
    dialog.locator("table").nth(1).locator("tbody tr").nth(1).get_by_text("Beside me").click()
    until(page, "window.beside.length === 1")
    assert page.evaluate("window.beside[0].steps") == 360
    with page.expect_download() as download:
        dialog.get_by_text("Curves as CSV").click()
    assert download.value.suggested_filename == "echospline-curves.csv"
    assert download.value.path().read_text().startswith("scene,exercise,trainee")
    dialog.locator("table").nth(1).locator("tbody tr").nth(1).get_by_text("Replay").click()
    until(page, "window.replayed.length === 1")
    expect(dialog).not_to_be_visible()


def test_what_cannot_be_read_is_said(opened):
    page, _ = opened
    expect(page.locator("#class")).to_be_visible()
    page.route("**/api/class", lambda route: route.fulfill(status=200, body='{"sessions": 1}', content_type="application/json"))  # fmt: skip
    page.locator("#class").get_by_text("Read anew").click()
    expect(page.locator("#class [role=alert]")).to_contain_text("Expected")
    page.unroute("**/api/class")
    page.route("**/api/class", lambda route: route.fulfill(status=403, body="the class is shown to the instructor alone"))  # fmt: skip
    page.locator("#class").get_by_text("Read anew").click()
    expect(page.locator("#class [role=alert]")).to_contain_text("instructor alone")
    page.unroute("**/api/class")
    page.locator("#class").get_by_text("Read anew").click()
    expect(page.locator("#class [role=alert]")).to_have_text("")


def test_it_speaks_german_and_closes_by_the_keyboard(opened):
    page, _ = opened
    expect(page.locator("#class")).to_be_visible()
    page.evaluate("window.language = 'de'; window.view.fill()")
    expect(page.locator("#class")).to_contain_text("Die Klasse")
    page.keyboard.press("Escape")
    expect(page.locator("#class")).not_to_be_visible()


@pytest.mark.parametrize("opened", [False], indirect=True)
def test_a_trainee_sees_the_own_sessions_and_experts_alone(opened):
    page, stored = opened
    rows = page_scene.poses()
    expect(page.locator("#class [role=alert]")).to_contain_text("instructor alone")
    body = json.dumps(honest(page_scene.small(), rows, trainee="Ann", started="2026-03-05T10:00:00Z"))
    page.evaluate("(body) => fetch('api/sessions', { method: 'POST', body }).then((a) => a.text())", body)
    page.evaluate("window.view.open('Ann')")
    dialog = page.locator("#class")
    expect(dialog).to_contain_text("My sessions on the server")
    dialog.locator("select").first.select_option(index=1)
    expect(dialog.locator("table").nth(1).locator("tbody tr")).to_have_count(1)
    for others in (EVIL, "Ben", "Dr. Expert", "median", "CSV", "Benchmark"):
        expect(dialog).not_to_contain_text(others)
    dialog.locator("select").first.select_option(index=0)
    expect(dialog.locator("table").nth(1).locator("tbody tr")).to_have_count(3)  # the experts'
    dialog.locator("table").nth(1).locator("tbody tr").first.get_by_text("Replay").click()
    until(page, "window.replayed.length === 1")
    assert page.evaluate("window.replayed[0].trainee") == ""
    assert stored.every()[-1].trainee == "Ann"
