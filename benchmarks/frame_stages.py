"""Time of a whole frame, from the needle's pose to the picture with its echo: 512 x 512 pixels of 8 bits at 60 Hz, one thread.

Stages: interaction, spline, picture. The whole is also given in ``cv2.remap`` calls of the same run, interleaved frame by frame
(one such call samples the picture once at known positions), as the median of the ratios. Times are of one machine under its load that
day; the ratios are what lasts.

Run: ``python benchmarks/frame_stages.py [--json]``.
"""

from __future__ import annotations

import argparse
import json
from itertools import product
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from echospline.mechanics import Elastic, Kernel, ThinPlate, TPSModel
from echospline.picture import Deformation, NeedleEcho, simulate
from echospline.picture.native import Inverse, blank
from echospline.scene import Insertion, RegularGrid, UltrasoundImage

SIZE, SPACING, FPS = 512, 0.08, 60.0
MESHES = ((40, 30), (78, 58))
PATH = Insertion.straight((8.0, 0.0), 50.0, 28.0, 14.0)
WARM = 30  # frames


def picture_of_noise() -> UltrasoundImage:
    noise = np.random.default_rng(0).integers(0, 256, (SIZE, SIZE)).astype(np.uint8)
    smooth = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    return UltrasoundImage.from_array(smooth, (SPACING, SPACING))


def measure(kernel: Kernel, nodes: tuple[int, int], inverse: Inverse) -> dict[str, Any]:
    """Run one insertion; medians over its frames after the first half second."""
    image = picture_of_noise()
    model = TPSModel(RegularGrid.covering(image.grid, nodes), kernel=kernel)
    bump = 2 * np.exp(-((model.grid.nodes - (23.0, 20.0)) ** 2).sum(axis=1) / 16)[:, None] * [0.4, 0.9]
    origins = Deformation(model.grid, bump).inverse(image.grid)
    out = np.empty_like(image.pixels)
    stages: list[list[float]] = []
    ratios = []
    for frame in simulate(image, PATH, model, fps=FPS, needle=NeedleEcho(), inverse=inverse):
        began = perf_counter()
        cv2.remap(image.pixels, origins.x, origins.y, cv2.INTER_LINEAR, dst=out)
        remap = 1000.0 * (perf_counter() - began)
        stages.append([*frame.milliseconds.values(), remap])
        ratios.append(sum(frame.milliseconds.values()) / remap)
    names = [*frame.milliseconds, "remap"]
    times = dict(zip(names, np.median(stages[WARM:], axis=0).tolist(), strict=True))
    whole = [sum(row[:-1]) for row in stages[WARM:]]
    return {
        **times,
        "frame": float(np.median(whole)),
        "p99": float(np.percentile(whole, 99)),
        "remaps": float(np.median(ratios[WARM:])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    as_json = parser.parse_args().json
    cv2.setNumThreads(1)
    kernels: dict[str, Kernel] = {"tps": ThinPlate(), "elastic": Elastic()}
    methods: tuple[Inverse, ...] = ("auto", "exact")
    with threadpool_limits(limits=1):
        rows = [
            {
                "model": name,
                "nodes": nodes[0] * nodes[1],
                "inverse": inverse,
                **measure(kernels[name], nodes, inverse),
            }
            for name, nodes, inverse in product(kernels, MESHES, methods)
        ]
    one = RegularGrid((2, 2), (1.0, 1.0))
    level = blank(one, one).level
    if as_json:
        print(json.dumps({"level": level, "opencv": cv2.__version__, "rows": rows}, indent=2))
        return
    print(f"{level}, OpenCV {cv2.__version__}, one thread; median ms, and the frame in remaps")
    words = ("model", "nodes", "inverse")
    numbers = [k for k in rows[0] if k not in words]
    print(f"{'model':8} {'nodes':>6} {'inverse':8}" + " ".join(f"{s:>12}" for s in numbers))
    for row in rows:
        print(
            f"{row['model']:8} {row['nodes']:6} {row['inverse']:8}"
            + " ".join(f"{row[s]:12.3f}" for s in numbers)
        )


if __name__ == "__main__":
    main()
