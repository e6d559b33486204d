"""How the mesh answers the landmarks that move: kept between steps, updated when contacts come and go.

With the anchors held (`anchored_kernel`), contacts C with displacements d move the mesh by H d, H = G_:C P with
P = (G_CC + D)^-1. H is kept, one row per contact; a step reads it once. A contact that joins or leaves changes H and P by a
product of one column and one row; nothing is refitted. Rounding that this gathers is watched at the landmarks, and H is
rebuilt when it grows. The tip moves at every step, so its row cannot be kept; `tip_patch` interpolates it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from echospline.errors import SolverError
from echospline.grid import Floats
from echospline.mechanics.anchored_kernel import AnchoredKernel
from echospline.mechanics.compiled_step import at_point, begin_patch, spread
from echospline.mechanics.contacts import build_rows, drop, join, misfit
from echospline.mechanics.spline import Spline
from echospline.mechanics.tip_patch import COEFFICIENTS, DEGREE, NODES, TipPatch

RESIDUAL = 1e-6
"""mm; misfit at the landmarks, for displacements of 1 mm, at which H is rebuilt."""

ROWS_PER_STEP = 3
"""How many rows of a new patch one step builds: the patch is ready after seven steps, and no step takes long."""

LINE = 64
"""Bytes in a cache line."""

Singles = NDArray[np.float32]
Precision = Literal["single", "double"]
NO_TIP = np.zeros(12)
Number = TypeVar("Number", bound=np.generic)
Quantities = tuple[Floats, Floats, Floats, Floats, Floats]


@dataclass
class Statistics:
    """What the response has done so far.

    Parameters
    ----------
    joined, left : int
        Contacts added and removed by an update.
    rebuilt : int
        How often H was built anew because rounding had grown past `RESIDUAL`.
    patches : int
        How often a patch was begun for the tip.
    direct : int
        How often the tip's row was evaluated directly.
    residual : float
        Largest misfit at the landmarks seen after an update, mm for displacements of 1 mm.
    """

    joined: int = 0
    left: int = 0
    rebuilt: int = 0
    patches: int = 0
    direct: int = 0
    residual: float = 0.0


class Response:
    """Rows of H for the current contacts, and of the tip, at all points of an `AnchoredKernel`.

    A workspace: it holds no state of the tissue, only what follows from the set of contacts, so it may be asked about
    any set at any time; the closer to the last one, the cheaper. Not safe for use by two threads at once.

    Parameters
    ----------
    scene : AnchoredKernel
        Anchors, evaluation points, and the sources that may become contacts.
    precision : {"single", "double"}
        Of the product that gives the field. Factors are always double. "single" also interpolates the tip's row.
    at : ndarray of int, shape (K,)
        Which evaluation point each source is.
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
        c = scene.components
        self.sources_in_patch = len(NODES) if precision == "single" else 0
        self.head = c * (self.sources_in_patch + 1)
        """Rows before those of the contacts: those of the tip's patch, then the tip's own when it is evaluated."""
        self.count = 0
        self.slot_of_source = np.full(len(scene.sources), -1, dtype=np.int64)
        self.slots: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self.inverse: Floats = np.empty((0, 0))
        self.gram: Floats = np.empty((0, 0))
        self.toq: Floats = np.empty((0, c * len(NODES)))
        # rows as long as whole cache lines, so that all of them begin on one; what is beyond the points stays unused
        self.rows: Floats = np.empty((0, -(-c * len(scene.points) * 4 // LINE) * LINE // 4))
        self.single: Singles = np.empty(self.rows.shape, dtype=np.float32)
        self.product: Floats | Singles = self.rows
        self._reserve(32)
        self._forget_patch()

    # --- contacts

    def set_contacts(self, sources: ArrayLike) -> NDArray[np.int64]:
        """Make these the contacts and say in which slot each stands.

        Parameters
        ----------
        sources : array_like of int, shape (k,)
            Indices of sources, each once.

        Returns
        -------
        ndarray of int, shape (k,)

        Raises
        ------
        SolverError
            If two of them lie too close together.
        """
        wanted = np.asarray(sources, dtype=np.int64).reshape(-1)
        member = np.zeros(len(self.slot_of_source), dtype=bool)
        member[wanted] = True
        gone = np.flatnonzero(~member[self.slots[: self.count]])
        if len(gone):
            self._drop(gone)
        new = wanted[self.slot_of_source[wanted] < 0]
        if len(new):
            self._join(new)
        if len(gone) or len(new):
            worst = misfit(self.inverse, self.gram, self.count * self.scene.components)
            self.statistics.residual = max(self.statistics.residual, worst)
            if not worst <= RESIDUAL:
                self.rebuild()
        return self.slot_of_source[wanted]

    def rebuild(self) -> None:
        """Build H and P anew.

        Raises
        ------
        SolverError
            If they cannot be had to `RESIDUAL`.
        """
        names = self.slots[: self.count].copy()
        self.count = 0
        self._forget_patch()
        self._append(names)
        self.statistics.rebuilt += 1
        worst = misfit(self.inverse, self.gram, self.count * self.scene.components)
        if not worst <= RESIDUAL:
            raise SolverError(
                f"the spline misses its landmarks by {worst:.1e} mm: two of the {len(names)} contacts lie too close "
                "together; thin them out or give them a finite stiffness"
            )

    def _join(self, new: NDArray[np.int64]) -> None:
        self._append(new)
        self.statistics.joined += len(new)

    def _append(self, new: NDArray[np.int64]) -> None:
        s = self.scene
        self._reserve(self.count + len(new))
        patch = self.sources_in_patch if self.patch is not None else 0
        told_apart = join(
            s.form, s.columns, s.table, s.sources, s.felt, s.held, new, self.softness[new], self.slots, self.count,
            self.inverse, self.gram, self.rows, self.single, self.head, patch, self.built, self.at[new], self.toq,
            self.patch_nodes, self.patch_held,
        )  # fmt: skip
        if not told_apart:
            raise SolverError(
                f"{len(new)} contacts cannot be told apart from others: they lie too close together; thin them out "
                "or give them a finite stiffness"
            )
        self.count += len(new)
        self._number()

    def _drop(self, gone: NDArray[np.int64]) -> None:
        patch = self.sources_in_patch if self.patch is not None else 0
        drop(
            self.scene.components, gone, self.slots, self.count, self.inverse, self.gram, self.rows, self.single, self.head,
            patch, self.built, self.toq,
        )  # fmt: skip
        self.count -= len(gone)
        self.statistics.left += len(gone)
        self._number()

    def _number(self) -> None:
        self.slot_of_source[:] = -1
        self.slot_of_source[self.slots[: self.count]] = np.arange(self.count)

    def _reserve(self, contacts: int) -> None:
        """Have room for that many contacts."""
        have = len(self.slots)
        if have >= contacts:
            return
        c, room = self.scene.components, max(contacts, 2 * have)
        self.slots = _grown(self.slots, (room,))
        self.inverse = _grown(self.inverse, (room * c, room * c))
        self.gram = _grown(self.gram, (room * c, room * c))
        self.toq = _grown(self.toq, (room * c, self.toq.shape[1]))
        shape = (self.head + room * c, self.rows.shape[1])
        self.rows, self.single = _grown(self.rows, shape), _grown(self.single, shape)
        self.product = self.rows if self.precision == "double" else self.single

    # --- the tip's patch

    def _forget_patch(self) -> None:
        self.patch: TipPatch | None = None
        self.built = 0
        self.square = np.zeros(3)
        self.patch_nodes, self.patch_held = np.empty((0, 2)), np.empty((0, self.scene.table.shape[0]))
        self.near, self.rough = np.empty(0, dtype=np.int64), np.empty((0, len(NODES)))

    def prepare(self, tip: Floats, ahead: Floats, rows: int = ROWS_PER_STEP) -> None:
        """Go on building the patch for a tip (conditioned) that its patch does not hold; ``ahead`` is its direction."""
        if not self.sources_in_patch:
            return
        if self.patch is None or not self.patch.holds(float(tip[0]), float(tip[1])):
            self._forget_patch()
            patch = TipPatch.around(tip, ahead, self.scene.anchors, self.scene.scale)
            if patch is None:
                return
            self._begin(patch)
        end = min(self.sources_in_patch, self.built + rows)
        if end > self.built:
            s = self.scene
            build_rows(
                s.form, s.columns, s.table, self.patch_nodes, self.patch_held, self.toq, self.rows, self.single, self.head,
                self.count, self.built, end,
            )  # fmt: skip
            self.built = end
        if self.patch is not None and self.built == self.sources_in_patch:
            self.square = np.array([*self.patch.centre, self.patch.half])

    def _begin(self, patch: TipPatch) -> None:
        s = self.scene
        self.patch, self.patch_nodes = patch, patch.nodes
        self.patch_held, self.near, self.rough = begin_patch(
            s.form, patch.nodes, np.array(patch.centre), patch.near, s.anchors, s.L_inverse, s.sources, s.felt, self.slots,
            self.count, self.inverse, s.columns, self.toq,
        )  # fmt: skip
        self.statistics.patches += 1

    # --- the field

    def at_point(self, point: Floats) -> Quantities:
        """What a conditioned point has to do with the landmarks (`compiled_step.at_point`)."""
        s = self.scene
        quantities: Quantities = at_point(
            s.form, float(point[0]), float(point[1]), s.anchors, s.L_inverse, s.sources, s.felt, self.slots, self.count,
            self.inverse,
        )  # fmt: skip
        return quantities

    def field(
        self,
        slot_of: NDArray[np.int64],
        q: Floats,
        tip: Floats = NO_TIP,
        soft: float = 0.0,
        on_tip: int = -1,
        nodes: NDArray[np.int64] | None = None,
        was: Floats | None = None,
    ) -> tuple[Floats, float]:
        """Displacement of all points.

        Parameters
        ----------
        slot_of : ndarray of int, shape (k,)
            Slots of the contacts.
        q : ndarray, shape (k, 2)
            Their displacements, mm.
        tip : ndarray, shape (12,)
            As `compiled_step.TIP`, mm.
        soft : float
            Softness of the tip's landmark.
        on_tip : int
            Contact for which the tip speaks, or -1.
        nodes, was : ndarray, optional
            Points at which the change since an earlier field is asked for.

        Returns
        -------
        field : ndarray, shape (n, 2)
            mm.
        change : float
            Square of the largest change at ``nodes``, mm^2.
        """
        s = self.scene
        nodes = np.empty(0, dtype=np.int64) if nodes is None else nodes
        was = np.empty((0, 2)) if was is None else was
        place = (tip[1:3] - s.centre) / s.scale
        quantities = self.at_point(place)
        mesh, change, how, _ = spread(
            s.form, s.frame, s.columns, s.table, self.rows, self.single, self.product, self.head, slot_of, q, tip, on_tip,
            soft, quantities, self.square, COEFFICIENTS, DEGREE, self.toq, self.near, self.rough, nodes, was,
        )  # fmt: skip
        self.statistics.direct += how == 2
        return mesh, change

    def spline(
        self, slot_of: NDArray[np.int64], q: Floats, tip: Floats = NO_TIP, soft: float = 0.0, on_tip: int = -1
    ) -> Spline:
        """Return the same field as a spline that can be evaluated anywhere, in double precision."""
        s, c, n = self.scene, self.scene.components, self.count * self.scene.components
        own = q.copy()
        if on_tip >= 0:
            own[on_tip] = tip[3:5]
        d = np.zeros((self.count, 2))
        d[slot_of] = own
        d = d if c == 1 else d.reshape(-1, 1)
        slots = self.slots[: self.count]
        weights, where = self.inverse[:n, :n] @ d, s.sources[slots]
        coupling = s.held[(c * slots[:, None] + np.arange(c)).ravel()].T
        if tip[0] > 0 and on_tip < 0:
            place = (tip[1:3] - s.centre) / s.scale
            _, _, _, h, free = self.at_point(place)
            gap = tip[3:5].reshape(c, 2 // c) - h @ d
            w = np.linalg.solve(free + soft * np.eye(c), gap)
            weights, where = np.vstack([weights - h.T @ w, w]), np.vstack([where, place])
            coupling = np.hstack([coupling, s.coupling(place[None])])
        return s.spline(where, weights, coupling)


def _grown(array: NDArray[Number], shape: tuple[int, ...]) -> NDArray[Number]:
    """Return a larger array of zeros that begins with this one, on the boundary of a cache line."""
    size = int(np.prod(shape)) * array.itemsize
    room = np.zeros(size + LINE, dtype=np.uint8)
    start = -room.ctypes.data % LINE
    grown = room[start : start + size].view(array.dtype).reshape(shape)
    grown[tuple(slice(n) for n in array.shape)] = array
    return grown
