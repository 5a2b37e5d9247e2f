"""Predicts how long the parts of a run besides its steps will take, for the progress bar."""

from __future__ import annotations

from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refine.finish.photo_trial import TIMES
from biresnerf.refine.finish.rounds import FIRST_ROUND, LEARNING
from biresnerf.refine.optimise.joint_optimiser import JointOptimiser
from biresnerf.refine.scene.scene import Scene
from biresnerf.refine.stages.timing import Part, WorkAhead
from biresnerf.refine.start.first_step import adjusts_cameras
from biresnerf.refine.views.pose_trials import OPEN_STEPS

# In steps of stage 2, as measured on lego, temple, fox and fountain-P11; sets differ by a factor of two.
ADJUSTING, ADJUSTING_TRACKS, EVALUATING = 180.0, 800.0, 180.0
TRAINING = 0.55  # a step of a trial: stage 1, half of the samples, poses that stand still


def work_ahead(scene: Scene, optimiser: JointOptimiser, options: ResolvedOptions | None = None) -> WorkAhead:
    """What follows from the set and the options, the optimiser's where none are given."""
    options = options or optimiser.options
    parts: dict[Part, float] = {}
    share = 1.0
    trial = 2 * TRAINING * options.trial_steps * (OPEN_STEPS if optimiser.frame.unbounded else 1)
    if adjusts_cameras(scene.dataset, optimiser.method):
        parts["adjusting"] = ADJUSTING
        if scene.tracks is not None:  # mostly, these move the cameras, which then stand still
            parts["adjusting"] += ADJUSTING_TRACKS + TIMES * trial
            share = FIRST_ROUND + LEARNING
    parts["evaluating"] = EVALUATING
    if options.verdict:
        parts["judging"] = trial  # of several rounds the first decides mostly
    return WorkAhead(parts, share)
