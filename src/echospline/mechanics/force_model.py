"""The tissue model of a needle that acts by forces: the law that sticks and slips, on any tissue that answers forces."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from hashlib import blake2b
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import InputError
from echospline.mechanics import stick_slip
from echospline.mechanics.forces import NeedleForces, NeedleLoad, check_step
from echospline.mechanics.response import ForceResponse
from echospline.mechanics.stick_slip import SlipState, Station, Track
from echospline.scene import Floats, NeedlePose, RegularGrid, as_points

ForceSolver = Literal["native", "reference"]

AHEAD = 4
"""Stations whose columns are computed at once, along the needle's axis: one answer of the tissue to eight load cases costs less than
four to two each."""
KEPT = 128
"""Stations that a model keeps for the next time the needle comes that way; states hold their own besides."""


@dataclass(frozen=True, slots=True, eq=False)
class Born:
    """A station with what the tissue answers to it.

    Attributes
    ----------
    station : Station
        Its place and load.
    columns : ndarray, shape (2, n, 2), float32
        Displacement of the mesh nodes by a unit force along x, and along y, mm/N.
    rows : ndarray, shape (j + 1, 2, 2)
        Mean displacement over the stations before it and itself, mm/N: [station, component, direction of the force].
    key : bytes
        Of the track up to here.
    """

    station: Station
    columns: NDArray[np.float32]
    rows: Floats
    key: bytes


@dataclass(frozen=True, slots=True, eq=False)
class ForceState:
    """What needle and tissue remember.

    Attributes
    ----------
    slip : SlipState
        Of the law.
    track : tuple of Born
        Stations with their columns, shared between states.
    load : NeedleLoad
        The needle's forces.
    displacement : ndarray, shape (n, 2)
        Of the mesh nodes, mm, read-only.
    """

    slip: SlipState
    track: tuple[Born, ...]
    load: NeedleLoad
    displacement: Floats
