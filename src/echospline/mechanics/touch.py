"""Which nodes touch the needle and how friction moves them, compiled; the plain reading is in `tps.py` and `interaction.py`.

A contact is a row of seven numbers (`COLUMNS`), the tip one of twelve with the last pose (`TIP`), a pose and its time fifteen
(`POSE`), the model's parameters ten (`SETTING`).
"""

from __future__ import annotations

from math import exp, inf, sqrt
from typing import Any

import numpy as np
from numba import njit

from echospline.mechanics.compiled import OPTIONS
from echospline.scene import ZERO_LENGTH

COLUMNS = ("source", "touching", "qx", "qy", "along", "grip x", "grip y")
TIP = ("present", "x", "y", "qx", "qy", "pushed", "posed", "entry x", "entry y", "tip x", "tip y", "reach")
POSE = (
    "entry x", "entry y", "tip x", "tip y", "axis x", "axis y", "depth", "speed", "travel", "dt",
    "landmark x", "landmark y", "may stand", "soft", "soft before",
)  # fmt: skip
SETTING = ("sigma", "delta", "alpha1", "alpha2", "alpha3", "length", "drag", "gap", "immediate", "on node")

PARALLEL = 1e-12
"""Sine of the angle below which a shaft runs along a line of nodes."""


@njit(**OPTIONS)
def needle(
    ex: float, ey: float, tx: float, ty: float, speed: float, dt: float, immediate: bool, before: Any, place: Any
) -> Any:  # fmt: skip
    """`POSE`, with the travel since the last one (``before``: `TIP`); ``place`` is its end, or empty in the plain case."""
    pose = np.empty(15)
    depth = sqrt((tx - ex) ** 2 + (ty - ey) ** 2)
    pose[0], pose[1], pose[2], pose[3] = ex, ey, tx, ty
    pose[4] = pose[5] = 0.0
    if depth >= ZERO_LENGTH:
        pose[4], pose[5] = (tx - ex) / depth, (ty - ey) / depth
    travel = depth
    if before[6] > 0.0:
        at_entry = sqrt((ex - before[7]) ** 2 + (ey - before[8]) ** 2)
        at_tip = sqrt((tx - before[9]) ** 2 + (ty - before[10]) ** 2)
        travel = max(at_entry, at_tip)
    pose[6], pose[7], pose[8], pose[9] = depth, speed, inf if immediate else travel, dt
    pose[10], pose[11], pose[12], pose[13], pose[14] = tx, ty, 1.0, 0.0, 0.0
    if place.shape[0] > 0:
        pose[10:15] = place
    return pose


@njit(**OPTIONS)
def distance(x: float, y: float, ux: float, uy: float, pose: Any, drag: float) -> Any:
    """Distance along the axis from the entry, and the square of d (13), of a point displaced by u."""
    ax, ay, depth = pose[4], pose[5], pose[6]
    inline = ux * ax + uy * ay
    ox = x + drag * (ux - inline * ax) - pose[0]
    oy = y + drag * (uy - inline * ay) - pose[1]
    along = ox * ax + oy * ay
    beyond = along - min(max(along, 0.0), depth)
    cx, cy = ox - along * ax, oy - along * ay
    return along, cx * cx + cy * cy + beyond * beyond


@njit(**OPTIONS)
def _first(px: Any, start: int, stop: int, x: float) -> Any:
    """First of the ascending px[start:stop] that is not below x."""
    while start < stop:
        middle = (start + stop) // 2
        if px[middle] < x:
            start = middle + 1
        else:
            stop = middle
    return start


@njit(**OPTIONS)
def touched(
    places: Any, lines: Any, at: Any, mesh: Any, pose: Any, setting: Any, reach: float, which: Any, alongs: Any
) -> Any:  # fmt: skip
    """How many sources touch the needle; fills ``which`` (ascending) and where on the axis they are.

    ``lines`` (j + 1, 2) are the lattice's rows: first source, y. Only sources whose rest position lies within delta and the
    largest displacement ``reach`` of the shaft are looked at.
    """
    delta, drag, gap = setting[1], setting[6], setting[7]
    ex, ey, ax, ay, depth = pose[0], pose[1], pose[4], pose[5], pose[6]
    count = 0
    if depth < ZERO_LENGTH:
        return count
    far = (delta + drag * reach) * (1.0 + 1e-9) + 1e-9
    px, py, slope, near2 = places[0], places[1], 1.0 / ay, delta * delta * (1.0 + 1e-9)
    for r in range(lines.shape[0] - 1):
        y, lo, hi = lines[r, 1], 0.0, depth
        if abs(ay) > PARALLEL:
            above, below = (y - far - ey) * slope, (y + far - ey) * slope
            lo, hi = max(0.0, min(above, below)), min(depth, max(above, below))
        elif abs(y - ey) > far:
            continue
        if lo > hi:
            continue
        left = ex + min(ax * lo, ax * hi) - far
        right = ex + max(ax * lo, ax * hi) + far
        stop = int(lines[r + 1, 0])
        i = _first(px, int(lines[r, 0]), stop, left)
        while i < stop and px[i] <= right:
            n = at[i]
            along, d2 = distance(px[i], py[i], mesh[n, 0], mesh[n, 1], pose, drag)
            # the root, for nodes at delta itself, as a lattice has them: its square would tell some of them apart by rounding
            if d2 <= near2 and sqrt(d2) <= delta and along <= depth - gap:
                which[count], alongs[count] = i, along
                count += 1
            i += 1
    return count


