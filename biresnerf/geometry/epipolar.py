"""How far matched viewing rays of two cameras are from meeting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array

# Sines: with a baseline or ray component this short, the epipolar plane is determined by rounding errors.
_DEGENERATE = 1e-9


def epipolar_angles(
    world_from_cam: Array, a: NDArray[np.int64], b: NDArray[np.int64], ray_a: Array, ray_b: Array
) -> Array:
    """Symmetric epipolar error [m] of matches, radians: 0 where both rays and the baseline lie in one plane.

    It is the mean of two angles: from the ray of b to the plane that the baseline spans with the ray of a, and the
    other way round. For a pinhole near its axis that is the distance to the epipolar line in focal lengths; unlike
    that, it holds for any lens. Moving, turning or scaling the whole rig changes nothing. NaN where two cameras stand
    at one point, or a ray runs along the baseline.

    Args:
        world_from_cam: poses [n, 4, 4].
        a, b: indices [m] of the two cameras of each match.
        ray_a, ray_b: unit viewing directions [m, 3], each in the axes of its camera.
    """
    direction_a = np.einsum("mij,mj->mi", world_from_cam[a, :3, :3], ray_a)
    direction_b = np.einsum("mij,mj->mi", world_from_cam[b, :3, :3], ray_b)
    baseline = world_from_cam[b, :3, 3] - world_from_cam[a, :3, 3]
    reach = np.linalg.norm(world_from_cam[:, :3, 3] - world_from_cam[:, :3, 3].mean(0), axis=1).max()
    baseline = _unit(baseline, _DEGENERATE * max(float(reach), 1e-300))
    sine_b = np.abs((_unit(np.cross(baseline, direction_a), _DEGENERATE) * direction_b).sum(1))
    sine_a = np.abs((_unit(np.cross(baseline, direction_b), _DEGENERATE) * direction_a).sum(1))
    mean_angle: Array = (np.arcsin(np.minimum(sine_a, 1.0)) + np.arcsin(np.minimum(sine_b, 1.0))) / 2
    return mean_angle


def match_depths(
    world_from_cam: Array, a: NDArray[np.int64], b: NDArray[np.int64], ray_a: Array, ray_b: Array
) -> Array:
    """How far in front of the two cameras of a match its point lies [m, 2]: along z, in the poses' unit.

    The point is the middle of the shortest line between the rays. NaN where they are parallel. Arguments as for
    `epipolar_angles`.
    """
    towards = [np.einsum("mij,mj->mi", world_from_cam[i, :3, :3], ray) for i, ray in ((a, ray_a), (b, ray_b))]
    apart = world_from_cam[b, :3, 3] - world_from_cam[a, :3, 3]
    cosine = (towards[0] * towards[1]).sum(1)
    sine_squared = 1 - cosine**2
    along = [(apart * ray).sum(1) for ray in towards]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (along[0] - cosine * along[1]) / np.where(sine_squared > 1e-12, sine_squared, np.nan)
    t = cosine * s - along[1]
    middle = (s[:, None] * towards[0] + apart + t[:, None] * towards[1]) / 2  # seen from a
    axis_a, axis_b = world_from_cam[a, :3, 2], world_from_cam[b, :3, 2]
    return np.stack([(middle * axis_a).sum(1), ((middle - apart) * axis_b).sum(1)], axis=1)


def _unit(vectors: Array, shortest: float) -> Array:
    """Vectors [m, 3] at length 1, NaN where they are no longer than `shortest`."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > shortest, length, np.nan)
