"""Pictures of one image, frame by frame: deformed, checked, with the needle, in one pass through the native core."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from echospline.errors import FoldingError, InputError
from echospline.picture.deformation import Deformation, Folds, InverseMap
from echospline.picture.native import LARGEST, Border, Inverse, NativePicture, check_border
from echospline.picture.needle_echo import NeedleEcho, draw_needle, white_of
from echospline.picture.warp import in_core, warp
from echospline.scene import ZERO_LENGTH, Floats, NeedlePose, RegularGrid, UltrasoundImage

ImageFormer = Callable[[Deformation, InverseMap], UltrasoundImage]
"""Forms the picture of deformed tissue."""


@dataclass(frozen=True)
class Drawn:
    """One picture and its check.

    Parameters
    ----------
    image : UltrasoundImage
        Deformed, with the needle.
    residual : float
        Largest distance of a checked pixel from the forward map of its origin, pixels.
    folds : Folds or None
        Where the deformation folds.
    """

    image: UltrasoundImage
    residual: float
    folds: Folds | None


class Drawing:
    """Pictures of one image under the deformations of one mesh; used by one thread at a time.

    Images that the native core samples (see `warp`) are deformed and get their needle in one pass through it; others go through
    the inverse map.

    Parameters
    ----------
    image : UltrasoundImage
        At rest.
    mesh : RegularGrid
        Nodes of the deformations.
    border : float or "transparent"
        Where no tissue comes to lie.
    inverse : {"auto", "exact"}
        How origins of pixels are found: interpolated over 4 x 4 pixels where that is good to 0.1 pixel, or each in its cell of
        the mesh. Images outside the core are always exact.
    folding : {"flag", "refuse"}
        Whether a deformation that folds is refused.
    form_image : callable, optional
        Forms the picture of deformed tissue from the deformation and its exact inverse; the default resamples the image.

    Raises
    ------
    InputError
        If an option is unknown or the mesh is smaller than 2 x 2 nodes.
    """

    def __init__(
        self,
        image: UltrasoundImage,
        mesh: RegularGrid,
        *,
        border: Border = 0.0,
        inverse: Inverse = "auto",
        folding: Literal["flag", "refuse"] = "flag",
        form_image: ImageFormer | None = None,
    ) -> None:
        if inverse not in ("auto", "exact"):
            raise InputError(f'inverse is "auto" or "exact"; got {inverse!r}')
        if folding not in ("flag", "refuse"):
            raise InputError(f'folding is "flag" or "refuse"; got {folding!r}')
        check_border(border, image.pixels)
        self.image, self.mesh = image, mesh
        self._border, self._folding, self._form_image = border, folding, form_image
        self._white = white_of(image.pixels)
        self._native: NativePicture | None = None
        if form_image is None and in_core(image, border) and self._white <= LARGEST:
            self._native = NativePicture(
                image.pixels, image.grid, mesh,
                interpolation="linear", border=border, inverse=inverse, white=max(self._white, 0.0),
            )  # fmt: skip

    def draw(
        self, displacement: Floats, pose: NeedlePose | None = None, echo: NeedleEcho | None = None
    ) -> Drawn:
        """Draw the image under a deformation, with a needle where a pose and its looks are given.

        Parameters
        ----------
        displacement : ndarray, shape (n, 2)
            Of the mesh nodes, deformed minus reference, mm.
        pose : NeedlePose, optional
            The needle.
        echo : NeedleEcho, optional
            Its looks.

        Raises
        ------
        FoldingError
            If the deformation folds and ``folding="refuse"``.
        """
        if self._native is None:
            return self._through_inverse(displacement, pose, echo)
        native = self._native
        native.deform(displacement)
        report = native.report()
        folds = self._allowed(Folds.of(report))
        seen = pose is not None and pose.depth >= ZERO_LENGTH
        pixels = native.draw(echo.at(pose) if echo is not None and pose is not None and seen else None)
        return Drawn(UltrasoundImage(pixels, self.image.grid, self.image.source), report.residual, folds)

    def _through_inverse(
        self, displacement: Floats, pose: NeedlePose | None, echo: NeedleEcho | None
    ) -> Drawn:
        deformation = Deformation(self.mesh, displacement)
        folds = self._allowed(deformation.folds)
        inverse = deformation.inverse(self.image.grid)
        if self._form_image is None:
            picture, white = warp(self.image, inverse, border=self._border), self._white
        else:
            picture = self._form_image(deformation, inverse)
            white = white_of(picture.pixels)
        if pose is not None and echo is not None:
            picture = draw_needle(picture, pose, echo, white)
        return Drawn(picture, inverse.residual, folds)

    def _allowed(self, folds: Folds | None) -> Folds | None:
        if folds and self._folding == "refuse":
            raise FoldingError(f"{folds}: push less far, or let folding be flagged")
        return folds
