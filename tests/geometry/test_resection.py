"""Resection: cameras found from points, against the truth; wrong points, planes and too few of them."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.resection import resect, three_point_poses
from tests.data.formats.random_sets import random_poses

FOCAL = 500.0


def seen(
    rng: np.random.Generator, pose: np.ndarray, count: int, noise_px: float = 0.0, flat: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Points about the origin, and the unit rays in which the camera sees them."""
    points = rng.uniform(-0.8, 0.8, (count, 3))
    if flat:
        points[:, 2] = 0.1 * points[:, 0]
    in_cam = (points - pose[:3, 3]) @ pose[:3, :3]
    rays = in_cam / in_cam[:, 2:]
    rays[:, :2] += rng.normal(0, noise_px / FOCAL, (count, 2))
    return points, rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(8))
def test_one_of_at_most_four_solutions_of_three_points_is_the_camera(seed):
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, 20)
    triples, nearest = [seen(rng, pose, 3) for pose in poses], []
    for pose, (points, rays) in zip(poses, triples, strict=True):
        rotations, centres = three_point_poses(points[None], rays[None])
        assert 1 <= len(centres) <= 4
        off = np.linalg.norm(centres - pose[:3, 3], axis=1) + rotation_between_deg(rotations, pose[:3, :3])
        nearest.append(off.min())
        towards = (
            points[None] - centres[:, None]
        ) @ rotations  # every solution sees the points along the rays
        units = towards / np.linalg.norm(towards, axis=2, keepdims=True)
        np.testing.assert_allclose(units, np.broadcast_to(rays, units.shape), atol=1e-3)
    assert np.median(nearest) < 1e-6
    assert max(nearest) < 0.05  # degrees and lengths: near a double root, digits are lost


def test_solutions_of_three_points_have_them_in_front_also_where_rays_are_wide_apart():
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(100, 3, 3)) * [1, 1, 0.5]
    rays[..., 2] = np.abs(rays[..., 2])
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    for triple in rays:
        points = rng.uniform(1, 4, (3, 1)) * triple
        rotations, centres = three_point_poses(points[None], triple[None])
        assert (((points - centres[:, None]) @ rotations * triple).sum(2) > 0).all()
        assert np.linalg.norm(centres, axis=1).min() < 1e-3  # the camera that saw them


@pytest.mark.parametrize("flat", [False, True])
def test_half_of_the_points_wrong_leave_the_camera_where_it_is(flat):
    rng = np.random.default_rng(1)
    for pose in random_poses(rng, 5):
        points, rays = seen(rng, pose, 60, noise_px=0.3, flat=flat)
        points[::2] += rng.normal(0, 0.3, (30, 3))
        found = resect(points, rays, 2.0 / FOCAL)
        assert rotation_between_deg(found.world_from_cam[:3, :3], pose[:3, :3]) < 0.3
        assert np.linalg.norm(found.world_from_cam[:3, 3] - pose[:3, 3]) < 0.03
        assert found.inliers[1::2].mean() > 0.9
        assert found.inliers[::2].mean() < 0.2


def test_without_noise_it_is_exact():
    rng = np.random.default_rng(2)
    pose = random_poses(rng, 1)[0]
    found = resect(*seen(rng, pose, 20), 1e-3)
    np.testing.assert_allclose(found.world_from_cam, pose, atol=1e-9)


def test_too_few_points_or_none_that_agree_place_nothing():
    rng = np.random.default_rng(3)
    points, rays = seen(rng, random_poses(rng, 1)[0], 30)
    assert resect(points[:5], rays[:5], 1e-3) is None
    assert resect(rng.normal(size=(30, 3)), rays, 1e-4) is None
    assert resect(np.zeros((30, 3)), rays, 1e-3) is None
    assert resect(np.zeros((0, 3)), np.zeros((0, 3)), 1e-3) is None
