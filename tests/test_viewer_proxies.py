"""The server behind reverse proxies: its own check of origins, and the examples of docs/live.md with the real nginx and Caddy."""

from __future__ import annotations

import getpass
import http.client
import json
import os
import re
import shutil
import socket
import ssl
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from typer.testing import CliRunner
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from echospline.cli.app import app
from echospline.errors import InputError
from echospline.page import Pack, core_bytes
from echospline.scene import NeedlePose
from echospline.viewer import Settings, steer
from echospline.viewer.guard import Guard, checked_origin
from live_scene import Page, free_port, get, listening, pack, recorded, running, scene

OUTSIDE = "https://sim.example.org"
DOCS = Path(__file__).resolve().parent.parent / "docs" / "live.md"
TOKEN = "a-word-that-nobody-knows"
KEY = "ab" * 16


def scope(**headers: str):
    pairs = [(name.encode(), value.encode()) for name, value in headers.items()]
    return {"type": "http", "path": "/pack", "headers": pairs}


# --- origins


@pytest.mark.parametrize("host", ["sim.example.org", "sim.example.org:443", "127.0.0.1:8750", "localhost"])
def test_a_proxy_may_keep_host_or_write_its_own(tmp_path, host):
    settings = Settings(port=free_port(), token=TOKEN, origins=(OUTSIDE,))
    with running(tmp_path, settings=settings):
        address = f"http://127.0.0.1:{settings.port}"
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        assert get(address, "/pack", Host=host, Origin=OUTSIDE, **bearer)[0] == 200
        assert get(address, "/pack", Host=host, Origin=OUTSIDE)[0] == 401
        assert get(address, "/pack", Host=host, Origin="https://evil.example", **bearer)[0] == 403
        assert get(address, "/pack", Host="evil.example", Origin=OUTSIDE, **bearer)[0] == 421
        with listening(address, origin=OUTSIDE, subprotocols=["echospline.1", f"token.{TOKEN}"]) as client:
            assert client.line.subprotocol == "echospline.1"


def test_several_origins_and_none(tmp_path):
    guard = Guard(lambda *_: None, frozenset({"127.0.0.1"}), (), (OUTSIDE, "http://10.0.0.5:8080"))
    assert guard.refusal(scope(host="127.0.0.1", origin="http://10.0.0.5:8080")) is None
    assert guard.refusal(scope(host="127.0.0.1", origin=OUTSIDE.upper())) is None
    assert guard.refusal(scope(host="127.0.0.1", origin="http://sim.example.org"))[0] == 403
    assert guard.refusal(scope(host="127.0.0.1", origin="https://sim.example.org.evil.example"))[0] == 403
    assert guard.refusal(scope(host="127.0.0.1", origin="null"))[0] == 403
    assert guard.refusal(scope(host="127.0.0.1", origin="https://["))[0] == 403
    bare = Guard(lambda *_: None, frozenset({"127.0.0.1"}))
    assert bare.refusal(scope(host="127.0.0.1", origin=OUTSIDE))[0] == 403


def test_the_operator_is_told_once_what_to_do_and_the_page_is_not(caplog):
    guard = Guard(lambda *_: None, frozenset({"127.0.0.1"}))
    for _ in range(3):
        assert "--" not in guard.refusal(scope(host="127.0.0.1", origin=OUTSIDE))[1]
    assert len([r for r in caplog.records if "--origin" in r.message]) == 1


@pytest.mark.parametrize(
    ("text", "origin"),
    [
        ("https://Sim.Example.org/", OUTSIDE),
        ("https://sim.example.org:443", OUTSIDE),
        ("http://10.0.0.5:8080", "http://10.0.0.5:8080"),
        ("http://[::1]:80", "http://[::1]"),
    ],
)
def test_origins_are_written_as_browsers_write_them(text, origin):
    assert checked_origin(text) == origin


