"""One step of the needle's interaction, compiled: `tps.TPSModel.advance` in loops over the landmarks.

The plain NumPy reading is in `tps.py` and `interaction.py`; the names here are the same. A contact is a row of seven
numbers (`COLUMNS`), the tip one of twelve with the last pose (`TIP`). Nothing here reads more than the landmarks; `spread` then reads the
response once and gives the mesh.
"""

from __future__ import annotations

from math import exp, expm1, inf, sqrt
from typing import Any

import numpy as np
from numba import njit

from echospline.mechanics.compiled import CHUNK, OPTIONS, add_range, kernel, kernel_rows
from echospline.mechanics.contacts import green, inverse
from echospline.mechanics.interaction import CALM, LET_GO
from echospline.needle import ZERO_LENGTH

COLUMNS = ("source", "touching", "qx", "qy", "along", "grip x", "grip y")
TIP = ("present", "x", "y", "qx", "qy", "pushed", "posed", "entry x", "entry y", "tip x", "tip y", "reach")

CONTACTS, NOT_YET, DONE = 0, 1, 2

SAME_PLACE = 1e-6
"""mm; a tip this close to a contact speaks for it."""


@njit(**OPTIONS)
def _distance(x: float, y: float, ux: float, uy: float, pose: Any, drag: float) -> Any:
    """Distance along the axis from the entry, and d (13), of a point displaced by u."""
    ax, ay, depth = pose[4], pose[5], pose[6]
    inline = ux * ax + uy * ay
    ox = x + drag * (ux - inline * ax) - pose[0]
    oy = y + drag * (uy - inline * ay) - pose[1]
    along = ox * ax + oy * ay
    beyond = along - min(max(along, 0.0), depth)
    cx, cy = ox - along * ax, oy - along * ay
    return along, sqrt(cx * cx + cy * cy + beyond * beyond)


@njit(**OPTIONS)
def touch(
    places: Any, nodes: Any, mesh: Any, contacts: Any, pose: Any, setting: Any, marks: Any, alongs: Any, reach: float
) -> Any:  # fmt: skip
    """Contacts after nodes have joined and left; ``marks`` and ``alongs`` are room for one number per source;
    ``reach`` is the largest displacement at the sources, mm.

    ``pose`` is (entry x, y, tip x, y, axis x, y, depth, speed, travel, dt); ``setting`` the model's parameters as
    `fused.py` lists them.
    """
    delta, drag, gap, immediate = setting[1], setting[6], setting[7], setting[8] > 0.0
    depth, ax, ay = pose[6], pose[4], pose[5]
    K, k = places.shape[1], contacts.shape[0]
    px, py = places[0], places[1]
    # -2: not touched, -1: touched; listed ones carry their place in the old table: -3 - j not touched, j touched
    lo, hi = K, 0
    if depth >= ZERO_LENGTH:
        # only nodes whose rest position lies within delta and the largest displacement of the shaft are looked at closely
        far = delta + drag * reach
        squares = alongs
        for i in range(K):
            ox, oy = px[i] - pose[0], py[i] - pose[1]
            along = ox * ax + oy * ay
            beyond = along - min(max(along, -reach), depth + reach)
            cross = ox * ay - oy * ax
            squares[i] = max(cross * cross, beyond * beyond)
        for i in range(K):
            if squares[i] <= far * far * (1.0 + 1e-9) + 1e-9:
                along, d = _distance(px[i], py[i], mesh[nodes[i], 0], mesh[nodes[i], 1], pose, drag)
                if d <= delta and along <= depth - gap:
                    if lo < K:
                        marks[hi:i] = -2
                    else:
                        lo = i
                    hi = i + 1
                    marks[i] = -1
                    alongs[i] = along
    for j in range(k):
        i = int(contacts[j, 0])
        if lo == K:
            lo, hi = i, i + 1
            marks[i] = -2
        if i < lo:
            marks[i:lo] = -2
            lo = i
        if i >= hi:
            marks[hi : i + 1] = -2
            hi = i + 1
        if marks[i] == -1:
            marks[i] = j
        else:
            marks[i] = -3 - j
            alongs[i] = _distance(px[i], py[i], mesh[nodes[i], 0], mesh[nodes[i], 1], pose, drag)[0]
            if depth < ZERO_LENGTH:
                alongs[i] = 0.0
    count = 0
    for i in range(lo, hi):
        count += marks[i] >= -1 or (marks[i] <= -3 and not immediate)
    table = np.empty((count, 7))
    at = 0
    for i in range(lo, hi):
        mark = marks[i]
        if not (mark >= -1 or (mark <= -3 and not immediate)):
            continue
        row = table[at]
        at += 1
        touching = mark >= -1
        old = mark if mark >= 0 else (-3 - mark if mark <= -3 else -1)
        held = old >= 0 and contacts[old, 1] > 0.0
        row[0], row[1] = i, 1.0 if touching else 0.0
        if old >= 0:
            row[2], row[3] = contacts[old, 2], contacts[old, 3]
        else:
            row[2], row[3] = mesh[nodes[i], 0], mesh[nodes[i], 1]
        row[4] = contacts[old, 4] if held else min(max(alongs[i], 0.0), depth)
        if old >= 0 and (held or not touching):
            row[5], row[6] = contacts[old, 5], contacts[old, 6]
        else:
            # displacement across the axis less the shaft's position there, when it is first touched
            wx = row[2] - (pose[0] + row[4] * ax)
            wy = row[3] - (pose[1] + row[4] * ay)
            inline = row[2] * ax + row[3] * ay
            row[5] = drag * (wx - inline * ax)
            row[6] = drag * (wy - inline * ay)
    return table


