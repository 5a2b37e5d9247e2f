"""How much of what each camera sees the others see too.

In a scene without background, a camera that looks where no other does finds room there for its photo: the field
explains it as well as any, wherever it truly belongs. Only that nobody shares the view gives it away.
"""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.geometry.camera import Intrinsics

WITNESSES = 2  # other cameras that must have a point in view


def shared_shares(points: Tensor, seer: Tensor, unit_from_cam: Tensor, intrinsics: Intrinsics) -> Tensor:
    """Share [k] of each set of points [k, m, 3] that lies in the view of two cameras or more beside the seer's own.

    Args:
        seer: index [k] of the camera that sees the points, or would from another pose.
        unit_from_cam: [n, 3, 4], in the frame of the points.
        intrinsics: of the n cameras; views are taken as pinholes, whatever the lens.
    """
    rotation, centre = unit_from_cam[:, :, :3], unit_from_cam[:, :, 3]
    focal = torch.stack([intrinsics.fx, intrinsics.fy], 1).to(points)
    middle = torch.stack([intrinsics.cx, intrinsics.cy], 1).to(points)
    size = torch.stack([intrinsics.width, intrinsics.height], 1).to(points)
    shares = []
    for own, camera in zip(points, seer.tolist(), strict=True):
        in_cam = torch.einsum("cji,ckj->cki", rotation, own[None] - centre[:, None])
        pixel = in_cam[..., :2] / in_cam[..., 2:].clamp(min=1e-9) * focal[:, None] + middle[:, None]
        inside = (in_cam[..., 2] > 0) & ((pixel > 0) & (pixel < size[:, None])).all(-1)
        inside[camera] = False
        shares.append((inside.sum(0) >= WITNESSES).float().mean())
    return torch.stack(shares)
