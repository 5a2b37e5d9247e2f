"""The point a camera rig looks at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Below this mean squared sine (axes within about 0.06 deg of one direction) the depth of the point is noise.
PARALLEL_BELOW = 1e-6


def rms_spread(centres: NDArray[np.float64]) -> float:
    """Root mean square distance of camera centres [n, 3] from their mean."""
    return float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))


@dataclass(frozen=True, eq=False)
class Focus:
    """The point nearest to all optical axes, and how well it is determined.

    Attributes:
        point: [3], in the frame of the poses.
        conditioning: smallest eigenvalue of the mean of ``I - d d^T``, from 0 (all axes parallel) to 2/3
            (axes from all around): the mean squared sine of the angle between the axes and the direction they
            determine least.
        well_posed: whether the axes determine the point; if not, ``point`` is the one nearest to the mean camera
            centre.
        mean_distance: mean distance of the camera centres from ``point``.
        in_front: share of cameras that have ``point`` in front of them.
    """

    point: NDArray[np.float64]
    conditioning: float
    well_posed: bool
    mean_distance: float
    in_front: float


def focus_point(world_from_cam: NDArray[np.float64]) -> Focus:
    """Least-squares point nearest to the optical axes (z forward) of poses [n, 4, 4], in their frame.

    Raises:
        ValueError: if the poses are not [n, 4, 4] with n at least 1.
    """
    poses = np.asarray(world_from_cam, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
        raise ValueError(f"poses must have shape [n, 4, 4] with n >= 1, got {poses.shape}")
    centres = poses[:, :3, 3]
    axes = poses[:, :3, 2] / np.linalg.norm(poses[:, :3, 2], axis=1, keepdims=True)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # Relative to the mean centre, so that an undetermined direction keeps the point there and large coordinates
    # keep their precision.
    middle = centres.mean(axis=0)
    offset = np.einsum("nij,nj->i", across, centres - middle) / len(poses)
    values, vectors = np.linalg.eigh(across.mean(axis=0))
    conditioning = float(max(values[0], 0.0))
    fixed = values > PARALLEL_BELOW
    step = vectors[:, fixed] @ ((vectors[:, fixed].T @ offset) / values[fixed])
    point = middle + step
    to_point = point - centres
    return Focus(
        point=point,
        conditioning=conditioning,
        well_posed=bool(fixed.all()),
        mean_distance=float(np.linalg.norm(to_point, axis=1).mean()),
        in_front=float(((to_point * axes).sum(axis=1) > 0).mean()),
    )
