"""Time per frame by stage: interaction, spline, inverse map, warp, needle, write; 512 x 512 pixels, one thread.

Run: ``python benchmarks/frame_stages.py``. Times of one machine under its load that day; the shares are what lasts.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from echospline.scenario import Scenario, build_model
from echospline.scenario.run import run
from echospline.scene import UltrasoundImage


def measure(nodes: tuple[int, int], kind: str) -> dict[str, float]:
    pixels = np.random.default_rng(0).integers(0, 200, (512, 512)).astype(np.uint8)
    image = UltrasoundImage.from_array(pixels, (0.08, 0.08))
    scenario = Scenario().with_values(
        {
            "mesh.nodes": list(nodes),
            "model.kind": kind,
            "needle.entry": [8.0, 0.0],
            "needle.depth": 28.0,
            "needle.speed": 14.0,
            "needle.dwell": 0.5,
            "output.figure": False,
        }
    )
    model = build_model(scenario, scenario.grid(image))
    with tempfile.TemporaryDirectory() as out:
        run(scenario, image, model, Path(out) / "first", Path())  # compiles and warms up
        report = run(scenario, image, model, Path(out) / "second", Path())
    return {name: ms["median"] for name, ms in report["milliseconds_per_frame"].items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    rows = [
        {"model": kind, "nodes": nx * ny, **measure((nx, ny), kind)}
        for kind in ("tps", "elastic", "fem")
        for nx, ny in ((40, 30), (75, 60))
    ]
    if parser.parse_args().json:
        print(json.dumps(rows, indent=2))
        return
    stages = [k for k in rows[0] if k not in ("model", "nodes")]
    print(f"{'model':8} {'nodes':>6} " + " ".join(f"{s:>12}" for s in stages) + "   (median ms)")
    for row in rows:
        print(f"{row['model']:8} {row['nodes']:6d} " + " ".join(f"{row[s]:12.2f}" for s in stages))


if __name__ == "__main__":
    main()
