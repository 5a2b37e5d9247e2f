"""The kernels of poses and rays give what torch's operations do, and the same gradients."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip(
    "triton",
    minversion="3.2",
    reason="the CUDA backend's kernels need Triton, for Linux only; its interpreter runs them from 3.2 on",
)

from biresnerf.field import backends
from biresnerf.field.cuda.cameras.poses_and_rays import moved_poses, rays_of_cameras
from biresnerf.field.cuda.check_batch import defined_poses, defined_rays, moved_and_cast
from tests.field.cuda.fields import DEVICE


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.3, 0.999, 1.001, 3.1, 6.5])
def test_poses_rays_and_gradients_are_those_of_torch(angle):
    found = moved_and_cast(moved_poses, rays_of_cameras, angle, DEVICE)
    for name, expected in moved_and_cast(defined_poses, defined_rays, angle, DEVICE).items():
        torch.testing.assert_close(found[name], expected, rtol=2e-5, atol=2e-5 * float(expected.abs().max()))


def test_poses_may_be_slices_of_larger_matrices():
    start = torch.randn(5, 4, 4, device=DEVICE)[:, :3]
    still, own = torch.zeros(5, 3, device=DEVICE), torch.arange(5, device=DEVICE)
    assert torch.equal(moved_poses(still, still, own, torch.ones(1, device=DEVICE), start), start)


def test_gradients_are_of_the_increments_that_were_rendered_with():
    increments = [torch.full((2, 3), 0.3, device=DEVICE, requires_grad=True) for _ in range(2)]
    others = (
        torch.arange(2, device=DEVICE),
        torch.ones(1, device=DEVICE),
        torch.ones(2, 3, 4, device=DEVICE),
    )
    expected = torch.autograd.grad(moved_poses(*increments, *others).sum(), increments)
    matrices = moved_poses(*increments, *others)
    with torch.no_grad():
        increments[0] += 1.0
        others[2].add_(1.0)
    for one, other in zip(torch.autograd.grad(matrices.sum(), increments), expected, strict=True):
        assert torch.equal(one, other)


def test_no_ray_is_cast_of_none():
    matrices = torch.eye(4, device=DEVICE)[None, :3].requires_grad_()
    none = torch.zeros(0, 3, device=DEVICE)
    origin, direction = rays_of_cameras(matrices, torch.zeros(0, dtype=torch.int64, device=DEVICE), none)
    (origin.sum() + direction.sum()).backward()
    assert origin.shape == direction.shape == (0, 3)
    assert not matrices.grad.any()


def test_torch_takes_the_place_of_kernels_that_fail(monkeypatch):
    monkeypatch.setattr(backends, "gpu_faults", lambda _device: ("origins differ",))
    assert backends.camera_kernels(torch.device("cuda")) is None
    monkeypatch.setattr(backends, "gpu_faults", lambda _device: ())
    assert backends.camera_kernels(torch.device("cuda")).rays_of_cameras is rays_of_cameras
