"""echospline: how an ultrasound image deforms while a needle is pushed into the tissue, in real time.

The paper's equations and their code:

========  ================================================================  ==========================================
equation  content                                                           code
========  ================================================================  ==========================================
(1)       bending energy that the spline minimises                          `mechanics.spline.Spline.energy`
(2) (9)   g = a0 + a1 x + a2 y + sum w_i U(r_i)                             `mechanics.spline.Spline.__call__`
(3) (4)   U(r) = r^2 ln r^2, matrix K                                       `mechanics.kernels.ThinPlate`
(5) (6)   R, and L = [K R; R' 0]                                            `mechanics.spline.factor`
(7) (8)   weights = L^-1 V                                                  `mechanics.spline.FactoredSpline.solve`
(10)      shaft n(t) = n_s + t (n_t - n_s)                                  `NeedlePose.shaft`
(11)(13)  closest point and distance d                                      `NeedlePose.closest`
(12)      tip pushes to n_t + sigma a                                       `mechanics.interaction.tip_push`
(14)(15)  friction f = (alpha1 + alpha2 / (1 + e^d)) v along a              `mechanics.interaction.friction`
(16)(17)  relaxation with rate alpha3                                       `mechanics.interaction.relax`
(18)-(23) plane elasticity by finite elements                               `mechanics.finite_elements`
(24)      mean absolute and root mean square error                          `scene.metrics`
========  ================================================================  ==========================================

Lengths are mm, times s, forces N, moduli kPa; points (x lateral, y depth); displacement is deformed minus reference. In space z is elevation, and
`simulate` takes a `Volume`, a `Probe` and its plane: `docs/space.md`.
"""

from typing import TYPE_CHECKING

from echospline.menu import on_demand

if TYPE_CHECKING:  # the menu, loaded on demand
    from echospline.errors import EchosplineError, FoldingError, InputError, MissingExtraError, SolverError
    from echospline.io import open_cine, open_writer, read, read_displacement, read_image, sample_image
    from echospline.mechanics import (
        Elastic,
        FEMModel,
        GreenModel,
        NeedleForces,
        ThinPlate,
        TPSModel,
        TPSParameters,
        ViscousForces,
    )
    from echospline.mechanics.protocol import TissueModel
    from echospline.mechanics.spatial_force_model import SpatialForceModel
    from echospline.picture import Deformation, Frame, NeedleEcho, simulate, warp
    from echospline.scenario import Scenario
    from echospline.scenario import load as load_scenario
    from echospline.scene import (
        Cine,
        ImagingPlane,
        Insertion,
        NeedlePose,
        PlanePath,
        Probe,
        RegularGrid,
        SpatialInsertion,
        Tissue,
        UltrasoundImage,
        Volume,
        probe_plane,
    )
else:
    on_demand(__name__)

__all__ = [
    "Cine",
    "Deformation",
    "EchosplineError",
    "Elastic",
    "FEMModel",
    "FoldingError",
    "Frame",
    "GreenModel",
    "ImagingPlane",
    "InputError",
    "Insertion",
    "MissingExtraError",
    "NeedleEcho",
    "NeedleForces",
    "NeedlePose",
    "PlanePath",
    "Probe",
    "RegularGrid",
    "Scenario",
    "SolverError",
    "SpatialForceModel",
    "SpatialInsertion",
    "TPSModel",
    "TPSParameters",
    "ThinPlate",
    "Tissue",
    "TissueModel",
    "UltrasoundImage",
    "ViscousForces",
    "Volume",
    "load_scenario",
    "open_cine",
    "open_writer",
    "probe_plane",
    "read",
    "read_displacement",
    "read_image",
    "sample_image",
    "simulate",
    "warp",
]
