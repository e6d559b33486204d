"""What every tissue model can do: the one interface that the image side and the outside know."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from numpy.typing import ArrayLike

from echospline.mechanics.forces import NeedleLoad
from echospline.scene import Floats, NeedlePose, RegularGrid, SpatialGrid, SpatialPose

__all__ = ["LoadedModel", "NeedleLoad", "State", "TissueModel", "needle_load"]

State = TypeVar("State")


class TissueModel(Protocol, Generic[State]):
    """Tissue that answers a needle.

    The state is explicit and never changed in place: ``advance`` returns a new one. All displacements
    are deformed minus reference, in mm.
    """

    @property
    def grid(self) -> RegularGrid:
        """The mesh whose nodes carry the displacement."""
        ...

    def rest(self) -> State:
        """State of tissue that no needle has touched: zero displacement everywhere."""
        ...

    def advance(self, state: State, pose: NeedlePose, dt: float) -> State:
        """State after the needle has moved to ``pose`` in ``dt`` seconds (dt >= 0)."""
        ...

    def displacement(self, state: State) -> Floats:
        """Displacement of the mesh nodes, shape (n, 2), mm."""
        ...

    def displacement_at(self, state: State, points: ArrayLike) -> Floats:
        """Displacement of any reference points (n, 2) in mm, shape (n, 2), mm."""
        ...


@runtime_checkable
class LoadedModel(Protocol):
    """A tissue model that knows the needle's forces."""

    def needle_load(self, state: Any) -> NeedleLoad:
        """Return the needle's forces on the tissue in a state."""
        ...


def needle_load(model: object, state: object) -> NeedleLoad | None:
    """Return the needle's forces in a state of any model; None where the model has none (landmarks)."""
    return model.needle_load(state) if isinstance(model, LoadedModel) else None


def described(model: object) -> str:
    """Return in one sentence how a model solves the tissue; empty where the model's name says it all (landmarks)."""
    describe = getattr(model, "describe", None)
    return str(describe()) if callable(describe) else ""


class SpatialTissueModel(Protocol, Generic[State]):
    """Tissue in space that answers a needle; states as in `TissueModel`."""

    @property
    def grid(self) -> SpatialGrid:
        """The mesh; its corners are those of the tissue."""
        ...

    def rest(self) -> State:
        """State of tissue that no needle has touched."""
        ...

    def advance(self, state: State, pose: SpatialPose, dt: float) -> State:
        """State after the needle has moved to ``pose`` in ``dt`` seconds (dt >= 0)."""
        ...

    def field(self, state: State) -> Callable[[Floats], Floats]:
        """Displacement (n, 3) in mm of any reference points (n, 3) in mm."""
        ...
