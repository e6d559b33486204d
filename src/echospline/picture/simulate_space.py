"""The loop in space: needle and probe move, the tissue answers, and the picture is the plane under the probe; frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import ceil, isfinite
from time import perf_counter
from typing import Literal

import numpy as np

from echospline.errors import FoldingError, InputError
from echospline.mechanics.protocol import SpatialTissueModel, State
from echospline.picture.needle_echo import NeedleEcho
from echospline.picture.slices import SliceDrawing, SliceFormer, SpatialFolds, lattice_of
from echospline.scene import (
    Floats,
    ImagingPlane,
    PlanePath,
    Probe,
    SeenMotion,
    SpatialInsertion,
    SpatialPose,
    UltrasoundImage,
    Volume,
    seen_motion,
)


@dataclass(frozen=True)
class SpatialFrame:
    """One instant of a simulated scene in space.

    Parameters
    ----------
    index : int
        0 for the first frame.
    time : float
        s since the start.
    pose : SpatialPose
        Where the needle is.
    plane : ImagingPlane
        Where the probe is.
    places : ndarray, shape (rows, columns, 3)
        Where a lattice of the picture's pixels lies in undeformed tissue, mm.
    displacement : ndarray, shape (n, 3)
        Of the mesh nodes, mm.
    image : UltrasoundImage
        The picture, on the probe's grid.
    residual : float
        Largest distance of a checked pixel from the forward map of its origin, pixels.
    folds : SpatialFolds or None
        Where tissue folds.
    outside : float
        Share of the picture that lies outside the volume.
    milliseconds : dict
        Time per stage: interaction, inverse, slice, needle.
    motion : callable
        Displacement (n, 3) in mm of any reference points (n, 3) in mm.
    """

    index: int
    time: float
    pose: SpatialPose
    plane: ImagingPlane
    places: Floats
    displacement: Floats
    image: UltrasoundImage
    residual: float
    folds: SpatialFolds | None
    outside: float
    milliseconds: dict[str, float] = field(default_factory=dict)
    motion: Callable[[Floats], Floats] = field(default=np.zeros_like, repr=False)

    def seen_from(self, first: SpatialFrame, probe: Probe, volume: Volume) -> SeenMotion:
        """Return where the picture shows the tissue of a first picture now, on the first one's lattice (row by row)."""
        start = first.places.reshape(-1, 3)
        at = lattice_of(probe).nodes
        known = volume.contains(start) & probe.sees(at)
        return seen_motion(at, start + self.motion(start), self.plane, probe, known)


def simulate_space(
    volume: Volume,
    probe: Probe,
    planes: PlanePath,
    insertion: SpatialInsertion,
    model: SpatialTissueModel[State],
    *,
    fps: float = 30.0,
    longest_step: float = 1 / 30,
    folding: Literal["flag", "refuse"] = "flag",
    needle: NeedleEcho | None = None,
    form_image: SliceFormer | None = None,
) -> Iterator[SpatialFrame]:
    """Push a needle into a volume while the probe moves.

    Parameters
    ----------
    volume : Volume
        Undeformed tissue: 8-bit voxels, y = 0 the surface.
    probe : Probe
        Shape of the picture and thickness of the slice.
    planes : PlanePath
        Where the probe is; times from the start.
    insertion : SpatialInsertion
        The needle's path; times from the start.
    model : SpatialTissueModel
        How the tissue answers.
    fps : float
        Frames per second.
    longest_step : float
        Longest step of the model, s.
    folding : {"flag", "refuse"}
        Whether a picture that folds is flagged in ``SpatialFrame.folds`` or ends the run.
    needle : NeedleEcho, optional
        Draws the needle's echo.
    form_image : callable, optional
        Forms the picture of deformed tissue; the default slices the volume (`slices.SliceFormer`).

    Yields
    ------
    SpatialFrame

    Raises
    ------
    InputError
        If fps or longest_step is not positive.
    FoldingError
        If the picture folds and ``folding="refuse"``.
    """
    for name, value in (("fps", fps), ("longest_step", longest_step)):
        if not (isfinite(value) and value > 0):
            raise InputError(f"{name} must be a positive number; got {value}")
    if folding not in ("flag", "refuse"):
        raise InputError(f'folding is "flag" or "refuse"; got {folding!r}')
    first = float(insertion.times[0])
    duration = max(float(insertion.times[-1]) - first, float(planes.times[-1]) - first)
    count = int(duration * fps + 1e-9) + 1
    steps = max(1, ceil(1.0 / fps / longest_step - 1e-9))
    drawing = SliceDrawing(volume, probe, form_image)
    state = model.rest()
    for index in range(count):
        began = perf_counter()
        pose = insertion.pose(first)
        for k in range(steps) if index else ():
            pose = insertion.pose(first + (index - 1 + (k + 1) / steps) / fps)
            state = model.advance(state, pose, 1.0 / fps / steps)
        displaced = model.field(state)
        u = displaced(model.grid.nodes)
        interaction = 1e3 * (perf_counter() - began)
        plane = planes.at(first + index / fps)
        drawn = drawing.draw(plane, displaced, pose, needle, index)
        if drawn.folds and folding == "refuse":
            raise FoldingError(f"at {index / fps:.2f} s {drawn.folds}")
        yield SpatialFrame(
            index,
            index / fps,
            pose,
            plane,
            drawn.lattice,
            u,
            drawn.image,
            drawn.residual,
            drawn.folds,
            drawn.outside,
            {"interaction": interaction, **drawn.milliseconds},
            displaced,
        )
