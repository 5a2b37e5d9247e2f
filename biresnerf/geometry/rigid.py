"""Rigid motions as float64 matrices [..., 4, 4]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rigid_inverse(b_from_a: Array) -> Array:
    """The ``a_from_b`` [..., 4, 4] of rigid motions: the transposed rotation, no elimination."""
    given = np.asarray(b_from_a, dtype=np.float64)
    inverse = np.zeros_like(given)
    inverse[..., :3, :3] = np.swapaxes(given[..., :3, :3], -1, -2)
    inverse[..., :3, 3] = -(inverse[..., :3, :3] @ given[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def interpolate_pose(first: Array, second: Array, share: float) -> Array:
    """The pose [4, 4] at ``share`` of the way from ``first`` to ``second``.

    Its centre is on the line between theirs, its rotation on the shortest path (for opposite rotations, one of them).

    Args:
        first, second: world_from_cam [4, 4].
        share: 0 gives ``first``, 1 gives ``second``.
    """
    pose = np.eye(4)
    pose[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
    axis, angle = _axis_angle(first[:3, :3].T @ second[:3, :3])
    pose[:3, :3] = first[:3, :3] @ _rotation(axis, share * angle)
    return pose


def _axis_angle(rotation: Array) -> tuple[Array, float]:
    """Unit axis [3] and angle in [0, pi]."""
    twice_sine = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    length = float(np.linalg.norm(twice_sine))
    angle = float(np.arctan2(length, np.trace(rotation) - 1))
    if angle > 3.0:  # the sine vanishes near pi, the symmetric part does not
        symmetric = (rotation + rotation.T) / 2 - np.cos(angle) * np.eye(3)
        column = symmetric[:, int(np.argmax(np.diag(symmetric)))]
        axis = column / np.linalg.norm(column)
        return (axis if axis @ twice_sine >= 0 else -axis), angle
    return (twice_sine / length, angle) if length > 0 else (np.array([1.0, 0.0, 0.0]), 0.0)


def _rotation(axis: Array, angle: float) -> Array:
    """Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned
