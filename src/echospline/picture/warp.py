"""Warp an image: every pixel of the deformed picture takes its value from where it lay in the reference."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np

from echospline.errors import FoldingError, InputError
from echospline.picture.deformation import Deformation, Folds, InverseMap
from echospline.picture.native import LARGEST, Border, NativePicture, check_border, drawable
from echospline.scene import Pixels, UltrasoundImage

Interpolation = Literal["linear", "nearest", "cubic"]
INTERPOLATIONS: tuple[Interpolation, ...] = get_args(Interpolation)
NATIVE = (np.uint8, np.uint16, np.int16, np.float32, np.float64)
"""Types that OpenCV resamples as they are; others go through float64 and come back rounded."""


def warp(
    image: UltrasoundImage,
    deformation: Deformation | InverseMap,
    *,
    border: Border = 0.0,
    interpolation: Interpolation = "linear",
    folding: Literal["flag", "refuse"] = "flag",
) -> UltrasoundImage:
    """Deform an image.

    A deformation of uint8, uint16, int16 or float32 pixels, grey or RGB, linear or nearest, is drawn by the native core.
    Everything else (other types, RGBA, cubic, an inverse map) goes through the inverse map and ``cv2.remap``, which may round
    positions to 1/32 of a pixel.

    Parameters
    ----------
    image : UltrasoundImage
        The reference; type and value range are kept.
    deformation : Deformation or InverseMap
        How the tissue moves, or its inverse on the image's grid where the caller has it.
    border : float or "transparent"
        Value where no tissue comes to lie, or an alpha channel (the result is RGBA).
    interpolation : {"linear", "nearest", "cubic"}
        Between reference pixels; cubic may overshoot, and is cut to the range of the image.
    folding : {"flag", "refuse"}
        Whether a deformation that folds is refused; otherwise ``deformation.folds`` says where it does.

    Returns
    -------
    UltrasoundImage

    Raises
    ------
    FoldingError
        If the map folds and ``folding="refuse"``.
    InputError
        If an option is unknown or the inverse map belongs to another grid.
    """
    if interpolation not in INTERPOLATIONS:
        raise InputError(f"interpolation is one of {', '.join(INTERPOLATIONS)}; got {interpolation!r}")
    if folding not in ("flag", "refuse"):
        raise InputError(f'folding is "flag" or "refuse"; got {folding!r}')
    check_border(border, image.pixels)
    if isinstance(deformation, Deformation):
        if interpolation != "cubic" and in_core(image, border):
            picture = NativePicture(
                image.pixels, image.grid, deformation.grid,
                interpolation=interpolation, border=border, inverse="exact", white=0.0,
            )  # fmt: skip
            picture.deform(deformation.displacement)
            if folding == "refuse":
                _refuse(Folds.of(picture.report()))
            return UltrasoundImage(picture.draw(None), image.grid, image.source)
        if folding == "refuse":
            _refuse(deformation.folds)
        inverse = deformation.inverse(image.grid)
    else:
        inverse = deformation
    if inverse.grid.shape != image.grid.shape:
        raise InputError(f"the inverse map has grid {inverse.grid.shape}, the image {image.grid.shape}")
    fill = 0.0 if border == "transparent" else float(border)
    pixels = _resample(image.pixels, inverse, fill, interpolation)
    if border == "transparent":
        pixels = _with_alpha(pixels, inverse)
    return UltrasoundImage(pixels, image.grid, image.source)


def in_core(image: UltrasoundImage, border: Border) -> bool:
    """Return whether the native core can draw an image with such a border."""
    return drawable(image.pixels) and (border == "transparent" or abs(border) <= LARGEST)


def _refuse(folds: Folds | None) -> None:
    if folds:
        raise FoldingError(f"{folds}: push less far, or allow it with folding flagged")


def _resample(pixels: Pixels, inverse: InverseMap, fill: float, interpolation: Interpolation) -> Pixels:
    import cv2  # noqa: PLC0415  (the core draws most pictures: OpenCV is loaded for those that it does not)

    flag = {"linear": cv2.INTER_LINEAR, "nearest": cv2.INTER_NEAREST, "cubic": cv2.INTER_CUBIC}[interpolation]
    native = pixels.dtype.type in NATIVE
    source: Any = np.ascontiguousarray(pixels if native else pixels.astype(np.float64))
    # half a pixel beyond the outermost centres the tissue is still that of the outermost pixel
    moved = cv2.remap(source, inverse.x, inverse.y, flag, borderMode=cv2.BORDER_REPLICATE)
    if not native:
        if np.issubdtype(pixels.dtype, np.integer):
            moved = np.rint(moved)
        moved = moved.astype(pixels.dtype)
    if interpolation == "cubic" and pixels.size:
        moved = np.clip(moved, pixels.min(), pixels.max())
    if inverse.outside.any():
        moved[inverse.outside] = fill
    result: Pixels = moved
    return result


def _with_alpha(pixels: Pixels, inverse: InverseMap) -> Pixels:
    kind: Any = pixels.dtype
    full = np.iinfo(kind).max if np.issubdtype(kind, np.integer) else 1.0
    alpha = np.where(inverse.outside, 0, full).astype(pixels.dtype)
    colour = pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
    return np.dstack([colour, alpha])
