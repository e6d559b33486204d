"""echospline: how an ultrasound image deforms while a needle is pushed into the tissue, in real time.

The paper's equations, and where they live:

========  ================================================================  ==========================================
equation  says                                                              code
========  ================================================================  ==========================================
(1)       bending energy that the spline makes least                        `mechanics.spline.Spline.energy`
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
(24)      mean absolute and root mean square error                          `metrics`
========  ================================================================  ==========================================

Lengths are mm, times s, forces N, moduli kPa; points (x lateral, y depth); displacement is deformed minus reference.
"""

from echospline.data import sample_image
from echospline.deformation import Deformation
from echospline.errors import EchosplineError, FoldingError, InputError, MissingExtraError, SolverError
from echospline.grid import RegularGrid
from echospline.image import Cine, UltrasoundImage
from echospline.io import open_cine, open_writer, read, read_displacement, read_image
from echospline.mechanics.fem import FEMModel
from echospline.mechanics.forces import NeedleForces
from echospline.mechanics.kernels import Elastic, ThinPlate
from echospline.mechanics.model import TissueModel
from echospline.mechanics.tps import TPSModel, TPSParameters
from echospline.needle import Insertion, NeedlePose
from echospline.needle_echo import NeedleEcho
from echospline.scenario import Scenario
from echospline.scenario import load as load_scenario
from echospline.simulate import Frame, simulate
from echospline.tissue import Tissue
from echospline.warp import warp

__all__ = [
    "Cine",
    "Deformation",
    "EchosplineError",
    "Elastic",
    "FEMModel",
    "FoldingError",
    "Frame",
    "InputError",
    "Insertion",
    "MissingExtraError",
    "NeedleEcho",
    "NeedleForces",
    "NeedlePose",
    "RegularGrid",
    "Scenario",
    "SolverError",
    "TPSModel",
    "TPSParameters",
    "ThinPlate",
    "Tissue",
    "TissueModel",
    "UltrasoundImage",
    "load_scenario",
    "open_cine",
    "open_writer",
    "read",
    "read_displacement",
    "read_image",
    "sample_image",
    "simulate",
    "warp",
]
