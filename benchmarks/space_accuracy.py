"""Tissue in space against finer finite elements on unseen needles, and what set-up, steps and fields cost.

    python benchmarks/space_accuracy.py             # about five minutes
    python benchmarks/space_accuracy.py --quick     # without the loads spread over fine elements

Block 40 x 35 x 30 mm, E 10 kPa, walls and bottom clamped. Six needles in the plane z = 0 and three that cross it, 0.4 N at the tip and
0.005 N/mm along the shaft. Planes z = 0, z = 5 mm, and one tilted by 30 degrees. Errors: mean distance as a share of the mean displacement in
that plane, mean over needles. Times are processor time of one thread.
"""

import argparse
import sys
from pathlib import Path
from time import thread_time

import numpy as np
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from echospline.mechanics import Elastic, SpatialForceModel, SpatialLandmarkModel, ThinPlate
from echospline.mechanics.hexahedra import Hexahedra
from echospline.mechanics.landmarks import SIDES
from echospline.mechanics.space_response import SpaceResponse, block
from echospline.mechanics.spatial_fem_response import SpatialFEMResponse
from echospline.mechanics.spatial_force_model import LIVE_CELL
from echospline.scene import Layer, Region, SpatialInsertion, Sphere, Tissue
from test_hexahedra import graded, spread_load

SIZE = (40.0, 35.0, 30.0)
WALLS = ("left", "right", "bottom", "front", "back")
FINE = 2.75
"""mm; cells of the reference."""
NEEDLES = (
    ((-12, 0, 0), (1, 1, 0), 24), ((7, 0, 0), (-0.26, 0.97, 0), 12), ((-8, 0, 0), (0.5, 0.87, 0), 20),
    ((0, 0, 0), (0, 1, 0), 18), ((10, 0, 0), (-0.7, 0.7, 0), 22), ((-4, 0, 0), (0.17, 0.98, 0), 15),
    ((-8, 0, -6), (0.46, 0.79, 0.41), 24), ((4, 0, 7), (-0.2, 0.85, -0.5), 20), ((0, 0, -5), (0.1, 0.9, 0.4), 16),
)  # fmt: skip
SPHERE = Region(Sphere((4.0, 16.0, 0.0), 5.0), 50.0)
LAYER = Region(Layer(20.0, 35.0), 50.0)


def planes(n=25):
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-19.5, 19.5, n), np.linspace(0.2, 34.5, n)))
    tilted = np.stack([x, y, np.tan(np.radians(30)) * (y - 17.5)], axis=1)
    flat = [np.stack([x, y, np.full_like(x, z)], axis=1) for z in (0.0, 5.0)]
    return {"z = 0": flat[0], "z = 5": flat[1], "30 degrees": tilted[np.abs(tilted[:, 2]) < 14.8]}


def load(entry, direction, depth):
    """Places, shares and whole force of a needle: friction each half mm, then the tip."""
    along = np.array(direction) / np.linalg.norm(direction)
    s = np.append((np.arange(int(2 * depth)) + 0.5) / 2, depth)
    places = np.array(entry) + s[:, None] * along
    f = np.append(np.full(len(s) - 1, 2.5e-3), 0.4)
    return places, f / f.sum(), f.sum() * along


def clear(places, region):
    """Whether the tip is more than 1.5 mm from the interface of a region."""
    tip = places[-1]
    if isinstance(region.shape, Sphere):
        return abs(np.linalg.norm(tip - region.shape.centre) - region.shape.radius) > 1.5
    return abs(tip[1] - region.shape.top) > 1.5


def fields(response):
    for entry, direction, depth in NEEDLES:
        places, weights, force = load(entry, direction, depth)
        yield response.field_of([response.column(places, weights)], force[None])


def share(u, v):
    return 100 * np.linalg.norm(u - v, axis=1).mean() / np.linalg.norm(v, axis=1).mean()


def compare(name, kinds, tissue, make, region=None):
    grid, clamps = block(SIZE, kinds)
    began = thread_time()
    ours = make(grid, clamps, tissue)
    setup = thread_time() - began
    truth = SpatialFEMResponse(grid, clamps, tissue, cell=FINE)
    rows = {plane: [] for plane in planes()}
    for needle, u, v in zip(NEEDLES, fields(ours), fields(truth), strict=True):
        if region is None or clear(load(*needle)[0], region):
            for plane, points in planes().items():
                rows[plane].append(share(u(points), v(points)))
    text = "  ".join(f"{p}: {np.mean(e):4.2f} (worst {np.max(e):4.2f})" for p, e in rows.items())
    print(f"{name:42} {text}  {len(rows['z = 0'])} needles, set-up {setup:.2f} s", flush=True)


