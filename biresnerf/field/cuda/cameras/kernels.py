"""Rigid motions of cameras and rays of their pixels, with their ways back, as Triton kernels.

`biresnerf.geometry.lie.se3_exp` defines the motions. Those are few, so they are computed in float64.
"""

from __future__ import annotations

import triton
import triton.language as tl

from biresnerf.field.cuda.access import load_vector, store_vector

TERMS = tl.constexpr(9)  # of the series, below one squared radian: as in the geometry


@triton.jit
def _series(s, K: tl.constexpr, FACTORIAL: tl.constexpr):
    """The sum over j of (-s)^j K! / (K + 2j)!, over FACTORIAL."""
    total = s * 0.0 + 1.0
    for i in tl.static_range(1, TERMS):
        total = 1.0 - total * s / ((K + 2 * (TERMS - i) - 1) * (K + 2 * (TERMS - i)))
    return total / FACTORIAL


@triton.jit
def _stumpff(s):
    """The first five Stumpff functions of squared angles, see `biresnerf.geometry.lie`."""
    near = s < 1.0
    angle = tl.sqrt(tl.where(near, 1.0, s))
    far = angle * angle
    half = tl.sin(0.5 * angle) / angle
    c1 = tl.sin(angle) / angle
    c2 = 2.0 * half * half
    c3 = (1.0 - c1) / far
    c4 = (0.5 - c2) / far
    c5 = (1.0 / 6.0 - c3) / far
    return (
        tl.where(near, _series(s, 1, 1), c1),
        tl.where(near, _series(s, 2, 2), c2),
        tl.where(near, _series(s, 3, 6), c3),
        tl.where(near, _series(s, 4, 24), c4),
        tl.where(near, _series(s, 5, 120), c5),
    )


@triton.jit
def _dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@triton.jit
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@triton.jit
def _twist(rotation, translation, body, length, i, here):
    """The row of each camera's body, and its twist in float64."""
    row = tl.load(body + i, mask=here, other=0)
    wx, wy, wz = load_vector(rotation + 3 * row, 1, here)
    vx, vy, vz = load_vector(translation + 3 * row, 1, here)
    scale = length.to(tl.float64)
    wx, wy, wz = wx.to(tl.float64), wy.to(tl.float64), wz.to(tl.float64)
    return row, wx, wy, wz, vx.to(tl.float64) * scale, vy.to(tl.float64) * scale, vz.to(tl.float64) * scale


