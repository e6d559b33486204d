"""The needle's command, and the scene after one step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from echospline.scene import Floats, NeedlePose


@dataclass(frozen=True, slots=True)
class Command:
    """Goal of the needle.

    Parameters
    ----------
    entry, tip : (x, y)
        n_s and n_t, mm.
    number : int
        Chosen by the sender and returned in every snapshot from this command on.
    sent : float
        The sender's clock, returned unchanged (for latency).
    """

    entry: tuple[float, float]
    tip: tuple[float, float]
    number: int = 0
    sent: float = 0.0


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The scene after one step.

    Parameters
    ----------
    step : int
        Steps so far, frozen ones included.
    time : float
        Model time since the last reset, s.
    pose : NeedlePose
        The needle, its speed derived from its motion.
    displacement : ndarray, shape (n, 2)
        Of the mesh nodes, mm.
    model : str
        Name of the model.
    command : Command
        The newest command applied in this step.
    duration : float
        Processing time of the step, s.
    watched : ndarray, shape (k, 2)
        Deformed positions of the watched points, mm.
    reference : ndarray, shape (n, 2), or None
        Displacement by the model compared with, in the same pose, mm.
    frozen : bool
        Whether model time is stopped.
    replaying : bool
        Whether the pose comes from a recording.
    failure : str or None
        The error that stopped the model, if any; a reset starts it again.
    spline : callable or None
        Returns the field as a spline (landmarks, weights, motion, centre, scale, kernel), or None where nothing is
        displaced; present if the model offers it. It may cost as much as a step: call it only when needed.
    """

    step: int
    time: float
    pose: NeedlePose
    displacement: Floats
    model: str
    command: Command
    duration: float
    watched: Floats
    reference: Floats | None = None
    frozen: bool = False
    replaying: bool = False
    failure: str | None = None
    spline: Callable[[], object] | None = None
