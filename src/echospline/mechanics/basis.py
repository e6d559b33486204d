"""What the compiled loops read and keep, in one object: a call with forty arrays costs more than the sums of a small step.

With G the anchored kernel (`anchored_kernel`) and C the contacts, G_CC + D = L L' (Cholesky; D the softness of the
contacts). Kept are M = L^-1 and the rows E = G_:C M', the *Newton basis* of the contacts: contacts with displacements d
move the mesh by E (M d). A contact that joins appends one row to both and leaves the others as they are; one that
leaves turns the rows after it (`contacts`). M. Pazouki and R. Schaback, Bases for kernel-based spaces, 2011.

Everything is flat: contact i has the indices i c ... i c + c - 1 for a kernel of c components, and a row holds the x
displacement of all n points, then (c = 2) the y displacement.
"""

from __future__ import annotations

from typing import Any

from numba import njit, types
from numba.experimental import structref

from echospline.mechanics.compiled import OPTIONS

FIELDS = {
    # the scene, as `anchored_kernel.AnchoredKernel` has it
    "form": "(3,) the kernel: components, coupling, radius^2",
    "frame": "(3,) centre x, y and scale, mm",
    "anchors": "(b, 2)",
    "L_inverse": "(m, m) L_B^-1",
    "sources": "(K, 2) where contacts may stand",
    "felt": "(K c, m) [U_yB P_y] of the sources",
    "held": "(K c, m) L_B^-1 of those",
    "points": "(2, n)",
    "table": "(m, n c) [U_xB P_x]'",
    "at": "(K,) which point each source is",
    "watched": "(n,) marks of those points (`mesh_field.largest`), or empty",
    "softness": "(K,) D of each source",
    # the contacts
    "count": "(1,) how many, k",
    "source_of": "(room,) source of each contact",
    "contact_of": "(K,) contact at each source, or -1",
    "MT": "(room c, whole blocks) M', whose rows are summed: zero before the diagonal",
    "starts": "(room c,) where each of those rows begins, in numbers",
    "gram": "(room c, room c) G_CC + D",
    "rows": "(2 Q c + c + room c, n c) rows of the two patches, the tip's own, those of the contacts: E",
    "single": "the same in single precision",
    "product": "rows or single: what is multiplied",
    # the tip's patches, two of each (`tip_column`)
    "squares": "(2, 3) centre and half side; half 0: none",
    "built": "(2,) at how many points the rows of a patch are there",
    "nodes": "(2, Q, 2) interpolation points",
    "nodes_held": "(2, Q c, m) L_B^-1 [U_qB P_q]",
    "nodes_own": "(2, Q c, Q c) G of the nodes without U",
    "nodes_contacts": "(2, Q c, whole blocks) G of nodes and contacts, without U for close contacts",
    "nodes_newton": "(2, Q c, whole blocks) the part of each node's row that E carries",
    "node_starts": "(Q,) where the rows of each node begin, in numbers",
    "close": "(2, room) 1 for a contact close to the patch",
    "near": "(2, j) points close to a patch",
    "near_count": "(2,) how many",
    "near_points": "(2, 2, j) where they are",
    "near_U": "(2, (2 c - 1) Q, j) U of those and the nodes: xx, then xy and yy",
    "coefficients": "(Q, Q) from values at the nodes to Chebyshev coefficients",
    # room for sums, overwritten by every call
    "met": "(4,) patch of a point or -1; G there less what the contacts explain: xx, xy, yy",
    "t": "(2, whole blocks) Newton basis at that point",
    "cross": "(2, whole blocks) G of that point and the contacts",
    "tip_felt": "(2, m)",
    "tip_held": "(2, m)",
    "shares": "(1, Q)",
    "polynomials": "(2, degree + 1)",
    "own": "(c, c)",
    "rough": "(2, CHUNK)",
    "d": "(2, whole blocks) displacements of the contacts",
    "w": "(2, whole blocks) M d",
    "q": "(room, 2)",
    "free": "(room, 2)",
    "weights": "(2, rows)",
    "offsets": "(rows,) where each row that is summed begins, in numbers",
    "sums": "(2, BLOCK)",
    "touched": "(K,)",
    "alongs": "(K,)",
}
"""Name, shape and meaning of everything in a basis; lengths conditioned as in `anchored_kernel` unless stated."""


@structref.register
class _BasisType(types.StructRef):
    def preprocess_fields(self, fields: Any) -> Any:
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class Basis(structref.StructRefProxy):
    """The arrays of `FIELDS`, for the compiled loops; made by `new_basis`."""


structref.define_proxy(Basis, _BasisType, list(FIELDS))


@njit(**OPTIONS)
def new_basis(
    form: Any, frame: Any, anchors: Any, L_inverse: Any, sources: Any, felt: Any, held: Any, points: Any,
    table: Any, at: Any, watched: Any, softness: Any, count: Any, source_of: Any, contact_of: Any, MT: Any, starts: Any, gram: Any,
    rows: Any, single: Any, product: Any, squares: Any, built: Any, nodes: Any, nodes_held: Any,
    nodes_own: Any, nodes_contacts: Any, nodes_newton: Any, node_starts: Any, close: Any, near: Any, near_count: Any,
    near_points: Any, near_U: Any, coefficients: Any, met: Any, t: Any, cross: Any, tip_felt: Any,
    tip_held: Any, shares: Any, polynomials: Any,
    own: Any, rough: Any, d: Any, w: Any, q: Any, free: Any, weights: Any, offsets: Any, sums: Any, touched: Any,
    alongs: Any,
) -> Any:  # fmt: skip
    """Put the arrays of `FIELDS` together, in that order."""
    return Basis(
        form, frame, anchors, L_inverse, sources, felt, held, points, table, at, watched, softness, count,
        source_of, contact_of, MT, starts, gram, rows, single, product, squares, built, nodes, nodes_held,
        nodes_own, nodes_contacts, nodes_newton, node_starts, close, near, near_count, near_points, near_U,
        coefficients, met, t, cross, tip_felt, tip_held, shares, polynomials, own, rough, d, w, q, free, weights, offsets, sums, touched,
        alongs,
    )  # fmt: skip