@njit(**OPTIONS)
def _follow(x: float, y: float, tx: float, ty: float, travel: float) -> Any:
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
        d = _distance(places[0, i], places[1, i], qx, qy, pose, drag)[1]
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
        q[j, 0], q[j, 1] = _follow(
            rx, ry, target * ax + sx - inline * ax, target * ay + sy - inline * ay, travel
        )


@njit(**OPTIONS)
def at_point(
    form: Any,
    x: float,
    y: float,
    anchors: Any,
    L_inverse: Any,
    sources: Any,
    felt: Any,
    slots: Any,
    k: int,
    P: Any,
) -> Any:
    """What a point has to do with the landmarks, in double precision.

    Returns
    -------
    felt_p, held_p : (c, m)
        [U_pB P_p] and L_B^-1 of it.
    cross, h : (c, k c)
        G_pC and G_pC P.
    own : (c, c)
        G_pp less what the contacts explain.
    """
    c, b, m = int(form[0]), anchors.shape[0], L_inverse.shape[0]
    felt_p, held_p = np.empty((c, m)), np.empty((c, m))
    for i in range(b):
        xx, xy, yy = kernel(form, x - anchors[i, 0], y - anchors[i, 1])
        felt_p[0, i] = xx
        if c == 2:
            felt_p[0, b + i] = felt_p[1, i] = xy
            felt_p[1, b + i] = yy
    if c == 1:
        felt_p[0, m - 3], felt_p[0, m - 2], felt_p[0, m - 1] = 1.0, x, y
    else:
        felt_p[0, m - 3], felt_p[0, m - 2], felt_p[0, m - 1] = 1.0, 0.0, -y
        felt_p[1, m - 3], felt_p[1, m - 2], felt_p[1, m - 1] = 0.0, 1.0, x
    for a in range(c):
        one = felt_p[a]
        for i in range(m):
            line, value = L_inverse[i], 0.0
            for j in range(m):
                value += one[j] * line[j]
            held_p[a, i] = value
    kc = k * c
    cross, h, own = np.empty((c, kc)), np.empty((c, kc)), np.empty((c, c))
    for j in range(k):
        s = slots[j]
        xx, xy, yy = kernel(form, x - sources[s, 0], y - sources[s, 1])
        for a in range(c):
            for e in range(c):
                f, g = felt[s * c + e], held_p[a]
                value = 0.0
                for t in range(m):
                    value += f[t] * g[t]
                cross[a, j * c + e] = (xx if a + e == 0 else (yy if a + e == 2 else xy)) - value
    for a in range(c):
        one = cross[a]
        for i in range(kc):
            line, value = P[i], 0.0  # P is symmetric
            for j in range(kc):
                value += one[j] * line[j]
            h[a, i] = value
    xx, xy, yy = kernel(form, 0.0, 0.0)
    for a in range(c):
        for e in range(c):
            value = xx if a == e else 0.0
            for t in range(m):
                value -= felt_p[a, t] * held_p[e, t]
            for j in range(kc):
                value -= h[a, j] * cross[e, j]
            own[a, e] = value
    return felt_p, held_p, cross, h, own


