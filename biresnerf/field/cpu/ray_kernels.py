"""View harmonics of rays and gradients of rays, in Numba.

The harmonics' definition is `biresnerf.field.spherical_harmonics`.
"""

from __future__ import annotations

import numpy as np

from biresnerf.field.cpu.vector_access import KERNEL, PARALLEL_KERNEL
from biresnerf.field.numba_kernels import njit, prange

f4 = np.float32
A, B, C = f4(0.48860251190291987), f4(1.0925484305920792), f4(0.94617469575756)
D, E = f4(0.31539156525252), f4(0.5462742152960396)
F, G, H = f4(0.5900435899266435), f4(2.890611442640554), f4(0.4570457994644658)
J, K = f4(0.3731763325901154), f4(1.445305721320277)
ONE, TWO, THREE, FIVE = f4(1), f4(2), f4(3), f4(5)


@njit(**KERNEL)
def harmonics(direction, view):
    """Fill view [rays, 16] for directions [rays, 3]."""
    for r in range(direction.shape[0]):
        x, y, z = direction[r, 0], direction[r, 1], direction[r, 2]
        xx, yy, zz = x * x, y * y, z * z
        view[r, 0] = f4(0.28209479177387814)
        view[r, 1], view[r, 2], view[r, 3] = -A * y, A * z, -A * x
        view[r, 4], view[r, 5], view[r, 7] = B * x * y, -B * y * z, -B * x * z
        view[r, 6], view[r, 8] = C * zz - D, E * (xx - yy)
        view[r, 9], view[r, 15] = F * y * (yy - THREE * xx), F * x * (THREE * yy - xx)
        view[r, 10] = G * x * y * z
        view[r, 11], view[r, 13] = H * y * (ONE - FIVE * zz), H * x * (ONE - FIVE * zz)
        view[r, 12], view[r, 14] = J * z * (FIVE * zz - THREE), K * z * (xx - yy)


@njit(**KERNEL)
def add_harmonics_gradient(direction, g_view, g_direction):
    """Add the gradient that g_view [rays, 16] gives to directions [rays, 3]."""
    for r in range(direction.shape[0]):
        x, y, z = direction[r, 0], direction[r, 1], direction[r, 2]
        xx, yy, zz = x * x, y * y, z * z
        g = g_view[r]
        ring, ends = H * (ONE - FIVE * zz), f4(10) * H
        g_direction[r, 0] += (
            B * (y * g[4] - z * g[7]) - A * g[3] + TWO * E * x * g[8] + G * y * z * g[10] + ring * g[13]
            + TWO * K * x * z * g[14] + THREE * F * ((yy - xx) * g[15] - TWO * x * y * g[9])
        )  # fmt: skip
        g_direction[r, 1] += (
            B * (x * g[4] - z * g[5]) - A * g[1] - TWO * E * y * g[8] + G * x * z * g[10] + ring * g[11]
            - TWO * K * y * z * g[14] + THREE * F * ((yy - xx) * g[9] + TWO * x * y * g[15])
        )  # fmt: skip
        g_direction[r, 2] += (
            A * g[2] - B * (y * g[5] + x * g[7]) + TWO * C * z * g[6] + G * x * y * g[10]
            - ends * z * (y * g[11] + x * g[13]) + J * (f4(15) * zz - THREE) * g[12] + K * (xx - yy) * g[14]
        )  # fmt: skip


@njit(**PARALLEL_KERNEL)
def ray_gradients(origin, direction, offset, t, dx, unbounded, g_origin, g_direction):
    """Sum the samples' gradients dx [3, n] to grid positions into their rays: autograd of `reference.grid_position`."""
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
