"""The tables of a scenario that describe the virtual laboratory: [probe] and [phantom]."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from echospline.errors import InputError
from echospline.scenario.sections import Millimetres, Point, Section
from echospline.scene import Display, RegularGrid, Transducer, UltrasoundImage

if TYPE_CHECKING:  # the laboratory is loaded when a phantom is made
    from echospline.laboratory import Inclusion, Layer, Phantom


class ProbeSection(Section):
    """The probe that images scatterers: of the phantom, and of `output.image_model = "rescatter"`."""

    frequency: float = Field(5.0, gt=0.1, le=50, description="centre frequency, MHz")
    bandwidth: float = Field(
        0.6, gt=0.01, lt=2, description="-6 dB width of the spectrum, share of frequency"
    )
    f_number: float = Field(2.0, ge=0.5, le=20, description="depth over aperture: sets the beam's width")
    sampling: float = Field(40.0, gt=0.5, le=1000, description="rate of RF samples, MHz; snr is per sample")
    snr: float = Field(
        40.0, ge=-20, le=200, description="0 dB speckle over electronic noise at mid-depth, dB"
    )
    attenuation: float = Field(
        0.0, ge=0, le=10, description="one way, dB/(cm MHz), undone by the gain: noise grows with depth"
    )
    focus: Annotated[Millimetres, Field(gt=0)] | None = Field(
        None, description="depth of a fixed focus, mm; focused everywhere where not given"
    )
    sound_speed: float = Field(1.54, gt=0.3, le=5, description="mm/us")

    def probe(self) -> Transducer:
        """Return the probe."""
        return Transducer(**self.model_dump())


class EllipseSection(Section):
    """An ellipse."""

    centre: Point = Field(description="mm")
    half_axes: Point = Field(description="mm along x and y")


class EchogenicitySection(Section):
    """Part of the tissue that is brighter or darker; exactly one of layer and ellipse."""

    level: float = Field(ge=-100, le=60, description="dB against the background; -100 is a cyst")
    layer: tuple[Millimetres, Millimetres] | None = Field(None, description="depths from, to, mm")
    ellipse: EllipseSection | None = None

    def region(self) -> Inclusion | Layer:
        """Return the region.

        Raises
        ------
        InputError
            If both or none of layer and ellipse are given.
        """
        from echospline.laboratory import Inclusion, Layer  # noqa: PLC0415

        if self.layer is not None and self.ellipse is None:
            return Layer(*self.layer, self.level)
        if self.ellipse is not None and self.layer is None:
            return Inclusion(self.ellipse.centre, self.ellipse.half_axes, self.level)
        raise InputError("a [[phantom.region]] has exactly one of layer and ellipse")


class PhantomSection(Section):
    """Tissue of point scatterers."""

    size: tuple[Annotated[Millimetres, Field(ge=5, le=500)], Annotated[Millimetres, Field(ge=5, le=500)]] = (
        Field((40.0, 40.0), description="width and depth of the picture, mm")
    )
    pixel: tuple[
        Annotated[Millimetres, Field(ge=0.01, le=2)], Annotated[Millimetres, Field(ge=0.01, le=2)]
    ] = Field((0.1, 0.1), description="pitch of lines, distance of rows, mm")
    per_cell: float = Field(12.0, ge=0.1, le=1000, description="scatterers per resolution cell")
    seed: int = Field(0, ge=0, description="of scatterers and noise")
    out_of_plane: float = Field(
        0.0, ge=0, le=1, description="share of scatterers that leave the imaging plane per second"
    )
    angles: list[Annotated[float, Field(ge=-45, le=45)]] = Field(
        [-12.0, 0.0, 12.0],
        min_length=1,
        max_length=32,
        description="rescatter: beams whose envelopes are averaged, degrees",
    )
    dynamic_range: float = Field(60.0, ge=10, le=200, description="of the picture, dB")
    region: list[EchogenicitySection] = Field(default=[], description="cysts, lesions, layers")

    def grid(self) -> RegularGrid:
        """Return the picture's pixel centres."""
        nx, ny = (round(s / h) for s, h in zip(self.size, self.pixel, strict=True))
        if nx * ny > 50_000_000:
            raise InputError(f"a phantom of {nx} x {ny} pixels is too large: choose larger phantom.pixel")
        return RegularGrid((max(nx, 2), max(ny, 2)), self.pixel)

    def phantom(self, probe: Transducer) -> Phantom:
        """Scatter the phantom."""
        from echospline.laboratory import Phantom  # noqa: PLC0415

        regions = tuple(r.region() for r in self.region)
        return Phantom(probe, self.grid(), self.seed, self.per_cell, regions)

    def still(self, probe: Transducer) -> UltrasoundImage:
        """Return the phantom's picture at rest."""
        phantom = self.phantom(probe)
        picture = phantom.form(noise_seed=phantom.seed).b_mode(self.display(), phantom.grid)
        return UltrasoundImage(picture.pixels, picture.grid, "speckle phantom")

    def display(self) -> Display:
        """Return the log compression of the picture."""
        return Display(self.dynamic_range)
