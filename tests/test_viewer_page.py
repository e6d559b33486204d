"""The served page in a real browser where others can reach it: its token, and a phone that holds the probe."""

from __future__ import annotations

import re

import numpy as np
import pytest
from playwright.sync_api import expect
from scipy.spatial.transform import Rotation

from echospline.page import packed_space
from echospline.scene import probe_plane
from echospline.viewer import Settings
from live_scene import running, waited
from test_page_browser import CHROMIUM, FLAGS, WASM, picture, ready
from test_page_pack_space import opened

pytestmark = [
    pytest.mark.skipif(
        CHROMIUM is None,
        reason="Chromium is not installed; run tests/install-system (needs apt-get and root)",
    ),
    pytest.mark.skipif(not WASM.exists(), reason="echospline.wasm is not built; run make wasm"),
]
TOKEN = "a-word-that-nobody-knows"


@pytest.fixture(scope="session")
def browser_type_launch_args(browser_type_launch_args):
    return {**browser_type_launch_args, "executable_path": CHROMIUM, "args": FLAGS}


def test_with_its_token_the_page_works_and_without_it_says_why_not(browser, tmp_path):
    with running(tmp_path, settings=Settings(port=0, token=TOKEN)) as (address, _, _):
        page = browser.new_page()
        page.goto(f"{address}/#token={TOKEN}")
        ready(page)
        expect(page.locator("#title")).to_have_text("Speckle")
        page.close()
        for wrong in ("", "#token=guess"):
            page = browser.new_page()
            page.goto(f"{address}/{wrong}")
            expect(page.locator("#fault")).to_contain_text("token is missing or wrong")
            page.close()


@pytest.fixture
def phone(browser):
    """A phone's page whose orientation is what a test says."""
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True)
    page = context.new_page()
    faults = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    yield page
    context.close()
    assert not faults, faults


@pytest.fixture
def held(phone):
    """Hold the phone with these angles."""
    line = phone.context.new_cdp_session(phone)

    def hold(alpha, beta, gamma):
        told = {"alpha": alpha, "beta": beta, "gamma": gamma}
        line.send("DeviceOrientation.setDeviceOrientationOverride", told)
        phone.wait_for_timeout(150)

    return hold


def test_a_phone_turns_the_slice_while_its_button_is_held(browser, phone, held, tmp_path):
    with running(tmp_path, pack=packed_space(opened()), fem=None) as (address, _, app):
        page = browser.new_page()
        page.goto(address)
        ready(page)
        waited(app, 1)
        key = next(iter(app.state.room.hub.listeners)).key
        assert re.fullmatch("[0-9a-f]{32}", key)
        phone.goto(f"{address}/phone?room={key}")
        held(0.0, 90.0, 0.0)  # upright
        expect(phone.locator("#state")).to_have_text("Connected.")
        before = picture(page)
        held(25.0, 90.0, 0.0)
        page.wait_for_timeout(300)
        assert np.array_equal(picture(page), before), "nothing turns before the button is held"
        box = phone.locator("#take").bounding_box()
        phone.mouse.move(box["x"] + 20, box["y"] + 20)
        phone.mouse.down()
        expect(phone.locator("#take")).to_have_attribute("aria-pressed", "true")
        held(30.0, 95.0, 0.0)
        expect(phone.locator("#state")).to_have_text("The slice follows.")
        held(60.0, 95.0, 0.0)
        page.wait_for_timeout(500)
        turned = picture(page)
        assert not np.array_equal(turned, before)
        phone.mouse.up()
        held(0.0, 60.0, 0.0)
        page.wait_for_timeout(300)
        assert np.array_equal(picture(page), turned), "a phone that is let go turns nothing"
        page.close()


def test_the_turn_of_a_phone_is_that_of_the_plane_it_stands_for(phone, tmp_path):
    """Compared with SciPy's rotations and `probe_plane`: lateral is the phone's x, depth its -y, across its -z."""
    axes = np.diag([1.0, -1.0, -1.0])
    rng = np.random.default_rng(6)
    upright = [0.0, 90.0, 0.0]
    cases = [(upright, [25.0, 90.0, 0.0]), (upright, [0.0, 110.0, 0.0])]
    cases += [
        ([rng.uniform(0, 360), rng.uniform(60, 120), rng.uniform(-30, 30)], [rng.uniform(0, 360), rng.uniform(60, 120), rng.uniform(-30, 30)])
        for _ in range(20)
    ]  # fmt: skip
    with running(tmp_path) as (address, _, _):
        phone.goto(f"{address}/phone?room={'ab' * 16}")
        script = re.search(r'<script type="module">(.*?)</script>', phone.content(), re.DOTALL).group(1)
        functions = script[script.index("function rotation") :]
        said = phone.evaluate(
            f"(cases) => {{ {functions}; return cases.map(([from, to]) => turned(rotation(...from), rotation(...to))); }}",
            cases,
        )
    np.testing.assert_allclose(said[:2], [[-25.0, 0.0, 0.0], [0.0, 20.0, 0.0]], atol=1e-9)
    for (first, now), turn in zip(cases, said, strict=True):
        start, end = (Rotation.from_euler("ZXY", angles, degrees=True).as_matrix() for angles in (first, now))
        wanted = axes @ start.T @ end @ axes
        np.testing.assert_allclose(probe_plane((0, 0, 0), *turn).matrix[:3, :3], wanted, atol=1e-9)
