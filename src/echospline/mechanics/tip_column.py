"""The column of G at the tip, which moves at every step: interpolated inside a patch (`tip_patch`), or evaluated.

Two patches, so that the next one is ready before the tip leaves the one that it is in.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import Any

import numpy as np
from numba import njit

from echospline.mechanics.compiled import CHUNK, OPTIONS, add_range, component, kernel, kernel_rows
from echospline.mechanics.contacts import contacts_and_nodes, keep, smooth_part, source_rows, times_M
from echospline.mechanics.row_sums import BLOCK, sum_block
from echospline.mechanics.tip_patch import AHEAD, DEGREE, HALF_WIDTH, NEAR, NODES, PARTS, SMALLEST

STALE = 5.0
"""How many times what is left of a tip contacts may carry of it before they are taken out of its patch's rows."""


@njit(**OPTIONS)
def conditioned(b: Any, x: float, y: float) -> Any:
    """A point in mm as the kernel takes it."""
    return (x - b.frame[0]) / b.frame[2], (y - b.frame[1]) / b.frame[2]


@njit(**OPTIONS)
def felt_at(b: Any, x: float, y: float, felt: Any) -> None:
    """[U_pB P_p] of a point, (c, m)."""
    form, anchors = b.form, b.anchors
    c, n, m = int(form[0]), anchors.shape[0], felt.shape[1]
    for i in range(n):
        xx, xy, yy = kernel(form, x - anchors[i, 0], y - anchors[i, 1])
        felt[0, i] = xx
        if c == 2:
            felt[0, n + i] = felt[1, i] = xy
            felt[1, n + i] = yy
    if c == 1:
        felt[0, m - 3], felt[0, m - 2], felt[0, m - 1] = 1.0, x, y
    else:
        felt[0, m - 3], felt[0, m - 2], felt[0, m - 1] = 1.0, 0.0, -y
        felt[1, m - 3], felt[1, m - 2], felt[1, m - 1] = 0.0, 1.0, x


@njit(**OPTIONS)
def held_of(L_inverse: Any, felt: Any, held: Any) -> None:
    """L_B^-1 of [U_pB P_p], (c, m)."""
    for a in range(felt.shape[0]):
        one = felt[a]
        for i in range(felt.shape[1]):
            line, value = L_inverse[i], 0.0
            for j in range(felt.shape[1]):
                value += one[j] * line[j]
            held[a, i] = value


@njit(**OPTIONS)
def patch_at(b: Any, x: float, y: float) -> Any:
    """The patch that is ready and holds a point, or -1."""
    for p in range(2):
        square = b.squares[p]
        ready = square[2] > 0.0 and b.built[p] == b.points.shape[1]
        if ready and abs(x - square[0]) <= square[2] and abs(y - square[1]) <= square[2]:
            return p
    return -1


@njit(**OPTIONS)
def shares_at(square: Any, x: float, y: float, coefficients: Any, T: Any, shares: Any) -> None:
    """Shares of the interpolation points in the value at (x, y); ``T`` is room for the polynomials."""
    X, Y = T[0], T[1]
    u, v = (x - square[0]) / square[2], (y - square[1]) / square[2]
    X[0] = Y[0] = 1.0
    X[1], Y[1] = u, v
    for i in range(2, DEGREE + 1):
        X[i] = 2.0 * u * X[i - 1] - X[i - 2]
        Y[i] = 2.0 * v * Y[i - 1] - Y[i - 2]
    shares[:] = 0.0
    at = 0
    for i in range(DEGREE + 1):
        for j in range(DEGREE + 1 - i):
            w, line = X[i] * Y[j], coefficients[at]
            for t in range(shares.shape[0]):
                shares[t] += w * line[t]
            at += 1


@njit(**OPTIONS)
def combine_nodes(b: Any, lines: Any, out: Any) -> None:
    """Value at the tip for each contact, from those at the nodes: every c-th of ``lines`` times a node's share."""
    for start in range(0, b.count[0] * int(b.form[0]), BLOCK):
        sum_block(lines, b.node_starts, b.shares, b.shares.shape[1], start, out[:, start:])


