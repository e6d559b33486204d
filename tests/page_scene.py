"""Scenes of pages for tests: a small one that is quick to factor, with two models, stiff places and clamped points."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np

from echospline.page import Exercise, Pack, packed
from echospline.page.pack import table
from echospline.scenario import Scenario
from echospline.scene import Insertion, RegularGrid, UltrasoundImage

ROOT = Path(__file__).resolve().parent.parent
EXERCISE = Exercise.model_validate(
    {
        "name": "between",
        "title": "Between <two> vessels",
        "goal": "Reach the target.",
        "target": {"centre": (15.0, 11.0), "radius": 1.5},
        "vessels": [{"centre": (11.0, 4.0), "radius": 2.0}, {"centre": (24.0, 16.0), "radius": 2.0}],
        "most_redirections": 1,
    }
)


def scenario(**more: Any) -> Scenario:
    """Scenario of a small picture with a stiff layer, a clamped point and one exercise."""
    values = {
        "title": 'Small </script><img src=x onerror="alert(1)">',
        "mesh.nodes": (16, 12),
        "mesh.clamped_points": [(28.0, 10.0)],
        "tissue.region": [{"name": "deep", "layer": (14.0, 20.0), "young": 60.0}],
        "needle.entry": (8.0, 0.0),
        "exercise": [EXERCISE.model_dump()],
        "model.kind": "tps",
    }
    return Scenario().with_values({**values, **more}, "test")


def image() -> UltrasoundImage:
    """Speckle of 32 x 20 mm."""
    pixels = np.random.default_rng(5).integers(0, 200, (80, 128), dtype=np.uint8)
    return UltrasoundImage(pixels, RegularGrid((128, 80), (0.25, 0.25)), "speckle")


def small(**more: Any) -> Pack:
    """Pack of the small scene."""
    return packed(scenario(**more), image(), Path())


def poses(seconds: float = 3.0, rate: float = 120.0) -> np.ndarray:
    """Rows of a session that the needle's limits allow: in, a turn inside the tissue, a rest, a little back."""
    times = np.array([0.0, 0.3, 1.4, 1.8, 2.4, seconds])
    entry = np.array([[8.0, 0.0], [8.0, 0.0], [8.0, 0.0], [8.3, 0.0], [8.3, 0.0], [8.3, 0.0]])
    tip = np.array([[8.0, 0.0], [8.0, 0.0], [14.0, 9.0], [16.0, 10.0], [16.0, 10.0], [15.2, 9.2]])
    path = Insertion(times, entry, tip)
    rows = []
    before = path.pose(0.0)
    for k in range(1, round(seconds * rate) + 1):
        now = path.pose(k / rate)
        shaft, last = np.subtract(now.tip, now.entry), np.subtract(before.tip, before.entry)
        length = float(np.hypot(*shaft))
        axis = shaft / length if length > 1e-9 else np.zeros(2)
        rows.append((*now.entry, *now.tip, float((shaft - last) @ axis) * rate))
        before = now
    return np.array(rows)


def session(pack: Pack, rows: np.ndarray, model: str = "tps", **more: Any) -> dict[str, Any]:
    """Session as a page exports it, with no score."""
    plain = {
        "format": 1, "kind": "echospline session", "version": "0.1.0", "core": "0" * 64,
        "scene": {"title": pack.manifest.title, "pack": pack.digest}, "model": model,
        "exercise": pack.manifest.exercises[0].model_dump(mode="json"), "examination": True, "trainee": "Ann", "attempt": 2,
        "started": "2026-03-01T10:20:30.123Z", "rate": pack.manifest.rate, "ended": "finished", "steps": len(rows),
        "poses": base64.b64encode(rows.astype("<f8").tobytes()).decode(), "planes": None, "events": [[36, "entered"]],
        "score": None,
    }  # fmt: skip
    return {**plain, **more}


def uncoded(pack: Pack) -> Pack:
    """The same scene, all of whose arrays are written plainly."""
    arrays = dict(pack.arrays)
    return Pack(pack.manifest.model_copy(update={"arrays": table(arrays)}), arrays)
