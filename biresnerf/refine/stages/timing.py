"""When to show a preview of the stages, how far they are, and how long they will take."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from biresnerf.progress import EVALUATING_FROM, STAGES_FROM

StageName = Literal["coarse", "fine"]

FIRST_PREVIEW_S, PREVIEW_PERIOD_S = 3.0, 20.0
PREVIEW_SHARE = 0.05  # of the run's time, at most
FINE_COST = 2.0  # a step of stage 2 against one of stage 1, until measured
MEMORY = 0.98  # of the running mean of a step's time


class PreviewTimer:
    """Says when a preview is due: soon after the start, then every so often, but never for much of the time.

    Args:
        period_s: seconds from one to the next, `PREVIEW_PERIOD_S` at most.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s, self._due = min(period_s, PREVIEW_PERIOD_S), 0.0

    def begin(self) -> None:
        """The run steps from now on."""
        self._due = time.monotonic() + min(FIRST_PREVIEW_S, self._period_s)

    @property
    def due(self) -> bool:
        return time.monotonic() >= self._due

    @contextmanager
    def showing(self) -> Iterator[None]:
        """Around the writing of a preview: the longer it takes, the later comes the next."""
        started = time.monotonic()
        yield
        now = time.monotonic()
        self._due = now + max(self._period_s, (now - started) / PREVIEW_SHARE)


class Estimate:
    """Fraction of the run that is done, and seconds to its end, by the time that a step takes in each stage."""

    def __init__(self) -> None:
        self.step_seconds: dict[StageName, float] = {"coarse": 0.0, "fine": 0.0}
        self._fraction = STAGES_FROM

    def stepped(self, stage: StageName, seconds: float) -> None:
        """Add the time of one step."""
        mean = self.step_seconds[stage]
        self.step_seconds[stage] = seconds if mean == 0 else MEMORY * mean + (1 - MEMORY) * seconds

    def at(self, step: int, switch: int, steps: int, spent_s: float) -> tuple[float, float]:
        """Fraction of the whole run and seconds left, at a step.

        Args:
            switch: the step at which stage 2 begins, or will at the latest.
            steps: of both stages.
            spent_s: seconds spent so far.
        """
        coarse = self.step_seconds["coarse"] or self.step_seconds["fine"] / FINE_COST
        fine = self.step_seconds["fine"] or coarse * FINE_COST
        left_s = max(0, switch - step) * coarse + (steps - max(step, switch)) * fine
        share = spent_s / max(spent_s + left_s, 1e-9)
        stages = EVALUATING_FROM - STAGES_FROM
        # An early switch makes the remaining steps dearer; the fraction never falls all the same.
        self._fraction = max(self._fraction, STAGES_FROM + stages * share)
        return self._fraction, left_s * (1 - STAGES_FROM) / stages
