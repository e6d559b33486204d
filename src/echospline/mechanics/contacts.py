"""Contacts that come and go: the compiled updates of the Newton basis (`basis`)."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numba import njit

from echospline.mechanics.compiled import CHUNK, OPTIONS, add_range, component, kernel, kernel_rows
from echospline.mechanics.row_sums import BLOCK, sum_block
from echospline.mechanics.tip_patch import NEAR


@njit(**OPTIONS)
def smooth_part(felt: Any, i: int, held: Any, j: int) -> float:
    """-[U_xB P_x] L_B^-1 [U_By P_y]': what holding the anchors adds to U."""
    f, h, value = felt[i], held[j], 0.0
    for t in range(f.shape[0]):
        value -= f[t] * h[t]
    return value


@njit(**OPTIONS)
def green(
    form: Any, x: Any, felt: Any, i: int, y: Any, held: Any, j: int, out: Any, row: int, column: int
) -> None:
    """out[row :, column :] = G of point i of x (rows i c ... of ``felt``) and source j of y (rows j c ... of ``held``)."""
    c = int(form[0])
    xx, xy, yy = kernel(form, x[i, 0] - y[j, 0], x[i, 1] - y[j, 1])
    for a in range(c):
        for b in range(c):
            own = component(xx, xy, yy, a, b)
            out[row + a, column + b] = own + smooth_part(felt, i * c + a, held, j * c + b)


@njit(**OPTIONS)
def cholesky(A: Any) -> bool:
    """Lower factor of a small symmetric matrix, in place; False where it is not positive."""
    for j in range(A.shape[0]):
        line = A[j, :j]
        pivot = A[j, j]
        for t in range(j):
            pivot -= line[t] * line[t]
        if not pivot > 0.0:
            return False
        A[j, j] = sqrt(pivot)
        for i in range(j + 1, A.shape[0]):
            other, value = A[i, :j], A[i, j]
            for t in range(j):
                value -= other[t] * line[t]
            A[i, j] = value / A[j, j]
    return True


@njit(**OPTIONS)
def cholesky_solve(L: Any, X: Any) -> None:
    """(L L')^-1 X, in place."""
    n, r = X.shape
    for i in range(n):
        for j in range(i):
            for e in range(r):
                X[i, e] -= L[i, j] * X[j, e]
        for e in range(r):
            X[i, e] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for e in range(r):
            X[i, e] /= L[i, i]
        for j in range(i):
            for e in range(r):
                X[j, e] -= L[i, j] * X[i, e]


@njit(**OPTIONS)
def times_M(b: Any, d: Any, out: Any) -> None:
    """Out (1 or 2, kc) = M d for each line of d; what ``out`` has beyond kc, up to a whole block, is lost."""
    kc = b.count[0] * int(b.form[0])
    for start in range(0, kc, BLOCK):
        sum_block(b.MT, b.starts, d, min(kc, start + BLOCK), start, out[:, start:])


@njit(**OPTIONS)
def source_rows(b: Any, xy: Any, minus_held: Any, minus_E: Any, start: int, stop: int, out: Any) -> None:
    """Out = G less what the contacts explain, for sources xy (r, 2) at points start to stop: with two components all x
    of the block, then all y. ``minus_E`` (r c, k c) is minus the part of each that the first k contacts carry."""
    form, points, rows = b.form, b.points, b.rows
    c, n, m = int(form[0]), points.shape[1], stop - start
    head, kc = rows.shape[0] - b.MT.shape[0], minus_E.shape[1]
    for i in range(xy.shape[0]):
        kernel_rows(form, points, start, stop, xy[i, 0], xy[i, 1], out, i * c)
    for e in range(c):
        lo, hi = e * n + start, e * n + stop
        add_range(out, e * m, minus_held, 0, b.table.shape[0], b.table, lo, hi)
        add_range(out, e * m, minus_E, head, kc, rows, lo, hi)


@njit(**OPTIONS)
def keep(rows: Any, single: Any, row: int, lo: int, values: Any) -> None:
    """Store part of a row in both precisions."""
    m = values.shape[0]
    target, copy = rows[row, lo : lo + m], single[row, lo : lo + m]
    for x in range(m):
        target[x] = values[x]
        copy[x] = values[x]


@njit(**OPTIONS)
def contacts_and_nodes(b: Any, patch: int, first: int) -> None:
    """G of the contacts from ``first`` on and the nodes of a patch, without U where a contact is close."""
    form, square, nodes = b.form, b.squares[patch], b.nodes[patch]
    c, Q = int(form[0]), nodes.shape[0]
    reach2 = (NEAR * square[2]) ** 2
    for j in range(first, b.count[0]):
        s = b.source_of[j]
        dx, dy = b.sources[s, 0] - square[0], b.sources[s, 1] - square[1]
        close = dx * dx + dy * dy <= reach2
        b.close[patch, j] = close
        for a in range(Q):
            xx, xy, yy = kernel(form, nodes[a, 0] - b.sources[s, 0], nodes[a, 1] - b.sources[s, 1])
            for e in range(c):
                for f in range(c):
                    value = smooth_part(b.felt, s * c + e, b.nodes_held[patch], a * c + f)
                    if not close:
                        value += component(xx, xy, yy, e, f)
                    b.nodes_contacts[patch, a * c + f, j * c + e] = value


