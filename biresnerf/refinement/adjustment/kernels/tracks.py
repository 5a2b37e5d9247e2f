"""Points seen in several photos: reprojection residuals, and the cameras' normal equations without the points.

The definitions are in `tests.refinement.adjustment.reference`. A point's observations lie one after the other.
Cameras are R = rotation [n, 3, 3] (world from cam), c = centre [n, 3]; lenses are those of `lens`. An increment of a
camera is a rotation vector w and a shift s, both in the world's axes: exp(w) R and c + s. What is
known of points before is (x - place)^T known (x - place), zero for most: known [p, 3, 3], place [p, 3].
"""

from __future__ import annotations

import numpy as np

from biresnerf.field.numba_kernels import njit
from biresnerf.refinement.adjustment.kernels.blocks import add_block
from biresnerf.refinement.adjustment.kernels.compiled import KERNEL, LEAST_DETERMINANT
from biresnerf.refinement.adjustment.kernels.lens import bent, bent_slopes, by_unknown


@njit(inline="always", **KERNEL)
def project_point(rotation, centre, lens, cam, x, xy, r, v, q):
    """Residual r [2] (px) of point x [3] seen by a camera at xy [2]; fills v = x - c and q = R^T v."""
    for a in range(3):
        v[a] = x[a] - centre[cam, a]
    for a in range(3):
        q[a] = rotation[cam, 0, a] * v[0] + rotation[cam, 1, a] * v[1] + rotation[cam, 2, a] * v[2]
    if not q[2] > lens[cam, 4]:
        return False
    x, y = bent(lens, cam, q[0] / q[2], q[1] / q[2])
    r[0] = lens[cam, 0] * x + lens[cam, 2] - xy[0]
    r[1] = lens[cam, 1] * y + lens[cam, 3] - xy[1]
    return True


@njit(inline="always", **KERNEL)
def point_jacobian(rotation, lens, cam, q, jac):
    """jac [2, 3]: derivative of the residual in the point."""
    z = 1.0 / q[2]
    x, y = q[0] * z, q[1] * z
    xx, across, yy = bent_slopes(lens, cam, x, y)
    for row in range(2):
        f = lens[cam, row] * z
        gx, gy = (f * xx, f * across) if row == 0 else (f * across, f * yy)
        gz = -(gx * x + gy * y)
        for a in range(3):
            jac[row, a] = rotation[cam, a, 0] * gx + rotation[cam, a, 1] * gy + rotation[cam, a, 2] * gz


@njit(inline="always", **KERNEL)
def lens_jacobian(lens, cam, kinds, q, camera):
    """Columns of camera [2, 6 + kinds] from the seventh on: derivative of the residual in the lens's unknowns."""
    if lens.shape[1] > 11 and lens[cam, 11] > 0:  # a fisheye's view (`adjustment.tangent_views`)
        for k in range(len(kinds)):
            at = 12 + 2 * kinds[k]
            camera[0, 6 + k], camera[1, 6 + k] = lens[cam, at], lens[cam, at + 1]
        return
    x, y = q[0] / q[2], q[1] / q[2]
    at_x, at_y = bent(lens, cam, x, y)
    for k in range(len(kinds)):
        dx, dy = by_unknown(lens, cam, kinds[k], x, y, at_x, at_y)
        camera[0, 6 + k], camera[1, 6 + k] = lens[cam, 0] * dx, lens[cam, 1] * dy


@njit(inline="always", **KERNEL)
def inverse3(m, out):
    """Inverse of a symmetric 3 x 3 matrix; False where it has none in this precision."""
    a = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    b = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    determinant = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
    size = (m[0, 0] + m[1, 1] + m[2, 2]) / 3
    if not determinant > LEAST_DETERMINANT * size * size * size:
        return False
    k = 1.0 / determinant
    out[0, 0], out[0, 1], out[0, 2] = a * k, b * k, c * k
    out[1, 1] = (m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]) * k
    out[1, 2] = (m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]) * k
    out[2, 2] = (m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]) * k
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return True


