"""Time of a whole picture in the native core, in cv2.remaps of the same run.

Deformation set, positions found, sampled, needle drawn: 512 x 512 pixels of 8 bits, one thread. Prints the processor level, and the
least and the median of the ratios over interleaved rounds.

Usage: python benchmarks/picture.py [rounds]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import perf_counter

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "core"))
import native

SIZE, SPACING = 512, 0.09
MESHES = ((40, 30), (78, 58))


def milliseconds(call: Callable[[], object]) -> float:
    """Time of one call."""
    start = perf_counter()
    call()
    return 1000 * (perf_counter() - start)


def main(rounds: int = 40) -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (SIZE, SIZE)).astype(np.uint8), (0, 0), 1.5)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    out = np.empty_like(image)
    lib = native.library()
    print(f"{SIZE} x {SIZE}, one thread, OpenCV {cv2.__version__}, {rounds} rounds")
    print(f"{'level':9} {'mesh':8} {'method':6} {'needle':8} {'ms':>7} {'in remaps':>10} {'median':>7}")
    for level in native.levels():
        for mesh in MESHES:
            for method, name in ((native.EXACT, "exact"), (native.PULL, "pull")):
                picture = native.Picture(image, mesh, spacing=(SPACING, SPACING), level=level, method=method)
                away = picture.nodes - (23.0, 20.0)
                u = 2 * np.exp(-(away**2).sum(1) / 16)[:, None] * [0.4, 0.9]
                picture.deform(u)
                x, y = picture.inverse()
                for tilt in (None, 5, 30):
                    needle = None
                    if tilt is not None:
                        a = np.radians(tilt)
                        tip = (3 + 33 * np.cos(a), 5 + 33 * np.sin(a), 0)
                        needle = native.needle((3, 5, 0), tip)
                    pointer = None if needle is None else native.c.byref(needle)

                    def draw() -> None:
                        lib.echospline_picture_deform(picture.handle, u.ctypes.data, u.size)
                        lib.echospline_picture_draw(picture.handle, pointer, out.ctypes.data, out.nbytes)

                    def remap() -> None:
                        cv2.remap(image, x, y, cv2.INTER_LINEAR, dst=out)

                    draw(), remap()
                    times = np.array([(milliseconds(draw), milliseconds(remap)) for _ in range(rounds)])
                    least = times.min(axis=0)
                    ratio = median(times[:, 0] / times[:, 1])
                    label = "none" if tilt is None else f"{tilt} deg"
                    shape = f"{mesh[0]}x{mesh[1]}"
                    level_name = lib.echospline_level_name(level).decode()
                    print(f"{level_name:9} {shape:8} {name:6} {label:8} {least[0]:7.3f} {least[0] / least[1]:10.2f} {ratio:7.2f}")


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
