"""How much work a run has before it, told to its forecast."""

from __future__ import annotations

from dataclasses import replace

from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.images import load_images
from biresnerf.data.photos.panoramas.cut_panoramas import as_views
from biresnerf.data.workload import ADJUSTMENT, after_steps, step_weights, steps_share, workload
from biresnerf.forecast.run_forecast import Forecast, Phase
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.finish.photo_trial import photos_will_be_asked
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.two_stages import TwoStages
from biresnerf.refinement.start.first_step import adjusts_cameras

PHOTOS_LOOKED_AT, SMALL = 3, 64  # to see whether there is a background, and px


def expect_run(forecast: Forecast, dataset: Dataset, recipe: Recipe) -> None:
    """All of a run, as far as it is known before its features are."""
    options = recipe.options
    few = replace(dataset, frames=dataset.frames[:PHOTOS_LOOKED_AT])
    unbounded = load_images(few, SMALL, options.background).background is None
    adjusts = adjusts_cameras(as_views(dataset), recipe.method)
    work = workload(dataset, options, unbounded=unbounded, adjusts=adjusts)
    forecast.plan(work.step_weights, work.share)
    forecast.expect(work.amounts)


def expect_rest(stages: TwoStages) -> None:
    """All of a run from where its steps begin or go on."""
    forecast, optimiser = stages.forecast, stages.optimiser
    forecast.leave()
    forecast.continues(sum(stages.record.seconds.values()))
    adjusts = adjusts_cameras(stages.scene.dataset, optimiser.method)
    share = steps_share(matched=stages.scene.tracks is not None and adjusts)
    forecast.plan(step_weights(optimiser.options, unbounded=optimiser.frame.unbounded), share)
    forecast.expect(work_ahead(stages), alone=True)


def expect_as_measured(stages: TwoStages) -> None:
    """The rest of a run on its way, as its poses and what it has done tell it now."""
    stages.forecast.expect(work_ahead(stages))


def work_ahead(
    stages: TwoStages, options: ResolvedOptions | None = None, *, checks: bool | None = None
) -> dict[Phase, float]:
    """What is left of a run after its first step, with other options (of its steps) if given.

    Args:
        checks: what `checks_ahead` says, where it was asked already.
    """
    scene, optimiser = stages.scene, stages.optimiser
    unbounded = optimiser.frame.unbounded
    steps = optimiser.schedule.steps if options is None else options.steps
    options = options or optimiser.options
    coarse, fine = stages.steps_left(steps, options.coarse_steps_max)
    weights = step_weights(options, unbounded=unbounded)
    adjusts, first = adjusts_cameras(scene.dataset, optimiser.method), not stages.record.adjusted
    each = adjustment(scene) if adjusts else 0.0
    checks = checks_ahead(stages) if checks is None else checks
    return {
        "coarse": coarse * weights["coarse"],
        "fine": fine * weights["fine"],
        **after_steps(
            options, unbounded, adjusting=(first + stages.record.adjusts_again) * each, checks=checks
        ),
    }


def checks_ahead(stages: TwoStages) -> bool:
    """Whether photos will judge the adjusted cameras."""
    scene = stages.scene
    adjusts = adjusts_cameras(scene.dataset, stages.optimiser.method) and not stages.record.adjusted
    return adjusts and scene.tracks is not None and photos_will_be_asked(stages)


def adjustment(scene: Scene) -> float:
    """Work of one adjustment of all cameras."""
    return ADJUSTMENT + (0.0 if scene.tracks is None else len(scene.tracks.point) / 1000)
