"""CamP (Park et al. 2023): coordinates for camera poses in which every direction moves the picture by as much.

A pose parameter theta = (rotation, translation) of `so3xr3` moves the projections of points in view by J theta. With
Sigma = mean J^T J, theta = P phi and P = (Sigma + damping)^(-1/2), a unit of phi moves them by about the image's size,
whichever way it points, and rotations no longer fight translations that look the same.
"""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.geometry.camera import Intrinsics

POINTS = 5000
NEAR, FAR = 0.125, 2.0  # depths of the points, of the cameras' distance: 0.5 to 8 of rigs 4 away
DAMPING, DAMPING_LEAST = 0.1, 1e-8  # of Sigma's diagonal


def projection_jacobian(
    points: Tensor, focal: Tensor, size: float, rotation: Tensor, length: float
) -> Tensor:
    """d(pixel / size) / d(rotation, translation) [n, 2, 6] at zero, of points [n, 3] in the camera's frame.

    Args:
        focal: fx and fy [2], px; lens distortion is left out.
        size: the longer side of the image, px.
        rotation: unit_from_cam [3, 3].
        length: unit lengths per unit of translation.
    """
    x, y, z = points.unbind(1)
    zero = torch.zeros_like(x)
    projection = torch.stack(
        [torch.stack([1 / z, zero, -x / z**2], 1), torch.stack([zero, 1 / z, -y / z**2], 1)], 1
    )
    projection = projection * (focal / size)[:, None]
    # A point at p of the camera's frame goes to p - (R^T omega) x p - R^T u.
    cross = torch.stack(
        [torch.stack([zero, -z, y], 1), torch.stack([z, zero, -x], 1), torch.stack([-y, x, zero], 1)], 1
    )
    by_rotation = projection @ cross @ rotation.T
    by_translation = -length * projection @ rotation.T
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
    result = []
    for i, pose in enumerate(unit_from_cam.double().cpu()):
        size = torch.stack([intrinsics.width[i], intrinsics.height[i]]).double().cpu()
        focal = torch.stack([intrinsics.fx[i], intrinsics.fy[i]]).double().cpu()
        centre = torch.stack([intrinsics.cx[i], intrinsics.cy[i]]).double().cpu()
        points = torch.cat([(across * size - centre) / focal * depth, depth], 1)
        jacobian = projection_jacobian(points, focal, float(size.max()), pose[:3, :3], length)
        sigma = (jacobian.transpose(1, 2) @ jacobian).mean(0)
        damped = sigma + torch.diag((DAMPING * sigma.diagonal()).clamp(min=DAMPING_LEAST))
        values, vectors = torch.linalg.eigh(damped)
        result.append(vectors @ torch.diag(values.rsqrt()) @ vectors.T)
    return torch.stack(result)
