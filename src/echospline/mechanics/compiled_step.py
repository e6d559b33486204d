"""One step of the needle's interaction, compiled: `tps.TPSModel.advance` in loops over the landmarks.

The plain NumPy reading is in `tps.py` and `interaction.py`; the names are the same. Nothing but `spread` reads more than
the landmarks.
"""

from __future__ import annotations

from math import exp, expm1, inf, sqrt
from typing import Any

import numpy as np
from numba import njit

from echospline.mechanics.compiled import OPTIONS
from echospline.mechanics.interaction import CALM, LET_GO
from echospline.mechanics.mesh_field import combine, contacts_field, leaving, spoken_for, spread
from echospline.mechanics.tip_column import conditioned, meet, patch_at
from echospline.mechanics.tip_patch import AHEAD, HALF_WIDTH, LASTS
from echospline.mechanics.touch import clearance, follow, load, needle, touch
from echospline.scene import ZERO_LENGTH

CONTACTS, BEYOND, RELEASED, DONE = 0, 1, 2, 3

SAME_PLACE = 1e-6
"""mm; a tip this close to a contact speaks for it."""

NONE, GIVEN, FOLLOWS, LEFT = 0, 1, 2, 3


@njit(**OPTIONS)
def tip_push(pose: Any, sigma: float, clear: float) -> Any:
    """How far the tip pushes, sigma of (12), mm; ``clear`` is the distance to what is clamped."""
    if sigma <= 0.0:
        return 0.0
    near = min(1.0, clear / (4.0 * sigma))
    return min(sigma, pose[6]) * near * near * (3.0 - 2.0 * near)


@njit(**OPTIONS)
def tip_kind(places: Any, table: Any, before: Any, pose: Any, setting: Any, clear: float) -> int:
    """Which landmark the tip has: none, one that is placed and given, one that follows the tip, one left behind."""
    advancing = pose[7] >= 0.0 and pose[6] >= ZERO_LENGTH
    if clear <= 0.0 or setting[0] <= 0.0:
        return NONE
    if setting[9] > 0.0 or setting[8] > 0.0:
        return GIVEN if advancing and pose[12] > 0.0 else NONE
    free = inf
    for j in range(table.shape[0]):
        if table[j, 1] == 0.0:
            i = int(table[j, 0])
            dx, dy = places[0, i] - pose[2], places[1, i] - pose[3]
            free = min(free, sqrt(dx * dx + dy * dy))
    bx, by = pose[2] - before[1], pose[3] - before[2]
    back = before[0] == 0.0 or before[5] > 0.0 or sqrt(bx * bx + by * by) <= max(pose[8], LET_GO)
    if not (advancing and free > setting[7] and back):
        return LEFT if before[0] > 0.0 else NONE
    return FOLLOWS if before[0] > 0.0 or pose[7] > 0.0 else NONE


@njit(**OPTIONS)
def spoken(places: Any, table: Any, tip: Any) -> Any:
    """The contact for which the tip's landmark speaks, or -1."""
    found = -1
    if tip[0] > 0.0:
        for j in range(table.shape[0]):
            i = int(table[j, 0])
            dx, dy = places[0, i] - tip[1], places[1, i] - tip[2]
            if dx * dx + dy * dy <= SAME_PLACE * SAME_PLACE:
                found = j
    return found


@njit(**OPTIONS)
def move(
    b: Any, places: Any, posts: Any, walls: Any, setting: Any, table: Any, before: Any, pose: Any
) -> Any:
    """New displacements of contacts (``q``) and tip; ``before`` is the old tip.

    Fills ``q`` and ``free``, the field without the contacts that have left, at those, mm; meets the tip's landmark and combines
    the contacts for `spread`.

    Returns
    -------
    tip : (12,)
    on_tip : int
        The contact for which the tip speaks, or -1.
    soft : float
        Softness of the tip's landmark.
    """
    c, k = int(b.form[0]), table.shape[0]
    q, free, tip = b.q[:k], b.free[:k], np.zeros(12)
    ax, ay, speed, travel = pose[4], pose[5], pose[7], pose[8]
    kept = exp(-setting[4] * pose[9])
    tip[6], tip[7:11] = 1.0, pose[0:4]
    load(places, table, pose, setting, q)
    clear = clearance(pose[2], pose[3], walls, posts)
    kind = tip_kind(places, table, before, pose, setting, clear)
    push = tip_push(pose, setting[0], clear)
    x, y, soft = pose[10], pose[11], pose[13]
    if kind == LEFT:
        x, y, soft = before[1], before[2], pose[14]
    if kind != NONE:
        px, py = conditioned(b, x, y)
        meet(b, px, py)
    if kind == GIVEN:
        tip[0], tip[1], tip[2], tip[5] = 1.0, x, y, 1.0
        tip[3], tip[4] = pose[2] + push * ax - x, pose[3] + push * ay - y
    elif kind == FOLLOWS:
        if before[0] > 0.0:
            wx, wy = before[3], before[4]
        else:
            combine(b, table, table[:, 2:4].copy())
            wx, wy = contacts_field(b.t, b.w, k * c, c)
        combine(b, table, q)
        fx, fy = contacts_field(b.t, b.w, k * c, c)
        inline, ahead = fx * ax + fy * ay, push
        if speed <= 0.0:  # (17): at rest the whole field relaxes, the tip's push with the contacts
            lost = (wx * ax + wy * ay) * (1.0 - kept)
            wx, wy = wx - lost * ax, wy - lost * ay
            ahead = min(wx * ax + wy * ay, push)
        tip[0], tip[1], tip[2], tip[5] = 1.0, x, y, 1.0
        tip[3], tip[4] = follow(wx, wy, ahead * ax + fx - inline * ax, ahead * ay + fy - inline * ay, travel)
    elif kind == LEFT:
        combine(b, table, q)
        fx, fy = contacts_field(b.t, b.w, k * c, c)
        gx, gy = before[3] - fx, before[4] - fy
        if sqrt(gx * gx + gy * gy) > LET_GO:
            tip[0], tip[1], tip[2], tip[5] = 1.0, x, y, 0.0
            tip[3], tip[4] = follow(fx + gx * kept, fy + gy * kept, fx, fy, travel)
    on_tip = spoken(places, table, tip)
    given = q if on_tip < 0 else spoken_for(q, tip, on_tip)
    left = 0
    for j in range(k):
        left += table[j, 1] == 0.0
    if left > 0:
        free[:, :] = 0.0
        leaving(b, table, given, on_tip, soft, tip, free)
        for j in range(k):
            if table[j, 1] == 0.0:
                fx, fy = free[j, 0], free[j, 1]
                gx, gy = table[j, 2] - fx, table[j, 3] - fy
                q[j, 0], q[j, 1] = follow(fx + gx * kept, fy + gy * kept, fx, fy, travel)
        given = q if on_tip < 0 else spoken_for(q, tip, on_tip)
    if left > 0 or on_tip >= 0 or kind < FOLLOWS:
        combine(b, table, given)
    return tip, on_tip, soft