@pytest.mark.parametrize(
    "text",
    [
        "sim.example.org",
        "ftp://a",
        "https://a/b",
        "https://a?b",
        "https://u@a",
        "https://",
        "https://a:x",
        "",
    ],
)
def test_what_is_no_origin_is_refused(text):
    with pytest.raises(InputError, match="without a path"):
        Settings(origins=(text,))


def test_others_than_this_machines_users_need_a_token_unless_the_proxy_knows_them():
    assert Settings().token is None
    assert len(Settings(origins=(OUTSIDE,)).token) >= 24
    assert Settings(origins=(OUTSIDE,), open_door=True).token is None
    with pytest.raises(InputError, match="--no-token"):
        Settings(host="0.0.0.0", open_door=True)
    said = CliRunner().invoke(app, ["live", "--no-browser", "--port", "0", "--origin", "sim.example.org"])
    assert isinstance(said.exception, InputError)


def test_the_printed_address_is_the_outside_one(tmp_path):
    from echospline.viewer import Sessions, build_app, serve  # noqa: PLC0415

    settings = Settings(port=0, origins=(OUTSIDE,), token=TOKEN, instructor="another")
    built = build_app(scene(), Sessions(tmp_path / "s.sqlite"), settings)
    printed = []
    serve(built, settings, lambda *addresses: printed.extend(addresses), lambda: bool(printed))
    assert printed == [f"{OUTSIDE}/#token={TOKEN}", f"{OUTSIDE}/#token=another"]


# --- the examples of the docs


