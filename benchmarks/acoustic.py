"""The convolution phantom against acoustic simulation (PyMUST): the same scatterers, the same motion.

    pip install 'echospline[acoustic]'
    python benchmarks/acoustic.py --out out/acoustic

Minutes. A patch of 8 x 8 mm, 8 mm deep, before and after a strain; the acoustic frames are beamformed from
channel data of one plane wave. Compared: size and statistics of speckle, correlation of the pair, error of tracking.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np

from echospline.laboratory import LinearArray, Phantom, channel_data, delay_and_sum, speckle_statistics
from echospline.laboratory.beamform import demodulate
from echospline.scene import Display, Echo, RegularGrid
from echospline.scene.transducer import LINEAR
from echospline.tracking import FlowTracker

mpl.use("agg")
import matplotlib.pyplot as plt

GRID = RegularGrid((81, 161), (0.1, 0.05), (-4.0, 8.0))


def motion(p):
    """Strain of 1 % along depth and a shear, 0.1 mm at most."""
    x, y = p[:, 0], p[:, 1] - 12.0
    return np.column_stack([0.005 * y, 0.01 * y + 0.01 * x])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/acoustic"))
    parser.add_argument("--per-cell", type=float, default=8.0)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    # a plane wave focuses on reception only: its lateral width is that of the receiving aperture alone
    probe = replace(LINEAR, snr=float("inf"), f_number=2.0)
    phantom = Phantom(probe, GRID, seed=3, per_cell=args.per_cell, reserve=0.5)
    array = LinearArray(frequency=5.0, sampling=20.0, pitch=0.3, sound_speed=1.54, f_number=1.5)
    p, a = phantom.scatterers.positions, phantom.scatterers.amplitudes
    frames = {"convolution": [phantom.form(), phantom.form(motion)], "acoustic": []}
    start = time.perf_counter()
    for q in (p, phantom.moved(motion)):
        rf, recorded = channel_data(q, a, array)
        echo = delay_and_sum(demodulate(rf, recorded, bandwidth=1.6), recorded, GRID)
        frames["acoustic"].append(echo)
    seconds = {"acoustic": (time.perf_counter() - start) / 2}
    start = time.perf_counter()
    phantom.form(motion)
    seconds["convolution"] = time.perf_counter() - start
    level = np.sqrt(np.mean(np.abs(frames["acoustic"][0].iq) ** 2))
    frames["acoustic"] = [Echo(e.iq / level, GRID, e.carrier) for e in frames["acoustic"]]
    points = RegularGrid((11, 11), (0.4, 0.4), (-2.0, 10.0)).nodes
    results = {}
    figure, axes = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
    print(
        "| image | scatterers | s per frame | envelope SNR | width lateral x axial mm | RMSE axial/lateral um |"
    )
    print("|---|---|---|---|---|---|")
    for ax, (name, (before, after)) in zip(axes, frames.items(), strict=True):
        s = speckle_statistics(before.envelope()[20:-20, 10:-10], GRID.spacing)
        found = FlowTracker().motion(before, after, points)
        e = 1e3 * np.sqrt(((found.displacement - motion(points)) ** 2).mean(axis=0))[::-1]
        results[name] = {
            "seconds": seconds[name],
            "snr": s.snr,
            "lateral": s.lateral,
            "axial": s.axial,
            "rmse": e.tolist(),
        }
        print(
            f"| {name} | {len(a)} | {seconds[name]:.3f} | {s.snr:.2f} | {s.lateral:.2f} x {s.axial:.2f} | {e[0]:.1f}/{e[1]:.1f} |"
        )
        x0, x1, y0, y1 = GRID.extent
        ax.imshow(before.b_mode(Display(50.0, 12.0)).pixels, cmap="gray", extent=(x0, x1, y1, y0))
        ax.set(title=name, xlabel="lateral, mm", ylabel="depth, mm")
    figure.savefig(args.out / "acoustic.png", dpi=90)
    (args.out / "acoustic.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
