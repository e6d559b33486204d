"""The page with a server, in a real browser: what is added is there, sessions arrive verified, and a lost server is survived."""

from __future__ import annotations

import threading
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pydicom
import pytest
from PIL import Image
from playwright.sync_api import expect
from websockets.sync.client import connect

from echospline.page import packed, packed_space
from echospline.scene import NeedlePose, probe_plane
from echospline.viewer import Scene, Settings, announce, steer, turn
from live_scene import free_port, running
from page_scene import image, scenario
from test_page_browser import CHROMIUM, FLAGS, SECONDS, SIZES, WASM, picture, push, ready, until
from test_page_space import opened as volume_scene

pytestmark = [
    pytest.mark.skipif(
        CHROMIUM is None,
        reason="Chromium is not installed; run tests/install-system (needs apt-get and root)",
    ),
    pytest.mark.skipif(not WASM.exists(), reason="echospline.wasm is not built; run make wasm"),
]


@pytest.fixture(scope="session")
def browser_type_launch_args(browser_type_launch_args):
    return {**browser_type_launch_args, "executable_path": CHROMIUM, "args": FLAGS}


def read(path, _spacing):
    """Open an uploaded picture as the command does, with the small scenario's words."""
    pixels = np.asarray(Image.open(path).convert("L"))
    assert pixels.ndim == 2
    made = packed(scenario(title="Uploaded"), image(), Path())
    return Scene(pack=made, source="{}", fem=None)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with running(tmp_path_factory.mktemp("served"), opener=read) as (address, sessions, app):
        yield address, sessions, app


@pytest.fixture
def visit(browser):
    """Open the page of a server; fails on any fault in the page."""
    contexts, faults = [], []

    def go(address, size="desk"):
        width, height = SIZES[size]
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme="dark")
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(SECONDS)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(address)
        return ready(page)

    yield go
    for context in contexts:
        context.close()
    assert not faults, faults


def attempt(page, *, to=5.0):
    page.locator("#stage").focus()
    page.keyboard.press("e")
    until(page, "document.body.classList.contains('recording')")
    push(page, to)
    page.keyboard.press("e")
    expect(page.locator("#summary")).to_be_visible()
    page.locator("#summary [data-close]").click()


def test_what_a_server_adds_is_offered_and_a_session_arrives_verified(server, visit):
    address, sessions, _ = server
    page = visit(address)
    for name in ("uploads", "fem", "dicom", "class"):
        expect(page.locator(f'[data-served="{name}"]').first).to_be_visible()
    expect(page.locator("#line")).to_be_hidden()
    before = len(sessions.every())
    page.locator("#trainee").fill("Ann")
    attempt(page)
    until(page, "document.getElementById('notice').textContent.includes('verified')")
    kept = sessions.every()
    assert len(kept) == before + 1
    assert kept[-1].verified is True
    assert kept[-1].trainee == "Ann"


def test_finite_elements_are_shown_on_request_and_the_difference_is_said(server, visit):
    page = visit(server[0])
    push(page, 6)
    page.wait_for_timeout(300)
    own = picture(page)
    page.locator('[data-do="fem"]').click()
    until(page, "document.getElementById('notice').textContent.includes('on average')", 60)
    expect(page.locator('[data-do="fem"]')).to_have_attribute("aria-pressed", "true")
    page.wait_for_timeout(300)
    assert np.abs(picture(page) - own).max() > 10
    page.locator('[data-do="fem"]').click()
    expect(page.locator('[data-do="fem"]')).to_have_attribute("aria-pressed", "false")


def test_a_file_is_opened_by_the_server_and_one_that_is_none_is_said(server, visit, tmp_path):
    page = visit(server[0])
    (tmp_path / "bad.png").write_bytes(b"not a picture")
    Image.fromarray(np.random.default_rng(2).integers(0, 255, (64, 80), dtype=np.uint8)).save(
        tmp_path / "own.png"
    )
    page.locator('[data-do="open"]').click()
    page.locator("#open-file").set_input_files(tmp_path / "own.png")
    page.locator("#open-spacing").fill("0.2")
    page.locator("#open-form [type=submit]").click()
    expect(page.locator("#open")).to_be_hidden()
    expect(page.locator("#title")).to_have_text("Uploaded")
    push(page, 4)
    page.locator('[data-do="open"]').click()
    page.locator("#open-spacing").fill("none")
    page.locator("#open-form [type=submit]").click()
    until(page, "document.getElementById('open-said').textContent.includes('spacing')")


