"""How much work is left in a run, reported to its forecast, and how many steps there is time for."""

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
from biresnerf.options.refine_options import RefineOptions, ResolvedOptions
from biresnerf.refinement.finish.photo_trial import photos_will_be_asked
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from biresnerf.refinement.optimise.methods import Recipe
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.start.first_step import adjusts_cameras

logger = logging.getLogger(__name__)

PHOTOS_LOOKED_AT, SMALL = 3, 64  # to see whether there is a background, and px
OVERDRAWN = 1.1  # times the budget: the report warns of more


def expect_run(forecast: Forecast, dataset: Dataset, asked: RefineOptions, recipe: Recipe) -> None:
    """Set the forecast to all of a run, as far as known before its features are; `asked` by the user."""
    options = recipe.options
    few = replace(dataset, frames=dataset.frames[:PHOTOS_LOOKED_AT])
    kind = recipe.method.kinds.of(load_images(few, SMALL, options.background).background is None)
    adjusts = adjusts_cameras(as_views(dataset), recipe.method)
    work = workload(dataset, asked, options, kind=kind, adjusts=adjusts)
    forecast.plan(work.step_weights, work.share)
    forecast.expect(work.amounts)


class WorkAhead:
    """What is left of a run from its first step on, and how many steps there is time for."""

    def __init__(self, scene: Scene, optimiser: JointOptimiser, run: RunState) -> None:
        self._scene, self._optimiser, self._run = scene, optimiser, run
        self._adjusts = adjusts_cameras(scene.dataset, optimiser.method)

    def expect_all(self) -> None:
        """Set the forecast to all of the run from where its steps begin or continue."""
        optimiser, forecast = self._optimiser, self._run.monitor.forecast
        forecast.leave()
        forecast.continues(sum(self._run.record.seconds.values()))
        share = steps_share(matched=self._scene.tracks is not None and self._adjusts)
        forecast.plan(step_weights(optimiser.options, kind=optimiser.schedule.kind), share)
        forecast.expect(self.left(), alone=True)

    def expect(self) -> None:
        """Update the forecast with the rest of the run, by its poses and what it has done."""
        self._run.monitor.forecast.expect(self.left())

    def left(
        self, options: ResolvedOptions | None = None, *, checks: bool | None = None
    ) -> dict[Phase, float]:
        """What is left after the first step, with other options (of its steps) if given.

        Args:
            checks: the result of `checks`, where it is known already.
        """
        schedule, step, switch = self._optimiser.schedule, self._optimiser.step_index, self._optimiser.switch
        options = options or schedule.options
        coarse, fine = self._run.steps_left(step, switch, options.steps, options.coarse_steps_max)
        weights = step_weights(options, kind=schedule.kind)
        first = not self._run.record.adjusted
        # With matches, the first adjustment mostly moves cameras, which are not adjusted again then.
        again = self._run.record.adjusts_again and not (first and self._scene.tracks is not None)
        each = adjustment(self._scene) if self._adjusts else 0.0
        checks = self.checks() if checks is None else checks
        return {
            "coarse": coarse * weights["coarse"],
            "fine": fine * weights["fine"],
            **after_steps(options, schedule.kind, adjusting=(first + again) * each, checks=checks),
        }

    def checks(self) -> bool:
        """Whether photos will judge the adjusted cameras."""
        if not self._adjusts or self._run.record.adjusted or self._scene.tracks is None:
            return False
        optimiser = self._optimiser
        present, unseen_px = optimiser.joint.unit_from_cam, optimiser.method.finish.unseen_px
        return photos_will_be_asked(self._scene, present, unseen_px)

    def keep_to_budget(self, started: float, steps_asked: int) -> None:
        """Let a run that started at this `time.monotonic` end within its budget; predict its end if it has none.

        What it took before it was interrupted counts.
        """
        seconds, run = self._optimiser.options.time_budget_s, self._run
        if not seconds:
            run.keep_to(self.expect)
            return
        writing = self._optimiser.method.finish.writing
        ends = started + (1 - writing) * seconds - sum(run.record.seconds.values())
        run.keep_to(partial(self.choose_steps, steps_asked), ends)

    def choose_steps(self, most: int) -> None:
        """Leave the run as many steps as there is time for, `most` in all; fewer where poses stand still now."""
        optimiser = self._optimiser
        before = optimiser.schedule.steps
        high = max(FEWEST_STEPS, round((FIRST_ROUND + LEARNING) * most)) if optimiser.poses_held else most
        low = min(
            high, max(optimiser.step_index, round(optimiser.method.finish.least_steps * most), FEWEST_STEPS)
        )
        left_s, checks = self._run.left_s, self.checks()

        def needed_s(steps: int) -> float:
            options = optimiser.options.with_steps(steps) if optimiser.switch is None else optimiser.options
            options = options.model_copy(update={"steps": steps})
            return self._run.monitor.forecast.left_s(self.left(options, checks=checks))

        while low < high:
            steps = (low + high + 1) // 2
            if needed_s(steps) <= left_s:
                low = steps
            else:
                high = steps - 1
        if low != before:
            logger.debug("%d steps in place of %d: %.0f s left", low, before, left_s)
            optimiser.set_steps(low)
        self.expect()


def adjustment(scene: Scene) -> float:
    """Work of one adjustment of all cameras."""
    return adjustment_work(len(scene.dataset), 0 if scene.tracks is None else len(scene.tracks.point))


def budget_warnings(budget_s: float, spent: Mapping[str, float]) -> tuple[str, ...]:
    """A warning where the parts of a run took longer than it was to."""
    total = sum(spent.values())
    if not budget_s or total <= OVERDRAWN * budget_s:
        return ()
    compiling = spent.get("compiling", 0.0)
    before = f"{spent.get('preparing', 0.0) + compiling:.0f} s of them before the first step"
    advice = "Give it more time, or fewer or smaller photos."
    if compiling:
        waited = f"{compiling:.0f} s of waiting"
        advice = f"The first run on a machine compiles kernels ({waited}): the next one has that time."
    return (f"The run took {total:.0f} s of a budget of {budget_s:g} s, {before}. {advice}",)
