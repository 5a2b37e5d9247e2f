"""Stage 2 in two rounds of steps, each followed by the adjustment of all cameras."""

from __future__ import annotations

import time
from dataclasses import replace

from biresnerf.data.workload import FIRST_ROUND, LEARNING
from biresnerf.forecast.run_forecast import Phase
from biresnerf.refinement.finish.adjust_cameras import adjust_cameras
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.finish.work_ahead import expect_as_measured
from biresnerf.refinement.stages.two_stages import TwoStages

AFTER: tuple[Phase, ...] = ("adjusting", "evaluating", "judging")  # phases that follow the last step
SLACK = 0.05  # of a run's time budget


def run_stage_2(stages: TwoStages) -> Finish:
    """Steps of stage 2, twice with the adjustment of all cameras after them; what came of the last one.

    Where the first adjustment finds better poses than the field's, they stand still from then on, and the field learns
    at them for a while. It would only bend them. They are adjusted again only if patches of the photos had no say yet:
    the surface of a young field may have been too rough for them; and if the run's time allows. A run that was resumed
    after the first adjustment gathers the evidence once more, and reports what was chosen then.

    Raises:
        Interrupted: stopped; a continued run goes on from there.
        RefinementError: ``diverged``.
    """
    first = None
    if not stages.record.adjusted:
        stages.run_stage_2(FIRST_ROUND)
        first = adjust_cameras(stages)
        if stages.optimiser.poses_held:
            stages.optimiser.end_after(LEARNING)
        again = not _is_over(stages, first) and _time_to_adjust_again(stages)
        stages.note(
            adjusted=True, candidates=first.candidates, believed=first.fit is not None, adjusts_again=again
        )
        expect_as_measured(stages)
        stages.replan()
    stages.run_stage_2()
    held, again = stages.optimiser.poses_held, stages.record.adjusts_again and _time_to_adjust_again(stages)
    if first is not None and not again:
        return first
    if not again and not stages.record.believed:
        return Finish(stages.record.candidates)
    last = adjust_cameras(stages, moves=again)
    # The poses that are held are what the first adjustment made of the field's.
    chosen_then = not again or (held and last.kept)
    return replace(last, candidates=stages.record.candidates) if chosen_then else last


def _is_over(stages: TwoStages, first: Finish) -> bool:
    """Whether cameras need not be adjusted again."""
    return stages.optimiser.poses_held and first.heeds_photos


def _time_to_adjust_again(stages: TwoStages) -> bool:
    """Whether there is time for a second adjustment, as long as the first, and for what follows it.

    The steps were chosen so that there just is: it must not be left out for a moment that they took longer.
    """
    after_s = sum(stages.forecast.seconds(phase) for phase in AFTER)
    slack_s = SLACK * stages.optimiser.options.time_budget_s
    return time.monotonic() + after_s < stages.ends + slack_s
