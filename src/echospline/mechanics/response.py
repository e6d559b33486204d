"""How the mesh answers the landmarks that move: kept between steps, updated when contacts come and go.

With the anchors held (`anchored_kernel`), contacts C with displacements d move the mesh by G_:C (G_CC + D)^-1 d = E (M d)
(`basis`). E is kept, one row per contact; a step reads it once. A contact that joins appends a row; one that leaves turns
the rows after it; nothing is refitted. Rounding that this gathers is watched at the landmarks, and everything is rebuilt when
it grows. The tip moves at every step, so its row cannot be kept; `tip_column` interpolates it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import SolverError
from echospline.mechanics.anchored_kernel import AnchoredKernel
from echospline.mechanics.basis import Basis, new_basis
from echospline.mechanics.compiled import CHUNK
from echospline.mechanics.contacts import change, misfit
from echospline.mechanics.mesh_field import SIGN, field, field_before
from echospline.mechanics.row_sums import BLOCK
from echospline.mechanics.spline import Spline
from echospline.mechanics.tip_column import meet_exactly, tend
from echospline.mechanics.tip_patch import COEFFICIENTS, DEGREE, NODES
from echospline.scene import Floats

RESIDUAL = 1e-6
"""mm; misfit at the landmarks, for displacements of 1 mm, at which the response is rebuilt."""

CATCH_UP = 3
"""Parts of a patch that one step builds while the tip has none; otherwise one, so that no step takes long."""

LINE = 64
"""Bytes in a cache line."""

Singles = NDArray[np.float32]
Precision = Literal["single", "double"]
NO_TIP = np.zeros(12)
NOT_ASKED = np.empty((0, 2))
Number = TypeVar("Number", bound=np.generic)


@dataclass
class Statistics:
    """What the response has done so far.

    Parameters
    ----------
    joined, left : int
        Contacts added and removed by an update.
    rebuilt : int
        How often the response was built anew because rounding had grown past `RESIDUAL`.
    patches : int
        How often a patch was begun for the tip.
    built : int
        Points at which the rows of patches were built.
    direct : int
        How often the tip's row was evaluated directly.
    residual : float
        Largest misfit at the landmarks seen after an update, mm for displacements of 1 mm.
    """

    joined: int = 0
    left: int = 0
    rebuilt: int = 0
    patches: int = 0
    built: int = 0
    direct: int = 0
    residual: float = 0.0


class Response:
    """The displacement of all points as a product of what is kept and the displacements of the landmarks.

    A table of contacts has a row for each, `touch.COLUMNS`, of which only the first column, its source, is read here.

    Parameters
    ----------
    scene : AnchoredKernel
        Anchors, points and the sources that may become contacts.
    at : ndarray of int, shape (K,)
        Which evaluation point each source is.
    precision : {"single", "double"}
        Of the product that gives the field. Factors are always double. "single" also interpolates the tip's row.
    softness : ndarray, shape (K,), optional
        Diagonal D of each source (`AnchoredKernel.compliance`); 0, the default, interpolates.
    """

    def __init__(
        self,
        scene: AnchoredKernel,
        at: NDArray[np.intp],
        precision: Precision = "single",
        softness: Floats | None = None,
    ) -> None:
        self.scene = scene
        self.at = np.ascontiguousarray(at, dtype=np.int64)
        self.precision = precision
        self.softness = np.zeros(len(scene.sources)) if softness is None else softness
        self.statistics = Statistics()
        c, Q, m, K = scene.components, len(NODES), len(scene.table), len(scene.sources)
        self.watched = np.zeros(len(scene.points) if len(scene.points) < 2 * K else 0, dtype=np.int64)
        if len(self.watched):
            self.watched[self.at] = SIGN
        self.head = (2 * Q + 1) * c
        """Rows before those of the contacts: those of the tip's two patches, then the tip's own when it is evaluated."""
        self.counted = np.zeros(1, dtype=np.int64)
        self.contact_of = np.full(K, -1, dtype=np.int64)
        self.squares, self.built = np.zeros((2, 3)), np.zeros(2, dtype=np.int64)
        self.nodes, self.nodes_held = np.zeros((2, Q, 2)), np.zeros((2, Q * c, m))
        self.nodes_own = np.zeros((2, Q * c, Q * c))
        # rows as long as whole blocks, so that all of them begin on a cache line; what is beyond the points stays zero
        self.rows: Floats = np.empty((0, -(-c * len(scene.points) // BLOCK) * BLOCK))
        self.single: Singles = np.empty(self.rows.shape, dtype=np.float32)
        self.source_of: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self.MT: Floats = np.empty((0, 0))
        self.gram: Floats = np.empty((0, 0))
        self.nodes_contacts: Floats = np.empty((2, Q * c, 0))
        self.nodes_newton: Floats = np.empty((2, Q * c, 0))
        self.close: NDArray[np.int64] = np.empty((2, 0), dtype=np.int64)
        self._near_room(64)
        self._reserve(128)

    @property
    def count(self) -> int:
        """Number of contacts."""
        return int(self.counted[0])

    # --- contacts

    def set_contacts(self, sources: ArrayLike) -> None:
        """Make these the contacts.

        Parameters
        ----------
        sources : array_like of int, shape (k,)
            Indices of sources, each once.

        Raises
        ------
        SolverError
            If two of them lie too close together.
        """
        wanted = np.array(sources, dtype=np.int64).reshape(-1)
        self._reserve(len(wanted))  # those that leave go first
        joined, left, told_apart = change(self.basis, wanted)
        if not told_apart:
            raise SolverError(
                f"{joined} contacts cannot be told apart from others: they lie too close together; thin them out "
                "or give them a finite stiffness"
            )
        if joined or left:
            self.statistics.joined += joined
            self.statistics.left += left
            worst = misfit(self.basis)
            self.statistics.residual = max(self.statistics.residual, worst)
            if not worst <= RESIDUAL:
                self.rebuild()

    def rebuild(self) -> None:
        """Build E and M anew.

        Raises
        ------
        SolverError
            If they cannot be had to `RESIDUAL`.
        """
        names = self.source_of[: self.count].copy()
        self.counted[0] = 0
        self.contact_of[:] = -1
        self.squares[:] = 0.0
        _, _, told_apart = change(self.basis, names)
        self.statistics.rebuilt += 1
        worst = misfit(self.basis) if told_apart else np.inf
        if not worst <= RESIDUAL:
            raise SolverError(
                f"the spline misses its landmarks by {worst:.1e} mm: two of the {len(names)} contacts lie too close "
                "together; thin them out or give them a finite stiffness"
            )

    def _reserve(self, contacts: int) -> None:
        """Have room for that many contacts."""
        have = len(self.source_of)
        if have >= contacts:
            return
        c, room = self.scene.components, max(contacts, 2 * have)
        self.source_of = _grown(self.source_of, (room,))
        width = -(-room * c // BLOCK) * BLOCK
        self.MT, self.gram = _grown(self.MT, (room * c, width)), _grown(self.gram, (room * c, room * c))
        shape = (2, len(NODES) * c, width)
        self.nodes_contacts, self.nodes_newton = (
            _grown(a, shape) for a in (self.nodes_contacts, self.nodes_newton)
        )
        self.close = _grown(self.close, (2, room))
        rows = (self.head + room * c, self.rows.shape[1])
        self.rows, self.single = _grown(self.rows, rows), _grown(self.single, rows)
        self._gather()

    def _near_room(self, points: int) -> None:
        """Have room for that many points close to a patch; what was close to earlier ones is forgotten."""
        c = self.scene.components
        self.squares[:] = 0.0
        self.near = np.zeros((2, points), dtype=np.int64)
        self.near_count = np.zeros(2, dtype=np.int64)
        self.near_points = np.zeros((2, 2, points))
        self.near_U = np.zeros((2, (2 * c - 1) * len(NODES), points))

    def _gather(self) -> None:
        """Hand everything to the compiled loops."""
        s, c, room, K = self.scene, self.scene.components, len(self.source_of), len(self.contact_of)
        self.product = self.rows if self.precision == "double" else self.single
        kind, m = self.product.dtype, len(s.table)
        width = self.MT.shape[1]
        starts, node_starts = (
            width * np.arange(room * c, dtype=np.int64),
            width * c * np.arange(len(NODES), dtype=np.int64),
        )
        self.met, self.q, self.free = np.zeros(4), np.zeros((room, 2)), np.zeros((room, 2))
        self.t, cross, d, w = (_aligned((2, width), np.dtype(np.float64)) for _ in range(4))
        self.basis: Basis = new_basis(
            s.form, s.frame, s.anchors, s.L_inverse, s.sources, s.felt, s.held, s.columns, s.table, self.at, self.watched,
            self.softness, self.counted, self.source_of, self.contact_of, self.MT, starts, self.gram, self.rows, self.single,
            self.product, self.squares, self.built, self.nodes, self.nodes_held, self.nodes_own, self.nodes_contacts,
            self.nodes_newton, node_starts, self.close, self.near, self.near_count, self.near_points, self.near_U, COEFFICIENTS,
            self.met, self.t, cross, np.zeros((c, m)), np.zeros((c, m)), np.zeros((1, len(NODES))),
            np.zeros((2, DEGREE + 1)), np.zeros((c, c)), np.zeros((2, CHUNK)), d, w, self.q, self.free,
            np.zeros((2, len(self.rows)), kind), np.zeros(len(self.rows), np.int64), _aligned((2, BLOCK), kind),
            np.zeros(K, np.int64), np.zeros(K),
        )  # fmt: skip

    # --- the tip's patches

    def prepare(self, tip: Floats, before: Floats, parts: int = CATCH_UP) -> None:
        """Go on building a patch for where a tip will be soon.

        Parameters
        ----------
        tip, before : ndarray, shape (12,)
            As `touch.TIP`, now and a step ago.
        parts : int
            How many of its parts to build now if the tip has no patch; otherwise one.
        """
        if self.precision == "double":
            return
        begun, built = tend(self.basis, tip, before, parts)
        while begun < 0:
            self._near_room(2 * self.near.shape[1])
            self._gather()
            begun, built = tend(self.basis, tip, before, parts)
        self.statistics.patches += begun
        self.statistics.built += built

    # --- the field

    def field(
        self,
        table: Floats,
        q: Floats,
        tip: Floats = NO_TIP,
        soft: float = 0.0,
        on_tip: int = -1,
        was: Floats = NOT_ASKED,
    ) -> tuple[Floats, float, float]:
        """Displacement of all points.

        Parameters
        ----------
        table : ndarray, shape (k, 7)
            Contacts; all of those that there are.
        q : ndarray, shape (k, 2)
            Their displacements, mm.
        tip : ndarray, shape (12,)
            As `touch.TIP`, mm.
        soft : float
            Softness of the tip's landmark.
        on_tip : int
            Contact for which the tip speaks, or -1.
        was : ndarray, shape (n, 2), optional
            An earlier field, for ``change``.

        Returns
        -------
        field : ndarray, shape (n, 2)
            mm.
        change : float
            Square of the largest change at the sources since the earlier field, mm^2; 0 when not asked.
        reach : float
            Largest displacement at the sources, mm; 0 when not asked for the change.
        """
        mesh, moved, how, reach = field(self.basis, table, q, tip, on_tip, soft, was)
        self.statistics.direct += how == 2
        return mesh, moved, reach

    def before(
        self, table: Floats, q: Floats, tip: Floats, soft: float, point: Floats
    ) -> tuple[float, float]:
        """Field of contacts and an earlier tip at a point (2,) mm, mm."""
        value: tuple[float, float] = field_before(
            self.basis, table, q, tip, soft, float(point[0]), float(point[1])
        )
        return value

    def spline(
        self, table: Floats, q: Floats, tip: Floats = NO_TIP, soft: float = 0.0, on_tip: int = -1
    ) -> Spline:
        """Return the same field as a spline that can be evaluated anywhere, in double precision."""
        s, c, n = self.scene, self.scene.components, self.count * self.scene.components
        d = np.zeros((self.count, 2))
        own = q.copy()
        if on_tip >= 0:
            own[on_tip] = tip[3:5]
        d[self.contact_of[table[:, 0].astype(np.int64)]] = own
        d = d if c == 1 else d.reshape(-1, 1)
        M = np.triu(self.MT[:n, :n]).T
        w = M @ d
        sources = self.source_of[: self.count]
        weights, where = M.T @ w, s.sources[sources]
        coupling = s.held[(c * sources[:, None] + np.arange(c)).ravel()].T
        if tip[0] > 0 and on_tip < 0:
            place = (tip[1:3] - s.centre) / s.scale
            meet_exactly(self.basis, float(place[0]), float(place[1]))
            t, own = self.t[:c, :n], self.met[1:2] if c == 1 else self.met[[1, 2, 2, 3]]
            gap = tip[3:5].reshape(c, 2 // c) - t @ w
            s_tip = np.linalg.solve(own.reshape(c, c) + soft * np.eye(c), gap)
            weights, where = np.vstack([weights - M.T @ (t.T @ s_tip), s_tip]), np.vstack([where, place])
            coupling = np.hstack([coupling, s.coupling(place[None])])
        return s.spline(where, weights, coupling)


def _aligned(shape: tuple[int, ...], kind: np.dtype[Number]) -> NDArray[Number]:
    """Return zeros that begin on the boundary of a cache line: half as fast again to read as others."""
    size = int(np.prod(shape)) * kind.itemsize
    room = np.zeros(size + LINE, dtype=np.uint8)
    start = -room.ctypes.data % LINE
    return room[start : start + size].view(kind).reshape(shape)


def _grown(array: NDArray[Number], shape: tuple[int, ...]) -> NDArray[Number]:
    """Return a larger aligned array of zeros that begins with this one."""
    grown = _aligned(shape, array.dtype)
    grown[tuple(slice(n) for n in array.shape)] = array
    return grown
