"""The rays of matched points, and how far away the points are: for rigs whose axes do not meet."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam
from biresnerf.geometry.epipolar import epipolar_angles, match_depths
from biresnerf.refinement.numbers.scene import FrameNumbers


def track_rays(intrinsics: Intrinsics, tracks: Tracks) -> NDArray[np.float64]:
    """Direction of each observation in the axes of its camera, float64 [m, 3], of length 1.

    Args:
        intrinsics: of all images of the set, at full size.
    """
    image, xy = torch.from_numpy(tracks.image.copy()), torch.from_numpy(tracks.xy.copy())
    rays: NDArray[np.float64] = directions_in_cam(intrinsics, image, xy).numpy()
    return rays


def matched_depth(
    dataset: Dataset, world_from_cam: NDArray[np.float64], tracks: Tracks | None, numbers: FrameNumbers
) -> float | None:
    """Median depth of tracked points in front of the cameras at poses [n, 4, 4], in their unit.

    None where too few observations agree with the poses, or all points are too far away for the rig's width.
    """
    if tracks is None:
        return None
    intrinsics = Intrinsics.from_cameras([dataset.camera_of(i) for i in range(len(dataset))])
    rays, pairs = track_rays(intrinsics, tracks), tracks.pairs()
    (a, b), (ray_a, ray_b) = (tracks.image[side] for side in pairs), (rays[side] for side in pairs)
    errors = np.degrees(epipolar_angles(world_from_cam, a, b, ray_a, ray_b))
    world_a = np.einsum("mij,mj->mi", world_from_cam[a, :3, :3], ray_a)
    world_b = np.einsum("mij,mj->mi", world_from_cam[b, :3, :3], ray_b)
    parallax = np.degrees(
        np.arctan2(np.linalg.norm(np.cross(world_a, world_b), axis=1), (world_a * world_b).sum(1))
    )
    depths = match_depths(world_from_cam, a, b, ray_a, ray_b)
    usable = (errors < numbers.agree_deg) & (parallax > numbers.pair_parallax_deg) & (depths > 0).all(1)
    return float(np.median(depths[usable])) if usable.sum() >= numbers.pairs else None
