"""Time of one needle step against mesh nodes (the paper's Fig. 3b), with every method named.

One process, one thread, one machine, one scene; the methods take turns at each mesh, so that ratios are of one run.
Wall-clock and processor time are both kept: they agree on an idle machine, and on a busy one the wall clock includes
other processes, so savings are of processor time.
A step is the work between two poses of the needle: from the pose to the displacement of all nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from echospline.mechanics import (
    Elastic,
    FEMModel,
    GreenModel,
    Kernel,
    Solver,
    ThinPlate,
    TPSModel,
    TPSParameters,
    ViscousForces,
)
from echospline.mechanics.finite_elements import Method as Factorisation
from echospline.mechanics.finite_elements import factor, stiffness
from echospline.mechanics.native import Precision
from echospline.mechanics.protocol import TissueModel
from echospline.scene import Floats, Insertion, NeedlePose, RegularGrid
from echospline.study.accuracy import CLAMPED, FITTED, SIZE, SPEED

Step = Callable[[NeedlePose], Floats]
Build = Callable[[RegularGrid, Sequence[NeedlePose]], Step]

FORCES = ViscousForces(0.4, 1e-8, ramp=0.0)
LANDMARKS = TPSParameters(loading="immediate", drag=0.0, tip="point")
"""Landmarks represent tissue, not pixels: they are about 1.25 mm apart on every mesh."""


@dataclass(frozen=True)
class Method:
    """One way to take a step.

    Parameters
    ----------
    name : str
        Name in tables and figures.
    family : {"fem", "tps", "green"}
        Family of the model.
    build : callable
        Set-up for one mesh; returns the step.
    most_nodes : int
        Larger meshes are left out: a step would take minutes.
    paper : bool
        Whether the paper itself describes this method.
    """

    name: str
    family: str
    build: Build
    most_nodes: int = 10**9
    paper: bool = False


def _stepped(model: TissueModel[Any]) -> Step:
    state = model.rest()

    def step(pose: NeedlePose) -> Floats:
        nonlocal state
        state = model.advance(state, pose, 0.1)
        return model.displacement(state)

    return step


def _fem_anew(factorisation: Factorisation) -> Build:
    def build(grid: RegularGrid, _: Sequence[NeedlePose]) -> Step:
        model = FEMModel(grid, CLAMPED, forces=FORCES)
        young, poisson = model.tissue.in_cells(grid)

        def step(pose: NeedlePose) -> Floats:
            K = stiffness(grid, young, poisson, model.tissue.thickness)
            loads = model.friction_loads(pose) + model.tip_loads(pose, FORCES.tip)
            return factor(K, model.clamped, factorisation).solve(loads)

        return step

    return build


def _fem_factored(grid: RegularGrid, _: Sequence[NeedlePose]) -> Step:
    return _stepped(FEMModel(grid, CLAMPED, forces=FORCES))


def _fem_compliance(grid: RegularGrid, poses: Sequence[NeedlePose]) -> Step:
    model = FEMModel(grid, CLAMPED, forces=FORCES)

    def loads(pose: NeedlePose) -> Floats:
        return model.friction_loads(pose) + model.tip_loads(pose, FORCES.tip)

    touched = np.any([loads(pose).any(axis=1) for pose in poses], axis=0)
    columns = model.factored.compliance(np.flatnonzero(touched))
    return lambda pose: columns.solve(loads(pose))


def _tps(kernel: Kernel, solver: Solver, precision: Precision = "single") -> Build:
    def build(grid: RegularGrid, _: Sequence[NeedlePose]) -> Step:
        return _stepped(TPSModel(grid, CLAMPED, LANDMARKS, kernel, solver=solver, precision=precision))

    return build


def _green(grid: RegularGrid, _: Sequence[NeedlePose]) -> Step:
    return _stepped(GreenModel(grid, CLAMPED, forces=FORCES))


def _literal(grid: RegularGrid, _: Sequence[NeedlePose]) -> Step:
    """Build Algorithm 1 as printed: every node is a source, K and L built and L inverted at each step."""
    nodes = grid.nodes

    def step(pose: NeedlePose) -> Floats:
        targets = nodes.copy()
        distance = pose.closest(nodes)[1]
        targets[distance <= LANDMARKS.delta] += 0.1 * np.array(pose.axis)
        squared = ((nodes[:, None, :] - nodes[None, :, :]) ** 2).sum(axis=-1)
        K = squared * np.log(squared, out=np.zeros_like(squared), where=squared > 0)
        R = np.column_stack([np.ones(len(nodes)), nodes])
        L = np.block([[K, R], [R.T, np.zeros((3, 3))]])
        weights = np.linalg.inv(L) @ np.vstack([targets, np.zeros((3, 2))])
        moved: Floats = K @ weights[:-3] + R @ weights[-3:] - nodes
        return moved

    return step


METHODS = (
    Method("FEM, assembled and solved per step (SuperLU)", "fem", _fem_anew("superlu"), paper=True),
    Method("FEM, assembled and solved per step (CHOLMOD)", "fem", _fem_anew("cholmod")),
    Method("FEM, factored once", "fem", _fem_factored),
    Method("FEM, compliance columns", "fem", _fem_compliance, 20_000),
    Method("TPS, literal: all nodes sources, L inverted per step", "tps", _literal, 5_000, paper=True),
    Method("TPS, landmarks, refitted per step", "tps", _tps(ThinPlate(), "refit")),
    Method("TPS, landmarks, fast path", "tps", _tps(ThinPlate(), "response")),
    Method("TPS, landmarks, fast path in double precision", "tps", _tps(ThinPlate(), "response", "double")),
    Method("TPS, elastic kernel, refitted per step", "tps", _tps(Elastic(), "refit")),
    Method("TPS, elastic kernel, fast path", "tps", _tps(Elastic(), "response")),
    Method("Green's function", "green", _green),
)


def mesh_of(nodes: int) -> RegularGrid:
    """Return the mesh of the study's scene with about this many nodes, its cells nearly square."""
    nx = max(4, round((nodes * SIZE[0] / SIZE[1]) ** 0.5))
    ny = max(3, round(nodes / nx))
    return RegularGrid((nx, ny), (SIZE[0] / (nx - 1), SIZE[1] / (ny - 1)))


