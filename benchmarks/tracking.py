"""Accuracy and speed of tracking in the virtual laboratory, beside the Cramer-Rao bound, and on real recordings.

    python benchmarks/tracking.py table  --out out/tracking     method x probe x noise
    python benchmarks/tracking.py curves --out out/tracking     error against motion, strain, noise, decorrelation
    python benchmarks/tracking.py speed  --out out/tracking     a pair of 512 x 512, a phantom frame
    python benchmarks/tracking.py real   --out out/tracking --data ../shared/data

Scatterers move, the picture is formed anew; no picture is ever warped. Errors are root mean squares in um over
the field (1089 points, 4 mm or more from the border) and over the paper's region (200 points, 2 x 3 mm, 4 mm
ahead of the tip); outliers are points that miss by 0.1 mm or more.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
from scipy.io import loadmat

import bounds
from echospline.laboratory import LinearArray, NeedleField, Phantom, delay_and_sum
from echospline.laboratory.beamform import demodulate, rigid_motion
from echospline.scene import TRANSDUCERS, Display, Echo, NeedlePose, RegularGrid, UltrasoundImage
from echospline.scene.transducer import LINEAR
from echospline.tracking import BlockMatching, CarrierPhase, DenseFlow, FlowTracker, track
from echospline.tracking.tracker import regrid

mpl.use("agg")
import matplotlib.pyplot as plt

PIXEL = {"linear": 0.1, "convex": 0.17}
WINDOW = 9.0
"""mm^2, the window of the bounds: 3 x 3 mm."""
METHODS = {
    "dense flow, B-mode": ("B", FlowTracker()),
    "dense flow stride 4, B-mode": ("B", FlowTracker(DenseFlow(stride=4))),
    "block matching, B-mode": ("B", BlockMatching()),
    "dense flow, envelope of IQ": ("IQ", FlowTracker(phase=None)),
    "dense flow + carrier, IQ": ("IQ", FlowTracker()),
}


def laboratory(name: str, peak: float, seed: int, pixels: int = 400, **probe: float):
    """Phantom, true field, points of the field, points of the region ahead of the tip."""
    h = PIXEL[name]
    grid = RegularGrid((pixels, pixels), (h, h))
    x0, x1, y0, y1 = grid.extent
    tip = np.array([x0 + 0.5 * (x1 - x0), y0 + 0.5 * (y1 - y0)])
    pose = NeedlePose((x0 + 0.35 * (x1 - x0), y1), tuple(tip))
    field = NeedleField(grid, pose, peak)
    inner = RegularGrid((33, 33), ((x1 - x0 - 8) / 32, (y1 - y0 - 8) / 32), (x0 + 4, y0 + 4)).nodes
    region = tip + 4.0 * np.asarray(pose.axis) + RegularGrid((10, 20), (2 / 9, 3 / 19), (-1.0, -1.5)).nodes
    phantom = Phantom(replace(TRANSDUCERS[name], **probe), grid, seed)
    return phantom, field, inner, region


def measure(tracker, kind, phantom, field, inner, region, replaced=0.0, seed=0):
    """Squared errors (axial, lateral) over field and region, outliers and seconds of one pair."""
    a = phantom.form(noise_seed=1000 + seed)
    b = phantom.form(field, noise_seed=2000 + seed, replaced=replaced)
    if kind == "B":
        a, b = (echo.b_mode(grid=phantom.grid) for echo in (a, b))
    points = np.concatenate([inner, region])
    start = time.perf_counter()
    found = tracker.motion(a, b, points)
    seconds = time.perf_counter() - start
    error = (found.displacement - field(points))[:, ::-1] * 1e3
    n = len(inner)
    return {
        "field": (error[:n] ** 2).mean(axis=0),
        "region": (error[n:] ** 2).mean(axis=0),
        "outliers": float((np.hypot(*error[:n].T) > 100.0).mean()),
        "seconds": seconds,
    }


def average(tracker, kind, name, peak, seeds, replaced=0.0, pixels=400, **probe):
    """Root mean squares over the seeds."""
    rows = [
        measure(tracker, kind, *laboratory(name, peak, seed, pixels, **probe), replaced=replaced, seed=seed)
        for seed in range(seeds)
    ]
    return {
        "field": np.sqrt(np.mean([r["field"] for r in rows], axis=0)).round(2).tolist(),
        "region": np.sqrt(np.mean([r["region"] for r in rows], axis=0)).round(2).tolist(),
        "outliers": round(float(np.mean([r["outliers"] for r in rows])), 4),
        "seconds": round(float(np.median([r["seconds"] for r in rows])), 3),
    }


def bound(name, replaced=0.0, **probe):
    """Two-dimensional bounds of B-mode and of echoes, and Walker and Trahey's for one line of 3 mm."""
    phantom = Phantom(replace(TRANSDUCERS[name], **probe), RegularGrid((400, 400), (PIXEL[name],) * 2), 99)
    a, b = phantom.form(noise_seed=1), phantom.form(noise_seed=2, replaced=replaced)
    pictures = [x.b_mode(grid=phantom.grid).pixels.astype(float) for x in (a, b)]
    return {
        "B": [round(v, 2) for v in bounds.plane(*pictures, phantom.grid.spacing, WINDOW)],
        "IQ": [round(v, 2) for v in bounds.of_echoes(a, b, WINDOW)],
        "line": round(bounds.walker_trahey(phantom.probe, 3.0, 1.0 - replaced), 2),
    }