@njit(inline="always", **KERNEL)
def known_before(known, place, point, normal, gradient):
    """Starts a point's normal equations [3, 3] and [3] with what is known of it; returns its cost."""
    cost = 0.0
    for a in range(3):
        gradient[a] = 0
        for b in range(3):
            normal[a, b] = known[a, b]
            gradient[a] += known[a, b] * (point[b] - place[b])
        cost += gradient[a] * (point[a] - place[a])
    return cost


@njit(**KERNEL)
def track_errors(rotation, centre, lens, xyz, start, image, xy, squared):
    """Squared residual [m] of each observation, px^2; infinite where it is not in front."""
    r, v, q = np.empty(2), np.empty(3), np.empty(3)
    for i in range(len(xyz)):
        for e in range(start[i], start[i + 1]):
            seen = project_point(rotation, centre, lens, image[e], xyz[i], xy[e], r, v, q)
            squared[e] = r[0] * r[0] + r[1] * r[1] if seen else np.inf


@njit(**KERNEL)
def settle_points(rotation, centre, lens, xyz, start, image, xy, known, place, sigma, scale, rounds):
    """Move each point to the least robust cost for cameras that stay; Levenberg-Marquardt, in place."""
    r, v, q, jac = np.empty(2), np.empty(3), np.empty(3), np.empty((2, 3))
    normal, inverse, gradient, tried = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    s2, iv = scale * scale, 1.0 / (sigma * sigma)
    for i in range(len(xyz)):
        cost, damping = np.inf, 1e-4
        tried[:] = xyz[i]
        for _ in range(rounds):
            now = known_before(known[i], place[i], tried, normal, gradient)
            for e in range(start[i], start[i + 1]):
                if not project_point(rotation, centre, lens, image[e], tried, xy[e], r, v, q):
                    now += s2
                    continue
                e2 = (r[0] * r[0] + r[1] * r[1]) * iv
                f = s2 / (s2 + e2)
                now += f * e2
                point_jacobian(rotation, lens, image[e], q, jac)
                w = f * f * iv
                for a in range(3):
                    gradient[a] += w * (jac[0, a] * r[0] + jac[1, a] * r[1])
                    for b in range(3):
                        normal[a, b] += w * (jac[0, a] * jac[0, b] + jac[1, a] * jac[1, b])
            if now <= cost:
                done = cost - now <= 1e-6 * now
                cost = now
                xyz[i] = tried
                if done:
                    break
                kept, kept_gradient = normal.copy(), gradient.copy()
                damping = max(0.1 * damping, 1e-9)
            else:
                damping *= 10
            normal[:] = kept
            for a in range(3):
                normal[a, a] *= 1 + damping
            if not inverse3(normal, inverse):
                break
            for a in range(3):
                tried[a] = xyz[i, a]
                for b in range(3):
                    tried[a] -= inverse[a, b] * kept_gradient[b]


@njit(**KERNEL)
def track_cost(rotation, centre, lens, xyz, start, image, xy, known, place, sigma, scale):
    """Sum of the robust squares of all observations, and of the points' distances from where they are known to be."""
    r, v, q, normal, gradient = np.empty(2), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
    s2, iv, cost = scale * scale, 1.0 / (sigma * sigma), 0.0
    for i in range(len(xyz)):
        cost += known_before(known[i], place[i], xyz[i], normal, gradient)
        for e in range(start[i], start[i + 1]):
            if project_point(rotation, centre, lens, image[e], xyz[i], xy[e], r, v, q):
                e2 = (r[0] * r[0] + r[1] * r[1]) * iv
                cost += s2 * e2 / (s2 + e2)
            else:
                cost += s2
    return cost