@njit(**OPTIONS)
def _value(h: Any, q: Any, slot_of: Any) -> Any:
    """Field at a point whose shares are h (c, k c) when the contacts (k, 2) of the table have displacements q."""
    x, y = 0.0, 0.0
    if h.shape[0] == 1:
        for j in range(q.shape[0]):
            w = h[0, slot_of[j]]
            x += w * q[j, 0]
            y += w * q[j, 1]
    else:
        for j in range(q.shape[0]):
            s = 2 * slot_of[j]
            x += h[0, s] * q[j, 0] + h[0, s + 1] * q[j, 1]
            y += h[1, s] * q[j, 0] + h[1, s + 1] * q[j, 1]
    return x, y


@njit(**OPTIONS)
def _solve(own: Any, soft: float, gx: float, gy: float) -> Any:
    """(own + soft)^-1 (gx, gy) for one or two components."""
    if own.shape[0] == 1:
        w = 1.0 / (own[0, 0] + soft)
        return gx * w, gy * w
    a, b, d = own[0, 0] + soft, 0.5 * (own[0, 1] + own[1, 0]), own[1, 1] + soft
    w = 1.0 / (a * d - b * b)
    return (d * gx - b * gy) * w, (a * gy - b * gx) * w


@njit(**OPTIONS)
def leaving(
    P: Any,
    c: int,
    table: Any,
    slot_of: Any,
    q: Any,
    on_tip: int,
    h: Any,
    own: Any,
    soft: float,
    tip: Any,
    free: Any,
) -> None:
    """Field at the contacts that have left, if they were no landmarks: ``free`` (k, 2), only their rows are set.

    With F the ones that have left and N the others, the field of N at F is -P_FF^-1 P_FN q_N; the tip adds its own.
    ``on_tip`` is the contact for which the tip speaks, or -1.
    """
    k = table.shape[0]
    count = 0
    for j in range(k):
        count += table[j, 1] == 0.0 and j != on_tip
    F = np.empty(count, dtype=np.int64)
    at = 0
    for j in range(k):
        if table[j, 1] == 0.0 and j != on_tip:
            F[at] = j
            at += 1
    fc, rhs = count * c, 2 // c
    A, B = np.empty((fc, fc)), np.zeros((fc, rhs))
    gone = np.zeros(k, dtype=np.bool_)
    gone[F] = True
    for i in range(count):
        si = slot_of[F[i]] * c
        for a in range(c):
            for j in range(count):
                sj = slot_of[F[j]] * c
                for e in range(c):
                    A[i * c + a, j * c + e] = P[si + a, sj + e]
            for j in range(k):
                if gone[j]:
                    continue
                sj = slot_of[j] * c
                if c == 1:
                    B[i, 0] -= P[si, sj] * q[j, 0]
                    B[i, 1] -= P[si, sj] * q[j, 1]
                else:
                    B[2 * i + a, 0] -= P[si + a, sj] * q[j, 0] + P[si + a, sj + 1] * q[j, 1]
    V = inverse(A)
    u = np.zeros((fc, rhs))
    for i in range(fc):
        for j in range(fc):
            for e in range(rhs):
                u[i, e] += V[i, j] * B[j, e]
    if tip[0] > 0.0 and on_tip < 0:
        hF, e_N = np.empty((c, fc)), np.zeros((fc, c))
        for a in range(c):
            for i in range(count):
                for e in range(c):
                    hF[a, i * c + e] = h[a, slot_of[F[i]] * c + e]
        for i in range(fc):
            for a in range(c):
                for j in range(fc):
                    e_N[i, a] += V[i, j] * hF[a, j]
        own_N = own.copy()
        for a in range(c):
            for e in range(c):
                for i in range(fc):
                    own_N[a, e] += hF[a, i] * e_N[i, e]
        given = q.copy()
        for i in range(count):
            if c == 1:
                given[F[i], 0], given[F[i], 1] = u[i, 0], u[i, 1]
            else:
                given[F[i], 0], given[F[i], 1] = u[2 * i, 0], u[2 * i + 1, 0]
        x, y = _value(h, given, slot_of)
        sx, sy = _solve(own_N, soft, tip[3] - x, tip[4] - y)
        for i in range(count):
            if c == 1:
                u[i, 0] += e_N[i, 0] * sx
                u[i, 1] += e_N[i, 0] * sy
            else:
                u[2 * i, 0] += e_N[2 * i, 0] * sx + e_N[2 * i, 1] * sy
                u[2 * i + 1, 0] += e_N[2 * i + 1, 0] * sx + e_N[2 * i + 1, 1] * sy
    for i in range(count):
        if c == 1:
            free[F[i], 0], free[F[i], 1] = u[i, 0], u[i, 1]
        else:
            free[F[i], 0], free[F[i], 1] = u[2 * i, 0], u[2 * i + 1, 0]
    if on_tip >= 0:
        free[on_tip, 0], free[on_tip, 1] = tip[3], tip[4]