def table(out: Path, seeds: int) -> None:
    conditions = [
        ("linear", 0.3, {"snr": 20.0}, 0.0),
        ("linear", 0.3, {"snr": 10.0}, 0.2),
        ("linear", 1.0, {"snr": 20.0}, 0.0),
        ("convex", 0.3, {"snr": 20.0}, 0.0),
        ("convex", 0.3, {"snr": 10.0}, 0.2),
        ("convex", 1.0, {"snr": 20.0}, 0.0),
    ]
    results = []
    print(
        "| probe | peak mm | SNR dB | replaced | method | field axial/lateral um | region | outliers | s | bound |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, peak, probe, replaced in conditions:
        limit = bound(name, replaced, **probe)
        for method, (kind, tracker) in METHODS.items():
            r = average(tracker, kind, name, peak, seeds, replaced, **probe)
            results.append({"probe": name, "peak": peak, **probe, "replaced": replaced, "method": method, **r}
                           | {"bound": limit[kind], "walker_trahey": limit["line"]})  # fmt: skip
            pairs = ["{:.1f}/{:.1f}".format(*v) for v in (r["field"], r["region"], limit[kind])]
            print(f"| {name} | {peak} | {probe['snr']:g} | {replaced:.0%} | {method} | {pairs[0]} | {pairs[1]} "
                  f"| {r['outliers']:.1%} | {r['seconds']:.2f} | {pairs[2]} |", flush=True)  # fmt: skip
    print(
        "\nSequence to 3 mm in 10 steps, RMSE axial/lateral um at the last frame (field; region), keyframes:"
    )
    for name in PIXEL:
        for kind in ("B", "IQ"):
            rows = []
            for seed in range(seeds):
                phantom, field, inner, region = laboratory(name, 3.0, seed)
                points = np.concatenate([inner, region])
                frames = [
                    phantom.form(lambda p, s=s, f=field: f(p) * s / 10, noise_seed=s) for s in range(11)
                ]
                if kind == "B":
                    frames = [echo.b_mode(grid=phantom.grid) for echo in frames]
                found = track(frames, points, FlowTracker(), times=np.arange(11.0))
                e = (found.displacement[-1] - field(points))[:, ::-1] * 1e3
                rows.append([(x**2).mean(axis=0) for x in (e[: len(inner)], e[len(inner) :])])
            whole, region = np.sqrt(np.mean(rows, axis=0)).round(1).tolist()
            results.append(
                {"probe": name, "peak": 3.0, "kind": kind, "steps": 10, "field": whole, "region": region}
            )
            print(
                f"- {name}, {kind}: field {whole[0]}/{whole[1]}, region {region[0]}/{region[1]}", flush=True
            )
    (out / "table.json").write_text(json.dumps(results, indent=1))


def curves(out: Path, seeds: int) -> None:
    chosen = {
        k: METHODS[k] for k in ("dense flow, B-mode", "block matching, B-mode", "dense flow + carrier, IQ")
    }
    sweeps = {
        "peak displacement, mm": [(v, v, {}, 0.0) for v in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)],
        "SNR, dB": [(v, 0.3, {"snr": float(v)}, 0.0) for v in (0, 5, 10, 15, 20, 30, 40)],
        "replaced scatterers, %": [(100 * v, 0.3, {}, v) for v in (0.0, 0.05, 0.1, 0.2, 0.3, 0.4)],
    }
    figure, axes = plt.subplots(2, 4, figsize=(15, 6.5), layout="constrained")
    data: dict[str, dict] = {}
    for row, name in zip(axes, PIXEL, strict=True):
        for ax, (label, sweep) in zip(row, sweeps.items(), strict=False):
            limits = {repr((p, s)): bound(name, s, **p) for _, _, p, s in sweep}
            for colour, (method, (kind, tracker)) in zip(("C0", "C2", "C3"), chosen.items(), strict=True):
                y = [
                    average(tracker, kind, name, peak, seeds, share, **p)["field"]
                    for _, peak, p, share in sweep
                ]
                data.setdefault(name, {}).setdefault(label, {})[method] = y
                for i, style in ((0, "-"), (1, "--")):
                    ax.loglog([s[0] for s in sweep], [v[i] for v in y], style, color=colour,
                              label=f"{method}, {('axial', 'lateral')[i]}")  # fmt: skip
                if method != "block matching, B-mode":
                    for i, style in ((0, "-"), (1, "--")):
                        low = [limits[repr((p, s))][kind][i] for _, _, p, s in sweep]
                        ax.plot([s[0] for s in sweep], low, style, color=colour, lw=0.7, alpha=0.5)
            ax.set(xlabel=label, ylabel="RMSE, um", title=name)
            if not label.startswith("peak"):
                ax.set_xscale("linear")
        strain_curve(row[3], name, seeds, chosen, data)
    axes[0, 0].legend(fontsize=7)
    figure.suptitle(
        "Tracking error over the field; thin: Cramer-Rao bound of a 3 x 3 mm window without strain"
    )
    figure.savefig(out / "curves.png", dpi=110)
    (out / "curves.json").write_text(json.dumps(data, indent=1))


