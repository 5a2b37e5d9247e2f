"""Floaters: opacity where too few cameras look for their photos to contradict it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from biresnerf.field.reference import operations as reference
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.scene.shared_views import witnessed

RAYS_A_VIEW = 200  # evenly spread over the image: a quarter of a second with 50 cameras


@torch.no_grad()
def unshared_opacity(
    renderer: Renderer,
    held_out: Tensor,
    unit_from_cam: Tensor,
    image: int,
    intrinsics: Intrinsics | None = None,
) -> float:
    """Share of the opacity rendered in a view that lies in the image of fewer than two training cameras.

    Opacity is the weights T_k alpha_k of the samples (`reference.composite`). A training camera counts where its image
    shows the point, whatever stands between: frusta, as in the visibility loss of Nerfbusters (Warburg et al. 2023).
    That requires one camera; but nothing contradicts what only one sees. 0 where nothing is rendered.

    Args:
        held_out: bool [n], images that the field was not trained on.
        unit_from_cam: [3, 4] of the view.
        image: whose lens it has, among ``intrinsics``; the run's images' where not given.
    """
    lenses = intrinsics or renderer.joint.lenses.intrinsics
    width, height = int(lenses.width[image]), int(lenses.height[image])
    stride = max(1, math.ceil(math.sqrt(width * height / RAYS_A_VIEW)))
    rows, columns = (torch.arange(stride // 2, length, stride) + 0.5 for length in (height, width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    xy = torch.stack([x, y], -1).reshape(-1, 2).to(renderer.device)
    index = torch.full((len(xy),), image, device=renderer.device)
    matrix = unit_from_cam.float().to(renderer.device).expand(len(xy), 3, 4)
    origin, direction = renderer.cast(matrix, index, xy, lenses)
    marching, field = renderer.marching, renderer.field
    t, dt, ray = reference.march(
        origin, direction, torch.full_like(xy[:, 0], 0.5), marching.occupied,
        marching.step, marching.near, marching.far, field.unbounded, marching.most,
    )  # fmt: skip
    points = origin[ray] + t[:, None] * direction[ray]
    density = field.density(reference.grid_position(points, field.unbounded))
    training = torch.nonzero(~held_out)[:, 0]
    joint = renderer.joint
    shared = witnessed(points, training, joint.poses.matrices(), joint.lenses.intrinsics)
    unshared = (~shared).float()[:, None].expand(-1, 3)
    # Composited like a colour before a black background, the share of each ray.
    shares, opacity, _ = reference.composite(density, unshared, t, dt, ray, torch.zeros_like(origin))
    return float(shares[:, 0].sum() / opacity.sum().clamp(min=1e-6))
