"""Hash and dense grid encodings in Numba: forward with Jacobian, gradient to positions, table update.

The definition is `field.reference.operations.encode`. Layout, chosen so that every inner loop runs over samples
with unit stride: features [2 levels, n], Jacobian [levels, 6, n] (d feature 0 / dxyz, d feature 1 / dxyz); both
features of an entry share one 8-byte word, so a corner costs one load.
"""

from __future__ import annotations

import numpy as np

from biresnerf.field.cpu.vector_access import (
    KERNEL,
    PARALLEL_KERNEL,
    float_from_bits,
    load,
    next_task,
    reload,
    store,
)
from biresnerf.field.grid_levels import HASH_PRIMES
from biresnerf.field.numba_kernels import njit, prange

f4, u4, i4, i8, u8 = np.float32, np.uint32, np.int32, np.int64, np.uint64
PRIME_Y, PRIME_Z = u4(HASH_PRIMES[1]), u4(HASH_PRIMES[2])
ONE, HALF = f4(1), f4(0.5)
HALF_PI, PI_SQUARED = f4(np.pi / 2), f4(np.pi**2)
BLOCK = 256  # samples whose corner indices and values are staged before they are scattered
CHUNK = 8192  # samples of one level that a forward task encodes


@njit(inline="always")
def _low(word):
    return float_from_bits(u4(word))


@njit(inline="always")
def _high(word):
    return float_from_bits(u4(word >> u8(32)))


@njit(inline="always")
def _straight_through(fraction, smoothing):
    """1 + smoothing (pi/2) sin(pi w): Heo et al. 2023's factor on d w/dx. cos series of w - 1/2, error 5e-7."""
    q = (fraction - HALF) * (fraction - HALF) * PI_SQUARED
    cosine = ONE - q * (
        HALF - q * (f4(1 / 24) - q * (f4(1 / 720) - q * (f4(1 / 40320) - q * f4(1 / 3628800))))
    )
    return ONE + smoothing * HALF_PI * cosine


@njit(inline="always")
def _locate(x, i, scale):
    """Cell of point i and its fraction within the cell, per axis."""
    px = load(x, 3 * i) * scale + HALF
    py = load(x, 3 * i + 1) * scale + HALF
    pz = load(x, 3 * i + 2) * scale + HALF
    ix, iy, iz = i4(px), i4(py), i4(pz)
    return ix, iy, iz, px - f4(ix), py - f4(iy), pz - f4(iz)


@njit(inline="always")
def _trilinear(corners, fx, fy, fz):
    """The value between those of eight corners, and its derivatives by the three fractions."""
    v0, v1, v2, v3, v4, v5, v6, v7 = corners
    m, n, r, t = v1 - v0, v3 - v2, v5 - v4, v7 - v6
    h0, h1 = m + fy * (n - m), r + fy * (t - r)
    a, b, c, d = v0 + fx * m, v2 + fx * n, v4 + fx * r, v6 + fx * t
    w0, w1 = b - a, d - c
    y0, y1 = a + fy * w0, c + fy * w1
    return y0 + fz * (y1 - y0), h0 + fz * (h1 - h0), w0 + fz * (w1 - w0), y1 - y0


def _make_corners(hashing: bool):
    """How corners are numbered; `hashing` is fixed at compile time so that the index arithmetic stays branch-free."""

    @njit(inline="always")
    def index_of(x, y, z, mask):
        if hashing:
            return u4(u4(x ^ y) ^ z) & mask
        return u4(u4(x + y) + z)

    @njit(inline="always")
    def corners(ix, iy, iz, stride, mask):
        """Entries of a cell's eight corners, x fastest."""
        step_y, step_z = (PRIME_Y, PRIME_Z) if hashing else (stride, u4(stride * stride))
        ax, bx = u4(ix), u4(ix + i4(1))
        ay, az = u4(u4(iy) * step_y), u4(u4(iz) * step_z)
        by, bz = u4(ay + step_y), u4(az + step_z)
        return (
            index_of(ax, ay, az, mask), index_of(bx, ay, az, mask),
            index_of(ax, by, az, mask), index_of(bx, by, az, mask),
            index_of(ax, ay, bz, mask), index_of(bx, ay, bz, mask),
            index_of(ax, by, bz, mask), index_of(bx, by, bz, mask),
        )  # fmt: skip

    return corners


def _make_forward(hashing: bool, differentiating: bool):
    """The kernel that encodes samples [begin, end) at one level, with the Jacobian or without."""
    corners = _make_corners(hashing)

    @njit(**KERNEL)
    def forward(x, table, scale, stride, smoothing, features, jacobian, begin, end):
        mask = u4(table.shape[0] - 1)
        out0, out1 = features[0], features[1]
        if differentiating:
            j0, j1, j2, j3, j4, j5 = (
                jacobian[0], jacobian[1], jacobian[2], jacobian[3], jacobian[4], jacobian[5],
            )  # fmt: skip
        for i in range(begin, end):
            ix, iy, iz, fx, fy, fz = _locate(x, i, scale)
            k0, k1, k2, k3, k4, k5, k6, k7 = corners(ix, iy, iz, stride, mask)
            w0, w1, w2, w3 = load(table, k0), load(table, k1), load(table, k2), load(table, k3)
            w4, w5, w6, w7 = load(table, k4), load(table, k5), load(table, k6), load(table, k7)
            low = (_low(w0), _low(w1), _low(w2), _low(w3), _low(w4), _low(w5), _low(w6), _low(w7))
            high = (_high(w0), _high(w1), _high(w2), _high(w3), _high(w4), _high(w5), _high(w6), _high(w7))
            p, px, py, pz = _trilinear(low, fx, fy, fz)
            q, qx, qy, qz = _trilinear(high, fx, fy, fz)
            store(out0, i, p)
            store(out1, i, q)
            if differentiating:
                sx = scale * _straight_through(fx, smoothing)
                sy = scale * _straight_through(fy, smoothing)
                sz = scale * _straight_through(fz, smoothing)
                store(j0, i, sx * px)
                store(j1, i, sy * py)
                store(j2, i, sz * pz)
                store(j3, i, sx * qx)
                store(j4, i, sy * qy)
                store(j5, i, sz * qz)

    return forward


