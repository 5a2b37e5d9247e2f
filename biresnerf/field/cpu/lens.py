"""Viewing directions of pixels in one Numba kernel: `biresnerf.geometry.camera.camera.directions_in_cam`."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from biresnerf.field.numba_kernels import njit
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.distortion import NEWTON_DONE, NEWTON_STEPS

NEAR_AXIS = 1e-16  # squared radians, as in the geometry


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _undistorted(x0, y0, c):
    """The position that a lens with coefficients c [11] distorts to (x0, y0), by Newton's method."""
    x, y = x0, y0
    for _ in range(NEWTON_STEPS):
        s = x * x + y * y
        below = ((c[6] * s + c[5]) * s + c[4]) * s + 1.0
        radial = ((((c[3] * s + c[2]) * s + c[1]) * s + c[0]) * s + 1.0) / below
        slope = ((4.0 * c[3] * s + 3.0 * c[2]) * s + 2.0 * c[1]) * s + c[0]
        slope = 2.0 * (slope - radial * ((3.0 * c[6] * s + 2.0 * c[5]) * s + c[4])) / below
        error_x = x * radial + 2.0 * c[7] * x * y + c[8] * (s + 2.0 * x * x) + c[9] * s - x0
        error_y = y * radial + 2.0 * c[8] * x * y + c[7] * (s + 2.0 * y * y) + c[10] * s - y0
        xx = radial + slope * x * x + 2.0 * c[7] * y + (6.0 * c[8] + 2.0 * c[9]) * x
        yy = radial + slope * y * y + 2.0 * c[8] * x + (6.0 * c[7] + 2.0 * c[10]) * y
        xy = slope * x * y + 2.0 * c[7] * x + 2.0 * c[8] * y
        yx = xy + 2.0 * c[10] * x
        xy += 2.0 * c[9] * y
        determinant = xx * yy - xy * yx
        step_x = (yy * error_x - xy * error_y) / determinant
        step_y = (xx * error_y - yx * error_x) / determinant
        x, y = x - step_x, y - step_y
        if abs(step_x) + abs(step_y) < NEWTON_DONE:
            break
    return x, y


@njit(nogil=True, cache=True, error_model="numpy")
def directions(fx, fy, cx, cy, distortion, distorted, fisheye, image, xy, out):
    """Unit directions out [n, 3] of pixels xy [n, 2] of images [n]; float64 inside."""
    for r in range(len(image)):
        i = image[r]
        x, y = (xy[r, 0] - cx[i]) / fx[i], (xy[r, 1] - cy[i]) / fy[i]
        if distorted:
            x, y = _undistorted(x, y, distortion[i])
        s = x * x + y * y
        if not fisheye[i]:
            z = across = 1.0 / np.sqrt(s + 1.0)
        elif s > NEAR_AXIS:
            angle = np.sqrt(s)
            z, across = np.cos(angle), np.sin(angle) / angle
        else:
            z, across = 1.0 - s / 2.0, 1.0 - s / 6.0
        out[r, 0], out[r, 1], out[r, 2] = x * across, y * across, z


def directions_in_cam(intrinsics: Intrinsics, image_index: Tensor, pixel_xy: Tensor) -> Tensor:
    """Unit viewing directions float32 [rays, 3] of pixels [rays, 2] (px) of images int64 [rays]."""
    i, out = intrinsics, np.empty((len(pixel_xy), 3), np.float32)
    fx, fy, cx, cy, distortion = (each.detach().numpy() for each in (i.fx, i.fy, i.cx, i.cy, i.distortion))
    xy = pixel_xy.detach().to(torch.float64).numpy()
    directions(fx, fy, cx, cy, distortion, i.distorted, i.fisheye.numpy(), image_index.numpy(), xy, out)
    return torch.from_numpy(out)
