"""Needle paths for tests: what a hand might do, drawn from a seed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from echospline.scene import NeedlePose


def wandering(seed: int, dt: float, duration: float, width: float = 40.0) -> Iterator[NeedlePose]:
    """Pushes, pulls, stops, tilts and turns back at random, from an entry on the top edge; one pose every dt s."""
    rng = np.random.default_rng(seed)
    entry = (float(rng.uniform(0.1, 0.9) * width), 0.0)
    depth, angle, speed, turn = 0.0, float(np.radians(rng.uniform(40, 140))), 5.0, 0.0
    for _ in range(round(duration / dt)):
        if rng.random() < 3 * dt:
            speed = float(rng.choice([-8, -3, 0, 3, 5, 8]))
        if rng.random() < 3 * dt:
            turn = float(rng.choice([0, 0, 0.3, -0.3]))
        depth = float(np.clip(depth + speed * dt, 0.0, 35.0))
        angle = float(np.clip(angle + turn * dt, 0.4, 2.7))
        tip = (entry[0] + depth * float(np.cos(angle)), entry[1] + depth * float(np.sin(angle)))
        yield NeedlePose(entry, tip, speed if 0 < depth < 35 else 0.0)
