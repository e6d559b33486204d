"""The one loop (Algorithm 2): needle pose, tissue, deformation, picture; frame by frame, none of them kept."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import ceil
from time import perf_counter
from typing import Literal

from echospline.errors import FoldingError, InputError
from echospline.mechanics.protocol import NeedleLoad, State, TissueModel, needle_load
from echospline.picture.deformation import Folds
from echospline.picture.drawing import Drawing, ImageFormer
from echospline.picture.native import Border, Inverse
from echospline.picture.needle_echo import NeedleEcho
from echospline.scene import Floats, Insertion, NeedlePose, UltrasoundImage, is_number


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
        Largest distance of a checked pixel from the forward map of its origin, pixels.
    folds : Folds or None
        Where the deformation folds.
    milliseconds : dict
        Time spent per stage: interaction, spline, picture (deformation, check, sampling and needle).
    load : NeedleLoad or None
        The needle's forces; None where the model has none.
    """

    index: int
    time: float
    pose: NeedlePose
    displacement: Floats
    image: UltrasoundImage
    residual: float = 0.0
    folds: Folds | None = None
    milliseconds: dict[str, float] = field(default_factory=dict)
    load: NeedleLoad | None = None


def frame_count(insertion: Insertion, fps: float) -> int:
    """Number of frames of an insertion, first and last included.

    Raises
    ------
    InputError
        If fps is not positive.
    """
    if not (is_number(fps) and fps > 0):
        raise InputError(f"fps must be a positive number of frames per second; got {fps}")
    return int(insertion.duration * fps + 1e-9) + 1


def simulate(
    image: UltrasoundImage,
    insertion: Insertion,
    model: TissueModel[State],
    *,
    fps: float = 30.0,
    longest_step: float = 1 / 30,
    border: Border = 0.0,
    folding: Literal["flag", "refuse"] = "flag",
    inverse: Inverse = "auto",
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
    inverse : {"auto", "exact"}
        How origins of pixels are found: interpolated over 4 x 4 pixels where that is good to 0.1 pixel, or each in its cell of
        the mesh (see `Drawing`). A ``form_image`` gets the exact inverse map.
    needle : NeedleEcho, optional
        Draws the needle's echo into the picture.
    form_image : callable, optional
        Forms the picture of deformed tissue; the default resamples the image.

    Yields
    ------
    Frame
        The first at the start of the insertion, before the needle has moved.

    Raises
    ------
    InputError
        If fps or longest_step is not positive, or an option is unknown.
    FoldingError
        If the picture folds and ``folding="refuse"``.
    """
    count = frame_count(insertion, fps)
    if not (is_number(longest_step) and longest_step > 0):
        raise InputError(f"longest_step must be a positive number of seconds; got {longest_step}")
    steps = max(1, ceil(1.0 / fps / longest_step - 1e-9))
    start = float(insertion.times[0])
    drawing = Drawing(
        image, model.grid, border=border, inverse=inverse, folding=folding, form_image=form_image
    )
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
        try:
            drawn = drawing.draw(u, pose, needle)
        except FoldingError as error:
            raise FoldingError(f"at {index / fps:.2f} s {error}") from None
        clock.stage("picture")
        load = needle_load(model, state)
        yield Frame(
            index, index / fps, pose, u, drawn.image, drawn.residual, drawn.folds, clock.milliseconds, load
        )


class _Stopwatch:
    """Time per stage, in milliseconds."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {}
        self._since = perf_counter()

    def stage(self, name: str) -> None:
        now = perf_counter()
        self.milliseconds[name] = 1000.0 * (now - self._since)
        self._since = now
