"""Warp against rescatter: the same motion, two image models; speckle statistics, decorrelation, error of tracking.

    python benchmarks/image_models.py --out out/image_models

On a homogeneous phantom (5 MHz, 40 x 40 mm, 20 dB) the first frame is either warped by the field, or its
scatterers are moved and imaged anew. The field is a needle's, so strain is not even. Nothing is fitted.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from echospline.laboratory import NeedleField, Phantom, speckle_statistics
from echospline.laboratory.speckle import correlation_coefficient
from echospline.picture import Deformation, warp
from echospline.scene import Display, NeedlePose, RegularGrid, UltrasoundImage
from echospline.scene.transducer import LINEAR
from echospline.tracking import FlowTracker
from echospline.tracking.tracker import _pull, correlation

GRID = RegularGrid((400, 400), (0.1, 0.1))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/image_models"))
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    results = []
    points = RegularGrid((33, 33), (1.0, 1.0), (4.0, 4.0)).nodes
    display = Display()
    print(
        "| peak mm | model | Rayleigh distance | envelope SNR | width lateral x axial mm | median NCC after | RMSE axial/lateral um |"
    )
    print("|---|---|---|---|---|---|---|")
    for peak in (0.1, 0.3, 1.0, 2.0):
        rows: dict[str, list[list[float]]] = {"warp": [], "rescatter": []}
        for seed in range(args.seeds):
            phantom = Phantom(LINEAR, GRID, seed)
            field = NeedleField(GRID, NeedlePose((14.0, 39.0), (20.0, 20.0)), peak)
            first = phantom.form(noise_seed=2 * seed).b_mode(display, GRID)
            mesh = RegularGrid.covering(GRID, (200, 200))
            pictures = {
                "warp": warp(first, Deformation(mesh, field(mesh.nodes)), interpolation="cubic").pixels,
                "rescatter": phantom.form(field, noise_seed=2 * seed + 1).b_mode(display, GRID).pixels,
            }
            for name, pixels in pictures.items():
                envelope = display.envelope(pixels)[100:300, 100:300]
                s = speckle_statistics(envelope, (0.1, 0.1))
                found = FlowTracker().motion(first, UltrasoundImage(pixels, GRID), points)
                error = 1e3 * np.sqrt(((found.displacement - field(points)) ** 2).mean(axis=0))[::-1]
                # the picture taken back by the true field: what is left is decorrelation, not motion
                u = (field(GRID.nodes) / 0.1).reshape(400, 400, 2).astype(np.float32)
                local = correlation(first.pixels, pixels, u, np.array([20.0, 20.0]))[100:300, 100:300]
                whole = correlation_coefficient(first.pixels, _pull(pixels.astype(np.float32), u))
                rows[name].append(
                    [s.distance, s.snr, s.lateral, s.axial, float(np.median(local)), whole, *error]
                )
        for name, values in rows.items():
            m = np.mean(values, axis=0)
            m[6:] = np.sqrt(np.mean(np.square(values), axis=0))[6:]
            results.append({"peak": peak, "model": name, "values": m.tolist()})
            print(f"| {peak} | {name} | {m[0]:.3f} | {m[1]:.2f} | {m[2]:.2f} x {m[3]:.2f} | {m[4]:.3f} | {m[6]:.1f}/{m[7]:.1f} |", flush=True)  # fmt: skip
    (args.out / "image_models.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
