"""Patches of photos compared with other photos: residuals, and the cameras' normal equations without the depths.

The definitions are in `biresnerf.refine.adjustment.reference`. Cameras and their increments are those of `tracks`.
Photos are cubic B-splines: coefficients [total_px, channels], photo after photo, row by row, with `frames` [n, 3]:
first row of the coefficients, width and height. A patch i has rays [k, 3] (z = 1) in its host's axes, and inverse
depths [k] times its one unknown, the scale s[i]; its comparisons lie one after the other.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from biresnerf.refine.adjustment.kernels.compiled import KERNEL

SCAN, HALVINGS = 6, 5  # steps to either side of a scan, and how often the last one's length is halved
UNSEEN = 1e9  # squared error of a comparison that leaves the photo


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


@njit(**KERNEL)
def compare(rotation, centre, lens, photos, values, host, target, rays, rho, s, floor, slope, jac, r, work):
    """Mean square of one comparison in the noise expected of its pixels, and that noise's variance.

    Args:
        jac: [k, channels, 13], filled with derivatives by the host's increment, the target's and the scale; or empty.
        r: [k, channels], filled with the residuals.
        values: [k, channels], of the host photo.
        floor, slope: standard deviation of a pixel, and what its gradient adds to it.
    """
    coefficients, frames = photos
    out, wx, dx, wy, dy, a, v, q, g = work
    channels = coefficients.shape[1]
    squares, steep = 0.0, 0.0
    for k in range(len(rho)):
        depth = s * rho[k]
        for x in range(3):
            a[x] = (
                rotation[host, x, 0] * rays[k, 0]
                + rotation[host, x, 1] * rays[k, 1]
                + rotation[host, x, 2] * rays[k, 2]
            )
            v[x] = a[x] + depth * (centre[host, x] - centre[target, x])
        for x in range(3):
            q[x] = (
                rotation[target, 0, x] * v[0] + rotation[target, 1, x] * v[1] + rotation[target, 2, x] * v[2]
            )
        if not q[2] > 1e-3:
            return UNSEEN, 1.0
        z = 1.0 / q[2]
        x, y = lens[target, 0] * q[0] * z + lens[target, 2], lens[target, 1] * q[1] * z + lens[target, 3]
        if not sample(coefficients, frames, target, x, y, out, wx, dx, wy, dy):
            return UNSEEN, 1.0
        for c in range(channels):
            r[k, c] = out[c, 0] - values[k, c]
            squares += r[k, c] * r[k, c]
            steep += out[c, 1] * out[c, 1] + out[c, 2] * out[c, 2]
            if len(jac) == 0:
                continue
            gx, gy = out[c, 1] * lens[target, 0] * z, out[c, 2] * lens[target, 1] * z
            gz = -(gx * q[0] + gy * q[1]) * z
            row = jac[k, c]
            row[12] = 0
            for x in range(3):
                g[x] = rotation[target, x, 0] * gx + rotation[target, x, 1] * gy + rotation[target, x, 2] * gz
                row[3 + x] = depth * g[x]
                row[9 + x] = -depth * g[x]
                row[12] += rho[k] * (centre[host, x] - centre[target, x]) * g[x]
            row[0], row[1], row[2] = (
                a[1] * g[2] - a[2] * g[1],
                a[2] * g[0] - a[0] * g[2],
                a[0] * g[1] - a[1] * g[0],
            )
            row[6], row[7], row[8] = (
                v[2] * g[1] - v[1] * g[2],
                v[0] * g[2] - v[2] * g[0],
                v[1] * g[0] - v[0] * g[1],
            )
    count = len(rho) * channels
    variance = floor * floor + slope * slope * steep / count
    return squares / count / variance, variance


@njit(**KERNEL)
def work_space(channels):
    """Room for `compare`."""
    return (
        np.empty((channels, 3)), np.empty(4), np.empty(4), np.empty(4), np.empty(4),
        np.empty(3), np.empty(3), np.empty(3), np.empty(3),
    )  # fmt: skip


@njit(**KERNEL)
def patch_errors(
    rotation, centre, lens, photos, values, host, rays, rho, start, target, s, floor, slope, squared
):
    """Mean square [m] of each comparison."""
    pixels, channels = values.shape[1], values.shape[2]
    work, r, none = work_space(channels), np.empty((pixels, channels)), np.empty((0, channels, 13))
    for i in range(len(host)):
        for e in range(start[i], start[i + 1]):
            squared[e], _ = compare(
                rotation, centre, lens, photos, values[i], host[i], target[e], rays[i], rho[i], s[i], floor, slope,
                none, r, work,
            )  # fmt: skip


@njit(**KERNEL)
def settle_scales(
    rotation,
    centre,
    lens,
    photos,
    values,
    host,
    rays,
    rho,
    start,
    target,
    s,
    floor,
    slope,
    scale,
    deviation,
    reach,
):
    """Move each patch's scale to the least cost that a scan of s (1 - reach .. 1 + reach) leads to, in place."""
    pixels, channels = values.shape[1], values.shape[2]
    work, r, none = work_space(channels), np.empty((pixels, channels)), np.empty((0, channels, 13))
    s2, first = scale * scale, s.copy()
    for i in range(len(host)):
        best, step = np.inf, reach / SCAN
        middle = first[i]
        for t in range(2 * SCAN + 1 + 2 * HALVINGS):
            if t <= 2 * SCAN:
                tried = first[i] * (1 + step * (t - SCAN))
            else:
                half = (t - 2 * SCAN - 1) // 2
                if (t - 2 * SCAN) % 2 == 1:
                    middle = s[i]
                tried = middle + (1 - 2 * (t % 2)) * first[i] * step * 0.5 ** (half + 1)
            cost = ((tried - 1) / deviation) ** 2
            for e in range(start[i], start[i + 1]):
                e2, _ = compare(
                    rotation, centre, lens, photos, values[i], host[i], target[e], rays[i], rho[i], tried, floor, slope,
                    none, r, work,
                )  # fmt: skip
                cost += s2 * e2 / (s2 + e2) * pixels * channels
            if cost < best:
                best, s[i] = cost, tried