@njit(**OPTIONS)
def newton_of_node(b: Any, patch: int, i: int, newton: Any) -> None:
    """What the contacts carry of the column of a node, i = node c + component of the patch: newton (1, k c)."""
    form, between = b.form, b.nodes_contacts[patch]
    c, k = int(form[0]), b.count[0]
    x, y, a = b.nodes[patch, i // c, 0], b.nodes[patch, i // c, 1], i % c
    cross = np.empty((1, k * c))
    for j in range(k):
        s = b.source_of[j]
        xx, xy, yy = kernel(form, x - b.sources[s, 0], y - b.sources[s, 1])
        for e in range(c):
            cross[0, j * c + e] = between[i, j * c + e]
            if b.close[patch, j]:
                cross[0, j * c + e] += component(xx, xy, yy, a, e)
    times_M(b, cross, newton)


@njit(**OPTIONS)
def renew(b: Any, patch: int, first: int) -> None:
    """Take out of a patch's rows what the contacts from the scalar ``first`` on, that joined since, carry of them."""
    c, kc, N = int(b.form[0]), b.count[0] * int(b.form[0]), b.rows.shape[1]
    Qc, head = b.nodes.shape[1] * c, b.rows.shape[0] - b.MT.shape[0]
    newton, minus = np.empty((1, b.MT.shape[1])), np.empty((Qc, kc - first))
    for i in range(Qc):
        newton_of_node(b, patch, i, newton)
        minus[i] = b.nodes_newton[patch, i, first:kc] - newton[0, first:kc]
        b.nodes_newton[patch, i, first:kc] = newton[0, first:kc]
    rows = b.rows[patch * Qc : (patch + 1) * Qc]
    for start in range(0, N, CHUNK):
        stop = min(N, start + CHUNK)
        add_range(rows, start, minus, head + first, kc - first, b.rows, start, stop)
        b.single[patch * Qc : (patch + 1) * Qc, start:stop] = rows[:, start:stop]


@njit(**OPTIONS)
def meet_in_patch(b: Any, p: int, x: float, y: float) -> None:
    """G of a point inside a patch with the contacts (``cross``), and its own without U (``own``), from those of the nodes."""
    form, sources, cross, shares, G, own = b.form, b.sources, b.cross, b.shares[0], b.nodes_own[p], b.own
    c, Q = int(form[0]), shares.shape[0]
    shares_at(b.squares[p], x, y, b.coefficients, b.polynomials, shares)
    for a in range(c):
        combine_nodes(b, b.nodes_contacts[p, a:], cross[a:])
    for j in range(b.count[0]):
        if b.close[p, j] == 0:
            continue
        s = b.source_of[j]
        xx, xy, yy = kernel(form, x - sources[s, 0], y - sources[s, 1])
        cross[0, j * c] += xx
        if c == 2:
            cross[0, 2 * j + 1] += xy
            cross[1, 2 * j] += xy
            cross[1, 2 * j + 1] += yy
    own[:, :] = 0.0
    for i in range(Q):
        for a in range(c):
            line = G[i * c + a]
            for e in range(c):
                value = 0.0
                for q in range(Q):
                    value += shares[q] * line[q * c + e]
                own[a, e] += shares[i] * value


@njit(**OPTIONS)
def meet_anchors(b: Any, x: float, y: float) -> None:
    """The same for any point, from the anchors; also fills ``tip_felt`` and ``tip_held``."""
    form, sources, cross, felt, held, own = b.form, b.sources, b.cross, b.tip_felt, b.tip_held, b.own
    c = int(form[0])
    felt_at(b, x, y, felt)
    held_of(b.L_inverse, felt, held)
    for j in range(b.count[0]):
        s = b.source_of[j]
        xx, xy, yy = kernel(form, x - sources[s, 0], y - sources[s, 1])
        for a in range(c):
            for e in range(c):
                direct = component(xx, xy, yy, a, e)
                cross[a, j * c + e] = direct + smooth_part(b.felt, s * c + e, held, a)
    for a in range(c):
        for e in range(c):
            own[a, e] = smooth_part(felt, a, held, e)


@njit(**OPTIONS)
def settle(b: Any, p: int) -> None:
    """From what a point has to do with each landmark to what is left of it: ``t`` and ``met``."""
    own, t, met, kc = b.own, b.t, b.met, b.count[0] * int(b.form[0])
    c = own.shape[0]
    for a in range(c):
        times_M(b, b.cross[a:], t[a:])
    xx, _, _ = kernel(b.form, 0.0, 0.0)
    for a in range(c):
        own[a, a] += xx
        for e in range(c):
            for i in range(kc):
                own[a, e] -= t[a, i] * t[e, i]
    met[0], met[1] = p, own[0, 0]
    if c == 2:
        met[2], met[3] = 0.5 * (own[0, 1] + own[1, 0]), own[1, 1]


@njit(**OPTIONS)
def meet(b: Any, x: float, y: float) -> None:
    """What a point has to do with the landmarks, in double precision: fills ``met`` and ``t``, and ``shares`` where a patch
    holds it, otherwise ``tip_felt`` and ``tip_held``."""
    p = patch_at(b, x, y)
    if p >= 0:
        meet_in_patch(b, p, x, y)
    else:
        meet_anchors(b, x, y)
    settle(b, p)


@njit(**OPTIONS)
def meet_exactly(b: Any, x: float, y: float) -> None:
    """`meet` without a patch."""
    meet_anchors(b, x, y)
    settle(b, -1)


@njit(**OPTIONS)
def stale(b: Any, p: int) -> Any:
    """First of the contacts (flat) that joined since a patch was built and have to be taken out of its rows, or -1.

    The rows still hold what those contacts carry by now. Once that is most of them, what is left of the tip would be the
    difference of large numbers in single precision.
    """
    c, t, met = int(b.form[0]), b.t, b.met
    first, joined = b.count[0] * c, 0.0
    while first > 0 and b.nodes_newton[p, 0, first - 1] == 0.0:
        first -= 1
        for a in range(c):
            joined += t[a, first] * t[a, first]
    return first if joined > STALE * (met[1] + met[3]) else -1


@njit(**OPTIONS)
def tip_row(b: Any, x: float, y: float) -> None:
    """Evaluate the column at a point that `meet` has just met, less what the contacts explain, into its own rows."""
    c, n = int(b.form[0]), b.points.shape[1]
    own, kc = 2 * b.nodes.shape[1] * c, b.count[0] * c
    xy, width = np.empty((1, 2)), CHUNK // c
    xy[0, 0], xy[0, 1] = x, y
    minus_held, minus_t, out = -b.tip_held, -b.t[:, :kc], np.empty((c, c * width))
    for start in range(0, n, width):
        w = min(n, start + width) - start
        source_rows(b, xy, minus_held, minus_t, start, start + w, out)
        for a in range(c):
            for e in range(c):
                keep(b.rows, b.single, own + a, e * n + start, out[a, e * w : (e + 1) * w])


@njit(**OPTIONS)
def place_patch(b: Any, patch: int, x: float, y: float, ahead_x: float, ahead_y: float) -> Any:
    """Lay a patch around (x, y), with room ahead. -1 where anchors are too close for one, 0 where there is no room to list
    all points close to it, otherwise 1."""
    square, points, near, anchors = b.squares[patch], b.points, b.near[patch], b.anchors
    b.built[patch] = 0
    square[2], nearest2 = 0.0, inf
    for i in range(anchors.shape[0]):
        dx, dy = anchors[i, 0] - x, anchors[i, 1] - y
        nearest2 = min(nearest2, dx * dx + dy * dy)
    half = min(HALF_WIDTH / b.frame[2], sqrt(nearest2) / (NEAR + 1.0))
    if half * b.frame[2] < SMALLEST:
        return -1
    cx, cy, count = x + 0.7 * half * ahead_x, y + 0.7 * half * ahead_y, 0
    for i in range(points.shape[1]):
        dx, dy = points[0, i] - cx, points[1, i] - cy
        if dx * dx + dy * dy <= (NEAR * half) ** 2:
            if count == near.shape[0]:
                return 0
            near[count] = i
            b.near_points[patch, 0, count], b.near_points[patch, 1, count] = points[0, i], points[1, i]
            count += 1
    b.near_count[patch] = count
    square[0], square[1], square[2] = cx, cy, half
    for a in range(b.nodes.shape[1]):
        b.nodes[patch, a, 0] = cx + half * NODES[a, 0]
        b.nodes[patch, a, 1] = cy + half * NODES[a, 1]
    return 1


@njit(**OPTIONS)
def begin_patch(b: Any, patch: int) -> None:
    """What a patch that has been placed needs beside its rows.

    Without BLAS: its threads wait for each other, and beside a busy process that takes longer than many steps.
    """
    form, nodes, places, U = b.form, b.nodes[patch], b.near_points[patch], b.near_U[patch]
    c, Q, j = int(form[0]), b.nodes.shape[1], b.near_count[patch]
    felt, held = np.empty((Q * c, b.table.shape[0])), b.nodes_held[patch]
    for a in range(Q):
        one = slice(a * c, (a + 1) * c)
        felt_at(b, nodes[a, 0], nodes[a, 1], felt[one])
        held_of(b.L_inverse, felt[one], held[one])
    for i in range(Q * c):
        for a in range(Q * c):
            b.nodes_own[patch, i, a] = smooth_part(felt, i, held, a)
    contacts_and_nodes(b, patch, 0)
    newton, kc = np.empty((1, b.MT.shape[1])), b.count[0] * c
    b.nodes_newton[patch] = 0.0
    for i in range(Q * c):
        newton_of_node(b, patch, i, newton)
        b.nodes_newton[patch, i, :kc] = newton[0, :kc]
    for a in range(Q):
        for i in range(j):
            xx, xy, yy = kernel(form, places[0, i] - nodes[a, 0], places[1, i] - nodes[a, 1])
            U[a, i] = xx
            if c == 2:
                U[Q + a, i], U[2 * Q + a, i] = xy, yy


@njit(**OPTIONS)
def build_parts(b: Any, patch: int, parts: int) -> None:
    """The rows of a patch at the next points: all rows at once, so that what they are made of is read once."""
    c, n, kc = int(b.form[0]), b.points.shape[1], b.count[0] * int(b.form[0])
    begin, Qc, width = b.built[patch], b.nodes.shape[1] * int(b.form[0]), CHUNK // 4
    end = min(n, begin + parts * (-(-n // PARTS)))
    minus_held, minus_newton = -b.nodes_held[patch], -b.nodes_newton[patch, :, :kc]
    out = np.empty((Qc, c * width))
    for start in range(begin, end, width):
        w = min(end, start + width) - start
        source_rows(b, b.nodes[patch], minus_held, minus_newton, start, start + w, out)
        for i in range(Qc):
            for e in range(c):
                keep(b.rows, b.single, patch * Qc + i, e * n + start, out[i, e * w : (e + 1) * w])
    b.built[patch] = end


@njit(**OPTIONS)
def tend(b: Any, tip: Any, before: Any, parts: int) -> Any:
    """Go on with a patch for where a tip that was ``before`` (`touch.TIP`) a step ago will be soon: begin one, or build the
    next part of its rows (``parts`` while the tip has no patch).

    Returns
    -------
    begun, built : int
        Patches and points; -1 and 0 where there is no room to list the points close to a new one.
    """
    x, y = conditioned(b, tip[1], tip[2])
    dx, dy = (tip[1] - before[1]) / b.frame[2], (tip[2] - before[2]) / b.frame[2]
    ahead_x, ahead_y, n = x + AHEAD * dx, y + AHEAD * dy, b.points.shape[1]
    if patch_at(b, ahead_x, ahead_y) >= 0:
        return 0, 0
    serves, which = patch_at(b, x, y), -1
    for p in range(2):
        square = b.squares[p]
        inside = abs(ahead_x - square[0]) <= square[2] and abs(ahead_y - square[1]) <= square[2]
        if square[2] > 0.0 and b.built[p] < n and inside:
            which = p
    begun = 0
    if which < 0:
        length = max(sqrt(dx * dx + dy * dy), 1e-300)
        which = 1 if serves == 0 else 0
        placed = place_patch(b, which, ahead_x, ahead_y, dx / length, dy / length)
        if placed <= 0:
            return (-1 if placed == 0 else 0), 0
        begin_patch(b, which)
        begun = 1
        if serves >= 0:
            return begun, 0
    done = b.built[which]
    build_parts(b, which, 1 if serves >= 0 else parts)
    return begun, b.built[which] - done


@njit(**OPTIONS)
def add_near(b: Any, x: float, y: float, sx: float, sy: float, mesh: Any) -> None:
    """Add what interpolation leaves out of U at the points close to the patch, times (sx, sy)."""
    p, form, shares = int(b.met[0]), b.form, b.shares[0]
    Q, near, U, block = shares.shape[0], b.near[p], b.near_U[p], CHUNK // 2
    rough = b.rough
    for start in range(0, b.near_count[p], block):
        stop = min(b.near_count[p], start + block)
        w = stop - start
        kernel_rows(form, b.near_points[p], start, stop, x, y, rough, 0)
        if form[0] == 1.0:
            one = rough[0, :w]
            for a in range(Q):
                share, line = shares[a], U[a, start:stop]
                for i in range(w):
                    one[i] -= share * line[i]
            for i in range(w):
                m = near[start + i]
                mesh[m, 0] += one[i] * sx
                mesh[m, 1] += one[i] * sy
            continue
        # kernel_rows has left xx and xy in the first row, yx and yy in the second
        for a in range(Q):
            share = shares[a]
            xx, xy, yy = U[a, start:stop], U[Q + a, start:stop], U[2 * Q + a, start:stop]
            for i in range(w):
                rough[0, i] -= share * xx[i]
                rough[0, w + i] -= share * xy[i]
                rough[1, w + i] -= share * yy[i]
        for i in range(w):
            m = near[start + i]
            mesh[m, 0] += rough[0, i] * sx + rough[0, w + i] * sy
            mesh[m, 1] += rough[0, w + i] * sx + rough[1, w + i] * sy