@njit(**OPTIONS)
def join(b: Any, new: Any) -> bool:
    """Append contacts at the sources ``new``; False when they cannot be told apart from others."""
    form, MT, gram, rows, single = b.form, b.MT, b.gram, b.rows, b.single
    c, n, k, r, m = int(form[0]), b.points.shape[1], b.count[0], len(new), b.table.shape[0]
    rc, kc, head = r * c, k * c, rows.shape[0] - MT.shape[0]
    cross, S, U = np.empty((rc, kc)), np.empty((rc, rc)), np.empty((rc, MT.shape[1]))
    xy, minus_held = np.empty((r, 2)), np.empty((rc, m))
    for i in range(r):
        xy[i] = b.sources[new[i]]
        for a in range(c):
            minus_held[i * c + a] = -b.held[new[i] * c + a]
        for j in range(k):
            green(form, b.sources, b.felt, new[i], b.sources, b.held, b.source_of[j], cross, i * c, j * c)
        for j in range(r):
            green(form, b.sources, b.felt, new[i], b.sources, b.held, new[j], S, i * c, j * c)
        for a in range(c):
            S[i * c + a, i * c + a] += b.softness[new[i]]
    for i in range(rc):
        for j in range(kc):
            gram[kc + i, j] = gram[j, kc + i] = cross[i, j]
        for j in range(rc):
            gram[kc + i, kc + j] = S[i, j]
    for i in range(rc):
        times_M(b, cross[i : i + 1], U[i : i + 1])
    for i in range(rc):
        for j in range(i + 1):
            value = 0.5 * (S[i, j] + S[j, i])
            for x in range(kc):
                value -= U[i, x] * U[j, x]
            S[i, j] = value
    if not cholesky(S):
        return False
    V, back = np.zeros((rc, rc)), np.empty(rc)  # V: S^-1, lower
    for i in range(rc):
        V[i, i] = 1.0 / S[i, i]
        for j in range(i):
            value = 0.0
            for x in range(j, i):
                value -= S[i, x] * V[x, j]
            V[i, j] = value * V[i, i]
    for i in range(rc):
        MT[kc + i, : kc + i] = 0.0
        for j in range(i, rc):
            MT[kc + i, kc + j] = V[j, i]
    for y in range(kc):  # a row of M is -V U M, V
        line = MT[y]
        for j in range(rc):
            value, one = 0.0, U[j]
            for x in range(y, kc):
                value += one[x] * line[x]
            back[j] = value
        for i in range(rc):
            value = 0.0
            for j in range(i + 1):
                value -= V[i, j] * back[j]
            line[kc + i] = value
    for i in range(r):
        b.source_of[k + i] = new[i]
        b.contact_of[new[i]] = k + i
    b.count[0] = k + r
    for patch in range(2):
        if b.squares[patch, 2] > 0.0:
            b.nodes_newton[patch, :, kc : kc + rc] = 0.0
            contacts_and_nodes(b, patch, k)
    minus_U = -U[:, :kc]
    width = CHUNK // c
    out, turned = np.empty((rc, c * width)), np.empty((rc, c * width))
    for start in range(0, n, width):
        stop = min(n, start + width)
        w = stop - start
        source_rows(b, xy, minus_held, minus_U, start, stop, out)
        turned[:, : c * w] = 0.0
        add_range(turned, 0, V, 0, rc, out, 0, c * w)
        for e in range(c):
            at = e * n + start
            for i in range(rc):
                keep(rows, single, head + kc + i, at, turned[i, e * w : (e + 1) * w])
    return True


@njit(**OPTIONS)
def _turn(line: Any, x: int, co: float, si: float) -> None:
    """Turn the neighbouring numbers x and x + 1 of a line."""
    kept = si * line[x + 1] - co * line[x]
    line[x + 1] = co * line[x + 1] + si * line[x]
    line[x] = kept


@njit(**OPTIONS)
def _turn_rows(rows: Any, j: int, last: int, turns: Any, start: int, stop: int) -> None:
    """Carry row j to ``last``: each row that it passes takes its part of it."""
    for x in range(j, last):
        co, si = turns[x, 0], turns[x, 1]
        carry, other = rows[x, start:stop], rows[x + 1, start:stop]
        for i in range(stop - start):
            kept = si * other[i] - co * carry[i]
            other[i] = co * other[i] + si * carry[i]
            carry[i] = kept


