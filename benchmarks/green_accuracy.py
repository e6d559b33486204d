"""Green's function against quadratic finite elements on unseen insertions: every combination of edges, and tissue with regions.

    python benchmarks/green_accuracy.py              # the tables of docs/fem.md, about 15 minutes
    python benchmarks/green_accuracy.py --regions    # the tables without the combinations of edges
    python benchmarks/green_accuracy.py --random 60  # random scenes: residual beside error

40 x 30 mm, 40 mm thick, mesh of 40 x 30 nodes, E 10 kPa, nu 0.45, plane stress unless said; 0.4 N at the tip and 0.005 N/mm along the
shaft; 36 poses of six needles. Truth: quadratic triangles of scikit-fem, 0.33 mm (`tests/quadratic_reference.py`). Errors: mean distance
as a share of the mean displacement of all poses, and of the worst pose. Set-up is processor time of one thread.
"""

import argparse
import sys
from functools import lru_cache
from itertools import product
from pathlib import Path
from time import thread_time

import numpy as np
from threadpoolctl import threadpool_limits

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from echospline.errors import InputError
from echospline.mechanics import Clamps
from echospline.mechanics.green_response import green_response
from echospline.scene import Circle, Label, Layer, Polygon, Region, RegularGrid, Tissue
from quadratic_reference import errors, needle, quadratic

GRID = RegularGrid((40, 30), (40 / 39, 30 / 29))
FINE = 1 / 3
NEEDLES = (
    ((8, 0), 35, 26),
    ((27, 0), 105, 22),
    ((19.5, 0), 80, 20),
    ((20, 0), 90, 25),
    ((33, 0), 130, 26),
    ((12, 0), 60, 24),
)
POSES = [needle(entry, angle, d) for entry, angle, depth in NEEDLES for d in np.linspace(depth / 6, depth, 6)]
BOX = ("left", "right", "bottom")


def labels():
    """A wavy border at 14 mm with a soft lesion above it, 200 x 150 pixels."""
    pixels = RegularGrid((200, 150), (40 / 199, 30 / 149))
    x, y = pixels.nodes.T
    image = np.where(y > 14 + 2 * np.sin(x / 5), 1, 0)
    image[np.hypot(x - 15, y - 9) < 3.5] = 2
    image = image.reshape(150, 200)
    return [Region(Label(image, pixels, 1), 40.0), Region(Label(image, pixels, 2), 3.0)]


STIFF, SOFT = Region(Circle((24, 17), 6), 50.0), Region(Circle((24, 17), 6), 2.0)
OUTLINE = Polygon(((16, 10), (30, 12), (31, 22), (22, 26), (15, 20)))
SCENES = {
    "lesion 5x": [STIFF],
    "lesion 0.2x": [SOFT],
    "layers 10 / 50 kPa at 10 mm": [Region(Layer(10, 99), 50.0)],
    "layers 10 / 2 kPa at 12 mm": [Region(Layer(12, 99), 2.0)],
    "lesions 5x and 0.2x": [STIFF, Region(Circle((12, 14), 3), 2.0)],
    "polygon 5x": [Region(OUTLINE, 50.0)],
    "polygon 0.2x": [Region(OUTLINE, 2.0)],
    "labels image 1 : 4 : 0.3": labels(),
    "lesion 0.1x, 5 mm": [Region(Circle((24, 17), 5), 1.0)],
}


@lru_cache(maxsize=2)
def stiffness(scene, poisson, plane):
    model = quadratic(GRID.extent, FINE)
    E, nu = Tissue(10.0, poisson, SCENES.get(scene, ())).at(model.centres)
    loads = np.stack([model.loads(*pose) for pose in POSES], axis=1)
    return model, model.stiffness(E, nu, 40.0, plane), loads, model.probes(GRID.nodes)


def compare(scene, clamped, sliding, poisson=0.45, plane="stress", method="auto"):
    """Error (mean, worst) in %, the response, set-up in ms."""
    tissue = Tissue(10.0, poisson, SCENES.get(scene, ()), plane=plane)
    clamps = Clamps.of(GRID, clamped, None, sliding)
    model, K, loads, probes = stiffness(scene, poisson, plane)
    true = (probes @ model.solver(K, clamped, sliding)(loads)).T.reshape(len(POSES), -1, 2)
    took = []
    for _ in range(3):
        start = thread_time()
        response = green_response(GRID, clamps, tissue, method=method)
        took.append(thread_time() - start)
    found = [response.answer(s, F[:, :, None], s[:0])[0][:, :, 0] for s, F in POSES]
    return errors(found, true), response, 1e3 * min(took)


