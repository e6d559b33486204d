"""From the displacements of contacts and tip to that of the mesh: one product, compiled."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numba import njit

from echospline.mechanics.compiled import OPTIONS, bits, component, kernel, number
from echospline.mechanics.contacts import cholesky, cholesky_solve, smooth_part, times_M
from echospline.mechanics.row_sums import BLOCK, sum_block, sum_block_twice
from echospline.mechanics.tip_column import (
    add_near,
    combine_nodes,
    conditioned,
    meet,
    meet_exactly,
    renew,
    stale,
    tip_row,
)

SIGN = 0x7FFFFFFFFFFFFFFF
"""All bits of a double but its sign: as integers, the numbers that they leave have the order of their sizes, and the
largest is found eight at a time; NaN is above all."""


@njit(**OPTIONS)
def combine(b: Any, table: Any, q: Any) -> None:
    """w = M d for the displacements q (k, 2) of the contacts in a table, that are all there."""
    c, d, contact_of = int(b.form[0]), b.d, b.contact_of
    for j in range(q.shape[0]):
        i, x, y = contact_of[int(table[j, 0])], q[j, 0], q[j, 1]
        if c == 1:
            d[0, i], d[1, i] = x, y
        else:
            d[0, 2 * i], d[0, 2 * i + 1] = x, y
    if c == 2:
        times_M(b, d, b.w)
        return
    kc = b.count[0]
    for start in range(0, kc, BLOCK):
        sum_block_twice(b.MT, b.starts, d, min(kc, start + BLOCK), start, b.w[:, start:])


@njit(**OPTIONS)
def interpolate(b: Any, patch: int, sx: float, sy: float, kc: int) -> None:
    """Weights of a patch's rows, after those of the contacts, for a tip of weight (sx, sy); the contacts explain the tip
    itself less what they explain of its interpolant."""
    weights, t, shares, explained = b.weights, b.t, b.shares[0], b.cross
    c, Q = int(b.form[0]), shares.shape[0]
    for e in range(c):
        combine_nodes(b, b.nodes_newton[patch, e:], explained[e:])
        part, interpolant = t[e], explained[e]
        if c == 1:
            for i in range(kc):
                rest = part[i] - interpolant[i]
                weights[0, i] -= rest * sx
                weights[1, i] -= rest * sy
            for a in range(Q):
                weights[0, kc + a], weights[1, kc + a] = shares[a] * sx, shares[a] * sy
        else:
            s = sx if e == 0 else sy
            for i in range(kc):
                weights[0, i] -= (part[i] - interpolant[i]) * s
            for a in range(Q):
                weights[0, kc + 2 * a + e] = shares[a] * s


@njit(**OPTIONS)
def contacts_field(t: Any, w: Any, kc: int, c: int) -> Any:
    """Field of the contacts alone, E (M d), at the point whose basis is t."""
    x, y = 0.0, 0.0
    if c == 1:
        for i in range(kc):
            x += t[0, i] * w[0, i]
            y += t[0, i] * w[1, i]
    else:
        for i in range(kc):
            x += t[0, i] * w[0, i]
            y += t[1, i] * w[0, i]
    return x, y


@njit(**OPTIONS)
def tip_weights(own: Any, soft: float, gx: float, gy: float, c: int) -> Any:
    """(own + soft)^-1 (gx, gy), ``own`` being (xx, xy, yy)."""
    if c == 1:
        w = 1.0 / (own[0] + soft)
        return gx * w, gy * w
    a, m, d = own[0] + soft, own[1], own[2] + soft
    w = 1.0 / (a * d - m * m)
    return (d * gx - m * gy) * w, (a * gy - m * gx) * w


@njit(**OPTIONS)
def leaving(b: Any, table: Any, q: Any, on_tip: int, soft: float, tip: Any, free: Any) -> None:
    """Field at the contacts that have left, if they were no landmarks: ``free`` (k, 2), only their rows are set.

    With F the ones that have left, N the others and P = M' M, the field of N at F is -P_FF^-1 P_FN q_N; the tip adds its
    own. ``on_tip`` is the contact for which the tip speaks, or -1. `meet` has met the tip's landmark.
    """
    MT, contact_of = b.MT, b.contact_of
    c, k, rhs = int(b.form[0]), table.shape[0], 2 // int(b.form[0])
    kc, count = k * c, 0
    F, given = np.empty(k, dtype=np.int64), q.copy()
    for j in range(k):
        if table[j, 1] == 0.0 and j != on_tip:
            F[count] = j
            given[j, 0] = given[j, 1] = 0.0
            count += 1
    combine(b, table, given)
    fc, w, t = count * c, b.w, b.t
    rows, A, u = np.empty((fc, kc)), np.empty((fc, fc)), np.zeros((fc, rhs + c))
    for x in range(fc):
        i = contact_of[int(table[F[x // c], 0])] * c + x % c
        rows[x] = MT[i, :kc]
        one = rows[x]
        for z in range(x + 1):
            other, value = rows[z], 0.0
            for y in range(kc):
                value += one[y] * other[y]
            A[x, z] = value
        for y in range(i, kc):
            for e in range(rhs):
                u[x, e] -= one[y] * w[e, y]
            for a in range(c):
                u[x, rhs + a] += one[y] * t[a, y]
    given_t = u[:, rhs:].copy()
    cholesky(A)
    cholesky_solve(A, u)
    if tip[0] > 0.0 and on_tip < 0:
        own = b.met[1:4].copy()
        x, y = contacts_field(t, w, kc, c)
        for i in range(fc):
            own[0] += given_t[i, 0] * u[i, rhs]
            if c == 1:
                x += given_t[i, 0] * u[i, 0]
                y += given_t[i, 0] * u[i, 1]
            else:
                own[1] += 0.5 * (given_t[i, 0] * u[i, 2] + given_t[i, 1] * u[i, 1])
                own[2] += given_t[i, 1] * u[i, 2]
                x += given_t[i, 0] * u[i, 0]
                y += given_t[i, 1] * u[i, 0]
        sx, sy = tip_weights(own, soft, tip[3] - x, tip[4] - y, c)
        for i in range(fc):
            if c == 1:
                u[i, 0] += u[i, 1 + c] * sx
                u[i, 1] += u[i, 1 + c] * sy
            else:
                u[i, 0] += u[i, 1] * sx + u[i, 2] * sy
    for i in range(count):
        if c == 1:
            free[F[i], 0], free[F[i], 1] = u[i, 0], u[i, 1]
        else:
            free[F[i], 0], free[F[i], 1] = u[2 * i, 0], u[2 * i + 1, 0]
    if on_tip >= 0:
        free[on_tip, 0], free[on_tip, 1] = tip[3], tip[4]


@njit(**OPTIONS)
def spread(b: Any, k: int, tip: Any, on_tip: int, soft: float, was: Any) -> Any:
    """Field of k contacts and tip on the whole mesh. `meet` has met the tip's landmark, and `combine` the contacts.

    A tip inside a patch is interpolated there; another one has its row evaluated.

    Returns
    -------
    mesh : (n, 2)
        mm.
    change : float
        Square of the largest change since ``was`` (empty: not asked) at the nodes that may become contacts, mm^2.
    how : int
        0 no landmark of the tip, 1 interpolated, 2 evaluated directly.
    reach : float
        Largest displacement at those nodes, mm.
    """
    weights, offsets, w, t, n = b.weights, b.offsets, b.w, b.t, b.points.shape[1]
    c, kc, width = int(b.form[0]), k * int(b.form[0]), b.product.shape[1]
    head, Qc = b.product.shape[0] - b.MT.shape[0], b.nodes.shape[1] * c
    for i in range(kc):
        offsets[i], weights[0, i] = (head + i) * width, w[0, i]
        if c == 1:
            weights[1, i] = w[1, i]
    how, count, sx, sy, px, py = 0, kc, 0.0, 0.0, 0.0, 0.0
    if tip[0] > 0.0 and on_tip < 0:
        px, py = conditioned(b, tip[1], tip[2])
        gx, gy = contacts_field(t, w, kc, c)
        sx, sy = tip_weights(b.met[1:4], soft, tip[3] - gx, tip[4] - gy, c)
        patch = int(b.met[0])
        if patch >= 0:
            how, count = 1, kc + Qc
            first = stale(b, patch)
            if first >= 0:
                renew(b, patch, first)
            interpolate(b, patch, sx, sy, kc)
            for a in range(Qc):
                offsets[kc + a] = (patch * Qc + a) * width
        else:
            how, count = 2, kc + c
            tip_row(b, px, py)
            weights[0, kc] = sx
            weights[1 if c == 1 else 0, kc + c - 1] = sy
            for a in range(c):
                offsets[kc + a] = (2 * Qc + a) * width
    mesh = np.empty((n, 2))
    if c == 1:
        flat, x, y = mesh.reshape(2 * n), b.sums[0], b.sums[1]
        for start in range(0, n, BLOCK):
            sum_block_twice(b.product, offsets, weights, count, start, b.sums)
            m = min(BLOCK, n - start)
            block = flat[2 * start : 2 * (start + m)]
            for i in range(m):
                block[2 * i], block[2 * i + 1] = x[i], y[i]
    else:
        x = b.sums[0]
        for start in range(0, 2 * n, BLOCK):
            sum_block(b.product, offsets, weights, count, start, b.sums)
            for i in range(start, min(start + BLOCK, n)):
                mesh[i, 0] = x[i - start]
            for i in range(max(start, n), min(start + BLOCK, 2 * n)):
                mesh[i - n, 1] = x[i - start]
    if how == 1:
        add_near(b, px, py, sx, sy, mesh)
    change, reach = largest(b.at, b.watched, mesh, was)
    return mesh, change, how, reach


@njit(**OPTIONS)
def largest(at: Any, watched: Any, mesh: Any, was: Any) -> Any:
    """Square of the largest change and the largest displacement at the points ``at``; ``watched`` has `SIGN` for each of
    them and 0 for all others, or is empty where they are too few for that to pay."""
    change, reach = 0, 0
    if was.shape[0] == 0:
        return 0.0, 0.0
    now, old = mesh.reshape(-1), was.reshape(-1)
    if watched.shape[0] > 0:
        for i in range(watched.shape[0]):
            x, y = now[2 * i], now[2 * i + 1]
            dx, dy = x - old[2 * i], y - old[2 * i + 1]
            change = max(change, bits(dx * dx + dy * dy) & watched[i])
            reach = max(reach, bits(x * x + y * y) & watched[i])
    else:
        for i in range(at.shape[0]):
            x, y = mesh[at[i], 0], mesh[at[i], 1]
            dx, dy = x - was[at[i], 0], y - was[at[i], 1]
            change = max(change, bits(dx * dx + dy * dy) & SIGN)
            reach = max(reach, bits(x * x + y * y) & SIGN)
    return number(change), sqrt(number(reach))


@njit(**OPTIONS)
def spoken_for(q: Any, tip: Any, on_tip: int) -> Any:
    """Displacements of the contacts, the tip's own for the one that it speaks for."""
    given = q.copy()
    given[on_tip, 0], given[on_tip, 1] = tip[3], tip[4]
    return given