@triton.jit
def move(rotation, translation, body, start, length, matrices, n, BLOCK: tl.constexpr):
    """Fill matrices [n, 3, 4] with start [n, 3, 4] moved by the increments [bodies, 3] of each camera's body [n].

    A unit of translation is length [1] long.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    _, wx, wy, wz, vx, vy, vz = _twist(rotation, translation, body, tl.load(length), i, here)
    s, along = _dot(wx, wy, wz, wx, wy, wz), _dot(wx, wy, wz, vx, vy, vz)
    c1, c2, c3, _, _ = _stumpff(s)
    # hat(w)^2 = w w^T - |w|^2; the translation is v + c2 w x v + c3 (w (w . v) - |w|^2 v).
    x, y, z = _cross(wx, wy, wz, vx, vy, vz)
    x, y, z = (
        vx + c2 * x + c3 * (wx * along - s * vx),
        vy + c2 * y + c3 * (wy * along - s * vy),
        vz + c2 * z + c3 * (wz * along - s * vz),
    )
    xx, xy, xz = 1.0 + c2 * (wx * wx - s), c2 * wx * wy - c1 * wz, c2 * wx * wz + c1 * wy
    yx, yy, yz = c2 * wy * wx + c1 * wz, 1.0 + c2 * (wy * wy - s), c2 * wy * wz - c1 * wx
    zx, zy, zz = c2 * wz * wx - c1 * wy, c2 * wz * wy + c1 * wx, 1.0 + c2 * (wz * wz - s)
    for j in tl.static_range(4):
        sx, sy, sz = load_vector(start + 12 * i + j, 4, here)
        mx, my, mz = (
            _dot(xx, xy, xz, sx, sy, sz),
            _dot(yx, yy, yz, sx, sy, sz),
            _dot(zx, zy, zz, sx, sy, sz),
        )
        if j == 3:
            mx, my, mz = mx + x, my + y, mz + z
        store_vector(matrices + 12 * i + j, 4, mx.to(tl.float32), my.to(tl.float32), mz.to(tl.float32), here)


@triton.jit
def move_backward(
    rotation, translation, body, start, length, g_matrices, g_rotation, g_translation, n, BLOCK: tl.constexpr
):  # fmt: skip
    """Add the gradients to the increments [bodies, 3] from those to `move`'s matrices [n, 3, 4]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    scale = tl.load(length)
    row, wx, wy, wz, vx, vy, vz = _twist(rotation, translation, body, scale, i, here)
    # Gradients to the rotation are G = g start^T, a row for each of its rows; those to the translation are h.
    hx, hy, hz = load_vector(g_matrices + 12 * i + 3, 4, here)
    hx, hy, hz = hx.to(tl.float64), hy.to(tl.float64), hz.to(tl.float64)
    zero = wx * 0.0
    xx, xy, xz, yx, yy, yz, zx, zy, zz = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for j in tl.static_range(4):
        sx, sy, sz = load_vector(start + 12 * i + j, 4, here)
        gx, gy, gz = load_vector(g_matrices + 12 * i + j, 4, here)
        gx, gy, gz = gx.to(tl.float64), gy.to(tl.float64), gz.to(tl.float64)
        xx, xy, xz = xx + gx * sx, xy + gx * sy, xz + gx * sz
        yx, yy, yz = yx + gy * sx, yy + gy * sy, yz + gy * sz
        zx, zy, zz = zx + gz * sx, zy + gz * sy, zz + gz * sz
    s, along = _dot(wx, wy, wz, wx, wy, wz), _dot(wx, wy, wz, vx, vy, vz)
    c1, c2, c3, c4, c5 = _stumpff(s)
    trace, hv, hw = xx + yy + zz, _dot(hx, hy, hz, vx, vy, vz), _dot(hx, hy, hz, wx, wy, wz)
    ax, ay, az = zy - yz, xz - zx, yx - xy
    px, py, pz = _cross(wx, wy, wz, vx, vy, vz)
    # (G + G^T) w, half of whose product with w is w^T G w.
    qx = _dot(xx + xx, xy + yx, xz + zx, wx, wy, wz)
    qy = _dot(yx + xy, yy + yy, yz + zy, wx, wy, wz)
    qz = _dot(zx + xz, zy + yz, zz + zz, wx, wy, wz)
    g_c1 = _dot(wx, wy, wz, ax, ay, az)
    g_c2 = 0.5 * _dot(wx, wy, wz, qx, qy, qz) - s * trace + _dot(hx, hy, hz, px, py, pz)
    g_c3 = along * hw - s * hv
    # The derivative of c_k by the squared angle is (k c_(k+2) - c_(k+1)) / 2.
    slope = g_c1 * (c3 - c2) + g_c2 * (2.0 * c4 - c3) + g_c3 * (3.0 * c5 - c4)
    g_s = slope - 2.0 * (c2 * trace + c3 * hv)  # twice the gradient to the squared angle, as it meets w
    ux, uy, uz = _cross(vx, vy, vz, hx, hy, hz)
    to_h, to_v = c3 * along, c3 * hw
    _add(
        g_rotation + 3 * row,
        c1 * ax + c2 * (qx + ux) + to_h * hx + g_s * wx + to_v * vx,
        c1 * ay + c2 * (qy + uy) + to_h * hy + g_s * wy + to_v * vy,
        c1 * az + c2 * (qz + uz) + to_h * hz + g_s * wz + to_v * vz,
        here,
    )
    tx, ty, tz = _cross(hx, hy, hz, wx, wy, wz)
    rest = 1.0 - c3 * s
    _add(
        g_translation + 3 * row,
        scale * (rest * hx + to_v * wx + c2 * tx),
        scale * (rest * hy + to_v * wy + c2 * ty),
        scale * (rest * hz + to_v * wz + c2 * tz),
        here,
    )


@triton.jit
def _add(pointer, x, y, z, here):
    tl.atomic_add(pointer, x.to(tl.float32), mask=here, sem="relaxed")
    tl.atomic_add(pointer + 1, y.to(tl.float32), mask=here, sem="relaxed")
    tl.atomic_add(pointer + 2, z.to(tl.float32), mask=here, sem="relaxed")


@triton.jit
def cast(matrices, camera, in_cam, origin, direction, n, BLOCK: tl.constexpr):
    """Fill origin and direction [n, 3] of rays with directions in_cam [n, 3] in cameras [n] of matrices [., 3, 4]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    m = matrices + 12 * tl.load(camera + i, mask=here, other=0)
    x, y, z = load_vector(in_cam + 3 * i, 1, here)
    for k in tl.static_range(3):
        mx, my, mz = load_vector(m + 4 * k, 1, here)
        tl.store(direction + 3 * i + k, _dot(mx, my, mz, x, y, z), mask=here)
        tl.store(origin + 3 * i + k, tl.load(m + 4 * k + 3, mask=here, other=0.0), mask=here)


@triton.jit
def cast_backward(camera, in_cam, g_origin, g_direction, g_matrices, n, BLOCK: tl.constexpr):
    """Add the gradients of all rays to those of their cameras [., 3, 4]."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    g = g_matrices + 12 * tl.load(camera + i, mask=here, other=0)
    x, y, z = load_vector(in_cam + 3 * i, 1, here)
    for k in tl.static_range(3):
        along = tl.load(g_direction + 3 * i + k, mask=here, other=0.0)
        _add(g + 4 * k, along * x, along * y, along * z, here)
        at = tl.load(g_origin + 3 * i + k, mask=here, other=0.0)
        tl.atomic_add(g + 4 * k + 3, at, mask=here, sem="relaxed")
