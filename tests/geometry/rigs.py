"""Camera rigs for the tests of geometry, written out by hand with scipy's rotations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def look_at(centre: np.ndarray, target: np.ndarray) -> np.ndarray:
    """world_from_cam [4, 4] at `centre` with z towards `target` and y downwards, against world z."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    up = np.array([0.0, 0.0, 1.0])
    if abs(forward @ up) > 0.999:
        up = np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = centre
    return pose


def dome(cameras: int, rng: np.random.Generator, radius: float = 4.0) -> np.ndarray:
    """Cameras [n, 4, 4] on the upper half of a sphere about the origin, all looking there."""
    directions = rng.normal(size=(cameras, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.stack([look_at(radius * direction, np.zeros(3)) for direction in directions])


def jitter(poses: np.ndarray, rng: np.random.Generator, angle_rad: float, distance: float) -> np.ndarray:
    """Every camera turned about itself and shifted by normal noise of the given size per axis."""
    out = poses.copy()
    out[:, :3, :3] = (
        Rotation.from_rotvec(rng.normal(0, angle_rad, (len(poses), 3))).as_matrix() @ poses[:, :3, :3]
    )
    out[:, :3, 3] += rng.normal(0, distance, (len(poses), 3))
    return out


def similar(poses: np.ndarray, scale: float, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """The rig seen from a frame in which x' = scale * rotation @ x + translation, one camera at a time."""
    out = poses.copy()
    for i, pose in enumerate(poses):
        out[i, :3, :3] = rotation @ pose[:3, :3]
        out[i, :3, 3] = scale * (rotation @ pose[:3, 3]) + translation
    return out
