"""The page in a real browser (the system's Chromium, headless), with stand-in tissue; no request leaves the machine."""

from __future__ import annotations

import base64
import io
import shutil
import socket
import time
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

from echospline.live import Command, Snapshot
from echospline.mechanics import Elastic, ThinPlate
from echospline.mechanics.spline import factor
from echospline.scene import NeedlePose, RegularGrid, UltrasoundImage
from echospline.viewer import Settings, announce
from echospline.viewer.protocol import encode_frame
from echospline.viewer.served_scene import PAGE_LOOK
from live_scene import IMAGE_GRID, MESH, running, scene, speckle

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
SECONDS = 20_000  # ms, the patience of every wait; nothing here is a measurement of speed

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="Chromium is not installed; run tests/install-system (needs apt-get and root)"
)
expect.set_options(timeout=SECONDS)


@pytest.fixture(scope="session")
def browser_type_launch_args(browser_type_launch_args):
    return {**browser_type_launch_args, "executable_path": CHROMIUM, "args": FLAGS}


@pytest.fixture(scope="session")
def browser_context_args(browser_context_args):
    return {**browser_context_args, "viewport": {"width": 880, "height": 400}, "service_workers": "block"}


@pytest.fixture
def context(context):
    """Browser context that fails the test on any request to another machine, and on any fault in the page."""
    away, faults = [], []

    def check(route):
        if urlsplit(route.request.url).hostname == "127.0.0.1":
            route.continue_()
        else:
            away.append(route.request.url)
            route.abort()

    def watch(page):
        page.set_default_timeout(SECONDS)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda m: faults.append(m.text) if m.type == "error" else None)

    context.route(lambda url: not url.startswith(("blob:", "data:")), check)
    context.on("page", watch)
    context.expected_faults = 0
    yield context
    assert not away, f"requests left the machine: {away}"
    assert len(faults) <= context.expected_faults, faults


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with running(
        tmp_path_factory.mktemp("page"), opener=lambda path, spacing: scene(title="Uploaded")
    ) as running_server:
        yield running_server


@pytest.fixture(scope="module")
def address(server):
    return server[0]


def visit(page, address):
    page.goto(address)
    page.wait_for_selector("#stage[data-ready=true][data-step]")


@pytest.fixture
def live(page, address):
    visit(page, address)
    return page


def wait_until(page, condition):
    """Wait for a condition (JavaScript) on d, the stage's data, and text, which reads an element."""
    page.wait_for_function(
        f"() => {{ const d = document.getElementById('stage').dataset, "
        f"text = (id) => document.getElementById(id).textContent; return {condition}; }}",
        timeout=SECONDS,
    )


def settle(page):
    """Wait until the needle has arrived and some frames were drawn after that."""
    wait_until(page, "text('speed') === '0.0' && Math.abs(Number(text('depth')) - Number(d.depth)) < 0.06")
    drawn = page.get_attribute("#stage", "data-step")
    wait_until(page, f"Number(d.step) > {drawn} + 3")


def picture(page):
    """The stage as grey levels."""
    png = page.locator("#stage").screenshot()
    return np.asarray(Image.open(io.BytesIO(png)).convert("L"), dtype=float)


def bare(page):
    """Switch everything off that is drawn over the tissue."""
    for name in ("shaft", "tip", "reverberation", "shadow", "guide"):
        page.locator(f"#{name}").evaluate("box => box.click()")


def place(page, x, y):
    """Pixel on the stage of (x, y) mm, from where the drawn image lies."""
    box = page.locator("#stage").bounding_box()
    _, right, _, bottom = MESH.extent
    scale = min((box["width"] - 64) / right, (box["height"] - 64) / bottom)
    left = 18 + (box["width"] - 64 - scale * right) / 2
    top = 46 + (box["height"] - 64 - scale * bottom) / 2
    return left + scale * x, top + scale * y, scale


def drag(page, start, end, steps=6):
    box = page.locator("#stage").bounding_box()
    (ax, ay, _), (bx, by, _) = place(page, *start), place(page, *end)
    page.mouse.move(box["x"] + ax, box["y"] + ay)
    page.mouse.down()
    page.mouse.move(box["x"] + bx, box["y"] + by, steps=steps)
    page.mouse.up()
    settle(page)


