"""Pose noise: BARF's model, checked against scipy's matrix exponential."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.perturb import perturb_poses
from tests.geometry.rigs import dome, similar


def barf_by_matrix_exponential(world_from_cam: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """W' = W exp(xi) camera by camera on 4 x 4 matrices, in the centred and scaled rig."""
    focus = focus_point(world_from_cam)
    xis = np.random.default_rng(seed).normal(0.0, noise, (len(world_from_cam), 6))
    rig_from_world = np.eye(4)
    rig_from_world[:3, 3] = -focus.point
    out = []
    for pose, xi in zip(world_from_cam, xis, strict=True):
        rig_from_cam = rig_from_world @ pose
        rig_from_cam[:3, 3] *= 4.0 / focus.mean_distance
        twist = np.zeros((4, 4))
        twist[:3, :3] = np.cross(np.eye(3), xi[:3])
        twist[:3, 3] = xi[3:]
        noisy = np.linalg.inv(np.linalg.inv(rig_from_cam) @ expm(twist))
        noisy[:3, 3] = noisy[:3, 3] * focus.mean_distance / 4.0 + focus.point
        out.append(noisy)
    return np.stack(out)


@pytest.mark.parametrize("noise", [0.01, 0.15, 0.6])
def test_perturbed_poses_are_barfs(noise):
    poses = similar(dome(20, np.random.default_rng(3)), 2.5, np.eye(3), np.array([10.0, -3.0, 7.0]))
    expected = barf_by_matrix_exponential(poses, noise, seed=5)
    np.testing.assert_allclose(perturb_poses(poses, noise, 5), expected, atol=1e-10)


def test_no_noise_changes_nothing():
    poses = dome(8, np.random.default_rng(0))
    np.testing.assert_allclose(perturb_poses(poses, 0.0, 1), poses, atol=1e-12)


def test_noise_commutes_with_a_change_of_scale_and_origin():
    poses = dome(12, np.random.default_rng(1))
    moved = similar(poses, 50.0, np.eye(3), np.array([100.0, 200.0, -30.0]))
    noisy_then_moved = similar(
        perturb_poses(poses, 0.15, 2), 50.0, np.eye(3), np.array([100.0, 200.0, -30.0])
    )
    np.testing.assert_allclose(perturb_poses(moved, 0.15, 2), noisy_then_moved, atol=1e-9)


def test_same_seed_gives_the_same_noise_and_another_does_not():
    poses = dome(5, np.random.default_rng(1))
    assert np.array_equal(perturb_poses(poses, 0.1, 4), perturb_poses(poses, 0.1, 4))
    assert not np.allclose(perturb_poses(poses, 0.1, 4), perturb_poses(poses, 0.1, 5))
