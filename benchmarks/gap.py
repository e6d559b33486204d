"""What was tried to close the gap between landmark splines and finite elements.

    python benchmarks/gap.py

Each line: mean distance to FEM as a share of the mean FEM displacement, %, on the fitted insertion and on three held-out
ones (the study's scene, 1200 nodes, 10 kPa, tip force 0.4 N). One parameter set for all depths. Linear amplitudes are
solved for by least distances; everything else stands in the line.
"""

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.mechanics import AnchoredKernel, Clamps, Elastic, FEMModel, ThinPlate
from echospline.mechanics.green_response import green_response
from echospline.scene import Tissue, distance, field_error
from echospline.study.accuracy import CLAMPED, FITTED, HELD_OUT, Case, observe, oracle
from echospline.study.identify import _least

CASE = Case(steps=20)
GRID = CASE.grid
NODES = GRID.nodes


class Displaced:
    """Landmarks displaced along the axis: contacts within delta, and the tip; G of a spline kernel."""

    def __init__(self, kernel, anchor_spacing=1.5, every=1, margin=0.0):
        anchors = Clamps.of(GRID, CLAMPED).anchors(anchor_spacing)
        if margin:  # the same anchors, moved outwards
            centre = np.array([20.0, 0.0])
            anchors = centre + (anchors - centre) * (1 + margin / 20)
        self.scene = AnchoredKernel.factor(kernel, anchors, NODES)
        inside = np.setdiff1d(np.arange(GRID.size), GRID.boundary(CLAMPED))
        iy, ix = np.divmod(inside, GRID.shape[0])
        self.free = inside[(ix % every == 0) & (iy % every == 0)]

    def fields(self, pose, delta, law):
        """Field per column of ``law(distance, share of depth)`` at contacts, and of the tip, (n, 2, p)."""
        points, axis = NODES[self.free], np.array(pose.axis)
        d = pose.closest(points)[1]
        along = (points - pose.entry) @ axis
        on = (d <= delta) & (along <= pose.depth - 0.25) & (np.hypot(*(points - pose.tip).T) > 0.3)
        contact = law(d[on], along[on] / pose.depth)
        places = np.vstack([points[on], pose.tip])
        amplitude = np.zeros((len(places), contact.shape[1] + 1))
        amplitude[:-1, :-1], amplitude[-1, -1] = contact, 1.0
        return self.displaced(places, axis, amplitude)

    def displaced(self, places, axis, amplitude):
        x, c = self.scene.conditioned(places), self.scene.components
        right = amplitude if c == 1 else np.repeat(amplitude, 2, axis=0) * np.tile(axis, len(places))[:, None]
        field = self.scene.rows(x).T @ np.linalg.solve(self.scene.between(x, x), right)
        return (
            field[:, None, :] * axis[:, None]
            if c == 1
            else field.reshape(2, len(NODES), -1).transpose(1, 0, 2)
        )

    def loaded(self, pose):
        """Field of a weight at the tip that does not change with depth: a force, for an elastic kernel."""
        axis, x = np.array(pose.axis), self.scene.conditioned(np.array([pose.tip]))
        field = self.scene.rows(x).T
        return (
            (field[:, None, :] * axis[:, None])
            if field.shape[1] == 1
            else (field @ axis).reshape(2, -1, 1).transpose(1, 0, 2)
        )


class Green:
    """Point forces in clamped elastic tissue under a free or a sliding top."""

    def __init__(self, sliding, radius):
        self.response = green_response(
            GRID, Clamps.of(GRID, CLAMPED, None, sliding), Tissue(10.0), radius=radius
        )

    def fields(self, pose, force):
        place = np.array([pose.tip])
        return self.response.answer(place, np.reshape(force, (1, 2, 1)), place)

    def loaded(self, pose):
        return self.fields(pose, pose.axis)[0]

    def displaced(self, pose):
        own = np.column_stack([self.fields(pose, unit)[1][0, :, 0] for unit in np.eye(2)])
        return self.fields(pose, np.linalg.solve(own, np.array(pose.axis)))[0]