def depth(page):
    return float(page.get_attribute("#stage", "data-depth"))


def hold(page, key, condition):
    page.keyboard.down(key)
    try:
        wait_until(page, condition)
    finally:
        page.keyboard.up(key)
    settle(page)


# --- the image and the needle


def test_the_idle_image_is_static(live):
    settle(live)
    first = picture(live)
    assert first.std() > 20  # there is an image
    time.sleep(0.3)
    np.testing.assert_array_equal(picture(live), first)


def test_a_drag_moves_tissue_near_the_needle_along_it_and_none_far_away(live):
    bare(live)
    settle(live)
    before = picture(live)
    drag(live, (20.0, 8.0), (20.0, 17.0))
    assert depth(live) == pytest.approx(9.0, abs=0.3)
    after = picture(live)
    x, y, scale = place(live, 20.0, depth(live))
    rows, columns = np.indices(before.shape)
    distance = np.hypot(columns - x, rows - y) / scale
    changed = np.abs(after - before)
    assert changed[distance < 2.5].mean() > 8
    far = (distance > 6.0 + np.hypot(*MESH.spacing)) & (
        rows > place(live, 0, 0.5)[1]
    )  # the marker of the entry lies on the skin
    assert changed[far].max() == 0
    # which way: the patch below the tip matches the old one best when it is taken from above
    half = int(1.5 * scale)
    here = np.s_[int(y) - half : int(y) + half, int(x) - half : int(x) + half]

    def misfit(dx, dy):
        return np.abs(after[here] - np.roll(before, (dy, dx), (0, 1))[here]).mean()

    reach = range(-int(2.2 * scale), int(2.2 * scale) + 1)
    best = min((misfit(dx, dy), dx, dy) for dx in reach for dy in reach)
    assert best[2] / scale == pytest.approx(1.8, abs=0.5)  # a fifth of the depth, downwards
    assert abs(best[1] / scale) < 0.4


def test_reset_restores_the_image_exactly(live):
    settle(live)
    before = picture(live)
    drag(live, (20.0, 8.0), (20.0, 15.0))
    assert np.abs(picture(live) - before).max() > 50
    live.keyboard.press("Space")
    wait_until(live, "text('largest') === '0.00'")
    settle(live)
    np.testing.assert_array_equal(picture(live), before)


def test_a_press_near_the_skin_chooses_the_entry_and_one_inside_aims(live):
    drag(live, (12.0, 1.0), (12.0, 1.0))
    assert float(live.text_content("#entry-value")) == pytest.approx(12.0, abs=0.2)
    drag(live, (22.0, 10.0), (22.0, 10.0))
    assert float(live.text_content("#angle")) == pytest.approx(45.0, abs=1.5)
    drag(live, (22.0, 10.0), (25.0, 13.0))
    assert depth(live) == pytest.approx(np.hypot(3, 3), abs=0.3)
    live.keyboard.down("Shift")
    drag(live, (22.0, 10.0), (17.0, 14.0))
    live.keyboard.up("Shift")
    assert float(live.text_content("#angle")) == pytest.approx(45 + np.degrees(np.arctan2(14, 5)) - 45, abs=3)
    assert float(live.text_content("#entry-value")) == pytest.approx(12.0, abs=0.2)


def test_switching_the_model_keeps_the_pose(live):
    drag(live, (20.0, 8.0), (20.0, 16.0))
    before = depth(live)
    wait_until(live, "Math.abs(Number(text('largest')) - 0.2 * Number(d.depth)) < 0.02")
    live.keyboard.press("2")
    wait_until(live, "Math.abs(Number(text('largest')) - 0.1 * Number(d.depth)) < 0.02")
    assert depth(live) == before
    live.keyboard.press("k")
    wait_until(live, "Math.abs(Number(text('difference')) - 0.1 * Number(d.depth)) < 0.02")
    expect(live.locator("#heat")).to_be_checked()


def test_a_reload_resumes(live):
    drag(live, (20.0, 8.0), (20.0, 16.0))
    before = depth(live)
    visit(live, live.url)
    settle(live)
    assert depth(live) == pytest.approx(before, abs=0.01)
    assert float(live.text_content("#largest")) > 1.0


