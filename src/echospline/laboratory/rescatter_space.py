"""Planes of a volume imaged anew in every frame: scatterers move with the tissue, out of the plane too, and speckle decorrelates.

Slicing a volume moves its grey values, so that speckle is stretched like a photograph and tissue that has left the slice leaves no trace of it.
Here the scatterers of the slab about the plane are moved and imaged. `sample:kidney` knows its scatterers. A recorded volume gives its
echogenicity, the local mean power of its envelope, as a picture does in the plane (`rescatter`): brightness, structures and recorded
shadows stay, the pattern of speckle is new.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil

import numpy as np
from scipy import ndimage

from echospline.errors import InputError
from echospline.laboratory.scattering import BRICK, CELL, Faces, Scattering, Singles
from echospline.laboratory.sonogram import ABDOMINAL, LOOKS, SpatialPhantom
from echospline.picture.slices import Field, SliceFormer
from echospline.scene import FWHM, Display, Floats, ImagingPlane, Probe, UltrasoundImage, Volume

MOST_SCATTERERS = 40_000_000
"""Of a volume: 16 bytes each, and one per 0.11 mm^3; a block of 160 mm a side."""
NOTHING = -200.0
"""dB; the level of cells beyond the volume."""


def echogenicity_of_volume(volume: Volume, probe: Probe, display: Display) -> Singles:
    """Return the level of the tissue at every voxel, dB: mean power of the envelope over one resolution cell, shape (nz, ny, nx).

    Raises
    ------
    InputError
        If the volume is not 8-bit.
    """
    if volume.voxels.dtype != np.uint8:
        raise InputError(
            f"rescattering needs an 8-bit volume; got {volume.voxels.dtype}: choose a window (Volume.windowed)"
        )
    of_grey = (display.envelope(np.arange(256)) ** 2).astype(np.float32)
    of_grey[0] = 0.0
    widths = (ABDOMINAL.sigma_lateral, ABDOMINAL.sigma_axial, probe.elevation)
    sigma = [FWHM * w / h / 2.0 for w, h in zip(widths, volume.spacing, strict=True)]
    power = ndimage.gaussian_filter(of_grey[volume.voxels], sigma[::-1], mode="nearest")
    with np.errstate(divide="ignore"):
        level: Singles = np.float32(10.0) * np.log10(power)
    return level


def rescattered_volume(
    volume: Volume, probe: Probe, *, display: Display | None = None, seed: int = 0
) -> tuple[SpatialPhantom, Display]:
    """Build a phantom whose scatterers are as bright as a volume, and the display that shows them equally bright.

    Parameters
    ----------
    volume : Volume
        8-bit, y = 0 the surface.
    probe : Probe
        Its elevation is the length across the slice over which the volume's own speckle is averaged.
    display : Display, optional
        Log compression of the volume; 60 dB when not given.
    seed : int
        Of the scatterers.

    Raises
    ------
    InputError
        If the volume is not 8-bit, black, or so large that its scatterers would be more than `MOST_SCATTERERS`.
    """
    display = display or Display()
    low = np.array(volume.origin) - np.array(volume.spacing) / 2
    low[1] = 0.0
    size = np.array(volume.origin) + volume.size - low
    cells = [
        ceil(ceil(s / c - 1e-6) / b) * b for s, c, b in zip(size, CELL, BRICK, strict=True)
    ]  # whole bricks
    if np.prod(cells, dtype=float) > MOST_SCATTERERS:
        raise InputError(
            f"a volume of {size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm would need {np.prod(cells, dtype=float) / 1e6:.0f} million "
            f'scatterers; at most {MOST_SCATTERERS / 1e6:.0f}: crop it, or slice it (output.image_model = "warp")'
        )
    level = echogenicity_of_volume(volume, probe, display)
    mean = float(10.0 * np.log10(np.mean(10.0 ** (level / 10.0)) + 1e-12))
    if not np.isfinite(level).any():
        raise InputError("the volume is black everywhere; there is nothing to image anew")
    level = np.maximum(level - np.float32(mean), np.float32(-display.dynamic_range - 20.0))
    places = [a + (np.arange(n) + 0.5) * c for a, n, c in zip(low, cells, CELL, strict=True)]
    x, y, z = ((p - o) / h for p, o, h in zip(places, volume.origin, volume.spacing, strict=True))
    levels = np.empty(cells[::-1], dtype=np.float32)
    for k, at in enumerate(z):
        index = np.broadcast_arrays(np.float32(at), y[:, None], x[None, :])
        levels[k] = ndimage.map_coordinates(level, index, np.float32, order=1, mode="nearest")
    for axis, index in enumerate((x, y, z)):
        beyond = index > volume.shape[axis] - 0.5
        np.moveaxis(levels, 2 - axis, 0)[beyond] = NOTHING
    nothing = Volume(np.zeros((2, 2, 2), np.float32), (1e3, 1e3, 1e3), (-500.0, 0.0, -500.0))
    phantom = SpatialPhantom(
        Scattering.of_levels(levels, low.tolist(), seed), Faces.none(), nothing, np.zeros(2), float(size[1])
    )
    return phantom, Display(display.dynamic_range, display.top - mean)


def rescattered_slices(
    phantom: SpatialPhantom,
    volume: Volume,
    *,
    display: Display | None = None,
    looks: Sequence[float] = LOOKS,
    seed: int = 0,
) -> SliceFormer:
    """Return what forms the pictures of `simulate_space` from scatterers.

    Parameters
    ----------
    phantom : SpatialPhantom
        Scatterers and faces of the undeformed tissue.
    volume : Volume
        Whose extent is that of the tissue: scatterers outside it move as its faces do.
    display : Display, optional
        Log compression; that of `sample:kidney` when not given.
    looks : sequence of float
        Degrees of the beams whose envelopes are averaged; one leaves the full contrast of speckle.
    seed : int
        Of the electronic noise, which is another in every frame.
    """
    low = np.array(volume.origin)
    high = low + volume.size

    def form(plane: ImagingPlane, probe: Probe, field: Field | None, index: int) -> UltrasoundImage:
        return phantom.image_plane(
            plane, probe, None if field is None else _inside(field, low, high),
            looks=looks, display=display, noise_seed=seed * 1_000_003 + index,
        )  # fmt: skip

    return form


def _inside(field: Field, low: Floats, high: Floats) -> Callable[[Floats], Floats]:
    """Return a field that goes on beyond the tissue as it is at its faces."""
    return lambda points: field(np.clip(points, low, high))
