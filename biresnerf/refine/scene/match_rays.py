"""Viewing directions of matched points."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.points.feature_matches import FeatureMatches
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam


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
