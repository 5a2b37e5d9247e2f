"""Viewing directions of pixels in one Triton kernel: `biresnerf.geometry.camera.camera.directions_in_cam`.

There, Newton's method checks after every step whether it has converged, and the host would wait for that. Here it
always takes all its steps.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from biresnerf.field.cuda.access import load_vector, store_vector
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.distortion import NEWTON_STEPS

BLOCK = 128
NEAR_AXIS = tl.constexpr(1e-16)  # squared radians, as in the geometry


@triton.jit
def directions(
    fx, fy, cx, cy, distortion, fisheye, image, xy, out, n, STEPS: tl.constexpr, FISHEYE: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Unit directions out [n, 3] of pixels xy [n, 2] of images [n]; all float64 inside.

    STEPS = 0: no distortion. FISHEYE: some images are a fisheye's.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    m = tl.load(image + i, mask=here, other=0)
    x0 = tl.load(xy + 2 * i, mask=here, other=0.0).to(tl.float64) - tl.load(cx + m, mask=here, other=0.0)
    y0 = tl.load(xy + 2 * i + 1, mask=here, other=0.0).to(tl.float64) - tl.load(cy + m, mask=here, other=0.0)
    x0 = x0 / tl.load(fx + m, mask=here, other=1.0)
    y0 = y0 / tl.load(fy + m, mask=here, other=1.0)
    x, y = x0, y0
    if STEPS > 0:
        a1, a2, a3 = load_vector(distortion + 11 * m, 1, here)
        a4, b1, b2 = load_vector(distortion + 11 * m + 3, 1, here)
        b3, p1, p2 = load_vector(distortion + 11 * m + 6, 1, here)
        sx = tl.load(distortion + 11 * m + 9, mask=here, other=0.0)
        sy = tl.load(distortion + 11 * m + 10, mask=here, other=0.0)
        for _ in range(STEPS):
            s = x * x + y * y
            below = ((b3 * s + b2) * s + b1) * s + 1.0
            radial = ((((a4 * s + a3) * s + a2) * s + a1) * s + 1.0) / below
            slope = ((a4 * s * 4.0 + a3 * 3.0) * s + a2 * 2.0) * s + a1
            slope = (slope - radial * ((b3 * s * 3.0 + b2 * 2.0) * s + b1)) * 2.0 / below
            error_x = x * radial + p1 * x * y * 2.0 + p2 * (s + x * x * 2.0) + sx * s - x0
            error_y = y * radial + p2 * x * y * 2.0 + p1 * (s + y * y * 2.0) + sy * s - y0
            xx = radial + slope * x * x + p1 * y * 2.0 + (p2 * 6.0 + sx * 2.0) * x
            yy = radial + slope * y * y + p2 * x * 2.0 + (p1 * 6.0 + sy * 2.0) * y
            across = slope * x * y + p1 * x * 2.0 + p2 * y * 2.0
            upper, lower = across + sx * y * 2.0, across + sy * x * 2.0
            determinant = xx * yy - upper * lower
            x -= (yy * error_x - upper * error_y) / determinant
            y -= (xx * error_y - lower * error_x) / determinant
    s = x * x + y * y
    z = 1.0 / tl.sqrt(s + 1.0)
    scale = z
    if FISHEYE:
        curved = tl.load(fisheye + m, mask=here, other=0) != 0
        off_axis = s > NEAR_AXIS
        angle = tl.sqrt(tl.where(off_axis, s, 1.0))
        scale = tl.where(curved, tl.where(off_axis, tl.sin(angle) / angle, 1.0 - s / 6.0), scale)
        z = tl.where(curved, tl.where(off_axis, tl.cos(angle), 1.0 - s / 2.0), z)
    store_vector(
        out + 3 * i, 1, (x * scale).to(tl.float32), (y * scale).to(tl.float32), z.to(tl.float32), here
    )


def directions_in_cam(intrinsics: Intrinsics, image_index: Tensor, pixel_xy: Tensor) -> Tensor:
    """Unit viewing directions float32 [rays, 3] of pixels [rays, 2] (px) of images int64 [rays]."""
    n = len(pixel_xy)
    out = torch.empty(n, 3, device=pixel_xy.device)
    i = intrinsics
    if n:
        directions[(triton.cdiv(n, BLOCK),)](
            i.fx, i.fy, i.cx, i.cy, i.distortion, i.fisheye.view(torch.uint8), image_index.contiguous(),
            pixel_xy.float().contiguous(), out, n,
            STEPS=NEWTON_STEPS if i.distorted else 0, FISHEYE=i.some_fisheye, BLOCK=BLOCK,
        )  # fmt: skip
    return out
