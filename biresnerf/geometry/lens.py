"""Whether distortion coefficients describe a lens that every pixel of the image can be seen through."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.camera_models import OpenCVParameters

# Share of the radius that distortion may move a corner by; wide lenses that this model suits stay below a half.
MAX_DISTORTION = 1.5
# Least area (relative to the centre's) that a patch of the view may shrink to. Where it comes near zero the image
# folds over itself and pixels beyond have no viewing ray.
MIN_MAGNIFICATION = 0.1
_BORDER_POINTS_PER_EDGE = 8
_STEPS_OUTWARD = 24
_NEWTON_STEPS = 6


def lens_problem(full: OpenCVParameters, width: int, height: int) -> str | None:
    """A sentence on why no real lens has this distortion over this image, or None where one may.

    The undistorted positions of border pixels are followed outward from the principal point, where distortion
    vanishes; they must stay within reach, and the picture must not fold on the way.
    """
    if full.k1 == full.k2 == full.p1 == full.p2 == 0.0:
        return None
    target = _border(width, height)
    target = (target - [full.cx, full.cy]) / [full.fx, full.fy]
    r = float(np.linalg.norm(target, axis=1).max())
    moved = abs(full.k1) * r**2 + abs(full.k2) * r**4 + 3.0 * (abs(full.p1) + abs(full.p2)) * r
    if moved > MAX_DISTORTION:
        return f"the distortion moves the image's corner by {moved:.3g} times its distance from the centre."
    xy = np.zeros_like(target)
    for share in np.arange(1, _STEPS_OUTWARD + 1) / _STEPS_OUTWARD:
        for _ in range(_NEWTON_STEPS):
            distorted, jacobian = _distort(full, xy)
            magnification = np.linalg.det(jacobian)
            if magnification.min() < MIN_MAGNIFICATION:
                return "the distortion folds back inside the image, so its outer pixels have no viewing ray."
            xy = xy - np.linalg.solve(jacobian, (distorted - share * target)[..., None])[..., 0]
    return None


def _border(width: int, height: int) -> NDArray[np.float64]:
    """Points [n, 2] (px) along the image's border, corners among them."""
    along = np.linspace(0.0, 1.0, _BORDER_POINTS_PER_EDGE, endpoint=False)
    edges = [(along, 0 * along), (1 + 0 * along, along), (1 - along, 1 + 0 * along), (0 * along, 1 - along)]
    return np.concatenate([np.stack(edge, axis=1) for edge in edges]) * [width, height]


def _distort(
    full: OpenCVParameters, xy: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distorted positions [n, 2], in focal lengths, and the derivatives [n, 2, 2]."""
    x, y = xy.T
    r2 = x * x + y * y
    radial, slope = 1 + r2 * (full.k1 + r2 * full.k2), 2 * full.k1 + 4 * full.k2 * r2
    u = x * radial + 2 * full.p1 * x * y + full.p2 * (r2 + 2 * x * x)
    v = y * radial + 2 * full.p2 * x * y + full.p1 * (r2 + 2 * y * y)
    across = slope * x * y + 2 * full.p1 * x + 2 * full.p2 * y
    u_by_x = radial + slope * x * x + 2 * full.p1 * y + 6 * full.p2 * x
    v_by_y = radial + slope * y * y + 2 * full.p2 * x + 6 * full.p1 * y
    rows = [np.stack([u_by_x, across], axis=-1), np.stack([across, v_by_y], axis=-1)]
    return np.stack([u, v], axis=1), np.stack(rows, axis=1)
