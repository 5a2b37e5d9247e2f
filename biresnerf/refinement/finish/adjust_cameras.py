"""Adjust all cameras at once, and move them where left-out evidence supports that and photos do not object."""

from __future__ import annotations

import logging

import torch

from biresnerf.refinement.finish.candidates import BY_PATCHES
from biresnerf.refinement.finish.choose_poses import choose_poses
from biresnerf.refinement.finish.gather_evidence import gather_evidence
from biresnerf.refinement.finish.lens_evidence import corrected_cameras
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.finish.photo_trial import photos_object
from biresnerf.refinement.finish.work_ahead import adjustment
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.optimise.renderer import Renderer
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.start.first_step import adjusts_cameras
from biresnerf.refinement.views.compare_rigs import Rig

logger = logging.getLogger(__name__)


def adjust_cameras(
    scene: Scene,
    renderer: Renderer,
    recipe: Recipe,
    run: RunState,
    repair: LostCameraRepair,
    *,
    moves: bool = True,
) -> Finish:
    """Adjust all cameras at once, and move them where left-out evidence supports that; they are held there.

    Cameras that their own matches contradict are placed by those first. Photos have the last word: nothing is moved if
    they object, judged by fields trained on them unless patches of them support the move. Other methods are left alone.

    Args:
        moves: whether cameras may move; if not, the evidence is only gathered.

    Raises:
        Interrupted: stopped; a continued run adjusts again.
    """
    if not adjusts_cameras(scene.dataset, recipe.method):
        return Finish()
    joint, of_lenses = renderer.joint, renderer.joint.lenses
    certainty = of_lenses.certainty

    def announce() -> None:
        run.monitor.raise_if_stopped("stopped while the cameras were adjusted; run again to go on")
        run.announce("adjusting all cameras at once")

    with run.timed("adjusting", amount=adjustment(scene)):
        if moves:
            repair.place_by_matches()
        placed, numbers = repair.camera_errors.placed, recipe.method.evidence
        gathered = gather_evidence(scene, renderer, recipe.options, placed, numbers)
        found = choose_poses(scene, joint, gathered, recipe.options, announce)
    if found is None:
        return Finish()
    chosen, finish, focals = found
    of_lenses.be_certain(focals)
    if not moves:
        return finish
    if finish.moved:
        run.monitor.forecast.expect({"adjusting": 0.0})  # unless photos object
    cameras, lenses = of_lenses.refined(scene.dataset).cameras, chosen.lenses
    if lenses is not None:
        cameras = corrected_cameras(cameras, lenses.correction) or cameras
    asked = chosen.name not in ("refined", *BY_PATCHES)
    rig = Rig(chosen.world_from_cam, tuple(cameras[frame.camera] for frame in scene.dataset.frames))
    if asked and photos_object(scene, joint, recipe, run, rig):
        logger.info("the photos contradict these poses, which are not taken")
        of_lenses.be_certain(certainty)
        return finish.refused()
    if chosen.name != "refined":
        joint.poses.place(torch.from_numpy(chosen.world_from_cam))
    if lenses is not None:
        of_lenses.place(scene.dataset.cameras, cameras)
    return finish
