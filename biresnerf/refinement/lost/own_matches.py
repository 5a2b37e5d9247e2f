"""What the feature matches of a single camera say of its pose, and where they would place it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.epipolar import epipolar_angles
from biresnerf.geometry.resection import resect
from biresnerf.geometry.triangulation import parallax_deg, triangulate
from biresnerf.judging.compare import ANY_GAIN, is_better, octaves
from biresnerf.refinement.numbers.lost import LostNumbers
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.scene.scene_depth import track_rays

LEAST_PAIRS = 8  # of an image's observations with others; fewer say nothing of it
LEAST_PX = 0.05  # errors below it are equal: features are not that exact


class OwnMatches:
    """The observations of a set, and how far they are from agreeing with poses.

    Args:
        tracks: of the set.
        cameras: of each image, at full size.
    """

    def __init__(self, tracks: Tracks, cameras: Sequence[Camera]) -> None:
        intrinsics = Intrinsics.from_cameras(cameras)
        self.tracks, self.rays = tracks, track_rays(intrinsics, tracks)
        self.focal_px = ((intrinsics.fx + intrinsics.fy) / 2).numpy()

    @classmethod
    def of(cls, scene: Scene) -> OwnMatches | None:
        """The observations of a scene; None where there are none."""
        if scene.tracks is None:
            return None
        return cls(scene.tracks, [scene.dataset.camera_of(i) for i in range(len(scene.dataset))])

    def errors_px(self, world_from_cam: Array) -> Array:
        """Each camera's median epipolar error [n] with the poses [n, 4, 4], px; NaN where it has too few pairs."""
        one, other = self.tracks.pairs()
        a, b = self.tracks.image[one], self.tracks.image[other]
        angles = epipolar_angles(world_from_cam, a, b, self.rays[one], self.rays[other])
        errors = angles * (self.focal_px[a] + self.focal_px[b]) / 2
        return _medians(np.concatenate([a, b]), np.tile(errors, 2), len(self.focal_px))

    def placed(
        self, camera: int, world_from_cam: Array, trusted: NDArray[np.bool_], numbers: LostNumbers
    ) -> Array | None:
        """The camera's pose [4, 4] by points that trusted cameras [n] see, at poses [n, 4, 4]; none of those left out.

        None where too few points agree, or where its own matches do not fit the pose found better than the present one.
        """
        before = self.errors_px(world_from_cam)
        others = trusted.copy()
        others[camera] = False
        bound_px = numbers.agree * _usual(before[others])
        shared = np.zeros(self.tracks.points, dtype=np.bool_)
        shared[self.tracks.point[self.tracks.image == camera]] = True
        shared &= ~self.tracks.left_out()
        used = others[self.tracks.image] & shared[self.tracks.point]
        seen = np.bincount(self.tracks.point[used], minlength=self.tracks.points)
        used &= (seen >= 2)[self.tracks.point]
        points, row = np.unique(self.tracks.point[used], return_inverse=True)
        if len(points) == 0:
            return None
        image = self.tracks.image[used]
        directions = np.einsum("mij,mj->mi", world_from_cam[image, :3, :3], self.rays[used])
        origins = world_from_cam[image, :3, 3]
        xyz = triangulate(origins, directions, self.focal_px[image], row, len(points))
        wide = parallax_deg(origins, xyz, row) >= numbers.least_parallax_deg
        own = np.flatnonzero((self.tracks.image == camera) & np.isin(self.tracks.point, points))
        found = resect(xyz[wide], self.rays[own[wide]], bound_px / self.focal_px[camera], seed=camera)
        if found is None:
            return None
        poses = world_from_cam.copy()
        poses[camera] = found.world_from_cam
        return found.world_from_cam if better(camera, before, self.errors_px(poses)) else None


def well_matched(tracks: Tracks, count: int) -> NDArray[np.bool_]:
    """Which of `count` images have enough pairs to judge their poses."""
    pairs = np.bincount(tracks.image[np.concatenate(tracks.pairs())], minlength=count)
    return np.asarray(pairs >= LEAST_PAIRS)


def _medians(image: NDArray[np.int64], errors: Array, count: int) -> Array:
    """Median of the finite errors [m] of each of `count` images; NaN where there are too few."""
    finite = np.isfinite(errors)
    image, errors = image[finite], errors[finite]
    ordered = errors[np.lexsort((errors, image))]
    known = np.bincount(image, minlength=count)
    first, enough = np.cumsum(known) - known, known >= LEAST_PAIRS
    medians = np.full(count, np.nan)
    low, high = (first + (known - 1) // 2)[enough], (first + known // 2)[enough]
    medians[enough] = (ordered[low] + ordered[high]) / 2
    return medians


def contradicted(errors_px: Array, numbers: LostNumbers) -> NDArray[np.bool_]:
    """Cameras [n] whose own matches fit far worse than the set's, by their errors [n]."""
    return np.asarray(np.nan_to_num(errors_px) > numbers.times_usual * _usual(errors_px))


def better(camera: int, before_px: Array, after_px: Array) -> bool:
    """Whether a camera's own matches fit better after than before, by its errors [n]."""
    return is_better(octaves(before_px[camera], after_px[camera], LEAST_PX), ANY_GAIN)


def _usual(errors_px: Array) -> float:
    known = errors_px[np.isfinite(errors_px)]
    return max(float(np.median(known)), LEAST_PX) if len(known) else np.inf