@njit(**OPTIONS)
def _clearance(x: float, y: float, walls: Any, posts: Any) -> Any:
    """Distance to what is clamped: ``walls`` are left, right, top, bottom, infinite where free."""
    least = min(x - walls[0], walls[1] - x, y - walls[2], walls[3] - y)
    for i in range(posts.shape[0]):
        dx, dy = x - posts[i, 0], y - posts[i, 1]
        least = min(least, sqrt(dx * dx + dy * dy))
    return max(0.0, least)


@njit(**OPTIONS)
def move(
    table: Any, before: Any, places: Any, pose: Any, setting: Any, walls: Any, posts: Any, form: Any, frame: Any,
    anchors: Any, L_inverse: Any, sources: Any, felt: Any, slots: Any, slot_of: Any, P: Any
) -> Any:  # fmt: skip
    """New displacements of contacts and tip; ``before`` is the old tip, ``frame`` (centre x, y, scale).

    ``pose`` goes on with (place of the tip's landmark x, y, whether there is one, softness there, softness at the
    old tip's landmark).

    Returns
    -------
    q, tip, free : (k, 2), (12,), (k, 2)
        New displacements; the field without the contacts that have left, at those, mm.
    on_tip : int
        The contact for which the tip speaks, or -1.
    soft : float
        Softness of the tip's landmark.
    quantities
        `at_point` at the tip's landmark.
    """
    c, k = int(form[0]), table.shape[0]
    sigma, immediate, node = setting[0], setting[8] > 0.0, setting[9] > 0.0
    ax, ay, depth, speed, travel, dt = pose[4], pose[5], pose[6], pose[7], pose[8], pose[9]
    kept = exp(-setting[4] * dt)
    q, free, tip = np.empty((k, 2)), np.zeros((k, 2)), np.zeros(12)
    tip[6] = 1.0
    tip[7:11] = pose[0:4]
    load(places, table, pose, setting, q)
    clearance = _clearance(pose[2], pose[3], walls, posts)
    push = 0.0
    if sigma > 0.0:
        near = min(1.0, clearance / (4.0 * sigma))
        push = min(sigma, depth) * near * near * (3.0 - 2.0 * near)
    advancing = speed >= 0.0 and depth >= ZERO_LENGTH
    # which landmark: 0 none, 1 placed and given, 2 follows the tip, 3 left behind
    kind = 0
    if clearance > 0.0 and sigma > 0.0:
        if node or immediate:
            kind = 1 if advancing and pose[12] > 0.0 else 0
        else:
            clear = inf
            for j in range(k):
                if table[j, 1] == 0.0:
                    i = int(table[j, 0])
                    dx, dy = places[0, i] - pose[2], places[1, i] - pose[3]
                    clear = min(clear, sqrt(dx * dx + dy * dy))
            bx, by = pose[2] - before[1], pose[3] - before[2]
            back = before[0] == 0.0 or before[5] > 0.0 or sqrt(bx * bx + by * by) <= max(travel, LET_GO)
            if not (advancing and clear > setting[7] and back):
                kind = 3 if before[0] > 0.0 else 0
            elif before[0] > 0.0 or speed > 0.0:
                kind = 2
    x, y, soft = pose[10], pose[11], pose[13]
    if kind == 3:
        x, y, soft = before[1], before[2], pose[14]
    quantities = at_point(
        form, (x - frame[0]) / frame[2], (y - frame[1]) / frame[2], anchors, L_inverse, sources, felt, slots,
        k if kind > 0 else 0, P
    )  # fmt: skip
    h = quantities[3]
    if kind == 1:
        tip[0], tip[1], tip[2], tip[5] = 1.0, x, y, 1.0
        tip[3], tip[4] = pose[2] + push * ax - x, pose[3] + push * ay - y
    elif kind == 2:
        fx, fy = _value(h, q, slot_of)
        if before[0] > 0.0:
            wx, wy = before[3], before[4]
        else:
            wx, wy = _value(h, table[:, 2:4], slot_of)
        inline = fx * ax + fy * ay
        ahead = push
        if speed <= 0.0:  # (17): at rest the whole field relaxes, the tip's push with the contacts
            lost = (wx * ax + wy * ay) * (1.0 - kept)
            wx, wy = wx - lost * ax, wy - lost * ay
            ahead = min(wx * ax + wy * ay, push)
        tip[0], tip[1], tip[2], tip[5] = 1.0, x, y, 1.0
        tip[3], tip[4] = _follow(wx, wy, ahead * ax + fx - inline * ax, ahead * ay + fy - inline * ay, travel)
    elif kind == 3:
        fx, fy = _value(h, q, slot_of)
        gx, gy = before[3] - fx, before[4] - fy
        if sqrt(gx * gx + gy * gy) > LET_GO:
            tip[0], tip[1], tip[2], tip[5] = 1.0, x, y, 0.0
            tip[3], tip[4] = _follow(fx + gx * kept, fy + gy * kept, fx, fy, travel)
    on_tip, off = -1, 0
    for j in range(k):
        off += table[j, 1] == 0.0
        i = int(table[j, 0])
        dx, dy = places[0, i] - x, places[1, i] - y
        if tip[0] > 0.0 and sqrt(dx * dx + dy * dy) <= SAME_PLACE:
            on_tip = j
    if off > 0:
        given = q.copy()
        if on_tip >= 0:
            given[on_tip, 0], given[on_tip, 1] = tip[3], tip[4]
        leaving(P, c, table, slot_of, given, on_tip, h, quantities[4], soft, tip, free)
        for j in range(k):
            if table[j, 1] == 0.0:
                fx, fy = free[j, 0], free[j, 1]
                gx, gy = table[j, 2] - fx, table[j, 3] - fy
                q[j, 0], q[j, 1] = _follow(fx + gx * kept, fy + gy * kept, fx, fy, travel)
    return q, tip, free, on_tip, soft, quantities


