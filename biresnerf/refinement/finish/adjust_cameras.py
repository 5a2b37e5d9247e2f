"""All cameras adjusted at once, and moved where left-out evidence says that is better and photos do not object."""

from __future__ import annotations

import logging
from functools import partial

from biresnerf.refinement.finish.candidates import BY_PATCHES
from biresnerf.refinement.finish.choose_poses import choose_poses
from biresnerf.refinement.finish.lens_evidence import corrected_cameras
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.finish.photo_trial import photos_object
from biresnerf.refinement.finish.work_ahead import adjustment
from biresnerf.refinement.stages.two_stages import TwoStages
from biresnerf.refinement.start.first_step import adjusts_cameras

logger = logging.getLogger(__name__)


def adjust_cameras(stages: TwoStages, *, moves: bool = True) -> Finish:
    """Adjust all cameras at once, and where left-out evidence says that is better move them and hold them there.

    Cameras that their own matches contradict are placed by those first. Photos have the last word: nothing is moved
    where they object, by fields that are trained on them unless patches of them speak for it. Methods of others are
    left alone.

    Args:
        moves: whether cameras may move; if not, what the evidence says is only gathered.

    Raises:
        Interrupted: stopped; a continued run adjusts again.
    """
    optimiser = stages.optimiser
    if not adjusts_cameras(stages.scene.dataset, optimiser.method):
        return Finish()
    certainty = optimiser.lenses.certainty
    with stages.timed("adjusting", amount=adjustment(stages.scene)):
        if moves:
            stages.repair.place_by_matches()
        found = choose_poses(stages.scene, optimiser, partial(_announce, stages))
    if found is None:
        return Finish()
    chosen, finish, focals = found
    optimiser.lenses.be_certain(focals)
    if not moves:
        return finish
    if finish.heeds_photos:
        stages.forecast.expect({"adjusting": 0.0})  # unless photos object
    cameras, lenses = optimiser.lenses.refined(stages.scene.dataset).cameras, chosen.lenses
    if lenses is not None:
        cameras = corrected_cameras(cameras, lenses.correction) or cameras
    asked = chosen.name not in ("refined", *BY_PATCHES)
    if asked and photos_object(stages, chosen.world_from_cam, cameras):
        logger.info("the photos contradict these poses, which are not taken")
        optimiser.lenses.be_certain(certainty)
        return finish.refused()
    if chosen.name != "refined":
        stages.place(chosen.world_from_cam)
        optimiser.hold_poses()
    if lenses is not None:
        optimiser.lenses.place(stages.scene.dataset.cameras, cameras)
    return finish


def _announce(stages: TwoStages) -> None:
    stages.monitor.raise_if_stopped("stopped while the cameras were adjusted; run again to go on")
    stages.announce("adjusting all cameras at once")
