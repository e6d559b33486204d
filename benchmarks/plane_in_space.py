"""Pictures of thick tissue: plane elasticity, and the plane of a slab in space, against finer finite elements in space.

    python benchmarks/plane_in_space.py             # about a minute and a half

Pictures of 40 x 35 mm, E 10 kPa, nu 0.45, walls and bottom clamped, the slab's sides too (or sliding). Six needles in the plane under the law that
sticks and slips, 0.4 N at the tip and 0.005 N/mm along the shaft. Errors: mean distance from the elements' displacement in the picture
as a share of its mean displacement, mean over needles (and the worst). Times are processor time of one thread.
"""

from time import thread_time

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.mechanics import NeedleForces, PlaneInSpace, SpatialForceModel
from echospline.scenario import Scenario, build_model
from echospline.scene import Insertion, RegularGrid

GRID = RegularGrid((41, 36), (1.0, 1.0), (-20.0, 0.0))
FINE = 2.75
"""mm; cells of the reference."""
NEEDLES = ((-12, 45, 24), (7, 105, 12), (-8, 60, 20), (0, 90, 18), (10, 135, 22), (-4, 80, 15))
"""Entry, angle and depth; mm and degrees."""
CASES = ((15.0, "clamped"), (30.0, "clamped"), (60.0, "clamped"), (30.0, "sliding"), (30.0, "free"))
MODELS = {
    "plane, green (stress)": ("plane", "green", "stress"),
    "plane, green (strain)": ("plane", "green", "strain"),
    "space, green": ("space", "green", "stress"),
}


def deepest(model, needle):
    """Displacement of the mesh at the end of an insertion, mm, and ms per step."""
    x, angle, depth = needle
    insertion = Insertion.straight((x, 0.0), angle, depth, 10.0, dwell=0.0, retract=False)
    times = np.linspace(0.0, insertion.duration, 41)
    state, began = model.rest(), thread_time()
    for before, now in zip(np.r_[0.0, times[:-1]], times, strict=True):
        state = model.advance(state, insertion.pose(float(now)), float(now - before))
    return model.displacement(state), 1e3 * (thread_time() - began) / len(times)


def scenario(mechanics, kind, plane, thickness, sides):
    return Scenario().with_values({
        "model.kind": kind, "model.mechanics": mechanics, "tissue.young": 10.0, "tissue.thickness": thickness, "tissue.plane": plane,
        "mesh.sides": sides, "model.forces.tip": 0.4, "model.forces.friction_limit": 0.005,
    })  # fmt: skip


def share(u, v):
    return 100 * np.linalg.norm(u - v, axis=1).mean() / np.linalg.norm(v, axis=1).mean()


def main():
    for thickness, sides in CASES:
        made = build_model(scenario("space", "green", "stress", thickness, sides), GRID).model
        held = made.response.clamps
        fine = SpatialForceModel.fem(
            made.grid, held.edges, sliding=held.sliding, forces=NeedleForces(tip=0.4, friction_limit=0.005),
            cell=FINE, radius=made.response.radius,
        )  # fmt: skip
        truth = [deepest(PlaneInSpace(GRID, fine), needle)[0] for needle in NEEDLES]
        for name, (mechanics, kind, plane) in MODELS.items():
            began = thread_time()
            model = build_model(scenario(mechanics, kind, plane, thickness, sides), GRID)
            setup = thread_time() - began
            runs = [deepest(model, needle) for needle in NEEDLES]
            errors = [share(u, v) for (u, _), v in zip(runs, truth, strict=True)]
            print(
                f"{thickness:3g} mm, sides {sides:8} {name:22} {np.mean(errors):6.1f} % (worst {np.max(errors):5.1f})  "
                f"set-up {setup:.2f} s, step {np.mean([ms for _, ms in runs]):5.1f} ms",
                flush=True,
            )


if __name__ == "__main__":
    with threadpool_limits(limits=1):
        main()
