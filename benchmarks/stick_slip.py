"""Step of a needle that sticks and slips against one back-substitution of finite elements, in one run.

    python benchmarks/stick_slip.py [--steps 60]

The step is the whole of `ForceModel.advance`: the law in the core, one product for the mesh, and Python around both. Steps in which the
tissue is asked for a new station are counted apart. The ratio is medians of thread time; both sides take turns.
"""

from __future__ import annotations

import argparse
from time import thread_time

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.mechanics import Clamps, ForceModel
from echospline.mechanics.fem_response import FEMResponse
from echospline.scene import NeedlePose, RegularGrid, Tissue

SIZE = (40.0, 30.0)
MESHES = ((40, 30), (115, 87), (231, 173))


def measure(shape: tuple[int, int], steps: int) -> tuple[float, float, float, int]:
    """Median ms of a step that asks for nothing, of one that does, of a back-substitution; and the stations at the end."""
    grid = RegularGrid(shape, (SIZE[0] / (shape[0] - 1), SIZE[1] / (shape[1] - 1)))
    response = FEMResponse(grid, Clamps.of(grid, ("left", "right", "bottom")), Tissue(10.0))
    model = ForceModel(response)
    state = model.rest()
    loads = np.zeros((grid.size, 2))
    loads[grid.size // 2, 1] = 0.4
    times: dict[str, list[float]] = {"step": [], "asking": [], "solve": []}
    asked = 0
    answer = response.answer

    def counted(*arguments):  # type: ignore[no-untyped-def]
        nonlocal asked
        asked += 1
        return answer(*arguments)

    response.answer = counted  # type: ignore[method-assign]
    for k in range(1, steps + 1):
        depth = 24.0 * k / steps
        before, begin = asked, thread_time()
        state = model.advance(state, NeedlePose((20.0, 0.0), (20.0 + 0.3 * depth, 0.95 * depth)), 1 / 60)
        end = thread_time()
        times["asking" if asked > before else "step"].append(end - begin)
        begin = thread_time()
        response.factored.solve(loads)
        times["solve"].append(thread_time() - begin)
    step, asking, solve = (1000 * float(np.median(times[name])) for name in ("step", "asking", "solve"))
    return step, asking, solve, len(state.track)


def main() -> None:
    """Print a row per mesh."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=60, help="of one insertion of 24 mm")
    steps = parser.parse_args().steps
    print("nodes   step ms   with a new station ms   back-substitution ms   ratio   stations")
    with threadpool_limits(limits=1):
        for shape in MESHES:
            step, asking, solve, stations = measure(shape, steps)
            print(
                f"{shape[0] * shape[1]:6d} {step:8.3f} {asking:16.2f} {solve:22.3f} {solve / step:14.1f} {stations:8d}"
            )


if __name__ == "__main__":
    main()
