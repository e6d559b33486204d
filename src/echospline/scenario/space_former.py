"""The words "warp" and "rescatter" of a scenario in space become what forms its pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

from echospline.picture.slices import SliceFormer
from echospline.scenario.phantom_section import PhantomSection
from echospline.scenario.scenario import Scenario
from echospline.scenario.space_section import SpaceSection
from echospline.scene import Volume

if TYPE_CHECKING:  # the laboratory is loaded where something is imaged anew
    from echospline.laboratory.kidney import Kidney


def former_of(scenario: Scenario, volume: Volume, made: Kidney | None = None) -> SliceFormer | None:
    """Return what forms the pictures of a scenario in space; None where the volume is sliced (`output.image_model = "warp"`).

    Parameters
    ----------
    scenario : Scenario
        Its [phantom] gives angles, dynamic range and seed; the angles of the plane's default stand for `sonogram.LOOKS`.
    volume : Volume
        Its volume, 8-bit, in the scene's frame.
    made : Kidney, optional
        The patient that the volume shows: it knows its scatterers.

    Raises
    ------
    InputError
        If the volume is too large or black, the probe's slice has no thickness, or an angle is too steep.
    """
    if scenario.output.image_model == "warp":
        return None
    from echospline.laboratory.beam_lattice import BeamLattice  # noqa: PLC0415
    from echospline.laboratory.rescatter_space import (  # noqa: PLC0415
        rescattered_slices,
        rescattered_volume,
    )
    from echospline.laboratory.sonogram import ABDOMINAL, LOOKS  # noqa: PLC0415

    section = scenario.phantom
    looks = LOOKS if section.angles == PhantomSection().angles else tuple(section.angles)
    probe = (scenario.space or SpaceSection()).probe.probe()
    BeamLattice.of(probe, ABDOMINAL, looks)  # refuses what cannot be imaged, before scatterers are drawn
    if made is not None:
        return rescattered_slices(made.phantom, volume, looks=looks, seed=section.seed)
    phantom, display = rescattered_volume(volume, probe, display=section.display(), seed=section.seed)
    return rescattered_slices(phantom, volume, display=display, looks=looks, seed=section.seed)


def former_notes(scenario: Scenario, made: Kidney | None = None) -> list[str]:
    """Say what images the scatterers, where a scenario asks for it."""
    if scenario.output.image_model == "warp":
        return []
    from echospline.laboratory.sonogram import ABDOMINAL  # noqa: PLC0415

    whose = (
        "its own scatterers"
        if made is not None
        else "scatterers as bright as the volume; its speckle is new, its recorded shadows stay"
    )
    return [
        f"every frame is imaged anew at {ABDOMINAL.frequency:g} MHz from {whose} (space.probe gives the slice, [phantom] angles and seed; "
        "[probe] is that of scenes in the plane)"
    ]
