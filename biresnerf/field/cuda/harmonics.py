"""View harmonics of ray directions and their gradient, in Triton: `biresnerf.field.spherical_harmonics`."""

from __future__ import annotations

import triton
import triton.language as tl

from biresnerf.field.cuda.access import load_vector, store_vector


@triton.jit
def _directions(direction, ray_count, BLOCK: tl.constexpr):
    """This program's rays, which of them exist, and their directions."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = r < tl.load(ray_count).to(tl.int32)
    x, y, z = load_vector(direction + 3 * r, 1, here)
    return r, here, x, y, z


@triton.jit
def view_harmonics(direction, ray_count, view, BLOCK: tl.constexpr):
    """view [rays, 16] of unit directions [rays, 3]."""
    r, here, x, y, z = _directions(direction, ray_count, BLOCK)
    xx, yy, zz = x * x, y * y, z * z
    out = view + 16 * r
    tl.store(out, 0.0 * x + 0.28209479177387814, mask=here)
    tl.store(out + 1, -0.48860251190291987 * y, mask=here)
    tl.store(out + 2, 0.48860251190291987 * z, mask=here)
    tl.store(out + 3, -0.48860251190291987 * x, mask=here)
    tl.store(out + 4, 1.0925484305920792 * x * y, mask=here)
    tl.store(out + 5, -1.0925484305920792 * y * z, mask=here)
    tl.store(out + 6, 0.94617469575756 * zz - 0.31539156525252, mask=here)
    tl.store(out + 7, -1.0925484305920792 * x * z, mask=here)
    tl.store(out + 8, 0.5462742152960396 * (xx - yy), mask=here)
    tl.store(out + 9, 0.5900435899266435 * y * (yy - 3.0 * xx), mask=here)
    tl.store(out + 10, 2.890611442640554 * x * y * z, mask=here)
    tl.store(out + 11, 0.4570457994644658 * y * (1.0 - 5.0 * zz), mask=here)
    tl.store(out + 12, 0.3731763325901154 * z * (5.0 * zz - 3.0), mask=here)
    tl.store(out + 13, 0.4570457994644658 * x * (1.0 - 5.0 * zz), mask=here)
    tl.store(out + 14, 1.445305721320277 * z * (xx - yy), mask=here)
    tl.store(out + 15, 0.5900435899266435 * x * (3.0 * yy - xx), mask=here)


@triton.jit
def harmonics_gradient(direction, ray_count, g_harmonics, g_direction, BLOCK: tl.constexpr):
    """Add the harmonics' Jacobian, transposed, times g_harmonics [rays, 16] to g_direction [rays, 3]."""
    r, here, x, y, z = _directions(direction, ray_count, BLOCK)
    xx, yy, zz = x * x, y * y, z * z
    g = g_harmonics + 16 * r
    gx, gy, gz = load_vector(g_direction + 3 * r, 1, here)
    gy -= 0.48860251190291987 * tl.load(g + 1, mask=here, other=0.0)
    gz += 0.48860251190291987 * tl.load(g + 2, mask=here, other=0.0)
    gx -= 0.48860251190291987 * tl.load(g + 3, mask=here, other=0.0)
    a = 1.0925484305920792 * tl.load(g + 4, mask=here, other=0.0)
    gx, gy = gx + a * y, gy + a * x
    a = -1.0925484305920792 * tl.load(g + 5, mask=here, other=0.0)
    gy, gz = gy + a * z, gz + a * y
    gz += 2.0 * 0.94617469575756 * z * tl.load(g + 6, mask=here, other=0.0)
    a = -1.0925484305920792 * tl.load(g + 7, mask=here, other=0.0)
    gx, gz = gx + a * z, gz + a * x
    a = 2.0 * 0.5462742152960396 * tl.load(g + 8, mask=here, other=0.0)
    gx, gy = gx + a * x, gy - a * y
    a = 0.5900435899266435 * tl.load(g + 9, mask=here, other=0.0)
    gx, gy = gx - 6.0 * a * x * y, gy + 3.0 * a * (yy - xx)
    a = 2.890611442640554 * tl.load(g + 10, mask=here, other=0.0)
    gx, gy, gz = gx + a * y * z, gy + a * x * z, gz + a * x * y
    a = 0.4570457994644658 * tl.load(g + 11, mask=here, other=0.0)
    gy, gz = gy + a * (1.0 - 5.0 * zz), gz - 10.0 * a * y * z
    gz += 0.3731763325901154 * (15.0 * zz - 3.0) * tl.load(g + 12, mask=here, other=0.0)
    a = 0.4570457994644658 * tl.load(g + 13, mask=here, other=0.0)
    gx, gz = gx + a * (1.0 - 5.0 * zz), gz - 10.0 * a * x * z
    a = 1.445305721320277 * tl.load(g + 14, mask=here, other=0.0)
    gx, gy, gz = gx + 2.0 * a * x * z, gy - 2.0 * a * y * z, gz + a * (xx - yy)
    a = 0.5900435899266435 * tl.load(g + 15, mask=here, other=0.0)
    gx, gy = gx + 3.0 * a * (yy - xx), gy + 6.0 * a * x * y
    store_vector(g_direction + 3 * r, 1, gx, gy, gz, here)