@njit(**KERNEL)
def eliminate_point(
    rows, parts, offsets, first, last, blocks, forces, mixed, inverse, gradient, system, right
):
    """Add a point's observations, from first to last, to the normal equations of cameras and lenses alone.

    `blocks` and `forces` are the cameras' own, counted from the first; `inverse` and `gradient` the point's.
    """
    width = rows.shape[1]
    through, block = np.empty((width, 3)), np.empty((width, width))
    for e in range(first, last):
        for a in range(width):
            for b in range(3):
                through[a, b] = 0
                for c in range(3):
                    through[a, b] += mixed[e, a, c] * inverse[c, b]
        for a in range(width):
            row = rows[e, a]
            right[row] += forces[e - first, a]
            for b in range(3):
                right[row] -= through[a, b] * gradient[b]
        add_block(system, parts[e], parts[e], offsets, blocks[e - first])
        for g in range(first, last):
            if parts.shape[1] == 1 and parts[e, 0] > parts[g, 0]:
                continue
            for a in range(width):
                for b in range(width):
                    block[a, b] = -(
                        through[a, 0] * mixed[g, b, 0]
                        + through[a, 1] * mixed[g, b, 1]
                        + through[a, 2] * mixed[g, b, 2]
                    )
            add_block(system, parts[e], parts[g], offsets, block)


@njit(**KERNEL)
def track_system(
    rotation, centre, lens, xyz, start, image, xy, known, place, rows, parts, offsets, sigma, scale, damping, system,
    right, mixed,
):  # fmt: skip
    """Add the normal equations without the points to the system, as `add_block`, and right [u], half the gradient.

    Args:
        rows: [m, 6 + k], where the unknowns of each observation's camera, and those of its lens, are among all u.
        parts, offsets: [m, 1 or 2] and [6 + k], where these are among the system's blocks, see `Cameras`.
        mixed: zero; gets the mixed block [m, 6 + k, 3] of each observation of these points.

    Returns for each point the inverse of its own block and its gradient.
    A point that its observations do not fix in this precision has a zero inverse and no effect.
    """
    points, width, kinds = len(xyz), rows.shape[1], offsets[6:]
    inverses, gradients = np.zeros((points, 3, 3)), np.zeros((points, 3))
    own, jac, camera = np.empty((3, 3)), np.empty((2, 3)), np.empty((2, width))
    r, v, q = np.empty(2), np.empty(3), np.empty(3)
    s2, iv = scale * scale, 1.0 / (sigma * sigma)
    most = 0
    for i in range(points):
        most = max(most, start[i + 1] - start[i])
    blocks, forces = np.empty((most, width, width)), np.empty((most, width))
    for i in range(points):
        known_before(known[i], place[i], xyz[i], own, gradients[i])
        first = start[i]
        for e in range(first, start[i + 1]):
            blocks[e - first] = 0
            forces[e - first] = 0
            cam = image[e]
            if not project_point(rotation, centre, lens, cam, xyz[i], xy[e], r, v, q):
                continue
            f = s2 / (s2 + (r[0] * r[0] + r[1] * r[1]) * iv)
            w = f * f * iv
            point_jacobian(rotation, lens, cam, q, jac)
            for k in range(2):
                camera[k, 0] = -(v[1] * jac[k, 2] - v[2] * jac[k, 1])
                camera[k, 1] = -(v[2] * jac[k, 0] - v[0] * jac[k, 2])
                camera[k, 2] = -(v[0] * jac[k, 1] - v[1] * jac[k, 0])
                for a in range(3):
                    camera[k, 3 + a] = -jac[k, a]
            if width > 6:
                lens_jacobian(lens, cam, kinds, q, camera)
            for k in range(2):
                for a in range(3):
                    gradients[i, a] += w * jac[k, a] * r[k]
                    for b in range(3):
                        own[a, b] += w * jac[k, a] * jac[k, b]
                for a in range(width):
                    forces[e - first, a] += w * camera[k, a] * r[k]
                    for b in range(3):
                        mixed[e, a, b] += w * camera[k, a] * jac[k, b]
                    for b in range(width):
                        blocks[e - first, a, b] += w * camera[k, a] * camera[k, b]
        for a in range(3):
            own[a, a] *= 1 + damping
        if not inverse3(own, inverses[i]):
            inverses[i] = 0
            gradients[i] = 0
            continue
        eliminate_point(
            rows, parts, offsets, first, start[i + 1], blocks, forces, mixed, inverses[i], gradients[i], system, right
        )  # fmt: skip
    return inverses, gradients
