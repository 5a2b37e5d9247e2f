"""File conventions: reading inverts writing, and quaternions agree with scipy's."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from biresnerf.data.model.conventions import file_from_world_from_cam, world_from_cam_of_file
from biresnerf.geometry.rigid import quat_wxyz_from_rotation, rotation_from_quat_wxyz

seeds = st.integers(0, 2**32 - 1)


def random_poses(seed: int, count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(seed).normal(size=(count, 3))
    return poses


@given(seeds, st.floats(0.01, 100.0))
def test_writing_inverts_reading(seed, scale):
    poses = random_poses(seed, 5)
    applied = random_poses(seed // 2, 1)[0]
    in_file = file_from_world_from_cam(poses, applied, scale)
    np.testing.assert_allclose(world_from_cam_of_file(in_file, applied, scale), poses, atol=1e-12)


def test_an_applied_point_and_the_camera_that_sees_it_move_together():
    """A point keeps its place in the camera's view when world and camera go through the same similarity."""
    pose, applied = random_poses(3, 2)
    scale = 2.5
    point = np.array([0.3, -0.8, 1.7])
    in_cam = np.linalg.inv(pose) @ np.append(point, 1)
    file_pose = file_from_world_from_cam(pose, applied, scale)
    file_point = scale * (applied[:3, :3] @ point + applied[:3, 3])
    opengl = np.linalg.inv(file_pose) @ np.append(file_point, 1)
    np.testing.assert_allclose(opengl[:3] * [1, -1, -1], scale * in_cam[:3], atol=1e-12)


@given(seeds, st.sampled_from([1.0, 1e-9, np.pi - 1e-9, np.pi]))
def test_quaternions_are_scipys_also_near_half_turns(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    rotation = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    quat_wxyz = quat_wxyz_from_rotation(rotation.as_matrix())
    x, y, z, w = rotation.as_quat()
    assert quat_wxyz[0] >= 0
    assert abs(quat_wxyz @ [w, x, y, z]) > 1 - 1e-14
    np.testing.assert_allclose(rotation_from_quat_wxyz(quat_wxyz), rotation.as_matrix(), atol=1e-14)
