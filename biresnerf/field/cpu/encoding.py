"""Hash and dense grid encodings in Numba: forward with Jacobian, gradient to positions, table update.

The definition is `field.reference.operations.encode`. Layout, chosen so that every inner loop runs over samples
with unit stride: features [2 levels, n], Jacobian [levels, 6, n] (d feature 0 / dxyz, d feature 1 / dxyz); both
features of an entry share one 8-byte word, so a corner costs one load.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from biresnerf.field.cpu.vector_access import (
    KERNEL,
    PARALLEL_KERNEL,
    float_from_bits,
    load,
    next_task,
    reload,
    store,
)

f4, u4, i4, i8, u8 = np.float32, np.uint32, np.int32, np.int64, np.uint64
PRIME_Y, PRIME_Z = u4(2654435761), u4(805459861)
ONE, HALF = f4(1), f4(0.5)
HALF_PI, PI_SQUARED = f4(np.pi / 2), f4(np.pi**2)
BLOCK = 256  # samples whose corner indices and values are staged before they are scattered
CHUNK = 8192  # samples of one level that a forward task encodes


@njit(inline="always")
def _corner(table, index):
    word = load(table, index)
    return float_from_bits(u4(word)), float_from_bits(u4(word >> u8(32)))


@njit(inline="always")
def _straight_through(fraction, smoothing):
    """1 + smoothing (pi/2) sin(pi w): Heo et al. 2023's factor on d w/dx. cos series of w - 1/2, error 5e-7."""
    q = (fraction - HALF) * (fraction - HALF) * PI_SQUARED
    cosine = ONE - q * (
        HALF - q * (f4(1 / 24) - q * (f4(1 / 720) - q * (f4(1 / 40320) - q * f4(1 / 3628800))))
    )
    return ONE + smoothing * HALF_PI * cosine


def _make_corners(hashing: bool):
    """How corners are numbered; `hashing` is fixed at compile time so that the index arithmetic stays branch-free."""

    @njit(inline="always")
    def index_of(x, y, z, mask):
        if hashing:
            return u4(u4(x ^ y) ^ z) & mask
        return u4(u4(x + y) + z)

    @njit(inline="always")
    def strides(stride):
        if hashing:
            return PRIME_Y, PRIME_Z
        return stride, u4(stride * stride)

    return index_of, strides


def _make_forward(hashing: bool):
    """The kernel that encodes samples at one level."""
    index_of, strides = _make_corners(hashing)

    @njit(**KERNEL)
    def forward(x, table, scale, stride, mask, smoothing, out0, out1, j0, j1, j2, j3, j4, j5, begin, end):
        step_y, step_z = strides(stride)
        for i in range(begin, end):
            px = load(x, 3 * i) * scale + HALF
            py = load(x, 3 * i + 1) * scale + HALF
            pz = load(x, 3 * i + 2) * scale + HALF
            ix, iy, iz = i4(px), i4(py), i4(pz)
            fx, fy, fz = px - f4(ix), py - f4(iy), pz - f4(iz)
            ax, bx = u4(ix), u4(ix + i4(1))
            ay = u4(u4(iy) * step_y)
            by = u4(ay + step_y)
            az = u4(u4(iz) * step_z)
            bz = u4(az + step_z)
            p0, q0 = _corner(table, index_of(ax, ay, az, mask))
            p1, q1 = _corner(table, index_of(bx, ay, az, mask))
            p2, q2 = _corner(table, index_of(ax, by, az, mask))
            p3, q3 = _corner(table, index_of(bx, by, az, mask))
            p4, q4 = _corner(table, index_of(ax, ay, bz, mask))
            p5, q5 = _corner(table, index_of(bx, ay, bz, mask))
            p6, q6 = _corner(table, index_of(ax, by, bz, mask))
            p7, q7 = _corner(table, index_of(bx, by, bz, mask))
            sx = scale * _straight_through(fx, smoothing)
            sy = scale * _straight_through(fy, smoothing)
            sz = scale * _straight_through(fz, smoothing)
            m, n, r, t = p1 - p0, p3 - p2, p5 - p4, p7 - p6
            h0, h1 = m + fy * (n - m), r + fy * (t - r)
            store(j0, i, sx * (h0 + fz * (h1 - h0)))
            a, b, c, d = p0 + fx * m, p2 + fx * n, p4 + fx * r, p6 + fx * t
            w0, w1 = b - a, d - c
            store(j1, i, sy * (w0 + fz * (w1 - w0)))
            y0, y1 = a + fy * w0, c + fy * w1
            store(j2, i, sz * (y1 - y0))
            store(out0, i, y0 + fz * (y1 - y0))
            m, n, r, t = q1 - q0, q3 - q2, q5 - q4, q7 - q6
            h0, h1 = m + fy * (n - m), r + fy * (t - r)
            store(j3, i, sx * (h0 + fz * (h1 - h0)))
            a, b, c, d = q0 + fx * m, q2 + fx * n, q4 + fx * r, q6 + fx * t
            w0, w1 = b - a, d - c
            store(j4, i, sy * (w0 + fz * (w1 - w0)))
            y0, y1 = a + fy * w0, c + fy * w1
            store(j5, i, sz * (y1 - y0))
            store(out1, i, y0 + fz * (y1 - y0))

    return forward