def test_two_pages_do_not_disturb_each_other(live, browser, context, address):
    settle(live)
    still = picture(live)
    other = context.new_page()
    visit(other, address)
    other.keyboard.press("2")
    hold(other, "ArrowDown", "Number(d.depth) > 5")
    np.testing.assert_array_equal(picture(live), still)
    assert live.text_content("#largest") == "0.00"
    assert live.get_attribute("#models button[data-model=soft]", "aria-pressed") == "true"


def test_a_failing_model_is_shown_and_reset_helps(live, caplog):
    live.locator("#depth-range").evaluate(
        "range => { range.value = 29; range.dispatchEvent(new Event('input')); }"
    )
    settle(live)
    assert not live.locator("#fault").is_visible()
    live.locator("#angle-range").evaluate(
        "range => { range.value = 70; range.dispatchEvent(new Event('input')); }"
    )
    live.locator("#depth-range").evaluate(
        "range => { range.max = 40; range.value = 31; range.dispatchEvent(new Event('input')); }"
    )
    expect(live.locator("#fault")).to_contain_text("through the table")
    live.keyboard.press("Space")
    expect(live.locator("#fault")).to_be_hidden()
    hold(live, "ArrowDown", "Number(d.depth) > 2")


# --- training


def test_the_keyboard_alone_completes_an_exercise_and_its_replay_scores_the_same(live, server):
    live.locator("#trainee").focus()
    live.keyboard.type("E. Mace")  # letters in a field are no commands
    live.keyboard.press("Tab")
    expect(live.locator("#start")).to_be_focused()
    live.keyboard.press("Enter")
    expect(live.locator("#exercise-status")).to_contain_text("Recording")
    hold(live, "ArrowDown", "Number(d.depth) > 13")
    live.keyboard.press("e")
    expect(live.locator("#summary")).to_be_visible()
    expect(live.locator("#verdict")).to_have_text("Passed")
    assert "mm from the target" in live.text_content("#why")
    metrics = live.locator("#metrics").inner_text()
    live.locator("#watch").click()
    expect(live.locator("#exercise-status")).to_contain_text("Replay")
    expect(live.locator("#summary-title")).to_contain_text("scored again")
    assert live.locator("#metrics").inner_text() == metrics
    live.keyboard.press("Escape")
    live.keyboard.press("l")
    expect(live.locator("#session-rows tr").first).to_contain_text("E. Mace")
    with live.expect_download() as download:
        live.locator("#export-sessions").click()
    assert Path(download.value.path()).read_text().startswith("id,started")
    live.keyboard.press("Escape")
    before = depth(live)
    hold(live, "ArrowUp", f"Number(d.depth) < {before} - 2")  # the needle obeys again


def test_after_a_click_the_keys_steer_again(live):
    live.locator("label:has(#mesh)").click()
    expect(live.locator("#mesh")).to_be_checked()
    hold(live, "ArrowDown", "Number(d.depth) > 2")
    live.keyboard.press("Space")  # resets, and does not press the box again
    wait_until(live, "d.depth === '0'")
    expect(live.locator("#mesh")).to_be_checked()


def test_targets_move_with_the_tissue(live):
    live.keyboard.press("e")
    expect(live.locator("#exercise-status")).to_contain_text("Recording")
    hold(live, "ArrowDown", "Number(d.depth) > 9")
    # the readout follows the needle by a few frames; a target that stayed would read more than 1 mm less
    shift = "0.2 * Number(d.depth) * (1 - ((12 - Number(d.depth)) / 6) ** 2) ** 2"
    wait_until(live, f"Math.abs(Number(text('target')) - (12 + {shift} - Number(d.depth))) < 0.15")
    live.keyboard.press("x")
    expect(live.locator("#exercise-status")).to_be_hidden()


# --- other hands


def test_a_gamepad_steers(live):
    live.evaluate(
        "() => { window.pad = { connected: true, axes: [0, 1, 0, 0], buttons: [{ pressed: false }] };"
        "navigator.getGamepads = () => [window.pad]; }"
    )
    wait_until(live, "Number(d.depth) > 4")
    live.evaluate("() => { window.pad.axes = [0, 0, -1, 0]; }")
    wait_until(live, "Number(text('angle')) > 100")
    live.evaluate("() => { window.pad.axes = [0, 0, 0, 0]; }")


