"""Whether a camera's parameters describe a lens that gives every pixel of the image a viewing ray."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from biresnerf.geometry.camera.camera_models import FullParameters
from biresnerf.geometry.camera.distortion import (
    coefficients_of,
    distort,
    distort_jacobian,
    newton_step,
    undistort,
)

# How much nearer to the centre, or farther from it, distortion may put a corner, as a share of the shorter of its two
# distances; wide lenses stay below a half.
MAX_DISTORTION = 1.5
# Least area (relative to the centre's) that a patch of the view may shrink to. Where it comes near zero the image
# folds over itself and pixels beyond have no viewing ray.
MIN_MAGNIFICATION = 0.1
_BORDER_POINTS_PER_EDGE = 8
_STEPS_OUTWARD = 24
_NEWTON_STEPS = 8  # near a fold they converge slowly
# In focal lengths: two ways to one position, and a pixel and what its direction is projected to.
_SAME, _EXACT = 1e-5, 1e-11


class _Border(NamedTuple):
    """Why the border has no viewing rays, or how far from the axis it lies on the plane of directions."""

    problem: str | None
    reach: float


def lens_problem(full: FullParameters, width: int, height: int) -> str | None:
    """A sentence on why no real lens has this distortion over this image, or None where one may.

    The undistorted positions of border pixels are followed outward from the principal point, where distortion
    vanishes. They must stay within reach, the image must not fold on the way, and the direct solution that is used for
    rays later must find the same positions.
    """
    return _border_seen(full, width, height).problem


def lens_reach(full: FullParameters, width: int, height: int) -> float:
    """Radius on the plane of `distortion` about all that the image shows; inf for a pinhole."""
    if not full.distorted and not full.fisheye:
        return float("inf")
    return _border_seen(full, width, height).reach


@lru_cache(maxsize=256)
def _border_seen(full: FullParameters, width: int, height: int) -> _Border:
    target = (_border(width, height) - [full.cx, full.cy]) / [full.fx, full.fy]
    if not full.distorted:
        return _within_reach(full, target, target)
    c = coefficients_of(full)
    to_x, to_y = target.T
    x, y = np.zeros_like(to_x), np.zeros_like(to_y)
    shares = np.arange(1, _STEPS_OUTWARD + 1) / _STEPS_OUTWARD
    path = []
    for share in shares:
        for _ in range(_NEWTON_STEPS):
            xx, xy, yx, yy = distort_jacobian(x, y, c)
            if (xx * yy - xy * yx).min() < MIN_MAGNIFICATION:
                problem = (
                    "the distortion folds back inside the image, so its outer pixels have no viewing ray."
                )
                return _Border(problem, float(np.hypot(x, y).max()))
            step_x, step_y = newton_step(x, y, share * to_x, share * to_y, c)
            x, y = x - step_x, y - step_y
        path.append(np.stack([x, y]))
    step_x, step_y = newton_step(x, y, to_x, to_y, c)
    seen = _within_reach(full, target, np.stack([x - step_x, y - step_y], axis=1))
    if seen.problem is not None:
        return seen
    pixels = np.concatenate([share * target.T for share in shares], axis=1)
    # Far from every root Newton's method may diverge to infinity, which also answers the question.
    with np.errstate(all="ignore"):
        direct = np.stack(undistort(pixels[0], pixels[1], c))
        there = np.abs(np.stack(distort(direct[0], direct[1], c)) - pixels).max() < _EXACT
    if not there or not np.allclose(direct, np.concatenate(path, axis=1), rtol=0, atol=_SAME):
        return _Border("the distortion cannot be undone from within the image.", seen.reach)
    return seen


def _within_reach(full: FullParameters, target: NDArray[np.float64], xy: NDArray[np.float64]) -> _Border:
    """Check border points that distortion moves from `xy` to `target` [n, 2]."""
    far, seen = np.linalg.norm(target, axis=1), np.linalg.norm(xy, axis=1)
    reach = float(seen.max())
    if full.fisheye and reach >= np.pi:
        return _Border("the image's corner lies more than 180 degrees from the lens's axis.", reach)
    moved = float((np.maximum(far, seen) / np.minimum(far, seen).clip(min=1e-12)).max()) - 1.0
    if moved > MAX_DISTORTION:
        text = f"the distortion moves the image's border by {moved:.3g} times its distance from the centre."
        return _Border(text, reach)
    return _Border(None, reach)


def _border(width: int, height: int) -> NDArray[np.float64]:
    """Points [n, 2] (px) along the image's border, corners among them."""
    along = np.linspace(0.0, 1.0, _BORDER_POINTS_PER_EDGE, endpoint=False)
    edges = [(along, 0 * along), (1 + 0 * along, along), (1 - along, 1 + 0 * along), (0 * along, 1 - along)]
    return np.concatenate([np.stack(edge, axis=1) for edge in edges]) * [width, height]
