"""Small dense products on blocks of BLOCK samples that stay in the first-level cache.

Activations are [channels, BLOCK] with row stride BLOCK, flattened; only the first `n` samples of a block are live.
Output and input channel counts must be multiples of 4 (register tiles of 4 x 4).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from biresnerf.field.cpu.vector_access import KERNEL, float_from_bits, load, reload, store

f4, u4, i4 = np.float32, np.uint32, np.int32
BLOCK = 128


@njit(**KERNEL)
def product(weight, x, y, rows, columns, n, rectify):
    """y[:rows, :n] = weight[rows, columns] @ x[:columns, :n], then max(0, .) if `rectify`."""
    for o in range(0, rows, 4):
        yb = o * BLOCK
        for k in range(0, columns, 4):
            w, xb = o * columns + k, k * BLOCK
            a00, a01, a02, a03 = weight[w], weight[w + 1], weight[w + 2], weight[w + 3]
            w += columns
            a10, a11, a12, a13 = weight[w], weight[w + 1], weight[w + 2], weight[w + 3]
            w += columns
            a20, a21, a22, a23 = weight[w], weight[w + 1], weight[w + 2], weight[w + 3]
            w += columns
            a30, a31, a32, a33 = weight[w], weight[w + 1], weight[w + 2], weight[w + 3]
            if k == 0:
                for t in range(n):
                    p, q = load(x, xb + t), load(x, xb + BLOCK + t)
                    r, s = load(x, xb + 2 * BLOCK + t), load(x, xb + 3 * BLOCK + t)
                    store(y, yb + t, a00 * p + a01 * q + a02 * r + a03 * s)
                    store(y, yb + BLOCK + t, a10 * p + a11 * q + a12 * r + a13 * s)
                    store(y, yb + 2 * BLOCK + t, a20 * p + a21 * q + a22 * r + a23 * s)
                    store(y, yb + 3 * BLOCK + t, a30 * p + a31 * q + a32 * r + a33 * s)
            else:
                for t in range(n):
                    p, q = load(x, xb + t), load(x, xb + BLOCK + t)
                    r, s = load(x, xb + 2 * BLOCK + t), load(x, xb + 3 * BLOCK + t)
                    i0, i1, i2, i3 = yb + t, yb + BLOCK + t, yb + 2 * BLOCK + t, yb + 3 * BLOCK + t
                    store(y, i0, reload(y, i0) + a00 * p + a01 * q + a02 * r + a03 * s)
                    store(y, i1, reload(y, i1) + a10 * p + a11 * q + a12 * r + a13 * s)
                    store(y, i2, reload(y, i2) + a20 * p + a21 * q + a22 * r + a23 * s)
                    store(y, i3, reload(y, i3) + a30 * p + a31 * q + a32 * r + a33 * s)
        if rectify:
            for c in range(4):
                for t in range(n):
                    store(y, yb + c * BLOCK + t, max(reload(y, yb + c * BLOCK + t), f4(0)))


@njit(**KERNEL)
def add_outer(g, x, dweight, rows, columns, n):
    """dweight[rows, columns] += g[:rows, :n] @ x[:columns, :n]^T."""
    for o in range(0, rows, 4):
        gb = o * BLOCK
        for k in range(0, columns, 4):
            xb = k * BLOCK
            s00 = s01 = s02 = s03 = f4(0)
            s10 = s11 = s12 = s13 = f4(0)
            s20 = s21 = s22 = s23 = f4(0)
            s30 = s31 = s32 = s33 = f4(0)
            for t in range(n):
                u, v = load(x, xb + t), load(x, xb + BLOCK + t)
                w, z = load(x, xb + 2 * BLOCK + t), load(x, xb + 3 * BLOCK + t)
                a, b = load(g, gb + t), load(g, gb + BLOCK + t)
                c, d = load(g, gb + 2 * BLOCK + t), load(g, gb + 3 * BLOCK + t)
                s00 += a * u
                s01 += a * v
                s02 += a * w
                s03 += a * z
                s10 += b * u
                s11 += b * v
                s12 += b * w
                s13 += b * z
                s20 += c * u
                s21 += c * v
                s22 += c * w
                s23 += c * z
                s30 += d * u
                s31 += d * v
                s32 += d * w
                s33 += d * z
            i = o * columns + k
            dweight[i] += s00
            dweight[i + 1] += s01
            dweight[i + 2] += s02
            dweight[i + 3] += s03
            i += columns
            dweight[i] += s10
            dweight[i + 1] += s11
            dweight[i + 2] += s12
            dweight[i + 3] += s13
            i += columns
            dweight[i] += s20
            dweight[i + 1] += s21
            dweight[i + 2] += s22
            dweight[i + 3] += s23
            i += columns
            dweight[i] += s30
            dweight[i + 1] += s31
            dweight[i + 2] += s32
            dweight[i + 3] += s33


@njit(**KERNEL)
def zero_where_inactive(g, activation, channels, n):
    """The derivative of max(0, .): g = 0 where the activation is not positive."""
    for c in range(channels):
        for t in range(n):
            i = c * BLOCK + t
            value = reload(g, i)
            store(g, i, value if load(activation, i) > f4(0) else f4(0))


@njit(**KERNEL)
def copy_in(source, block, channels, total, begin, n):
    """block[:channels, :n] = source[:channels, begin:begin + n] for a flattened source [channels, total]."""
    for c in range(channels):
        for t in range(n):
            store(block, c * BLOCK + t, load(source, c * total + begin + t))


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