@njit(**OPTIONS)
def touch(
    places: Any, lines: Any, at: Any, mesh: Any, contacts: Any, pose: Any, setting: Any, reach: float, which: Any, alongs: Any
) -> Any:  # fmt: skip
    """Contacts after nodes have joined and left; ``which`` and ``alongs`` are room for one number per source."""
    drag, immediate, ax, ay, depth = setting[6], setting[8] > 0.0, pose[4], pose[5], pose[6]
    count, k = touched(places, lines, at, mesh, pose, setting, reach, which, alongs), contacts.shape[0]
    table = np.empty((count + k, 7))
    rows, i, j = 0, 0, 0
    while i < count or j < k:
        source = int(contacts[j, 0]) if j < k else places.shape[1]
        touching = i < count and which[i] <= source
        old = -1
        if not touching or which[i] == source:
            old = j
            j += 1
        along = 0.0
        if touching:
            source, along = which[i], alongs[i]
            i += 1
        elif immediate:
            continue
        elif depth >= ZERO_LENGTH:
            n = at[source]
            along = distance(places[0, source], places[1, source], mesh[n, 0], mesh[n, 1], pose, drag)[0]
        row, held = table[rows], old >= 0 and contacts[old, 1] > 0.0
        rows += 1
        row[0], row[1] = source, 1.0 if touching else 0.0
        if old >= 0:
            row[2], row[3] = contacts[old, 2], contacts[old, 3]
        else:
            row[2], row[3] = mesh[at[source], 0], mesh[at[source], 1]
        row[4] = contacts[old, 4] if held else min(max(along, 0.0), depth)
        if old >= 0 and (held or not touching):
            row[5], row[6] = contacts[old, 5], contacts[old, 6]
        else:
            # displacement across the axis less the shaft's position there, when it is first touched
            wx = row[2] - (pose[0] + row[4] * ax)
            wy = row[3] - (pose[1] + row[4] * ay)
            inline = row[2] * ax + row[3] * ay
            row[5] = drag * (wx - inline * ax)
            row[6] = drag * (wy - inline * ay)
    return table[:rows]


@njit(**OPTIONS)
def follow(x: float, y: float, tx: float, ty: float, travel: float) -> Any:
    """Move a displacement towards its target, by at most the travel."""
    gx, gy = tx - x, ty - y
    share = min(1.0, travel / max(sqrt(gx * gx + gy * gy), 1e-300))
    return x + gx * share, y + gy * share


@njit(**OPTIONS)
def load(places: Any, table: Any, pose: Any, setting: Any, q: Any) -> None:
    """New displacements q (k, 2) of the contacts that touch the needle, equations (14) to (16)."""
    alpha1, alpha2, length, drag = setting[2], setting[3], setting[5], setting[6]
    ax, ay, speed, travel = pose[4], pose[5], pose[7], pose[8]
    kept = exp(-setting[4] * pose[9])
    for j in range(table.shape[0]):
        qx, qy = table[j, 2], table[j, 3]
        q[j, 0], q[j, 1] = qx, qy
        if table[j, 1] == 0.0:
            continue
        i = int(table[j, 0])
        d = sqrt(distance(places[0, i], places[1, i], qx, qy, pose, drag)[1])
        f = (alpha1 + alpha2 / (1.0 + exp(min(d / length, 700.0)))) * speed
        along = qx * ax + qy * ay
        sign = 1.0 if f > 0 else (-1.0 if f < 0 else 0.0)
        loading = sign * (f - along) > 0 or (travel == inf and f != 0)
        relaxed = along if loading else f + (along - f) * kept
        rx, ry = qx + (relaxed - along) * ax, qy + (relaxed - along) * ay
        sx = table[j, 5] + drag * (pose[0] + table[j, 4] * ax)
        sy = table[j, 6] + drag * (pose[1] + table[j, 4] * ay)
        inline = sx * ax + sy * ay
        target = f if loading else relaxed
        q[j, 0], q[j, 1] = follow(
            rx, ry, target * ax + sx - inline * ax, target * ay + sy - inline * ay, travel
        )


@njit(**OPTIONS)
def clearance(x: float, y: float, walls: Any, posts: Any) -> Any:
    """Distance to what is clamped: ``walls`` are left, right, top, bottom, infinite where free."""
    least = min(x - walls[0], walls[1] - x, y - walls[2], walls[3] - y)
    for i in range(posts.shape[0]):
        dx, dy = x - posts[i, 0], y - posts[i, 1]
        least = min(least, sqrt(dx * dx + dy * dy))
    return max(0.0, least)