@njit(**OPTIONS)
def begin_patch(
    form: Any, nodes: Any, centre: Any, reach: float, anchors: Any, L_inverse: Any, sources: Any, felt: Any, slots: Any,
    k: int, P: Any, points: Any, toq: Any
) -> Any:  # fmt: skip
    """What a patch with interpolation points ``nodes`` (Q, 2) needs; fills ``toq`` (G of contacts and nodes).

    Without BLAS: its threads wait for each other, and beside a busy process that takes longer than many steps.

    Returns
    -------
    held : (Q c, m)
        L_B^-1 [U_qB P_q] of the nodes.
    near : (j,)
        Points within ``reach`` of the centre.
    rough : (j, Q) or (j, 3 Q)
        U of those and the nodes; xx, xy and yy with two components.
    """
    c, Q, n = int(form[0]), nodes.shape[0], points.shape[1]
    held = np.empty((Q * c, L_inverse.shape[0]))
    for a in range(Q):
        quantities = at_point(form, nodes[a, 0], nodes[a, 1], anchors, L_inverse, sources, felt, slots, 0, P)
        for e in range(c):
            held[a * c + e] = quantities[1][e]
    for j in range(k):
        for a in range(Q):
            green(form, sources, felt, slots[j], nodes, held, a, toq, j * c, a * c)
    near, count = np.empty(n, dtype=np.int64), 0
    for i in range(n):
        dx, dy = points[0, i] - centre[0], points[1, i] - centre[1]
        if dx * dx + dy * dy <= reach * reach:
            near[count] = i
            count += 1
    rough = np.empty((count, Q * (2 * c - 1)))
    for i in range(count):
        for a in range(Q):
            xx, xy, yy = kernel(form, points[0, near[i]] - nodes[a, 0], points[1, near[i]] - nodes[a, 1])
            rough[i, a] = xx
            if c == 2:
                rough[i, Q + a], rough[i, 2 * Q + a] = xy, yy
    return held, near[:count].copy(), rough


