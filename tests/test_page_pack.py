"""The pack of a scene, and the page as one file: what is written is what is read, and nothing hostile is."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import struct
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

import page_scene
from echospline.cli.app import loaded
from echospline.errors import InputError
from echospline.page import Pack, bundle, pack_of_page, packed
from echospline.page.bundle import assembled, one_script, shipped
from echospline.page.pack import deflated, inflated
from echospline.page.replay import tissue_of
from echospline.scenario import Scenario, build_model
from echospline.scene import NeedlePose, RegularGrid, UltrasoundImage
from node_here import NODE, STEADY

STUB = Path(__file__).resolve().parent / "page_stub"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture(scope="module")
def small():
    return page_scene.small()


@pytest.fixture(scope="module")
def data(small):
    return small.to_bytes()


def stub(name: str) -> str:
    path = STUB / name
    return path.read_text(encoding="utf-8") if path.is_file() else shipped(name)


# --- what is packed


def test_a_pack_is_read_as_it_was_written(small, data):
    again = Pack.from_bytes(data)
    assert again.manifest == small.manifest
    assert again.to_bytes() == data
    assert again.digest == small.digest == hashlib.sha256(data).hexdigest()
    np.testing.assert_array_equal(again.arrays["pixels"], page_scene.image().pixels)
    with pytest.raises(ValueError, match="read-only"):
        again.arrays["pixels"][0, 0] = 1


def test_two_packs_of_a_scene_are_the_same_bytes(data):
    assert page_scene.small().to_bytes() == data


@pytest.mark.parametrize("kind", ["tps", "elastic"])
def test_a_model_of_a_pack_moves_tissue_as_pythons_own_model(small, kind):
    scenario = page_scene.scenario()
    grid = scenario.grid(page_scene.image())
    own = build_model(scenario, grid, kind=kind)
    pack = Pack.from_bytes(small.to_bytes())
    tissue = tissue_of(pack, pack.model(kind))
    state, other = tissue.rest(), own.rest()
    for x, y, tx, ty, speed in page_scene.poses()[::3]:
        pose = NeedlePose((x, y), (tx, ty), speed)
        state, other = tissue.advance(state, pose, 0.025), own.advance(other, pose, 0.025)
    field = own.displacement(other)
    assert np.abs(field).max() > 0.2
    np.testing.assert_array_equal(tissue.displacement(state), field)


def test_stiff_tissue_and_clamped_points_are_in_the_pack(small):
    model = small.model("tps")
    assert small.array(model, "clamped_points").tolist() == [[28.0, 10.0]]
    firm = small.array(model, "stiffness")
    assert firm.shape == (16 * 12,)
    assert (firm > 0).all()
    assert np.isfinite(firm).any()


def test_the_scenarios_own_model_comes_first():
    names = [model.name for model in page_scene.small(**{"model.kind": "elastic"}).manifest.models]
    assert names[0] == "elastic"
    assert set(names) >= {"tps", "elastic"}


def test_colour_is_packed_by_its_brightness():
    grid = RegularGrid((8, 6), (1.0, 1.0))
    pixels = np.zeros((6, 8, 3), np.uint8)
    pixels[..., 0], pixels[2, 3] = 100, (10, 20, 30)
    plain = Scenario().with_values(
        {"mesh.nodes": (4, 4), "needle.entry": (1.0, 0.0), "model.kind": "tps"}, "test"
    )
    grey = packed(plain, UltrasoundImage(pixels, grid, "colour"), Path()).arrays["pixels"]
    assert grey[0, 0] == round(0.299 * 100)
    assert grey[2, 3] == round(0.299 * 10 + 0.587 * 20 + 0.114 * 30)


def test_an_entry_outside_the_picture_is_refused():
    with pytest.raises(InputError, match=r"needle\.entry must lie in the image"):
        page_scene.small(**{"needle.entry": (50.0, 0.0)})


# --- what is refused


def changed(data: bytes, change) -> bytes:
    """Pack whose manifest has been changed, with its length put right."""
    (length,) = struct.unpack_from("<I", data, 8)
    tree = json.loads(data[12 : 12 + length])
    start = 12 + length + -(12 + length) % 8
    tree = change(tree) or tree
    text = (tree if isinstance(tree, str) else json.dumps(tree)).encode()
    head = b"ECHOPACK" + struct.pack("<I", len(text)) + text
    return head + bytes(-len(head) % 8) + data[start:]


def put(*keys):
    """Change that sets what stands at keys."""
    *path, last, value = keys

    def change(tree):
        for key in path:
            tree = tree[key]
        tree[last] = value

    return change


HOSTILE = {
    "another format": (put("format", 2), "format"),
    "an unknown key": (put("script", "alert(1)"), "script"),
    "no models": (put("models", []), "models"),
    "a mesh beyond memory": (put("mesh", "shape", [4096, 4096]), "nodes"),
    "a mesh in space over a picture": (put("mesh", "shape", [4, 4, 4]), "mesh"),
    "a picture larger than its array": (put("image", "rows", 81), "picture"),
    "an array beyond the end": (put("arrays", "pixels", "shape", [80000, 128]), "overlaps|ends beyond"),
    "an array of negative size": (put("arrays", "pixels", "shape", [-80, 128]), "shape"),
    "an array between multiples of eight": (put("arrays", "pixels", "offset", 4), "offset"),
    "an array of another type": (put("arrays", "pixels", "dtype", "object"), "dtype"),
    "an array shorter than the bytes": (put("arrays", "pixels", "shape", [79, 128]), "overlaps|arrays end|picture"),
    "a name of no array": (put("image", "pixels", "voxels"), "voxels"),
    "text for a number": (put("image", "rows", "80"), "rows"),
    "a spacing of zero": (put("mesh", "spacing", [0, 1]), "spacing"),
    "a direction of length 2": (put("needle", "direction", [2.0, 0.0]), "length 1"),
    "a direction in space": (put("needle", "direction", [1.0, 0.0, 0.0]), "2 numbers"),
    "a rate of zero": (put("rate", 0), "rate"),
    "a name that is markup": (put("models", 0, "name", "<b>"), "name"),
    "a model of no kind": (put("models", 0, "kind", "script"), "kind"),
    "options of another mesh": (put("models", 0, "options", "shape", [400, 400, 0]), "mesh"),
    "two models of a name": (put("models", 0, "name", "elastic"), "one name"),
    "a target outside": (put("exercises", 0, "target", "centre", [99.0, 1.0]), "must lie in the image"),
    "an infinite number": (put("needle", "lag", float("inf")), "lag|finite|damaged"),
    "not a number": (put("needle", "echo", "specular", float("nan")), "finite|damaged"),
    "no JSON": (lambda _: "{", "damaged"),
    "tables without end": (lambda _: '{"a":' * 100_000, "damaged"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_manifest_is_refused_in_one_sentence(data, name):
    change, said = HOSTILE[name]
    with pytest.raises(InputError, match=said) as refused:
        Pack.from_bytes(changed(data, change))
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 500


def test_an_option_that_the_core_does_not_have_is_refused_before_it_runs(data):
    pack = Pack.from_bytes(changed(data, put("models", 0, "options", "stiffness", 140_000_000)))
    with pytest.raises(InputError, match="no option of a scene"):
        tissue_of(pack, pack.manifest.models[0])


@pytest.mark.parametrize("kept", [0, 7, 8, 11, 12, 500, 3000, -1])
def test_a_pack_that_is_cut_is_refused(data, kept):
    with pytest.raises(InputError):
        Pack.from_bytes(data[:kept])


def test_bytes_behind_the_arrays_are_refused(data):
    with pytest.raises(InputError, match="arrays end"):
        Pack.from_bytes(data + bytes(8))


def ending(data: bytes) -> str:
    """Sentence with which a reader refuses; empty where it reads."""
    try:
        Pack.from_bytes(data)
    except InputError as error:
        return str(error)
    return ""


def test_whatever_bytes_are_changed_the_reader_ends_in_a_pack_or_a_sentence(data):
    rng = np.random.default_rng(11)
    (length,) = struct.unpack_from("<I", data, 8)
    ends = {"read": 0, "refused": 0}
    for _ in range(400):
        broken = bytearray(data)
        for _ in range(rng.integers(1, 4)):
            broken[rng.integers(8, 12 + length)] = rng.integers(0, 256)
        said = ending(bytes(broken))
        assert len(said.splitlines()) <= 1
        ends["refused" if said else "read"] += 1
    assert ends["refused"] > 100


def test_packed_data_that_unpacks_without_end_is_refused():
    with pytest.raises(InputError, match="longer than"):
        inflated(deflated(bytes(10_000_000)), most=1_000_000)
    with pytest.raises(InputError, match=r"damaged|cut"):
        inflated(deflated(b"a scene")[:-2])
    assert inflated(deflated(b"a scene")) == b"a scene"


# --- the page


def test_a_page_holds_its_scene_and_gives_it_back(small, tmp_path):
    page = assembled(stub, {"core": b"core", "scene": small.to_bytes()})[0]
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    assert pack_of_page(tmp_path / "page.html").digest == small.digest
    assert "onerror" not in page
    assert "<img" not in page


def test_the_policy_names_the_very_bytes_of_script_and_style(small):
    page = assembled(stub, {"core": b"core", "scene": small.to_bytes()}, "de")[0]
    content = re.search(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', page).group(1)
    script = re.search(r'<script type="module">(.*?)</script>', page, re.DOTALL).group(1)
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL).group(1)
    for text, directive in ((script, "script-src"), (style, "style-src")):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{directive} 'sha256-{digest}'" in content
    assert "default-src 'none'" in content
    assert "connect-src" not in content
    assert "unsafe-inline" not in content
    assert page.index("Content-Security-Policy") < page.index("<style>") < page.index("<script")
    assert '<html lang="de">' in page
    assert "\r" not in page


def test_line_ends_of_a_checkout_make_no_difference(small):
    windows = assembled(lambda name: stub(name).replace("\n", "\r\n"), {"scene": small.to_bytes()})[0]
    assert windows == assembled(stub, {"scene": small.to_bytes()})[0]


MODULES = {
    "main.js": 'import { drawn } from "./draw.js";\nimport {\n  scene,\n  LARGE,\n} from "./scene.js";\ndrawn(scene, LARGE);\n',
    "draw.js": 'import { scene } from "./scene.js";\nexport function drawn() { return scene; }\n',
    "scene.js": "export const scene = 1;\nexport const LARGE = 2;\nconst own = 3;\n",
}


def test_modules_become_one_script_each_after_what_it_imports():
    script = one_script(MODULES.__getitem__, "main.js")
    assert script.index("// scene.js") < script.index("// draw.js") < script.index("// main.js")
    assert script.count("const scene = 1") == 1
    assert "import" not in script
    assert "export" not in script


@pytest.mark.parametrize(
    ("name", "old", "new", "match"),
    [
        ("draw.js", "return scene; }", "return scene; }\nconst own = 4;", "both declare own"),
        ("scene.js", "const own", 'import { drawn } from "./draw.js";\nconst own', "circle"),
        ("main.js", "LARGE,\n}", "SMALL,\n}", "SMALL from scene.js"),
        ("main.js", "drawn }", "drawn as d }", "as they are"),
        ("main.js", "drawn(", 'import * as all from "./scene.js";\ndrawn(', "no room"),
        ("draw.js", "export function", "export default function", "no room"),
        ("scene.js", "const own = 3", 'const own = "</script>"', "</script"),
    ],
)
def test_modules_that_one_script_cannot_hold_are_refused(name, old, new, match):
    changed_modules = {**MODULES, name: MODULES[name].replace(old, new)}
    assert changed_modules != MODULES
    with pytest.raises(InputError, match=match):
        one_script(changed_modules.__getitem__, "main.js")


def test_inline_handlers_of_the_html_are_refused(small):
    read = {"index.html": stub("index.html").replace("<canvas", '<canvas onclick="go()"')}
    with pytest.raises(InputError, match="inline handlers"):
        assembled(lambda name: read.get(name) or stub(name), {"scene": small.to_bytes()})


@pytest.mark.skipif(NODE is None, reason="Node is not installed: the script's syntax is not checked")
def test_the_one_script_is_sound_javascript(tmp_path):
    path = tmp_path / "page.mjs"
    path.write_text(one_script(stub, "main.js"), encoding="utf-8")
    done = subprocess.run(
        [NODE, STEADY, "--check", str(path)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def browser_type_launch_args(browser_type_launch_args):
    flags = ["--no-sandbox", "--disable-gpu"]
    return {**browser_type_launch_args, "executable_path": CHROMIUM, "args": flags}


@pytest.mark.skipif(
    CHROMIUM is None, reason="Chromium is not installed; run tests/install-system (needs apt-get and root)"
)
def test_a_page_opens_from_a_file_and_runs_nothing_that_was_added(small, tmp_path, browser):
    wasm = page_scene.ROOT / "src" / "echospline" / "_native" / "echospline.wasm"
    if not wasm.exists():
        pytest.skip("echospline.wasm is not built; run make wasm")
    page = assembled(stub, {"core": wasm.read_bytes(), "scene": small.to_bytes()})[0]
    heard = []

    class Listener(BaseHTTPRequestHandler):
        def do_GET(self):
            heard.append(self.path)
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Listener)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    there = f"http://127.0.0.1:{server.server_port}"
    added = (
        "<script>document.title = 'taken'</script><img src=x onerror=\"document.title = 'taken'\">"
        f"<img src='{there}/leak.png'><iframe src='{there}/frame'></iframe><form action='{there}/form'></form></body>"
    )
    (tmp_path / "page.html").write_text(page.replace("</body>", added), encoding="utf-8", newline="")
    tab = browser.new_page()
    tab.goto((tmp_path / "page.html").as_uri())
    said = tab.locator("#said", has_text="scene of")
    said.wait_for(timeout=20_000)
    assert said.inner_text() == f"core 0.1.0, scene of {len(small.to_bytes())} bytes"
    sent = "fetch(%r).then(() => 'sent', () => 'refused')" % f"{there}/fetch"  # noqa: UP031 - braces are the script's
    assert tab.evaluate(sent) == "refused"
    assert tab.title() == "echospline"
    tab.evaluate("document.querySelector('form').submit()")
    tab.wait_for_timeout(300)
    tab.goto(f"{there}/heard")  # the listener does listen
    tab.close()
    server.shutdown()
    server.server_close()
    assert [path for path in heard if path != "/favicon.ico"] == ["/heard"]


def test_a_page_that_cannot_be_written_whole_is_not_there(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise InputError("the disk is full")

    monkeypatch.setattr("echospline.page.bundle", fails)
    out = tmp_path / "trainer.html"
    out.write_text("the old one", encoding="utf-8")
    with pytest.raises(InputError, match="disk is full"):
        loaded("page").main(
            ["sample:calf", "--mesh", "6x6", "--model", "tps", "--out", str(out)], standalone_mode=False
        )
    assert out.read_text(encoding="utf-8") == "the old one"
    assert [path.name for path in tmp_path.iterdir()] == ["trainer.html"]


def test_the_page_of_the_calf_is_below_a_megabyte(tmp_path, capsys):
    try:
        bundle(page_scene.small())
    except InputError as error:
        pytest.skip(str(error))
    out = tmp_path / "trainer.html"
    loaded("page").main(["--out", str(out)], standalone_mode=False)
    assert out.stat().st_size <= 1_000_000
    assert f"{out.stat().st_size / 1000:.0f} kB" in capsys.readouterr().out
    assert pack_of_page(out).manifest.title == "Sample: calf"