def test_the_last_seconds_become_a_dicom_file(server, visit, tmp_path):
    page = visit(server[0])
    push(page, 4)
    page.wait_for_timeout(1500)
    push(page, 8)
    with page.expect_download() as made:
        page.locator('[data-do="dicom"]').click()
    made.value.save_as(tmp_path / "x.dcm")
    file = pydicom.dcmread(tmp_path / "x.dcm")
    assert 1000 / 15.5 < file.FrameTime < 1000 / 14.5, "pictures are held where nothing moved, at one pace"
    assert file.NumberOfFrames == len(file.pixel_array) > 15
    (region,) = file.SequenceOfUltrasoundRegions
    assert (10 * region.PhysicalDeltaX, 10 * region.PhysicalDeltaY) == pytest.approx(image().grid.spacing)


def test_a_tracker_steers_the_needle_and_its_trouble_is_said(server, visit):
    address, _, app = server
    page = visit(address)
    stop = threading.Event()

    def track():
        while not stop.wait(0.05):
            steer(app, NeedlePose((8.0, 0.0), (12.0, 7.0), 0.0), appears=False)

    thread = threading.Thread(target=track)
    thread.start()
    try:
        until(
            page,
            f"Math.abs(Number(document.getElementById('stage').dataset.depth) - {np.hypot(4, 7)}) < 0.02",
        )
    finally:
        stop.set()
        thread.join()
    announce(app, "no pose for 2 s")
    expect(page.locator("#line")).to_contain_text("no pose for 2 s")
    announce(app, "")
    expect(page.locator("#line")).to_be_hidden()


def test_a_lost_server_is_said_a_running_exercise_goes_on_and_is_handed_in_later(tmp_path, visit):
    port, over = free_port(), threading.Event()
    with running(tmp_path, settings=Settings(port=port), over=over) as (address, _, _):
        page = visit(address)
        page.wait_for_timeout(500)
        page.keyboard.press("e")
        until(page, "document.body.classList.contains('recording')")
        push(page, 3)
        over.set()
        expect(page.locator("#line")).to_contain_text("server is lost")
        push(page, 5)
        page.keyboard.press("e")
        expect(page.locator("#summary")).to_be_visible()
        page.locator("#summary [data-close]").click()
    with running(tmp_path, settings=Settings(port=port)) as (_, sessions, _):
        expect(page.locator("#line")).to_be_hidden()
        until(page, "document.getElementById('notice').textContent.includes('verified')")
        assert [kept.verified for kept in sessions.every()] == [True]
        page.reload()
        ready(page)
        page.wait_for_timeout(1500)
        assert len(sessions.every()) == 1, "a session is handed in once"


def test_the_page_itself_carries_no_scene_and_the_same_policy(server, visit):
    page = visit(server[0])
    assert page.evaluate("document.getElementById('scene')") is None
    assert page.evaluate("fetch('https://example.org/').then(() => 'sent', () => 'refused')") == "refused"


def test_a_phone_turns_the_probe_and_a_tracker_places_it(tmp_path, visit):
    made = packed_space(volume_scene())
    with running(tmp_path, pack=made, fem=None) as (address, _, app):
        page = visit(address)
        held = "document.getElementById('stage').dataset.plane"
        expect(page.locator('[data-served="fem"]')).to_be_hidden()
        page.locator('[data-do="phone"]').click()
        link = urlsplit(page.locator("#phone-link").get_attribute("href"))
        where = f"ws://{link.netloc}/phone?{link.query}"
        with connect(where) as phone:
            expect(page.locator("#phone")).to_be_hidden()
            until(page, "document.getElementById('notice').textContent.includes('phone is connected')")
            phone.send('{"turn": [0, 0, 0]}')
            for k in range(1, 11):
                phone.send(f'{{"turn": [{3 * k}, {k}, 0]}}')
                page.wait_for_timeout(30)
            until(page, f"Math.abs(Number({held}.split(' ')[3]) - 30) < 0.1")
            assert abs(float(page.evaluate(held).split()[4]) - 10) < 0.1
        until(page, "document.getElementById('notice').textContent.includes('phone is gone')")
        turn(app, [3.0, 0.0, -2.0, 15.0, 5.0, -4.0])
        until(page, f"{held} === '3.00 0.00 -2.00 15.00 5.00 -4.00'")
        turn(app, probe_plane((1.0, 0.0, 2.0), -20.0, 6.0, 3.0).matrix.ravel())
        until(page, f"{held} === '1.00 0.00 2.00 -20.00 6.00 3.00'")
