"""Synthetic ultrasound with known motion: phantoms, speckle statistics, beamforming and image formers."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.laboratory.acoustic import channel_data
    from echospline.laboratory.beamform import LinearArray, delay_and_sum, demodulate
    from echospline.laboratory.needle_field import NeedleField
    from echospline.laboratory.phantom import Displacement, Inclusion, Layer, Phantom, Scatterers
    from echospline.laboratory.phantom_cine import displacement_of, phantom_pictures
    from echospline.laboratory.rescatter import rescatter
    from echospline.laboratory.speckle import speckle_statistics
else:
    on_demand(__name__)

__all__ = [
    "Displacement",
    "Inclusion",
    "Layer",
    "LinearArray",
    "NeedleField",
    "Phantom",
    "Scatterers",
    "channel_data",
    "delay_and_sum",
    "demodulate",
    "displacement_of",
    "phantom_pictures",
    "rescatter",
    "speckle_statistics",
]
