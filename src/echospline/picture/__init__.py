"""The picture: deformation field, warped image, needle echo and the simulation loop.

`summary` is imported by its own name: it loads matplotlib.
"""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.picture.deformation import Deformation, InverseMap
    from echospline.picture.drawing import Drawing, Drawn, ImageFormer
    from echospline.picture.native import check_border
    from echospline.picture.needle_echo import OUTER_DIAMETER, NeedleEcho, draw_needle, needle_echo
    from echospline.picture.simulate import Frame, frame_count, simulate
    from echospline.picture.warp import warp
else:
    on_demand(__name__)

__all__ = [
    "OUTER_DIAMETER",
    "Deformation",
    "Drawing",
    "Drawn",
    "Frame",
    "ImageFormer",
    "InverseMap",
    "NeedleEcho",
    "check_border",
    "draw_needle",
    "frame_count",
    "needle_echo",
    "simulate",
    "warp",
]
