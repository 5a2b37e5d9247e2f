"""Register tiles of small matrix products, written for LLVM with explicit vectors.

Numba has no vector types, and LLVM keeps no accumulators in registers across two nested loops, so the innermost part
of a product is emitted here as vector instructions. Matrices are the activations [channels, BLOCK] of one block of
samples, flattened with row stride ``STRIDE``; vectors run over samples.
"""

from __future__ import annotations

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

BLOCK = 128  # samples of a block: its activations stay in the second-level cache
STRIDE = BLOCK + 16  # rows of one column must not fall on the same cache sets
_WIDE = bool(llvmlite.binding.get_host_cpu_features().get("avx512f"))
LANES = 16 if _WIDE else 8
VECTORS = 2  # of samples in a product's tile
ROWS = 8 if _WIDE else 4  # of outputs in a product's tile: ROWS * VECTORS accumulators fit the registers
OUTER_ROWS, OUTER_COLUMNS = LANES // 4, 4  # of an outer product's tile: one accumulator per lane

_i64, _f32 = ir.IntType(64), ir.FloatType()
_vector = ir.VectorType(_f32, LANES)
_FAST = ("fast",)


def _data(context, builder, signature, arguments, position):
    array_type = signature.args[position]
    return context.make_array(array_type)(context, builder, arguments[position]).data


def _load(builder, data, index):
    pointer = builder.bitcast(builder.gep(data, [index]), ir.PointerType(_vector))
    value = builder.load(pointer)
    value.align = 4
    return value


def _store(builder, value, data, index):
    pointer = builder.bitcast(builder.gep(data, [index]), ir.PointerType(_vector))
    builder.store(value, pointer).align = 4


def _splat(builder, scalar):
    first = builder.insert_element(ir.Constant(_vector, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, ir.Constant(_vector, ir.Undefined), zeros)


def _accumulators(builder, count):
    zero = ir.Constant(_vector, [0.0] * LANES)
    held = [cgutils.alloca_once(builder, _vector) for _ in range(count)]
    for one in held:
        builder.store(zero, one)
    return held


def _add_product(builder, accumulator, a, b):
    product = builder.fmul(a, b, flags=_FAST)
    builder.store(builder.fadd(builder.load(accumulator), product, flags=_FAST), accumulator)


_FLAT = types.Array(types.float32, 1, "C")
_INT = types.int64


def _make_product_tile(rows: int, epilogue: str):
    """y[:rows, t:t + VECTORS LANES] = weight x; `epilogue`: "", "rectify", or "mask" (zero where `active` <= 0)."""

    @intrinsic
    def tile(typing, weight, w, row_stride, depth_stride, x, xb, y, yb, depth, active):
        signature = types.void(_FLAT, _INT, _INT, _INT, _FLAT, _INT, _FLAT, _INT, _INT, _FLAT)

        def codegen(context, builder, signature, arguments):
            weights, xs, ys, mask = (_data(context, builder, signature, arguments, p) for p in (0, 4, 6, 9))
            w, row_stride, depth_stride = arguments[1:4]
            xb, yb, depth = arguments[5], arguments[7], arguments[8]
            sums = _accumulators(builder, rows * VECTORS)
            width, lanes = ir.Constant(_i64, STRIDE), [ir.Constant(_i64, v * LANES) for v in range(VECTORS)]
            with cgutils.for_range(builder, depth, intp=_i64) as loop:
                base = builder.add(xb, builder.mul(loop.index, width))
                inputs = [_load(builder, xs, builder.add(base, lane)) for lane in lanes]
                at = builder.add(w, builder.mul(loop.index, depth_stride))
                for r in range(rows):
                    factor = _splat(builder, builder.load(builder.gep(weights, [at])))
                    for v in range(VECTORS):
                        _add_product(builder, sums[r * VECTORS + v], factor, inputs[v])
                    at = builder.add(at, row_stride)
            zero = ir.Constant(_vector, [0.0] * LANES)
            for r in range(rows):
                base = builder.add(yb, ir.Constant(_i64, r * STRIDE))
                for v in range(VECTORS):
                    index = builder.add(base, lanes[v])
                    value = builder.load(sums[r * VECTORS + v])
                    if epilogue:
                        source = value if epilogue == "rectify" else _load(builder, mask, index)
                        value = builder.select(builder.fcmp_ordered(">", source, zero), value, zero)
                    _store(builder, value, ys, index)
            return context.get_dummy_value()

        return signature, codegen

    return tile


product_tile = _make_product_tile(ROWS, "")
rectified_tile = _make_product_tile(ROWS, "rectify")
masked_tile = _make_product_tile(ROWS, "mask")
product_tile_of_4 = _make_product_tile(4, "")


def _sums_of_lanes(builder, vectors):
    """One vector whose lane i is the sum of vectors[i]: pairs of neighbours are added until one is left."""
    index = ir.VectorType(ir.IntType(32), LANES)
    even = ir.Constant(index, [2 * i for i in range(LANES)])
    odd = ir.Constant(index, [2 * i + 1 for i in range(LANES)])
    while len(vectors) > 1:
        vectors = [
            builder.fadd(builder.shuffle_vector(a, b, even), builder.shuffle_vector(a, b, odd), flags=_FAST)
            for a, b in zip(vectors[::2], vectors[1::2], strict=True)
        ]
    return vectors[0]


@intrinsic
def outer_tile(typing, g, gb, x, xb, dweight, d, vectors):
    """dweight[d + i] += sum_t g[row, t] x[column, t] over `vectors` vectors; i = OUTER_COLUMNS row + column."""
    signature = types.void(_FLAT, _INT, _FLAT, _INT, _FLAT, _INT, _INT)

    def codegen(context, builder, signature, arguments):
        gs, xs, out = (_data(context, builder, signature, arguments, p) for p in (0, 2, 4))
        gb, xb, d, vectors = arguments[1], arguments[3], arguments[5], arguments[6]
        sums = _accumulators(builder, OUTER_ROWS * OUTER_COLUMNS)
        with cgutils.for_range(builder, vectors, intp=_i64) as loop:
            at = builder.mul(loop.index, ir.Constant(_i64, LANES))

            def column_of(data, base, row, at=at):
                offset = builder.add(base, ir.Constant(_i64, row * STRIDE))
                return _load(builder, data, builder.add(offset, at))

            right = [column_of(xs, xb, c) for c in range(OUTER_COLUMNS)]
            for r in range(OUTER_ROWS):
                left = column_of(gs, gb, r)
                for c in range(OUTER_COLUMNS):
                    _add_product(builder, sums[r * OUTER_COLUMNS + c], left, right[c])
        total = _sums_of_lanes(builder, [builder.load(one) for one in sums])
        _store(builder, builder.fadd(_load(builder, out, d), total, flags=_FAST), out, d)
        return context.get_dummy_value()

    return signature, codegen
