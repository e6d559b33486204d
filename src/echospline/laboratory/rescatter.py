"""The image model that forms speckle again: scatterers of the image's own brightness move and are imaged in every frame.

`warp` moves the picture's grey values, so speckle stretches like a photograph and never decorrelates. Here the
picture gives only its echogenicity, the local mean power of its envelope; scatterers of that strength move with the
tissue and every frame is formed from them. The pattern of speckle is new; brightness and structures stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count

import cv2
import numpy as np

from echospline.errors import InputError
from echospline.laboratory.phantom import Phantom
from echospline.laboratory.phantom_cine import displacement_of
from echospline.picture import Deformation, ImageFormer, InverseMap
from echospline.scene import FWHM, Display, Echo, Floats, Transducer, UltrasoundImage

FINE = Transducer(frequency=7.5, snr=30.0)
"""A linear array for superficial tissue, like the one that recorded the image that ships with the package."""


def echogenicity(
    image: UltrasoundImage, probe: Transducer, display: Display, smoothing: float = 1.0
) -> Floats:
    """Return the level of the tissue at every pixel, dB: mean power of the envelope over ``smoothing`` resolution cells."""
    grey = np.asarray(image.pixels, dtype=np.float64)
    if grey.ndim == 3:
        grey = grey.mean(axis=2)
    if image.pixels.dtype != np.uint8:
        raise InputError(f"rescattering needs an 8-bit image; got {image.pixels.dtype}: convert it to 0..255")
    power = display.envelope(grey) ** 2
    power[grey <= 0] = 0.0
    (dx, dy), s = image.spacing, smoothing
    smooth = cv2.GaussianBlur(
        power,
        (0, 0),
        s * FWHM * probe.sigma_lateral / dx / 2.0,
        sigmaY=s * FWHM * probe.sigma_axial / dy / 2.0,
        borderType=cv2.BORDER_REPLICATE,
    )
    with np.errstate(divide="ignore"):
        return np.asarray(10.0 * np.log10(smooth), dtype=np.float64)


def rescattered(
    image: UltrasoundImage, probe: Transducer, *, display: Display | None = None, seed: int = 0
) -> tuple[Phantom, Display]:
    """Build a phantom whose scatterers are as bright as the image, and the display that shows them equally bright."""
    display = display or Display()
    level = echogenicity(image, probe, display)
    # the probe's snr is against speckle of 0 dB: make that the image's mean power
    mean = float(10.0 * np.log10(np.mean(10.0 ** (level / 10.0)) + 1e-12))
    level = np.maximum(level - mean, -display.dynamic_range - 20.0).astype(np.float32)
    display = Display(display.dynamic_range, display.top - mean)

    def at(points: Floats) -> Floats:
        # OpenCV's maps hold at most 32767 columns
        index = image.grid.to_index(points).astype(np.float32)
        found = np.empty(len(points))
        for start in range(0, len(points), 32000):
            part = index[None, start : start + 32000]
            x, y = np.ascontiguousarray(part[..., 0]), np.ascontiguousarray(part[..., 1])
            found[start : start + 32000] = cv2.remap(
                level, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )[0]
        return found

    return Phantom(probe, image.grid, seed, echogenicity=at), display


def rescatter(
    image: UltrasoundImage,
    probe: Transducer = FINE,
    *,
    display: Display | None = None,
    angles: Sequence[float] = (-12.0, 0.0, 12.0),
    seed: int = 0,
) -> ImageFormer:
    """Image former for `simulate`: each call is the next frame and has noise of its own.

    Parameters
    ----------
    image : UltrasoundImage
        8-bit; gives the echogenicity.
    probe : Transducer
        Gives speckle size and noise.
    display : Display, optional
        Log compression of the image; 60 dB when not given.
    angles : sequence of float
        Beams in degrees whose envelopes are averaged, as scanners do; one angle leaves the full contrast of
        speckle, and costs a third.
    seed : int
        Of scatterers and noise.

    Raises
    ------
    InputError
        If the image is not 8-bit.
    """
    if len(angles) == 0:
        raise InputError("rescattering needs one beam angle or more, degrees")
    phantom, display = rescattered(image, probe, display=display, seed=seed)
    frame = count(seed * 1_000_003 + 1)

    def form(deformation: Deformation, inverse: InverseMap) -> UltrasoundImage:
        p = phantom.moved(displacement_of(deformation))
        looks = [phantom.formed_at(p, noise_seed=next(frame), steering=angle).envelope() for angle in angles]
        mean = np.asarray(np.mean(looks, axis=0), dtype=np.complex64)
        return Echo(mean, phantom.samples, probe.carrier).b_mode(display, image.grid)

    return form
