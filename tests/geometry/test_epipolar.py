"""Epipolar errors: zero for true poses, independent of the gauge, and as large as the error in the image."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.synthetic.scene import synthetic_cameras
from biresnerf.geometry.epipolar import epipolar_angles, match_depths
from biresnerf.geometry.similarity import Similarity

POINTS = np.random.default_rng(1).uniform(-0.7, 0.7, (200, 3))
A, B = np.divmod(np.arange(200), 20)[0] % 5, np.arange(200) % 4 + 5


def rays(world_from_cam: np.ndarray, index: np.ndarray) -> np.ndarray:
    towards = POINTS - world_from_cam[index, :3, 3]
    in_cam = np.einsum("mji,mj->mi", world_from_cam[index, :3, :3], towards)
    return in_cam / np.linalg.norm(in_cam, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def rig() -> np.ndarray:
    return synthetic_cameras(9, seed=2)


def errors(poses: np.ndarray, true_poses: np.ndarray) -> np.ndarray:
    return epipolar_angles(poses, A, B, rays(true_poses, A), rays(true_poses, B))


def test_true_poses_have_none(rig):
    assert errors(rig, rig).max() < 1e-12


def test_the_frame_does_not_matter(rig):
    wrong = rig.copy()
    wrong[:, :3, 3] += np.random.default_rng(2).normal(0, 0.05, (9, 3))
    moved = Similarity(7.0, rig[3, :3, :3], np.array([3.0, -90, 4])).apply_to_poses(wrong)
    np.testing.assert_allclose(errors(moved, rig), errors(wrong, rig), rtol=1e-6, atol=1e-12)


def test_a_small_turn_about_the_axis_across_the_baseline_is_seen_in_full():
    """Two cameras side by side, looking ahead; one nods by an angle: points ahead leave their line by that angle."""
    left, right = np.eye(4), np.eye(4)
    right[0, 3] = 1.0
    nod = 0.01
    nodding = right.copy()
    nodding[:3, :3] = [[1, 0, 0], [0, np.cos(nod), -np.sin(nod)], [0, np.sin(nod), np.cos(nod)]]
    ahead = np.array([[0.0, 0.0, 1.0]])
    error = epipolar_angles(np.stack([left, nodding]), np.array([0]), np.array([1]), ahead, ahead)
    assert error[0] == pytest.approx(nod, rel=1e-9)


def test_the_two_cameras_may_be_named_either_way_round(rig):
    wrong = rig.copy()
    wrong[:, :3, 3] += np.random.default_rng(3).normal(0, 0.1, (9, 3))
    forth = epipolar_angles(wrong, A, B, rays(rig, A), rays(rig, B))
    back = epipolar_angles(wrong, B, A, rays(rig, B), rays(rig, A))
    np.testing.assert_allclose(forth, back, rtol=1e-9)


def test_cameras_at_one_point_say_nothing(rig):
    same = rig.copy()
    same[B] = same[A[0]]
    assert np.isnan(errors(same, same)[A[0] == A]).all()


def test_depths_of_matches_are_those_of_their_points_in_either_camera(rig):
    def depth(index: np.ndarray) -> np.ndarray:
        return np.einsum("mj,mj->m", POINTS - rig[index, :3, 3], rig[index, :3, 2])

    expected = np.stack([depth(A), depth(B)], axis=1)
    np.testing.assert_allclose(match_depths(rig, A, B, rays(rig, A), rays(rig, B)), expected, rtol=1e-9)


def test_a_point_without_parallax_has_no_depth_and_one_behind_a_negative_one():
    side_by_side = np.stack([np.eye(4), np.eye(4)])
    side_by_side[1, 0, 3] = 1.0
    ahead, crossing = np.array([[0.0, 0.0, 1.0]]), np.array([[0.6, 0.0, 0.8]])
    a, b = np.array([0]), np.array([1])
    assert np.isnan(match_depths(side_by_side, a, b, ahead, ahead)).all()
    np.testing.assert_allclose(match_depths(side_by_side, a, b, ahead, crossing), -4 / 3, rtol=1e-9)