def test_a_phone_shows_everything_without_scrolling_sideways_and_its_buttons_push(browser, context, address):
    page = context.new_page()
    page.set_viewport_size({"width": 360, "height": 700})
    visit(page, address)
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    push = page.locator("button[data-hold=ArrowDown]")
    box = push.bounding_box()
    page.mouse.move(box["x"] + 5, box["y"] + 5)
    page.mouse.down()
    wait_until(page, "Number(d.depth) > 2")
    page.mouse.up()
    settle(page)
    stopped = depth(page)
    time.sleep(0.2)
    assert depth(page) == stopped


def test_an_image_of_ones_own_can_be_opened(live, tmp_path):
    (tmp_path / "a.png").write_bytes(b"the opener of this test looks at nothing")
    live.locator("#open").click()
    live.locator("#upload-file").set_input_files(tmp_path / "a.png")
    live.locator("#upload-spacing").fill("0.1")
    live.locator("#upload-form button[type=submit]").click()
    expect(live.locator("#title")).to_have_text("Uploaded")
    hold(live, "ArrowDown", "Number(d.depth) > 1")


def test_a_scene_that_loads_slowly_is_not_drawn_or_reported_before_it_is_whole(live, context):
    """The second scene's image is held back while its frames come in and a gamepad pushes all the time; the server
    would close a page whose report of drawn frames goes back to none."""

    def late(route):
        time.sleep(0.5)
        route.continue_()

    context.route("**/api/image*", late)
    live.evaluate(
        "() => { navigator.getGamepads = () => [{ connected: true, axes: [0, 0.3, 0, 0], buttons: [] }]; }"
    )
    live.locator("#open").click()
    live.locator("#upload-file").set_input_files({"name": "a.png", "mimeType": "image/png", "buffer": b"x"})
    live.locator("#upload-spacing").fill("0.1")
    live.locator("#upload-form button[type=submit]").click()
    expect(live.locator("#title")).to_have_text("Uploaded")
    wait_until(live, "Number(d.depth) > 1 && Number(text('depth')) > 0.5")
    assert live.get_attribute("#connection", "data-state") == "open"


def test_with_a_token_the_page_works_and_without_it_says_why_not(context, tmp_path):
    with running(tmp_path, settings=Settings(port=0, token="a-secret")) as (address, _, _):
        page = context.new_page()
        visit(page, f"{address}/#token=a-secret")
        assert "a-secret" not in page.url
        page.close()
        context.expected_faults = 20  # the browser itself reports each refused connection
        stranger = context.new_page()
        stranger.goto(address)
        expect(stranger.locator("#fault")).to_contain_text("token is missing")


# --- the shaders, against NumPy


def rendered(page, frame, mesh, image, pixels, scale, looks=None, apex=None):
    """Grey levels that the page's renderer makes of one frame; pixel (i, j) shows ((i + .5), (j + .5)) / scale mm."""
    description = {
        "image": {"columns": image.pixels.shape[1], "rows": image.pixels.shape[0],
                  "spacing": image.spacing, "origin": image.grid.origin},
        "mesh": {"shape": mesh.shape, "spacing": mesh.spacing, "origin": mesh.origin},
        "needle": {"echo": PAGE_LOOK | {"diameter": 1.27, "apex": apex}},
    }  # fmt: skip
    looks = {"gain": 0, "contrast": 1, "invert": False, "mesh": False, "heat": False, "heatScale": 1, "shaft": True,
             "tip": True, "reverberation": True, "shadow": True} | (looks or {})  # fmt: skip
    encode = lambda data: base64.b64encode(data).decode()  # noqa: E731
    values = page.evaluate(
        """async ({ frame, pixels, description, looks, size, scale }) => {
          const { Renderer } = await import("/static/renderer.js");
          const { decodeFrame } = await import("/static/protocol.js");
          const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
          const canvas = document.createElement("canvas");
          [canvas.width, canvas.height] = size;
          const renderer = new Renderer(canvas);
          renderer.setScene(description, bytes(pixels));
          const view = { scale, toClip: () => [(2 * scale) / size[0], (-2 * scale) / size[1], -1, 1] };
          renderer.draw(decodeFrame(bytes(frame).buffer), view, looks);
          const gl = renderer.gl, out = new Uint8Array(4 * size[0] * size[1]);
          gl.readPixels(0, 0, size[0], size[1], gl.RGBA, gl.UNSIGNED_BYTE, out);
          return btoa(Array.from(out, (v) => String.fromCharCode(v)).join(""));
        }""",
        {"frame": encode(frame), "pixels": encode(image.pixels.tobytes()), "description": description,
         "looks": looks, "size": pixels, "scale": scale},
    )  # fmt: skip
    width, height = pixels
    rgba = np.frombuffer(base64.b64decode(values), np.uint8).reshape(height, width, 4)
    return rgba[::-1, :, 0].astype(float)


