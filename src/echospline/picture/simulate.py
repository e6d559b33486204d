"""The one loop (Algorithm 2): needle pose, tissue, deformation, picture; frame by frame, none of them kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import ceil, isfinite
from time import perf_counter
from typing import Literal

from echospline.errors import FoldingError, InputError
from echospline.mechanics.protocol import State, TissueModel
from echospline.picture.deformation import Deformation, Folds, InverseMap
from echospline.picture.needle_echo import NeedleEcho, draw_needle
from echospline.picture.warp import warp
from echospline.scene import Floats, Insertion, NeedlePose, UltrasoundImage

ImageFormer = Callable[[Deformation, InverseMap], UltrasoundImage]
"""Forms the picture of deformed tissue; the default resamples the reference image."""


@dataclass(frozen=True)
class Frame:
    """One instant of a simulated insertion.

    Parameters
    ----------
    index : int
        0 for the first frame.
    time : float
        s since the start of the insertion.
    pose : NeedlePose
        Where the needle is.
    displacement : ndarray, shape (n, 2)
        Of the mesh nodes, deformed minus reference, mm.
    image : UltrasoundImage
        The deformed picture.
    residual : float
        Of the inverse map against the forward map, pixels.
    folds : Folds or None
        Where the deformation folds.
    milliseconds : dict
        Time spent per stage: interaction, spline, inverse map, warp, needle.
    """

    index: int
    time: float
    pose: NeedlePose
    displacement: Floats
    image: UltrasoundImage
    residual: float = 0.0
    folds: Folds | None = None
    milliseconds: dict[str, float] = field(default_factory=dict)


def frame_count(insertion: Insertion, fps: float) -> int:
    """Number of frames of an insertion, first and last included.

    Raises
    ------
    InputError
        If fps is not positive.
    """
    if not (isfinite(fps) and fps > 0):
        raise InputError(f"fps must be a positive number of frames per second; got {fps}")
    return int(insertion.duration * fps + 1e-9) + 1


def simulate(
    image: UltrasoundImage,
    insertion: Insertion,
    model: TissueModel[State],
    *,
    fps: float = 30.0,
    longest_step: float = 1 / 30,
    border: float | Literal["transparent"] = 0.0,
    folding: Literal["flag", "refuse"] = "flag",
    needle: NeedleEcho | None = None,
    form_image: ImageFormer | None = None,
) -> Iterator[Frame]:
    """Push a needle into an image.

    Parameters
    ----------
    image : UltrasoundImage
        The tissue before the needle.
    insertion : Insertion
        The needle's path.
    model : TissueModel
        How the tissue answers; its mesh covers the image.
    fps : float
        Frames per second.
    longest_step : float
        The model is stepped more often than frames are drawn where a frame lasts longer than this, s.
    border : float or "transparent"
        Where no tissue comes to lie.
    folding : {"flag", "refuse"}
        Whether a folded picture is flagged in ``Frame.folds`` or ends the run.
    needle : NeedleEcho, optional
        Draws the needle's echo into the picture.
    form_image : callable, optional
        Forms the picture in place of `warp`.

    Yields
    ------
    Frame
        The first at the start of the insertion, before the needle has moved.

    Raises
    ------
    InputError
        If fps or longest_step is not positive.
    FoldingError
        If the picture folds and ``folding="refuse"``.
    """
    count = frame_count(insertion, fps)
    if not (isfinite(longest_step) and longest_step > 0):
        raise InputError(f"longest_step must be a positive number of seconds; got {longest_step}")
    steps = max(1, ceil(1.0 / fps / longest_step - 1e-9))
    start = float(insertion.times[0])
    state = model.rest()
    for index in range(count):
        clock = _Stopwatch()
        pose = insertion.pose(start)
        for k in range(steps) if index else ():
            pose = insertion.pose(start + (index - 1 + (k + 1) / steps) / fps)
            state = model.advance(state, pose, 1.0 / fps / steps)
        clock.stage("interaction")
        u = model.displacement(state)
        clock.stage("spline")
        deformation = Deformation(model.grid, u)
        folds = deformation.folds
        if folds and folding == "refuse":
            raise FoldingError(f"at {index / fps:.2f} s {folds}: push less far, or let folding be flagged")
        inverse = deformation.inverse(image.grid)
        clock.stage("inverse map")
        picture = (
            warp(image, inverse, border=border) if form_image is None else form_image(deformation, inverse)
        )
        clock.stage("warp")
        if needle is not None:
            picture = draw_needle(picture, pose, needle)
            clock.stage("needle")
        yield Frame(index, index / fps, pose, u, picture, inverse.residual, folds, clock.milliseconds)


class _Stopwatch:
    """Time per stage, in milliseconds."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {}
        self._since = perf_counter()

    def stage(self, name: str) -> None:
        now = perf_counter()
        self.milliseconds[name] = 1000.0 * (now - self._since)
        self._since = now
