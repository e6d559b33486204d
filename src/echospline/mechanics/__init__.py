"""Tissue models: one protocol, and thin plate spline, Green's function and finite elements behind it."""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.mechanics.anchored_kernel import AnchoredKernel
    from echospline.mechanics.fem import FEMModel
    from echospline.mechanics.force_model import ForceModel
    from echospline.mechanics.forced_scene import ForcedScene, ForcedStep
    from echospline.mechanics.forces import Forces, NeedleForces, NeedleLoad, ViscousForces
    from echospline.mechanics.green import GreenModel
    from echospline.mechanics.kernels import Elastic, Kernel, ThinPlate
    from echospline.mechanics.landmark_stiffness import landmark_stiffness
    from echospline.mechanics.landmarks import Clamps
    from echospline.mechanics.native import CoreScene, NativeStep, describe_core
    from echospline.mechanics.neo_hookean_model import NeoHookeanModel
    from echospline.mechanics.parameters import TPSParameters
    from echospline.mechanics.plane_in_space import PlaneInSpace
    from echospline.mechanics.protocol import TissueModel
    from echospline.mechanics.spatial_force_model import SpatialForceModel
    from echospline.mechanics.spatial_landmark_model import SpatialLandmarkModel
    from echospline.mechanics.spatial_scene import SpatialForcedScene, SpatialStep
    from echospline.mechanics.tps import Solver, TPSModel, anchors_for
else:
    on_demand(__name__)

__all__ = [
    "AnchoredKernel",
    "Clamps",
    "CoreScene",
    "Elastic",
    "FEMModel",
    "ForceModel",
    "ForcedScene",
    "ForcedStep",
    "Forces",
    "GreenModel",
    "Kernel",
    "NativeStep",
    "NeedleForces",
    "NeedleLoad",
    "NeoHookeanModel",
    "PlaneInSpace",
    "Solver",
    "SpatialForceModel",
    "SpatialForcedScene",
    "SpatialLandmarkModel",
    "SpatialStep",
    "TPSModel",
    "TPSParameters",
    "ThinPlate",
    "TissueModel",
    "ViscousForces",
    "anchors_for",
    "describe_core",
    "landmark_stiffness",
]