def snapshot(displacement, pose=None, **more):
    pose = pose or NeedlePose((5.0, 0.0), (5.0, 0.0))
    rest = Command(pose.entry, pose.tip)
    return Snapshot(1, 0.0, pose, displacement, "soft", rest, 0.0, np.empty((0, 2)), **more)


@pytest.mark.parametrize("apex", [None, (20.0, -30.0)], ids=["linear array", "curved array"])
def test_the_needle_is_drawn_where_it_is(live, apex):
    """A bright shaft and tip on a grey picture, a shadow behind, nothing in front, at five angles."""
    image = UltrasoundImage(
        np.full((120, 160), 100, np.uint8), RegularGrid((160, 120), (0.25, 0.25), (0.125, 0.125))
    )
    mesh = RegularGrid.covering(image.grid, (9, 7))
    still = np.zeros((mesh.size, 2))
    columns, rows = np.meshgrid(image.grid.x, image.grid.y)
    for angle in (10, 35, 60, 90, 140):
        direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        entry = np.array([20.0, 1.0])
        pose = NeedlePose(tuple(entry), tuple(entry + 17.0 * direction))
        got = rendered(live, encode_frame(snapshot(still, pose), 1), mesh, image, (160, 120), 4.0, apex=apex)
        _, away = pose.closest(np.column_stack([columns.ravel(), rows.ravel()]))
        away = away.reshape(got.shape)
        assert got[away < 0.5].mean() > 115, f"at {angle} degrees"
        at_tip = np.hypot(columns - pose.tip[0], rows - pose.tip[1]) < 0.5
        assert got[at_tip].max() > 180
        inside = np.zeros(got.shape, bool)
        inside[1:-1, 1:-1] = True  # the outermost pixels of the canvas are half background
        above = (away > 3) & (rows < 1) & inside
        assert np.abs(got[above] - 100).max() <= 2


@pytest.mark.parametrize("kernel", [ThinPlate(), Elastic()], ids=["thin plate", "elastic"])
def test_a_spline_drawn_from_its_weights_is_the_same_picture_as_from_its_nodes(live, kernel):
    rng = np.random.default_rng(5)
    image = scene().image
    edge = MESH.nodes[MESH.boundary(["left", "right", "bottom"])][::6]
    moving = rng.uniform((12, 6), (28, 20), (6, 2))
    u = np.vstack([np.zeros((len(edge), 2)), rng.normal(0, 1.0, (6, 2))])
    spline = factor(kernel, np.vstack([edge, moving])).solve(u)
    fine = RegularGrid.covering(MESH, (73, 55))  # the mesh that the page evaluates splines on
    looks = {"shaft": False, "tip": False, "reverberation": False, "shadow": False}
    nodes = encode_frame(snapshot(spline(fine.nodes)), 1)
    weights = encode_frame(snapshot(np.zeros((MESH.size, 2)), spline=lambda: spline), 1)
    assert len(weights) < len(nodes) / 10
    from_nodes = rendered(live, nodes, fine, image, (160, 120), 4.0, looks)
    from_weights = rendered(live, weights, MESH, image, (160, 120), 4.0, looks)
    still = rendered(
        live, encode_frame(snapshot(np.zeros((MESH.size, 2))), 1), MESH, image, (160, 120), 4.0, looks
    )
    assert np.abs(from_weights - still).max() > 60
    assert np.abs(from_weights - from_nodes).mean() < 0.5


