"""Stage 2, and the adjustment of all cameras on the way through it."""

from __future__ import annotations

from dataclasses import replace

from biresnerf.data.workload import FIRST_ROUND, LEARNING
from biresnerf.forecast.run_forecast import Phase
from biresnerf.refinement.finish.adjust_cameras import adjust_cameras
from biresnerf.refinement.finish.outcome import Finish
from biresnerf.refinement.scene.scene import Scene
from biresnerf.refinement.stages.run_state import RunState
from biresnerf.refinement.stages.two_stages import TwoStages

AFTER: tuple[Phase, ...] = ("adjusting", "evaluating", "judging")  # phases that follow the last step


def run_rounds(stages: TwoStages, scene: Scene) -> Finish:
    """Run stage 2 in two rounds, with the adjustment of all cameras after the first; returns the last adjustment.

    Where it finds better poses than the field's, they stand still from then on, and the field learns at them for a
    while. It would only bend them. Where it does not, cameras are adjusted again after the last step if the run's time
    allows. A run that was resumed after the first adjustment gathers the evidence once more, and reports what was
    chosen then.

    Raises:
        Interrupted: stopped; a continued run goes on from there.
        RefinementError: ``diverged``.
    """
    optimiser, run, repair = stages.optimiser, stages.run, stages.repair
    slack_s = optimiser.method.finish.slack * optimiser.options.time_budget_s
    first: Finish | None = None
    if not run.record.adjusted:
        stages.run_stage_2(FIRST_ROUND)
        first = adjust_cameras(scene, optimiser.renderer, optimiser.recipe, run, repair)
        if first.moved:
            optimiser.hold_poses()
            stages.begin_block()
            optimiser.end_after(LEARNING)
        again = not first.moved and _time_to_adjust_again(run, slack_s)
        run.note(
            adjusted=True, candidates=first.candidates, believed=first.fit is not None, adjusts_again=again
        )
        stages.replan()
    stages.run_stage_2()
    then = run.record
    again = then.adjusts_again and _time_to_adjust_again(run, slack_s)
    if first is not None and not again:
        return first
    if not again and not then.believed:
        return Finish(then.candidates)
    last = adjust_cameras(scene, optimiser.renderer, optimiser.recipe, run, repair, moves=again)
    if not again:
        return replace(last, candidates=then.candidates)
    if last.moved:
        optimiser.hold_poses()
    return last


def _time_to_adjust_again(run: RunState, slack_s: float) -> bool:
    """Whether there is time for a second adjustment, as long as the first, and for what follows it.

    The number of steps leaves just enough time: a small overrun must not cancel the adjustment.
    """
    after_s = sum(run.monitor.forecast.seconds(phase) for phase in AFTER)
    return after_s < run.left_s + slack_s
