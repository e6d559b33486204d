"""One step of the tissue against its limit, finite elements and other libraries, in one run on one machine.

    python benchmarks/steps.py [--peers PYTHON] [--repeats 5] [--out out/steps]

PYTHON is the interpreter of an environment with requirements-peers.txt; without it the libraries are left out. Writes
steps.json (every repeat, versions, machine), nodes.svg and landmarks.svg, and prints a table of ratios: minimum, median and
maximum over the repeats. The methods take turns in each repeat, so a busy neighbour meets all of them.
"""

import argparse
import json
import os
import platform
import subprocess
import tempfile
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import numpy as np
from matplotlib.figure import Figure

from echospline.mechanics import Elastic, ThinPlate, TPSModel, TPSParameters, describe_core
from echospline.mechanics.finite_elements import factor, stiffness
from echospline.scene import RegularGrid
from echospline.study.bench import PERIODS, bare_product, path, time_steps

MESHES = [(26, 20), (40, 30), (78, 58), (140, 104)]
DEPTHS = [(78, 58, depth) for depth in (4, 8, 16, 26)]
LANDMARKS = TPSParameters(delta=1.1, contact_spacing=1.0)


def median_time(call, repeats=25):
    times = np.empty(repeats)
    call()
    for i in range(repeats):
        begin = perf_counter()
        call()
        times[i] = perf_counter() - begin
    return float(np.median(times))


