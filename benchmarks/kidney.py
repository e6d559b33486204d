"""What `sample:kidney` costs and how good its speckle is; with --pictures, the pictures of docs/kidney.md.

    python benchmarks/kidney.py
    python benchmarks/kidney.py --pictures docs/images

One thread. The recipe is run anew, whatever the cache holds. Printed: seconds for tissue and volume, the process's peak memory, a hash of labels
and volume, a plane imaged anew (median of 9) in seconds and in complex Fourier transforms of 1000 x 400 of the same run, and the envelope's SNR
in a homogeneous block of the same size. Seconds of the processor leave out what other programs took.
"""

from __future__ import annotations

import argparse
import os
import sys
from hashlib import sha256
from math import pi, sqrt
from pathlib import Path
from time import perf_counter, process_time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from PIL import Image, ImageDraw
from scipy import fft

from echospline.laboratory import Faces, Scattering, SpatialPhantom
from echospline.laboratory.kidney_recipe import CELLS, CURVED, LOW, PROBE, build_tissue, build_volume
from echospline.scene import Probe, Volume, probe_plane

TRANSVERSE = Probe(
    width=56.0, depth=90.0, pixel=0.2, elevation=0.95, elevation_depth=62.0, element_height=4.0
)
VIEWS = {
    "longitudinal": (probe_plane((0, 0, 0)), PROBE),
    "transverse": (probe_plane((16, 0, 0), 90), TRANSVERSE),
    "oblique": (probe_plane((5, 0, 0), -35), PROBE),
    "curved array": (probe_plane((0, 0, 0)), CURVED),
}


def main() -> None:
    """Measure, print, and draw if asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--pictures", type=Path, help="folder for the pictures")
    options = parser.parse_args()

    start, worked = perf_counter(), process_time()
    built = build_tissue(1)
    tissue = perf_counter() - start
    phantom = built.phantom(1)
    volume = build_volume(phantom)
    labels = built.tissue(volume).labels
    total = perf_counter() - start
    digest = sha256(labels.voxels.tobytes() + volume.voxels.tobytes()).hexdigest()[:16]
    print(
        f"tissue {tissue:.1f} s, with volume {total:.1f} s ({process_time() - worked:.1f} s of the processor); {volume.shape} voxels, sha256 {digest}"
    )
    if sys.platform != "win32":
        import resource  # noqa: PLC0415

        print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")

    field = np.ones((1000, 400), dtype=np.complex64)
    unit = np.median([_timed(lambda: fft.fft2(field)) for _ in range(15)])
    pictures = {}
    for name, (plane, probe) in VIEWS.items():
        began = process_time()
        times = [_timed(lambda plane=plane, probe=probe: phantom.image_plane(plane, probe)) for _ in range(9)]
        busy = (process_time() - began) / len(times)
        pictures[name] = phantom.image_plane(plane, probe).pixels
        print(
            f"{name}: {np.median(times):.3f} s (at most {max(times):.3f}; {busy:.3f} s of the processor), "
            f"{np.median(times) / unit:.1f} transforms"
        )
    _speckle()
    if options.pictures:
        _draw(options.pictures, pictures, labels, volume)


def _timed(call) -> float:  # type: ignore[no-untyped-def]
    start = perf_counter()
    call()
    return perf_counter() - start


def _speckle() -> None:
    scattering = Scattering.of_levels(np.zeros(CELLS[::-1], np.float32), LOW, 5)
    nothing = Volume(np.zeros((2, 2, 2), np.float32), (200, 200, 200), (-100, 0, -100))
    block = SpatialPhantom(scattering, Faces.none(), nothing, np.zeros(2), 100.0)
    print(f"Rayleigh {sqrt(pi / (4 - pi)):.3f}")
    for name, yaw, probe in (
        ("longitudinal", 0, PROBE),
        ("oblique", 35, PROBE),
        ("transverse", 90, TRANSVERSE),
    ):
        envelopes = [
            block.envelope(
                probe_plane((0, 0, s) if yaw < 90 else (s, 0, 0), yaw), probe, looks=(0.0,), floor=-np.inf
            )[0]
            for s in (-8.0, -4.0, 0.0, 4.0, 8.0)
        ]
        e = np.stack(envelopes)[:, 60:-60, 20:-20].astype(float)
        parts = ", ".join(f"{p.mean() / p.std():.3f}" for p in np.array_split(e, 3, axis=1))
        print(f"SNR, single look, {name}: {e.mean() / e.std():.3f} (by depth {parts})")


def _draw(folder: Path, pictures: dict[str, np.ndarray], labels: Volume, volume: Volume) -> None:
    """Write four views, and the labels beside their slice of the volume."""
    tiles = [(name, Image.fromarray(p)) for name, p in pictures.items()]
    sheet = Image.new("L", (920, 920))
    for n, (name, tile) in enumerate(tiles):
        tile.thumbnail((455, 455))
        place = (460 * (n % 2), 460 * (n // 2))
        sheet.paste(tile, place)
        ImageDraw.Draw(sheet).text((place[0] + 6, place[1] + 6), name, fill=255)
    sheet.save(folder / "kidney-views.png", optimize=True)
    colours = np.array(
        (
            (230, 190, 160), (250, 230, 140), (170, 70, 70), (250, 240, 190), (200, 110, 90), (150, 70, 60), (250, 220, 200),
            (250, 230, 60), (60, 80, 200), (130, 60, 40), (240, 240, 240), (120, 220, 220),
        ),
        np.uint8,
    )  # fmt: skip
    k = labels.shape[2] // 2
    coloured = colours[labels.voxels[k].astype(int)]
    grey = np.repeat(volume.voxels[k][..., None], 3, axis=2)
    height = round(volume.size[1] * 4.4)
    width = round(volume.size[0] * 4.4)
    both = np.concatenate(
        [np.asarray(Image.fromarray(a).resize((width, height), Image.Resampling.NEAREST)) for a in (grey, coloured)], axis=1
    )  # fmt: skip
    Image.fromarray(both).quantize(96).save(folder / "kidney-labels.png", optimize=True)


if __name__ == "__main__":
    main()
