"""Weighted sums of rows, 64 columns at a time, with the sums in registers: the product that a step is made of.

As a loop over arrays the sums would go through memory for every four rows, where some row's place always collides with
theirs; that cost a third more than the product itself. The compiler cannot be talked into registers, so this one loop is
written in its own language. `numpy`'s reading: ``out[:, :64] = weights[:, :count] @ rows.ravel()[offsets + start + range(64)]``.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

BLOCK = 64
"""Columns of one call; rows are padded to multiples of it."""

LANES = 16
"""Numbers in a vector of the loop; the compiler cuts it into the machine's own."""

FLAGS = ["contract", "reassoc"]


def _vectors_at_once() -> int:
    """Vectors of a block whose sums fit into the registers together."""
    try:
        wide = binding.get_host_cpu_features().get("avx512f", False)
    except RuntimeError:  # not every processor can be asked
        wide = False
    return BLOCK // LANES if wide else BLOCK // LANES // 2


def _sum_block(several: int) -> Any:
    """Make the loop for that many sums of the same rows."""

    def sum_block(
        _typing: Any, rows: Any, offsets: Any, weights: Any, count: Any, start: Any, out: Any
    ) -> Any:
        signature = types.void(rows, offsets, weights, count, start, out)

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            def array(i: int) -> Any:
                return context.make_array(sig.args[i])(context, builder, args[i])

            number, whole = context.get_value_type(sig.args[0].dtype), ir.IntType(64)
            size = context.get_abi_sizeof(context.get_data_type(sig.args[0].dtype))
            vector, short = ir.VectorType(number, LANES), ir.IntType(32)
            nothing, zeros = ir.Constant(vector, ir.Undefined), ir.Constant(vector, [0.0] * LANES)
            everywhere = ir.Constant(ir.VectorType(short, LANES), [0] * LANES)

            def line_of(owner: Any, i: int) -> Any:
                step = builder.mul(builder.extract_value(owner.strides, 0), ir.Constant(whole, i))
                place = builder.add(builder.ptrtoint(owner.data, whole), step)
                return builder.inttoptr(place, number.as_pointer())

            def vector_at(place: Any, i: int) -> Any:
                return builder.bitcast(
                    builder.gep(place, [ir.Constant(whole, i * LANES)]), vector.as_pointer()
                )

            given, target = array(2), array(5)
            shares, sums = ([line_of(owner, i) for i in range(several)] for owner in (given, target))
            first, order = builder.gep(array(0).data, [args[4]]), array(1).data
            at_once = _vectors_at_once()
            for part in range(0, BLOCK // LANES, at_once):
                kept = [
                    [cgutils.alloca_once_value(builder, zeros) for _ in range(at_once)]
                    for _ in range(several)
                ]
                for slot in (s for line in kept for s in line):
                    builder.store(zeros, slot)
                with cgutils.for_range(builder, args[3]) as loop:
                    row = builder.gep(first, [builder.load(builder.gep(order, [loop.index]))])
                    spread = []
                    for line in shares:
                        share = builder.load(builder.gep(line, [loop.index]))
                        one = builder.insert_element(nothing, share, ir.Constant(short, 0))
                        spread.append(builder.shuffle_vector(one, nothing, everywhere))
                    for v in range(at_once):
                        values = builder.load(vector_at(row, part + v), align=size)
                        for share, line in zip(spread, kept, strict=True):
                            product = builder.fmul(share, values, flags=FLAGS)
                            builder.store(builder.fadd(product, builder.load(line[v]), flags=FLAGS), line[v])
                for place, line in zip(sums, kept, strict=True):
                    for v in range(at_once):
                        builder.store(builder.load(line[v]), vector_at(place, part + v), align=size)
            return context.get_dummy_value()

        return signature, generate

    return intrinsic(sum_block)


sum_block, sum_block_twice = _sum_block(1), _sum_block(2)
"""(rows, offsets, weights, count, start, out): for the first (two) lines of ``weights`` and ``out``, the sum over ``count``
rows of weight times 64 columns; row i begins ``offsets[i]`` numbers after the start of ``rows``, its columns at ``start``."""