@njit(**KERNEL)
def patch_system(
    rotation, centre, lens, photos, values, host, rays, rho, start, target, s, floor, slope, scale, deviation, noise,
    damping, system, right,
):  # fmt: skip
    """Add the normal equations without the scales to system [6n, 6n] and right [6n], which is half the gradient.

    Returns of each patch the inverse of its own entry and its gradient, and the mixed row of its host, and that of each
    target [m, 6].
    """
    patches, pixels, channels = len(host), values.shape[1], values.shape[2]
    work, r, jac = work_space(channels), np.empty((pixels, channels)), np.empty((pixels, channels, 13))
    inverses, gradients = np.zeros(patches), np.zeros(patches)
    of_host, of_target = np.zeros((patches, 6)), np.zeros((len(target), 6))
    block, force = np.empty((13, 13)), np.empty(13)
    s2 = scale * scale
    for i in range(patches):
        own = 1.0 / (deviation * deviation)
        gradients[i] = (s[i] - 1) * own
        h = 6 * host[i]
        for e in range(start[i], start[i + 1]):
            e2, variance = compare(
                rotation, centre, lens, photos, values[i], host[i], target[e], rays[i], rho[i], s[i], floor, slope,
                jac, r, work,
            )  # fmt: skip
            if e2 >= UNSEEN:
                continue
            f = s2 / (s2 + e2)
            w = f * f / variance / (noise * noise)
            block[:] = 0
            force[:] = 0
            for k in range(pixels):
                for c in range(channels):
                    row = jac[k, c]
                    for a in range(13):
                        force[a] += w * row[a] * r[k, c]
                        for b in range(a, 13):
                            block[a, b] += w * row[a] * row[b]
            for a in range(13):
                for b in range(a):
                    block[a, b] = block[b, a]
            j = 6 * target[e]
            for a in range(6):
                right[h + a] += force[a]
                right[j + a] += force[6 + a]
                of_host[i, a] += block[a, 12]
                of_target[e, a] = block[6 + a, 12]
                for b in range(6):
                    system[h + a, h + b] += block[a, b]
                    system[j + a, j + b] += block[6 + a, 6 + b]
                    system[h + a, j + b] += block[a, 6 + b]
                    system[j + a, h + b] += block[6 + a, b]
            own += block[12, 12]
            gradients[i] += force[12]
        inverses[i] = 1.0 / (own * (1 + damping))
        _eliminate(
            host[i],
            of_host[i],
            gradients[i],
            inverses[i],
            start[i],
            start[i + 1],
            target,
            of_target,
            system,
            right,
        )
    return inverses, gradients, of_host, of_target


@njit(inline="always", **KERNEL)
def _eliminate(host, of_host, gradient, inverse, first, last, target, of_target, system, right):
    """Take one patch's scale out of the cameras' equations."""
    for e in range(first - 1, last):
        one = 6 * host if e < first else 6 * target[e]
        for a in range(6):
            x = inverse * (of_host[a] if e < first else of_target[e, a])
            if x == 0:
                continue
            right[one + a] -= x * gradient
            for g in range(first - 1, last):
                other = 6 * host if g < first else 6 * target[g]
                for b in range(6):
                    system[one + a, other + b] -= x * (of_host[b] if g < first else of_target[g, b])