def example(language: str) -> str:
    (text,) = re.findall(rf"```{language}\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    return text


def changed(text: str, **changes: str) -> str:
    """Replace parts of an example; each must be in it."""
    for old, new in changes.values():
        assert old in text, old
        text = text.replace(old, new)
    return text


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """Certificate and key for sim.example.org, signed by themselves."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not here: the proxies' certificate cannot be made")
    folder = tmp_path_factory.mktemp("certificate")
    pem, key = folder / "sim.pem", folder / "sim.key"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=sim.example.org",
         "-addext", "subjectAltName=DNS:sim.example.org", "-keyout", key, "-out", pem],
        check=True, capture_output=True,
    )  # fmt: skip
    return pem, key


@contextmanager
def program(command: list[object], port: int):
    """Run a proxy until its port answers; its words are shown when it does not."""
    with subprocess.Popen(
        [str(c) for c in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            until = time.monotonic() + 30
            while True:
                try:
                    socket.create_connection(("127.0.0.1", port), timeout=1).close()
                    break
                except OSError:
                    assert process.poll() is None, process.stdout.read()
                    assert time.monotonic() < until
                    time.sleep(0.05)
            yield
        finally:
            process.terminate()
            process.wait(20)


@contextmanager
def nginx(folder: Path, inside: int, outside: int, certificate):
    binary = shutil.which("nginx") or shutil.which("/usr/sbin/nginx")
    if binary is None:
        pytest.skip("nginx is not installed; run tests/install-system (needs apt-get and root)")
    pem, key = certificate
    server = changed(
        example("nginx"),
        listen=("listen 443 ssl", f"listen 127.0.0.1:{outside} ssl"),
        pem=("/etc/ssl/sim.example.org.pem", str(pem)),
        key=("/etc/ssl/sim.example.org.key", str(key)),
        inside=("127.0.0.1:8750", f"127.0.0.1:{inside}"),
    )
    spaces = "\n".join(
        f"{name}_temp_path {folder}/{name};" for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    user = (
        f"user {getpass.getuser()};" if os.geteuid() == 0 else ""
    )  # else its workers may not read this folder
    text = f"{user} daemon off; pid {folder}/pid; error_log stderr; events {{}}\nhttp {{ access_log off;\n{spaces}\n{server}}}\n"
    (folder / "nginx.conf").write_text(text)
    with program([binary, "-p", folder, "-c", folder / "nginx.conf"], outside):
        yield


@contextmanager
def caddy(folder: Path, inside: int, outside: int, certificate):
    if shutil.which("caddy") is None:
        pytest.skip("caddy is not installed; run tests/install-system (needs apt-get and root)")
    pem, key = certificate
    site = changed(
        example("caddy"),
        name=(
            "sim.example.org {",
            f"https://sim.example.org:{outside} {{\n\tbind 127.0.0.1\n\ttls {pem} {key}",
        ),
        inside=("127.0.0.1:8750", f"127.0.0.1:{inside}"),
    )
    (folder / "Caddyfile").write_text("{\n\tadmin off\n\tauto_https disable_redirects\n}\n" + site)
    with program(["caddy", "run", "--config", folder / "Caddyfile", "--adapter", "caddyfile"], outside):
        yield


def through(port: int, certificate):
    """A TLS connection to the proxy, as a browser that looked up sim.example.org has it."""
    context = ssl.create_default_context(cafile=str(certificate[0]))
    plain = socket.create_connection(("127.0.0.1", port), timeout=20)
    return context.wrap_socket(plain, server_hostname="sim.example.org")


def ask(port: int, certificate, method: str, path: str, body: bytes | None = None, **headers: str):
    link = http.client.HTTPConnection("sim.example.org")
    link.sock = through(port, certificate)
    link.request(method, path, body, {"Origin": OUTSIDE, "Authorization": f"Bearer {TOKEN}", **headers})
    answer = link.getresponse()
    data = answer.read()
    link.close()
    return answer.status, data


@pytest.mark.parametrize("proxy", [nginx, caddy], ids=["nginx", "caddy"])
def test_the_example_of_the_docs_carries_the_page_its_socket_and_an_upload(proxy, tmp_path, certificate):
    settings = Settings(port=free_port(), token=TOKEN, origins=(OUTSIDE,))
    outside = free_port()
    clients = []

    def opener(path, spacing):
        assert path.stat().st_size == 3_000_000
        return scene(title="Through the proxy")

    with running(tmp_path / "served", settings=settings, opener=opener) as (_, _, served):
        turn = served.state.room.uploads.turn
        served.state.room.uploads.turn = lambda client: clients.append(client) or turn(client)
        (tmp_path / "proxy").mkdir()
        with proxy(tmp_path / "proxy", settings.port, outside, certificate):
            status, index = ask(outside, certificate, "GET", "/")
            assert (status, b"<html" in index) == (200, True)
            status, data = ask(outside, certificate, "GET", "/pack")
            assert (status, data) == (200, pack().to_bytes())
            assert ask(outside, certificate, "GET", "/core.wasm") == (200, core_bytes())
            assert ask(outside, certificate, "GET", "/pack", Authorization="Bearer no")[0] == 401
            assert ask(outside, certificate, "GET", "/pack", Origin="https://evil.example")[0] == 403
            status, said = ask(
                outside, certificate, "POST", "/api/open?name=a.png&spacing=0.2", b"x" * 3_000_000
            )
            assert status == 200, said
            mine = Pack.from_bytes(said)
            assert mine.manifest.title == "Through the proxy"
            told = json.dumps(recorded(mine)).encode()
            status, said = ask(outside, certificate, "POST", "/api/sessions", told)
            assert (status, json.loads(said)["verified"]) == (200, True)

            def socket_of(path: str, origin: str = OUTSIDE):
                return connect(
                    f"ws://sim.example.org/{path}?room={KEY}", sock=through(outside, certificate), origin=origin,
                    subprotocols=["echospline.1", f"token.{TOKEN}"], compression=None,
                )  # fmt: skip

            with socket_of("poses") as line, socket_of("phone") as phone:
                page = Page(line)
                page.hear("phone")
                phone.send('{"turn": [1, 2, 3]}')
                assert page.hear("turn")["turn"] == [1.0, 2.0, 3.0]
                steer(served, NeedlePose((8.0, 0.0), (8.0, 5.0)), True)
                assert page.hear("tip")["tip"] == [8.0, 5.0]
            with pytest.raises(InvalidStatus) as refused, socket_of("poses", "https://evil.example"):
                pass
            assert refused.value.response.status_code == 403
    assert clients == ["127.0.0.1"]  # the address that the proxy gives, which is the browser's
