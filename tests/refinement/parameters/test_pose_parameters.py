"""Poses as parameters: exact at zero, finite gradients, steps that move only what they may."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from biresnerf.refinement.parameters.pose_parameters import PoseParameters
from tests.refinement.tiny_scene import CPU


def given(count: int = 5) -> torch.Tensor:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=1).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(1).normal(size=(count, 3)) * 3
    return torch.from_numpy(poses)


def pull(poses: PoseParameters, rows: list[int]) -> None:
    """Gradients towards somewhere, for these rows only."""
    target = torch.linspace(-1, 1, 12).reshape(3, 4)
    ((poses.matrices()[rows] - target) ** 2).sum().backward()


def moved(poses: PoseParameters, start: torch.Tensor) -> list[int]:
    return [i for i in range(len(poses)) if not torch.equal(poses.matrices()[i], start[i])]


def test_zero_increments_give_the_given_poses_exactly():
    poses = PoseParameters(given(), 1.3, CPU)
    assert torch.equal(poses.matrices(), given()[:, :3].float())
    assert torch.equal(poses.poses()[:, 3], torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(5, 4))


def test_the_gradient_at_zero_is_finite_and_not_zero():
    poses = PoseParameters(given(), 1.3, CPU)
    pull(poses, [0, 1, 2, 3, 4])
    for gradient in (poses.rotation.grad, poses.translation.grad):
        assert torch.isfinite(gradient).all()
        assert (gradient.abs().amax(1) > 0).all()


def test_a_rotation_turns_a_camera_about_the_scene():
    turn = torch.tensor([0.0, 0.0, 0.5])
    about_z = torch.from_numpy(Rotation.from_rotvec(turn.numpy()).as_matrix()).float()
    poses = PoseParameters(given(), 1.3, CPU)
    with torch.no_grad():
        poses.rotation[:] = turn
    matrices = poses.matrices()
    torch.testing.assert_close(matrices[:, :, :3], about_z @ given()[:, :3, :3].float())
    torch.testing.assert_close(matrices[:, :, 3], given()[:, :3, 3].float() @ about_z.T)


def test_translations_are_in_units_of_the_length():
    poses = PoseParameters(given(), 2.5, CPU)
    with torch.no_grad():
        poses.translation[:, 1] = 0.2
    shift = poses.matrices()[:, :, 3] - given()[:, :3, 3].float()
    torch.testing.assert_close(shift, torch.tensor([0.0, 0.5, 0.0]).expand(5, 3))


def test_poses_stay_rigid_after_many_steps():
    poses = PoseParameters(given(), 1.0, CPU)
    for _ in range(50):
        pull(poses, [0, 1, 2, 3, 4])
        poses.step(0.1)
    rotation = poses.poses()[:, :3, :3]
    torch.testing.assert_close(
        rotation @ rotation.transpose(1, 2), torch.eye(3).double().expand(5, 3, 3), atol=1e-12, rtol=0
    )
    assert (torch.linalg.det(rotation) > 0).all()
    assert len(moved(poses, given()[:, :3].float())) == 5


def test_a_camera_that_never_met_a_gradient_keeps_still():
    poses = PoseParameters(given(), 1.0, CPU)
    start = poses.matrices().detach().clone()
    for _ in range(3):
        pull(poses, [1, 3])
        poses.step(0.01)
    assert moved(poses, start) == [1, 3]


def test_cameras_without_mobility_keep_still_in_spite_of_gradients_and_momentum():
    poses = PoseParameters(given(), 1.0, CPU)
    pull(poses, [0, 1, 2, 3, 4])
    poses.step(0.01)
    start = poses.matrices().detach().clone()
    mobility = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.5])
    pull(poses, [0, 1, 2, 3, 4])
    poses.step(0.01, mobility)
    assert moved(poses, start) == [1, 4]


def test_a_step_leaves_no_gradient_behind():
    poses = PoseParameters(given(), 1.0, CPU)
    pull(poses, [0])
    poses.step(0.01)
    assert poses.rotation.grad is None
    assert poses.translation.grad is None


def test_a_restored_state_takes_the_very_same_next_step():
    def steps(poses, count):
        for _ in range(count):
            pull(poses, [0, 2, 4])
            poses.step(0.02)

    first = PoseParameters(given(), 1.3, CPU)
    steps(first, 3)
    saved = {name: tensor.clone() for name, tensor in first.state().items()}
    steps(first, 2)
    second = PoseParameters(torch.eye(4).repeat(5, 1, 1), 1.3, CPU)
    second.load_state(saved)
    steps(second, 2)
    assert torch.equal(second.matrices(), first.matrices())


def test_restarted_moments_forget_where_they_were_going():
    poses = PoseParameters(given(), 1.0, CPU)
    pull(poses, [0])
    poses.step(0.01)
    poses.restart_adam()
    start = poses.matrices().detach().clone()
    pull(poses, [1])
    poses.step(0.01)
    assert moved(poses, start) == [1]