def speed(
    node_counts: Sequence[int],
    *,
    seconds: float = 2.0,
    literal_nodes: int = 5_000,
    report: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Time every method on every mesh.

    Parameters
    ----------
    node_counts : sequence of int
        Approximate numbers of nodes.
    seconds : float
        Budget per method and mesh after warm-up; 3 steps at least, 400 at most.
    literal_nodes : int
        Largest mesh for the literal algorithm, whose inverse grows with the cube.
    report : callable, optional
        Called with the name of the next measurement.

    Returns
    -------
    list of dict
        One row per method and mesh: ``method``, ``family``, ``nodes``, ``median_ms``, ``p99_ms``, ``cpu_median_ms``,
        ``setup_ms``, ``threads``, ``steps``.
    """
    insertion = Insertion.straight(FITTED[0], FITTED[1], FITTED[2], SPEED)
    poses = [insertion.pose(float(t)) for t in np.linspace(0.0, insertion.duration, 51)[1:]]
    rows = []
    with threadpool_limits(limits=1):
        for count in node_counts:
            grid = mesh_of(count)
            for method in METHODS:
                limit = (
                    min(method.most_nodes, literal_nodes) if method.build is _literal else method.most_nodes
                )
                if grid.size > limit:
                    continue
                if report is not None:
                    report(f"{method.name}, {grid.size} nodes")
                rows.append(_timed(method, grid, poses, seconds))
    return rows


def _timed(method: Method, grid: RegularGrid, poses: Sequence[NeedlePose], seconds: float) -> dict[str, Any]:
    began = perf_counter()
    step = method.build(grid, poses)
    setup = perf_counter() - began
    # One whole insertion warms caches up, if it is quick; then insertion after insertion.
    began = perf_counter()
    for pose in poses:
        step(pose)
        if perf_counter() - began > seconds:
            break
    step = method.build(grid, poses)
    times: list[float] = []
    busy: list[float] = []
    began = perf_counter()
    while len(times) < 400 and (len(times) < 3 or perf_counter() - began < seconds):
        if times and len(times) % len(poses) == 0:
            step = method.build(grid, poses)
            began += times[-1]  # building again is not part of the budget
        pose = poses[len(times) % len(poses)]
        start, at_work = perf_counter(), thread_time()
        step(pose)
        busy.append(thread_time() - at_work)
        times.append(perf_counter() - start)
    return {
        "method": method.name,
        "family": method.family,
        "paper": method.paper,
        "nodes": grid.size,
        "mesh": f"{grid.shape[0]} x {grid.shape[1]}",
        "median_ms": 1e3 * float(np.median(times)),
        "p99_ms": 1e3 * float(np.percentile(times, 99)),
        "cpu_median_ms": 1e3 * float(np.median(busy)),
        "setup_ms": 1e3 * setup,
        "threads": 1,
        "steps": len(times),
    }


def savings(rows: Sequence[dict[str, Any]], low: int = 450, high: int = 5_000) -> list[dict[str, Any]]:
    """Return the processor time that each TPS (and Green) method saves against each FEM method, %, mean over meshes of ``low`` to ``high``.

    The paper's claim is 51.8 % for one such pair.
    """
    out = []
    for fast in (m for m in METHODS if m.family != "fem"):
        for fem in (m for m in METHODS if m.family == "fem"):
            saved = []
            for row in rows:
                if row["method"] != fast.name or not low <= row["nodes"] <= high:
                    continue
                beside = [r for r in rows if r["method"] == fem.name and r["nodes"] == row["nodes"]]
                saved += [100.0 * (1.0 - row["cpu_median_ms"] / r["cpu_median_ms"]) for r in beside]
            if saved:
                out.append(
                    {
                        "method": fast.name,
                        "against": fem.name,
                        "mean_saving_percent": float(np.mean(saved)),
                        "least_saving_percent": float(np.min(saved)),
                        "meshes": len(saved),
                    }
                )
    return out