@njit(**OPTIONS)
def allowed(table: Any, before: Any, pose: Any, setting: Any) -> Any:
    """How far a node may move in this step, mm; the table has the displacements before it."""
    longest2 = before[3] * before[3] + before[4] * before[4] if before[0] > 0.0 else 0.0
    for j in range(table.shape[0]):
        longest2 = max(longest2, table[j, 2] * table[j, 2] + table[j, 3] * table[j, 3])
    return CALM * (pose[8] + sqrt(longest2) * -expm1(-setting[4] * pose[9])) + LET_GO


@njit(**OPTIONS)
def released(table: Any, free: Any) -> Any:
    """Keep the contacts that touch the needle or are not yet at rest in the field without them; how many."""
    kept = 0
    for j in range(table.shape[0]):
        dx, dy = table[j, 2] - free[j, 0], table[j, 3] - free[j, 1]
        if table[j, 1] > 0.0 or dx * dx + dy * dy > LET_GO * LET_GO:
            if kept < j:
                table[kept] = table[j]
            kept += 1
    return kept


@njit(**OPTIONS)
def lacks_patch(b: Any, tip: Any, before: Any) -> Any:
    """Whether no patch is ready for where the tip's landmark will be soon, though one would pay."""
    if tip[0] == 0.0 or before[0] == 0.0:
        return False
    dx, dy = tip[1] - before[1], tip[2] - before[2]
    if max(abs(dx), abs(dy)) * LASTS > HALF_WIDTH:
        return False
    x, y = conditioned(b, tip[1] + AHEAD * dx, tip[2] + AHEAD * dy)
    return patch_at(b, x, y) < 0


@njit(**OPTIONS)
def step(
    b: Any, places: Any, lines: Any, posts: Any, walls: Any, setting: Any, contacts: Any, before: Any, was: Any, place: Any,
    ex: float, ey: float, tx: float, ty: float, speed: float, dt: float
) -> Any:  # fmt: skip
    """`touch`, `move` and `spread` in one call.

    Returns
    -------
    outcome : int
        `CONTACTS` have to be added or dropped first (the table says which); the field moves `BEYOND` the limit;
        contacts that have left can be `RELEASED` (the table is without them, the mesh not yet); or `DONE`.
    table, tip, mesh
        The new state.
    how : int
        As `spread` says.
    lacks : bool
        As `lacks_patch` says.
    """
    pose = needle(ex, ey, tx, ty, speed, dt, setting[8] > 0.0, before, place)
    table = touch(places, lines, b.at, was, contacts, pose, setting, before[11], b.touched, b.alongs)
    k = table.shape[0]
    same = k == b.count[0]
    for j in range(k):
        same = same and b.contact_of[int(table[j, 0])] >= 0
    if not same:
        return CONTACTS, table, before, was, 0, False
    tip, on_tip, soft = move(b, places, posts, walls, setting, table, before, pose)
    mesh, change, how, tip[11] = spread(b, k, tip, on_tip, soft, was)
    if change > allowed(table, before, pose, setting) ** 2:
        return BEYOND, table, before, was, how, False
    table[:, 2:4] = b.q[:k]
    kept = released(table, b.free)
    if kept < k:
        return RELEASED, table[:kept], tip, mesh, how, False
    return DONE, table, tip, mesh, how, lacks_patch(b, tip, before)
