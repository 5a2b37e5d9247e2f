"""The evidence for or against refined poses: unseen views after equal trainings, feature matches, motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from biresnerf.data.photos.images import ImageSet
from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera import Intrinsics, directions_in_cam, project
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.epipolar import epipolar_angles
from biresnerf.geometry.focus import focus_point
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refine.scene.scene_depth import track_rays
from biresnerf.refine.start.frozen_trials import FrozenTrials, TrialScores, joined
from biresnerf.refine.verdict.verdict import EPIPOLAR_MATTERS, PSNR_MATTERS, SSIM_MATTERS, paired
from biresnerf.refine.views.held_out_views import unseen_rounds
from biresnerf.report import EpipolarEvidence, HeldOutEvidence

Array = NDArray[np.float64]

MATCHES_OF_IMAGE = 8  # an image with fewer is not used
LEAST_MATCHED = 4  # images
LEAST_PX = 0.05  # errors below it are equal: matches are not that exact
MOTION_GRID = 5  # points across and down


@dataclass(frozen=True, eq=False)
class Rig:
    """Poses [n, 4, 4] in the input's frame and the lens of each image at full size."""

    world_from_cam: Array
    cameras: tuple[Camera, ...]

    def lenses(self, images: ImageSet) -> tuple[Camera, ...]:
        """The lenses at the photos' working size."""
        return tuple(
            camera.resized(small.width, small.height)
            for camera, small in zip(self.cameras, images.cameras, strict=True)
        )


@dataclass(frozen=True, eq=False)
class HeldOutComparison:
    """Scores of the unseen `views` after two trainings."""

    views: list[int]
    before: TrialScores
    after: TrialScores
    evidence: HeldOutEvidence


@dataclass(frozen=True, eq=False)
class EpipolarComparison:
    """Median error of each image's matches [n] (px, full size) with either rig; NaN where it has too few."""

    before: Array
    after: Array
    evidence: EpipolarEvidence


def compare_on_unseen_views(
    before: Rig,
    after: Rig,
    images: ImageSet,
    held_out: Sequence[int],
    options: ResolvedOptions,
    device: torch.device,
    threads: int,
    should_stop: Callable[[], bool],
    report: Callable[[float], None] = lambda _share: None,
) -> HeldOutComparison | None:
    """Train a field on either rig, held still, and score both on the same unseen views; None of too few images.

    Small sets are trained several times, with other views left out. ``report`` is called with the share of work done.

    Raises:
        Interrupted: ``should_stop`` returned true.
    """
    steps = options.trial_steps
    rounds = unseen_rounds(len(images), held_out, most=16)
    if steps == 0 or not rounds[0]:
        return None
    rigs = [before.world_from_cam, after.world_from_cam]
    scores: tuple[list[TrialScores], list[TrialScores]] = ([], [])
    for views in rounds:
        trials = FrozenTrials(images, views, rigs, options, steps, device, threads, should_stop)
        for side, rig in zip(scores, (before, after), strict=True):
            side.append(trials.score(rig.world_from_cam, rig.lenses(images)))
            report(sum(map(len, scores)) / (2 * len(rounds)))
    old, new = (joined(side) for side in scores)
    seen = [view for views in rounds for view in views]
    evidence = HeldOutEvidence(
        steps=trials.steps,
        strictly=len(set(seen) & set(held_out)),
        psnr=paired(old.psnr, new.psnr, PSNR_MATTERS),
        ssim=paired(old.ssim, new.ssim, SSIM_MATTERS),
    )
    return HeldOutComparison(seen, old, new, evidence)


def compare_on_matches(
    before: Rig, after: Rig, tracks: Tracks, *, independent: bool
) -> EpipolarComparison | None:
    """Each image's median epipolar error with either rig; None where too few images have matches.

    Args:
        independent: whether the rig `after` has not been made from these matches.
    """
    old, new = (_image_errors(rig, tracks) for rig in (before, after))
    known = np.isfinite(old) & np.isfinite(new)
    if known.sum() < LEAST_MATCHED:
        return None
    gains = np.log2(np.maximum(old[known], LEAST_PX) / np.maximum(new[known], LEAST_PX))
    comparison = paired(old[known], new[known], EPIPOLAR_MATTERS, gains)
    medians = {"before": float(np.median(old[known])), "after": float(np.median(new[known]))}
    sides = [max(camera.width, camera.height) for camera in after.cameras]
    evidence = EpipolarEvidence(
        matches=len(tracks.pairs()[0]),
        independent=independent,
        error_px=comparison.model_copy(update=medians),
        share_of_image=medians["after"] / float(np.median(sides)),
    )
    return EpipolarComparison(old, new, evidence)


def _image_errors(rig: Rig, tracks: Tracks) -> Array:
    intrinsics = Intrinsics.from_cameras(rig.cameras)
    rays, pairs = track_rays(intrinsics, tracks), tracks.pairs()
    (a, b), (ray_a, ray_b) = (tracks.image[side] for side in pairs), (rays[side] for side in pairs)
    focal = ((intrinsics.fx + intrinsics.fy) / 2).numpy()
    errors = epipolar_angles(rig.world_from_cam, a, b, ray_a, ray_b) * (focal[a] + focal[b]) / 2
    medians = np.full(len(rig.cameras), np.nan)
    for image in range(len(medians)):
        own = errors[((a == image) | (b == image)) & np.isfinite(errors)]
        if len(own) >= MATCHES_OF_IMAGE:
            medians[image] = np.median(own)
    return medians


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
