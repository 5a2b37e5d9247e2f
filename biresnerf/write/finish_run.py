"""What follows the last step of the optimisation: evaluate, judge, write."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

from biresnerf.errors import Interrupted
from biresnerf.progress import OnProgress, Progress
from biresnerf.refine.stages.two_stages import LAST_FRACTION, TwoStages
from biresnerf.refine.verdict.judgement import Judgement, judge
from biresnerf.refine.verdict.run_input import RunInput
from biresnerf.refine.views.evaluation import ViewScore, fit_held_out_poses, render_orbit, score_views
from biresnerf.refine.views.shown_views import Shown, spread_views, surface_of
from biresnerf.report import Report
from biresnerf.write.output_folder import OutputFolder

logger = logging.getLogger(__name__)

EVALUATED_FRACTION, JUDGED_FRACTION, EXPORTING_FRACTION = 0.95, 0.985, 0.99  # of the whole run's progress
SHOWN_WITHOUT_HELD_OUT = 2  # training views rendered when none is held out
SHOWN_SHARE = 0.05  # of the run's time, at most, for views rendered to be looked at alone


@dataclass(eq=False)
class Run:
    """A refinement on its way: what its last steps need, and what they have found out so far."""

    given: RunInput
    stages: TwoStages
    folder: OutputFolder
    threads: int
    report: OnProgress
    stop: Callable[[], bool]
    scores: list[ViewScore] = field(default_factory=list)
    judgement: Judgement | None = None
    shown: Shown = field(default_factory=Shown)

    def evaluate(self) -> None:
        """Fit the poses of held-out views, score and render views, film the orbit.

        Raises:
            Interrupted: ``stop`` said so; a continued run evaluates again.
        """
        started = time.monotonic()
        optimiser, held_out = self.stages.optimiser, self.given.held_out
        self.report(Progress(stage="evaluating", fraction=LAST_FRACTION))
        fit_held_out_poses(optimiser, self.given.untaught)
        views = held_out or list(range(min(SHOWN_WITHOUT_HELD_OUT, len(self.given.dataset))))
        frames, more = optimiser.options.orbit_frames, optimiser.options.shown_views
        further = spread_views(self.given.dataset.world_from_cam, views, more)
        work = len(views) + len(further) + frames
        rendering_from = time.monotonic()

        def tell(done: int) -> None:
            if self.stop():
                raise Interrupted("stopped while the result was measured; run again to go on")
            share = done / max(1, work)
            spent = time.monotonic() - rendering_from
            self.report(
                Progress(
                    stage="evaluating",
                    step=done,
                    steps_total=work,
                    fraction=LAST_FRACTION + (EVALUATED_FRACTION - LAST_FRACTION) * share,
                    eta_s=spent * (1 - share) / share if share else None,
                )
            )

        tell(0)
        scores, shown = [], Shown()
        for score in score_views(optimiser, self.given.images, views):
            shown.add(self.folder.write_view(self.given, score), *surface_of(optimiser, score))
            scores.append(score)
            tell(len(scores))
        for score in score_views(optimiser, self.given.images, self._while_cheap(further)):
            shown.add(self.folder.write_view(self.given, score), *surface_of(optimiser, score))
            tell(len(shown.views))
        if frames:
            done = len(views) + len(further)
            self.folder.write_orbit(render_orbit(optimiser, frames, lambda i: tell(done + i + 1)))
        self.shown = shown
        self.stages.record.seconds["evaluating"] = time.monotonic() - started
        self.scores = scores if held_out else []

    def _while_cheap(self, views: list[int]) -> Iterator[int]:
        """The views one by one, until showing another would take more than its share of the run."""
        started, spent_before = time.monotonic(), sum(self.stages.record.seconds.values())
        for done, view in enumerate(views):
            spent = time.monotonic() - started
            if done and spent * (done + 1) / done > SHOWN_SHARE * spent_before:
                logger.info("%d of %d further views rendered: more would take too long", done, len(views))
                return
            yield view

    def judge(self) -> None:
        """Pass the verdict on the refined poses, if one is asked for.

        Raises:
            Interrupted: ``stop`` said so; a continued run judges again.
        """
        optimiser = self.stages.optimiser
        if not optimiser.options.verdict:
            return
        started = time.monotonic()

        def tell(share: float) -> None:
            fraction = EVALUATED_FRACTION + (JUDGED_FRACTION - EVALUATED_FRACTION) * share
            message = "comparing the refined poses with the input's"
            self.report(Progress(stage="evaluating", fraction=fraction, message=message))

        tell(0.0)
        self.judgement = judge(self.given, optimiser, self.threads, self.stop, tell)
        logger.info("verdict: %s", self.judgement.verdict.verdict)
        self.stages.record.seconds["judging"] = time.monotonic() - started

    def write(self, state: Literal["complete", "partial"]) -> Report:
        """Write all results; nothing is left of what only a run that goes on needs, once it is complete.

        Raises:
            Interrupted: ``stop`` said so before the last pack of a complete result was written.
        """
        if state == "complete":
            self.report(Progress(stage="exporting", fraction=EXPORTING_FRACTION))
        result = self.folder.write_result(
            self.given, self.stages, self.scores, self.judgement, self.shown,
            threads=self.threads, state=state, should_stop=self.stop if state == "complete" else lambda: False,
        )  # fmt: skip
        if state == "complete":
            self.folder.drop_traces()
            self.report(Progress(stage="exporting", fraction=1.0, eta_s=0.0))
        return result
