"""A small scene for the tests of the server, and a server that runs it."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from urllib.parse import urlsplit

from websockets.sync.client import connect

from echospline.page import parsed_sessions, verify
from echospline.scenario import build_model
from echospline.viewer import Scene, Sessions, Settings, build_app, serve
from page_scene import image, poses, scenario, session, small

PAGE_KEY = "ab" * 16


@cache
def pack(title="Speckle"):
    return small(title=title)


def fem():
    made = scenario()
    return build_model(made, made.grid(image()), kind="fem", folder=Path())


def scene(title="Speckle", **changes):
    return Scene(**({"pack": pack(title), "source": "{}", "fem": fem} | changes))


def recorded(of=None, rows=None, **more):
    """A session of a scene's page, as JSON, with the score that its page computes."""
    of = of or pack()
    told = session(of, poses() if rows is None else rows, **more)
    (given,) = parsed_sessions(json.dumps(told).encode(), "test")
    return {**told, "score": verify(of, given).score.to_dict()} if told["score"] is None else told


@contextmanager
def running(folder, *, settings=None, opener=None, over=None, patience=20, **changes):
    """Serve a scene on loopback in a thread; yields (address without slash, sessions, app).

    `over` stops it earlier than at the end of the context; it then ends within `patience` seconds.
    """
    settings = settings or Settings(port=0)
    sessions = Sessions(folder / "sessions.sqlite")
    app = build_app(scene(**changes), sessions, settings, opener)
    address, up, over = [], threading.Event(), over or threading.Event()

    def ready(where, _teaching):
        address.append(where)
        up.set()

    thread = threading.Thread(target=serve, args=(app, settings, ready, over.is_set), daemon=True)
    thread.start()
    assert up.wait(20), "the server did not start"
    try:
        yield address[0].split("/#")[0].rstrip("/"), sessions, app
    finally:
        over.set()
        thread.join(patience)
        assert not thread.is_alive()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def get(address, path, method="GET", body=None, **headers):
    where = urlsplit(address)
    link = http.client.HTTPConnection(where.hostname, where.port, timeout=60)
    try:
        link.putrequest(method, path, skip_host="Host" in headers, skip_accept_encoding=True)
        for name, value in headers.items():
            link.putheader(name.replace("_", "-"), value)
        if body is not None:
            link.putheader("Content-Length", str(len(body)))
        link.endheaders(body)
        answer = link.getresponse()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()
    finally:
        link.close()


def post(address, path, content, **headers):
    """Send JSON; returns the status and the answer, read where it is JSON."""
    status, kind, body = get(address, path, "POST", json.dumps(content).encode(), **headers)
    return status, json.loads(body) if "json" in kind.get("content-type", "") else body.decode()


class Page:
    """What a page hears of its server."""

    def __init__(self, line):
        self.line = line

    def hear(self, *names, timeout=10.0):
        """Wait for a message with all these names."""
        while True:
            told = json.loads(self.line.recv(timeout))
            if set(names) <= set(told):
                return told


@contextmanager
def listening(address, key="", **options):
    """A page that listens at /poses."""
    with connect(f"ws{address[4:]}/poses?room={key}", compression=None, **options) as line:
        yield Page(line)


def waited(app, count):
    """Wait until so many pages listen."""
    until = time.monotonic() + 10
    while len(app.state.room.hub.listeners) != count:
        assert time.monotonic() < until
        time.sleep(0.01)
