"""Viewing directions of pixels in one Triton kernel: `biresnerf.geometry.camera.directions_in_cam`.

There, Newton's method asks after every step whether it is done, and the host would wait for the answer. Here all its
steps are taken.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from biresnerf.geometry.camera import NEWTON_STEPS, Intrinsics

BLOCK = 128


@triton.jit
def directions(
    fx, fy, cx, cy, distortion, image, xy, out, n, STEPS: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """Unit directions out [n, 3] of pixels xy [n, 2] of images [n]; all float64 inside. STEPS = 0: no distortion."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = i < n
    m = tl.load(image + i, mask=here, other=0)
    x0 = tl.load(xy + 2 * i, mask=here, other=0.0).to(tl.float64) - tl.load(cx + m, mask=here, other=0.0)
    y0 = tl.load(xy + 2 * i + 1, mask=here, other=0.0).to(tl.float64) - tl.load(cy + m, mask=here, other=0.0)
    x0 = x0 / tl.load(fx + m, mask=here, other=1.0)
    y0 = y0 / tl.load(fy + m, mask=here, other=1.0)
    x, y = x0, y0
    if STEPS > 0:
        k1 = tl.load(distortion + 4 * m, mask=here, other=0.0)
        k2 = tl.load(distortion + 4 * m + 1, mask=here, other=0.0)
        p1 = tl.load(distortion + 4 * m + 2, mask=here, other=0.0)
        p2 = tl.load(distortion + 4 * m + 3, mask=here, other=0.0)
        for _ in range(STEPS):
            r2 = x * x + y * y
            radial = r2 * (k2 * r2 + k1) + 1.0
            slope = k2 * r2 * 4.0 + k1 * 2.0
            error_x = x * radial + p1 * x * y * 2.0 + p2 * (r2 + x * x * 2.0) - x0
            error_y = y * radial + p2 * x * y * 2.0 + p1 * (r2 + y * y * 2.0) - y0
            xx = radial + slope * x * x + p1 * y * 2.0 + p2 * x * 6.0
            yy = radial + slope * y * y + p2 * x * 2.0 + p1 * y * 6.0
            across = slope * x * y + p1 * x * 2.0 + p2 * y * 2.0
            determinant = xx * yy - across * across
            x -= (yy * error_x - across * error_y) / determinant
            y -= (xx * error_y - across * error_x) / determinant
    norm = tl.sqrt(x * x + y * y + 1.0)
    tl.store(out + 3 * i, (x / norm).to(tl.float32), mask=here)
    tl.store(out + 3 * i + 1, (y / norm).to(tl.float32), mask=here)
    tl.store(out + 3 * i + 2, (1.0 / norm).to(tl.float32), mask=here)


def directions_in_cam(intrinsics: Intrinsics, image_index: Tensor, pixel_xy: Tensor) -> Tensor:
    """Unit viewing directions float32 [rays, 3] of pixels [rays, 2] (px) of images int64 [rays]."""
    n = len(pixel_xy)
    out = torch.empty(n, 3, device=pixel_xy.device)
    i = intrinsics
    if n:
        directions[(triton.cdiv(n, BLOCK),)](
            i.fx, i.fy, i.cx, i.cy, i.distortion, image_index.contiguous(), pixel_xy.float().contiguous(), out, n,
            STEPS=NEWTON_STEPS if i.distorted else 0, BLOCK=BLOCK,
        )  # fmt: skip
    return out
