"""Time of a whole picture in the native core, in cv2.remaps of the same run.

Deformation set, positions found, sampled, needle drawn: 512 x 512 pixels of 8 bits, one thread. Prints the processor level, and the
least and the median of the ratios over interleaved rounds.

Usage: python benchmarks/picture.py [rounds]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "core"))
import native

SIZE, SPACING = 512, 0.09
MESHES = ((40, 30), (78, 58))
TILTS = (None, 5, 30)  # degrees; at 5 the ring-down is drawn too


def milliseconds(call: Callable[[], object]) -> float:
    """Time of one call."""
    start = perf_counter()
    call()
    return 1000 * (perf_counter() - start)


def compare(picture: native.Picture, needle: Any, rounds: int) -> tuple[float, float, float]:
    """Least time of a picture in ms, then its ratio to remap's: of the least times, and the median."""
    lib, out = native.library(), np.empty_like(picture.pixels)
    away = picture.nodes - (23.0, 20.0)
    u = 2 * np.exp(-(away**2).sum(1) / 16)[:, None] * [0.4, 0.9]
    x, y = picture.deform(u).inverse()
    pointer = None if needle is None else native.c.byref(needle)

    def draw() -> None:
        lib.echospline_picture_deform(picture.handle, u.ctypes.data, u.size)
        lib.echospline_picture_draw(picture.handle, pointer, out.ctypes.data, out.nbytes)

    def remap() -> None:
        cv2.remap(picture.pixels, x, y, cv2.INTER_LINEAR, dst=out)

    draw()
    remap()
    times = np.array([(milliseconds(draw), milliseconds(remap)) for _ in range(rounds)])
    least = times.min(axis=0)
    return least[0], least[0] / least[1], float(np.median(times[:, 0] / times[:, 1]))


def main(rounds: int = 40) -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    noise = np.random.default_rng(0).integers(0, 256, (SIZE, SIZE)).astype(np.uint8)
    image = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    print(f"{SIZE} x {SIZE}, one thread, OpenCV {cv2.__version__}, {rounds} rounds")
    print(f"{'level':9} {'mesh':8} {'method':6} {'needle':8} {'ms':>7} {'in remaps':>10} {'median':>7}")
    for level, mesh, method, tilt in product(native.levels(), MESHES, (native.EXACT, native.PULL), TILTS):
        picture = native.Picture(image, mesh, spacing=(SPACING, SPACING), level=level, method=method)
        needle = None
        if tilt is not None:
            tip = (3 + 33 * np.cos(np.radians(tilt)), 5 + 33 * np.sin(np.radians(tilt)), 0)
            needle = native.needle((3, 5, 0), tip)
        least, ratio, median = compare(picture, needle, rounds)
        words = (
            native.library().echospline_level_name(level).decode(),
            f"{mesh[0]}x{mesh[1]}",
            "exact" if method == native.EXACT else "pull",
            "none" if tilt is None else f"{tilt} deg",
        )
        print("{:9} {:8} {:6} {:8}".format(*words), f"{least:7.3f} {ratio:10.2f} {median:7.2f}")


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
