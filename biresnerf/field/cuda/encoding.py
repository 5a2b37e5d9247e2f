"""Hash and dense grid encodings in Triton: forward with Jacobian, gradient to positions, table gradient, table Adam.

The definition is `field.reference.operations.encode`. Layout: features [2 levels, capacity], Jacobian [levels, 6,
capacity] (d feature 0 / dxyz, d feature 1 / dxyz), so that neighbouring threads touch neighbouring samples. Both
features of an entry are read as one 8-byte word. Programs run level by level, so that one level's table stays in the
L2 cache.
"""

from __future__ import annotations

import triton
import triton.language as tl

from biresnerf.field.cuda.access import load_vector, sample_counts, samples_of_block, store_vector
from biresnerf.field.grid_levels import HASH_PRIMES

PRIME_Y, PRIME_Z = tl.constexpr(HASH_PRIMES[1]), tl.constexpr(HASH_PRIMES[2])


@triton.jit
def _level_of_program(stride, hashed, offset):
    """This program's level: its stride, whether it is hashed, its first entry and number of entries."""
    level = tl.program_id(1)
    base = tl.load(offset + level)
    size = (tl.load(offset + level + 1) - base).to(tl.int32)
    return level, tl.load(stride + level), tl.load(hashed + level) != 0, base, size


@triton.jit
def _locate(x, i, here, capacity, scale):
    """Cell and fraction within it of samples' positions, per axis."""
    px, py, pz = load_vector(x + i, capacity, here)
    px, py, pz = px * scale + 0.5, py * scale + 0.5, pz * scale + 0.5
    ix, iy, iz = px.to(tl.int32), py.to(tl.int32), pz.to(tl.int32)
    fx, fy, fz = px - ix.to(tl.float32), py - iy.to(tl.float32), pz - iz.to(tl.float32)
    return ix.to(tl.uint32), iy.to(tl.uint32), iz.to(tl.uint32), fx, fy, fz


@triton.jit
def _index(ix, iy, iz, hashed, stride, size):
    """Entry of a vertex within its level."""
    side = stride.to(tl.uint32)
    y = iy * tl.where(hashed, PRIME_Y, side)
    z = iz * tl.where(hashed, PRIME_Z, side * side)
    mixed = (ix ^ y ^ z) & (size - 1).to(tl.uint32)
    return tl.where(hashed, mixed, ix + y + z).to(tl.int64)


@triton.jit
def _straight_through(fraction, smoothing):
    """1 + smoothing (pi/2) sin(pi w): Heo et al. 2023's factor on d w/dx. cos series of w - 1/2, error 5e-7."""
    q = (fraction - 0.5) * (fraction - 0.5) * 9.869604401089358
    cosine = 1.0 - q * (0.5 - q * (1 / 24 - q * (1 / 720 - q * (1 / 40320 - q * (1 / 3628800)))))
    return 1.0 + smoothing * 1.5707963267948966 * cosine


