"""Interpolated poses against scipy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from biresnerf.geometry.pose_error import rotation_angle_deg
from biresnerf.geometry.rigid import interpolate_pose


def pose(rotation: Rotation, centre) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), centre
    return matrix


@given(seed=st.integers(0, 10_000), angle=st.floats(0, np.pi - 1e-4), share=st.floats(0, 1))
def test_the_path_is_a_straight_line_and_the_shortest_turn(seed, angle, share):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    first = Rotation.random(random_state=seed)
    second = first * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    between = interpolate_pose(pose(first, [1.0, 2, 3]), pose(second, [3.0, 2, -1]), share)
    expected = Slerp([0, 1], Rotation.concatenate([first, second]))(share).as_matrix()
    assert rotation_angle_deg((expected.T @ between[:3, :3])[None])[0] < 1e-3
    np.testing.assert_allclose(between[:3, 3], [1 + 2 * share, 2, 3 - 4 * share], atol=1e-12)


@pytest.mark.parametrize("axis", np.concatenate([np.eye(3), [[0.6, -0.8, 0], [-0.6, 0, 0.8]]]))
def test_half_of_a_half_turn_is_a_quarter_turn(axis):
    first = pose(Rotation.identity(), np.zeros(3))
    second = pose(Rotation.from_rotvec(np.pi * axis), np.ones(3))
    between = interpolate_pose(first, second, 0.5)
    assert rotation_angle_deg(between[None, :3, :3])[0] == pytest.approx(90)
    assert rotation_angle_deg((between[:3, :3].T @ second[:3, :3])[None])[0] == pytest.approx(90)


def test_the_ends_are_the_poses_themselves():
    first = pose(Rotation.random(random_state=1), [1.0, 2, 3])
    second = pose(Rotation.random(random_state=2), [4.0, 5, 6])
    np.testing.assert_allclose(interpolate_pose(first, second, 0), first, atol=1e-12)
    np.testing.assert_allclose(interpolate_pose(first, second, 1), second, atol=1e-12)
    np.testing.assert_allclose(interpolate_pose(first, first, 0.3), first, atol=1e-12)
