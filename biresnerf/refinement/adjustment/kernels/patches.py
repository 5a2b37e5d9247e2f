"""Patches of photos compared with other photos: residuals, and the cameras' normal equations without the depths.

The definitions are in `tests.refinement.adjustment.reference`. Cameras and their increments are those of `tracks`.
Photos are cubic B-splines: coefficients [total_px, channels], photo after photo, row by row, with `frames` [n, 3]:
first row of the coefficients, width and height. A patch i has rays [k, 3] (z = 1) in its host's axes, and inverse
depths [k] times its one unknown, the scale s[i]; its comparisons lie one after the other. Rays are those of the lens as
it is, so that they turn with an increment of the host's.
"""

from __future__ import annotations

import numpy as np

from biresnerf.field.numba_kernels import njit
from biresnerf.refinement.adjustment.kernels.blocks import add_block
from biresnerf.refinement.adjustment.kernels.compiled import KERNEL
from biresnerf.refinement.adjustment.kernels.lens import bent, bent_slopes, by_unknown
from biresnerf.refinement.adjustment.kernels.photo_samples import sample

SCAN, HALVINGS = 6, 5  # steps to either side of a scan, and how often the last one's length is halved
UNSEEN = 1e9  # squared error of a comparison that leaves the photo


@njit(**KERNEL)
def compare(
    rotation, centre, lens, photos, values, host, target, rays, rho, s, floor, slope, kinds, jac, r, work
):  # fmt: skip
    """Mean square of one comparison in the noise expected of its pixels, and that noise's variance.

    Args:
        kinds: which parameters of lenses are unknown.
        jac: [k, channels, 13 + 2 kinds], filled with derivatives by the host's increment, the target's and the scale;
            or empty. Each increment ends with that of the lens.
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
        ux, uy = q[0] * z, q[1] * z
        x, y = bent(lens, target, ux, uy)
        x, y = lens[target, 0] * x + lens[target, 2], lens[target, 1] * y + lens[target, 3]
        if not sample(coefficients, frames, target, x, y, out, wx, dx, wy, dy):
            return UNSEEN, 1.0
        for c in range(channels):
            r[k, c] = out[c, 0] - values[k, c]
            squares += r[k, c] * r[k, c]
            steep += out[c, 1] * out[c, 1] + out[c, 2] * out[c, 2]
            if len(jac) == 0:
                continue
            differentiate(
                rotation, centre, lens, host, target, rays[k], rho[k], depth, a, v, z, ux, uy,
                out[c, 1] * lens[target, 0], out[c, 2] * lens[target, 1], kinds, g, jac[k, c],
            )  # fmt: skip
    count = len(rho) * channels
    variance = floor * floor + slope * slope * steep / count
    return squares / count / variance, variance


@njit(inline="always", **KERNEL)
def differentiate(
    rotation, centre, lens, host, target, ray, rho, depth, a, v, z, ux, uy, gx, gy, kinds, g, row
):  # fmt: skip
    """Fill row [13 + 2 kinds], see `compare`: derivatives of one channel of one pixel.

    Args:
        a, v: the pixel's direction from the host and from the target, in the world; g: room for three numbers.
        z, ux, uy: one over its depth in the target, and its slopes there.
        gx, gy: gradient of the target's colour in focal lengths.
    """
    width = len(row) // 2
    if width > 6:
        at_x, at_y = bent(lens, target, ux, uy)
        for k in range(len(kinds)):
            dx, dy = by_unknown(lens, target, kinds[k], ux, uy, at_x, at_y)
            row[width + 6 + k] = gx * dx + gy * dy
    xx, across, yy = bent_slopes(lens, target, ux, uy)
    gx, gy = (xx * gx + across * gy) * z, (across * gx + yy * gy) * z
    gz = -(gx * ux + gy * uy)
    row[2 * width] = 0
    for x in range(3):
        g[x] = rotation[target, x, 0] * gx + rotation[target, x, 1] * gy + rotation[target, x, 2] * gz
        row[3 + x] = depth * g[x]
        row[width + 3 + x] = -depth * g[x]
        row[2 * width] += rho * (centre[host, x] - centre[target, x]) * g[x]
    row[0], row[1], row[2] = a[1] * g[2] - a[2] * g[1], a[2] * g[0] - a[0] * g[2], a[0] * g[1] - a[1] * g[0]
    row[width] = v[2] * g[1] - v[1] * g[2]
    row[width + 1] = v[0] * g[2] - v[2] * g[0]
    row[width + 2] = v[1] * g[0] - v[0] * g[1]
    if width > 6:
        host_lens(rotation, lens, host, ray, kinds, g, row)


@njit(inline="always", **KERNEL)
def host_lens(rotation, lens, host, ray, kinds, g, row):
    """Columns of row from the seventh on: derivative by the host's lens, which changes the direction of its pixels."""
    x, y = ray[0], ray[1]
    at_x, at_y = bent(lens, host, x, y)
    xx, across, yy = bent_slopes(lens, host, x, y)
    determinant = xx * yy - across * across
    gx = g[0] * rotation[host, 0, 0] + g[1] * rotation[host, 1, 0] + g[2] * rotation[host, 2, 0]
    gy = g[0] * rotation[host, 0, 1] + g[1] * rotation[host, 1, 1] + g[2] * rotation[host, 2, 1]
    by_x, by_y = (yy * gx - across * gy) / determinant, (xx * gy - across * gx) / determinant
    for k in range(len(kinds)):
        dx, dy = by_unknown(lens, host, kinds[k], x, y, at_x, at_y)
        row[6 + k] = -(by_x * dx + by_y * dy)


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
    held = np.empty(0, np.int64)
    for i in range(len(host)):
        for e in range(start[i], start[i + 1]):
            squared[e], _ = compare(
                rotation, centre, lens, photos, values[i], host[i], target[e], rays[i], rho[i], s[i], floor, slope,
                held, none, r, work,
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
    held = np.empty(0, np.int64)
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
                    held, none, r, work,
                )  # fmt: skip
                cost += s2 * e2 / (s2 + e2) * pixels * channels
            if cost < best:
                best, s[i] = cost, tried