@njit(**OPTIONS)
def tip_row(
    form: Any,
    points: Any,
    A: Any,
    x: float,
    y: float,
    held_p: Any,
    cross: Any,
    rows: Any,
    single: Any,
    head: int,
    k: int,
) -> None:
    """Evaluate the tip's row directly, into the c rows before ``head``."""
    c, n = int(form[0]), points.shape[1]
    minus_held, minus_cross = -held_p, -cross
    width = CHUNK // c
    E = np.empty((c, c * width))
    for start in range(0, n, width):
        stop = min(n, start + width)
        w = stop - start
        kernel_rows(form, points, start, stop, x, y, E, 0)
        for b in range(c):
            add_range(E, b * w, minus_held, 0, A.shape[0], A, b * n + start, b * n + stop)
            add_range(E, b * w, minus_cross, head, k * c, rows, b * n + start, b * n + stop)
        for a in range(c):
            for b in range(c):
                source = E[a, b * w : (b + 1) * w]
                target = rows[head - c + a, b * n + start : b * n + stop]
                copy = single[head - c + a, b * n + start : b * n + stop]
                for t in range(w):
                    target[t] = source[t]
                    copy[t] = source[t]


@njit(**OPTIONS)
def patch_shares(x: float, y: float, square: Any, coefficients: Any, degree: int) -> Any:
    """Shares of the interpolation points in the value at (x, y); ``square`` is (centre x, y, half side)."""
    Q = coefficients.shape[0]
    X, Y = np.empty(degree + 1), np.empty(degree + 1)
    u, v = (x - square[0]) / square[2], (y - square[1]) / square[2]
    X[0] = Y[0] = 1.0
    X[1], Y[1] = u, v
    for i in range(2, degree + 1):
        X[i] = 2.0 * u * X[i - 1] - X[i - 2]
        Y[i] = 2.0 * v * Y[i - 1] - Y[i - 2]
    shares = np.zeros(Q)
    at = 0
    for i in range(degree + 1):
        for j in range(degree + 1 - i):
            w, line = X[i] * Y[j], coefficients[at]
            for t in range(Q):
                shares[t] += w * line[t]
            at += 1
    return shares


