"""The two small networks in Numba, block by block.

The first turns an encoded point into 16 outputs, one of which gives the density; the second turns those and the view
into a colour.
The definition is `biresnerf.field.reference.operations.network`. Weights are flattened: w1 [64, width], w2 [16, 64],
w3 [64, 32], w4 [64, 64], w5 [4, 64] (three colours and a row of zeros).
"""

from __future__ import annotations

import numpy as np

from biresnerf.field.cpu.matrix_blocks import (
    BLOCK,
    CHANNELS,
    STRIDE,
    add_outer,
    copy_in,
    exponential,
    masked_transposed_product,
    product,
    product_of_4,
    rectified_product,
    transposed_product,
    zero_rest,
)
from biresnerf.field.cpu.vector_access import KERNEL, PARALLEL_KERNEL, load, next_task, reload, store
from biresnerf.field.numba_kernels import njit, prange
from biresnerf.field.reference import operations

f4, i8 = np.float32, np.int64
HIDDEN, OUT, VIEW = 64, 16, 16
DENSITY_SHIFT, DENSITY_CAP = f4(operations.DENSITY_SHIFT), f4(operations.DENSITY_CAP)
COLOUR_INPUTS = VIEW + OUT


@njit(inline="always")
def density_of(logit):
    """Density of the first network's first output."""
    return exponential(min(logit - DENSITY_SHIFT, DENSITY_CAP))


@njit(**KERNEL)
def outputs_of(x, width, n, w1, w2, h1, z):
    """Hidden layer h1 and outputs z [16] of the first network for the features x of a block."""
    rectified_product(w1, x, h1, HIDDEN, width, n)
    product(w2, h1, z, OUT, HIDDEN, n)


@njit(**KERNEL)
def view_in(view, ray, chosen, begin, n, z):
    """The first 16 rows of z: the harmonics `view` [rays 16] of the samples' rays."""
    for t in range(n):
        row = i8(ray[chosen[begin + t]]) * VIEW
        for c in range(VIEW):
            z[c * STRIDE + t] = view[row + c]
    zero_rest(z, VIEW, n)


@njit(**KERNEL)
def hidden_colours(z, n, w3, w4, h3, h4):
    """Both hidden layers of the colour network for z = [view harmonics (16); outputs (16)]."""
    rectified_product(w3, z, h3, HIDDEN, COLOUR_INPUTS, n)
    rectified_product(w4, h3, h4, HIDDEN, HIDDEN, n)


@njit(**KERNEL)
def colours_of(h4, n, w5, out):
    """Three colours in 0..1 from the last hidden layer."""
    product_of_4(w5, h4, out, 4, HIDDEN, n)
    for c in range(3):
        for t in range(n):
            i = c * STRIDE + t
            store(out, i, f4(1) / (f4(1) + exponential(-reload(out, i))))


@njit(**KERNEL)
def _layer_backward(weight, g, x, rectified, rows, columns, n, trained, d_weight, g_x):
    """Gradients of a layer [rows, columns]: to its input x, left in `g_x`, and if `trained` added to `d_weight`."""
    if trained:
        add_outer(g, x, d_weight, rows, columns, n)
    if rectified:
        masked_transposed_product(weight, g, g_x, rows, columns, n, x)
    else:
        transposed_product(weight, g, g_x, rows, columns, n)


@njit(**KERNEL)
def colour_backward(g_out, z, h3, h4, n, w3, w4, w5, trained, d3, d4, d5, ga, gb):
    """Gradients from the colours' logits g_out [4] to the inputs z, left in `ga` [32]; `gb` is scratch."""
    _layer_backward(w5, g_out, h4, True, 4, HIDDEN, n, trained, d5, ga)
    _layer_backward(w4, ga, h3, True, HIDDEN, HIDDEN, n, trained, d4, gb)
    _layer_backward(w3, gb, z, False, HIDDEN, COLOUR_INPUTS, n, trained, d3, ga)


@njit(**KERNEL)
def outputs_backward(g, x, h1, width, n, w1, w2, trained, d1, d2, ga, gb):
    """Gradients from the outputs g [16] to the features x, left in `ga` [width]; `gb` is scratch."""
    _layer_backward(w2, g, h1, True, OUT, HIDDEN, n, trained, d2, gb)
    _layer_backward(w1, gb, x, False, HIDDEN, width, n, trained, d1, ga)


@njit(**PARALLEL_KERNEL)
def network_density(features, width, w1, w2, density, counter, workers):
    """density [n] alone of features [width n], for the occupancy grid; `w2` may be its first 8 rows."""
    total = density.shape[0]
    blocks = (total + BLOCK - 1) // BLOCK
    for _ in prange(workers):
        x, h1, z = np.empty(width * STRIDE, f4), np.empty(HIDDEN * STRIDE, f4), np.empty(OUT * STRIDE, f4)
        block = next_task(counter)
        while block < blocks:
            begin = block * BLOCK
            n = min(BLOCK, total - begin)
            copy_in(features, x, width, total, begin, n)
            rectified_product(w1, x, h1, HIDDEN, width, n)
            product(w2, h1, z, CHANNELS, HIDDEN, n)
            for t in range(n):
                store(density, begin + t, density_of(load(z, t)))
            block = next_task(counter)
