"""Up to which turn of the probe a sliced volume shows what the probe would see: slices of `sample:kidney` against the same planes imaged anew.

    python benchmarks/turned_plane.py             # about a minute, when the kidney has been built

The volume was imaged from above, slice by slice; a plane cut through it carries the shadows and the speckle of those slices. Brightness: both pictures smoothed
over 1.6 mm (standard deviation), where the volume holds a value: correlation, mean difference in dB, share of the picture that is off by more than 6 dB. Speckle:
half width of the autocorrelation at one half, mm, median over patches of 8 mm.
"""

import numpy as np
from scipy import ndimage

from echospline.laboratory.kidney import kidney
from echospline.laboratory.rescatter_space import rescattered_slices
from echospline.picture.slices import SliceDrawing
from echospline.scene import Probe, probe_plane

PROBE = Probe(width=40.0, depth=70.0, pixel=0.2)
TURNS = {"yaw": (0, 15, 30, 45, 60, 90), "pitch": (5, 10, 15, 20), "roll": (5, 10, 15, 20, 30)}
SMOOTH, DETAIL, PATCH, LAGS = 8, 6, 40, 12
"""Pixels."""
DECIBELS = 60.0 / 255.0
"""Per grey value."""


def speckle_width(picture):
    """Half width of the detail's autocorrelation along x, mm: median over patches that are neither dark nor full of edges."""
    detail, found = picture - ndimage.gaussian_filter(picture, DETAIL), []
    for y in range(20, picture.shape[0] - 60, PATCH):
        for x in range(10, picture.shape[1] - 50, PATCH):
            patch, shown = (v[y : y + PATCH, x : x + PATCH] for v in (detail, picture))
            if shown.mean() < 40 or shown.std() > 60:
                continue
            power = np.abs(np.fft.fft2(patch - patch.mean(), (2 * PATCH, 2 * PATCH))) ** 2
            along = np.fft.ifft2(power).real[0, :LAGS]
            along = along / along[0]
            i = int(np.argmax(along < 0.5))
            if i:
                found.append(i - 1 + (along[i - 1] - 0.5) / (along[i - 1] - along[i]))
    return PROBE.pixel * float(np.median(found))


def main():
    made = kidney()
    sliced = SliceDrawing(made.volume, PROBE)
    anew = SliceDrawing(made.volume, PROBE, rescattered_slices(made.phantom, made.volume))
    for name, angles in TURNS.items():
        for angle in angles:
            plane = probe_plane((0.0, 0.0, 0.0), **{name: angle})
            u, v = (d.draw(plane, index=1).image.pixels.astype(float) for d in (sliced, anew))
            held = ndimage.minimum_filter(ndimage.median_filter((u > 0).astype(np.uint8), 9), 15) > 0
            a, b = (ndimage.gaussian_filter(p, SMOOTH)[held] for p in (u, v))
            off = DECIBELS * np.abs(a - b)
            print(
                f"{name:5} {angle:3} degrees: correlation {np.corrcoef(a, b)[0, 1]:.2f}, mean difference {off.mean():.1f} dB, off by more than 6 dB "
                f"{100 * (off > 6).mean():3.0f} %; speckle across {speckle_width(u):.2f} mm sliced, {speckle_width(v):.2f} mm anew",
                flush=True,
            )


if __name__ == "__main__":
    main()
