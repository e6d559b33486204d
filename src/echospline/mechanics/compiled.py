"""The loops that run at every step, compiled ahead of the simulation and cached on disk: products and kernels.

Plain loops over contiguous rows: memory bandwidth is their limit (`docs/performance.md`). Everything that they
compute is also written in NumPy, in `kernels.py`, `spline.py` and `tps.py`, and the tests compare the two.
One thread: waking a second costs more than a step.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

log = logging.getLogger("echospline")

OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",  # a division is checked by who calls, so that loops become vector instructions
    "fastmath": {"reassoc", "contract", "arcp", "nsz", "afn"},  # sums in any order; infinities and NaN stay
}

CHUNK = 1024
"""Points per block, so that the sums of one block stay in the first-level cache."""

LN2 = 0.6931471805599453
ROOT_HALF = 0x3FE6A09E667F3BCD
"""The bits of sqrt(1/2)."""


def _bits_of(_context: Any, _x: Any) -> Any:
    def generate(_c: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(64))

    return types.int64(types.float64), generate


def _number_of(_context: Any, _i: Any) -> Any:
    def generate(_c: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.int64), generate


bits: Any = intrinsic(_bits_of)
number: Any = intrinsic(_number_of)


@njit(**OPTIONS)
def ln(x: float) -> Any:
    """Natural logarithm to rounding, in a form that the compiler turns into vector instructions; finite at 0.

    x = m 2^e with m between sqrt(1/2) and sqrt(2), and ln m = 2 artanh((m - 1) / (m + 1)) as its series.
    """
    i = bits(x)
    e = (i - ROOT_HALF) >> 52
    m = number(i - (e << 52))
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 1.0 / 19.0
    p = p * z + 1.0 / 17.0
    p = p * z + 1.0 / 15.0
    p = p * z + 1.0 / 13.0
    p = p * z + 1.0 / 11.0
    p = p * z + 1.0 / 9.0
    p = p * z + 1.0 / 7.0
    p = p * z + 1.0 / 5.0
    p = p * z + 1.0 / 3.0
    return e * LN2 + 2.0 * (s + s * z * p)


@njit(**OPTIONS)
def kernel(form: Any, dx: float, dy: float) -> Any:
    """xx, xy, yy of a kernel at an offset; ``form`` is (components, coupling, radius^2)."""
    r2 = dx * dx + dy * dy
    if form[0] == 1.0:
        return r2 * ln(r2), 0.0, 0.0
    s = r2 + form[2]
    iso = -(4.0 - 2.0 * form[1]) * (ln(s) + 1.0) - 4.0 * r2 / s
    f = 4.0 * form[1] / s
    return iso + f * dx * dx, f * dx * dy, iso + f * dy * dy


@njit(**OPTIONS)
def component(xx: float, xy: float, yy: float, a: int, b: int) -> Any:
    """Entry (a, b) of a symmetric kernel; xx with one component."""
    return xx if a + b == 0 else (yy if a + b == 2 else xy)


@njit(**OPTIONS)
def kernel_rows(
    form: Any, points: Any, start: int, stop: int, x: float, y: float, out: Any, row: int
) -> None:
    """Rows of U for one source at points (2, n), start to stop: out[row, : stop - start], or for two components
    out[row] and out[row + 1] with all x, then all y."""
    px, py, m = points[0, start:stop], points[1, start:stop], stop - start
    if form[0] == 1.0:
        a = out[row, :m]
        for i in range(m):
            dx, dy = px[i] - x, py[i] - y
            r2 = dx * dx + dy * dy
            a[i] = r2 * ln(r2)
        return
    xx, xy = out[row, :m], out[row, m : 2 * m]
    yx, yy = out[row + 1, :m], out[row + 1, m : 2 * m]
    p, q, f = 4.0 - 2.0 * form[1], form[2], 4.0 * form[1]
    for i in range(m):
        dx, dy = px[i] - x, py[i] - y
        r2 = dx * dx + dy * dy
        s = r2 + q
        iso = -p * (ln(s) + 1.0) - 4.0 * r2 / s
        g = f / s
        xx[i] = iso + g * dx * dx
        yy[i] = iso + g * dy * dy
        xy[i] = g * dx * dy
        yx[i] = xy[i]


@njit(**OPTIONS)
def _add_two(
    a: Any, b: Any, wa: Any, wb: Any, first: int, count: int, rows: Any, start: int, stop: int
) -> None:
    """a += wa @ rows and b += wb @ rows: four rows at a time, then two, then one."""
    n, j = stop - start, 0
    while j + 3 < count:
        h0, h1 = rows[first + j, start:stop], rows[first + j + 1, start:stop]
        h2, h3 = rows[first + j + 2, start:stop], rows[first + j + 3, start:stop]
        a0, a1, a2, a3 = wa[j], wa[j + 1], wa[j + 2], wa[j + 3]
        b0, b1, b2, b3 = wb[j], wb[j + 1], wb[j + 2], wb[j + 3]
        for t in range(n):
            a[t] += a0 * h0[t] + a1 * h1[t] + a2 * h2[t] + a3 * h3[t]
            b[t] += b0 * h0[t] + b1 * h1[t] + b2 * h2[t] + b3 * h3[t]
        j += 4
    if j + 1 < count:
        h0, h1 = rows[first + j, start:stop], rows[first + j + 1, start:stop]
        a0, a1, b0, b1 = wa[j], wa[j + 1], wb[j], wb[j + 1]
        for t in range(n):
            a[t] += a0 * h0[t] + a1 * h1[t]
            b[t] += b0 * h0[t] + b1 * h1[t]
        j += 2
    if j < count:
        h0, a0, b0 = rows[first + j, start:stop], wa[j], wb[j]
        for t in range(n):
            a[t] += a0 * h0[t]
            b[t] += b0 * h0[t]


@njit(**OPTIONS)
def _add_one(a: Any, wa: Any, first: int, count: int, rows: Any, start: int, stop: int) -> None:
    """a += wa @ rows."""
    n, j = stop - start, 0
    while j + 3 < count:
        h0, h1 = rows[first + j, start:stop], rows[first + j + 1, start:stop]
        h2, h3 = rows[first + j + 2, start:stop], rows[first + j + 3, start:stop]
        a0, a1, a2, a3 = wa[j], wa[j + 1], wa[j + 2], wa[j + 3]
        for t in range(n):
            a[t] += a0 * h0[t] + a1 * h1[t] + a2 * h2[t] + a3 * h3[t]
        j += 4
    while j < count:
        h0, a0 = rows[first + j, start:stop], wa[j]
        for t in range(n):
            a[t] += a0 * h0[t]
        j += 1


@njit(**OPTIONS)
def add_range(
    out: Any, at: int, weights: Any, first: int, count: int, rows: Any, start: int, stop: int
) -> None:
    """out[:, at : at + stop - start] += weights[:, :count] @ rows[first : first + count, start:stop]."""
    r, n, i = out.shape[0], stop - start, 0
    while i + 1 < r:
        a, b = out[i, at : at + n], out[i + 1, at : at + n]
        _add_two(a, b, weights[i], weights[i + 1], first, count, rows, start, stop)
        i += 2
    if i < r:
        _add_one(out[i, at : at + n], weights[i], first, count, rows, start, stop)


@njit(**OPTIONS)
def add_product(out: Any, weights: Any, rows: Any) -> None:
    """out (r, n) += weights (r, m) @ rows (m, n), for few rows r: one pass over ``rows`` per pair of them."""
    n, m = rows.shape[1], rows.shape[0]
    for start in range(0, n, CHUNK):
        add_range(out, start, weights, 0, m, rows, start, min(n, start + CHUNK))


_ready: set[str] = set()
_lock = threading.Lock()


def forget_stale_code() -> None:
    """Drop compiled code that is older than any loop's source: numba's cache watches a function's own file alone,
    not the files of what it calls, and would go on running what a change elsewhere has replaced."""
    with _lock:
        if "cache" in _ready:
            return
        _ready.add("cache")
        folder = Path(__file__).parent
        sources = [*folder.glob("*.py"), folder.parent / "scene" / "needle.py"]
        changed = max(source.stat().st_mtime for source in sources)
        for index in (folder / "__pycache__").glob("*.nbi"):
            with suppress(OSError):  # where this may not be written, numba keeps nothing here either
                if index.stat().st_mtime < changed:
                    index.unlink()


def compile_ahead(
    name: str, try_out: Callable[[], None], report: Callable[[str], None] | None = None
) -> float:
    """Compile (first run on a machine) or load a set of loops, so that no step does.

    Parameters
    ----------
    name : str
        Of the set; each is tried out once per process.
    try_out : callable
        Calls every loop once with the types that the simulation uses.
    report : callable, optional
        Gets one sentence if this takes longer than three seconds: then the machine compiles. A warning of the logger
        "echospline" when not given.

    Returns
    -------
    float
        Seconds that it took; 0 when it was done before.
    """
    with _lock:
        if name in _ready:
            return 0.0
        say = log.warning if report is None else report
        timer = threading.Timer(
            3.0, say, args=("compiling the fast step for this machine, once: a minute or less",)
        )
        timer.daemon = True
        begin = time.perf_counter()
        timer.start()
        try:
            try_out()
        finally:
            timer.cancel()
        _ready.add(name)
        return time.perf_counter() - begin
