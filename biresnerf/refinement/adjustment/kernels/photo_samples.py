"""Values and gradients of photos that are cubic B-splines."""

from __future__ import annotations

from biresnerf.field.numba_kernels import njit
from biresnerf.refinement.adjustment.kernels.compiled import KERNEL


@njit(inline="always", **KERNEL)
def spline_weights(t, w, d):
    """Weights [4] of a cubic B-spline's coefficients at t in 0..1 between the middle two, and their derivative."""
    o = 1 - t
    w[0], w[3] = o * o * o / 6, t * t * t / 6
    w[1] = (3 * t * t * t - 6 * t * t + 4) / 6
    w[2] = 1 - w[0] - w[1] - w[3]
    d[0], d[3] = -o * o / 2, t * t / 2
    d[1] = (9 * t * t - 12 * t) / 6
    d[2] = -d[0] - d[1] - d[3]


@njit(inline="always", **KERNEL)
def sample(coefficients, frames, photo, x, y, out, wx, dx, wy, dy):
    """Value and gradient [channels, 3] of a photo at pixel position (x, y); False near its border and outside."""
    u, v = x - 0.5, y - 0.5
    width, height = frames[photo, 1], frames[photo, 2]
    if not (u >= 1 and v >= 1 and u < width - 2 and v < height - 2):
        return False
    ix, iy = int(u), int(v)
    spline_weights(u - ix, wx, dx)
    spline_weights(v - iy, wy, dy)
    out[:] = 0
    for a in range(4):
        row = frames[photo, 0] + (iy - 1 + a) * width + ix - 1
        for c in range(coefficients.shape[1]):
            value, slope = 0.0, 0.0
            for b in range(4):
                value += wx[b] * coefficients[row + b, c]
                slope += dx[b] * coefficients[row + b, c]
            out[c, 0] += wy[a] * value
            out[c, 1] += wy[a] * slope
            out[c, 2] += dy[a] * value
    return True
