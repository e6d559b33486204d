"""The page of one file in Firefox, steered by the browser's own WebDriver BiDi, where Firefox is installed."""

from __future__ import annotations

import itertools
import json
import shutil
import socket
import subprocess
import time

import pytest
from websockets.sync.client import connect

import page_scene
from echospline.page import bundle

FIREFOX = shutil.which("firefox-esr") or shutil.which("firefox")
WASM = page_scene.ROOT / "src" / "echospline" / "_native" / "echospline.wasm"
PATIENCE = 60  # s
DOWN = "\ue015"

pytestmark = [
    pytest.mark.skipif(
        FIREFOX is None, reason="Firefox is not installed; run tests/install-system (needs apt-get and root)"
    ),
    pytest.mark.skipif(not WASM.exists(), reason="echospline.wasm is not built; run make wasm"),
]


class Firefox:
    """A tab of a headless Firefox."""

    def __init__(self, line):
        self.line, self.numbers, self.faults = line, itertools.count(1), []
        self.call("session.new", capabilities={})
        self.call("session.subscribe", events=["log.entryAdded"])
        self.tab = self.call("browsingContext.create", type="tab")["context"]

    def call(self, method, **params):
        number = next(self.numbers)
        self.line.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            told = json.loads(self.line.recv(PATIENCE))
            if told.get("method") == "log.entryAdded" and told["params"]["level"] == "error":
                self.faults.append(told["params"]["text"])
            if told.get("id") == number:
                assert told["type"] == "success", told
                return told["result"]

    def value(self, expression):
        found = self.call(
            "script.evaluate", expression=expression, target={"context": self.tab}, awaitPromise=True
        )
        return found["result"].get("value")

    def until(self, expression):
        end = time.monotonic() + PATIENCE
        while not self.value(expression):
            assert time.monotonic() < end, f"never true: {expression}"
            time.sleep(0.05)

    def keys(self, *actions):
        self.call(
            "input.performActions",
            context=self.tab,
            actions=[{"type": "key", "id": "keys", "actions": list(actions)}],
        )


@pytest.fixture(scope="module")
def firefox(tmp_path_factory):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    home = tmp_path_factory.mktemp("firefox")
    browser = subprocess.Popen(
        [FIREFOX, "--headless", "--no-remote", "--profile", str(home), "--remote-debugging-port", str(port)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env={"HOME": str(home), "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    try:
        end = time.monotonic() + PATIENCE
        while True:
            try:
                line = connect(f"ws://127.0.0.1:{port}/session", max_size=None, open_timeout=5)
                break
            except OSError:
                assert time.monotonic() < end, "Firefox did not start"
                time.sleep(0.2)
        with line:
            yield Firefox(line)
    finally:
        browser.terminate()
        browser.wait(PATIENCE)


def test_firefox_opens_the_file_pushes_scores_and_keeps(firefox, tmp_path):
    path = tmp_path / "trainer.html"
    path.write_text(bundle(page_scene.small()), encoding="utf-8")
    firefox.call("browsingContext.setViewport", context=firefox.tab, viewport={"width": 1440, "height": 900})
    firefox.call("browsingContext.navigate", context=firefox.tab, url=path.as_uri(), wait="complete")
    firefox.until("document.getElementById('stage').dataset.ready === 'true'")
    assert firefox.value("document.getElementById('fault').hidden") is True
    firefox.keys({"type": "keyDown", "value": "e"}, {"type": "keyUp", "value": "e"})
    firefox.until("document.body.classList.contains('recording')")
    firefox.keys({"type": "keyDown", "value": DOWN})
    firefox.until("Number(document.getElementById('stage').dataset.depth) > 5")
    firefox.keys(
        {"type": "keyUp", "value": DOWN}, {"type": "keyDown", "value": "e"}, {"type": "keyUp", "value": "e"}
    )
    firefox.until("document.getElementById('summary').open")
    firefox.until("document.getElementById('notice').textContent.length > 5")
    assert firefox.value("document.querySelectorAll('#metrics tr').length") == 11
    grey = "(() => { const c = document.getElementById('canvas'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; const seen = new Set(); for (let k = 0; k < d.length; k += 400) seen.add(d[k]); return seen.size; })()"
    assert firefox.value(grey) > 30
    assert firefox.value("window.broken ?? null") is None
    assert not firefox.faults, firefox.faults