@njit(**KERNEL)
def patch_system(
    rotation, centre, lens, photos, values, host, rays, rho, start, target, s, host_rows, target_rows, host_parts,
    target_parts, offsets, floor, slope, scale, deviation, noise, damping, system, right, of_target,
):  # fmt: skip
    """Add the normal equations without the scales to the system, as `add_block`, and right [u], half the gradient.

    Args:
        host_rows, target_rows: [patches, w], [m, w], where the w = 6 + k unknowns of each one's camera, and those of
            its lens, are among all u.
        host_parts, target_parts, offsets: where these are among the system's blocks, see `Cameras`.

    Returns for each patch the inverse of its own entry and its gradient, and the mixed row of its host. Fills that of
    each target [m, w].
    """
    patches, pixels, channels = len(host), values.shape[1], values.shape[2]
    width, kinds = host_rows.shape[1], offsets[6:]
    last = 2 * width
    work, r, jac = (
        work_space(channels),
        np.empty((pixels, channels)),
        np.empty((pixels, channels, last + 1)),
    )
    inverses, gradients, of_host = np.zeros(patches), np.zeros(patches), np.zeros((patches, width))
    block, force = np.empty((last + 1, last + 1)), np.empty(last + 1)
    outer, s2 = np.empty((width, width)), scale * scale
    for i in range(patches):
        own = 1.0 / (deviation * deviation)
        gradients[i] = (s[i] - 1) * own
        h = host_rows[i]
        for e in range(start[i], start[i + 1]):
            e2, variance = compare(
                rotation, centre, lens, photos, values[i], host[i], target[e], rays[i], rho[i], s[i], floor, slope,
                kinds, jac, r, work,
            )  # fmt: skip
            if e2 >= UNSEEN:
                continue
            f = s2 / (s2 + e2)
            weighted_squares(jac, r, f * f / variance / (noise * noise), block, force)
            j = target_rows[e]
            for a in range(width):
                right[h[a]] += force[a]
                right[j[a]] += force[width + a]
                of_host[i, a] += block[a, last]
                of_target[e, a] = block[width + a, last]
            one, two = host_parts[i], target_parts[e]
            add_block(system, one, one, offsets, block[:width, :width])
            add_block(system, two, two, offsets, block[width:last, width:last])
            add_block(system, one, two, offsets, block[:width, width:last])
            add_block(system, two, one, offsets, block[width:last, :width])
            own += block[last, last]
            gradients[i] += force[last]
        inverses[i] = 1.0 / (own * (1 + damping))
        first, end = start[i], start[i + 1]
        for e in range(first - 1, end):
            left, one = (of_host[i], host_parts[i]) if e < first else (of_target[e], target_parts[e])
            for a in range(width):
                right[h[a] if e < first else target_rows[e, a]] -= inverses[i] * left[a] * gradients[i]
            for g in range(first - 1, end):
                across, two = (of_host[i], host_parts[i]) if g < first else (of_target[g], target_parts[g])
                for a in range(width):
                    for b in range(width):
                        outer[a, b] = -inverses[i] * left[a] * across[b]
                add_block(system, one, two, offsets, outer)
    return inverses, gradients, of_host


@njit(inline="always", **KERNEL)
def weighted_squares(jac, r, w, block, force):
    """block = w J^T J and force = w J^T r of jac [k, channels, d] and r [k, channels]."""
    size = len(force)
    block[:] = 0
    force[:] = 0
    for k in range(jac.shape[0]):
        for c in range(jac.shape[1]):
            row = jac[k, c]
            for a in range(size):
                force[a] += w * row[a] * r[k, c]
                for b in range(a, size):
                    block[a, b] += w * row[a] * row[b]
    for a in range(size):
        for b in range(a):
            block[a, b] = block[b, a]
