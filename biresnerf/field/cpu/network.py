"""The two small networks in Numba: encoded point -> density and 16 outputs, those and the view -> colour.

The definition is `biresnerf.field.reference.network`. Samples go through in blocks of 128 whose activations never
leave the cache; the backward pass computes them again rather than storing them.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from biresnerf.field.cpu.matrix_blocks import (
    BLOCK,
    add_outer,
    copy_in,
    exponential,
    product,
    zero_where_inactive,
)
from biresnerf.field.cpu.vector_access import KERNEL, PARALLEL_KERNEL, load, reload, store

f4, i8 = np.float32, np.int64
HIDDEN, OUT, VIEW = 64, 16, 16
DENSITY_SHIFT, DENSITY_CAP = f4(1.0), f4(11.0)  # density = exp(min(z0 - 1, 11)), BAA-NGP's trunc_exp(z0 - 1)


@njit(**KERNEL)
def _forward_block(features, view, ray, total, width, begin, n, w1, w2, w3, w4, w5, x, h1, z, h3, h4, out):
    """Fill the block's activations; z = [view harmonics (16); outputs of the first network (16)]."""
    copy_in(features, x, width, total, begin, n)
    for t in range(n):
        row = i8(ray[begin + t]) * VIEW
        for c in range(VIEW):
            z[c * BLOCK + t] = view[row + c]
    product(w1, x, h1, HIDDEN, width, n, True)
    product(w2, h1, z[VIEW * BLOCK :], OUT, HIDDEN, n, False)
    product(w3, z, h3, HIDDEN, VIEW + OUT, n, True)
    product(w4, h3, h4, HIDDEN, HIDDEN, n, True)
    product(w5, h4, out, 4, HIDDEN, n, False)
    for c in range(3):
        for t in range(n):
            store(out, c * BLOCK + t, f4(1) / (f4(1) + exponential(-reload(out, c * BLOCK + t))))


@njit(**PARALLEL_KERNEL)
def network_forward(features, width, view, ray, w1, w2, w3, w4, w5, density, colour, workers):
    """density [n] and colour [3 n] of features [width n]; `view` [rays 16] harmonics, `ray` [n] each sample's ray."""
    total = density.shape[0]
    blocks = (total + BLOCK - 1) // BLOCK
    for worker in prange(workers):
        x, h1 = np.empty(width * BLOCK, f4), np.empty(HIDDEN * BLOCK, f4)
        z, h3 = np.empty((VIEW + OUT) * BLOCK, f4), np.empty(HIDDEN * BLOCK, f4)
        h4, out = np.empty(HIDDEN * BLOCK, f4), np.empty(4 * BLOCK, f4)
        for block in range(worker * blocks // workers, (worker + 1) * blocks // workers):
            begin = block * BLOCK
            n = min(BLOCK, total - begin)
            _forward_block(
                features, view, ray, total, width, begin, n, w1, w2, w3, w4, w5, x, h1, z, h3, h4, out
            )
            for t in range(n):
                store(
                    density,
                    begin + t,
                    exponential(min(load(z, VIEW * BLOCK + t) - DENSITY_SHIFT, DENSITY_CAP)),
                )
            for c in range(3):
                for t in range(n):
                    store(colour, c * total + begin + t, load(out, c * BLOCK + t))


@njit(**PARALLEL_KERNEL)
def network_density(features, width, w1, w2, density, workers):
    """density [n] alone, for the occupancy grid."""
    total = density.shape[0]
    blocks = (total + BLOCK - 1) // BLOCK
    for worker in prange(workers):
        x, h1, z = np.empty(width * BLOCK, f4), np.empty(HIDDEN * BLOCK, f4), np.empty(OUT * BLOCK, f4)
        for block in range(worker * blocks // workers, (worker + 1) * blocks // workers):
            begin = block * BLOCK
            n = min(BLOCK, total - begin)
            copy_in(features, x, width, total, begin, n)
            product(w1, x, h1, HIDDEN, width, n, True)
            product(w2, h1, z, 4, HIDDEN, n, False)  # the first four rows hold the density's
            for t in range(n):
                store(density, begin + t, exponential(min(load(z, t) - DENSITY_SHIFT, DENSITY_CAP)))


@njit(**PARALLEL_KERNEL)
def network_backward(
    features, width, view, ray, first, last, with_weights,
    w1, w2, w3, w4, w5, t1, t2, t3, t4, t5,
    g_density, g_colour, g_features, g_view, d1, d2, d3, d4, d5,
):  # fmt: skip
    """Gradients of samples [first, last): to features [width n], view [16 n] and, added per worker, the weights.

    t1..t5 are the transposed weights, d1..d5 [workers, size] the weight gradients (left alone unless `with_weights`).
    """
    total = g_density.shape[0]
    blocks, workers = (last - first + BLOCK - 1) // BLOCK, d1.shape[0]
    for worker in prange(workers):
        x, h1 = np.empty(width * BLOCK, f4), np.empty(HIDDEN * BLOCK, f4)
        z, h3 = np.empty((VIEW + OUT) * BLOCK, f4), np.empty(HIDDEN * BLOCK, f4)
        h4, out = np.empty(HIDDEN * BLOCK, f4), np.empty(4 * BLOCK, f4)
        ga, gb = np.empty(HIDDEN * BLOCK, f4), np.empty(HIDDEN * BLOCK, f4)
        g_out = np.zeros(4 * BLOCK, f4)
        for block in range(worker * blocks // workers, (worker + 1) * blocks // workers):
            begin = first + block * BLOCK
            n = min(BLOCK, last - begin)
            _forward_block(
                features, view, ray, total, width, begin, n, w1, w2, w3, w4, w5, x, h1, z, h3, h4, out
            )
            for c in range(3):
                for t in range(n):
                    v = load(out, c * BLOCK + t)
                    store(g_out, c * BLOCK + t, load(g_colour, c * total + begin + t) * v * (f4(1) - v))
            if with_weights:
                add_outer(g_out, h4, d5[worker], 4, HIDDEN, n)
            product(t5, g_out, ga, HIDDEN, 4, n, False)
            zero_where_inactive(ga, h4, HIDDEN, n)
            if with_weights:
                add_outer(ga, h3, d4[worker], HIDDEN, HIDDEN, n)
            product(t4, ga, gb, HIDDEN, HIDDEN, n, False)
            zero_where_inactive(gb, h3, HIDDEN, n)
            if with_weights:
                add_outer(gb, z, d3[worker], HIDDEN, VIEW + OUT, n)
            product(t3, gb, ga, VIEW + OUT, HIDDEN, n, False)
            for c in range(VIEW):
                for t in range(n):
                    store(g_view, c * total + begin + t, load(ga, c * BLOCK + t))
            for t in range(n):
                a = load(z, VIEW * BLOCK + t) - DENSITY_SHIFT
                slope = exponential(a) if a < DENSITY_CAP else f4(0)
                i = VIEW * BLOCK + t
                store(ga, i, reload(ga, i) + load(g_density, begin + t) * slope)
            gz = ga[VIEW * BLOCK :]
            if with_weights:
                add_outer(gz, h1, d2[worker], OUT, HIDDEN, n)
            product(t2, gz, gb, HIDDEN, OUT, n, False)
            zero_where_inactive(gb, h1, HIDDEN, n)
            if with_weights:
                add_outer(gb, x, d1[worker], HIDDEN, width, n)
            product(t1, gb, ga, width, HIDDEN, n, False)
            for c in range(width):
                for t in range(n):
                    store(g_features, c * total + begin + t, load(ga, c * BLOCK + t))
