"""Synthetic ultrasound with known motion: phantoms, speckle statistics, beamforming and image formers."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.laboratory.acoustic import channel_data
    from echospline.laboratory.beamform import LinearArray, delay_and_sum, demodulate
    from echospline.laboratory.bodies import Body, Round, Tube
    from echospline.laboratory.imaged import imaged, imaged_volume
    from echospline.laboratory.kidney import Kidney, kidney
    from echospline.laboratory.kidney_recipe import LabelledTissue, TissueKind
    from echospline.laboratory.needle_field import NeedleField
    from echospline.laboratory.phantom import Displacement, Inclusion, Layer, Phantom, Scatterers
    from echospline.laboratory.phantom_cine import displacement_of, phantom_pictures
    from echospline.laboratory.rescatter import rescatter
    from echospline.laboratory.sample_volumes import SAMPLE_VOLUMES, sample_volume
    from echospline.laboratory.scattering import Faces, Scattering
    from echospline.laboratory.sonogram import ABDOMINAL, SpatialPhantom
    from echospline.laboratory.speckle import speckle_statistics
else:
    on_demand(__name__)

__all__ = [
    "ABDOMINAL",
    "SAMPLE_VOLUMES",
    "Body",
    "Displacement",
    "Faces",
    "Inclusion",
    "Kidney",
    "LabelledTissue",
    "Layer",
    "LinearArray",
    "NeedleField",
    "Phantom",
    "Round",
    "Scatterers",
    "Scattering",
    "SpatialPhantom",
    "TissueKind",
    "Tube",
    "channel_data",
    "delay_and_sum",
    "demodulate",
    "displacement_of",
    "imaged",
    "imaged_volume",
    "kidney",
    "phantom_pictures",
    "rescatter",
    "sample_volume",
    "speckle_statistics",
]