def _make_scatter(hashing: bool):
    """The kernel that adds samples' gradients to the table of one level."""
    index_of, strides = _make_corners(hashing)

    @njit(**KERNEL)
    def scatter(x, gradient, scale, stride, mask, g0, g1, corner, value, first, last):
        """Add the gradients of samples [first, last) to the flat [2 entries] gradient of this level."""
        step_y, step_z = strides(stride)
        for begin in range(first, last, BLOCK):
            size = min(BLOCK, last - begin)
            for j in range(size):
                i = begin + j
                px = load(x, 3 * i) * scale + HALF
                py = load(x, 3 * i + 1) * scale + HALF
                pz = load(x, 3 * i + 2) * scale + HALF
                ix, iy, iz = i4(px), i4(py), i4(pz)
                fx, fy, fz = px - f4(ix), py - f4(iy), pz - f4(iz)
                gx, gy, gz = ONE - fx, ONE - fy, ONE - fz
                ax, bx = u4(ix), u4(ix + i4(1))
                ay = u4(u4(iy) * step_y)
                by = u4(ay + step_y)
                az = u4(u4(iz) * step_z)
                bz = u4(az + step_z)
                store(corner, j, index_of(ax, ay, az, mask))
                store(corner, BLOCK + j, index_of(bx, ay, az, mask))
                store(corner, 2 * BLOCK + j, index_of(ax, by, az, mask))
                store(corner, 3 * BLOCK + j, index_of(bx, by, az, mask))
                store(corner, 4 * BLOCK + j, index_of(ax, ay, bz, mask))
                store(corner, 5 * BLOCK + j, index_of(bx, ay, bz, mask))
                store(corner, 6 * BLOCK + j, index_of(ax, by, bz, mask))
                store(corner, 7 * BLOCK + j, index_of(bx, by, bz, mask))
                u, v = load(g0, i), load(g1, i)
                a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
                h = 2 * j
                store(value, h, a * gx * u)
                store(value, h + 1, a * gx * v)
                store(value, 2 * BLOCK + h, a * fx * u)
                store(value, 2 * BLOCK + h + 1, a * fx * v)
                store(value, 4 * BLOCK + h, b * gx * u)
                store(value, 4 * BLOCK + h + 1, b * gx * v)
                store(value, 6 * BLOCK + h, b * fx * u)
                store(value, 6 * BLOCK + h + 1, b * fx * v)
                store(value, 8 * BLOCK + h, c * gx * u)
                store(value, 8 * BLOCK + h + 1, c * gx * v)
                store(value, 10 * BLOCK + h, c * fx * u)
                store(value, 10 * BLOCK + h + 1, c * fx * v)
                store(value, 12 * BLOCK + h, d * gx * u)
                store(value, 12 * BLOCK + h + 1, d * gx * v)
                store(value, 14 * BLOCK + h, d * fx * u)
                store(value, 14 * BLOCK + h + 1, d * fx * v)
            for j in range(size):
                for k in range(8):
                    entry = i8(load(corner, k * BLOCK + j)) * 2
                    h = 2 * (k * BLOCK + j)
                    a0 = reload(gradient, entry) + load(value, h)
                    a1 = reload(gradient, entry + 1) + load(value, h + 1)
                    store(gradient, entry, a0)
                    store(gradient, entry + 1, a1)

    return scatter