def paper(length):
    return lambda d, s: np.stack([np.ones_like(d), 1 / (1 + np.exp(d / length))], axis=1)


def profiled(length):
    return lambda d, s: np.stack(
        [w * s**k for w in (np.ones_like(d), 1 / (1 + np.exp(d / length))) for k in (0, 1, 2)], axis=1
    )


def main():
    fem = FEMModel(GRID, CLAMPED, CASE.tissue, CASE.forces)
    fitted = observe(fem, *CASE.poses(FITTED)).frames(np.arange(1, CASE.steps + 1))
    held = [observe(fem, *CASE.poses(t)).frames(np.arange(1, CASE.steps + 1)) for t in HELD_OUT]

    def report(name, fields):
        A = np.array([fields(pose) for pose in fitted.poses])
        seen = distance(fitted.displacement, 0 * fitted.displacement) > 1e-9
        x = _least(A[seen], fitted.displacement[seen], np.ones(int(seen.sum())), "mae", 1e-6, 1e-8)
        others = np.concatenate([np.array([fields(pose) for pose in o.poses]) @ x for o in held])
        truth = np.concatenate([o.displacement for o in held])
        print(
            f"{name:78s} {field_error(A @ x, fitted.displacement).mae_percent:6.1f} {field_error(others, truth).mae_percent:6.1f}",
            flush=True,
        )

    print(f"{'':78s} fitted held out")
    for label, kernel in (("thin plate", ThinPlate()), ("elastic, radius 1 mm", Elastic(0.45, 1.0))):
        spline = Displaced(kernel)
        for delta, length in ((1.1, 1.0), (2.1, 5.0)):
            report(
                f"{label}: law (12)-(15), delta {delta}, length {length}",
                lambda p, s=spline, d=delta, e=length: s.fields(p, d, paper(e)),
            )
        report(
            f"{label}: + quadratic profile of friction along the shaft",
            lambda p, s=spline: s.fields(p, 2.1, profiled(5.0)),
        )
        report(f"{label}: tip alone, displaced", lambda p, s=spline: s.fields(p, -1.0, paper(1.0))[..., 2:])
        report(f"{label}: tip alone, weight instead of displacement", spline.loaded)
        for spacing in (0.75, 4.0):
            other = Displaced(kernel, anchor_spacing=spacing)
            report(
                f"{label}: law, anchors {spacing} mm apart", lambda p, s=other: s.fields(p, 2.1, paper(5.0))
            )
        outward = Displaced(kernel, margin=3.0)
        report(f"{label}: law, anchors 3 mm further out", lambda p, s=outward: s.fields(p, 2.1, paper(5.0)))
        for every in (2, 3):
            thin = Displaced(kernel, every=every)
            report(
                f"{label}: law, one node in {every} each way a contact",
                lambda p, s=thin, k=every: s.fields(p, 2.1 * k, paper(5.0)),
            )
        bound = [field_error(oracle(GRID, o, kernel), o.displacement).mae_percent for o in (fitted, *held)]
        print(
            f"{label + ': oracle landmarks (the bound of any law)':78s} {bound[0]:6.1f} {np.mean(bound[1:]):6.1f}",
            flush=True,
        )
    for radius in (0.25, 0.5, 2.0):
        spline = Displaced(Elastic(0.45, radius))
        report(
            f"elastic, radius {radius} mm: law, delta 2.1, length 5",
            lambda p, s=spline: s.fields(p, 2.1, paper(5.0)),
        )
    for label, sliding in (("sliding top", ("top",)), ("free top", ())):
        for radius in (0.4, 1.0):
            green = Green(sliding, radius)
            report(f"Green's function, {label}, radius {radius} mm: tip displaced", green.displaced)
            report(f"Green's function, {label}, radius {radius} mm: tip force", green.loaded)


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
