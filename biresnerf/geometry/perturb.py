"""Known noise on known poses, for tests and demonstrations."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.lie import se3_exp
from biresnerf.geometry.rigid import rotation_of

RIG_DISTANCE = 4.0  # of the cameras from the scene in the Blender sets that BARF's noise levels were made for
LOST_DEG = (45.0, 180.0)
# Drift of visual-inertial tracking over a minute's walk around a table: about two degrees of heading and a few percent
# of the distance.
HEADING_STEP_DEG, HEADING_KEPT = 0.12, 0.8  # a photo's change of heading rate, and how much of the rate stays
SCALE_ERROR, STEP_LOST = 0.01, 0.03
JITTER_DEG, JITTER_OF_DISTANCE = 0.25, 0.004


def perturb_poses(world_from_cam: NDArray[np.float64], noise: float, seed: int) -> NDArray[np.float64]:
    """BARF's pose noise: camera-from-world times exp(xi), xi ~ N(0, noise^2 I6), rotation first.

    The rig is first centred on the point it looks at and scaled to a mean distance of 4, so that one noise
    level means the same for every scene; 0.15 turns cameras about the scene by 14 degrees on average.

    Args:
        world_from_cam: float64 [n, 4, 4], OpenCV axes.
        noise: standard deviation (rad, and units of the scaled rig).
        seed: the same seed gives the same noise.

    Returns:
        float64 [n, 4, 4] in the frame and scale of the input.
    """
    poses = np.asarray(world_from_cam, dtype=np.float64)
    focus = focus_point(poses)
    scale = RIG_DISTANCE / focus.mean_distance if focus.mean_distance > 0.0 else 1.0
    xi = torch.from_numpy(np.random.default_rng(seed).normal(0.0, noise, (len(poses), 6)))
    rotation, translation = (part.numpy() for part in se3_exp(xi[:, :3], xi[:, 3:]))
    # (W exp(xi))^-1 = exp(xi)^-1 W^-1: a motion of the world about the focus, different for each camera.
    back = np.swapaxes(rotation, 1, 2)
    centres = (poses[:, :3, 3] - focus.point) * scale
    moved = poses.copy()
    moved[:, :3, :3] = back @ poses[:, :3, :3]
    moved[:, :3, 3] = np.einsum("nij,nj->ni", back, centres - translation) / scale + focus.point
    return moved


def turn_in_place(world_from_cam: NDArray[np.float64], index: int, angle_deg: float) -> NDArray[np.float64]:
    """Poses [n, 4, 4] with camera `index` turned about its own vertical axis; 180 turns it to face backwards."""
    turn = rotation_of(np.array([0.0, np.radians(angle_deg), 0.0]))
    moved = np.array(world_from_cam, dtype=np.float64)
    moved[index, :3, :3] = moved[index, :3, :3] @ turn
    return moved


def orbit_away(world_from_cam: NDArray[np.float64], indices: list[int], seed: int) -> NDArray[np.float64]:
    """Poses [n, 4, 4] with some cameras turned about the rig's focus by 45 to 180 degrees, about random axes.

    They still look at the scene, but from a wrong side: the errors from which a camera does not recover by itself.
    """
    poses = np.array(world_from_cam, dtype=np.float64)
    focus = focus_point(poses).point
    random = np.random.default_rng([seed, 3])
    for index in indices:
        axis = random.normal(size=3)
        angle = np.radians(random.uniform(*LOST_DEG))
        turn = rotation_of(axis / np.linalg.norm(axis) * angle)
        poses[index, :3, :3] = turn @ poses[index, :3, :3]
        poses[index, :3, 3] = turn @ (poses[index, :3, 3] - focus) + focus
    return poses


def drift_like_a_phone(world_from_cam: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Poses [n, 4, 4], in the order they were taken, as a phone's tracking gives them: drift, jitter, level.

    Each motion between successive photos is rotated by a smoothly drifting heading, scaled by one wrong factor, and
    slightly shortened. Gravity fixes roll and pitch, so cameras drift only about the rig's up axis. Each pose also
    jitters. Apart from that the first pose stays.
    """
    poses = np.asarray(world_from_cam, dtype=np.float64)
    random = np.random.default_rng([seed, 6])
    count, distance = len(poses), focus_point(poses).mean_distance
    up = -poses[:, :3, 1].mean(axis=0)
    rate = np.zeros(count)
    for k in range(1, count):
        rate[k] = HEADING_KEPT * rate[k - 1] + random.normal(0.0, np.radians(HEADING_STEP_DEG))
    heading = rotation_of(up / np.linalg.norm(up) * np.cumsum(rate)[:, None])
    steps = np.diff(poses[:, :3, 3], axis=0)
    lost = random.normal(0.0, STEP_LOST, steps.shape) * np.linalg.norm(steps, axis=1, keepdims=True)
    scale = 1.0 + random.normal(0.0, SCALE_ERROR)
    walked = np.einsum("nij,nj->ni", heading[:-1], scale * steps + lost)
    moved = poses.copy()
    moved[1:, :3, 3] = poses[0, :3, 3] + np.cumsum(walked, axis=0)
    moved[:, :3, 3] += random.normal(0.0, JITTER_OF_DISTANCE * distance, (count, 3))
    jitter = rotation_of(random.normal(0.0, np.radians(JITTER_DEG), (count, 3)))
    moved[:, :3, :3] = jitter @ heading @ poses[:, :3, :3]
    return moved
