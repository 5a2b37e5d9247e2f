"""Cameras are moved to measured positions if these determine the frame; otherwise nothing is claimed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from biresnerf.geometry.earth.georeference import BELIEVED, NoGeoreference, fit_positions
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.similarity import Similarity

COUNT = 30
WORLD_FROM_METRES = Similarity(
    0.04, Rotation.from_rotvec([0.3, 1.2, -0.5]).as_matrix(), np.array([4.0, 1.0, -9.0])
)


def cameras_m(flat: float = 1.0) -> np.ndarray:
    """Poses [n, 4, 4] in metres, within 50 m; on a line where ``flat`` is 0."""
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, :3] = Rotation.random(COUNT, random_state=2).as_matrix()
    poses[:, :3, 3] = rng.uniform(-50, 50, (COUNT, 3)) * [1, flat, flat]
    return poses


def measured(poses: np.ndarray, noise_m: float) -> np.ndarray:
    return poses[:, :3, 3] + np.random.default_rng(3).normal(0, noise_m, (COUNT, 3))


@pytest.mark.parametrize("noise_m", [0.0, 0.02, 2.0])
def test_the_similarity_is_the_true_one_as_far_as_the_positions_tell(noise_m):
    poses = cameras_m()
    stated = np.full((COUNT, 3), max(noise_m, 1e-3))
    fit = fit_positions(WORLD_FROM_METRES.apply_to_poses(poses), measured(poses, noise_m), stated)
    back = fit.metres_from_world.apply_to_poses(WORLD_FROM_METRES.apply_to_poses(poses))
    assert np.abs(back[:, :3, 3] - poses[:, :3, 3]).max() < 1e-6 + 2 * noise_m
    assert rotation_between_deg(back, poses).max() < 1e-4 + np.degrees(2 * noise_m / 50)
    assert fit.metres_from_world.scale * WORLD_FROM_METRES.scale == pytest.approx(1, abs=1e-6 + noise_m / 50)
    assert fit.used.all()


def test_the_residuals_are_the_distances_and_one_wrong_position_moves_nothing():
    poses = cameras_m()
    positions = measured(poses, 0.1)
    positions[4] += [3000.0, 0, 0]
    positions[9] += [0, 20.0, 0]
    fit = fit_positions(WORLD_FROM_METRES.apply_to_poses(poses), positions)
    assert not fit.used[4]
    assert fit.residual_m[4] == pytest.approx(3000, rel=0.01)
    assert fit.residual_m[9] == pytest.approx(20, abs=0.6)
    assert np.delete(fit.residual_m, [4, 9]).max() < 0.6


def refusal(poses: np.ndarray, positions: np.ndarray) -> str:
    with pytest.raises(NoGeoreference) as caught:
        fit_positions(WORLD_FROM_METRES.apply_to_poses(poses), positions)
    return str(caught.value)


def test_a_frame_that_positions_leave_open_is_refused_with_the_reason():
    poses, line = cameras_m(), cameras_m(flat=0.0)
    assert "6 are needed" in refusal(poses[:5], poses[:5, :3, 3])
    assert "one place" in refusal(poses, np.tile([1.0, 2.0, 3.0], (COUNT, 1)))
    assert "leave the turn open" in refusal(line, line[:, :3, 3])
    assert "leave the turn open" in refusal(line, measured(line, 1.0))
    assert "scatter" in refusal(poses, np.random.default_rng(8).normal(0, 50, (COUNT, 3)))


def test_an_accuracy_that_the_residuals_contradict_is_doubted_and_the_frame_is_kept():
    poses = cameras_m()
    positions, world = measured(poses, 2.0), WORLD_FROM_METRES.apply_to_poses(poses)
    doubted = fit_positions(world, positions, np.full((COUNT, 3), 0.05))
    assert "accuracy of 0.05 m is not believed" in doubted.doubt
    assert doubted.metres_from_world.scale * WORLD_FROM_METRES.scale == pytest.approx(1, abs=0.05)
    assert not fit_positions(world, positions, np.full((COUNT, 3), 1.5)).doubt


def test_an_accuracy_is_doubted_just_where_normal_errors_would_hardly_reach_the_residuals():
    poses = cameras_m()
    positions, world = measured(poses, 2.0), WORLD_FROM_METRES.apply_to_poses(poses)
    apart = fit_positions(world, positions).residual_m
    # Of normal errors in three coordinates the median length is 1.538 deviations, the root of chi-square's median.
    bound = np.median(apart) / (BELIEVED * np.sqrt(chi2(3).median()))
    assert fit_positions(world, positions, np.full((COUNT, 3), 0.97 * bound)).doubt
    assert not fit_positions(world, positions, np.full((COUNT, 3), 1.03 * bound)).doubt


def test_a_gimbals_angles_tell_the_turn_about_a_line_unless_they_contradict_the_cameras():
    line = cameras_m(flat=0.0)
    world, positions = WORLD_FROM_METRES.apply_to_poses(line), measured(line, 0.5)
    off = Rotation.from_rotvec(np.random.default_rng(5).normal(0, 0.02, (COUNT, 3))).as_matrix()
    fit = fit_positions(world, positions, rotations=off @ line[:, :3, :3])
    back = fit.metres_from_world.apply_to_poses(world)
    assert rotation_between_deg(back, line).max() < 1.5
    assert np.abs(back[:, :3, 3] - line[:, :3, 3]).max() < 1.0
    with pytest.raises(NoGeoreference, match="gimbal"):
        fit_positions(world, positions, rotations=Rotation.random(COUNT, random_state=7).as_matrix())
