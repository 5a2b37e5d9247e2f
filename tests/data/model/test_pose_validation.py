"""Poses that files give: near rotations are projected to the nearest, others refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from biresnerf.data.model.pose_validation import ROTATION_REFUSED, rigid_matrix
from biresnerf.errors import InputError

seeds = st.integers(0, 2**32 - 1)


def random_pose(seed: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = np.random.default_rng(seed).normal(size=3) * 10
    return pose


@given(seeds)
def test_a_rigid_motion_passes_unchanged(seed):
    pose = random_pose(seed)
    matrix, deviation = rigid_matrix(pose.tolist(), "x")
    np.testing.assert_allclose(matrix, pose, atol=1e-14)
    assert deviation < 1e-14


@given(seeds, st.floats(1e-7, 3e-3))
def test_a_slightly_wrong_rotation_becomes_the_nearest_one(seed, amount):
    pose = random_pose(seed)
    given_ = pose.copy()
    given_[:3, :3] += amount * np.random.default_rng(seed).uniform(-1, 1, (3, 3))
    matrix, deviation = rigid_matrix(given_.tolist(), "x")
    rotation = matrix[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(rotation) > 0
    # Nearest: no rotation nearby is closer to what was given.
    distance = np.linalg.norm(rotation - given_[:3, :3])
    for axis in np.eye(3):
        other = Rotation.from_rotvec(1e-4 * axis).as_matrix() @ rotation
        assert np.linalg.norm(other - given_[:3, :3]) >= distance - 1e-12
    assert deviation <= 3 * amount


@given(seeds, st.floats(1 + 1.1 * ROTATION_REFUSED, 100.0), st.booleans())
def test_a_scaled_rotation_is_refused_and_its_factor_named(seed, factor, inverse):
    pose = random_pose(seed)
    factor = 1 / (factor * 1.01) if inverse else factor
    pose[:3, :3] *= factor
    with pytest.raises(InputError) as caught:
        rigid_matrix(pose.tolist(), "file frames[1].transform_matrix")
    assert caught.value.code == "pose_not_rotation"
    named = float(caught.value.detail.removeprefix("the rotation is scaled by ").removesuffix("."))
    assert named == pytest.approx(factor, rel=1e-5)


@given(seeds, st.sampled_from([0, 1, 2]))
def test_a_mirrored_pose_is_refused(seed, column):
    pose = random_pose(seed)
    pose[:3, column] *= -1
    with pytest.raises(InputError, match="mirrors"):
        rigid_matrix(pose.tolist(), "x")
