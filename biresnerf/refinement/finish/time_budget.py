"""Chooses the number of steps so that a run ends in time, from the time that its steps take on this machine."""

from __future__ import annotations

import logging
import time
from functools import partial

from biresnerf.data.workload import FIRST_ROUND, LEARNING
from biresnerf.options.presets import FEWEST_STEPS
from biresnerf.refinement.finish.work_ahead import checks_ahead, expect_as_measured, work_ahead
from biresnerf.refinement.stages.two_stages import TwoStages

logger = logging.getLogger(__name__)

LEAST = 0.1  # of the steps asked for: with fewer, poses move but do not improve
WRITING = 0.03  # of the budget, for the files of the result
OVERDRAWN = 1.1  # times the budget: the report warns of more


def keep_to_budget(stages: TwoStages, started: float, steps_asked: int) -> None:
    """Let a run that started at this `time.monotonic` end within its budget; predict its end if it has none.

    What it took before it was interrupted counts.
    """
    seconds = stages.optimiser.options.time_budget_s
    if not seconds:
        stages.keep_to(expect_as_measured)
        return
    ends = started + (1 - WRITING) * seconds - sum(stages.record.seconds.values())
    stages.keep_to(partial(choose_steps, most=steps_asked), ends)


def budget_warnings(stages: TwoStages) -> tuple[str, ...]:
    """A warning where a run took longer than it was to."""
    seconds, spent = stages.optimiser.options.time_budget_s, stages.record.seconds
    total = sum(spent.values())
    if not seconds or total <= OVERDRAWN * seconds:
        return ()
    return (
        f"The run took {total:.0f} s of a budget of {seconds:g} s, {spent.get('preparing', 0.0):.0f} s of them "
        "before the first step. Give it more time, or fewer or smaller photos.",
    )


def choose_steps(stages: TwoStages, most: int) -> None:
    """Leave a run as many steps as there is time for, `most` in all; fewer where poses stand still from now on."""
    optimiser = stages.optimiser
    before = optimiser.schedule.steps
    high = max(FEWEST_STEPS, round((FIRST_ROUND + LEARNING) * most)) if optimiser.poses_held else most
    low = min(high, max(optimiser.step_index, round(LEAST * most), FEWEST_STEPS))
    left_s, checks = stages.ends - time.monotonic(), checks_ahead(stages)
    while low < high:
        steps = (low + high + 1) // 2
        if _needed_s(stages, steps, checks) <= left_s:
            low = steps
        else:
            high = steps - 1
    if low != before:
        logger.debug("%d steps in place of %d: %.0f s left", low, before, left_s)
        optimiser.set_steps(low)
    expect_as_measured(stages)


def _needed_s(stages: TwoStages, steps: int, checks: bool) -> float:
    optimiser = stages.optimiser
    options = optimiser.options.with_steps(steps) if optimiser.switch is None else optimiser.options
    return stages.forecast.left_s(
        work_ahead(stages, options.model_copy(update={"steps": steps}), checks=checks)
    )