def own(shape, kernel, depth):
    """Seconds of steps, of those that change contacts, and of the limit; and the scene as it ends."""
    grid = RegularGrid(shape, (40 / (shape[0] - 1), 30 / (shape[1] - 1)))
    begin = perf_counter()
    model = TPSModel(grid, parameters=LANDMARKS, kernel=kernel)
    setup = perf_counter() - begin
    poses = list(path(depth=depth))
    in_python, landmarks = time_steps(model, poses)
    times, changed = model.native.time_steps(poses, PERIODS["1 kHz"])
    slow, _ = model.native.time_steps(list(path(PERIODS["60 Hz"], depth)), PERIODS["60 Hz"])
    late = np.arange(len(times)) > 0.75 * len(times)
    changes = times[late & changed]
    row = {
        "setup": setup,
        "step": float(np.median(times[late & ~changed])),  # from pose to mesh, no contact joins or leaves
        "step, mean": float(np.mean(times[late])),
        "step at 60 Hz": float(np.median(slow[len(slow) * 3 // 4 :])),
        "contacts change": float(np.median(changes)) if len(changes) else None,
        "step from Python": float(np.median(in_python[late])),
        "limit": bare_product(model.grid.size, landmarks, kernel.components),
    }
    return model, poses, landmarks, row


def last_state(model, poses):
    state = model.rest()
    for pose in poses[::20]:
        state = model.advance(state, pose, 0.02)
    return state


def finite_elements(grid, nodes):
    """Seconds of back-substitution after one factorisation, and of compliance columns in single precision."""
    begin = perf_counter()
    K = stiffness(grid, np.full((grid.shape[0] - 1) * (grid.shape[1] - 1), 10.0), 0.45, 10.0)
    factored = factor(K, grid.boundary(("left", "right", "bottom")))
    setup = perf_counter() - begin
    loads = np.zeros((grid.size, 2))
    loads[nodes] = 0.01
    rhs = loads.reshape(-1)[factored.free]
    solve = median_time(lambda: factored._solve(rhs[:, None]))
    begin = perf_counter()
    columns = factored.compliance(nodes).columns
    columns_setup = perf_counter() - begin
    T = np.ascontiguousarray(columns.T, dtype=np.float32)
    w, out = np.full((1, len(T)), 0.01, np.float32), np.empty((1, T.shape[1]), np.float32)
    product = median_time(lambda: np.dot(w, T, out=out), 200)
    return {
        "FEM factored once": solve,
        "FEM factored once, set-up": setup,
        "FEM compliance columns": product,
        "FEM compliance columns, set-up": setup + columns_setup,
        "FEM compliance columns, bytes": int(T.nbytes),
    }


def peers(python, model, state, landmarks):
    """Seconds of other libraries for the landmarks of a state."""
    spline = model.spline(state)
    moves = spline(spline.landmarks)
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.npz"
        np.savez(
            scene,
            nodes=model.grid.nodes,
            landmarks=spline.landmarks,
            moves=moves,
            exact=spline(model.grid.nodes),
        )
        here = Path(__file__).with_name("peers.py")
        done = subprocess.run([python, here, scene, "3"], capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def refit(model, poses):
    """Seconds of one step that factors L anew, the reference solver."""
    slow = TPSModel(model.grid, parameters=LANDMARKS, kernel=model.kernel, solver="refit")
    state = slow.rest()
    for pose in poses[::50]:
        state = slow.advance(state, pose, 0.05)
    return median_time(lambda: slow.displacement(slow.advance(state, poses[-1], 1e-3)), 3)


def measure(shape, kernel, depth, python):
    model, poses, landmarks, row = own(shape, kernel, depth)
    state = last_state(model, poses)
    row |= {
        "kernel": type(kernel).__name__,
        "nodes": model.grid.size,
        "landmarks": landmarks,
        "anchors": len(model.anchors),
    }
    row |= finite_elements(model.grid, model.landmarks(state).contacts)
    row["refit"] = refit(model, poses)
    if python and isinstance(kernel, ThinPlate):
        row["peers"] = peers(python, model, state, landmarks)
    return row


def ratios(rows, over, under):
    values = [r[over] / r[under] for r in rows if r.get(over) and r.get(under)]
    return (min(values), float(np.median(values)), max(values)) if values else None


def table(results):
    for key in sorted({(r["kernel"], r["nodes"], r["landmarks"]) for r in results}):
        rows = [r for r in results if (r["kernel"], r["nodes"], r["landmarks"]) == key]
        for r in rows:
            for name, peer in r.get("peers", {}).items():
                if "seconds" in peer:
                    r[name] = float(np.median(peer["seconds"]))
        print(f"\n{key[0]}, {key[1]} nodes, {key[2]} moving landmarks, {rows[0]['anchors']} anchors")
        for name in (
            "limit", "step", "step, mean", "step at 60 Hz", "contacts change", "step from Python", "setup", "refit",
        ):  # fmt: skip
            values = [1000 * r[name] for r in rows if r[name]]
            if values:
                print(f"  {name:32} {min(values):9.4f} {np.median(values):9.4f} {max(values):9.4f} ms")
        pairs = [
            ("step", "limit"),
            ("step, mean", "limit"),
            ("contacts change", "step"),
            ("step at 60 Hz", "limit"),
            ("step from Python", "step"),
        ]
        pairs += [
            (n, "step") for n in rows[0] if n.startswith("FEM") and "set-up" not in n and "bytes" not in n
        ]
        pairs += [("refit", "step")] + [(n, "step") for n in rows[0].get("peers", {})]
        for over, under in pairs:
            got = ratios(rows, over, under)
            if got:
                print(f"  {over + ' / ' + under:32} {got[0]:9.2f} {got[1]:9.2f} {got[2]:9.2f} x")


def figure(results, along, file):
    """Time of a step against nodes or landmarks: own in solid lines, finite elements dashed, libraries dotted."""
    fig = Figure(figsize=(8, 4.5), layout="constrained")
    axes = fig.subplots()
    styles = {
        "limit": ("black", "-"),
        "step": ("tab:blue", "-"),
        "contacts change": ("tab:cyan", "-"),
        "refit": ("tab:green", "-"),
        "FEM compliance columns": ("tab:orange", "--"),
        "FEM factored once": ("tab:red", "--"),
        "SciPy RBFInterpolator": ("tab:purple", ":"),
        "OpenCV": ("tab:brown", ":"),
        "scikit-image": ("tab:pink", ":"),
        "VTK": ("tab:gray", ":"),
        "ITK": ("tab:olive", ":"),
    }
    for name, (colour, line) in styles.items():
        points = {}
        for r in results:
            if r.get(name):
                points.setdefault(r[along], []).append(1000 * r[name])
        if len(points) > 1:
            x = sorted(points)
            axes.plot(
                x, [np.median(points[v]) for v in x], line, color=colour, marker="o", markersize=4, label=name
            )
    axes.set(xscale="log", yscale="log", xlabel=f"{along}", ylabel="one step, ms (median)")
    axes.grid(alpha=0.3, which="both")
    fig.legend(fontsize=8, loc="outside right upper")
    fig.savefig(file)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peers")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("out/steps"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    results = []
    for _ in range(options.repeats):
        for shape in MESHES:
            results.append(measure(shape, ThinPlate(), 26.0, options.peers) | {"along": "nodes"})
        for shape in MESHES[1:3]:
            results.append(measure(shape, Elastic(), 26.0, None) | {"along": "elastic"})
        for nx, ny, depth in DEPTHS[:-1]:
            results.append(measure((nx, ny), ThinPlate(), float(depth), None) | {"along": "landmarks"})
    table(results)
    machine = {"machine": platform.platform(), "processor": platform.machine(), "cores": os.cpu_count()}
    packages = ("echospline", "numpy", "scipy", "kvxopt", "scikit-fem")
    machine |= {
        "versions": {p: version(p) for p in packages},
        "python": platform.python_version(),
        "core": describe_core(),
    }
    (options.out / "steps.json").write_text(json.dumps({**machine, "results": results}, indent=1))
    thin = [r for r in results if r["kernel"] == "ThinPlate"]
    figure([r for r in thin if r["along"] == "nodes"], "nodes", options.out / "nodes.svg")
    same = [r for r in thin if r["nodes"] == MESHES[2][0] * MESHES[2][1]]
    figure(same, "landmarks", options.out / "landmarks.svg")


if __name__ == "__main__":
    main()
