"""How much work a run has before it, told to its forecast, and as many steps as there is time for."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import load_images
from biresnerf.data.photos.panoramas.cut_panoramas import as_views
from biresnerf.data.workload import (
    FIRST_ROUND,
    LEARNING,
    adjustment_work,
    after_steps,
    step_weights,
    steps_share,
    workload,
)
from biresnerf.forecast.run_forecast import Forecast, Phase
from biresnerf.options.presets import FEWEST_STEPS
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.finish.photo_trial import photos_will_be_asked
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.start.first_step import adjusts_cameras

logger = logging.getLogger(__name__)

PHOTOS_LOOKED_AT, SMALL = 3, 64  # to see whether there is a background, and px
OVERDRAWN = 1.1  # times the budget: the report warns of more


def expect_run(forecast: Forecast, dataset: Dataset, recipe: Recipe) -> None:
    """All of a run, as far as it is known before its features are."""
    options = recipe.options
    few = replace(dataset, frames=dataset.frames[:PHOTOS_LOOKED_AT])
    kind = recipe.method.kinds.of(load_images(few, SMALL, options.background).background is None)
    adjusts = adjusts_cameras(as_views(dataset), recipe.method)
    work = workload(dataset, options, kind=kind, adjusts=adjusts)
    forecast.plan(work.step_weights, work.share)
    forecast.expect(work.amounts)


def expect_rest(scene: Scene, optimiser: JointOptimiser, run: RunState) -> None:
    """All of a run from where its steps begin or go on."""
    forecast = run.monitor.forecast
    forecast.leave()
    forecast.continues(sum(run.record.seconds.values()))
    adjusts = adjusts_cameras(scene.dataset, optimiser.method)
    share = steps_share(matched=scene.tracks is not None and adjusts)
    forecast.plan(step_weights(optimiser.options, kind=optimiser.schedule.kind), share)
    forecast.expect(work_ahead(scene, optimiser, run), alone=True)


def expect_as_measured(scene: Scene, optimiser: JointOptimiser, run: RunState) -> None:
    """The rest of a run on its way, as its poses and what it has done tell it now."""
    run.monitor.forecast.expect(work_ahead(scene, optimiser, run))


def work_ahead(
    scene: Scene,
    optimiser: JointOptimiser,
    run: RunState,
    options: ResolvedOptions | None = None,
    *,
    checks: bool | None = None,
) -> dict[Phase, float]:
    """What is left of a run after its first step, with other options (of its steps) if given.

    Args:
        checks: what `checks_ahead` says, where it was asked already.
    """
    kind = optimiser.schedule.kind
    options = options or optimiser.schedule.options
    step, switch = optimiser.step_index, optimiser.switch
    coarse, fine = run.steps_left(step, switch, options.steps, options.coarse_steps_max)
    weights = step_weights(options, kind=kind)
    adjusts, first = adjusts_cameras(scene.dataset, optimiser.method), not run.record.adjusted
    each = adjustment(scene) if adjusts else 0.0
    checks = checks_ahead(scene, optimiser, run) if checks is None else checks
    return {
        "coarse": coarse * weights["coarse"],
        "fine": fine * weights["fine"],
        **after_steps(options, kind, adjusting=(first + run.record.adjusts_again) * each, checks=checks),
    }


def checks_ahead(scene: Scene, optimiser: JointOptimiser, run: RunState) -> bool:
    """Whether photos will judge the adjusted cameras."""
    adjusts = adjusts_cameras(scene.dataset, optimiser.method) and not run.record.adjusted
    if not adjusts or scene.tracks is None:
        return False
    return photos_will_be_asked(scene, optimiser.joint.unit_from_cam, optimiser.method.finish.unseen_px)


def adjustment(scene: Scene) -> float:
    """Work of one adjustment of all cameras."""
    return adjustment_work(len(scene.dataset), 0 if scene.tracks is None else len(scene.tracks.point))


def keep_to_budget(
    scene: Scene, optimiser: JointOptimiser, run: RunState, started: float, steps_asked: int
) -> None:
    """Let a run that started at this `time.monotonic` end within its budget; predict its end if it has none.

    What it took before it was interrupted counts.
    """
    seconds = optimiser.options.time_budget_s
    if not seconds:
        run.keep_to(partial(expect_as_measured, scene, optimiser, run))
        return
    ends = started + (1 - optimiser.method.finish.writing) * seconds - sum(run.record.seconds.values())
    run.keep_to(partial(choose_steps, scene, optimiser, run, steps_asked), ends)


def budget_warnings(budget_s: float, spent: Mapping[str, float]) -> tuple[str, ...]:
    """A warning where the parts of a run took longer than it was to."""
    total = sum(spent.values())
    if not budget_s or total <= OVERDRAWN * budget_s:
        return ()
    return (
        f"The run took {total:.0f} s of a budget of {budget_s:g} s, {spent.get('preparing', 0.0):.0f} s of them "
        "before the first step. Give it more time, or fewer or smaller photos.",
    )


def choose_steps(scene: Scene, optimiser: JointOptimiser, run: RunState, most: int) -> None:
    """Leave a run as many steps as there is time for, `most` in all; fewer where poses stand still from now on."""
    before = optimiser.schedule.steps
    high = max(FEWEST_STEPS, round((FIRST_ROUND + LEARNING) * most)) if optimiser.poses_held else most
    low = min(
        high, max(optimiser.step_index, round(optimiser.method.finish.least_steps * most), FEWEST_STEPS)
    )
    left_s, checks = run.left_s, checks_ahead(scene, optimiser, run)

    def needed_s(steps: int) -> float:
        options = optimiser.options.with_steps(steps) if optimiser.switch is None else optimiser.options
        options = options.model_copy(update={"steps": steps})
        return run.monitor.forecast.left_s(work_ahead(scene, optimiser, run, options, checks=checks))

    while low < high:
        steps = (low + high + 1) // 2
        if needed_s(steps) <= left_s:
            low = steps
        else:
            high = steps - 1
    if low != before:
        logger.debug("%d steps in place of %d: %.0f s left", low, before, left_s)
        optimiser.set_steps(low)
    expect_as_measured(scene, optimiser, run)
