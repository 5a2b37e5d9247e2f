"""Ray marching through the occupancy grid, compositing and gradients to rays, in Numba.

The definitions are in `biresnerf.field.reference`. Rays live in the unit frame; the encoding sees positions in
[0, 1]: (x + 1) / 2 when the scene is bounded, (contract(x) + 2) / 4 when it is not.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from biresnerf.field.cpu.matrix_blocks import exponential
from biresnerf.field.cpu.vector_access import PARALLEL_KERNEL

f4, i4 = np.float32, np.int32
ONE, TWO = f4(1), f4(2)
EDGE = f4(1e-6)  # keeps grid positions strictly inside [0, 1)


@njit(inline="always", fastmath=True)
def _grid_position(px, py, pz, unbounded):
    """Position in [0, 1]^3 and the largest coordinate m."""
    m = max(abs(px), max(abs(py), abs(pz)))
    if unbounded:
        factor = ONE if m <= ONE else (TWO - ONE / m) / m
        return (
            px * factor * f4(0.25) + f4(0.5),
            py * factor * f4(0.25) + f4(0.5),
            pz * factor * f4(0.25) + f4(0.5),
            m,
        )
    return px * f4(0.5) + f4(0.5), py * f4(0.5) + f4(0.5), pz * f4(0.5) + f4(0.5), m


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


@njit(**PARALLEL_KERNEL)
def composite(offset, t, dt, density, colour, background, out_colour, out_opacity, out_depth):
    """Quadrature of the volume rendering integral (Max 1995; Mildenhall et al. 2020, eq. 3) over packed samples."""
    total = density.shape[0]
    for r in prange(out_opacity.shape[0]):
        transmittance, c0, c1, c2, depth = ONE, f4(0), f4(0), f4(0), f4(0)
        for i in range(offset[r], offset[r + 1]):
            alpha = ONE - exponential(-density[i] * dt[i])
            weight = transmittance * alpha
            c0 += weight * colour[i]
            c1 += weight * colour[total + i]
            c2 += weight * colour[2 * total + i]
            depth += weight * t[i]
            transmittance *= ONE - alpha
        out_colour[r, 0] = c0 + transmittance * background[r, 0]
        out_colour[r, 1] = c1 + transmittance * background[r, 1]
        out_colour[r, 2] = c2 + transmittance * background[r, 2]
        out_opacity[r] = ONE - transmittance
        out_depth[r] = depth / max(ONE - transmittance, f4(1e-6))


@njit(**PARALLEL_KERNEL)
def composite_backward(
    offset, dt, density, colour, background, out_colour, out_opacity, g_colour, g_opacity, gd, gc
):
    """Gradients to density gd [n] and sample colour gc [3 n], from those of the rays' colour and opacity."""
    total = density.shape[0]
    for r in prange(out_opacity.shape[0]):
        g0, g1, g2 = g_colour[r, 0], g_colour[r, 1], g_colour[r, 2]
        last = ONE - out_opacity[r]
        g_last = -g_opacity[r]
        transmittance = ONE
        # What lies behind the sample at hand: sum of w_j c_j over later samples, and the background.
        s0, s1, s2 = out_colour[r, 0], out_colour[r, 1], out_colour[r, 2]
        for i in range(offset[r], offset[r + 1]):
            alpha = ONE - exponential(-density[i] * dt[i])
            weight = transmittance * alpha
            q0, q1, q2 = colour[i], colour[total + i], colour[2 * total + i]
            s0 -= weight * q0
            s1 -= weight * q1
            s2 -= weight * q2
            gc[i], gc[total + i], gc[2 * total + i] = weight * g0, weight * g1, weight * g2
            transmittance *= ONE - alpha
            gd[i] = dt[i] * (
                g0 * (transmittance * q0 - s0)
                + g1 * (transmittance * q1 - s1)
                + g2 * (transmittance * q2 - s2)
                - g_last * last
            )


@njit(**PARALLEL_KERNEL)
def ray_gradients(origin, direction, offset, t, dx, g_view, unbounded, g_origin, g_direction, g_harmonics):
    """Sum the samples' gradients dx [n, 3] (to grid positions) and g_view [16 n] into their rays."""
    total = t.shape[0]
    for r in prange(g_origin.shape[0]):
        a0 = a1 = a2 = b0 = b1 = b2 = f4(0)
        for i in range(offset[r], offset[r + 1]):
            u, v, w = dx[i, 0], dx[i, 1], dx[i, 2]
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
                u, v, w = f4(0.25) * u, f4(0.25) * v, f4(0.25) * w
            else:
                u, v, w = f4(0.5) * u, f4(0.5) * v, f4(0.5) * w
            a0 += u
            a1 += v
            a2 += w
            b0 += t[i] * u
            b1 += t[i] * v
            b2 += t[i] * w
        g_origin[r, 0], g_origin[r, 1], g_origin[r, 2] = a0, a1, a2
        g_direction[r, 0], g_direction[r, 1], g_direction[r, 2] = b0, b1, b2
        for c in range(16):
            s = f4(0)
            for i in range(offset[r], offset[r + 1]):
                s += g_view[c * total + i]
            g_harmonics[r, c] = s
