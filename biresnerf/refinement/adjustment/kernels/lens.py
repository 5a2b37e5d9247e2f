"""Lenses as the adjustment's kernels take them: where slopes appear, and the derivatives by slopes and by unknowns.

lens [n, 11] is fx, fy, cx, cy, the least depth that is in front, k1, k2, p1, p2, and the focal lengths that the
principal point's increments are measured in. A point at slopes x, y appears at fx x' + cx, fy y' + cy, with x', y'
as in `biresnerf.geometry.camera.distortion`. The unknowns are those of `biresnerf.refinement.adjustment.lens.lenses`.
"""

from __future__ import annotations

from biresnerf.field.numba_kernels import njit
from biresnerf.refinement.adjustment.kernels.compiled import KERNEL


@njit(inline="always", **KERNEL)
def bent(lens, cam, x, y):
    """x', y' of slopes."""
    s = x * x + y * y
    radial = 1 + s * (lens[cam, 5] + s * lens[cam, 6])
    p1, p2 = lens[cam, 7], lens[cam, 8]
    return x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + 2 * p2 * x * y + p1 * (
        s + 2 * y * y
    )


@njit(inline="always", **KERNEL)
def bent_slopes(lens, cam, x, y):
    """Derivatives of `bent`: of x' by x, of x' by y (and of y' by x, which is the same), of y' by y."""
    s = x * x + y * y
    radial = 1 + s * (lens[cam, 5] + s * lens[cam, 6])
    slope = 2 * lens[cam, 5] + 4 * s * lens[cam, 6]
    p1, p2 = lens[cam, 7], lens[cam, 8]
    return (
        radial + slope * x * x + 2 * p1 * y + 6 * p2 * x,
        slope * x * y + 2 * p1 * x + 2 * p2 * y,
        radial + slope * y * y + 2 * p2 * x + 6 * p1 * y,
    )


@njit(inline="always", **KERNEL)
def by_unknown(lens, cam, kind, x, y, at_x, at_y):
    """Derivative of where slopes x, y appear, in focal lengths, by one unknown of the lens; at_x, at_y are `bent`."""
    s = x * x + y * y
    if kind == 0:
        return at_x, at_y
    if kind == 1:
        return x * s, y * s
    if kind == 2:
        return x * s * s, y * s * s
    if kind == 3:
        return lens[cam, 9] / lens[cam, 0], 0.0
    if kind == 4:
        return 0.0, lens[cam, 10] / lens[cam, 1]
    if kind == 5:
        return 2 * x * y, s + 2 * y * y
    if kind == 6:
        return s + 2 * x * x, 2 * x * y
    return 0.0, at_y