@njit(inline="always")
def _stage(corner, value, slot, entry, weight, u, v):
    """Note that `entry` of the gradient grows by weight times (u, v)."""
    store(corner, slot, entry)
    store(value, 2 * slot, weight * u)
    store(value, 2 * slot + 1, weight * v)


def _make_scatter(hashing: bool):
    """The kernel that adds samples' gradients to the table of one level."""
    corners = _make_corners(hashing)

    @njit(**KERNEL)
    def scatter(x, first, last, gradient, scale, stride, g0, g1, corner, value):
        """Add the gradients of points first[s]:last[s] to the flat [2 entries] gradient of this level."""
        mask = u4(gradient.shape[0] // 2 - 1)
        for s in range(first.shape[0]):
            for begin in range(first[s], last[s], BLOCK):
                size = min(BLOCK, last[s] - begin)
                for j in range(size):
                    i = begin + j
                    ix, iy, iz, fx, fy, fz = _locate(x, i, scale)
                    gx, gy, gz = ONE - fx, ONE - fy, ONE - fz
                    k0, k1, k2, k3, k4, k5, k6, k7 = corners(ix, iy, iz, stride, mask)
                    u, v = load(g0, i), load(g1, i)
                    a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
                    _stage(corner, value, j, k0, a * gx, u, v)
                    _stage(corner, value, BLOCK + j, k1, a * fx, u, v)
                    _stage(corner, value, 2 * BLOCK + j, k2, b * gx, u, v)
                    _stage(corner, value, 3 * BLOCK + j, k3, b * fx, u, v)
                    _stage(corner, value, 4 * BLOCK + j, k4, c * gx, u, v)
                    _stage(corner, value, 5 * BLOCK + j, k5, c * fx, u, v)
                    _stage(corner, value, 6 * BLOCK + j, k6, d * gx, u, v)
                    _stage(corner, value, 7 * BLOCK + j, k7, d * fx, u, v)
                for j in range(size):
                    for k in range(8):
                        entry = i8(load(corner, k * BLOCK + j)) * 2
                        h = 2 * (k * BLOCK + j)
                        a0 = reload(gradient, entry) + load(value, h)
                        a1 = reload(gradient, entry + 1) + load(value, h + 1)
                        store(gradient, entry, a0)
                        store(gradient, entry + 1, a1)

    return scatter


_forward_hashed, _forward_dense = _make_forward(True, True), _make_forward(False, True)
_features_hashed, _features_dense = _make_forward(True, False), _make_forward(False, False)
_scatter_hashed, _scatter_dense = _make_scatter(True), _make_scatter(False)


@njit(**PARALLEL_KERNEL)
def encode(x, words, scale, stride, hashed, offset, smoothing, features, jacobian):
    """Features [2 levels, n] and Jacobian [levels, 6, n] of points x [3 n] in [0, 1]; `words` is the table as u64.

    No Jacobian is computed where it has no rows, [levels, 0, n].
    """
    levels, n = scale.shape[0], x.shape[0] // 3
    chunks = (n + CHUNK - 1) // CHUNK
    for task in prange(levels * chunks):
        level = task // chunks
        begin = (task - level * chunks) * CHUNK
        end = min(n, begin + CHUNK)
        table = words[offset[level] : offset[level + 1]]
        out, j = features[2 * level : 2 * level + 2], jacobian[level]
        if j.shape[0] == 0:
            if hashed[level]:
                _features_hashed(x, table, scale[level], stride[level], smoothing, out, j, begin, end)
            else:
                _features_dense(x, table, scale[level], stride[level], smoothing, out, j, begin, end)
        elif hashed[level]:
            _forward_hashed(x, table, scale[level], stride[level], smoothing, out, j, begin, end)
        else:
            _forward_dense(x, table, scale[level], stride[level], smoothing, out, j, begin, end)


@njit(**KERNEL)
def _adam_touched(p, g, m, v, rate, adam):
    """Adam on the numbers with a gradient; whole 64-byte lines without any are skipped. Leaves g zero."""
    beta1, beta2, eps, correction1, correction2 = adam
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


@njit(**PARALLEL_KERNEL)
def update_table(
    x, begin, end, g, scale, stride, hashed, offset, table, moment1, moment2, rates, adam, scratch, counter, workers
):  # fmt: skip
    """Scatter the feature gradients of points begin[s]:end[s] into each level and take its Adam step at once.

    A level's gradient is in its worker's row of `scratch` (zero before and after), so it stays in cache and no two
    workers write the same level: deterministic without atomics. `adam` = (beta1, beta2, eps, 1/(1-beta1^t),
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
                g0, g1 = g[2 * level], g[2 * level + 1]
                if hashed[level]:
                    _scatter_hashed(
                        x, begin, end, gradient, scale[level], stride[level], g0, g1, corner, value
                    )
                else:
                    _scatter_dense(
                        x, begin, end, gradient, scale[level], stride[level], g0, g1, corner, value
                    )
                _adam_touched(table[lo:hi], gradient, moment1[lo:hi], moment2[lo:hi], rates[level], adam)
            level = next_task(counter)
