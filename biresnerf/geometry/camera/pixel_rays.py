"""Pixels to viewing directions and back, in NumPy: the lenses of `biresnerf.geometry.camera.camera` without torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.camera.camera_models import FullParameters
from biresnerf.geometry.camera.distortion import coefficients_of, distort, undistort

_NEAR_AXIS = 1e-8  # radians; closer to it an angle equals its sine


def rays_of_pixels(lens: FullParameters, pixel_xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit viewing directions [m, 3] in cam of pixel positions [m, 2]; distortion is undone to rounding."""
    x, y = (pixel_xy[:, 0] - lens.cx) / lens.fx, (pixel_xy[:, 1] - lens.cy) / lens.fy
    if lens.distorted:
        x, y = undistort(x, y, coefficients_of(lens))
    if lens.fisheye:
        angle = np.hypot(x, y)
        across = np.where(angle > _NEAR_AXIS, np.sin(angle) / np.maximum(angle, _NEAR_AXIS), 1.0)
        return np.stack([x * across, y * across, np.cos(angle)], axis=1)
    directions = np.stack([x, y, np.ones_like(x)], axis=1)
    units: NDArray[np.float64] = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return units


def pixels_of_points(lens: FullParameters, points_in_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixel positions [m, 2] of points [m, 3] in cam; NaN behind a perspective camera."""
    x, y, z = points_in_cam.T
    if lens.fisheye:
        r = np.hypot(x, y)
        off_axis = r > _NEAR_AXIS * np.abs(z)
        scale = np.where(
            off_axis, np.arctan2(r, z) / np.where(off_axis, r, 1.0), 1.0 / np.where(z > 0, z, np.nan)
        )
    else:
        scale = 1.0 / np.where(z > 0, z, np.nan)
    u, v = x * scale, y * scale
    if lens.distorted:
        u, v = distort(u, v, coefficients_of(lens))
    return np.stack([lens.fx * u + lens.cx, lens.fy * v + lens.cy], axis=1)
