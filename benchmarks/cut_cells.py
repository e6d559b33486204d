"""What rule for elements that a boundary crosses is closest to quadratic elements that follow it.

    python benchmarks/cut_cells.py

Mean distance to the reference (tests/cut_cell_reference.py, triangles of 0.33 mm) as a share of its mean displacement, %: mean and largest of five
needles, on the study's mesh and one twice as fine. The rules: arithmetic mean of the moduli, geometric mean, mean compliance (harmonic), and
the laminate that the package uses.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import numpy as np

from cut_cell_reference import QuadraticPlane, needle
from echospline.mechanics.cut_cells import elements_of
from echospline.mechanics.finite_elements import factor, point_loads, stiffness
from echospline.scene import Circle, Layer, Region, RegularGrid, Tissue

SIZE, BACKGROUND = (40.0, 30.0), 10.0
MESHES = {1: RegularGrid((40, 30), (40 / 39, 30 / 29)), 2: RegularGrid((79, 59), (40 / 78, 30 / 58))}
NEEDLES = (
    ((12.0, 0.0), 60.0, 22.0), ((12.0, 0.0), 60.0, 20.0), ((26.0, 0.0), 115.0, 22.0), ((20.0, 0.0), 90.0, 20.0), ((6.0, 0.0), 45.0, 24.0),
)  # fmt: skip
SCENES = (
    ("lesion 0.1x, r 5 mm at (24, 15)", Circle((24.0, 15.0), 5.0), 1.0, 1 / 3),
    ("lesion 0.1x, r 5 mm at (23, 19)", Circle((23.0, 19.0), 5.0), 1.0, 1 / 3),
    ("lesion 0.2x, r 6 mm at (24, 17)", Circle((24.0, 17.0), 6.0), 2.0, 1 / 3),
    ("lesion 5x, r 6 mm at (24, 17)", Circle((24.0, 17.0), 6.0), 50.0, 1 / 3),
    ("lesion 5x, r 5 mm at (20, 15)", Circle((20.0, 15.0), 5.0), 50.0, 1 / 3),
    ("layer 5x, 10.4 to 18 mm", Layer(10.4, 18.0), 50.0, 0.4),
    ("layer 0.2x, 10.4 to 18 mm", Layer(10.4, 18.0), 2.0, 0.4),
    ("5x below 12 mm", Layer(12.0, 31.0), 50.0, 1 / 3),
)


def main() -> None:
    for name, shape, young, size in SCENES:
        tissue = Tissue(BACKGROUND, regions=[Region(shape, young)])
        circles = [(shape.centre, shape.radius)] if isinstance(shape, Circle) else []
        reference = QuadraticPlane(SIZE, size, circles, lambda p, t=tissue: t.at(p)[0], _held)
        truths = [reference.solve(*needle(*each), MESHES[1].nodes) for each in NEEDLES]
        print(name)
        for fine, grid in MESHES.items():
            pick = np.arange(grid.size).reshape(grid.shape[::-1])[::fine, ::fine].ravel()
            shares = []
            for rule in ("arithmetic", "geometric", "harmonic", "laminate"):
                solver = factor(_stiffness(tissue, grid, rule), grid.boundary(("left", "right", "bottom")))
                errors = []
                for each, truth in zip(NEEDLES, truths, strict=True):
                    u = solver.solve(point_loads(grid, *needle(*each)))[pick]
                    errors.append(100 * np.hypot(*(u - truth).T).mean() / np.hypot(*truth.T).mean())
                shares.append(f"{rule} {np.mean(errors):.2f} / {np.max(errors):.2f}")
            print(f"  {grid.shape[0]} x {grid.shape[1]}: {', '.join(shares)}", flush=True)


def _stiffness(tissue: Tissue, grid: RegularGrid, rule: str):
    made = elements_of(tissue, grid)
    if rule == "laminate":
        return stiffness(grid, made.young, made.poisson, tissue.thickness, excess=made[2:])
    E, nu = tissue.sampled(grid, np.arange(len(made.young)), 16)
    mean = {
        "arithmetic": E.mean(axis=1),
        "geometric": np.exp(np.log(E).mean(axis=1)),
        "harmonic": 1 / (1 / E).mean(axis=1),
    }
    return stiffness(grid, mean[rule], nu.mean(axis=1), tissue.thickness)


def _held(p: np.ndarray) -> np.ndarray:
    on = (np.abs(p[:, 0] * (p[:, 0] - SIZE[0])) < 1e-6) | (np.abs(p[:, 1] - SIZE[1]) < 1e-9)
    return np.stack([on, on], axis=1)


if __name__ == "__main__":
    main()
