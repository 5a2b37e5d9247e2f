"""Known noise on known poses, for tests and demonstrations."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.lie import se3_exp

RIG_DISTANCE = 4.0  # of the cameras from the scene in the Blender sets that BARF's noise levels were made for


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
