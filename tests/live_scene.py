"""A small scene with stand-in tissue for the tests of the live page, and a server that runs it."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from echospline.scene import RegularGrid, UltrasoundImage
from echospline.viewer import Disc, Exercise, Scene, Sessions, Settings, build_app, serve

IMAGE_GRID = RegularGrid((161, 121), (0.25, 0.25))
MESH = RegularGrid.covering(IMAGE_GRID, (41, 31))


@dataclass(frozen=True)
class Bump:
    """Tissue of which a smooth bump is carried along by the tip; far from it nothing moves at all."""

    grid: RegularGrid = MESH
    share: float = 0.2
    reach: float = 6.0

    def rest(self):
        return None

    def advance(self, state, pose, dt):
        if pose.depth > 30.0:
            raise RuntimeError("the needle went through the table")
        return pose

    def displacement(self, state):
        return self.displacement_at(state, self.grid.nodes)

    def displacement_at(self, state, points):
        if state is None or state.depth == 0.0:
            return np.zeros(np.shape(points))
        d = np.hypot(*(np.asarray(points) - state.tip).T) / self.reach
        weight = np.where(d < 1, (1 - np.minimum(d, 1) ** 2) ** 2, 0.0)
        push = self.share * min(state.depth, 10.0)
        return weight[:, None] * push * np.asarray(state.axis)


def speckle():
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(123, 163))
    smooth = sum(np.roll(noise, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))[1:-1, 1:-1] / 3
    return np.clip(110 + 45 * smooth, 0, 255).astype(np.uint8)


EXERCISE = Exercise(
    name="straight-down",
    title="Straight down",
    goal="Push the tip into the ring.",
    target=Disc(centre=(20.0, 12.0), radius=3.0),
)
PAST = Exercise(
    name="past",
    title="Past the vessel",
    target=Disc(centre=(28.0, 18.0), radius=2.0),
    vessels=[Disc(centre=(20.0, 10.0), radius=2.0)],
    most_redirections=0,
)


def models(name):
    return {"soft": Bump(), "stiff": Bump(share=0.1)}[name]


def scene(**changes):
    options = {
        "title": "Speckle",
        "image": UltrasoundImage(speckle(), IMAGE_GRID),
        "grid": MESH,
        "models": models,
        "names": (("soft", "Soft"), ("stiff", "Stiff")),
        "entry": (20.0, 0.0),
        "angle": 90.0,
        "exercises": (EXERCISE, PAST),
    }
    return Scene(**(options | changes))


@contextmanager
def running(folder, *, settings=None, opener=None, over=None, patience=20, **changes):
    """Serve a scene on loopback in a thread; yields (address without slash, sessions, app).

    `over` stops it earlier than at the end of the context; it then ends within `patience` seconds.
    """
    settings = settings or Settings(port=0)
    sessions = Sessions(folder / "sessions.sqlite")
    app = build_app(scene(**changes), sessions, settings, opener)
    address, up, over = [], threading.Event(), over or threading.Event()

    def ready(where):
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