def test_the_image_at_rest_is_shown_pixel_by_pixel(live):
    image = scene().image
    frame = encode_frame(snapshot(np.zeros((MESH.size, 2))), 1)
    looks = {"shaft": False, "tip": False, "reverberation": False, "shadow": False}
    got = rendered(live, frame, MESH, image, (160, 120), 4.0, looks)
    p = image.pixels.astype(float)
    between = (
        p[:-1, :-1] + p[1:, :-1] + p[:-1, 1:] + p[1:, 1:]
    ) / 4  # pixel centres of the canvas lie between
    assert IMAGE_GRID.shape == (161, 121)
    assert np.abs(got - between).max() <= 2


# --- bad lines


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_run_that_was_lost_in_a_restart_is_said_and_can_be_started_again(page, context, tmp_path):
    context.expected_faults = 50  # of the browser: it cannot connect meanwhile
    settings = Settings(port=free_port())
    with running(tmp_path, settings=settings) as (address, _, _):
        visit(page, address)
        page.locator("#start").click()
        expect(page.locator("#exercise-status")).to_contain_text("Recording")
        hold(page, "ArrowDown", "Number(d.depth) > 2")
    expect(page.locator("#fault")).to_contain_text("connection")
    with running(tmp_path, settings=settings):
        expect(page.locator("#fault")).to_contain_text("your run of “Straight down” is lost")
        expect(page.locator("#start")).to_have_text("Start")
        page.locator("#start").click()
        expect(page.locator("#exercise-status")).to_contain_text("Recording")
        expect(page.locator("#fault")).to_be_hidden()


def test_a_short_break_of_the_line_loses_no_run(page, context, tmp_path):
    context.expected_faults = 50
    with running(tmp_path) as (address, _, app):
        visit(page, address)
        page.locator("#start").click()
        expect(page.locator("#exercise-status")).to_contain_text("Recording")
        (client,) = app.state.room.pages
        client._loop.call_soon_threadsafe(lambda: client._loop.create_task(client.socket.close(1012)))
        expect(page.locator("#fault")).to_contain_text("connection")
        expect(page.locator("#fault")).to_be_hidden()
        expect(page.locator("#exercise-status")).to_contain_text("Recording")


def test_a_lost_tracker_is_shown_until_it_is_back(page, tmp_path):
    with running(tmp_path) as (address, _, app):
        visit(page, address)
        announce(
            app,
            "The tracker: stale: NeedleToTracker has been silent for 0.5 s; the needle stays where it was",
        )
        expect(page.locator("#fault")).to_contain_text("silent for 0.5 s")
        announce(app, "")
        expect(page.locator("#fault")).to_be_hidden()
        expect(page.locator("#notice")).to_contain_text("tracker is back")


def test_a_session_of_an_uploaded_picture_is_replayed_there_from_another_picture(page, tmp_path):
    other = UltrasoundImage(255 - speckle(), IMAGE_GRID)
    with running(tmp_path, opener=lambda path, spacing: scene(title="Uploaded", image=other)) as (
        address,
        _,
        _,
    ):
        visit(page, address)
        (tmp_path / "a.png").write_bytes(b"the opener of this test looks at nothing")
        page.locator("#open").click()
        page.locator("#upload-file").set_input_files(tmp_path / "a.png")
        page.locator("#upload-form button[type=submit]").click()
        expect(page.locator("#title")).to_have_text("Uploaded")
        page.locator("#start").click()
        expect(page.locator("#exercise-status")).to_contain_text("Recording")
        hold(page, "ArrowDown", "Number(d.depth) > 3")
        page.keyboard.press("e")
        expect(page.locator("#summary")).to_be_visible()
        page.evaluate("sessionStorage.setItem('scene', '')")
    settings = Settings(port=free_port())  # started again
    with running(
        tmp_path, settings=settings, opener=lambda path, spacing: scene(title="Uploaded", image=other)
    ) as (
        address,
        _,
        _,
    ):
        visit(page, address)
        expect(page.locator("#title")).to_have_text("Speckle")
        page.keyboard.press("l")
        page.locator("#session-rows button", has_text="Replay").first.click()
        expect(page.locator("#title")).to_have_text("Uploaded")
        expect(page.locator("#exercise-status")).to_contain_text("Replay")
