"""Over which length a needle's force in space has to be spread, so that tissue does not fold.

The force at a station acts at the four places of its hat, 2.5 stations long, and at each of them over a radius e. In tissue of modulus E
the steepest place then has |grad u| = F / (5.7 E e (e + 0.4 h)), h the station spacing: measured for nu from 0.3 to 0.49 and e from 0.25 h to
2.5 h, along and across the hat, where the factor lies between 5.6 and 7.3. Tissue folds (det(I + grad u) = 0) at 8.7 instead of 5.7 or more.
Below 1 the map of the tissue is one to one, and its inverse is found by repetition.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np

from echospline.errors import InputError
from echospline.mechanics.forces import NeedleForces
from echospline.mechanics.response import SpatialColumn
from echospline.scene import Floats, SpatialGrid, Tissue

STEEPNESS = 5.6
"""The factor above. Larger values let |grad u| pass 1."""
HAT = 0.4
"""Of a station spacing, that the hat adds to the radius."""
LEAST = 0.7
"""mm; a radius below it is steep for friction alone, and finer than the places of the hat."""
SAID = 1.25
"""Of the force at which |grad u| reaches 1, from which it is said: just below the surface a hat is cut short and seems to act over less
than it does. Tissue folds at 1.5 or more."""
WIDEST = 0.2
"""Of the least extent of the tissue: a force spread wider reaches the faces, where it is clamped or has an image."""


def softest(tissue: Tissue) -> float:
    """Least Young's modulus of tissue and regions, kPa, but for fluids, which bear no needle."""
    return min([tissue.young, *(region.young for region in tissue.regions if not region.fluid)])


def least_near(tissue: Tissue) -> float:
    """Return the least modulus of a closed form near a force, kPa: the softest solid's in tissue with fluids, else 0, which is none.

    A force whose spread suits that solid would fold fluid by its own closed form, by more than elements can correct.
    """
    return softest(tissue) if any(region.fluid for region in tissue.regions) else 0.0


def bearable(young: float, radius: float, spacing: float) -> float:
    """Force in N of a station at which |grad u| reaches 1, from E in kPa, radius and station spacing in mm."""
    return STEEPNESS * 1e-3 * young * radius * (radius + HAT * spacing)


def radius_for(forces: NeedleForces, tissue: Tissue, grid: SpatialGrid) -> float:
    """Least radius in mm over which the needle's greatest force may be spread.

    The tip and the friction of its station together bring |grad u| to 1 in the softest tissue, no further.

    Raises
    ------
    InputError
        If it would be more than a fifth of the least extent of the tissue.
    """
    h = forces.station_spacing
    greatest = forces.tip + forces.friction_limit * h
    young, a = softest(tissue), HAT * h
    radius = max(LEAST, -a / 2 + sqrt(a * a / 4 + greatest / (STEEPNESS * 1e-3 * young)))
    low, high = grid.corners
    most = WIDEST * float((high - low).min())
    if radius > most:
        bears = bearable(young, most, h)
        raise InputError(
            f"a force of {greatest:.2g} N in tissue of {young:g} kPa needs a spread of {radius:.1f} mm so that it does not fold; the tissue "
            f"has room for {most:.1f} mm: lower the force to {bears:.2g} N, or raise Young's modulus"
        )
    return radius


def folding(
    tissue: Tissue, radius: float, columns: Sequence[SpatialColumn], forces: Floats
) -> dict[str, str]:
    """Say where a force (k, 3) in N is more than tissue bears without |grad u| above 1; empty where none is."""
    worst, said = SAID, {}
    for column, f in zip(columns, forces, strict=True):
        if not len(column.places) or not f.any():
            continue
        young, _ = tissue.at(column.places)
        size = float(np.linalg.norm(f))
        length = float(np.linalg.norm(np.ptp(column.places, axis=0)))
        share = size / bearable(float(young.min()), radius, length / 1.5)
        if share > worst:
            worst = share
            x, y, z = column.weights @ column.places
            said["folding"] = (
                f"a force of {size:.2g} N at ({x:.1f}, {y:.1f}, {z:.1f}) mm is {share:.1f} times what tissue bears there without |grad u| "
                f"above 1: lower the force, or raise Young's modulus or the radius of {radius:.2g} mm"
            )
    return said