@njit(**OPTIONS)
def spread(
    form: Any, frame: Any, points: Any, A: Any, rows: Any, single: Any, product: Any, head: int, slot_of: Any, q: Any,
    tip: Any, on_tip: int, soft: float, quantities: Any, square: Any, coefficients: Any, degree: int, toq: Any, near: Any,
    rough: Any, nodes: Any, was: Any
) -> Any:  # fmt: skip
    """Field of contacts q (k, 2) and tip on the whole mesh.

    ``product`` is ``rows`` or ``single``: what is multiplied. A tip inside the patch ``square`` (half side > 0) is
    interpolated there; another one has its row evaluated.

    Returns
    -------
    mesh : (n, 2)
        mm.
    change : float
        Square of the largest change since ``was`` at the nodes that may become contacts, mm^2.
    how : int
        0 no landmark of the tip, 1 interpolated, 2 evaluated directly.
    reach : float
        Largest displacement at those nodes, mm.
    """
    c, n, k = int(form[0]), points.shape[1], q.shape[0]
    rhs, Qc, kc = 2 // c, head - c, k * c
    own_q = q
    if on_tip >= 0:
        own_q = q.copy()
        own_q[on_tip, 0], own_q[on_tip, 1] = tip[3], tip[4]
    weights = np.zeros((rhs, head + kc), dtype=product.dtype)
    how, sx, sy, px, py = 0, 0.0, 0.0, 0.0, 0.0
    W = np.empty((kc, rhs))
    for j in range(k):
        s = slot_of[j] * c
        if c == 1:
            W[s, 0], W[s, 1] = own_q[j, 0], own_q[j, 1]
        else:
            W[s, 0], W[s + 1, 0] = own_q[j, 0], own_q[j, 1]
    shares = coefficients[0]
    if tip[0] > 0.0 and on_tip < 0:
        px, py = (tip[1] - frame[0]) / frame[2], (tip[2] - frame[1]) / frame[2]
        held_p, cross, h, own = quantities[1], quantities[2], quantities[3], quantities[4]
        gx, gy = _value(h, own_q, slot_of)
        sx, sy = _solve(own, soft, tip[3] - gx, tip[4] - gy)
        if square[2] > 0.0 and abs(px - square[0]) <= square[2] and abs(py - square[1]) <= square[2]:
            how = 1
            shares = patch_shares(px, py, square, coefficients, degree)
            Q = shares.shape[0]
            for a in range(Q):
                if c == 1:
                    weights[0, a], weights[1, a] = shares[a] * sx, shares[a] * sy
                else:
                    weights[0, 2 * a], weights[0, 2 * a + 1] = shares[a] * sx, shares[a] * sy
            for s in range(kc):
                # what the contacts explain of the tip itself less what they explain of its interpolant
                r0, r1, line = cross[0, s], 0.0, toq[s]
                if c == 1:
                    for a in range(Q):
                        r0 -= line[a] * shares[a]
                    W[s, 0] -= r0 * sx
                    W[s, 1] -= r0 * sy
                else:
                    r1 = cross[1, s]
                    for a in range(Q):
                        r0 -= line[2 * a] * shares[a]
                        r1 -= line[2 * a + 1] * shares[a]
                    W[s, 0] -= r0 * sx + r1 * sy
        else:
            how = 2
            tip_row(form, points, A, px, py, held_p, cross, rows, single, head, k)
            if c == 1:
                weights[0, Qc], weights[1, Qc] = sx, sy
            else:
                weights[0, Qc], weights[0, Qc + 1] = sx, sy
    for s in range(kc):
        for e in range(rhs):
            weights[e, head + s] = W[s, e]
    # rows in use: all of the patch and not the direct one, or the direct one and not the patch, or contacts alone
    first = Qc if how == 2 else head
    rest = weights[:, first : head + kc].copy()
    mesh = np.empty((n, 2))
    flat = mesh.reshape(2 * n)
    out = np.empty((rhs, CHUNK), dtype=product.dtype)
    for e in range(c):
        for begin in range(0, n, CHUNK):
            w = min(n, begin + CHUNK) - begin
            out[:, :] = 0.0
            start = e * n + begin
            if how == 1:
                add_range(out, 0, weights, 0, Qc, product, start, start + w)
            add_range(out, 0, rest, first, head + kc - first, product, start, start + w)
            if c == 1:
                x, y, block = out[0], out[1], flat[2 * begin : 2 * (begin + w)]
                for i in range(w):
                    block[2 * i] = x[i]
                    block[2 * i + 1] = y[i]
            else:
                for i in range(w):
                    mesh[begin + i, e] = out[0, i]
    if how == 1:
        Q = shares.shape[0]
        for i in range(near.shape[0]):
            p = near[i]
            xx, xy, yy = kernel(form, points[0, p] - px, points[1, p] - py)
            line = rough[i]
            if c == 1:
                for a in range(Q):
                    xx -= line[a] * shares[a]
                mesh[p, 0] += xx * sx
                mesh[p, 1] += xx * sy
            else:
                for a in range(Q):
                    xx -= line[a] * shares[a]
                    xy -= line[Q + a] * shares[a]
                    yy -= line[2 * Q + a] * shares[a]
                mesh[p, 0] += xx * sx + xy * sy
                mesh[p, 1] += xy * sx + yy * sy
    change, reach = 0.0, 0.0
    for i in range(nodes.shape[0]):
        p = nodes[i]
        x, y = mesh[p, 0], mesh[p, 1]
        dx, dy = x - was[p, 0], y - was[p, 1]
        change = max(change, dx * dx + dy * dy)
        reach = max(reach, x * x + y * y)
    return mesh, change, how, sqrt(reach)


