"""Gradients of samples summed into their rays, in Numba. The definition is autograd's of `reference.grid_position`."""

from __future__ import annotations

import numpy as np

from biresnerf.field.cpu.vector_access import PARALLEL_KERNEL
from biresnerf.field.numba_kernels import njit, prange

f4 = np.float32
ONE, TWO = f4(1), f4(2)


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
