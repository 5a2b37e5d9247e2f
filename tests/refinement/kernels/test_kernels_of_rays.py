"""The kernels of poses and rays give what torch's operations do, and the same gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from biresnerf.refinement.optimise.camera_errors import CameraErrors
from biresnerf.refinement.optimise.renderer import cast_rays, turned
from biresnerf.refinement.parameters.pose_parameters import PoseParameters
from tests.refinement.tiny_scene import photos_set

CPU = torch.device("cpu")
CAMERAS, RAYS = 7, 200
BODIES = {"one camera": None, "rigs": torch.tensor([0, 0, 1, 2, 2, 2, 3])}


def moved_cameras(angle: float, body: torch.Tensor | None) -> PoseParameters:
    """Cameras whose increments turn by about so many radians."""
    random = torch.Generator().manual_seed(3)
    start = torch.eye(4).repeat(CAMERAS, 1, 1)
    start[:, :3] += torch.randn(CAMERAS, 3, 4, generator=random)
    made = PoseParameters(start, 0.7, CPU, body=body)
    with torch.no_grad():
        for parameter in (made.rotation, made.translation):
            direction = torch.randn(parameter.shape, generator=random)
            parameter.copy_(angle * direction / direction.norm(dim=1, keepdim=True))
    return made


def with_gradients(
    poses: PoseParameters, matrices: torch.Tensor, upstream: torch.Tensor
) -> list[torch.Tensor]:
    poses.rotation.grad = poses.translation.grad = None
    matrices.backward(upstream)
    return [matrices.detach(), poses.rotation.grad, poses.translation.grad]


@pytest.mark.parametrize("body", BODIES.values(), ids=list(BODIES))
@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.3, 0.999, 1.001, 3.1, 6.5])
def test_poses_and_their_gradients_are_those_of_torch(angle: float, body: torch.Tensor | None) -> None:
    poses = moved_cameras(angle, body)
    upstream = torch.randn(CAMERAS, 3, 4, generator=torch.Generator().manual_seed(4))
    ours = with_gradients(poses, poses.matrices(), upstream)
    theirs = with_gradients(poses, poses.defined_matrices(), upstream)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=2e-5, atol=2e-5)


def test_gradients_are_of_the_increments_that_were_rendered_with() -> None:
    poses = moved_cameras(0.3, None)
    upstream = torch.ones(CAMERAS, 3, 4)
    expected = with_gradients(poses, poses.matrices(), upstream)[1:]
    matrices = poses.matrices()
    poses.rotation.grad = poses.translation.grad = None
    with torch.no_grad():
        poses.rotation += 1.0
        poses.start += 1.0
    matrices.backward(upstream)
    assert torch.equal(poses.rotation.grad, expected[0])
    assert torch.equal(poses.translation.grad, expected[1])


def test_rays_and_their_gradients_are_those_of_torch() -> None:
    random = torch.Generator().manual_seed(5)
    camera = torch.randint(CAMERAS - 1, (RAYS,), generator=random)  # the last one has no ray
    in_cam, *upstream = (torch.randn(RAYS, 3, generator=random) for _ in range(3))
    found = []
    for cast in (cast_rays, lambda m, of, directions: turned(m[of], directions)):
        matrices = torch.randn(CAMERAS, 3, 4, generator=random.manual_seed(6)).requires_grad_()
        rays = cast(matrices, camera, in_cam)
        torch.autograd.backward(rays, upstream)
        found.append([*(part.detach() for part in rays), matrices.grad])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-4)
    assert not found[0][2][-1].any()


def test_directions_that_depend_on_lenses_get_their_gradient() -> None:
    matrices, camera = torch.randn(CAMERAS, 3, 4), torch.zeros(RAYS, dtype=torch.int64)
    in_cam = torch.randn(RAYS, 3, requires_grad=True)
    cast_rays(matrices, camera, in_cam)[1].sum().backward()
    torch.testing.assert_close(in_cam.grad, matrices[0, :, :3].sum(0).expand(RAYS, 3))


def test_errors_of_a_batch_are_those_of_torch() -> None:
    random = torch.Generator().manual_seed(5)
    image = torch.randint(CAMERAS - 1, (RAYS,), generator=random)  # the last camera has no rays
    colour, target = torch.rand(2, RAYS, 3, generator=random)
    opacity, weight = torch.rand(2, RAYS, generator=random)
    photos = photos_set([np.zeros((2, 2, 3), np.uint8)] * CAMERAS)
    ours, theirs = CameraErrors(photos, [], CPU), CameraErrors(photos, [], CPU)
    for _ in range(2):
        ours.add(image, colour, target, opacity, weight)
        theirs.defined_add(image, colour, target, opacity, weight)
    sums = ours.state()["sums"]
    assert (sums[:, -1] == 0).all()
    torch.testing.assert_close(sums, theirs.state()["sums"], rtol=2e-6, atol=2e-6)
