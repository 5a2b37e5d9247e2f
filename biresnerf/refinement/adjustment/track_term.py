"""Tracks as a term of the adjustment: reprojections of points that are eliminated."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.arrays import Array
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam
from biresnerf.geometry.triangulation import triangulate
from biresnerf.refinement.adjustment.cameras import Cameras, lens_rows
from biresnerf.refinement.adjustment.kernels.tracks import (
    settle_points,
    track_cost,
    track_errors,
    track_system,
)
from biresnerf.refinement.adjustment.lens.fisheyes import with_corrections
from biresnerf.refinement.adjustment.solver.blocks import Blocks
from biresnerf.refinement.adjustment.solver.in_parts import in_parts
from biresnerf.refinement.adjustment.solver.term import Linearised
from biresnerf.refinement.adjustment.tangent_views import TangentViews

# Residuals of this many noise levels have lost three quarters of their weight: what is beyond is taken to be wrong.
ROBUST_SCALE = 3.0
RAYLEIGH_MEDIAN = 1.1774  # of the length of two normal deviates
FINEST_PX = 1e-3  # no feature is as exact: a lower noise level only makes the numbers worse
SETTLING = 30
APART = np.radians(
    0.1
)  # between two rays: with less, they do not locate their point, and fit it wherever it is


class TrackTerm:
    """Reprojection residuals in px of the full-size photos, as if lenses had no distortion.

    Args:
        cameras: where points are triangulated first.
        noise_px: where it is known; else it is measured.

    Attributes:
        unknowns: the points [p, 3] in the world.
        noise_px: standard deviation of either coordinate of an observation.
        known, place: inverse covariances [p, 3, 3] of points about where they are known to be [p, 3]; zero.
    """

    def __init__(
        self, tracks: Tracks, intrinsics: Intrinsics, cameras: Cameras, noise_px: float | None = None
    ) -> None:
        self.image = np.ascontiguousarray(tracks.image, dtype=np.int64)
        self.xy = np.ascontiguousarray(tracks.xy, dtype=np.float64)
        self.point = np.asarray(tracks.point, dtype=np.int64)
        count = int(self.point[-1]) + 1 if len(self.point) else 0
        self.start = np.searchsorted(self.point, np.arange(count + 1)).astype(np.int64)
        self.lens = lens_rows(intrinsics, cameras)
        self._given_noise = noise_px
        self.noise_px = 1.0 if noise_px is None else noise_px
        self._intrinsics = intrinsics
        self._views: tuple[Cameras, TangentViews] | None = None
        self._tied: Blocks | None = None
        now = with_corrections(intrinsics, cameras.lens_of, cameras.lens)
        rays = directions_in_cam(now, torch.from_numpy(self.image), torch.from_numpy(self.xy)).numpy()
        flat = ~intrinsics.fisheye.numpy()[self.image]
        rays[flat] = cameras.rays_of(self.image[flat], rays[flat] / rays[flat, 2:])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        world = np.einsum("mij,mj->mi", cameras.rotation[self.image], rays)
        focal = np.sqrt(self.lens[:, 0] * self.lens[:, 1])[self.image]
        self.unknowns = triangulate(cameras.centre[self.image], world, focal, self.point, count)
        self.known, self.place = np.zeros((count, 3, 3)), np.zeros((count, 3))

    def errors_px(self, cameras: Cameras) -> Array:
        """Length of the residual of each observation [m], px; infinite where it is not in front."""
        squared = np.empty(len(self.image))
        track_errors(*self._seen(cameras, self.unknowns), squared)
        return np.sqrt(squared)

    def inliers(self, cameras: Cameras) -> NDArray[np.bool_]:
        """Which observations [m] are within the robust scale."""
        return np.asarray(self.errors_px(cameras) < ROBUST_SCALE * self.noise_px)

    def measure(self, cameras: Cameras) -> float:
        self.settle(cameras)
        if self._given_noise is not None:
            return 0.0
        before, self.noise_px = self.noise_px, self._measured_noise(cameras)
        self.settle(cameras)
        return abs(self.noise_px / before - 1)

    def settle(self, cameras: Cameras) -> None:
        """Move points to where they fit best, with cameras fixed."""
        in_parts(
            lambda part: settle_points(
                *self._seen(cameras, self.unknowns, part),
                self.known[part],
                self.place[part],
                self.noise_px,
                ROBUST_SCALE,
                SETTLING,
            ),
            len(self.unknowns),
        )

    def _measured_noise(self, cameras: Cameras) -> float:
        """The noise by the median residual, corrected for the degrees of freedom of points and cameras.

        Only points seen from different places count: copies of a photo, and photos from a tripod, fit exactly.
        """
        errors, apart = self.errors_px(cameras), self._seen_from_apart(cameras)
        if apart.any():
            errors = errors[apart[self.point]]
        points, images = (
            (int(apart.sum()), self.image[apart[self.point]]) if apart.any() else (len(apart), self.image)
        )
        known = 2 * len(errors)
        free = known - 3 * points - 6 * len(np.unique(images)) + 7
        if free <= 0:
            return self.noise_px
        noise = float(np.median(errors)) / RAYLEIGH_MEDIAN * (known / free) ** 0.5
        return max(noise, FINEST_PX) if np.isfinite(noise) else self.noise_px

    def _seen_from_apart(self, cameras: Cameras) -> NDArray[np.bool_]:
        """Points [p] whose viewing rays differ in direction."""
        towards = self.unknowns[self.point] - cameras.centre[self.image]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-300)
        count = len(self.unknowns)
        total = np.stack([np.bincount(self.point, one, count) for one in towards.T], 1)
        mean: Array = total / np.maximum(np.bincount(self.point, minlength=count), 1)[:, None]
        return np.asarray(1 - (mean**2).sum(1) > np.sin(APART / 2) ** 2)

    def cost(self, cameras: Cameras, unknowns: Array) -> float:
        seen = self._seen(cameras, unknowns)
        return float(track_cost(*seen, self.known, self.place, self.noise_px, ROBUST_SCALE))

    def linearise(self, cameras: Cameras, damping: float) -> Linearised:
        rows, parts = cameras.rows(self.image), cameras.parts(self.image)
        mixed, fixed = np.zeros((*rows.shape, 3)), (self.noise_px, ROBUST_SCALE, damping)
        if self._tied is None:
            self._tied = Blocks.tied(cameras, self.start, parts)
        tied = self._tied

        def linearised(points: slice) -> tuple[Blocks, Array, tuple[Array, Array]]:
            system, right = tied.zero, np.zeros(cameras.unknowns)
            seen = (*self._seen(cameras, self.unknowns, points), self.known[points], self.place[points])
            at = rows, parts, cameras.offsets
            return system, right, track_system(*seen, *at, *fixed, system.arrays, right, mixed)

        found = in_parts(linearised, len(self.unknowns))
        inverses, gradients = (np.concatenate(each) for each in zip(*(one[2] for one in found), strict=True))
        system, right = sum((one[0] for one in found), tied), np.sum([one[1] for one in found], axis=0)
        return Linearised(system, right, (inverses, gradients, mixed, rows))

    def stepped(self, linearised: Linearised, motion: Array) -> Array:
        inverses, gradients, mixed, rows = linearised.back
        moved = np.einsum("mab,ma->mb", mixed, motion[rows])
        count = len(self.unknowns)
        force = gradients + np.stack([np.bincount(self.point, one, count) for one in moved.T], 1)
        return self.unknowns - np.einsum("pab,pb->pa", inverses, force)

    def _seen(
        self, cameras: Cameras, points: Array, taken: slice | None = None
    ) -> tuple[NDArray[np.generic], ...]:
        """The arrays that all kernels read, for all points [p, 3] or a part of them."""
        taken = taken or slice(0, len(points))
        start = self.start[taken.start : taken.stop + 1]
        lens = cameras.lens_rows(self.lens)
        if not self._intrinsics.some_fisheye:
            return cameras.rotation, cameras.centre, lens, points[taken], start, self.image, self.xy
        views = self._tangent_views(cameras)
        rotation, centre, lens, view = views.seen(cameras, lens)
        return rotation, centre, lens, points[taken], start, view, views.xy

    def _tangent_views(self, cameras: Cameras) -> TangentViews:
        """The tangent views of the present lenses; the last ones are cached."""
        kept = self._views
        if kept is None or not kept[0].same_lenses(cameras):
            near = self.lens[:, 4]
            kept = cameras, TangentViews.looking_at(self.xy, self.image, self._intrinsics, near, cameras)
            self._views = kept
        return kept[1]