def strain_curve(ax, name, seeds, chosen, data) -> None:
    """Homogeneous axial strain, 0.3 mm of motion at most: only the strain changes."""
    strains = (0.001, 0.003, 0.01, 0.02, 0.03)
    for colour, (method, (kind, tracker)) in zip(("C0", "C2", "C3"), chosen.items(), strict=True):
        y = []
        for strain in strains:
            rows = []
            for seed in range(seeds):
                phantom, _, inner, _ = laboratory(name, 0.3, seed, pixels=250)
                mid = np.mean(phantom.grid.extent[2:])

                def field(p, strain=strain, mid=mid):
                    y = p[:, 1] - mid
                    return np.column_stack([np.zeros(len(p)), 0.3 * np.tanh(strain * y / 0.3)])

                rows.append(measure(tracker, kind, phantom, field, inner, inner[:1], seed=seed)["field"])
            y.append(np.sqrt(np.mean(rows, axis=0)).tolist())
        data[name].setdefault("strain", {})[method] = y
        for i, style in ((0, "-"), (1, "--")):
            ax.loglog([100 * s for s in strains], [v[i] for v in y], style, color=colour)
    ax.set(xlabel="axial strain, %", ylabel="RMSE, um", title=name)


def speed(out: Path) -> None:
    phantom = Phantom(LINEAR, RegularGrid((512, 512), (0.1, 0.1)), 1)
    field = NeedleField(phantom.grid, NeedlePose((18.0, 51.0), (25.0, 25.0)), 0.3)
    points = RegularGrid((102, 102), (0.5, 0.5), (0.3, 0.3)).nodes
    a, b = phantom.form(noise_seed=1), phantom.form(field, noise_seed=2)
    pictures = [echo.b_mode(grid=phantom.grid) for echo in (a, b)]
    jobs = {
        "track a 512 x 512 pair, 0.5 mm grid, B-mode": lambda: FlowTracker().motion(*pictures, points),
        "... without the forward-backward test": lambda: FlowTracker(check=None).motion(*pictures, points),
        "... from IQ with carrier phase": lambda: FlowTracker().motion(a, b, points),
        "... block matching": lambda: BlockMatching().motion(*pictures, points[::8]),
        "phantom frame 512 x 512, at rest": lambda: phantom.form(noise_seed=1),
        "phantom frame 512 x 512, linear field": lambda: phantom.form(lambda p: 0.01 * p, noise_seed=1),
        "B-mode of it": lambda: a.b_mode(grid=phantom.grid),
        "exact sum, 1000 of its 523 000 samples": lambda: phantom.exact(phantom.samples.nodes[::523]),
    }
    results = {}
    for job, run in jobs.items():
        run()
        wall, processor = [], []
        for _ in range(7):
            start, used = time.perf_counter(), time.process_time()
            run()
            wall.append(time.perf_counter() - start)
            processor.append(time.process_time() - used)
        # on a machine that others use too, the processor's time divided by the cores is the steadier number
        results[job] = {
            "median": float(np.median(wall)),
            "min": min(wall),
            "processor": float(np.median(processor)),
        }
        print(f"| {job} | {np.median(wall):.3f} s | min {min(wall):.3f} s | processor {np.median(processor):.3f} s |",
              flush=True)  # fmt: skip
    results["scatterers"] = len(phantom.scatterers.amplitudes)
    results["threads"] = cv2.getNumThreads()
    print(f"{results['scatterers']} scatterers, {results['threads']} threads")
    (out / "speed.json").write_text(json.dumps(results, indent=1))