@triton.jit
def encode(
    x, words, scale, stride, hashed, offset, taken, smoothing, features, jacobian, row, capacity,
    WITH_JACOBIAN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Features of `taken` points x [3, capacity] from row `row` on; `words` is the table, an entry per int64."""
    n = tl.load(taken)
    if tl.program_id(0) * BLOCK >= n:
        return
    i, here = samples_of_block(tl.program_id(0), n, BLOCK)
    level, side, by_hash, base, size = _level_of_program(stride, hashed, offset)
    s = tl.load(scale + level)
    ix, iy, iz, fx, fy, fz = _locate(x, i, here, capacity, s)
    f0 = tl.zeros([BLOCK], tl.float32)
    f1, x0, x1, y0, y1, z0, z1 = f0, f0, f0, f0, f0, f0, f0
    for corner in tl.static_range(8):
        index = _index(ix + (corner & 1), iy + ((corner >> 1) & 1), iz + (corner >> 2), by_hash, side, size)
        word = tl.load(words + base + index, mask=here, other=0)
        p = word.to(tl.uint32).to(tl.float32, bitcast=True)
        q = (word >> 32).to(tl.uint32).to(tl.float32, bitcast=True)
        wx = fx if corner & 1 else 1.0 - fx
        wy = fy if (corner >> 1) & 1 else 1.0 - fy
        wz = fz if corner >> 2 else 1.0 - fz
        f0 += wx * wy * wz * p
        f1 += wx * wy * wz * q
        if WITH_JACOBIAN:
            ux = wy * wz if corner & 1 else -wy * wz
            uy = wx * wz if (corner >> 1) & 1 else -wx * wz
            uz = wx * wy if corner >> 2 else -wx * wy
            x0, x1 = x0 + ux * p, x1 + ux * q
            y0, y1 = y0 + uy * p, y1 + uy * q
            z0, z1 = z0 + uz * p, z1 + uz * q
    out = features + (row + 2 * level).to(tl.int64) * capacity + i
    tl.store(out, f0, mask=here)
    tl.store(out + capacity, f1, mask=here)
    if WITH_JACOBIAN:
        smooth = tl.load(smoothing)
        sx = s * _straight_through(fx, smooth)
        sy = s * _straight_through(fy, smooth)
        sz = s * _straight_through(fz, smooth)
        j = jacobian + (6 * level).to(tl.int64) * capacity + i
        store_vector(j, capacity, sx * x0, sy * y0, sz * z0, here)
        store_vector(j + 3 * capacity, capacity, sx * x1, sy * y1, sz * z1, here)


@triton.jit
def position_gradient(
    g_features, jacobian, share, taken, g_x, row, levels, capacity, ACCUMULATE: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """g_x [3, capacity] (+)= share J^T g for feature gradients from row `row` on."""
    n = tl.load(taken)
    if tl.program_id(0) * BLOCK >= n:
        return
    i, here = samples_of_block(tl.program_id(0), n, BLOCK)
    a = tl.zeros([BLOCK], tl.float32)
    b, c = a, a
    for level in range(levels):
        g = g_features + (row + 2 * level).to(tl.int64) * capacity + i
        j = jacobian + tl.cast(6 * level, tl.int64) * capacity + i
        u = tl.load(g, mask=here, other=0.0)
        v = tl.load(g + capacity, mask=here, other=0.0)
        x0, y0, z0 = load_vector(j, capacity, here)
        x1, y1, z1 = load_vector(j + 3 * capacity, capacity, here)
        a, b, c = a + (u * x0 + v * x1), b + (u * y0 + v * y1), c + (u * z0 + v * z1)
    factor = tl.load(share)
    a, b, c = factor * a, factor * b, factor * c
    if ACCUMULATE:
        x0, y0, z0 = load_vector(g_x + i, capacity, here)
        a, b, c = a + x0, b + y0, c + z0
    store_vector(g_x + i, capacity, a, b, c, here)


@triton.jit
def table_gradient(
    x, g_features, scale, stride, hashed, offset, ray_offset, trained_rays, taken, gradient, row, capacity,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Add the trained samples' feature gradients to the table's gradient [entries, 2], by atomic additions."""
    _all, n = sample_counts(taken, ray_offset, trained_rays)
    if tl.program_id(0) * BLOCK >= n:
        return
    i, here = samples_of_block(tl.program_id(0), n, BLOCK)
    level, side, by_hash, base, size = _level_of_program(stride, hashed, offset)
    ix, iy, iz, fx, fy, fz = _locate(x, i, here, capacity, tl.load(scale + level))
    g = g_features + (row + 2 * level).to(tl.int64) * capacity + i
    u = tl.load(g, mask=here, other=0.0)
    v = tl.load(g + capacity, mask=here, other=0.0)
    for corner in tl.static_range(8):
        index = _index(ix + (corner & 1), iy + ((corner >> 1) & 1), iz + (corner >> 2), by_hash, side, size)
        weight = fx if corner & 1 else 1.0 - fx
        weight = weight * (fy if (corner >> 1) & 1 else 1.0 - fy)
        weight = weight * (fz if corner >> 2 else 1.0 - fz)
        entry = gradient + 2 * (base + index)
        tl.atomic_add(entry, weight * u, mask=here, sem="relaxed")
        tl.atomic_add(entry + 1, weight * v, mask=here, sem="relaxed")


@triton.jit
def adam_touched(
    table, gradient, moment1, moment2, offset, rates, corrections, BETA1: tl.constexpr, BETA2: tl.constexpr,
    EPSILON: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adam on the numbers of a table whose gradient is not zero; leaves the gradient zero.

    `rates` per level, 0 leaves a level alone; `corrections` = 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t).
    """
    level = tl.program_id(1)
    base = 2 * tl.load(offset + level)
    n = 2 * tl.load(offset + level + 1) - base
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    g = tl.load(gradient + base + i, mask=i < n, other=0.0)
    touched = g != 0.0
    if tl.max(touched.to(tl.int32), 0) == 0:
        return
    tl.store(gradient + base + i, 0.0 * g, mask=touched)
    rate = tl.load(rates + level)
    if rate == 0.0:
        return
    first = tl.load(moment1 + base + i, mask=touched, other=0.0)
    second = tl.load(moment2 + base + i, mask=touched, other=0.0)
    p = tl.load(table + base + i, mask=touched, other=0.0)
    first = BETA1 * first + (1.0 - BETA1) * g
    second = BETA2 * second + (1.0 - BETA2) * g * g
    p -= rate * (first * tl.load(corrections)) / (tl.sqrt(second) * tl.load(corrections + 1) + EPSILON)
    tl.store(moment1 + base + i, first, mask=touched)
    tl.store(moment2 + base + i, second, mask=touched)
    tl.store(table + base + i, p, mask=touched)