@njit(**OPTIONS)
def drop(b: Any, gone: Any) -> None:
    """Remove contacts ``gone`` (ascending).

    Without contact j, L has a row less and is no longer triangular; turns of neighbouring columns make it so again, and
    the same turns act on the rows of E and M. In M they leave nothing in column j but in the last row, which goes.
    """
    form, MT, gram, rows, single = b.form, b.MT, b.gram, b.rows, b.single
    c, N, room = int(form[0]), rows.shape[1], MT.shape[0]
    k, head, Qc = b.count[0], rows.shape[0] - room, b.nodes.shape[1] * c
    g, kc = len(gone) * c, k * c
    turns, which = np.empty((g, kc, 2)), np.empty(g, dtype=np.int64)
    lost = np.zeros((g, 2 * Qc))
    newton, between = b.nodes_newton.reshape(2 * Qc, -1), b.nodes_contacts.reshape(2 * Qc, -1)
    for i in range(g):
        j = (
            gone[len(gone) - 1 - i // c] * c + c - 1 - i % c
        )  # from the end, so that the others keep their numbers
        last = kc - 1 - i
        which[i] = j
        for x in range(j, last):
            p, q = MT[j, x], MT[j, x + 1]
            length = sqrt(p * p + q * q)
            turns[i, x, 0], turns[i, x, 1] = q / length, p / length
            _turn(MT[j], x, q / length, p / length)
        for y in range(last):
            line = MT[y] if y < j else MT[y + 1]
            for x in range(max(j, y), last):
                _turn(line, x, turns[i, x, 0], turns[i, x, 1])
            if y >= j:
                MT[y, : last + 1] = line[: last + 1]
        for y in range(last + 1):
            gram[y, j:last] = gram[y, j + 1 : last + 1]
        for x in range(j, last):
            gram[x, :last] = gram[x + 1, :last]
        for a in range(2 * Qc):
            for x in range(j, last):
                _turn(newton[a], x, turns[i, x, 0], turns[i, x, 1])
                between[a, x] = between[a, x + 1]
            lost[i, a] = newton[a, last]
    first, touched = which.min(), np.zeros(2 * Qc, dtype=np.bool_)
    for i in range(g):
        for a in range(2 * Qc):
            touched[a] = touched[a] or lost[i, a] != 0.0
    for start in range(0, N, CHUNK):
        stop = min(N, start + CHUNK)
        for i in range(g):
            last = kc - 1 - i
            _turn_rows(rows[head:], which[i], last, turns[i], start, stop)
            out = rows[head + last, start:stop]
            for a in range(2 * Qc):
                if lost[i, a] != 0.0:  # a node's row of a patch keeps what only the row that goes has carried
                    target, share = rows[a, start:stop], lost[i, a]
                    for x in range(stop - start):
                        target[x] += share * out[x]
        for row in range(head + first, head + kc - g):
            single[row, start:stop] = rows[row, start:stop]
        for a in range(2 * Qc):
            if touched[a]:
                single[a, start:stop] = rows[a, start:stop]
    at, j = gone[0], 0
    for i in range(gone[0], k):
        if j < len(gone) and gone[j] == i:
            b.contact_of[b.source_of[i]] = -1
            j += 1
            continue
        b.source_of[at] = b.source_of[i]
        b.contact_of[b.source_of[at]] = at
        b.close[0, at], b.close[1, at] = b.close[0, i], b.close[1, i]
        at += 1
    b.count[0] = k - len(gone)


@njit(**OPTIONS)
def change(b: Any, wanted: Any) -> Any:
    """Make the sources ``wanted`` the contacts: how many joined and left, and whether they can be told apart."""
    member = np.zeros(b.contact_of.shape[0], dtype=np.bool_)
    new, fresh = np.empty(len(wanted), dtype=np.int64), 0
    for i in wanted:
        member[i] = True
        if b.contact_of[i] < 0:
            new[fresh] = i
            fresh += 1
    k = b.count[0]
    gone, left = np.empty(k, dtype=np.int64), 0
    for i in range(k):
        if not member[b.source_of[i]]:
            gone[left] = i
            left += 1
    if left:
        drop(b, gone[:left])
    return fresh, left, join(b, new[:fresh]) if fresh else True


@njit(**OPTIONS)
def misfit(b: Any) -> float:
    """Largest |(G_CC + D) M' M d - d| for displacements d of 1 and -1 in no particular order."""
    MT, gram, n = b.MT, b.gram, b.count[0] * int(b.form[0])
    d, w, back = np.empty((1, n)), np.empty((1, MT.shape[1])), np.empty(n)
    for i in range(n):
        d[0, i] = 1.0 if (i * 2654435761 >> 9) & 1 else -1.0
    times_M(b, d, w)
    for j in range(n):
        line, value = MT[j], 0.0
        for i in range(j, n):
            value += line[i] * w[0, i]
        back[j] = value
    worst = 0.0
    for i in range(n):
        value = -d[0, i]
        for j in range(n):
            value += gram[i, j] * back[j]
        if not abs(value) <= worst:
            worst = abs(value)
    return worst