def real(out: Path, data: Path) -> None:
    results = {"disk": disk(data), "timtrack": calf(data, out), "ocular": ocular(data, out)}
    (out / "real.json").write_text(json.dumps(results, indent=1))


def disk(data: Path) -> dict:
    """Rotating disk, channel RF: what is left after the best rigid motion of every pair."""
    rf = loadmat(data / "pymust" / "PWI_disk.mat")["RF"]
    array = LinearArray(frequency=5.0, sampling=20.0 / 3.0, pitch=0.298, start=9.95, sound_speed=1.48)
    grid = RegularGrid((251, 501), (0.1, 0.05), (-12.5, 10.0))
    echoes = [delay_and_sum(demodulate(rf[:, :, k], array), array, grid) for k in range(12)]
    level = np.sqrt(np.mean(np.abs(echoes[0].iq) ** 2))
    echoes = [Echo(e.iq / level, grid, e.carrier) for e in echoes]
    shown = RegularGrid((251, 251), (0.1, 0.1), (-12.5, 10.0))
    pictures = [e.b_mode(Display(50.0, 20.0), shown) for e in echoes]
    points = RegularGrid((40, 40), (0.5, 0.5), (-11.0, 12.0)).nodes
    points = points[np.hypot(points[:, 0] + 0.8, points[:, 1] - 22.5) < 8.5]
    results = {}
    for name, tracker, frames in (
        ("dense flow, B-mode", FlowTracker(), pictures),
        ("block matching, B-mode", BlockMatching(), pictures),
        ("dense flow + carrier, RF", FlowTracker(), echoes),
        ("dense flow + carrier (2 mm), RF", FlowTracker(phase=CarrierPhase(2.0)), echoes),
    ):
        for lag in (1, 4):
            left, largest = [], []
            for k in range(len(frames) - lag):
                u = tracker.motion(frames[k], frames[k + lag], points).displacement
                left.append(u - rigid_motion(points, u)[0])
                largest.append(np.hypot(*u.T).max())
            r = (1e3 * np.sqrt((np.concatenate(left) ** 2).mean(axis=0))[::-1]).round(1).tolist()
            results[f"{name}, lag {lag}"] = {"axial/lateral um": r, "largest mm": float(np.mean(largest))}
            print(
                f"| disk | {name} | lag {lag} | {r[0]}/{r[1]} um | largest {np.mean(largest):.3f} mm |",
                flush=True,
            )
    return results