_forward_hashed, _forward_dense = _make_forward(True), _make_forward(False)
_scatter_hashed, _scatter_dense = _make_scatter(True), _make_scatter(False)


@njit(**PARALLEL_KERNEL)
def encode(x, words, scale, stride, hashed, offset, smoothing, features, jacobian):
    """Features [2 levels, n] and Jacobian [levels, 6, n] of points x [3 n] in [0, 1]; `words` is the table as u64."""
    levels, n = scale.shape[0], x.shape[0] // 3
    chunks = (n + CHUNK - 1) // CHUNK
    for task in prange(levels * chunks):
        level = task // chunks
        begin = (task - level * chunks) * CHUNK
        end = min(n, begin + CHUNK)
        table = words[offset[level] : offset[level + 1]]
        mask = u4(table.shape[0] - 1)
        j = jacobian[level]
        out0, out1 = features[2 * level], features[2 * level + 1]
        if hashed[level]:
            _forward_hashed(
                x, table, scale[level], stride[level], mask, smoothing,
                out0, out1, j[0], j[1], j[2], j[3], j[4], j[5], begin, end,
            )  # fmt: skip
        else:
            _forward_dense(
                x, table, scale[level], stride[level], mask, smoothing,
                out0, out1, j[0], j[1], j[2], j[3], j[4], j[5], begin, end,
            )  # fmt: skip


@njit(**KERNEL)
def _adam_touched(p, g, m, v, rate, beta1, beta2, eps, correction1, correction2):
    """Adam on the numbers with a gradient; whole 64-byte lines without any are skipped. Leaves g zero."""
    c1, c2 = ONE - beta1, ONE - beta2
    for begin in range(0, p.shape[0], 16):
        largest = f4(0)
        for j in range(16):
            largest = max(largest, abs(load(g, begin + j)))
        if largest == f4(0):
            continue
        for j in range(16):
            i = begin + j
            gi, mi, vi, pi = reload(g, i), reload(m, i), reload(v, i), reload(p, i)
            m1 = beta1 * mi + c1 * gi
            v1 = beta2 * vi + c2 * gi * gi
            p1 = pi - rate * (m1 * correction1) / (np.sqrt(v1) * correction2 + eps)
            touched = gi != f4(0)
            store(m, i, m1 if touched else mi)
            store(v, i, v1 if touched else vi)
            store(p, i, p1 if touched else pi)
            store(g, i, f4(0))


@njit(**KERNEL)
def _scatter_level(x, begin, end, hashed, gradient, scale, stride, g0, g1, corner, value):
    """Add the gradients of points begin[s]:end[s] to one level's."""
    mask = u4(gradient.shape[0] // 2 - 1)
    for s in range(begin.shape[0]):
        lo, hi = begin[s], end[s]
        if hashed:
            _scatter_hashed(x, gradient, scale, stride, mask, g0, g1, corner, value, lo, hi)
        else:
            _scatter_dense(x, gradient, scale, stride, mask, g0, g1, corner, value, lo, hi)


@njit(**PARALLEL_KERNEL)
def update_table(
    x, begin, end, g, scale, stride, hashed, offset, table, moment1, moment2, rates, adam, scratch, counter, workers
):  # fmt: skip
    """Scatter the feature gradients of points begin[s]:end[s] into each level and take its Adam step at once.

    A level's gradient lives in its worker's `scratch` row (kept zero), so it stays in cache and no two workers
    write the same level: deterministic without atomics. `adam` = (beta1, beta2, eps, 1/(1-beta1^t),
    1/sqrt(1-beta2^t)); a level with rate 0 is left alone.
    """
    levels = scale.shape[0]
    for worker in prange(workers):
        corner, value = np.empty(8 * BLOCK, u4), np.empty(16 * BLOCK, f4)
        level = next_task(counter)
        while level < levels:
            if rates[level] != f4(0):
                lo, hi = 2 * offset[level], 2 * offset[level + 1]
                gradient = scratch[worker][: hi - lo]
                _scatter_level(
                    x, begin, end, hashed[level], gradient, scale[level], stride[level],
                    g[2 * level], g[2 * level + 1], corner, value,
                )  # fmt: skip
                _adam_touched(
                    table[lo:hi], gradient, moment1[lo:hi], moment2[lo:hi],
                    rates[level], adam[0], adam[1], adam[2], adam[3], adam[4],
                )  # fmt: skip
            level = next_task(counter)
