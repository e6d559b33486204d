"""The loops that run at every step, compiled ahead of the simulation and cached on disk.

Plain loops over contiguous rows: memory bandwidth is their limit (`docs/performance.md`). Everything that they
compute is also written in NumPy, in `response.py`, `interaction.py` and `tps.py`, and the tests compare the two.
One thread: waking a second costs more than a step.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

log = logging.getLogger("echospline")

CHUNK = 2048
"""Points per block, so that the sums of one block stay in the first-level cache."""


@njit(cache=True, fastmath=True, nogil=True)
def add_product(out: Any, weights: Any, rows: Any) -> None:
    """out (r, n) += weights (r, m) @ rows (m, n), for few rows r: one pass over ``rows`` per pair of them."""
    r, n = out.shape
    m = rows.shape[0]
    for start in range(0, n, CHUNK):
        stop = min(n, start + CHUNK)
        i = 0
        while i + 1 < r:
            a, b = out[i, start:stop], out[i + 1, start:stop]
            j = 0
            while j + 3 < m:
                h0, h1 = rows[j, start:stop], rows[j + 1, start:stop]
                h2, h3 = rows[j + 2, start:stop], rows[j + 3, start:stop]
                a0, a1, a2, a3 = weights[i, j], weights[i, j + 1], weights[i, j + 2], weights[i, j + 3]
                b0, b1 = weights[i + 1, j], weights[i + 1, j + 1]
                b2, b3 = weights[i + 1, j + 2], weights[i + 1, j + 3]
                for t in range(stop - start):
                    a[t] += a0 * h0[t] + a1 * h1[t] + a2 * h2[t] + a3 * h3[t]
                    b[t] += b0 * h0[t] + b1 * h1[t] + b2 * h2[t] + b3 * h3[t]
                j += 4
            while j < m:
                h0 = rows[j, start:stop]
                a0, b0 = weights[i, j], weights[i + 1, j]
                for t in range(stop - start):
                    a[t] += a0 * h0[t]
                    b[t] += b0 * h0[t]
                j += 1
            i += 2
        if i < r:
            a = out[i, start:stop]
            j = 0
            while j + 3 < m:
                h0, h1 = rows[j, start:stop], rows[j + 1, start:stop]
                h2, h3 = rows[j + 2, start:stop], rows[j + 3, start:stop]
                a0, a1, a2, a3 = weights[i, j], weights[i, j + 1], weights[i, j + 2], weights[i, j + 3]
                for t in range(stop - start):
                    a[t] += a0 * h0[t] + a1 * h1[t] + a2 * h2[t] + a3 * h3[t]
                j += 4
            while j < m:
                h0 = rows[j, start:stop]
                a0 = weights[i, j]
                for t in range(stop - start):
                    a[t] += a0 * h0[t]
                j += 1


@njit(cache=True, fastmath=True, nogil=True)
def update_rows(rows: Any, single: Any, weights: Any, by: Any) -> None:
    """rows (m, n) += weights (m, r) @ by (r, n), and the same rows in single precision beside them."""
    m, n = rows.shape
    r = by.shape[0]
    for j in range(m):
        for start in range(0, n, CHUNK):
            stop = min(n, start + CHUNK)
            row, copy = rows[j, start:stop], single[j, start:stop]
            for i in range(r):
                w, b = weights[j, i], by[i, start:stop]
                for t in range(stop - start):
                    row[t] += w * b[t]
            for t in range(stop - start):
                copy[t] = row[t]


def _try_out() -> None:
    """Call every loop once with the types that the simulation uses."""
    for dtype in (np.float32, np.float64):
        add_product(np.zeros((2, 3), dtype), np.zeros((2, 1), dtype), np.zeros((1, 3), dtype))
    update_rows(np.zeros((1, 3)), np.zeros((1, 3), np.float32), np.zeros((1, 1)), np.zeros((1, 3)))


_ready = threading.Event()
_lock = threading.Lock()


def compile_ahead(report: Callable[[str], None] = log.warning, *more: Callable[[], None]) -> float:
    """Compile (first run on a machine) or load every loop, so that no step does.

    Parameters
    ----------
    report : callable
        Gets one sentence if this takes longer than half a second: then the machine compiles, once.

    Returns
    -------
    float
        Seconds that it took; 0 when it was done before.
    """
    with _lock:
        if _ready.is_set():
            return 0.0
        sentence = "compiling the fast step for this machine: once, some ten seconds"
        timer = threading.Timer(0.5, report, args=(sentence,))
        timer.daemon = True
        begin = time.perf_counter()
        timer.start()
        try:
            _try_out()
        finally:
            timer.cancel()
        _ready.set()
        return time.perf_counter() - begin