def warp_back(frames, out: Path, name: str, chain: slice) -> dict:
    """Track a real sequence, take the later frame back by the tracked field, compare with the first frame.

    Pair by pair over the whole sequence, and along material points over the stretch ``chain``.
    """
    mesh = RegularGrid.covering(frames[0].grid, (frames[0].grid.shape[0] // 4, frames[0].grid.shape[1] // 4))
    pairs = []
    for k in range(1, len(frames)):
        found = track(frames[k - 1 : k + 1], mesh.nodes, FlowTracker(), times=np.arange(2.0))
        pairs.append({"frame": k} | compare(frames[k - 1], frames[k], mesh, found, 1)[0])
    stretch = frames[chain]
    found = track(stretch, mesh.nodes, FlowTracker(), times=np.arange(float(len(stretch))))
    chained = []
    for k in range(1, len(stretch)):
        row, back = compare(stretch[0], stretch[k], mesh, found, k)
        chained.append({"frame": k} | row)
        if k in (1, len(stretch) // 2, len(stretch) - 1):
            picture(out / f"{name}_{k:02d}.png", stretch[0], stretch[k].pixels, back, mesh, found, k)
    for title, rows in (("pair", pairs), ("chain", chained)):
        for r in rows[:: max(1, len(rows) // 6)]:
            print(f"| {name} | {title} to {r['frame']} | trusted {r['trusted']:.0%} | motion {r['motion_median_mm']:.2f} mm "
                  f"(95 %: {r['motion_95_mm']:.2f}) | NCC {r['ncc_before']:.3f} -> {r['ncc_after']:.3f} | residual "
                  f"{r['residual_median_um']:.0f} um |", flush=True)  # fmt: skip
    return {"pairs": pairs, "chain": chained, "keyframes": found.keyframes}


def compare(first, later, mesh, found, k) -> tuple[dict, np.ndarray]:
    """Correlation before and after taking ``later`` back, and the motion that is left, where trusted."""
    shape, grid = (mesh.shape[1], mesh.shape[0]), first.grid
    u = found.displacement[k].reshape(*shape, 2).astype(np.float32)
    quality = found.confidence[k].reshape(shape).astype(np.float32)
    dense = regrid(u, mesh, grid) / np.asarray(grid.spacing, np.float32)
    x = np.arange(grid.shape[0], dtype=np.float32)[None, :] + dense[..., 0]
    y = np.arange(grid.shape[1], dtype=np.float32)[:, None] + dense[..., 1]
    # the later frame taken back to the first one's tissue: no inverse of the field is needed
    back = cv2.remap(later.pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    trusted, keep = regrid(quality, mesh, grid) > 0.3, found.confidence[k] > 0.3
    row = {"trusted": float(keep.mean())}
    names = ("motion_median_mm", "motion_95_mm", "ncc_before", "ncc_after", "residual_median_um")
    if keep.mean() < 0.05:
        return row | dict.fromkeys(names, float("nan")), back
    motion = np.hypot(*found.displacement[k][keep].T)
    left = FlowTracker().motion(first, UltrasoundImage(back, grid), mesh.nodes).displacement[keep]
    ncc = [np.corrcoef(first.pixels[trusted], z[trusted])[0, 1] for z in (later.pixels, back)]
    values = (np.median(motion), np.percentile(motion, 95), *ncc, 1e3 * np.median(np.hypot(*left.T)))
    return row | {n: float(v) for n, v in zip(names, values, strict=True)}, back


def picture(path: Path, first, later, back, mesh, found, k) -> None:
    x0, x1, y0, y1 = mesh.extent
    figure, axes = plt.subplots(1, 3, figsize=(15, 5.2), layout="constrained")
    for ax, (image, title) in zip(axes, ((first.pixels, "first frame, tracked displacement x 3"), (later, f"frame {k}"),
                                         (back, f"frame {k} taken back to the first")), strict=True):  # fmt: skip
        ax.imshow(image, cmap="gray", extent=(x0, x1, y1, y0))
        ax.set(title=title, xlabel="lateral, mm")
    chosen = np.zeros((mesh.shape[1], mesh.shape[0]), bool)
    chosen[4::8, 4::8] = True
    chosen = chosen.ravel() & (found.confidence[k] > 0.3)
    p, u = mesh.nodes[chosen], found.displacement[k][chosen]
    axes[0].quiver(*p.T, *u.T, angles="xy", scale_units="xy", scale=1 / 3, color="gold", width=0.003)
    axes[0].set_ylabel("depth, mm")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def calf(data: Path, out: Path) -> dict:
    """In-vivo calf muscle in a jump (TimTrack, every second frame), 0.0868 mm a pixel; ruler and letters cut away."""
    files = sorted((data / "timtrack").glob("*.png"))
    frames = []
    for file in files:
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)[64:516, 114:686]
        frames.append(UltrasoundImage.from_array(np.ascontiguousarray(grey), (0.0868, 0.0868), file.name))
    return warp_back(frames, out, "calf", slice(19, 23))


def ocular(data: Path, out: Path) -> dict:
    """Eye phantom sweep (ITKPOCUS), 0.0577 mm a pixel."""
    video = cv2.VideoCapture(str(data / "itkpocus" / "butterfly-ocular-phantom.mp4"))
    frames = []
    for _ in range(12):
        ok, frame = video.read()
        if ok:
            grey = np.ascontiguousarray(frame[150:950, 60:720].mean(axis=2).round().astype(np.uint8))
            frames.append(UltrasoundImage.from_array(grey, (0.0577, 0.0577), "butterfly-ocular-phantom"))
    return warp_back(frames, out, "ocular", slice(0, 12))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("table", "curves", "speed", "real"))
    parser.add_argument("--out", type=Path, default=Path("out/tracking"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    jobs = {
        "table": lambda: table(args.out, args.seeds),
        "curves": lambda: curves(args.out, args.seeds),
        "speed": lambda: speed(args.out),
        "real": lambda: real(args.out, args.data),
    }
    jobs[args.what]()


if __name__ == "__main__":
    main()
