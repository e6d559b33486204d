"""How the mesh answers the landmarks that move: kept between steps, updated when contacts come and go.

With the anchors held (`anchored_kernel`), contacts C with displacements d move the mesh by H d, H = G_:C G_CC^-1. H is kept,
one row per contact; a step reads it once. A contact that joins or leaves changes H and G_CC^-1 by a product of one column
and one row; nothing is refitted. Rounding that this gathers is watched at the landmarks, and H is rebuilt when it grows.
The tip moves at every step, so its row cannot be kept; `tip_patch` interpolates it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from echospline.errors import SolverError
from echospline.grid import Floats
from echospline.mechanics.anchored_kernel import AnchoredKernel, interleaved
from echospline.mechanics.compiled import add_product, update_rows
from echospline.mechanics.spline import Spline
from echospline.mechanics.tip_patch import HALF_WIDTH, NEAR, NODES, SMALLEST, TipPatch

RESIDUAL = 1e-6
"""mm; misfit at the landmarks, for displacements of 1 mm, at which H is rebuilt."""

Singles = NDArray[np.float32]
Precision = Literal["single", "double"]


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
        How often the tip entered a new patch.
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


@dataclass(frozen=True)
class Tip:
    """A landmark that is not one of the contacts, because it moves.

    Parameters
    ----------
    point : ndarray, shape (2,)
        Where it is, conditioned.
    displacement : ndarray, shape (2,)
        mm.
    softness : float
        Diagonal added (`AnchoredKernel.compliance`); 0 interpolates.
    """

    point: Floats
    displacement: Floats
    softness: float = 0.0


class Response:
    """Rows of H for the current contacts, and of the tip, at all points of an `AnchoredKernel`.

    A workspace: it holds no state of the tissue, only what can be derived from the set of contacts, so it may be asked
    about any set at any time; the closer to the last one, the cheaper. Not safe for use by two threads at once.

    Parameters
    ----------
    scene : AnchoredKernel
        Anchors and evaluation points.
    precision : {"single", "double"}
        Of the product that gives the field. Factors are always double. "single" also interpolates the tip's row.
    """

    def __init__(self, scene: AnchoredKernel, precision: Precision = "single") -> None:
        self.scene = scene
        self.precision = precision
        self.statistics = Statistics()
        c = scene.components
        self.lead = c * len(NODES) if precision == "single" else 0
        """Rows before those of the contacts: those of the tip's patch."""
        self.contacts: list[int] = []
        self.where = np.empty((0, 2))
        self.softness = np.empty(0)
        self.inverse = np.empty((0, 0))
        self.patch: TipPatch | None = None
        self.near = np.empty(0, dtype=np.intp)
        self.coupling = np.empty((0, self.lead))
        self.among = np.zeros((self.lead, self.lead))
        self.rows = np.zeros((0, scene.table.shape[1]))
        self.single = np.zeros(self.rows.shape, dtype=np.float32)
        self._reserve(32)

    # --- contacts

    def set_contacts(
        self, contacts: Sequence[int] | NDArray[np.intp], points: Floats, softness: Floats | None = None
    ) -> NDArray[np.intp]:
        """Make these the contacts and say in which row each stands.

        Parameters
        ----------
        contacts : sequence of int, length k
            Names of the landmarks (node indices), each once; a name keeps its point and softness.
        points : ndarray, shape (k, 2)
            Where they are, conditioned.
        softness : ndarray, shape (k,), optional
            Diagonal added to G_CC (`AnchoredKernel.compliance`); 0 interpolates.

        Returns
        -------
        ndarray of int, shape (k,)
            Row of each contact, counted after the leading ones.
        """
        wanted = [int(i) for i in contacts]
        row = {name: i for i, name in enumerate(self.contacts)}
        gone = set(row) - set(wanted)
        if gone:
            if 2 * len(gone) > len(row) + 8:
                self._clear()
            else:
                self._drop(sorted(row[name] for name in gone))
            row = {name: i for i, name in enumerate(self.contacts)}
        new = [i for i, name in enumerate(wanted) if name not in row]
        if new:
            soft = np.zeros(len(wanted)) if softness is None else softness
            self._join([wanted[i] for i in new], points[new], soft[new])
            row = {name: i for i, name in enumerate(self.contacts)}
        if gone or new:
            self._watch()
        return np.array([row[name] for name in wanted], dtype=np.intp)

    def _clear(self) -> None:
        self.statistics.left += len(self.contacts)
        self.contacts, self.where, self.softness = [], np.empty((0, 2)), np.empty(0)
        self.inverse = np.empty((0, 0))
        self.patch = None

    def _join(self, names: list[int], points: Floats, softness: Floats) -> None:
        """Append contacts: the bordered inverse of G_CC, and the rows of H that this changes."""
        scene, c, k = self.scene, self.scene.components, len(self.contacts)
        self._reserve(k + len(names))
        head, tail = self.lead, self.lead + k * c
        H = self.rows[head:tail]
        cross = scene.between(points, self.where)
        U = cross @ self.inverse
        S = scene.between(points, points) + np.diag(np.repeat(softness, c)) - U @ cross.T
        try:
            S_inverse = np.linalg.inv(0.5 * (S + S.T))
        except np.linalg.LinAlgError as error:
            raise SolverError(
                f"landmarks at nodes {names} cannot be told from others; thin them out"
            ) from error
        E = scene.rows(points)
        add_product(E, np.ascontiguousarray(-cross), H)
        T = np.zeros_like(E)
        add_product(T, S_inverse, E)
        update_rows(H, self.single[head:tail], np.ascontiguousarray(-U.T), T)
        end = tail + len(T)
        self.rows[tail:end] = T
        self.single[tail:end] = T
        if self.patch is not None:
            e = scene.between(self.patch.nodes, points) - self.coupling.T @ cross.T
            update_rows(self.rows[:head], self.single[:head], -e, T)
            self.among -= e @ S_inverse @ e.T
            self.coupling = np.vstack([self.coupling - U.T @ S_inverse @ e.T, S_inverse @ e.T])
        P = self.inverse + U.T @ S_inverse @ U
        corner = -U.T @ S_inverse
        self.inverse = np.block([[P, corner], [corner.T, S_inverse]])
        self.contacts = self.contacts + names
        self.where = np.vstack([self.where, points])
        self.softness = np.concatenate([self.softness, softness])
        self.statistics.joined += len(names)

    def _drop(self, gone: list[int]) -> None:
        """Remove contacts: the inverse of what remains, and the rows of H that this changes."""
        c, k = self.scene.components, len(self.contacts)
        kept = np.setdiff1d(np.arange(k), gone)
        D = (np.asarray(gone)[:, None] * c + np.arange(c)).ravel()
        K = (kept[:, None] * c + np.arange(c)).ravel()
        head = self.lead
        P, H = self.inverse, self.rows[head : head + k * c]
        felt = self.coupling[D] if self.patch is not None else np.empty((len(D), 0))
        share = np.linalg.solve(P[np.ix_(D, D)], np.hstack([P[np.ix_(D, K)], felt]))
        T = H[D]
        # the last rows move into the gaps, so that the rows stay together
        fill, holes = [i for i in kept if i >= len(kept)], [i for i in gone if i < len(kept)]
        order = np.arange(len(kept))
        order[holes] = fill
        rank = np.searchsorted(kept, order)
        moved = (np.asarray(fill, dtype=int)[:, None] * c + np.arange(c)).ravel()
        into = (np.asarray(holes, dtype=int)[:, None] * c + np.arange(c)).ravel()
        H[into] = H[moved]
        R = (rank[:, None] * c + np.arange(c)).ravel()
        tail = head + len(K)
        left = share[:, : len(K)]
        update_rows(self.rows[head:tail], self.single[head:tail], np.ascontiguousarray(-left[:, R].T), T)
        if self.patch is not None:
            u = share[:, len(K) :]
            update_rows(self.rows[:head], self.single[:head], np.ascontiguousarray(u.T), T)
            self.among += self.coupling[D].T @ u
            self.coupling = np.ascontiguousarray((self.coupling[K] - P[np.ix_(K, D)] @ u)[R])
        remaining = P[np.ix_(K, K)] - P[np.ix_(K, D)] @ left
        self.inverse = np.ascontiguousarray((0.5 * (remaining + remaining.T))[np.ix_(R, R)])
        self.contacts = [self.contacts[i] for i in order]
        self.where = np.ascontiguousarray(self.where[order])
        self.softness = self.softness[order]
        self.statistics.left += len(gone)

    def misfit(self) -> float:
        """Largest misfit at the contacts, mm for displacements of 1 mm: |(G_CC + D) G_CC^-1 - I|."""
        if not self.contacts:
            return 0.0
        c = self.scene.components
        G = self.scene.between(self.where, self.where) + np.diag(np.repeat(self.softness, c))
        return float(np.abs(G @ self.inverse - np.eye(len(G))).max())

    def _watch(self) -> None:
        misfit = self.misfit()
        self.statistics.residual = max(self.statistics.residual, misfit)
        if misfit > RESIDUAL:
            self.rebuild()

    def rebuild(self) -> None:
        """Build H and the inverse of G_CC anew."""
        names, where, softness = self.contacts, self.where, self.softness
        joined, left = self.statistics.joined, self.statistics.left
        self._clear()
        self._join(names, where, softness)
        self.statistics.joined, self.statistics.left = joined, left
        self.statistics.rebuilt += 1
        misfit = self.misfit()
        if misfit > RESIDUAL:
            raise SolverError(
                f"the spline misses its landmarks by {misfit:.1e} mm: two of the {len(names)} lie too close "
                "together; thin them out or give them a finite stiffness"
            )

    def _reserve(self, contacts: int) -> None:
        """Have room for that many contacts."""
        need, have = self.lead + contacts * self.scene.components, len(self.rows)
        if have >= need:
            return
        rows = np.zeros((max(need, 2 * have), self.rows.shape[1]))
        single = np.zeros(rows.shape, dtype=np.float32)
        rows[:have], single[:have] = self.rows, self.single
        self.rows, self.single = rows, single

    # --- the field

    def field(self, q: Floats, tip: Tip | None = None) -> Floats:
        """Displacement of all points.

        Parameters
        ----------
        q : ndarray, shape (k, 2)
            Displacements of the contacts, in the order of their rows, mm.
        tip : Tip, optional
            A landmark besides.

        Returns
        -------
        ndarray, shape (n, 2)
            mm.
        """
        scene, c, k = self.scene, self.scene.components, len(self.contacts)
        d = q if c == 1 else q.reshape(-1, 1)
        rows = self.rows if self.precision == "double" else self.single
        if tip is None:
            return self._product(rows[self.lead : self.lead + k * c], d)
        patch = self._patch(tip.point)
        if patch is None:
            cross = self.scene.between(tip.point[None], self.where)
            h = cross @ self.inverse
            own = self.scene.between(tip.point[None], tip.point[None])
            s = np.linalg.solve(own - h @ cross.T + tip.softness * np.eye(c), self._gap(tip, h, q))
            row = self.scene.rows(tip.point[None])
            add_product(row, np.ascontiguousarray(-cross), self.rows[self.lead : self.lead + k * c])
            self.statistics.direct += 1
            u = self._product(rows[self.lead : self.lead + k * c], d)
            return u + _vectors(row.T @ s, c)
        L: Floats = np.kron(patch.weights(tip.point)[:, None], np.eye(c)).astype(np.float64)
        dC = self._rough(self.where, tip.point, patch, L)
        v, w = L.T @ self.coupling.T, self.inverse @ dC
        own = (
            scene.kernel.matrix(scene.points[:1], scene.points[:1])
            + L.T @ self.among @ L
            - v @ dC
            - dC.T @ v.T
            - dC.T @ w
        )
        s = np.linalg.solve(own + tip.softness * np.eye(c), self._gap(tip, v + w.T, q))
        u = self._product(rows[: self.lead + k * c], np.vstack([L @ s, d - dC @ s]))
        near = self.near
        u[near] += (self._rough(self.scene.points[near], tip.point, patch, L) @ s).reshape(-1, 2)
        return u

    def _gap(self, tip: Tip, h: Floats, q: Floats) -> Floats:
        """What the tip wants less what the contacts alone give there, shape (c, 2 / c), mm."""
        c = self.scene.components
        given = h @ (q if c == 1 else q.reshape(-1, 1))
        return tip.displacement.reshape(c, 2 // c) - given

    def _rough(self, points: Floats, tip: Floats, patch: TipPatch, L: Floats) -> Floats:
        """U(x, tip) less its interpolant in the patch; 0 beyond the patch's reach. Shape (n c, c)."""
        c, U = self.scene.components, self.scene.kernel.matrix
        both = [interleaved(interleaved(U(points, y), c).T, c).T for y in (tip[None], patch.nodes)]
        rough = both[0] - both[1] @ L
        rough[np.repeat(np.hypot(*(points - patch.centre).T) > patch.near, c)] = 0.0
        return rough

    def _product(self, rows: Singles | Floats, weights: Floats) -> Floats:
        """Rows weighted and added up, as vectors."""
        out = np.zeros((weights.shape[1], rows.shape[1]), dtype=rows.dtype)
        add_product(out, np.ascontiguousarray(weights.T.astype(rows.dtype)), rows)
        return (
            out.T.astype(np.float64)
            if self.scene.components == 1
            else out.reshape(2, -1).T.astype(np.float64)
        )

    def _patch(self, tip: Floats) -> TipPatch | None:
        """Return the patch that holds the tip, built anew where necessary; None where none can be."""
        if not self.lead:
            return None
        x, y = float(tip[0]), float(tip[1])
        if self.patch is not None and self.patch.holds(x, y):
            return self.patch
        scene, c, k = self.scene, self.scene.components, len(self.contacts)
        held = float(np.hypot(*(scene.anchors - tip).T).min())
        half = min(HALF_WIDTH / scene.scale, held / NEAR)
        if half * scene.scale < SMALLEST:
            self.patch = None
            return None
        patch = TipPatch((x, y), half)
        cross = scene.between(patch.nodes, self.where)
        E = scene.rows(patch.nodes)
        add_product(E, np.ascontiguousarray(-cross), self.rows[self.lead : self.lead + k * c])
        self.rows[: self.lead] = E
        self.single[: self.lead] = E
        self.coupling = self.inverse @ cross.T
        U = scene.kernel.matrix(patch.nodes, patch.nodes)
        rough = interleaved(interleaved(U, c).T, c).T
        self.among = scene.between(patch.nodes, patch.nodes) - rough - cross @ self.coupling
        self.near = np.flatnonzero(np.hypot(*(scene.points - patch.centre).T) <= patch.near)
        self.patch = patch
        self.statistics.patches += 1
        return patch

    def spline(self, q: Floats, tip: Tip | None = None) -> Spline:
        """Return the same field as a spline that can be evaluated anywhere, in double precision."""
        scene, c = self.scene, self.scene.components
        where, inverse, d = self.where, self.inverse, q if c == 1 else q.reshape(-1, 1)
        weights = inverse @ d
        if tip is not None:
            cross = scene.between(tip.point[None], where)
            h = cross @ inverse
            own = scene.between(tip.point[None], tip.point[None]) - h @ cross.T
            s = np.linalg.solve(own + tip.softness * np.eye(c), self._gap(tip, h, q))
            weights, where = np.vstack([weights - h.T @ s, s]), np.vstack([where, tip.point])
        return scene.spline(where, weights)


def _vectors(blocked: Floats, c: int) -> Floats:
    """Rows of (n, 2), or blocks (2 n, 1), as vectors (n, 2)."""
    return blocked if c == 1 else blocked.reshape(2, -1).T
