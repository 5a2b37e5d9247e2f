"""CamP (Park et al. 2023): pose coordinates in which every direction moves the image by the same amount.

A pose parameter theta = (rotation, translation) of `so3xr3` moves the projections of points in view by J theta. With
Sigma = mean J^T J, theta = P phi and P = (Sigma + damping)^(-1/2), a unit of phi moves them by about the image's size,
whichever way it points, and rotations no longer fight translations that look the same.
"""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project

POINTS = 5000
NEAR, FAR = 0.125, 2.0  # depths of the points, of the cameras' distance: 0.5 to 8 of rigs 4 away
DAMPING, DAMPING_LEAST = 0.1, 1e-8  # of Sigma's diagonal


def pixels_by_points(intrinsics: Intrinsics, image: Tensor, points: Tensor) -> Tensor:
    """d(pixel) / d(point) [n, 2, 3] of points [n, 3] in the frames of the cameras of images [n]."""
    points = points.detach().requires_grad_()
    pixels = project(intrinsics, image, points)
    rows = [torch.autograd.grad(pixels[:, axis].sum(), points, retain_graph=axis == 0)[0] for axis in (0, 1)]
    return torch.stack(rows, 1)


def projection_jacobian(points: Tensor, by_point: Tensor, rotation: Tensor, length: float) -> Tensor:
    """d(pixel) / d(rotation, translation) [n, 2, 6] at zero, of points [n, 3] in the camera's frame.

    Args:
        by_point: d(pixel) / d(point) [n, 2, 3], in any unit.
        rotation: unit_from_cam [3, 3].
        length: unit lengths per unit of translation.
    """
    x, y, z = points.unbind(1)
    zero = torch.zeros_like(x)
    # A point at p of the camera's frame goes to p - (R^T omega) x p - R^T u.
    cross = torch.stack(
        [torch.stack([zero, -z, y], 1), torch.stack([z, zero, -x], 1), torch.stack([-y, x, zero], 1)], 1
    )
    by_rotation = by_point @ cross @ rotation.T
    by_translation = -length * by_point @ rotation.T
    return torch.cat([by_rotation, by_translation], 2)


def camp_preconditioner(
    unit_from_cam: Tensor, intrinsics: Intrinsics, distance: float, length: float, seed: int
) -> Tensor:
    """P [n, 6, 6], float64, of cameras [n, 4, 4] at their present poses.

    Args:
        distance: of the cameras from the scene, unit lengths.
        length: unit lengths per unit of translation.
    """
    generator = torch.Generator().manual_seed(seed)
    across = torch.rand(POINTS, 2, generator=generator, dtype=torch.float64)
    depth = torch.rand(POINTS, 1, generator=generator, dtype=torch.float64)
    depth = distance * (NEAR + (FAR - NEAR) * depth)
    intrinsics = intrinsics.to("cpu")
    result = []
    for i, pose in enumerate(unit_from_cam.double().cpu()):
        size = torch.stack([intrinsics.width[i], intrinsics.height[i]]).double()
        image = torch.full((POINTS,), i)
        direction = directions_in_cam(intrinsics, image, across * size)
        # For a fisheye, depth is measured along the ray: rays to its sides have no depth along the axis.
        points = direction * depth if intrinsics.fisheye[i] else direction / direction[:, 2:] * depth
        by_point = pixels_by_points(intrinsics, image, points) / size.max()
        jacobian = projection_jacobian(points, by_point, pose[:3, :3], length)
        sigma = (jacobian.transpose(1, 2) @ jacobian).mean(0)
        damped = sigma + torch.diag((DAMPING * sigma.diagonal()).clamp(min=DAMPING_LEAST))
        values, vectors = torch.linalg.eigh(damped)
        result.append(vectors @ torch.diag(values.rsqrt()) @ vectors.T)
    return torch.stack(result)
