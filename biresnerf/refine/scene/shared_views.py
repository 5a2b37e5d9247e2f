"""How much of what each camera sees the others see too.

In a scene without background, a camera that looks where no other does finds room there for its photo: the field
explains it as well as any, wherever it truly belongs. Only that nobody shares the view gives it away.
"""

from __future__ import annotations

import torch
from torch import Tensor

from biresnerf.geometry.camera.camera import Intrinsics, in_view

WITNESSES = 2  # other cameras that must have a point in view


def shared_shares(points: Tensor, seer: Tensor, unit_from_cam: Tensor, intrinsics: Intrinsics) -> Tensor:
    """Share [k] of each set of points [k, m, 3] that lies in the view of two cameras or more beside the seer's own.

    Args:
        seer: index [k] of the camera that sees the points, or would from another pose.
        unit_from_cam: [n, 3, 4], in the frame of the points.
        intrinsics: of the n cameras.
    """
    rotation, centre = unit_from_cam[:, :, :3], unit_from_cam[:, :, 3]
    everyone = torch.arange(len(unit_from_cam), device=points.device)
    shares = []
    for own, camera in zip(points, seer.tolist(), strict=True):
        in_cam = torch.einsum("cji,ckj->cki", rotation, own[None] - centre[:, None])
        cameras = everyone.repeat_interleave(len(own))
        seen = in_view(intrinsics, cameras, in_cam.reshape(-1, 3)).reshape(len(everyone), len(own))
        seen[camera] = False
        shares.append((seen.sum(0) >= WITNESSES).float().mean())
    return torch.stack(shares)
