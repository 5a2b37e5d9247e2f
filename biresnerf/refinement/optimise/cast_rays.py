"""Rays of cameras from viewing directions, and the gradients of all rays back to their cameras."""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.field.backends import Directions, camera_kernels
from biresnerf.geometry.camera.camera import Intrinsics, directions_with_gradient
from biresnerf.refinement.kernels.cast_rays import CastRays


def viewing_directions(directions: Directions, lenses: Intrinsics, image: Tensor, xy: Tensor) -> Tensor:
    """Viewing directions float32 [rays, 3] of pixels `xy` [rays, 2] in their cameras; by gradient where lenses move.

    `directions` is the device's, see `directions_for`.
    """
    with torch.no_grad():
        in_cam = directions(lenses, image, xy).float()
    return directions_with_gradient(lenses, image, xy, in_cam) if lenses.fx.requires_grad else in_cam


def cast_rays(matrices: Tensor, camera: Tensor, in_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Origin and direction [rays, 3] of rays with directions `in_cam` [rays, 3] in cameras `camera` [rays].

    Differentiable by `matrices` [n, 3, 4], which are unit_from_cam, and by `in_cam`.
    """
    if in_cam.requires_grad:
        return turned(matrices[camera], in_cam)
    if matrices.device.type == "cpu":
        origin, direction = CastRays.apply(matrices, camera, in_cam)
        return origin, direction
    if kernels := camera_kernels(matrices.device):
        return kernels.rays_of_cameras(matrices, camera, in_cam)
    return turned(matrices[camera], in_cam)


def turned(matrix: Tensor, in_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Origin and direction [rays, 3] of rays with a unit_from_cam [rays, 3, 4] each."""
    direction = (matrix[:, :, :3] @ in_cam[:, :, None])[:, :, 0]
    return matrix[:, :, 3].contiguous(), direction.contiguous()
