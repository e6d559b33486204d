"""Motion as the picture of a probe shows it: tissue of the first picture, followed in the plane of every later one, and out of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echospline.errors import InputError
from echospline.scene.grid import Floats
from echospline.scene.imaging_plane import ImagingPlane
from echospline.scene.probe import Probe


@dataclass(frozen=True, eq=False)
class SeenMotion:
    """Displacement of tissue of the first picture, as a later picture shows it.

    Parameters
    ----------
    displacement : ndarray, shape (n, 2)
        Place in the later plane minus place in the first picture (lateral, depth), mm: the motion of the tissue and that of the probe.
    out_of_plane : ndarray, shape (n,)
        Signed distance of the tissue from the later plane, mm.
    valid : ndarray of bool, shape (n,)
        Whether it can be followed: it was in the first picture, and in the later one it is still inside the slice and the beams' reach.
    """

    displacement: Floats
    out_of_plane: Floats
    valid: NDArray[np.bool_]


def seen_motion(
    first: Floats, now: Floats, plane: ImagingPlane, probe: Probe, known: NDArray[np.bool_]
) -> SeenMotion:
    """Return how a picture shows tissue that has moved.

    Tissue counts as inside the slice up to one sigma of the beam's amplitude from the plane: there the speckle's intensity keeps a correlation of
    exp(-1/2) = 0.61 with what it was in the plane. An infinitely thin slice keeps what is within half a pixel.

    Parameters
    ----------
    first : ndarray, shape (n, 2)
        Places in the first picture, mm.
    now : ndarray, shape (n, 3)
        Where their tissue is now, in the scene, mm.
    plane : ImagingPlane
        Of the later picture.
    probe : Probe
        Its shape and the thickness of its slice.
    known : ndarray of bool, shape (n,)
        Places that showed tissue in the first picture.

    Raises
    ------
    InputError
        If the arrays do not fit.
    """
    n = len(first)
    if first.shape != (n, 2) or now.shape != (n, 3) or known.shape != (n,):
        raise InputError(
            f"first, now and known have shapes (n, 2), (n, 3) and (n,); got {first.shape}, {now.shape} and {known.shape}"
        )
    place = plane.lower(now)
    away = np.abs(place[:, 2])
    inside = away <= np.maximum(probe.thickness(place[:, 1]), probe.pixel / 2)
    return SeenMotion(place[:, :2] - first, place[:, 2], known & inside & probe.sees(place[:, :2]))
