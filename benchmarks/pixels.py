"""A node per pixel, and frames of 512 x 512: time and error.

    python benchmarks/pixels.py

Wall-clock and processor time; the processor time is what a machine without neighbours needs.
"""

from time import perf_counter, process_time

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.mechanics import Elastic, ThinPlate, TPSModel
from echospline.picture import Deformation, warp
from echospline.scene import RegularGrid, UltrasoundImage
from echospline.study.bench import MESHES, path, scene


def show(name, rows):
    wall, processor = 1000 * np.array(rows[len(rows) // 2 :]).T
    print(
        f"{name:44} wall median {np.median(wall):7.2f} p99 {np.quantile(wall, 0.99):7.2f}  "
        f"processor median {np.median(processor):7.2f} ms  ({1000 / np.median(wall):.0f} / {1000 / np.median(processor):.0f} per s)"
    )


def pixels(size, kernel):
    grid = RegularGrid((size, size), (40 / (size - 1), 30 / (size - 1)))
    model, rows = TPSModel(grid, kernel=kernel), []
    state, rng, worst = model.rest(), np.random.default_rng(0), 0.0
    for i, pose in enumerate(path(1e-2)):
        begin = perf_counter(), process_time()
        state = model.advance(state, pose, 1e-2)
        u = model.displacement(state)
        rows.append((perf_counter() - begin[0], process_time() - begin[1]))
        if i % 30 == 29:
            near = np.flatnonzero(np.hypot(*(grid.nodes - pose.tip).T) < 3)
            some = np.concatenate([rng.choice(near, 3000), rng.choice(grid.size, 3000)])
            worst = max(worst, float(np.abs(u[some] - model.displacement_at(state, grid.nodes[some])).max()))
    show(f"{type(kernel).__name__}, {size} x {size} nodes, error {worst:.1e} mm", rows)


def frames(size=512):
    model = scene(MESHES[4524])
    grid = RegularGrid((size, size), (40 / (size - 1), 30 / (size - 1)))
    image = UltrasoundImage(np.random.default_rng(0).integers(0, 255, (size, size), dtype=np.uint8), grid)
    state, rows = model.rest(), []
    for pose in path(1 / 60):
        begin = perf_counter(), process_time()
        state = model.advance(state, pose, 1 / 60)
        warp(image, Deformation(model.grid, model.displacement(state)).inverse(grid))
        rows.append((perf_counter() - begin[0], process_time() - begin[1]))
    show(f"frame of {size} x {size}, mesh 4524", rows)


if __name__ == "__main__":
    with threadpool_limits(1):
        for size in (512, 1024):
            for kernel in (ThinPlate(), Elastic()):
                pixels(size, kernel)
        frames()
