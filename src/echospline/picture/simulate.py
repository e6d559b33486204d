"""The one loop (Algorithm 2): needle pose, tissue, deformation, picture; frame by frame, none of them kept.

A volume has its own loop, `simulate_space`, which `simulate` calls.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import ceil
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, cast, overload

from echospline.errors import FoldingError, InputError
from echospline.mechanics.protocol import NeedleLoad, SpatialTissueModel, State, TissueModel, needle_load
from echospline.picture.deformation import Folds
from echospline.picture.drawing import Drawing, ImageFormer
from echospline.picture.native import Border, Inverse
from echospline.picture.needle_echo import NeedleEcho
from echospline.scene import (
    Floats,
    ImagingPlane,
    Insertion,
    NeedlePose,
    PlanePath,
    Probe,
    SpatialInsertion,
    UltrasoundImage,
    Volume,
    is_number,
)

if TYPE_CHECKING:
    from echospline.picture.simulate_space import SpatialFrame


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


@overload
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
) -> Iterator[Frame]: ...


@overload
def simulate(
    image: Volume,
    insertion: SpatialInsertion,
    model: SpatialTissueModel[State],
    *,
    probe: Probe,
    plane: ImagingPlane | PlanePath,
    fps: float = 30.0,
    longest_step: float = 1 / 30,
    folding: Literal["flag", "refuse"] = "flag",
    needle: NeedleEcho | None = None,
) -> Iterator[SpatialFrame]: ...


def simulate(
    image: UltrasoundImage | Volume,
    insertion: Insertion | SpatialInsertion,
    model: TissueModel[Any] | SpatialTissueModel[Any],
    *,
    probe: Probe | None = None,
    plane: ImagingPlane | PlanePath | None = None,
    fps: float = 30.0,
    longest_step: float = 1 / 30,
    border: Border = 0.0,
    folding: Literal["flag", "refuse"] = "flag",
    inverse: Inverse = "auto",
    needle: NeedleEcho | None = None,
    form_image: ImageFormer | None = None,
) -> Iterator[Frame] | Iterator[SpatialFrame]:
    """Push a needle into an image, or into a volume that a probe looks into.

    Parameters
    ----------
    image : UltrasoundImage or Volume
        The tissue before the needle. A volume has 8-bit voxels, and y = 0 is its surface.
    insertion : Insertion or SpatialInsertion
        The needle's path, in the plane or in space as the image is.
    model : TissueModel or SpatialTissueModel
        How the tissue answers; its mesh covers the image.
    probe : Probe
        For a volume: the shape of its picture and the thickness of its slice.
    plane : ImagingPlane or PlanePath
        For a volume: where the probe stands, or how it moves (times from the start).
    fps : float
        Frames per second.
    longest_step : float
        The model is stepped more often than frames are drawn where a frame lasts longer than this, s.
    border : float or "transparent"
        Where no tissue comes to lie; beyond a volume it is black.
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
    Frame or SpatialFrame
        The first at the start of the insertion, before the needle has moved.

    Raises
    ------
    InputError
        If fps or longest_step is not positive, an option is unknown, or image, needle and probe are not all in the plane or all in space.
    FoldingError
        If the picture folds and ``folding="refuse"``.
    """
    if not isinstance(image, Volume):
        if not isinstance(insertion, Insertion) or probe is not None or plane is not None:
            raise InputError(
                f"an image is deformed in its own plane: it takes an Insertion, and no probe and no plane; got {type(insertion).__name__}"
                f"{'' if probe is None else ', a probe'}{'' if plane is None else ', a plane'}: give a Volume, or a path of the plane"
            )
        return _simulate(
            image, insertion, cast("TissueModel[Any]", model), fps=fps, longest_step=longest_step, border=border, folding=folding,
            inverse=inverse, needle=needle, form_image=form_image,
        )  # fmt: skip
    if not isinstance(insertion, SpatialInsertion) or probe is None or plane is None:
        raise InputError(
            f"a volume takes a SpatialInsertion, a probe and a plane (an ImagingPlane or a PlanePath); got {type(insertion).__name__}, probe "
            f"{type(probe).__name__}, plane {type(plane).__name__}"
        )
    if border != 0.0 or inverse != "auto" or form_image is not None:
        raise InputError(
            "border, inverse and form_image are for images of the plane; a volume is sliced and black beyond"
        )
    # loads SciPy's rotations and the core's slices: a run in the plane needs neither
    from echospline.picture.simulate_space import simulate_space  # noqa: PLC0415

    path = PlanePath.still(plane) if isinstance(plane, ImagingPlane) else plane
    return simulate_space(
        image, probe, path, insertion, cast("SpatialTissueModel[Any]", model), fps=fps, longest_step=longest_step, folding=folding, needle=needle
    )  # fmt: skip


def _simulate(
    image: UltrasoundImage,
    insertion: Insertion,
    model: TissueModel[State],
    *,
    fps: float,
    longest_step: float,
    border: Border,
    folding: Literal["flag", "refuse"],
    inverse: Inverse,
    needle: NeedleEcho | None,
    form_image: ImageFormer | None,
) -> Iterator[Frame]:
    """Run the loop in the plane."""
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
