"""Pictures of a phantom for the simulation loop: scatterers moved by its deformations, imaged anew each time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from echospline.errors import InputError
from echospline.laboratory.phantom import Displacement, Phantom
from echospline.picture import Deformation, ImageFormer, InverseMap
from echospline.scene import Display, Echo, Floats, UltrasoundImage


def displacement_of(deformation: Deformation) -> Displacement:
    """Return a function for the displacement at any points in mm; beyond the mesh, that of its edge."""
    x0, x1, y0, y1 = deformation.grid.extent

    def displacement(points: Floats) -> Floats:
        inside = np.clip(points, (x0, y0), (x1, y1))
        return np.asarray(deformation.forward(inside) - inside, dtype=np.float64)

    return displacement


def phantom_pictures(
    phantom: Phantom,
    *,
    display: Display | None = None,
    fps: float = 25.0,
    out_of_plane: float = 0.0,
    record: Callable[[int, Echo], None] | None = None,
) -> ImageFormer:
    """Image former for `simulate` that images a phantom.

    Parameters
    ----------
    phantom : Phantom
        The tissue; its seed also gives every frame's noise.
    display : Display, optional
        Log compression of the echoes.
    fps : float
        Frames per second, which turns ``out_of_plane`` into a share per frame.
    out_of_plane : float
        Share of the scatterers that leave the imaging plane per second, 0 to 1.
    record : callable, optional
        Called with every frame's index and echoes.

    Raises
    ------
    InputError
        If the share or the rate is out of its range.
    """
    if not (0.0 <= out_of_plane <= 1.0 and fps > 0):
        raise InputError(
            f"out_of_plane is a share from 0 to 1 per second, fps positive; got {out_of_plane}, {fps}"
        )
    index = 0

    def form(deformation: Deformation, inverse: InverseMap) -> UltrasoundImage:
        nonlocal index
        kept = (1.0 - out_of_plane) ** (index / fps)
        # one seed for the whole run: the set of scatterers that have left only grows
        scatterers = phantom.scatterers.replaced(1.0 - kept, phantom.seed + 1)
        echo = phantom.formed_at(
            phantom.moved(displacement_of(deformation)),
            phantom.seed * 1_000_003 + index,
            scatterers=scatterers,
        )
        if record is not None:
            record(index, echo)
        index += 1
        return echo.b_mode(display, phantom.grid)

    return form
