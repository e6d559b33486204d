"""The page of one file in a real browser (the system's Chromium, headless), opened from file:// with the network off."""

from __future__ import annotations

import base64
import io
import json
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

import page_scene
from echospline.page import bundle, pack_of_page, packed_space, read_sessions, verify

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WASM = page_scene.ROOT / "src" / "echospline" / "_native" / "echospline.wasm"
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
SECONDS = 20_000  # ms, the patience of every wait; nothing here is a measurement of speed
SIZES = {"desk": (1440, 900), "tablet": (1024, 768), "landscape": (844, 390), "portrait": (390, 844)}
OTHERS = {"laptop": (1280, 860), "small": (360, 640)}
SMALL_TARGET, TOUCH_TARGET = 24, 44  # CSS pixels, for a mouse and for a finger
EVIL = '<img src=x onerror="window.broken=1"></script><script>window.broken=2</script>'

pytestmark = [
    pytest.mark.skipif(
        CHROMIUM is None,
        reason="Chromium is not installed; run tests/install-system (needs apt-get and root)",
    ),
    pytest.mark.skipif(not WASM.exists(), reason="echospline.wasm is not built; run make wasm"),
]
expect.set_options(timeout=SECONDS)


@pytest.fixture(scope="session")
def browser_type_launch_args(browser_type_launch_args):
    return {**browser_type_launch_args, "executable_path": CHROMIUM, "args": FLAGS}


@pytest.fixture(scope="module")
def pack():
    exercise = page_scene.EXERCISE.model_dump()
    easy = {
        **exercise, "name": "easy", "title": EVIL[:80], "goal": EVIL, "vessels": [], "most_redirections": None,
        "target": {"centre": (12.0, 6.0), "radius": 4.0}, "time_limit": 60.0,
    }  # fmt: skip
    short = {**easy, "name": "short", "title": "Short", "time_limit": 0.5}
    return page_scene.small(**{"exercise": [exercise, easy, short]})


@pytest.fixture(scope="module")
def file(pack, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "trainer.html"
    path.write_text(bundle(pack), encoding="utf-8")
    return path


@pytest.fixture
def opened(browser, file, request):
    """Open the page at a size; fails the test on any request, and on any fault in the page."""
    contexts, faults, asked = [], [], []

    def make(size="desk", path=file, **more):
        width, height = {**SIZES, **OTHERS}[size]
        touch = size in {"landscape", "portrait", "small"}
        options = {
            "viewport": {"width": width, "height": height}, "has_touch": touch, "is_mobile": touch, "offline": True,
            "device_scale_factor": 2 if touch else 1, "color_scheme": "dark", **more,
        }  # fmt: skip
        context = browser.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(SECONDS)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda m: faults.append(m.text) if m.type == "error" else None)
        page.on(
            "request",
            lambda r: asked.append(r) if not r.url.startswith(("file:", "blob:", "data:")) else None,
        )
        page.goto(path.as_uri())
        return page

    make.excused = None
    yield make
    sent = [r.url for r in asked if r.failure != "csp"]
    for context in contexts:
        context.close()
    assert not sent, f"the page asked for {sent}"
    faults = [text for text in faults if make.excused is None or make.excused not in text]
    assert not faults, faults


