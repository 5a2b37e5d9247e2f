"""Small dense products on blocks of samples whose activations stay in cache.

Activations are [channels, BLOCK] with row stride STRIDE, flattened; the first `n` samples of a block are in use.
Products read and write whole vectors beyond `n`, so inputs must be finite there, and gradients zero.
Weights are [rows, columns], flattened; both counts are multiples of `CHANNELS`.
"""

from __future__ import annotations

import numpy as np

from biresnerf.field.cpu.vector_access import KERNEL, float_from_bits, load, store
from biresnerf.field.cpu.vector_tiles import (
    BLOCK,
    LANES,
    OUTER_COLUMNS,
    OUTER_ROWS,
    ROWS,
    STRIDE,
    VECTORS,
    masked_tile,
    outer_tile,
    product_tile,
    product_tile_of_4,
    rectified_tile,
)
from biresnerf.field.numba_kernels import njit

f4, u4, i4 = np.float32, np.uint32, np.int32
CHANNELS = 8  # channel counts are padded to multiples of this; the colour's three outputs to 4
PADDED = VECTORS * LANES  # products work on this many samples at a time
assert BLOCK % PADDED == 0


def _make_product(tile, rows_of_tile: int, *, transposed: bool = False):
    """A kernel that multiplies a block by a weight, or by its transpose, tile by tile of the result's channels."""

    @njit(**KERNEL)
    def multiply(weight, x, y, rows, columns, n, active=None):
        outputs, inputs = (columns, rows) if transposed else (rows, columns)
        output_stride, input_stride = (1, columns) if transposed else (columns, 1)
        mask = x if active is None else active
        for t in range(0, n, PADDED):
            for o in range(0, outputs, rows_of_tile):
                tile(
                    weight,
                    o * output_stride,
                    output_stride,
                    input_stride,
                    x,
                    t,
                    y,
                    o * STRIDE + t,
                    inputs,
                    mask,
                )

    return multiply


# y[:rows, :n] = weight x[:columns, :n]; the second for four rows, the third with negative values set to zero.
product = _make_product(product_tile, ROWS)
product_of_4 = _make_product(product_tile_of_4, 4)
rectified_product = _make_product(rectified_tile, ROWS)
# y[:columns, :n] = weight^T x[:rows, :n]; the second is zero where the rectified `active` [columns, n] is.
transposed_product = _make_product(product_tile, ROWS, transposed=True)
masked_transposed_product = _make_product(masked_tile, ROWS, transposed=True)


@njit(**KERNEL)
def add_outer(g, x, dweight, rows, columns, n):
    """Add g[:rows, :n] x[:columns, :n]^T to `dweight`, which is stored in tiles (`from_tiles`)."""
    vectors, d = (n + LANES - 1) // LANES, 0
    for o in range(0, rows, OUTER_ROWS):
        for k in range(0, columns, OUTER_COLUMNS):
            outer_tile(g, o * STRIDE, x, k * STRIDE, dweight, d, vectors)
            d += LANES


def from_tiles(dweight: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """The matrix [rows, columns] that `add_outer` stores tile by tile."""
    tiles = dweight.reshape(rows // OUTER_ROWS, columns // OUTER_COLUMNS, OUTER_ROWS, OUTER_COLUMNS)
    return tiles.transpose(0, 2, 1, 3).reshape(rows, columns)


@njit(**KERNEL)
def zero_rest(block, channels, n):
    """Zero the lanes from `n` to the end of the last vectors."""
    end = (n + PADDED - 1) // PADDED * PADDED
    for c in range(channels):
        for t in range(n, end):
            block[c * STRIDE + t] = f4(0)


@njit(**KERNEL)
def copy_in(source, block, channels, total, begin, n):
    """block[:channels, :n] = source[:channels, begin:begin + n] for a flattened source [channels, total]."""
    for c in range(channels):
        for t in range(n):
            store(block, c * STRIDE + t, load(source, c * total + begin + t))
    zero_rest(block, channels, n)


@njit(**KERNEL)
def copy_out(block, target, channels, total, begin, n):
    """target[:channels, begin:begin + n] = block[:channels, :n] for a flattened target [channels, total]."""
    for c in range(channels):
        for t in range(n):
            store(target, c * total + begin + t, load(block, c * STRIDE + t))


@njit(**KERNEL)
def gather_in(source, block, channels, total, chosen, begin, n):
    """block[:channels, :n] = source[:channels, chosen[begin:begin + n]]; `chosen` ascends."""
    first = chosen[begin]
    if chosen[begin + n - 1] - first == n - 1:
        copy_in(source, block, channels, total, first, n)
        return
    for c in range(channels):
        for t in range(n):
            block[c * STRIDE + t] = source[c * total + chosen[begin + t]]
    zero_rest(block, channels, n)


@njit(inline="always")
def exponential(x):
    """exp in float32 without a library call, so that loops over it vectorise; relative error 2e-7."""
    x = min(max(x, f4(-87.0)), f4(88.0))
    n = np.floor(x * f4(1.44269504) + f4(0.5))
    r = x - n * f4(0.693359375)
    r = r - n * f4(-2.12194440e-4)
    p = f4(1.9875691500e-4)
    p = p * r + f4(1.3981999507e-3)
    p = p * r + f4(8.3334519073e-3)
    p = p * r + f4(4.1665795894e-2)
    p = p * r + f4(1.6666665459e-1)
    p = p * r + f4(5.0000001201e-1)
    p = p * r * r + r + f4(1)
    return p * float_from_bits(u4((i4(n) + i4(127)) << i4(23)))