@njit(**OPTIONS)
def field(b: Any, table: Any, q: Any, tip: Any, on_tip: int, soft: float, was: Any) -> Any:
    """`spread` of landmarks that have not been met and combined yet."""
    combine(b, table, q if on_tip < 0 else spoken_for(q, tip, on_tip))
    if tip[0] > 0.0:
        px, py = conditioned(b, tip[1], tip[2])
        meet(b, px, py)
    return spread(b, table.shape[0], tip, on_tip, soft, was)


@njit(**OPTIONS)
def field_before(b: Any, table: Any, q: Any, before: Any, soft: float, x: float, y: float) -> Any:
    """Field at (x, y) mm of contacts q and the old tip ``before`` (absent: of the contacts alone)."""
    c, kc = int(b.form[0]), table.shape[0] * int(b.form[0])
    px, py = conditioned(b, x, y)
    combine(b, table, q)
    meet_exactly(b, px, py)
    vx, vy = contacts_field(b.t, b.w, kc, c)
    if before[0] == 0.0:
        return vx, vy
    here, felt = b.t[:, :kc].copy(), b.tip_felt.copy()
    bx, by = conditioned(b, before[1], before[2])
    meet_exactly(b, bx, by)
    gx, gy = contacts_field(b.t, b.w, kc, c)
    sx, sy = tip_weights(b.met[1:4], soft, before[3] - gx, before[4] - gy, c)
    e = np.empty((c, c))
    xx, xy, yy = kernel(b.form, px - bx, py - by)
    for a in range(c):
        for f in range(c):
            value = component(xx, xy, yy, a, f) + smooth_part(felt, a, b.tip_held, f)
            for i in range(kc):
                value -= here[a, i] * b.t[f, i]
            e[a, f] = value
    if c == 1:
        return vx + e[0, 0] * sx, vy + e[0, 0] * sy
    return vx + e[0, 0] * sx + e[0, 1] * sy, vy + e[1, 0] * sx + e[1, 1] * sy
