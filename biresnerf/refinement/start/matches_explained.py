"""How well a set of poses explains the feature matches that were left out of the mapping."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.epipolar import epipolar_angles
from biresnerf.refinement.scene.scene_depth import track_rays

EXPLAINED_WITHIN = 0.003  # of the photo's long side: 3 px of 1000


def matches_explained(dataset: Dataset, tracks: Tracks, world_from_cam: NDArray[np.float64]) -> float:
    """Share of a photo's left-out matches whose epipolar error at poses [n, 4, 4] is small: the mean over photos.

    Photos without any count as 0. A model that folds a symmetric thing is consistent with the matches it was made of
    mostly because it leaves out the others; here these count, and so do those of cameras that it does not place.
    """
    left_out = tracks.split()[1]
    if left_out is None:
        return 0.0
    rays, allowed = _rays(dataset, left_out)
    one, other = left_out.pairs()
    a, b = left_out.image[one], left_out.image[other]
    angles = epipolar_angles(world_from_cam, a, b, rays[one], rays[other])
    fits = angles < (allowed[a] + allowed[b]) / 2  # false where the angle is not known
    photos = np.concatenate([a, b])
    known = np.bincount(photos, minlength=len(dataset))
    agree = np.bincount(photos, np.tile(fits, 2), minlength=len(dataset))
    return float((agree / np.maximum(known, 1)).mean())


def explained_from_one_place(dataset: Dataset, tracks: Tracks, world_from_cam: NDArray[np.float64]) -> float:
    """Share of the matches that rotations alone explain, as if all photos had been taken from one place."""
    rays, allowed = _rays(dataset, tracks)
    one, other = tracks.pairs()
    in_world = np.einsum("mij,mj->mi", world_from_cam[tracks.image, :3, :3], rays)
    apart = 2 * np.arcsin(np.minimum(np.linalg.norm(in_world[one] - in_world[other], axis=1) / 2, 1.0))
    return float((apart < (allowed[tracks.image[one]] + allowed[tracks.image[other]]) / 2).mean())


def _rays(dataset: Dataset, tracks: Tracks) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit directions [m, 3] of the observations, and the angles [n] that may be wrong in each photo."""
    cameras = [dataset.camera_of(i) for i in range(len(dataset))]
    intrinsics = Intrinsics.from_cameras(cameras)
    focal_px = ((intrinsics.fx + intrinsics.fy) / 2).numpy()
    allowed = EXPLAINED_WITHIN * np.array([max(c.width, c.height) for c in cameras]) / focal_px
    return track_rays(intrinsics, tracks), allowed
