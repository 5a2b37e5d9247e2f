"""Points from the viewing rays of known cameras, many at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array

ROUNDS = 12  # of reweighting; steps fall below 1e-9 of the depth well before
CAUCHY_PX = 1.0  # residuals beyond this lose weight
# If all rays of a point are parallel to this precision, a little of the identity regularises their system.
_RIDGE = 1e-12


def triangulate(
    origins: Array, directions: Array, focal_px: Array, point: NDArray[np.int64], count: int
) -> Array:
    """Points nearest to their rays: [count, 3].

    Iteratively reweighted least squares of the rays' angles to the point: a ray counts by the inverse square of its
    length, as its pixel's error is an angle, and less where that error is large (Cauchy). Points with rays that do
    not meet are not filtered: the caller must check the residuals.

    Args:
        origins, directions: of each ray, [rays, 3]; directions of unit length.
        focal_px: of each ray's camera, [rays]: turns angles into pixels.
        point: of each ray, int64 [rays]; every point has two rays at least.
        count: of points.
    """
    if count == 0:
        return np.zeros((0, 3))
    middle = origins.mean(axis=0)
    origins = origins - middle  # keeps precision for large coordinates
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weights = np.ones(len(origins))
    xyz: Array = np.zeros((count, 3), dtype=np.float64)
    for _ in range(ROUNDS):
        system, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(system, point, weights[:, None, None] * across)
        np.add.at(right, point, weights[:, None] * (across @ origins[:, :, None])[:, :, 0])
        system += (_RIDGE * np.trace(system, axis1=1, axis2=2) + 1e-300)[:, None, None] * np.eye(3)
        xyz = np.asarray(np.linalg.solve(system, right[:, :, None])[:, :, 0], dtype=np.float64)
        to_point = xyz[point] - origins
        length = np.maximum(np.linalg.norm(to_point, axis=1), 1e-300)
        off_px = focal_px * np.linalg.norm((across @ to_point[:, :, None])[:, :, 0], axis=1) / length
        weights = (length.mean() / length) ** 2 / (1.0 + (off_px / CAUCHY_PX) ** 2)
    points: Array = xyz + middle
    return points


def parallax_deg(origins: Array, xyz: Array, point: NDArray[np.int64]) -> Array:
    """Twice the largest angle between a point's rays and their mean, [points], degrees; 0 where there is no ray.

    For two rays it is the angle between them.
    """
    back = origins - xyz[point]
    back = back / np.maximum(np.linalg.norm(back, axis=1, keepdims=True), 1e-300)
    mean = np.zeros_like(xyz)
    np.add.at(mean, point, back)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    sine = np.linalg.norm(np.cross(back, mean[point]), axis=1)
    widest = np.zeros(len(xyz))
    np.maximum.at(widest, point, np.arctan2(sine, (back * mean[point]).sum(1)))
    return 2.0 * np.degrees(widest)