def row(name, *args, **kind):
    error, response, took = compare(*args, **kind)
    residual = getattr(response.solver, "residual", None)
    told = f"{100 * residual.mean:.2f}" if residual else "-"
    print(
        f"| {name} | {response.method} | {error[0]:.2f} / {error[1]:.2f} | {told} | {took:.0f} |", flush=True
    )
    return error


def edges():
    """Every combination of clamped, sliding and free edges that holds the tissue, but for mirrored ones."""
    for left, right, top, bottom in product(("clamped", "sliding", "free"), repeat=4):
        if left > right:
            continue
        kinds = {"left": left, "right": right, "top": top, "bottom": bottom}
        clamped, sliding = (
            tuple(e for e, k in kinds.items() if k == kind) for kind in ("clamped", "sliding")
        )
        try:
            Clamps.of(GRID, clamped, None, sliding)
        except InputError:
            continue
        yield kinds, clamped, sliding


def homogeneous():
    for plane, poisson in (("stress", 0.45), ("strain", 0.49)):
        print(
            f"\n| left, right, top, bottom; plane {plane}, nu {poisson} | method | error / worst pose % | residual % | set-up ms |"
        )
        print("|---|---|---|---|---|")
        every = [
            row(", ".join(kinds.values()), None, clamped, sliding, poisson, plane)
            for kinds, clamped, sliding in edges()
        ]
        print(
            f"{len(every)} combinations: largest error {max(e[0] for e in every):.2f} %, worst pose {max(e[1] for e in every):.2f} %"
        )


def regions():
    print("\n| tissue; edges | method | error / worst pose % | residual % | set-up ms |")
    print("|---|---|---|---|---|")
    for name in SCENES:
        for clamped, sliding in ((BOX, ()), (BOX, ("top",)), (("bottom",), ("top",))):
            row(
                f"{name}; {', '.join(clamped)} clamped{', top sliding' * bool(sliding)}",
                name,
                clamped,
                sliding,
            )
    for name in list(SCENES)[:5]:
        row(f"{name}, solved; {', '.join(BOX)} clamped", name, BOX, (), method="solve")
    row("homogeneous, solved; left, right, bottom clamped", None, BOX, (), method="solve")


def random_scenes(count, seed=1):
    """Random layers, lesions and edges: the residual of the closed forms beside their distance to the live solve."""
    rng, kinds = np.random.default_rng(seed), np.array(["clamped", "sliding", "free"])
    over = 0
    while count:
        x, y = rng.uniform(15, 80), rng.uniform(15, 60)
        grid = RegularGrid((40, 30), (x / 39, y / 29))
        kind = dict(zip(("left", "right", "top", "bottom"), rng.choice(kinds, 4), strict=True))
        modulus = lambda: 10 * np.exp(rng.uniform(-2.3, 2.3))  # noqa: E731
        places = [
            *(Layer(a, a + rng.choice([99, rng.uniform(1, 8)])) for a in rng.uniform(0, y, rng.integers(3))),
            *(
                Circle((rng.uniform(0, x), rng.uniform(0, y)), rng.uniform(1, 8))
                for _ in range(rng.integers(3))
            ),
        ]
        plane = str(rng.choice(["stress", "strain"]))
        tissue = Tissue(
            10.0,
            rng.uniform(0.3, 0.49),
            [Region(s, modulus(), rng.uniform(0.3, 0.49)) for s in places],
            plane=plane,
        )
        held = [[e for e in kind if kind[e] == k] for k in ("clamped", "sliding")]
        try:
            clamps = Clamps.of(grid, held[0], None, held[1])
            found = green_response(
                grid, clamps, tissue, method="boundary" if tissue.homogeneous else "regions"
            )
        except InputError:
            continue
        solved = green_response(grid, clamps, tissue, method="solve")
        s = rng.uniform((0, 1), (x, y), (60, 2))
        s = s[found.solver.clearance(s) >= found.clearance][:12]
        if not len(s):
            continue
        count -= 1
        angle = rng.uniform(0, 2 * np.pi, len(s))
        F = np.eye(len(s))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, :, None]
        u, v = (m.answer(s, F, s[:0])[0].transpose(2, 0, 1) for m in (found, solved))
        error, residual = errors(u, v), 100 * found.solver.residual.mean
        over += residual <= 1 and error[0] > 1.5
        print(
            f"residual {residual:6.2f} %, error {error[0]:6.2f} / {error[1]:6.2f} %, {x:.0f} x {y:.0f} mm, {kind}, {len(places)} regions",
            flush=True,
        )
    print(f"residual up to 1 %, error above 1.5 %: {over}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--regions", action="store_true", help="leave the combinations of edges out")
    parser.add_argument(
        "--random", type=int, default=0, metavar="N", help="N random scenes instead of the tables"
    )
    given = parser.parse_args()
    with threadpool_limits(1):
        if given.random:
            random_scenes(given.random)
        else:
            regions()
            if not given.regions:
                homogeneous()
