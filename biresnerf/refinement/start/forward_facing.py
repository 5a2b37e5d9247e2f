"""A start from no poses at all, for photos that look the same way: all cameras at one place, and two tries.

From one place the optimisation finds small baselines by itself (Lin et al. 2021, BARF, section 4.2). But a small
baseline leaves a scene and its mirror image in depth nearly alike (the bas-relief ambiguity), so both are tried, and
the one that predicts unseen photos better is kept. Cameras around a scene cannot be found this way; unseen photos
show it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.photos.images import ImageSet
from biresnerf.errors import InputError
from biresnerf.geometry.rigid import motion_of
from biresnerf.geometry.similarity import nearest_rotation
from biresnerf.judging.compare import is_better
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.scene.scene_frame import scene_frame
from biresnerf.refinement.views.evaluation import score_views
from biresnerf.refinement.views.pose_trials import Trial, trial_views

logger = logging.getLogger(__name__)

MIRROR = np.diag([1.0, 1.0, -1.0])


def find_forward_facing(
    world_from_cam: NDArray[np.float64],
    images: ImageSet,
    recipe: Recipe,
    should_stop: Callable[[], bool],
) -> NDArray[np.float64]:
    """Poses [n, 4, 4] of photos taken from nearly one place, in a frame of their own.

    Args:
        world_from_cam: where they begin [n, 4, 4]: at one place, turned as the cameras were held.

    Raises:
        InputError: ``insufficient_overlap``: no poses were found that predict unseen photos.
        Interrupted: ``should_stop`` returned true.
    """
    frame = scene_frame(np.tile(np.eye(4), (len(images), 1, 1)), images, recipe.method.scene)
    numbers, unseen = recipe.method.start, trial_views(len(images), recipe.method.views)

    def run(world_from_cam: NDArray[np.float64], steps: int) -> tuple[NDArray[np.float64], float]:
        """Poses after stage 1 alone, and mean PSNR of views that move their own pose, but do not train the field."""
        short = recipe.apart(steps, (steps // 4, steps), numbers.facing_samples)
        poses = frame.unit_from_world.apply_to_poses(world_from_cam)
        optimiser = JointOptimiser(images, frame, poses, short, unseen)
        Trial(optimiser, images, unseen, steps, should_stop).train(1.0)
        psnr = float(np.mean([score.psnr for score in score_views(optimiser.renderer, images, unseen)]))
        return frame.unit_from_world.inverse().apply_to_poses(optimiser.poses.poses().numpy()), psnr

    first, _ = run(world_from_cam, numbers.facing_first_steps)
    tries = [run(rig, numbers.facing_second_steps) for rig in (first, mirrored(first))]
    logger.info("forward-facing: %.2f dB, mirrored in depth %.2f dB", tries[0][1], tries[1][1])
    best, psnr = max(tries, key=lambda found: found[1])
    bound = resemblance_psnr(images, unseen)
    if not is_better(psnr - bound, recipe.method.kinds.of(frame.unbounded).facing_forward):
        raise InputError(
            "insufficient_overlap",
            f"no poses were found that explain the photos: a scene built from some predicts others at {psnr:.1f} "
            f"dB, the mere mean of similar photos at {bound:.1f} dB.",
            hint="Photos from all around need features that match, or approximate poses; without either, only photos "
            "that look the same way, from nearly one place, can be used, or of something that turned: start=turntable.",
        )
    return best


def mirrored(world_from_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rig [n, 4, 4] to which a scene of reversed depth looks the same, but for perspective.

    A camera that goes round the scene by some angle sees what one that goes round by the opposite angle sees of the
    mirror image. So, in the frame of the mean pose, turns across the viewing direction are reversed, and with them
    the centres' offsets across it.
    """
    mean = motion_of(nearest_rotation(world_from_cam[:, :3, :3].mean(0)), world_from_cam[:, :3, 3].mean(0))
    in_mean = np.linalg.inv(mean) @ world_from_cam
    in_mean[:, :3, :3] = MIRROR @ in_mean[:, :3, :3] @ MIRROR
    in_mean[:, :2, 3] *= -1
    result: NDArray[np.float64] = mean @ in_mean
    return result


def resemblance_psnr(images: ImageSet, views: list[int]) -> float:
    """How well (dB, mean over views) each view is predicted, pixel by pixel, by the mean of other photos like it.

    Of the 1, 2, 4, ... most like it, whichever number does best; 0 where photos differ in size.
    """
    if len({images.image(i).shape for i in range(len(images))}) > 1:
        return 0.0
    photos = np.stack([images.image(i).reshape(-1).astype(np.float32) / 255 for i in range(len(images))])
    best = []
    for view in views:
        errors = ((photos - photos[view]) ** 2).mean(1)
        others = [i for i in np.argsort(errors, kind="stable") if i != view]
        counts = [2**k for k in range(len(others).bit_length())]
        means = [((photos[others[:count]].mean(0) - photos[view]) ** 2).mean() for count in counts]
        best.append(-10 * np.log10(max(float(min(means)), 1e-12)))
    return float(np.mean(best))
