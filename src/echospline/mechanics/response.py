"""How elastic tissue answers forces: the one interface between the needle's laws and whatever solves the tissue."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from echospline.scene import Floats, RegularGrid, SpatialGrid


class ForceResponse(Protocol):
    """Linear elastic tissue that is held somewhere and answers point forces; set up once.

    Behind it stand finite elements, closed forms with forces outside the edges, or a live solve. A model adds up the columns
    that it gives; a law of the needle needs nothing else of the tissue.
    """

    @property
    def grid(self) -> RegularGrid:
        """The mesh whose nodes carry the displacement."""
        ...

    def answer(self, places: Floats, forces: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Displacement under k load cases, each of which is a set of point forces.

        Parameters
        ----------
        places : ndarray, shape (m, 2)
            Where the forces act, mm; inside the mesh.
        forces : ndarray, shape (m, 2, k)
            The forces of every load case, N.
        points : ndarray, shape (p, 2)
            Where the displacement is wanted besides the mesh nodes, mm; inside the mesh.

        Returns
        -------
        mesh : ndarray, shape (n, 2, k)
            Displacement of the mesh nodes, mm.
        at : ndarray, shape (p, 2, k)
            Displacement of the points, mm.

        Raises
        ------
        InputError
            If a place or a point lies outside the tissue.
        """
        ...

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved, and how far that is to be trusted (a residual where there is one)."""
        ...


@dataclass(frozen=True, eq=False)
class SpatialColumn:
    """What tissue in space answers to unit forces along x, y and z, each of them spread over a few places.

    Parameters
    ----------
    places : ndarray, shape (m, 3)
        Where the force acts, mm: the displacement that does its work is the mean there.
    weights : ndarray, shape (m,)
        Share of the force at each.
    made : ndarray, shape (M, 3)
        What the response keeps of it, in its own unknowns.
    """

    places: Floats
    weights: Floats
    made: Floats


class SpatialResponse(Protocol):
    """Linear elastic tissue in space that is held somewhere and answers point forces; set up once.

    A law of the needle asks for a column where the tip comes near a new station, and for the field of all columns together.
    """

    @property
    def grid(self) -> SpatialGrid:
        """The mesh; its corners are those of the tissue."""
        ...

    def column(self, places: Floats, weights: Floats) -> SpatialColumn:
        """Answer unit forces along x, y and z that are spread over places (m, 3) in mm by weights (m,).

        Raises
        ------
        InputError
            If a place lies outside the tissue.
        """
        ...

    def column_at(self, column: SpatialColumn, points: Floats) -> Floats:
        """Displacement of points (p, 3) in mm by unit forces, shape (p, 3, 3), mm/N: the last axis is the force's direction."""
        ...

    def field_of(self, columns: Sequence[SpatialColumn], forces: Floats) -> Callable[[Floats], Floats]:
        """Displacement (n, 3) in mm of any points (n, 3) in mm under forces (k, 3) in N, one for each column."""
        ...

    def warnings(self, columns: Sequence[SpatialColumn], forces: Floats) -> dict[str, str]:
        """Say where forces (k, 3) in N go beyond what the method is good for: a sentence for each limit that is passed."""
        ...

    def describe(self) -> str:
        """Return in one sentence how the tissue is solved."""
        ...
