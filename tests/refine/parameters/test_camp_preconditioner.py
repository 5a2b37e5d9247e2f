"""CamP's preconditioner: its Jacobian against autograd, its effect on the picture, and its gradient at zero."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from biresnerf.data.synthetic.scene import synthetic_cameras
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.lie import so3_exp
from biresnerf.refine.parameters.camp_preconditioner import (
    camp_preconditioner,
    pixels_by_points,
    projection_jacobian,
)
from biresnerf.refine.parameters.parametrisations import CampSo3xR3, Parametrisation, So3xR3
from biresnerf.refine.parameters.pose_parameters import PoseParameters
from tests.refine.tiny_scene import tiny_optimiser, tiny_options, tiny_set

CPU = torch.device("cpu")
WIDTH, HEIGHT, FX, FY, CX, CY = 60, 40, 70.0, 66.0, 31.0, 18.0
LENGTH, DISTANCE = 1.7, 4.0


def pixels(points: torch.Tensor, pose: torch.Tensor, theta: torch.Tensor) -> torch.Tensor:
    """Pixels [n, 2], in image sizes, of points [n, 3] of the scene, by a camera moved by theta = (omega, u)."""
    rotation = so3_exp(theta[None, :3])[0] @ pose[:3, :3]
    x, y, z = ((points - pose[:3, 3] - LENGTH * theta[3:]) @ rotation).unbind(1)
    return torch.stack([FX * x / z, FY * y / z], 1) / max(WIDTH, HEIGHT)


def poses(count: int = 3) -> torch.Tensor:
    return torch.from_numpy(synthetic_cameras(count, seed=5))


def intrinsics(count: int) -> Intrinsics:
    return Intrinsics.from_cameras([Camera("PINHOLE", WIDTH, HEIGHT, (FX, FY, CX, CY))] * count)


def in_view(count: int, seed: int = 0) -> torch.Tensor:
    """Points [n, 3] of a camera's frame within its frustum."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 8.0, count)
    x = (rng.uniform(0, WIDTH, count) - CX) / FX * depth
    y = (rng.uniform(0, HEIGHT, count) - CY) / FY * depth
    return torch.from_numpy(np.stack([x, y, depth], 1))


def test_the_jacobian_is_that_of_the_projection_by_autograd():
    pose, points = poses()[1], in_view(20)
    by_point = pixels_by_points(intrinsics(1), torch.zeros(20, dtype=torch.int64), points)
    formula = projection_jacobian(points, by_point / max(WIDTH, HEIGHT), pose[:3, :3], LENGTH)
    world = points @ pose[:3, :3].T + pose[:3, 3]
    automatic = torch.autograd.functional.jacobian(
        lambda theta: pixels(world, pose, theta), torch.zeros(6, dtype=torch.float64)
    )
    torch.testing.assert_close(formula, automatic, rtol=1e-9, atol=1e-12)


def test_a_unit_of_every_parameter_moves_the_picture_by_about_its_size():
    pose = poses(1)
    p = camp_preconditioner(pose, intrinsics(1), DISTANCE, LENGTH, seed=0)[0]
    world = in_view(4000, seed=3) @ pose[0, :3, :3].T + pose[0, :3, 3]
    moves = []
    for phi in torch.eye(6, dtype=torch.float64):
        small = 1e-5
        moved = (pixels(world, pose[0], small * p @ phi) - pixels(world, pose[0], -small * p @ phi)) / small
        moves.append(float((moved / 2).square().sum(1).mean().sqrt()))
    assert max(moves) <= 1.05  # damping makes it a little less
    assert min(moves) > 0.6
    plain = [p.inverse()[:, k].norm().item() for k in range(6)]  # without it, directions differ more
    assert max(plain) / min(plain) > 1.5 * max(moves) / min(moves)


def test_the_preconditioner_is_symmetric_positive_and_the_same_for_the_same_seed():
    p = camp_preconditioner(poses(4), intrinsics(4), DISTANCE, LENGTH, seed=2)
    torch.testing.assert_close(p, p.transpose(1, 2))
    assert float(torch.linalg.eigvalsh(p).min()) > 0
    assert torch.equal(p, camp_preconditioner(poses(4), intrinsics(4), DISTANCE, LENGTH, seed=2))


def test_a_fisheye_that_sees_behind_itself_has_a_preconditioner_too():
    lens = Camera("OPENCV_FISHEYE", WIDTH, HEIGHT, (18.0, 18.0, 30.0, 20.0, 0.01, 0.0, 0.0, 0.0))
    p = camp_preconditioner(poses(2), Intrinsics.from_cameras([lens] * 2), DISTANCE, LENGTH, seed=0)
    assert p.isfinite().all()
    assert float(torch.linalg.eigvalsh(p).min()) > 0


def parameters(form: Parametrisation) -> PoseParameters:
    return PoseParameters(poses(3), form, CPU)


def test_parameters_are_those_of_so3xr3_times_the_preconditioner_with_finite_gradient_at_zero():
    p = camp_preconditioner(poses(3), intrinsics(3), DISTANCE, LENGTH, seed=0)
    camp, plain = parameters(CampSo3xR3(LENGTH, lambda _: p)), parameters(So3xR3(LENGTH))
    torch.testing.assert_close(camp.matrices(), poses(3)[:, :3].float())
    weight = torch.rand(3, 3, 4, generator=torch.Generator().manual_seed(1))
    for each in (camp, plain):
        (each.matrices() * weight).sum().backward()
    gradient = torch.cat([plain.rotation.grad, plain.translation.grad], 1)
    expected = (p.float().transpose(1, 2) @ gradient[:, :, None])[:, :, 0]
    found = torch.cat([camp.rotation.grad, camp.translation.grad], 1)
    assert found.isfinite().all()
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    with torch.no_grad():
        phi = 0.1 * torch.randn(3, 6, generator=torch.Generator().manual_seed(2))
        camp.rotation.copy_(phi[:, :3])
        camp.translation.copy_(phi[:, 3:])
        theta = (p.float() @ phi[:, :, None])[:, :, 0]
        plain.rotation.copy_(theta[:, :3])
        plain.translation.copy_(theta[:, 3:])
    torch.testing.assert_close(camp.matrices(), plain.matrices())


def test_a_preconditioner_without_its_parametrisation_is_refused():
    with pytest.raises(TypeError):
        So3xR3(LENGTH, lambda _: torch.eye(6).expand(3, 6, 6))
    with pytest.raises(TypeError):
        CampSo3xR3(LENGTH)


def test_bodies_of_several_cameras_are_refused_where_cameras_have_coordinates_of_their_own():
    form = CampSo3xR3(LENGTH, lambda _: torch.eye(6).expand(3, 6, 6))
    with pytest.raises(ValueError, match="CampSo3xR3"):
        PoseParameters(poses(3), form, CPU, body=torch.tensor([0, 0, 1]))


def test_a_run_with_it_steps_and_restores_its_state(tmp_path):
    dataset, images = tiny_set(tmp_path, views=4, size=16)
    first = tiny_optimiser(dataset, images, tiny_options(pose_parametrisation="so3xr3_camp"))
    for _ in range(4):
        first.step()
    saved, numbers = {k: v.clone() for k, v in first.state().items()}, first.step_state()
    first.step()
    second = tiny_optimiser(dataset, images, tiny_options(pose_parametrisation="so3xr3_camp"))
    second.load_state(saved, numbers)
    second.step()
    assert torch.equal(first.poses.matrices(), second.poses.matrices())
    assert not torch.equal(second.poses.matrices(), second.poses.start)
