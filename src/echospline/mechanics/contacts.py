"""Contacts that come and go: the compiled updates of H, of G_CC^-1 and of the tip's patch.

Notation of `response.py`: P = (G_CC + D)^-1 with D the softness of the contacts, H = G_:C P kept as rows. Everything is
flat: contact i has the indices i c ... i c + c - 1 for a kernel of c components.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from echospline.mechanics.compiled import CHUNK, OPTIONS, add_range, kernel, kernel_rows, update_rows


@njit(**OPTIONS)
def green(
    form: Any, x: Any, felt: Any, i: int, y: Any, held: Any, j: int, out: Any, row: int, column: int
) -> None:
    """out[row :, column :] = G of point i of x (rows i c ... of ``felt``) and source j of y (rows j c ... of ``held``)."""
    c, m = int(form[0]), felt.shape[1]
    xx, xy, yy = kernel(form, x[i, 0] - y[j, 0], x[i, 1] - y[j, 1])
    for a in range(c):
        for b in range(c):
            f, h = felt[i * c + a], held[j * c + b]
            value = 0.0
            for t in range(m):
                value += f[t] * h[t]
            own = xx if a == 0 and b == 0 else (yy if a == 1 and b == 1 else xy)
            out[row + a, column + b] = own - value


@njit(**OPTIONS)
def inverse(A: Any) -> Any:
    """Inverse of a small symmetric positive matrix by Gauss and Jordan; not finite where it is singular."""
    n = A.shape[0]
    B = A.copy()
    for k in range(n):
        pivot = 1.0 / B[k, k]
        B[k, k] = 1.0
        for j in range(n):
            B[k, j] *= pivot
        for i in range(n):
            if i != k:
                factor = B[i, k]
                B[i, k] = 0.0
                for j in range(n):
                    B[i, j] -= factor * B[k, j]
    return B


@njit(**OPTIONS)
def source_rows(
    form: Any,
    points: Any,
    table: Any,
    xy: Any,
    held: Any,
    cross: Any,
    rows: Any,
    first: int,
    k: int,
    start: int,
    stop: int,
    E: Any,
) -> None:
    """E = G less what the contacts explain, for sources xy (r, 2), at points start to stop: with two components all x
    of the block, then all y. ``first`` is the first contact's row."""
    c, n, m = int(form[0]), points.shape[1], stop - start
    for i in range(xy.shape[0]):
        kernel_rows(form, points, start, stop, xy[i, 0], xy[i, 1], E, i * c)
    for b in range(c):
        add_range(E, b * m, held, 0, table.shape[0], table, b * n + start, b * n + stop)
        add_range(E, b * m, cross, first, k * c, rows, b * n + start, b * n + stop)


