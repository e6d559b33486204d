"""From a scenario's words to a volume in the scene's frame, its tissue, and what has to be said of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from echospline.errors import InputError
from echospline.picture.slices import SliceFormer
from echospline.scenario.body_section import bodies_of, body_regions
from echospline.scenario.scenario import Scenario
from echospline.scenario.sections import TissueSection
from echospline.scenario.space_former import former_notes, former_of
from echospline.scenario.space_section import SpaceSection
from echospline.scene import Layer, Region, Tissue, Volume, VolumeLabel

KIDNEY = "sample:kidney"
SAMPLES = (KIDNEY, "sample:spine")


@dataclass(frozen=True)
class SpatialScene:
    """A volume that is ready to be deformed.

    Parameters
    ----------
    scenario : Scenario
        Resolved: running it again gives the same.
    volume : Volume
        8-bit voxels, y = 0 the skin.
    tissue : Tissue
        Its material.
    notes : tuple of str
        What was chosen or could not be followed.
    form_image : callable, optional
        What images the tissue anew in every frame; none where the volume is sliced.
    """

    scenario: Scenario
    volume: Volume
    tissue: Tissue
    notes: tuple[str, ...]
    form_image: SliceFormer | None = None


def is_spatial(scenario: Scenario) -> bool:
    """Return whether a scenario is a scene in space: it has [space], or names a sample that is a volume."""
    return scenario.space is not None or scenario.image.file in SAMPLES


def open_spatial(scenario: Scenario, folder: Path, *, own: bool = True) -> SpatialScene:
    """Read the volume of a scenario, turn its depth along y and choose a window where its voxels need one.

    Parameters
    ----------
    scenario : Scenario
        A scene in space.
    folder : Path
        Start of its relative paths.
    own : bool
        Whether a volume that knows the stiffness of its tissues gives it to a scenario that asks for none; without, such a scenario is
        homogeneous, as hosts of the core need it.

    Raises
    ------
    InputError
        If it cannot be read or is no volume, a region of the tissue is one of the plane, or a body cannot be imaged into it.
    """
    space = scenario.space or SpaceSection()
    name = scenario.image.file
    notes: list[str] = []
    made = None
    if name == KIDNEY:
        from echospline.laboratory.kidney import kidney  # noqa: PLC0415

        made = kidney()
        volume = made.volume
    elif name in SAMPLES:
        from echospline.laboratory.sample_volumes import sample_volume  # noqa: PLC0415

        volume, _ = sample_volume(name.removeprefix("sample:"))
    else:
        from echospline.io.volume_reading import read_volume_and_axis  # noqa: PLC0415

        axis = space.depth_axis or "y"
        volume, of_file = read_volume_and_axis(folder / name, axis)
        notes.append(
            f"depth runs along the volume's {axis} axis, {of_file} of its file"
            + ("" if space.depth_axis else "; say --depth-axis for another")
        )
    if space.window is None and scenario.image.window is not None:
        space = space.model_copy(update={"window": scenario.image.window})
    volume, space, said = _windowed(volume, space)
    notes += said
    known = made is not None
    if known and not own and space.tissue is None:
        space = space.model_copy(update={"tissue": "homogeneous"})
        notes.append(
            f"tissue is homogeneous here, {scenario.tissue.young:g} kPa; simulate takes the modulus of each tissue of {name}"
        )
    own = _takes_own(scenario, space, known=known)
    space = space.model_copy(update={"tissue": "own" if own else "homogeneous"})
    if scenario.has_bodies:
        from echospline.laboratory import imaged_volume  # noqa: PLC0415

        bodies = bodies_of(scenario.body, scenario.exercise)
        volume = imaged_volume(volume, bodies, display=scenario.phantom.display(), seed=scenario.phantom.seed)
    resolved = scenario.model_copy(update={"space": space})
    tissue = spatial_tissue(scenario)
    if own and made is not None:
        from echospline.laboratory.stiffness import tissue_of  # noqa: PLC0415

        tissue = tissue_of(made.tissue, scenario.tissue.poisson)
        notes.append(
            f"every tissue of {name} has a modulus of its own ({moduli(tissue)}): green takes some 4 s and 0.9 GB to set up, fem 15 s and 3 GB; "
            "--tissue homogeneous takes tissue.young alone"
        )
    notes += former_notes(resolved, made)
    return SpatialScene(resolved, volume, tissue, tuple(notes), former_of(resolved, volume, made))


def moduli(tissue: Tissue) -> str:
    """Name the moduli of a tissue in one line: kinds, softest first, with E in kPa."""
    if not tissue.regions:
        return f"{tissue.young:g} kPa everywhere"
    named = [(r.young, r.name or f"region {i}") for i, r in enumerate(tissue.regions)]
    if not any(isinstance(r.shape, VolumeLabel) for r in tissue.regions):  # labels name every voxel
        named.append((tissue.young, "the rest"))
    return ", ".join(f"{name} {young:,g}" for young, name in sorted(named)) + " kPa"


def _takes_own(scenario: Scenario, space: SpaceSection, *, known: bool) -> bool:
    """Return whether the volume's own moduli are taken.

    Raises
    ------
    InputError
        If they are asked for, and the volume knows none or the scenario gives layers beside them.
    """
    said, plain = scenario.tissue, TissueSection()
    if space.tissue == "own" and not known:
        raise InputError(
            f'space.tissue = "own": {scenario.image.file} does not know the stiffness of its tissues; {KIDNEY} does: give tissue.young and '
            "layers (tissue.region)"
        )
    if space.tissue == "own" and said.region:
        raise InputError(
            'space.tissue = "own" takes the moduli of the volume; tissue.region would replace them: leave one of them out'
        )
    if space.tissue is not None or not known:
        return space.tissue == "own"
    return said.young == plain.young and not said.region


def spatial_tissue(scenario: Scenario) -> Tissue:
    """Build the tissue of a scenario's words in space: homogeneous, or with layers by depth and bodies.

    Raises
    ------
    InputError
        If a region is a circle, a polygon or a labels image: shapes of the plane.
    """
    t = scenario.tissue
    regions = []
    for i, region in enumerate(t.region):
        if region.layer is None:
            raise InputError(
                f"tissue.region[{i}] is a shape of the plane; in space a scenario's regions are layers (depths from, to, mm): for spheres, boxes "
                "and labels build the model in Python"
            )
        regions.append(Region(Layer(*region.layer), region.young, region.poisson, region.name))
    regions += body_regions(scenario.body, scenario.exercise)
    return Tissue(t.young, t.poisson, regions, t.thickness)


def _windowed(volume: Volume, space: SpaceSection) -> tuple[Volume, SpaceSection, list[str]]:
    if volume.voxels.dtype == np.uint8 and space.window is None:
        return volume, space, []
    low, high = space.window or (float(volume.voxels.min()), float(volume.voxels.max()))
    if space.window is None and not high > low:
        raise InputError(f"the volume has one value, {low:g}, everywhere; nothing would be seen")
    chosen = (
        [] if space.window else [f"values {low:g} to {high:g} are shown as black to white (space.window)"]
    )
    return volume.windowed(low, high), space.model_copy(update={"window": (low, high)}), chosen
