"""Whether photos support the poses that cameras were adjusted to."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.workload import PHOTO_TRIALS, photo_check
from biresnerf.geometry.similarity import align_robust
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.parameters.joint_parameters import JointParameters
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.views.compare_rigs import Effort, Rig, compare_on_unseen_views, moved_px

logger = logging.getLogger(__name__)


def photos_will_be_asked(scene: Scene, present: NDArray[np.float64], unseen_px: float) -> bool:
    """Whether photos will have to judge the adjusted cameras, as far as the present poses tell.

    Cameras that are adjusted to tracks end near those that matches placed: where the present ones are as near, photos
    do not distinguish them. True if unknown.
    """
    matched = scene.start.matched_poses
    if matched is None or not (np.isfinite(matched).all() and np.isfinite(present).all()):
        return True
    lenses = tuple(scene.dataset.camera_of(i) for i in range(len(scene.dataset)))
    carried = align_robust(matched, present, with_rotations=True).apply_to_poses(matched)
    return moved_px(Rig(present, lenses), Rig(carried, lenses), scene.images) >= unseen_px


def photos_object(scene: Scene, joint: JointParameters, recipe: Recipe, run: RunState, other: Rig) -> bool:
    """Whether fields trained at other poses predict unseen views less well than at the present ones.

    The feature matches of a symmetric thing may agree on poses that are wrong. SSIM is ignored: on small photos it
    prefers poses fitted to them over true ones. Nothing is trained where the poses are too near for photos to tell.

    Raises:
        Interrupted: stopped.
    """
    refined = joint.lenses.refined(scene.dataset)
    present = Rig(joint.unit_from_cam, tuple(refined.camera_of(i) for i in range(len(refined))))
    moved = moved_px(present, other, scene.images)
    if moved < recipe.method.finish.unseen_px:
        logger.info("the adjusted cameras moved by %.2f px, which photos do not show", moved)
        return False
    run.announce("checking the adjusted cameras by the photos")
    work = photo_check(
        recipe.options, kind=recipe.method.kinds.of(joint.frame.unbounded)
    )  # known by now, if not before
    forecast = run.monitor.forecast
    with run.timed("adjusting", "checking", work):
        found = compare_on_unseen_views(
            (present, other), scene.images, scene.held_out, ~scene.start.guessed, recipe,
            run.monitor.should_stop, forecast.advance, Effort(PHOTO_TRIALS, rounds_most=1, looks=(1.0,)),
        )  # fmt: skip
        forecast.took(found.work if found else 0.0)
    if found is None:
        return False
    psnr = found.evidence.psnr
    logger.info("unseen views: %.2f dB, adjusted by %.2f px %.2f dB", psnr.before, moved, psnr.after)
    return psnr.finding == "worse"