@njit(**OPTIONS)
def value_before(
    form: Any,
    h: Any,
    felt: Any,
    x: float,
    y: float,
    before: Any,
    bx: float,
    by: float,
    soft: float,
    q: Any,
    slot_of: Any,
    old: Any,
) -> Any:
    """The old field at (x, y), conditioned: contacts q, and the old tip at (bx, by) with `at_point` quantities ``old``."""
    vx, vy = _value(h, q, slot_of)
    if before[0] == 0.0:
        return vx, vy
    held, cross, own = old[1], old[2], old[4]
    gx, gy = _value(old[3], q, slot_of)
    sx, sy = _solve(own, soft, before[3] - gx, before[4] - gy)
    c = h.shape[0]
    e = np.empty((c, c))
    xx, xy, yy = kernel(form, x - bx, y - by)
    for a in range(c):
        for b in range(c):
            value = xx if a + b == 0 else (yy if a + b == 2 else xy)
            for t in range(held.shape[1]):
                value -= felt[a, t] * held[b, t]
            for j in range(h.shape[1]):
                value -= h[a, j] * cross[b, j]
            e[a, b] = value
    if c == 1:
        return vx + e[0, 0] * sx, vy + e[0, 0] * sy
    return vx + e[0, 0] * sx + e[0, 1] * sy, vy + e[1, 0] * sx + e[1, 1] * sy


@njit(**OPTIONS)
def needle(
    ex: float,
    ey: float,
    tx: float,
    ty: float,
    speed: float,
    dt: float,
    immediate: bool,
    before: Any,
    place: Any,
) -> Any:
    """The pose as the loops take it, with the travel since the last one (``before``: `TIP` and the last pose)."""
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
def slots_of(table: Any, slot_of_source: Any) -> Any:
    """Slot of each contact of a table, -1 for one that the response does not have."""
    slots = np.empty(table.shape[0], dtype=np.int64)
    for j in range(table.shape[0]):
        slots[j] = slot_of_source[int(table[j, 0])]
    return slots


@njit(**OPTIONS)
def allowed(table: Any, before: Any, q: Any, free: Any, pose: Any, setting: Any) -> Any:
    """How far a node may move in this step (mm), and whether a contact that has left can go."""
    longest = sqrt(before[3] * before[3] + before[4] * before[4]) if before[0] > 0.0 else 0.0
    drops = False
    for j in range(table.shape[0]):
        longest = max(longest, sqrt(table[j, 2] * table[j, 2] + table[j, 3] * table[j, 3]))
        if table[j, 1] == 0.0:
            dx, dy = q[j, 0] - free[j, 0], q[j, 1] - free[j, 1]
            drops = drops or sqrt(dx * dx + dy * dy) <= LET_GO
    return CALM * (pose[8] + longest * -expm1(-setting[4] * pose[9])) + LET_GO, drops


@njit(**OPTIONS)
def step(
    ex: float, ey: float, tx: float, ty: float, speed: float, dt: float, place: Any, places: Any, nodes: Any, was: Any,
    contacts: Any, before: Any, setting: Any, walls: Any, posts: Any, form: Any, frame: Any, anchors: Any, L_inverse: Any,
    sources: Any, felt: Any, slots: Any, slot_of_source: Any, count: int, P: Any, points: Any, A: Any, rows: Any, single: Any,
    product: Any, head: int, square: Any, coefficients: Any, degree: int, toq: Any, near: Any, rough: Any, marks: Any,
    alongs: Any
) -> Any:  # fmt: skip
    """`touch`, `move` and `spread` in one call.

    Returns
    -------
    outcome : int
        `CONTACTS` have to be added or dropped first (the table says which), or `DONE`, or `NOT_YET`: the field moves
        beyond the limit, or a contact can go.
    table, tip, mesh
        The new state.
    how : int
        As `spread` says.
    """
    pose = needle(ex, ey, tx, ty, speed, dt, setting[8] > 0.0, before, place)
    table = touch(places, nodes, was, contacts, pose, setting, marks, alongs, before[11])
    k = table.shape[0]
    slot_of = slots_of(table, slot_of_source)
    same = k == count
    for j in range(k):
        same = same and slot_of[j] >= 0
    if not same:
        return CONTACTS, table, before, was, 0
    q, tip, free, on_tip, soft, quantities = move(
        table,
        before,
        places,
        pose,
        setting,
        walls,
        posts,
        form,
        frame,
        anchors,
        L_inverse,
        sources,
        felt,
        slots,
        slot_of,
        P,
    )
    mesh, change, how, tip[11] = spread(
        form, frame, points, A, rows, single, product, head, slot_of, q, tip, on_tip, soft, quantities, square,
        coefficients, degree, toq, near, rough, nodes, was
    )  # fmt: skip
    limit, drops = allowed(table, before, q, free, pose, setting)
    if change > limit * limit or drops:
        return NOT_YET, table, before, was, how
    table[:, 2:4] = q
    return DONE, table, tip, mesh, how
