"""The rays of matched points, and how far away the points are: for rigs whose axes do not meet."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.points.feature_matches import FeatureMatches
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam
from biresnerf.geometry.epipolar import epipolar_angles, match_depths

AGREE_DEG = 1.0  # a match whose epipolar error is larger is not used: either it or the poses are wrong
LEAST_PARALLAX_DEG = 1.0  # between the rays of a match; below, noise makes the depth
LEAST_MATCHES = 30


def match_rays(
    intrinsics: Intrinsics, matches: FeatureMatches
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions in the first and the second camera of each match, float64 [m, 3] each, of length 1.

    Args:
        intrinsics: of all images of the set, at full size.
    """
    first, second = (
        directions_in_cam(intrinsics, torch.from_numpy(image.copy()), torch.from_numpy(xy.copy())).numpy()
        for image, xy in zip(matches.images.T, matches.xy.transpose(1, 0, 2), strict=True)
    )
    return first, second


def matched_depth(
    dataset: Dataset, world_from_cam: NDArray[np.float64], matches: FeatureMatches | None
) -> float | None:
    """Median depth of matched points in front of the cameras at poses [n, 4, 4], in their unit.

    None where too few matches agree with the poses, or all points are too far away for the rig's width.
    """
    if matches is None:
        return None
    intrinsics = Intrinsics.from_cameras([dataset.camera_of(i) for i in range(len(dataset))])
    a, b = matches.images.T
    ray_a, ray_b = match_rays(intrinsics, matches)
    errors = np.degrees(epipolar_angles(world_from_cam, a, b, ray_a, ray_b))
    world_a = np.einsum("mij,mj->mi", world_from_cam[a, :3, :3], ray_a)
    world_b = np.einsum("mij,mj->mi", world_from_cam[b, :3, :3], ray_b)
    parallax = np.degrees(
        np.arctan2(np.linalg.norm(np.cross(world_a, world_b), axis=1), (world_a * world_b).sum(1))
    )
    depths = match_depths(world_from_cam, a, b, ray_a, ray_b)
    usable = (errors < AGREE_DEG) & (parallax > LEAST_PARALLAX_DEG) & (depths > 0).all(1)
    return float(np.median(depths[usable])) if usable.sum() >= LEAST_MATCHES else None
