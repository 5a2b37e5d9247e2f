"""Which initial poses to start from: the given ones, or those that feature matches support, as the photos decide.

The trial is short and treats all candidates alike: see `biresnerf.refinement.views.pose_trials`. It ends once photos
and left-out feature matches agree.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import ImageSet
from biresnerf.data.points.tracks import Tracks
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.data.workload import LOOKS, TRIAL_STEPS
from biresnerf.judging.compare import CLEAR_TRIAL, TRIAL, is_better
from biresnerf.progress import Monitor, Progress
from biresnerf.refinement.numbers.choosing import StartNumbers
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.start.forward_facing import find_forward_facing
from biresnerf.refinement.start.matches_explained import matches_explained
from biresnerf.refinement.start.turntable import start_on_turntable
from biresnerf.refinement.views.pose_trials import PoseTrials, Trial, trial_views
from biresnerf.report import TrialReport

logger = logging.getLogger(__name__)


def find_start(
    candidates: Sequence[InitialPoses],
    dataset: Dataset,
    images: ImageSet,
    tracks: Tracks | None,
    recipe: Recipe,
    monitor: Monitor,
) -> InitialPoses:
    """The candidate that predicts unseen photos best; poses found without features where the set has no others.

    Raises:
        InputError: ``insufficient_overlap``, see `find_forward_facing` and `start_on_turntable`.
        Interrupted: ``monitor`` asked to stop.
    """
    first = candidates[0]
    if first.source in ("forward-facing", "turntable"):
        message = "looking for poses without features"
        monitor.report(Progress(stage="seeding", message=message))
        if first.source == "turntable":
            return start_on_turntable(first, images, recipe, monitor.should_stop)
        found = find_forward_facing(first.world_from_cam, images, recipe, monitor.should_stop)
        return replace(first, world_from_cam=found)
    if len(candidates) == 1:
        return replace(first, matched_poses=first.world_from_cam if first.matched.any() else None)
    message = f"trying {len(candidates)} sets of poses"
    monitor.report(Progress(stage="seeding", message=message))
    explained = [
        0.0 if tracks is None else matches_explained(dataset, tracks, candidate.world_from_cam)
        for candidate in candidates
    ]
    with monitor.forecast.within("trying"):
        return choose_start(candidates, images, explained, recipe, monitor.should_stop, monitor.forecast.took)


def choose_start(
    candidates: Sequence[InitialPoses],
    images: ImageSet,
    explained: Sequence[float],
    recipe: Recipe,
    should_stop: Callable[[], bool],
    did: Callable[[float], None] = lambda _work: None,
) -> InitialPoses:
    """The candidate whose poses let a field predict unseen views best, unmoved or after some steps.

    Where that is not decided with the poses fixed, they move with the field: those near the truth improve, those of a
    wrong model do not. On a tie after that, too, the first one is kept. Cameras that all candidates guess are ignored.

    Args:
        explained: what `matches_explained` says of each candidate.
        did: called with the work of all trainings.

    Raises:
        Interrupted: ``should_stop`` returned true.
    """
    placed = np.flatnonzero(~np.logical_and.reduce([candidate.guessed for candidate in candidates]))
    if len(placed) < len(images):
        images = images.of(placed)
    rigs = [candidate.world_from_cam[placed] for candidate in candidates]
    unseen = trial_views(len(images), recipe.method.views)

    def begun(steps: int, *, moving: bool) -> list[Trial]:
        trials = PoseTrials(images, unseen, rigs, recipe, steps, should_stop)
        return [trials.begin(rig, moving=moving) for rig in rigs]

    work, numbers = 0.0, recipe.method.start
    for steps, moving in ((TRIAL_STEPS, False), (numbers.moving_steps, True)):
        running = begun(steps, moving=moving)
        scores = _scores_when_decided(running, explained, numbers)
        work += sum(trial.work for trial in running)
        if _decided(scores, explained, numbers):
            break
    did(work)
    best = int(np.argmax(scores))
    if not is_better(scores[best] - scores[0], TRIAL):
        best = 0
    trials = tuple(
        TrialReport(source=c.source, placed=int(c.matched.sum()), psnr=s)
        for c, s in zip(candidates, scores, strict=True)
    )
    chosen = candidates[best]
    matched = [i for i, candidate in enumerate(candidates) if candidate.matched.any()]
    likeliest = candidates[max(matched, key=lambda i: scores[i])].world_from_cam if matched else None
    tried = (
        f"{t.source} {t.psnr:.2f} dB, {share:.0%} of left-out matches explained"
        for t, share in zip(trials, explained, strict=True)
    )
    logger.info("start: %s of %s", chosen.source, "; ".join(tried))
    return replace(chosen, trials=trials, matched_poses=likeliest)


def _scores_when_decided(
    running: Sequence[Trial], explained: Sequence[float], numbers: StartNumbers
) -> list[float]:
    """Mean PSNR of each at the first of the `LOOKS` that decides, else at the end."""
    for look in LOOKS:
        for trial in running:
            trial.train(look)
        scores = [float(trial.scores().psnr.mean()) for trial in running]
        if _decided(scores, explained, numbers):
            break
    return scores


def _decided(scores: Sequence[float], explained: Sequence[float], numbers: StartNumbers) -> bool:
    """Whether the best is clearly so, or photos prefer it to all that leave matches unexplained, and it does not."""
    first, second = sorted(scores, reverse=True)[:2]
    if is_better(first - second, CLEAR_TRIAL):
        return True
    if explained[int(np.argmax(scores))] < numbers.explains:
        return False
    others = [score for score, share in zip(scores, explained, strict=True) if share < numbers.explains]
    return is_better(first - max(others, default=-np.inf), TRIAL)