@njit(**OPTIONS)
def join(
    form: Any, points: Any, table: Any, sources: Any, felt: Any, held: Any, new: Any, soft: Any, slots: Any, k: int,
    P: Any, gram: Any, rows: Any, single: Any, head: int, patch: int, built: int, at: Any, toq: Any, q: Any, felt_q: Any
) -> bool:  # fmt: skip
    """Append contacts ``new`` (indices of sources) after the k in ``slots``; False when they cannot be told apart.

    ``patch`` is the number of sources in the tip's patch (0: none), the first ``built`` of whose rows are in use;
    ``at`` are the mesh points of the new sources.
    """
    c, n, r = int(form[0]), points.shape[1], len(new)
    rc, kc, m = r * c, k * c, table.shape[0]
    cross, S = np.empty((rc, kc)), np.empty((rc, rc))
    xy, hold = np.empty((r, 2)), np.empty((rc, m))
    for i in range(r):
        xy[i] = sources[new[i]]
        for a in range(c):
            hold[i * c + a] = -held[new[i] * c + a]
        for j in range(k):
            green(form, sources, felt, new[i], sources, held, slots[j], cross, i * c, j * c)
        for j in range(r):
            green(form, sources, felt, new[i], sources, held, new[j], S, i * c, j * c)
        for a in range(c):
            S[i * c + a, i * c + a] += soft[i]
    for i in range(rc):
        for j in range(kc):
            gram[kc + i, j] = gram[j, kc + i] = cross[i, j]
        for j in range(rc):
            gram[kc + i, kc + j] = S[i, j]
    U = np.zeros((rc, kc))
    for i in range(rc):
        for x in range(kc):
            w = cross[i, x]
            for j in range(kc):
                U[i, j] += w * P[x, j]
    for i in range(rc):
        for j in range(i + 1):
            value = 0.5 * (S[i, j] + S[j, i])
            for x in range(kc):
                value -= 0.5 * (U[i, x] * cross[j, x] + U[j, x] * cross[i, x])
            S[i, j] = S[j, i] = value
    for i in range(rc):
        if not S[i, i] > 0.0:
            return False
    V = inverse(S)
    if not np.isfinite(V).all():
        return False
    minus = -cross
    # the rows of H and of the patch, a block of points after another while it is in the cache
    UT, e = np.empty((kc, rc)), np.empty((built * c, rc))
    for j in range(kc):
        for i in range(rc):
            UT[j, i] = -U[i, j]
    for j in range(built * c):
        for i in range(r):
            for a in range(c):
                e[j, i * c + a] = -rows[j, a * n + at[i]]
    width = CHUNK // c
    E, T = np.empty((rc, c * width)), np.empty((rc, c * width))
    for start in range(0, n, width):
        stop = min(n, start + width)
        w = stop - start
        source_rows(form, points, table, xy, hold, minus, rows, head, k, start, stop, E)
        T[:, : c * w] = 0.0
        add_range(T, 0, V, 0, rc, E, 0, c * w)
        for b in range(c):
            lo, hi = b * n + start, b * n + stop
            by = T[:, b * w : (b + 1) * w].copy()
            update_rows(rows, single, head, kc, UT, by, lo, hi)
            update_rows(rows, single, 0, built * c, e, by, lo, hi)
            for i in range(rc):
                target, copy, t = rows[head + kc + i, lo:hi], single[head + kc + i, lo:hi], by[i]
                for x in range(w):
                    target[x] = t[x]
                    copy[x] = t[x]
    # the bordered inverse
    for i in range(rc):
        for j in range(kc):
            value = 0.0
            for x in range(rc):
                value += V[i, x] * U[x, j]
            cross[i, j] = value
    for i in range(kc):
        for j in range(kc):
            value = 0.0
            for x in range(rc):
                value += U[x, i] * cross[x, j]
            P[i, j] += value
    for i in range(rc):
        for j in range(kc):
            P[kc + i, j] = P[j, kc + i] = -cross[i, j]
        for j in range(rc):
            P[kc + i, kc + j] = V[i, j]
        slots[k + i // c] = new[i // c]
    for i in range(r):
        for j in range(patch):
            green(form, sources, felt, new[i], q, felt_q, j, toq, kc + i * c, j * c)
    return True


@njit(**OPTIONS)
def drop(
    c: int,
    gone: Any,
    slots: Any,
    k: int,
    P: Any,
    gram: Any,
    rows: Any,
    single: Any,
    head: int,
    patch: int,
    built: int,
    toq: Any,
) -> None:
    """Remove the contacts in slots ``gone`` (ascending); those from the end move into the gaps."""
    r, N = len(gone), rows.shape[1]
    rc, kc = r * c, k * c
    left = kc - rc
    order = np.empty(k, dtype=np.int64)
    flag = np.zeros(k, dtype=np.bool_)
    for i in range(r):
        flag[gone[i]] = True
    last = k - 1
    for i in range(k - r):
        if flag[i]:
            while flag[last]:
                last -= 1
            order[i] = last
            last -= 1
        else:
            order[i] = i
    D, K = np.empty(rc, dtype=np.int64), np.empty(left, dtype=np.int64)
    for i in range(r):
        for a in range(c):
            D[i * c + a] = gone[i] * c + a
    for i in range(k - r):
        for a in range(c):
            K[i * c + a] = order[i] * c + a
    PDD, PDK, out = np.empty((rc, rc)), np.empty((rc, left)), np.empty((left, left))
    for i in range(rc):
        for j in range(rc):
            PDD[i, j] = P[D[i], D[j]]
        for j in range(left):
            PDK[i, j] = P[D[i], K[j]]
    V = inverse(PDD)
    share = np.zeros((left, rc))
    for j in range(left):
        for i in range(rc):
            value = 0.0
            for x in range(rc):
                value += V[i, x] * PDK[x, j]
            share[j, i] = -value
    for i in range(left):
        for j in range(left):
            value = P[K[i], K[j]]
            for x in range(rc):
                value += PDK[x, i] * share[j, x]
            out[i, j] = value
    # residual of the patch's sources at the contacts that go
    e = np.zeros((built * c, rc))
    for i in range(rc):
        for q in range(built * c):
            value = 0.0
            for x in range(kc):
                value += P[D[i], x] * toq[x, q]
            e[q, i] = value
    solved = np.zeros((built * c, rc))
    for q in range(built * c):
        for i in range(rc):
            for x in range(rc):
                solved[q, i] += V[i, x] * e[q, x]
    # rows: those that go are set aside, a block of points at a time
    by = np.empty((rc, CHUNK))
    for start in range(0, N, CHUNK):
        stop = min(N, start + CHUNK)
        for i in range(rc):
            by[i, : stop - start] = rows[head + D[i], start:stop]
        for i in range(left):
            if K[i] != i:
                rows[head + i, start:stop] = rows[head + K[i], start:stop]
        update_rows(rows, single, head, left, share, by, start, stop)
        update_rows(rows, single, 0, built * c, solved, by, start, stop)
    kept = np.empty((left, left))
    for i in range(left):
        for j in range(left):
            kept[i, j] = gram[K[i], K[j]]
    for i in range(left):
        for j in range(left):
            P[i, j] = 0.5 * (out[i, j] + out[j, i])
            gram[i, j] = kept[i, j]
    for i in range(left):
        if K[i] != i:
            for q in range(patch * c):
                toq[i, q] = toq[K[i], q]
    for i in range(k - r):
        slots[i] = slots[order[i]]


@njit(**OPTIONS)
def misfit(P: Any, gram: Any, n: int) -> float:
    """Largest |(G_CC + D) P - I|."""
    worst = 0.0
    line = np.empty(n)
    for i in range(n):
        line[:] = 0.0
        for x in range(n):
            g = gram[i, x]
            for j in range(n):
                line[j] += g * P[x, j]
        line[i] -= 1.0
        for j in range(n):
            if not abs(line[j]) <= worst:
                worst = abs(line[j])
    return worst


@njit(**OPTIONS)
def build_rows(
    form: Any,
    points: Any,
    table: Any,
    q: Any,
    held_q: Any,
    toq: Any,
    rows: Any,
    single: Any,
    head: int,
    k: int,
    begin: int,
    end: int,
) -> None:
    """Rows of the patch's sources ``begin`` to ``end``, from row begin c on."""
    c, n = int(form[0]), points.shape[1]
    r = end - begin
    rc, m = r * c, table.shape[0]
    hold, cross = np.empty((rc, m)), np.empty((rc, k * c))
    for i in range(rc):
        for t in range(m):
            hold[i, t] = -held_q[begin * c + i, t]
    # what the contacts explain of a source is its value there: G_qC P G_C: = G_qC H
    for i in range(rc):
        for j in range(k * c):
            cross[i, j] = -toq[j, begin * c + i]
    width = CHUNK // c
    E = np.empty((rc, c * width))
    for start in range(0, n, width):
        stop = min(n, start + width)
        w = stop - start
        source_rows(form, points, table, q[begin:end], hold, cross, rows, head, k, start, stop, E)
        for i in range(rc):
            for b in range(c):
                target = rows[begin * c + i, b * n + start : b * n + stop]
                copy = single[begin * c + i, b * n + start : b * n + stop]
                source = E[i, b * w : (b + 1) * w]
                for x in range(w):
                    target[x] = source[x]
                    copy[x] = source[x]