def until(page, expression: str, seconds: float = SECONDS / 1000) -> None:
    """Wait until an expression is true in the page; its policy refuses Playwright's own way."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"never true: {expression}"
        page.wait_for_timeout(30)


def ready(page):
    until(page, "document.getElementById('stage').dataset.ready === 'true'")
    return page


def depth(page) -> float:
    """Depth of the needle, mm."""
    return float(page.evaluate("document.getElementById('stage').dataset.depth"))


def push(page, beyond: float) -> None:
    """Push with the keys until the needle is deeper than so many mm."""
    page.keyboard.down("ArrowDown")
    until(page, f"Number(document.getElementById('stage').dataset.depth) > {beyond}")
    page.keyboard.up("ArrowDown")


def picture(page) -> np.ndarray:
    """What the canvas shows, grey."""
    data = page.evaluate("document.getElementById('canvas').toDataURL()")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.split(",")[1]))).convert("L"), dtype=int)


# --- opened


@pytest.mark.parametrize("size", SIZES)
def test_it_opens_offline_with_picture_hint_and_start_in_view(opened, size):
    page = ready(opened(size))
    width, height = SIZES[size]
    assert picture(page).std() > 10
    for name in ("#stage", "#start", "#hint"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["y"] >= 0
        assert box["x"] + box["width"] <= width + 0.5, name
        assert box["y"] + box["height"] <= height + 0.5, name
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    stage = page.locator("#stage").bounding_box()
    assert stage["height"] >= 0.3 * height
    assert stage["width"] >= 0.5 * width


@pytest.mark.parametrize("size", SIZES)
def test_every_control_is_large_enough_and_has_a_name(opened, size):
    page = ready(opened(size))
    page.evaluate("document.querySelectorAll('details').forEach((panel) => (panel.open = true))")
    least = TOUCH_TARGET if size in {"landscape", "portrait"} else SMALL_TARGET
    controls = page.evaluate(
        """(least) => [...document.querySelectorAll('button, select, input, summary')].filter((c) => c.checkVisibility()).map((c) => {
          const box = (c.closest('label') ?? c).getBoundingClientRect(), words = c.getAttribute('aria-label') || c.textContent.trim();
          const label = c.closest('label')?.textContent.trim() ?? '';
          return { name: words || label || c.title, height: Math.round(box.height), width: Math.round(box.width), tag: c.outerHTML.slice(0, 80) };
        })""",
        least,
    )
    assert len(controls) > 25
    for control in controls:
        assert control["name"], control
        if least == TOUCH_TARGET:
            assert control["height"] >= least, control
            assert control["width"] >= least, control


@pytest.mark.parametrize("server", [False, True])
@pytest.mark.parametrize("language", ["en", "de"])
@pytest.mark.parametrize("size", [*SIZES, "laptop", "small"])
def test_every_tool_is_in_view_in_both_languages_with_a_server_too(opened, size, language, server):
    page = ready(opened(size))
    if language == "de":
        page.locator('[data-do="language"]').click()
        until(page, "document.documentElement.lang === 'de'")
    if server:  # its buttons alone make the bar longer
        page.evaluate(
            "document.querySelectorAll('header [data-served], .tools [data-served]').forEach((button) => (button.hidden = false))"
        )
    names, hidden = page.evaluate(
        """() => {
          const bar = document.querySelector('.tools').getBoundingClientRect(), tools = [...document.querySelectorAll('.tools button')].filter((b) => b.checkVisibility());
          const cut = tools.filter((button) => {
            const box = button.getBoundingClientRect();
            return box.left < bar.left || box.right > bar.right || box.top < bar.top || box.bottom > Math.min(bar.bottom, innerHeight) || button.scrollWidth > button.clientWidth;
          });
          const wide = [...document.querySelectorAll('header button')].filter((b) => b.checkVisibility() && b.getBoundingClientRect().right > innerWidth);
          return [tools.map((b) => b.dataset.do), [...cut, ...wide].map((b) => b.dataset.do)];
        }"""
    )
    assert len(names) == (11 if server else 9)
    assert names[-1] == "reset"
    assert hidden == []


@pytest.mark.parametrize("size", ["desk", "laptop", "tablet", "landscape", "portrait"])
def test_sliders_are_long_enough_to_set_a_degree(opened, volume_file, size):
    page = ready(opened(size, volume_file))
    widths = page.evaluate(
        "[...document.querySelectorAll('.slider input')].filter((c) => c.checkVisibility()).map((c) => c.offsetWidth)"
    )
    assert len(widths) >= 5
    assert min(widths) >= 80


@pytest.mark.parametrize("size", ["desk", "portrait"])
def test_the_page_follows_light_and_dark_of_the_system_and_the_button_changes_it(opened, size):
    page = ready(opened(size, color_scheme="light"))
    assert page.evaluate("document.body.dataset.theme") == "light"
    bright = page.evaluate("getComputedStyle(document.querySelector('header')).backgroundColor")
    page.locator('[data-do="theme"]').click()
    until(page, "document.body.dataset.theme === 'dark'")
    assert page.evaluate("getComputedStyle(document.querySelector('header')).backgroundColor") != bright
    page.reload()
    ready(page)
    assert page.evaluate("document.body.dataset.theme") == "dark"


def test_the_other_language_changes_every_word_and_is_kept(opened):
    page = ready(opened())
    words = "[...document.querySelectorAll('[data-word]')].map((e) => [e.dataset.word, e.textContent])"
    english = page.evaluate(words)
    page.locator('[data-do="language"]').click()
    until(page, "document.documentElement.lang === 'de'")
    german = page.evaluate(words)
    assert all(text for _, text in [*english, *german])
    same = [word for (word, a), (_, b) in zip(english, german, strict=True) if a == b]
    assert set(same) <= {"training", "start", "dicom", "fem"}
    assert page.locator("#models .choice span").first.text_content().startswith("Dünne")
    page.reload()
    ready(page)
    assert page.evaluate("document.documentElement.lang") == "de"


def test_reduced_motion_moves_nothing_but_the_needle(opened):
    page = ready(opened(reduced_motion="reduce"))
    page.keyboard.press("e")
    until(page, "document.body.classList.contains('recording')")
    assert (
        page.evaluate("getComputedStyle(document.getElementById('status'), '::before').animationName")
        == "none"
    )
    moving = page.evaluate(
        "[...document.querySelectorAll('*')].filter((e) => parseFloat(getComputedStyle(e).transitionDuration) > 0).length"
    )
    assert moving == 0


# --- steered


def test_a_mouse_chooses_the_entry_aims_and_pushes(opened):
    page = ready(opened())
    box = page.locator("#stage").bounding_box()
    before = picture(page)
    x, y = box["x"] + 0.4 * box["width"], box["y"] + 0.5 * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60, y + 90, steps=6)
    page.mouse.up()
    until(page, "Number(document.getElementById('stage').dataset.depth) > 2")
    expect(page.locator("#hint")).to_be_hidden()
    assert np.abs(picture(page) - before).mean() > 1
    page.keyboard.press(" ")
    until(page, "Number(document.getElementById('stage').dataset.depth) === 0")


def test_a_finger_pushes_and_two_fingers_zoom(opened):
    page = ready(opened("portrait"))
    box, client = page.locator("#stage").bounding_box(), page.context.new_cdp_session(page)
    x, y = box["x"] + 0.35 * box["width"], box["y"] + 0.4 * box["height"]

    def touch(kind, *places):
        client.send(
            "Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": a, "y": b} for a, b in places]}
        )

    touch("touchStart", (x, y))
    for k in range(1, 9):
        touch("touchMove", (x + 5 * k, y + 12 * k))
    touch("touchEnd")
    until(page, "Number(document.getElementById('stage').dataset.depth) > 2")
    wide = picture(page)
    touch("touchStart", (x, y), (x + 60, y))
    for k in range(1, 9):
        touch("touchMove", (x - 4 * k, y), (x + 60 + 4 * k, y))
    touch("touchEnd")
    page.wait_for_timeout(200)
    assert np.abs(picture(page) - wide).mean() > 5
    assert page.evaluate("document.querySelector('main').scrollTop") == 0


def test_buttons_on_the_screen_push_while_they_are_held(opened):
    page = ready(opened("portrait"))
    page.locator("#stage").click(position={"x": 150, "y": 130})
    button = page.locator('[data-hold="ArrowDown"]')
    expect(button).to_be_visible()
    box = button.bounding_box()
    page.mouse.move(box["x"] + 20, box["y"] + 20)
    page.mouse.down()
    until(page, "Number(document.getElementById('stage').dataset.depth) > 3")
    page.mouse.up()
    page.wait_for_timeout(300)
    still = depth(page)
    page.wait_for_timeout(300)
    assert abs(depth(page) - still) < 0.05


def test_every_control_is_reached_and_worked_by_the_keyboard(opened, pack):
    page = ready(opened())
    page.locator("#stage").focus()
    seen, last = [], None
    for _ in range(120):
        page.keyboard.press("Tab")
        focus = page.evaluate(
            "(() => { const e = document.activeElement; e.dataset.n ??= String(window.n = (window.n ?? 0) + 1); return [e.dataset.n, e.dataset.do ?? e.id ?? '', e.tagName, getComputedStyle(e.closest('.toggle, .choice') ?? e).outlineStyle]; })()"
        )
        if focus[0] == last or (seen and focus[0] == seen[0][0]):
            break
        seen.append(focus)
    names = {name for _, name, *_ in seen}
    assert {
        "freeze", "flip", "invert", "caliper", "note", "clear", "picture", "clip", "reset", "language", "theme", "help",
        "examination", "trainee", "exercise", "sessions", "seen", "gain", "range", "flat", "entry", "angle", "depth",
    } <= names  # fmt: skip
    assert all(outline != "none" for *_, tag, outline in seen if tag not in {"BODY", "HTML"}), seen
    page.locator('[data-do="freeze"]').focus()
    page.keyboard.press(" ")
    expect(page.locator('[data-do="freeze"]')).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("Enter")
    expect(page.locator('[data-do="freeze"]')).to_have_attribute("aria-pressed", "false")
    page.locator("#examination").focus()
    page.keyboard.press(" ")
    assert page.locator("#examination").is_checked()
    page.keyboard.press(" ")
    assert not page.locator("#examination").is_checked()
    page.locator("#gain").focus()
    page.keyboard.press("ArrowRight")
    expect(page.locator("#gain")).to_have_value("1")
    assert depth(page) == 0, "a slider's arrows do not push the needle"
    page.locator("#models input").first.focus()
    page.keyboard.press("ArrowDown")
    until(page, f"document.getElementById('stage').dataset.model === '{pack.manifest.models[1].name}'")


@pytest.mark.parametrize(
    ("key", "name"), [("c", "freeze"), ("f", "flip"), ("i", "invert"), ("m", "caliper"), ("t", "note")]
)
def test_letters_do_what_the_buttons_do(opened, key, name):
    page = ready(opened())
    button = page.locator(f'.tools [data-do="{name}"]')
    expect(button).to_have_attribute("aria-pressed", "false")
    page.keyboard.press(key)
    expect(button).to_have_attribute("aria-pressed", "true")


def test_after_a_dialog_is_closed_with_the_mouse_the_keys_steer_and_space_resets(opened):
    page = ready(opened())
    page.locator("#start").click()
    push(page, 4)
    page.locator("#start").click()
    page.locator("#summary [data-close]").click()
    expect(page.locator("#stage")).to_be_focused()
    page.keyboard.press(" ")
    until(page, "Number(document.getElementById('stage').dataset.depth) < 0.01")
    assert not page.evaluate("document.body.classList.contains('recording')"), "Space is not Start again"
    page.locator('[data-do="help"]').focus()
    page.keyboard.press("Enter")
    page.keyboard.press("Escape")
    expect(page.locator('[data-do="help"]')).to_be_focused()


def test_frozen_time_stands_still(opened):
    page = ready(opened())
    push(page, 4)
    page.keyboard.press("c")
    page.wait_for_timeout(200)
    steps = page.evaluate("document.getElementById('stage').dataset.steps")
    page.keyboard.down("ArrowDown")
    page.wait_for_timeout(400)
    page.keyboard.up("ArrowDown")
    assert page.evaluate("document.getElementById('stage').dataset.steps") == steps


def test_a_reader_of_the_screen_hears_no_chatter_while_the_needle_moves(opened):
    page = ready(opened())
    page.evaluate(
        """() => { window.said = []; for (const e of document.querySelectorAll('[role=status], [role=alert], [aria-live], output'))
          if (e.ariaLive !== 'off') new MutationObserver(() => window.said.push(e.outerHTML)).observe(e, { childList: true, characterData: true, subtree: true }); }"""
    )
    push(page, 8)
    page.wait_for_timeout(700)
    assert page.evaluate("window.said") == []
    assert "mm deep" in page.locator("#spoken").text_content()


# --- measured and saved


def test_a_distance_is_measured_with_the_mouse_and_a_label_is_written(opened):
    page = ready(opened())
    box, before = page.locator("#stage").bounding_box(), picture(page)
    page.keyboard.press("m")
    page.mouse.move(box["x"] + 300, box["y"] + 300)
    page.mouse.down()
    page.mouse.move(box["x"] + 450, box["y"] + 380, steps=4)
    page.mouse.up()
    page.keyboard.press("t")
    page.mouse.click(box["x"] + 350, box["y"] + 250)
    page.locator("#write-text").fill("Faszie")
    page.keyboard.press("Enter")
    expect(page.locator("#write")).to_be_hidden()
    page.wait_for_timeout(200)
    assert (np.abs(picture(page) - before) > 40).sum() > 300
    assert depth(page) == 0
    page.keyboard.press("Delete")
    page.wait_for_timeout(200)
    assert np.abs(picture(page) - before).max() < 40


def test_picture_and_clip_are_saved(opened, tmp_path):
    page = ready(opened())
    push(page, 6)
    with page.expect_download() as made:
        page.keyboard.press("p")
    made.value.save_as(tmp_path / "p.png")
    assert np.asarray(Image.open(tmp_path / "p.png").convert("L")).std() > 10
    with page.expect_download() as made:
        page.keyboard.press("v")
    made.value.save_as(tmp_path / "v")
    head = (tmp_path / "v").read_bytes()[:12]
    assert head.startswith(b"\x1aE\xdf\xa3") or head[4:8] == b"ftyp"
    assert (tmp_path / "v").stat().st_size > 5000


# --- trained


def train(page, name: str, *, to: float, how: str = "e") -> None:
    """Make an attempt at an exercise."""
    page.locator(f'#exercises input[value="{name}"]').check(force=True)
    page.locator("#stage").focus()
    page.keyboard.press("e")
    until(page, "document.body.classList.contains('recording')")
    push(page, to)
    page.keyboard.press(how)


def test_an_attempt_is_scored_kept_exported_and_verified_by_the_package(opened, pack, tmp_path):
    page = ready(opened())
    page.locator("#trainee").fill(EVIL[:80])
    train(page, "easy", to=5)
    expect(page.locator("#summary")).to_be_visible()
    assert page.locator("#verdict").text_content() in {"Passed", "Not passed"}
    assert page.locator("#metrics tr").count() == 11
    with page.expect_download() as made:
        page.locator("#export-one").click()
    made.value.save_as(tmp_path / "one.json")
    [session] = read_sessions(tmp_path / "one.json")
    checked = verify(pack, session)
    assert checked.differences == ()
    assert session.trainee == EVIL[:80]
    page.locator("#again").click()
    until(page, "document.body.classList.contains('recording')")
    push(page, 3)
    page.keyboard.press(" ")
    until(page, "!document.body.classList.contains('recording')")
    expect(page.locator("#summary")).to_be_hidden()
    page.keyboard.press("l")
    expect(page.locator("#session-rows tr")).to_have_count(2)
    with page.expect_download() as made:
        page.locator("#export-all").click()
    made.value.save_as(tmp_path / "all.json")
    both = read_sessions(tmp_path / "all.json")
    assert [(one.ended, one.attempt) for one in both] == [("finished", 1), ("reset", 2)]
    assert all(verify(pack, one).differences == () for one in both)
    page.reload()
    ready(page)
    page.keyboard.press("l")
    expect(page.locator("#session-rows tr")).to_have_count(2)
    assert page.evaluate("window.broken") is None
    assert page.evaluate("document.querySelectorAll('img').length") == 0


def test_time_ends_an_attempt(opened):
    page = ready(opened())
    page.locator('#exercises input[value="short"]').check(force=True)
    page.keyboard.press("e")
    expect(page.locator("#summary")).to_be_visible()
    assert "Time is up" in page.locator("#why").text_content()


def test_an_examination_takes_every_help_away_until_it_ends(opened):
    page = ready(opened())
    page.locator("#examination").check(force=True)
    page.locator("#rule").select_option("fixed")
    train(page, "easy", to=5)
    expect(page.locator("#summary")).to_be_visible()
    page.locator("#summary [data-close]").click()
    page.keyboard.press("e")
    until(page, "document.body.classList.contains('recording')")
    for help_ in ("guide", "rings", "readouts"):
        box = page.locator(f'[data-help="{help_}"]')
        assert box.is_disabled()
        assert not box.is_checked()
    assert page.locator("#examination").is_disabled()
    page.keyboard.press(" ")
    until(page, "!document.body.classList.contains('recording')")
    assert page.locator('[data-help="rings"]').is_checked()


def test_a_file_of_attempts_that_is_read_twice_makes_no_second_attempts(opened, tmp_path):
    page = ready(opened())
    train(page, "easy", to=4)
    page.locator("#summary [data-close]").click()
    page.locator('[data-do="sessions"]').click()
    with page.expect_download() as made:
        page.locator("#export-all").click()
    made.value.save_as(tmp_path / "attempts.json")
    page.locator("#import-file").set_input_files(tmp_path / "attempts.json")
    expect(page.locator("#attempts-said")).to_have_text("Attempts read: 0.")
    assert page.locator("#session-rows tr").count() == 1
    page.on("dialog", lambda asked: asked.accept())
    page.locator("#erase").click()
    expect(page.locator("#session-rows tr")).to_have_count(0)
    for count in (1, 0):
        page.locator("#import-file").set_input_files(tmp_path / "attempts.json")
        expect(page.locator("#attempts-said")).to_have_text(f"Attempts read: {count}.")
        assert page.locator("#session-rows tr").count() == 1


@pytest.mark.parametrize("size", ["portrait", "landscape"])
def test_dialogs_on_a_phone_begin_at_their_top_and_fingers_find_every_control(opened, size):
    page = ready(opened(size))
    page.locator("#trainee").fill("A name that is rather long")
    train(page, "easy", to=4)
    for dialog, leave in (
        ("summary", "#summary [data-close]"),
        ("attempts", "#attempts [data-close]"),
        ("help", None),
    ):
        if dialog == "attempts":
            page.locator('[data-do="sessions"]').click()
        elif dialog == "help":
            page.locator('header [data-do="help"]').click()
        expect(page.locator(f"#{dialog} h2").first).to_be_in_viewport()
        small = page.evaluate(
            f"""[...document.querySelectorAll('#{dialog} button, #{dialog} select')].filter((c) => c.checkVisibility()).map((c) => {{
              const box = c.getBoundingClientRect(); return [c.id || c.textContent, box.width, box.height]; }})"""
        )
        assert all(width >= TOUCH_TARGET and height >= TOUCH_TARGET for _, width, height in small), small
        widths = page.evaluate(
            f"[...document.querySelectorAll('#{dialog} select')].filter((c) => c.checkVisibility()).map((c) => c.offsetWidth)"
        )
        assert all(width >= 90 for width in widths), "what is chosen can be read"
        if leave:
            page.locator(leave).click()


@pytest.mark.parametrize("size", ["portrait", "landscape"])
def test_a_replay_on_a_phone_is_scrubbed_with_a_finger_and_has_no_buttons_for_the_needle(opened, size):
    page = ready(opened(size))
    train(page, "easy", to=4)
    page.locator("#watch").click()
    expect(page.locator("#player")).to_be_visible()
    expect(page.locator(".pad")).to_be_hidden()
    box = page.locator("#scrub").bounding_box()
    assert box["height"] >= TOUCH_TARGET
    assert box["width"] >= 100


def test_a_replay_shows_what_was_done_with_pause_speed_and_scrubbing(opened):
    page = ready(opened())
    train(page, "easy", to=6)
    expect(page.locator("#summary")).to_be_visible()
    page.locator("#watch").click()
    expect(page.locator("#player")).to_be_visible()
    assert page.locator("#events button").count() >= 1
    page.locator("#speed").select_option("4")
    until(page, "Number(document.getElementById('stage').dataset.depth) > 5.5")
    end = picture(page)
    page.locator("#scrub").focus()
    page.keyboard.press("Home")
    until(page, "Number(document.getElementById('stage').dataset.depth) < 0.1")
    page.keyboard.press("End")
    until(page, "Number(document.getElementById('stage').dataset.depth) > 5.5")
    page.wait_for_timeout(200)
    assert np.abs(picture(page) - end).mean() < 3
    page.locator('[data-do="leave"]').click()
    expect(page.locator("#player")).to_be_hidden()


def test_the_expert_moves_beside_the_trainee(opened):
    page = ready(opened())
    for to in (4, 7):
        train(page, "easy", to=to)
        expect(page.locator("#summary")).to_be_visible()
        page.locator("#summary [data-close]").click()
        page.keyboard.press(" ")
    page.keyboard.press("l")
    page.locator("#session-rows tr").nth(1).locator("button").nth(1).click()
    expect(page.locator("#session-rows tr").nth(1).locator("button").nth(1)).to_have_attribute(
        "aria-pressed", "true"
    )
    page.locator("#session-rows tr").nth(0).locator("button").nth(0).click()
    expect(page.locator("#player")).to_be_visible()
    page.wait_for_timeout(400)
    violet = page.evaluate(
        "(() => { const c = document.getElementById('canvas'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0; for (let k = 0; k < d.length; k += 4) n += d[k] > 180 && d[k + 1] < 185 && d[k + 2] > 230; return n; })()"
    )
    assert violet > 20


# --- hostile


def test_names_that_are_markup_are_shown_as_text(opened):
    page = ready(opened())
    assert page.locator("#title").text_content().startswith("Small </script>")
    assert page.evaluate("window.broken") is None
    assert page.evaluate("document.querySelectorAll('img, iframe, object').length") == 0


def test_the_policy_lets_nothing_out_and_nothing_else_in(opened):
    page = ready(opened(offline=False))
    opened.excused = "Content Security Policy"
    refused = page.evaluate(
        """async () => {
          const seen = [];
          document.addEventListener("securitypolicyviolation", (event) => seen.push(event.effectiveDirective));
          await fetch("https://example.org/").catch(() => 0);
          document.body.append(Object.assign(document.createElement("script"), { textContent: "window.broken = 1" }));
          document.body.append(Object.assign(document.createElement("img"), { src: "https://example.org/x.png" }));
          document.body.append(Object.assign(document.createElement("iframe"), { src: "https://example.org/" }));
          document.body.insertAdjacentHTML("beforeend", "<b onclick='window.broken = 2' id='bad'>x</b>");
          document.getElementById("bad").click();
          await new Promise((done) => setTimeout(done, 300));
          return seen;
        }"""
    )
    assert {"connect-src", "script-src-elem", "img-src", "frame-src", "script-src-attr"} <= set(refused)
    assert page.evaluate("window.broken") is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[1]",
        json.dumps({"format": 1, "kind": "echospline sessions", "sessions": [{"format": 1}]}),
        EVIL,
    ],
)
def test_a_file_that_holds_no_sessions_is_said_in_one_sentence(opened, tmp_path, text):
    page = ready(opened())
    (tmp_path / "bad.json").write_text(text)
    page.keyboard.press("l")
    page.locator("#import-file").set_input_files(tmp_path / "bad.json")
    until(page, "document.getElementById('attempts-said').textContent.length > 10")
    said = page.locator("#attempts-said").text_content()
    assert said.endswith(".")
    assert len(said) < 300
    assert page.evaluate("window.broken") is None


@pytest.mark.parametrize("harm", ["cut", "other", "none"])
def test_a_damaged_scene_is_said_in_one_sentence(opened, file, tmp_path, harm):
    text = file.read_text(encoding="utf-8")
    start = text.index('id="scene">') + len('id="scene">')
    end = text.index("</script>", start)
    core = text.index('id="core">') + len('id="core">')
    new = {
        "cut": text[start : start + 4 * ((end - start) // 8)],
        "other": text[core : text.index("</script>", core)],
        "none": "",
    }
    (tmp_path / "bad.html").write_text(text[:start] + new[harm] + text[end:], encoding="utf-8")
    page = opened(path=Path(tmp_path / "bad.html"))
    expect(page.locator("#fault")).to_be_visible()
    said = page.locator("#fault").text_content()
    assert said.endswith((".", "!"))
    assert len(said) < 300


# --- in space


@pytest.fixture(scope="module")
def volume_file(tmp_path_factory):
    from test_page_space import opened as volume_scene  # noqa: PLC0415 - it imports what this module offers

    path = tmp_path_factory.mktemp("space") / "volume.html"
    path.write_text(bundle(packed_space(volume_scene())), encoding="utf-8")
    return path


def plane(page) -> list[float]:
    """Where the probe is held: x, y, z, yaw, pitch, roll."""
    return [float(v) for v in page.evaluate("document.getElementById('stage').dataset.plane").split()]


@pytest.mark.parametrize("size", SIZES)
def test_a_volume_opens_offline_with_the_probe_in_the_other_hand(opened, volume_file, size):
    page = ready(opened(size, path=volume_file))
    assert picture(page).std() > 10
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
    start = page.locator("#start").bounding_box()
    assert start["y"] + start["height"] <= SIZES[size][1]
    along = picture(page)
    page.keyboard.press("z")
    until(page, "document.getElementById('stage').dataset.plane.split(' ')[3] === '90.00'")
    page.wait_for_timeout(150)
    assert np.abs(picture(page) - along).mean() > 2
    page.keyboard.press("x")
    until(page, "document.getElementById('stage').dataset.plane.split(' ')[3] === '0.00'")


def test_both_hands_work_at_once(opened, volume_file):
    page = ready(opened(path=volume_file))
    before = plane(page)
    page.keyboard.down("ArrowDown")
    page.keyboard.down("KeyD")
    until(page, "Number(document.getElementById('stage').dataset.depth) > 4")
    page.keyboard.up("KeyD")
    page.keyboard.up("ArrowDown")
    after = plane(page)
    assert after[0] > before[0] + 2
    page.keyboard.down("Shift")
    page.keyboard.down("KeyS")
    page.wait_for_timeout(300)
    page.keyboard.up("KeyS")
    page.keyboard.up("Shift")
    page.wait_for_timeout(150)
    assert plane(page)[4] > after[4] + 2


def test_the_small_drawing_takes_the_probe_and_can_be_hidden(opened, volume_file):
    page = ready(opened(path=volume_file))
    box, shown, before = page.locator("#stage").bounding_box(), picture(page), plane(page)
    x, y = box["x"] + box["width"] - 140, box["y"] + box["height"] - 110
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 30, y - 20, steps=5)
    page.mouse.up()
    page.wait_for_timeout(200)
    moved = plane(page)
    assert moved[0] > before[0] + 1
    assert moved[2] > before[2] + 1
    assert depth(page) == 0, "and not the needle"
    page.keyboard.press("k")
    page.wait_for_timeout(200)
    corner = picture(page)[-200:, -250:]
    assert np.abs(corner - shown[-200:, -250:]).mean() > 3


def test_the_guide_says_where_a_needle_across_would_pass_and_the_numbers_how_far_off_it_is(
    opened, volume_file
):
    page = ready(opened(path=volume_file))
    push(page, 6)
    page.keyboard.press("z")
    page.wait_for_timeout(150)
    before = plane(page)[0]
    page.locator("#probe-0").focus()
    for _ in range(40):
        page.keyboard.press("ArrowRight")
    page.wait_for_timeout(300)
    assert abs(plane(page)[0] - before - 4) < 0.2
    assert page.locator("#fault").is_hidden()


def test_an_attempt_with_both_hands_is_scored_replayed_and_verified_by_the_package(
    opened, volume_file, tmp_path
):
    page = ready(opened(path=volume_file))
    page.keyboard.press("e")
    until(page, "document.body.classList.contains('recording')")
    page.keyboard.down("ArrowDown")
    until(page, "Number(document.getElementById('stage').dataset.depth) > 3")
    page.keyboard.down("KeyW")  # the probe slides off the needle
    until(page, "Number(document.getElementById('stage').dataset.depth) > 9")
    page.keyboard.up("KeyW")
    page.keyboard.up("ArrowDown")
    page.keyboard.press("x")
    page.wait_for_timeout(400)
    page.keyboard.press("e")
    expect(page.locator("#summary")).to_be_visible()
    assert "Tip in the picture" in page.locator("#metrics").text_content()
    with page.expect_download() as made:
        page.locator("#export-one").click()
    made.value.save_as(tmp_path / "one.json")
    [session] = read_sessions(tmp_path / "one.json")
    assert session.planes
    checked = verify(pack_of_page(volume_file), session)
    assert checked.differences == ()
    assert 0 < checked.score.picture_time < checked.score.tissue_time
    assert "lost" in {kind for _, kind in session.events}
    end = plane(page)
    page.locator("#watch").click()
    expect(page.locator("#player")).to_be_visible()
    page.locator("#scrub").focus()
    page.keyboard.press("Home")
    page.wait_for_timeout(300)
    page.keyboard.press("End")
    until(page, "Number(document.getElementById('stage').dataset.depth) > 8.5")
    page.wait_for_timeout(300)
    np.testing.assert_allclose(plane(page), end, atol=0.02)


def test_a_gamepad_holds_needle_and_probe(opened, volume_file):
    page = ready(opened(path=volume_file))
    pad = "(axes, pressed) => { navigator.getGamepads = () => [{ connected: true, axes, buttons: Array.from({ length: 17 }, (_, k) => ({ pressed: pressed.includes(k) })) }]; }"
    before = plane(page)
    page.evaluate(f"({pad})([0, 0.6, 0, 0.8], [5])")
    until(page, "Number(document.getElementById('stage').dataset.depth) > 4")
    page.evaluate(f"({pad})([0, 0, 0, 0], [])")
    page.wait_for_timeout(200)
    after = plane(page)
    assert after[2] > before[2] + 1
    assert after[3] > before[3] + 3
    page.evaluate(f"({pad})([0, 0, 0, 0], [1])")
    until(page, "Number(document.getElementById('stage').dataset.depth) === 0")
