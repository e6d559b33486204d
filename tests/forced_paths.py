"""Tissue and needle paths for the tests of forces that stick and slip."""

import numpy as np

from echospline.mechanics import Clamps, ForceModel, NeedleForces
from echospline.mechanics.fem_response import FEMResponse
from echospline.scene import NeedlePose, RegularGrid, Tissue

GRID = RegularGrid((21, 16), (2.0, 2.0))


def response(young=10.0, grid=GRID):
    return FEMResponse(grid, Clamps.of(grid, ("left", "right", "bottom")), Tissue(young))


def model(law=None, young=10.0, **options):
    return ForceModel(response(young), law or NeedleForces(), **options)


def pose(depth, angle=90.0, x=20.0):
    """Needle that enters at (x, 0) mm in a direction in degrees."""
    a = np.radians(angle)
    return NeedlePose((x, 0.0), (x + depth * np.cos(a), depth * np.sin(a)))


def depths(made, values, dt=0.01, state=None):
    """States along depths (mm) straight down."""
    state = state or made.rest()
    states = []
    for d in values:
        state = made.advance(state, pose(max(float(d), 0.0)), dt)
        states.append(state)
    return states


def largest(state):
    """Greatest displacement of a mesh node, mm."""
    return float(np.hypot(*state.displacement.T).max())
