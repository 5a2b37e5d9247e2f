"""Ray marching through the occupancy grid and gradients to rays, in Numba.

The definitions are in `field.reference.operations`. Rays live in the unit frame; the encoding sees positions in
[0, 1]: (x + 1) / 2 when the scene is bounded, (contract(x) + 2) / 4 when it is not.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from biresnerf.field.cpu.vector_access import PARALLEL_KERNEL
from biresnerf.field.reference import operations

f4, i4 = np.float32, np.int32
ONE, TWO = f4(1), f4(2)
EDGE = f4(operations.EDGE)  # keeps grid positions strictly inside [0, 1)
_LARGEST_BITS = np.array(ONE - EDGE, f4).view(np.uint32)


@njit(inline="always", fastmath=True)
def _grid_position(px, py, pz, unbounded):
    """Position in [0, 1]^3 and the largest coordinate m."""
    m = max(abs(px), max(abs(py), abs(pz)))
    factor = f4(0.5)
    if unbounded:
        factor = f4(0.25) * (ONE if m <= ONE else (TWO - ONE / m) / m)
    return px * factor + f4(0.5), py * factor + f4(0.5), pz * factor + f4(0.5), m


@njit(inline="always", fastmath=True)
def _inside(v):
    return min(max(v, EDGE), ONE - EDGE)


@njit(**PARALLEL_KERNEL)
def march(origin, direction, jitter, occupied, side, step, near, far, unbounded, t_buffer, dt_buffer, count):
    """Start and length of the live intervals of each ray: t_buffer, dt_buffer [rays, most], count [rays].

    Intervals are `step` long, growing as m^2 outside the inner box (even in contracted space, along rays from its
    centre); one is live if the cell of its midpoint is.
    """
    most = t_buffer.shape[1]
    for r in prange(origin.shape[0]):
        ox, oy, oz = origin[r, 0], origin[r, 1], origin[r, 2]
        dx, dy, dz = direction[r, 0], direction[r, 1], direction[r, 2]
        t, t_end = near, far
        if not unbounded:
            for axis in range(3):
                d = direction[r, axis]
                if abs(d) < f4(1e-9):
                    d = f4(1e-9)
                ta, tb = (-ONE - origin[r, axis]) / d, (ONE - origin[r, axis]) / d
                t, t_end = max(t, min(ta, tb)), min(t_end, max(ta, tb))
        n = 0
        first = True
        while t < t_end and n < most:
            _, _, _, m = _grid_position(ox + t * dx, oy + t * dy, oz + t * dz, unbounded)
            dt = step
            if unbounded and m > ONE:
                dt = step * m * m
            if first:  # a random start within the first interval decorrelates the rays
                t += jitter[r] * dt
                first = False
                continue
            middle = t + f4(0.5) * dt
            if middle >= t_end:
                break
            gx, gy, gz, _ = _grid_position(ox + middle * dx, oy + middle * dy, oz + middle * dz, unbounded)
            ix = min(max(i4(gx * side), 0), side - 1)
            iy = min(max(i4(gy * side), 0), side - 1)
            iz = min(max(i4(gz * side), 0), side - 1)
            if occupied[(iz * side + iy) * side + ix]:
                t_buffer[r, n] = t
                dt_buffer[r, n] = dt
                n += 1
            t += dt
        count[r] = n


@njit(**PARALLEL_KERNEL)
def pack(origin, direction, t_buffer, dt_buffer, count, offset, unbounded, x, t, dt, ray):
    """The live intervals of all rays one after another: x [3 n] grid positions of midpoints, t, dt, ray [n]."""
    for r in prange(origin.shape[0]):
        base = offset[r]
        for k in range(count[r]):
            i = base + k
            length = dt_buffer[r, k]
            middle = t_buffer[r, k] + f4(0.5) * length
            gx, gy, gz, _ = _grid_position(
                origin[r, 0] + middle * direction[r, 0],
                origin[r, 1] + middle * direction[r, 1],
                origin[r, 2] + middle * direction[r, 2],
                unbounded,
            )
            x[3 * i], x[3 * i + 1], x[3 * i + 2] = _inside(gx), _inside(gy), _inside(gz)
            t[i], dt[i], ray[i] = middle, length, r


def bring_inside(x):
    """Replaces positions [3 n] that are not finite by the grid's edge, in place: tables are read without bounds checks.

    As unsigned numbers, positive floats are ordered as they are, and what is negative or not finite is larger.
    """
    bits = x.view(np.uint32)
    np.minimum(bits, _LARGEST_BITS, out=bits)


@njit(**PARALLEL_KERNEL)
def ray_gradients(origin, direction, offset, t, dx, unbounded, g_origin, g_direction):
    """Sum the samples' gradients dx [3, n] to grid positions into their rays."""
    scale = f4(0.25) if unbounded else f4(0.5)
    for r in prange(g_origin.shape[0]):
        a0 = a1 = a2 = b0 = b1 = b2 = f4(0)
        for i in range(offset[r], offset[r + 1]):
            u, v, w = dx[0, i], dx[1, i], dx[2, i]
            if unbounded:
                px = origin[r, 0] + t[i] * direction[r, 0]
                py = origin[r, 1] + t[i] * direction[r, 1]
                pz = origin[r, 2] + t[i] * direction[r, 2]
                m = max(abs(px), max(abs(py), abs(pz)))
                if m > ONE:
                    # y = f(m) x with f = (2 - 1/m)/m: J^T g = f g + f'(m) sign(x_k) (x . g) e_k, k the largest axis
                    inverse = ONE / m
                    factor = (TWO - inverse) * inverse
                    slope = (TWO * inverse - TWO) * inverse * inverse
                    along = slope * (px * u + py * v + pz * w)
                    u, v, w = factor * u, factor * v, factor * w
                    if abs(px) == m:
                        u += along if px > f4(0) else -along
                    elif abs(py) == m:
                        v += along if py > f4(0) else -along
                    else:
                        w += along if pz > f4(0) else -along
            a0 += u
            a1 += v
            a2 += w
            b0 += t[i] * u
            b1 += t[i] * v
            b2 += t[i] * w
        g_origin[r, 0], g_origin[r, 1], g_origin[r, 2] = scale * a0, scale * a1, scale * a2
        g_direction[r, 0], g_direction[r, 1], g_direction[r, 2] = scale * b0, scale * b1, scale * b2
