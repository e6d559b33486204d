"""The scene: grid, image, needle, tissue, transforms, imaging plane, transducer and metrics; pure data and geometry."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.scene.echo import Complexes, Display, Echo, EchoCine, fourier_frequencies
    from echospline.scene.grid import EDGES, Floats, RegularGrid, as_points
    from echospline.scene.image import Cine, Pixels, UltrasoundImage, shades
    from echospline.scene.imaging_plane import AXIAL, ImagingPlane, Reach, TrackedNeedle, Visible
    from echospline.scene.metrics import MOVED, FieldError, distance, field_error
    from echospline.scene.needle import ZERO_LENGTH, Insertion, NeedlePose
    from echospline.scene.number import is_number
    from echospline.scene.probe import Probe
    from echospline.scene.space import PlanePath, SpatialGrid, SpatialInsertion, SpatialPose, probe_plane
    from echospline.scene.tissue import (
        Box,
        Circle,
        Label,
        Layer,
        Polygon,
        Region,
        Shape,
        Sphere,
        Tissue,
        VolumeLabel,
    )
    from echospline.scene.tracked_space import (
        nearest_rigid,
        picture_plane,
        pose_in_space,
        probe_angles,
        rigid_fault,
        tip_frame,
    )
    from echospline.scene.transducer import FWHM, TRANSDUCERS, Transducer
    from echospline.scene.transform import as_transform, chain_between, frames_of, transform_between
    from echospline.scene.volume import Volume, Voxels
else:
    on_demand(__name__)

__all__ = [
    "AXIAL",
    "EDGES",
    "FWHM",
    "MOVED",
    "TRANSDUCERS",
    "ZERO_LENGTH",
    "Box",
    "Cine",
    "Circle",
    "Complexes",
    "Display",
    "Echo",
    "EchoCine",
    "FieldError",
    "Floats",
    "ImagingPlane",
    "Insertion",
    "Label",
    "Layer",
    "NeedlePose",
    "Pixels",
    "PlanePath",
    "Polygon",
    "Probe",
    "Reach",
    "Region",
    "RegularGrid",
    "Shape",
    "SpatialGrid",
    "SpatialInsertion",
    "SpatialPose",
    "Sphere",
    "Tissue",
    "TrackedNeedle",
    "Transducer",
    "UltrasoundImage",
    "Visible",
    "Volume",
    "VolumeLabel",
    "Voxels",
    "as_points",
    "as_transform",
    "chain_between",
    "distance",
    "field_error",
    "fourier_frequencies",
    "frames_of",
    "is_number",
    "nearest_rigid",
    "picture_plane",
    "pose_in_space",
    "probe_angles",
    "probe_plane",
    "rigid_fault",
    "shades",
    "tip_frame",
    "transform_between",
]
