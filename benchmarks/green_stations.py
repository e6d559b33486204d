"""A new station of a needle's track by Green's function: in the core from tables, and by NumPy and SciPy, in one run.

    python benchmarks/green_stations.py [--repeats 3]

The core's step is `ForcedStep.advance`, which asks nobody; NumPy's and SciPy's side is what the core was given before: the answer to the
station's two unit forces alone. Medians of thread time on 1200 nodes; both take turns.
"""

from __future__ import annotations

import argparse
from time import thread_time

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.mechanics import Clamps, ForcedScene, ForcedStep
from echospline.mechanics.green_response import green_response
from echospline.mechanics.stick_slip import station_at
from echospline.scene import Circle, Layer, NeedlePose, Polygon, RegularGrid, Tissue
from echospline.scene.tissue import Region

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
SCENES = {
    "homogeneous": Tissue(),
    "lesion": Tissue(regions=[Region(Circle((22.0, 14.0), 4.0), 50.0)]),
    "layer and lesion": Tissue(
        regions=[Region(Layer(0.0, 6.0), 30.0), Region(Circle((20.0, 18.0), 4.0), 2.0)]
    ),
    "triangles": Tissue(regions=[Region(Polygon(((18.0, 10.0), (26.0, 12.0), (20.0, 20.0))), 40.0)]),
}


def measure(tissue: Tissue, repeats: int) -> dict[str, float]:
    """Median ms of a step with a new station and without, and of the oracle's answer to a station."""
    response = green_response(GRID, Clamps.of(GRID, ("left", "right", "bottom"), None, ("top",)), tissue)
    times: dict[str, list[float]] = {"new": [], "other": [], "oracle": []}
    axis = np.array([0.5, 0.866])
    extent = np.array([0.0, 0.0]), np.array([40.0, 30.0])
    unit = np.zeros((4, 2, 2))
    for _ in range(repeats):
        step = ForcedStep(ForcedScene.of(response))
        state = step.rest()
        size = len(state)
        for depth in np.linspace(0.1, 19.0, 190):
            pose = NeedlePose((14.0, 0.0), tuple(np.array([14.0, 0.0]) + depth * axis))
            begin = thread_time()
            state = step.advance(state, pose, 1 / 120)
            elapsed = 1e3 * (thread_time() - begin)
            times["other" if len(state) == size else "new"].append(elapsed)
            if len(state) == size:
                continue
            size = len(state)
            station = station_at(np.array([14.0, 0.0]) + depth * axis, axis, 1.25, extent)
            count = len(station.points)
            unit[:count] = station.weights[:, None, None] * np.eye(2)
            begin = thread_time()
            response.solver.answer(station.points, unit[:count], station.points)
            times["oracle"].append(1e3 * (thread_time() - begin))
    return {name: float(np.median(values)) for name, values in times.items()}


def main() -> None:
    """Print one line per scene."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3)
    repeats = parser.parse_args().repeats
    print("scene               new station, ms   other, ms   NumPy's answer, ms   ratio")
    with threadpool_limits(1):
        for name, tissue in SCENES.items():
            t = measure(tissue, repeats)
            ratio = t["oracle"] / t["new"]
            print(f"{name:20} {t['new']:14.2f} {t['other']:11.3f} {t['oracle']:20.2f} {ratio:7.1f}")


if __name__ == "__main__":
    main()
