"""Time, size and fidelity of every cine writer on one moving image; times as multiples of the MP4 writer's, in one run."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from echospline.io import open_cine, open_writer, sample_image

FRAMES, FPS = 60, 30


def moving() -> list[np.ndarray]:
    """The shipped image, swaying by up to 1.5 pixels in depth, as 8-bit grey."""
    pixels = sample_image().pixels.astype(float)
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    shifted = (
        map_coordinates(pixels, [y + 1.5 * np.sin(x / 80 + k / 9), x], order=1, mode="nearest")
        for k in range(FRAMES)
    )
    return [np.rint(s).astype(np.uint8) for s in shifted]


def size_of(path: Path) -> int:
    return sum(p.stat().st_size for p in path.iterdir()) if path.is_dir() else path.stat().st_size


def read_back(path: Path) -> list[np.ndarray]:
    if path.is_dir():
        return [np.asarray(Image.open(p)) for p in sorted(path.glob("frame_*.png"))]
    return [image.pixels for _, image in open_cine(path, spacing=(1, 1))]


def main() -> None:
    grid, frames = sample_image().grid, moving()
    with tempfile.TemporaryDirectory() as folder:
        print(f"{FRAMES} frames of {grid.shape[0]} x {grid.shape[1]}, 8-bit grey")
        mp4 = 0.0
        print("writer   ms/frame   times MP4   KiB/frame   mean error   largest error (of 255)")
        for name in ("cine.mp4", "cine.gif", "cine.mha", "frames"):
            path = Path(folder) / name
            start = time.perf_counter()
            with open_writer(path, grid, FPS) as writer:
                for k, pixels in enumerate(frames):
                    writer.add(pixels, k / FPS)
            spent = time.perf_counter() - start
            mp4 = mp4 or spent
            error = np.abs(np.stack(read_back(path)).astype(int) - frames)
            print(
                f"{name:9}{1e3 * spent / FRAMES:8.2f}{spent / mp4:12.2f}{size_of(path) / 1024 / FRAMES:12.1f}"
                f"{error.mean():13.2f}{error.max():10d}"
            )


if __name__ == "__main__":
    main()
