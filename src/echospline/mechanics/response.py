"""How elastic tissue answers forces: the one interface between the needle's laws and whatever solves the tissue."""

from __future__ import annotations

from typing import Protocol

from echospline.scene import Floats, RegularGrid


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
