"""How far two sets of poses of the same photos are apart, as the photos see it."""

from __future__ import annotations

import numpy as np
import torch

from biresnerf.data.photos.images import ImageSet
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project
from biresnerf.geometry.focus import focus_point
from biresnerf.refinement.views.compare_rigs import Rig

MOTION_GRID = 5  # points across and down


def moved_px(before: Rig, after: Rig, images: ImageSet) -> float:
    """How far the scene moves in the image (px, working size) between two rigs in one frame: median over cameras.

    Looked at are points of a grid over each image, as far as the point that the rig `before` looks at; each camera
    counts with their mean, and no point with more than the image's long side.
    """
    n = len(images)
    old, new = (Intrinsics.from_cameras(rig.lenses(images)) for rig in (before, after))
    focus = focus_point(before.world_from_cam)
    towards = (focus.point - before.world_from_cam[:, :3, 3]) * before.world_from_cam[:, :3, 2]
    depth = np.where(towards.sum(1) > 0, towards.sum(1), focus.mean_distance)
    steps = (torch.arange(MOTION_GRID, dtype=torch.float64) + 0.5) / MOTION_GRID
    share = torch.cartesian_prod(steps, steps).repeat(n, 1)
    index = torch.arange(n).repeat_interleave(MOTION_GRID**2)
    xy = share * torch.stack([old.width, old.height], 1)[index]
    rays = directions_in_cam(old, index, xy).numpy()
    i = index.numpy()
    in_cam = rays * depth[i][:, None]
    world = (
        np.einsum("mij,mj->mi", before.world_from_cam[i, :3, :3], in_cam) + before.world_from_cam[i, :3, 3]
    )
    seen = np.einsum("mji,mj->mi", after.world_from_cam[i, :3, :3], world - after.world_from_cam[i, :3, 3])
    moved = (project(new, index, torch.from_numpy(seen)) - xy).norm(dim=1).numpy().reshape(n, -1)
    most = np.maximum(images.widths, images.heights)[:, None].astype(np.float64)
    return float(np.median(np.fmin(moved, most).mean(1)))
