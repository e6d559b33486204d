"""The scene that a session simulates, in the plane or in space, its rates, and its options for peers."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite

import numpy as np

from echospline.errors import InputError
from echospline.live import LiveEngine, SpatialEngine
from echospline.openigtlink.header import PORT
from echospline.openigtlink.link import LinkLimits
from echospline.openigtlink.outgoing import Looks
from echospline.openigtlink.tools import STREAMED_ON_REQUEST
from echospline.scene import (
    AXIAL,
    Floats,
    ImagingPlane,
    Insertion,
    PlanePath,
    Reach,
    SpatialInsertion,
    UltrasoundImage,
)

_NO_PLAN = "there is no planned insertion to start: load a scenario that has one"


@dataclass(frozen=True)
class Stage:
    """The simulated scene.

    Parameters
    ----------
    image : UltrasoundImage
        At rest.
    engine : LiveEngine
        Tissue and needle.
    models : tuple of str
        Names that the engine can be switched to.
    insertion : Insertion, optional
        The path for the order `start`.
    """

    image: UltrasoundImage
    engine: LiveEngine
    models: tuple[str, ...] = ()
    insertion: Insertion | None = None

    def start(self) -> float:
        """Play the planned insertion; returns its duration, s.

        Raises
        ------
        InputError
            If there is none.
        """
        if self.insertion is None:
            raise InputError(_NO_PLAN)
        engine, planned = self.engine, self.insertion
        engine.freeze(False)
        times = (k * engine.period for k in range(1, int(planned.duration / engine.period) + 1))
        engine.replay(planned.pose(float(planned.times[0]) + t) for t in times)
        return planned.duration


@dataclass(frozen=True, eq=False)
class SpatialStage:
    """The simulated scene in space.

    Parameters
    ----------
    engine : SpatialEngine
        Tissue, needle and probe in their volume.
    models : tuple of str
        Names that the engine can be switched to.
    insertion : SpatialInsertion, optional
        The path for the order `start`.
    planes : PlanePath, optional
        The probe's path for it.
    place : ndarray, shape (4, 4)
        Scene to reference frame (RAS), mm, until a transform ``SceneToReference`` says otherwise; a rotation and a translation.

    Raises
    ------
    InputError
        If the place is no such motion.
    """

    engine: SpatialEngine
    models: tuple[str, ...] = ()
    insertion: SpatialInsertion | None = None
    planes: PlanePath | None = None
    place: Floats = field(default_factory=lambda: np.array(AXIAL))

    def __post_init__(self) -> None:
        ImagingPlane(self.place)  # checks it

    def start(self) -> float:
        """Play the planned insertion, and the probe's path where there is one; returns its duration, s.

        Raises
        ------
        InputError
            If there is none.
        """
        if self.insertion is None:
            raise InputError(_NO_PLAN)
        self.engine.freeze(False)
        self.engine.play(self.insertion, self.planes)
        return max(self.insertion.duration, self.planes.duration if self.planes else 0.0)


AnyStage = Stage | SpatialStage


@dataclass(frozen=True)
class Rates:
    """Rates of sending.

    Parameters
    ----------
    image : float
        Pictures per second, with the needle's transform; above 0, at most 1000.
    mesh : float
        Displaced meshes per second; 0 for none.
    status : float
        STATUS per second; 0 for none.
    """

    image: float = 30.0
    mesh: float = 5.0
    status: float = 2.0

    def __post_init__(self) -> None:
        if not (isfinite(self.image) and 0 < self.image <= 1000):
            raise InputError(f"the image rate is above 0 and at most 1000 per second; got {self.image}")
        for name in ("mesh", "status"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(f"the {name} rate is 0 or more per second; got {getattr(self, name)}")


@dataclass(frozen=True)
class SessionOptions:
    """Options of a session.

    Parameters
    ----------
    host : str
        Address to listen on; empty for none.
    port : int
        Port to listen on; 0 for any free one.
    connect : tuple of (host, port)
        Servers to connect to.
    looks : Looks
        Names of frames, the needle's looks.
    reach : Reach
        Distances within which the needle counts as near the plane.
    rates : Rates
        Rates of sending.
    limits : LinkLimits
        Limits of the link.
    silence : float
        Seconds without a transform after which the needle counts as stale.
    ask : {"TDATA", "QTDATA", "QTRANS", "POSITION", ""}
        Stream that servers in ``connect`` are asked to start; empty asks nothing.

    Raises
    ------
    InputError
        If the silence is not positive or there is no such stream.
    """

    host: str = "127.0.0.1"
    port: int = PORT
    connect: tuple[tuple[str, int], ...] = ()
    looks: Looks = field(default_factory=Looks)
    reach: Reach = field(default_factory=Reach)
    rates: Rates = field(default_factory=Rates)
    limits: LinkLimits = field(default_factory=LinkLimits)
    silence: float = 0.5
    ask: str = "TDATA"

    def __post_init__(self) -> None:
        if not (isfinite(self.silence) and self.silence > 0):
            raise InputError(f"the silence is a positive number of s; got {self.silence}")
        if self.ask and self.ask not in STREAMED_ON_REQUEST:
            raise InputError(f"a stream is one of {', '.join(STREAMED_ON_REQUEST)}; got {self.ask!r}")
