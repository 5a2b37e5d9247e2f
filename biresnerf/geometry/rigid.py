"""Rigid motions as float64 matrices [..., 4, 4]."""

from __future__ import annotations

import numpy as np

from biresnerf.arrays import Array


def motion_of(rotation: Array, translation: Array | float = 0.0) -> Array:
    """Motions [..., 4, 4] of rotations [..., 3, 3] and translations [..., 3]."""
    motion = np.zeros((*np.shape(rotation)[:-2], 4, 4))
    motion[..., :3, :3], motion[..., :3, 3], motion[..., 3, 3] = rotation, translation, 1.0
    return motion


def rigid_inverse(b_from_a: Array) -> Array:
    """The ``a_from_b`` [..., 4, 4] of rigid motions: the transposed rotation, no elimination."""
    given = np.asarray(b_from_a, dtype=np.float64)
    rotation = np.swapaxes(given[..., :3, :3], -1, -2)
    return motion_of(rotation, -(rotation @ given[..., :3, 3, None])[..., 0])


def interpolate_pose(first: Array, second: Array, share: float) -> Array:
    """The pose [4, 4] at ``share`` of the way from ``first`` to ``second``.

    Its centre is on the line between theirs, its rotation on the shortest path (for opposite rotations, one of them).

    Args:
        first, second: world_from_cam [4, 4].
        share: 0 gives ``first``, 1 gives ``second``.
    """
    turn = rotation_vectors(first[:3, :3].T @ second[:3, :3])
    centre = (1 - share) * first[:3, 3] + share * second[:3, 3]
    return motion_of(first[:3, :3] @ rotation_of(share * turn), centre)


def quat_wxyz_from_rotation(rotation: Array) -> Array:
    """Unit quaternions (w, x, y, z) [..., 4], w >= 0, of rotations [..., 3, 3].

    Each is the first eigenvector of a matrix that is linear in the rotation (Bar-Itzhack 2000): no branch loses digits
    near half turns.
    """
    r = np.asarray(rotation, np.float64)
    trace = np.trace(r, axis1=-2, axis2=-1)[..., None, None]
    outer = np.empty((*r.shape[:-2], 4, 4))
    outer[..., 1:, 1:] = r + np.swapaxes(r, -1, -2) - trace * np.eye(3)
    outer[..., :1, :1] = trace
    for row, (y, z) in enumerate(((2, 1), (0, 2), (1, 0)), start=1):
        outer[..., 0, row] = outer[..., row, 0] = r[..., y, z] - r[..., z, y]
    quat_wxyz = np.linalg.eigh(outer)[1][..., -1]
    return np.asarray(np.where(quat_wxyz[..., :1] < 0, -quat_wxyz, quat_wxyz))


def rotation_from_quat_wxyz(quat_wxyz: Array) -> Array:
    """Rotations [..., 3, 3] of quaternions (w, x, y, z) [..., 4]; their length does not matter."""
    given = np.asarray(quat_wxyz, dtype=np.float64)
    w, x, y, z = np.moveaxis(given / np.linalg.norm(given, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rotation_vectors(rotation: Array) -> Array:
    """Rotation vectors [..., 3] of angle at most pi, of rotations [..., 3, 3]; exact near pi as well as near zero."""
    quat_wxyz = quat_wxyz_from_rotation(rotation)
    sine = np.linalg.norm(quat_wxyz[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quat_wxyz[..., :1])
    return np.asarray(np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0) * quat_wxyz[..., 1:])


def rotation_of(vector: Array) -> Array:
    """The rotations [..., 3, 3] of rotation vectors [..., 3], by way of their quaternions."""
    half = np.asarray(vector, dtype=np.float64) / 2
    angle = np.linalg.norm(half, axis=-1, keepdims=True)
    return rotation_from_quat_wxyz(np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], -1))


def rotation_about(axis: int, angle: Array | float) -> Array:
    """The rotations [..., 3, 3] by angles [...] (rad) about a coordinate axis, counter-clockwise."""
    return rotation_of(np.asarray(angle)[..., None] * np.eye(3)[axis])