def spread(name, regions, through):
    """Against forces spread over fine elements, without any closed form; the last 2.4 mm of a needle."""
    grid, clamps = block(SIZE, kinds())
    tissue = Tissue(10.0, 0.45, regions)
    a = np.array([0.6, 0.8, 0.0])
    places, forces = (
        np.array([-4.0, 8, 0]) + np.outer(np.arange(4) * 0.8, a),
        np.outer([0.05, 0.05, 0.1, 0.2], a),
    )
    low, high = grid.corners
    lines = tuple(
        graded(low[k], high[k], places[:, k].min() - 1.5, places[:, k].max() + 1.5, 1.4, 6.0, through[k])
        for k in range(3)
    )
    fine = Hexahedra(lines, tissue, clamps)
    values = fine.solve(spread_load(fine, places, forces, 1.2)[:, :, None])[:, :, 0]
    for cell in (LIVE_CELL, 3.5):
        ours = SpatialFEMResponse(grid, clamps, tissue, cell=cell, radius=1.2)
        u = ours.field_of([ours.column(p[None], np.ones(1)) for p in places], forces)
        text = "  ".join(f"{p}: {share(u(q), fine.at(values, q)):4.2f}" for p, q in planes().items())
        print(f"{name:32} cells {cell:g} mm  {text}  ({fine.size} nodes)", flush=True)


def kinds(**faces):
    return {face: faces.get(face, "clamped" if face in WALLS else "free") for face in SIDES}


def costs():
    grid, _ = block(SIZE, kinds(), (21, 18, 16))
    insertion = SpatialInsertion.straight((-8, 0, -6), (0.46, 0.79, 0.41), 24, 10, dwell=0.5, retract=True)
    sphere = Tissue(10.0, 0.45, [SPHERE])
    layer = Tissue(10.0, 0.45, [LAYER])
    makers = {
        "green": lambda: SpatialForceModel.green(grid, WALLS),
        "green, sphere": lambda: SpatialForceModel.green(grid, WALLS, sphere),
        "green, layers": lambda: SpatialForceModel.green(grid, WALLS, layer),
        "fem": lambda: SpatialForceModel.fem(grid, WALLS),
        "tps": lambda: SpatialLandmarkModel(grid, WALLS, kernel=ThinPlate(3)),
        "elastic": lambda: SpatialLandmarkModel(grid, WALLS, kernel=Elastic(0.45, 2.0, dimension=3)),
    }
    points = planes(65)["z = 0"]
    for name, make in makers.items():
        began = thread_time()
        made = make()
        setup = thread_time() - began
        state, steps, sums = made.rest(), [], []
        for k in range(1, round(insertion.duration * 30) + 1):
            began = thread_time()
            state = made.advance(state, insertion.pose(k / 30), 1 / 30)
            steps.append(1e3 * (thread_time() - began))
            began = thread_time()
            made.field(state)(points)
            sums.append(1e3 * (thread_time() - began))
        print(
            f"{name:16} set-up {setup:5.2f} s   step {np.mean(steps):6.2f} ms, longest {np.max(steps):6.1f}   "
            f"field at {len(points)} points {np.mean(sums):5.2f} ms",
            flush=True,
        )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="without the loads spread over fine elements")
    quick = parser.parse_args().quick
    with threadpool_limits(1):
        print("steps of 1/30 s at 10 mm/s, in, a rest and out")
        costs()
        print(f"\nerrors in %, against closed forms with cells of {FINE} mm")
        for nu in (0.45, 0.49):
            compare(f"green, nu {nu}, top free", kinds(), Tissue(10.0, nu), SpaceResponse)
            compare(f"green, nu {nu}, probe on top", kinds(top="sliding"), Tissue(10.0, nu), SpaceResponse)

        def live(grid, clamps, tissue):
            return SpatialFEMResponse(grid, clamps, tissue, cell=LIVE_CELL)

        for name, region in (("stiff sphere 5x", SPHERE), ("layers 10 / 50 kPa", LAYER)):
            compare(f"green with regions, {name}", kinds(), Tissue(10.0, 0.45, [region]), live, region)
        if not quick:
            print("\nerrors in %, against forces spread over fine elements")
            spread("homogeneous", [], ((), (), ()))
            spread("stiff sphere 5x", [SPHERE], ((), (), ()))
            spread("layers, interface at 13.5 mm", [Region(Layer(13.5, 35.0), 50.0)], ((), (13.5,), ()))


if __name__ == "__main__":
    main()
