"""What follows the last step of the optimisation: evaluate, judge, write."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from biresnerf.errors import Interrupted
from biresnerf.output_folder import OutputFolder
from biresnerf.progress import OnProgress, Progress
from biresnerf.refine.evaluation import ViewScore, fit_held_out_poses, render_orbit, score_views
from biresnerf.refine.judgement import Judgement, judge
from biresnerf.refine.run_input import RunInput
from biresnerf.refine.two_stages import LAST_FRACTION, TwoStages
from biresnerf.report import Report

logger = logging.getLogger(__name__)

EVALUATED_FRACTION, JUDGED_FRACTION, EXPORTING_FRACTION = 0.95, 0.985, 0.99  # of the whole run's progress
SHOWN_WITHOUT_HELD_OUT = 2  # training views rendered when none is held out


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
        frames = int(optimiser.options.orbit_frames or 0)
        work = len(views) + frames
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
        scores = []
        for score in score_views(optimiser, self.given.images, views):
            self.folder.write_view(self.given.dataset.names, self.given.images, score)
            scores.append(score)
            tell(len(scores))
        if frames:
            self.folder.write_orbit(render_orbit(optimiser, frames, lambda i: tell(len(views) + i + 1)))
        self.stages.record.seconds["evaluating"] = time.monotonic() - started
        self.scores = scores if held_out else []

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
            self.given, self.stages, self.scores, self.judgement,
            threads=self.threads, state=state, should_stop=self.stop if state == "complete" else lambda: False,
        )  # fmt: skip
        if state == "complete":
            self.folder.drop_traces()
            self.report(Progress(stage="exporting", fraction=1.0, eta_s=0.0))
        return result
