"""When to show a preview of the stages, how far a run is, and how long it will take."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

from biresnerf.progress import EXPORTING_FROM, STAGES_FROM

StageName = Literal["coarse", "fine"]
Part = Literal["adjusting", "evaluating", "judging"]

FIRST_PREVIEW_S, PREVIEW_PERIOD_S = 3.0, 20.0
PREVIEW_SHARE = 0.05  # of the run's time, at most
FINE_COST = 1.1  # a step of stage 2 against one of stage 1, until measured
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


@dataclass(frozen=True)
class WorkAhead:
    """What a run does besides its steps, as far as it is known beforehand.

    Attributes:
        parts: how long each takes, in steps of stage 2; in their order.
        share: of the steps asked for, how many will be taken.
    """

    parts: Mapping[Part, float] = field(default_factory=dict)
    share: float = 1.0


class Forecast:
    """How much of a run is done, and the seconds to its end, from the time that its steps take on this machine."""

    def __init__(self, ahead: WorkAhead = WorkAhead()) -> None:
        self.ahead = ahead
        self.step_seconds: dict[StageName, float] = {"coarse": 0.0, "fine": 0.0}
        self._steps: dict[StageName, int] = {"coarse": 0, "fine": 0}
        self.done_of_part = 0.0
        self._part: Part | None = None
        self._began = 0.0
        self._fraction = STAGES_FROM

    def stepped(self, stage: StageName, seconds: float) -> None:
        """Add the time of one step. The first of a stage is slower: it counts only until there is another."""
        self._steps[stage] += 1
        share = max(1 / max(1, self._steps[stage] - 1), 1 - MEMORY)
        self.step_seconds[stage] += share * (seconds - self.step_seconds[stage])

    @contextmanager
    def within(self, part: Part) -> Iterator[None]:
        """Around a part; `done_of_part` may be set to the share of it that is done."""
        self._part, self._began, self.done_of_part = part, time.monotonic(), 0.0
        try:
            yield
        finally:
            self._part = None

    def at(self, step: int, switch: int, steps: int, spent: Mapping[str, float]) -> tuple[float, float]:
        """Fraction of the whole run that is done, and seconds left.

        Args:
            switch: the step at which stage 2 begins, or will at the latest.
            steps: of both stages.
            spent: seconds in each part of the run so far, without the one that it is in.
        """
        left_s = self.left_s(step, switch, steps, spent, self.ahead)
        spent_s = sum(spent.values()) + self._running_s
        share = spent_s / max(spent_s + left_s, 1e-9)
        # The prediction may grow; the fraction never falls all the same.
        self._fraction = max(self._fraction, STAGES_FROM + (EXPORTING_FROM - STAGES_FROM) * share)
        return self._fraction, left_s

    def left_s(
        self, step: int, switch: int, steps: int, spent: Mapping[str, float], ahead: WorkAhead
    ) -> float:
        """Seconds to the end of a run of so many steps with this work besides; see `at`."""
        coarse = self.step_seconds["coarse"] or self.step_seconds["fine"] / FINE_COST
        fine = self.fine_step_s
        left_s = max(0, switch - step) * coarse + max(0, steps - max(step, switch)) * fine
        return left_s + sum(self._left_s(part, cost * fine, spent) for part, cost in ahead.parts.items())

    def expected_s(self, part: Part) -> float:
        """Seconds that a part is expected to take; none if it is not to be."""
        return self.ahead.parts.get(part, 0.0) * self.fine_step_s

    @property
    def fine_step_s(self) -> float:
        """Seconds of a step of stage 2."""
        return self.step_seconds["fine"] or self.step_seconds["coarse"] * FINE_COST

    @property
    def _running_s(self) -> float:
        return 0.0 if self._part is None else time.monotonic() - self._began

    def _left_s(self, part: Part, expected_s: float, spent: Mapping[str, float]) -> float:
        order = list(self.ahead.parts)
        if self._part in order and order.index(part) < order.index(self._part):
            return 0.0
        if part != self._part:
            return max(0.0, expected_s - spent.get(part, 0.0))
        todo = 1 - self.done_of_part
        if todo < 1:  # from what was expected to what is measured
            return todo * (self._running_s + todo * expected_s)
        return max(0.0, expected_s - spent.get(part, 0.0) - self._running_s)
