"""Step of a needle that sticks and slips against one back-substitution of finite elements, in one run.

    python benchmarks/stick_slip.py [--steps 60]

The step is the whole of `ForceModel.advance`: the law in the core, one product for the mesh, and Python around both. Steps in which the
tissue is asked for a new station are counted apart. Beside the back-substitution stands a whole step of `FEMModel` under the paper's
viscous law, which makes one. Medians of thread time; all sides take turns.
"""

from __future__ import annotations

import argparse
from time import thread_time

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.mechanics import Clamps, FEMModel, ForceModel, ViscousForces
from echospline.mechanics.fem_response import FEMResponse
from echospline.scene import NeedlePose, RegularGrid, Tissue

SIZE = (40.0, 30.0)
MESHES = ((40, 30), (115, 87), (231, 173))


def measure(shape: tuple[int, int], steps: int) -> tuple[dict[str, float], int]:
    """Median ms of each side, and the stations at the end."""
    grid = RegularGrid(shape, (SIZE[0] / (shape[0] - 1), SIZE[1] / (shape[1] - 1)))
    response = FEMResponse(grid, Clamps.of(grid, ("left", "right", "bottom")), Tissue(10.0))
    model = ForceModel(response)
    state = model.rest()
    viscous = FEMModel(grid, forces=ViscousForces(friction=1e-3))
    other = viscous.rest()
    loads = np.zeros((grid.size, 2))
    loads[grid.size // 2, 1] = 0.4
    times: dict[str, list[float]] = {"step": [], "asking": [], "solve": [], "viscous": []}
    asked = 0
    answer = response.answer

    def counted(*arguments):  # type: ignore[no-untyped-def]
        nonlocal asked
        asked += 1
        return answer(*arguments)

    response.answer = counted  # type: ignore[method-assign]
    for k in range(1, steps + 1):
        depth = 24.0 * k / steps
        pose = NeedlePose((20.0, 0.0), (20.0 + 0.3 * depth, 0.95 * depth), 10.0)
        before, begin = asked, thread_time()
        state = model.advance(state, pose, 1 / 60)
        end = thread_time()
        times["asking" if asked > before else "step"].append(end - begin)
        begin = thread_time()
        response.factored.solve(loads)
        times["solve"].append(thread_time() - begin)
        begin = thread_time()
        other = viscous.advance(other, pose, 1 / 60)
        times["viscous"].append(thread_time() - begin)
    return {name: 1000 * float(np.median(seconds)) for name, seconds in times.items()}, len(state.track)


def main() -> None:
    """Print a row per mesh."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=60, help="of one insertion of 24 mm")
    steps = parser.parse_args().steps
    print(
        "nodes    step ms   with a new station ms   back-substitution ms (ratio)   viscous FEM step ms (ratio)   stations"
    )
    with threadpool_limits(limits=1):
        for shape in MESHES:
            ms, stations = measure(shape, steps)
            print(
                f"{shape[0] * shape[1]:6d} {ms['step']:9.3f} {ms['asking']:16.2f} {ms['solve']:22.3f} ({ms['solve'] / ms['step']:.1f})"
                f" {ms['viscous']:20.3f} ({ms['viscous'] / ms['step']:.1f}) {stations:14d}"
            )


if __name__ == "__main__":
    main()
