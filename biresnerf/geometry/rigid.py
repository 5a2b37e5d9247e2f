"""Rigid motions as float64 matrices [..., 4, 4]."""

from __future__ import annotations

import numpy as np

from biresnerf.arrays import Array


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
    turn = rotation_vectors((first[:3, :3].T @ second[:3, :3])[None])[0]
    pose[:3, :3] = first[:3, :3] @ rotation_of(share * turn)
    return pose


def rotation_vectors(rotation: Array) -> Array:
    """Rotation vectors [n, 3] of angle at most pi, of rotations [n, 3, 3].

    From the unit quaternion, the first eigenvector of a matrix that is linear in the rotation (Bar-Itzhack 2000): exact
    near pi as well as near zero.
    """
    r = np.asarray(rotation, np.float64)
    outer = np.empty((len(r), 4, 4))
    outer[:, 1:, 1:] = r + r.transpose(0, 2, 1)
    trace = np.trace(r, axis1=1, axis2=2)
    outer[:, [1, 2, 3], [1, 2, 3]] -= trace[:, None]
    outer[:, 0, 0] = trace
    outer[:, 0, 1:] = outer[:, 1:, 0] = np.stack(
        [r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], 1
    )
    quat_wxyz = np.linalg.eigh(outer)[1][:, :, -1]
    quat_wxyz *= np.where(quat_wxyz[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(quat_wxyz[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, quat_wxyz[:, :1])
    return np.asarray(np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0) * quat_wxyz[:, 1:])


def rotation_of(vector: Array) -> Array:
    """The rotation [3, 3] of a rotation vector [3], by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle > 0 else np.zeros(3)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned
