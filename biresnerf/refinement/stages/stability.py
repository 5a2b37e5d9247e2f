"""Error-stability detection, Algorithm 1 of Guo et al. 2023: when the coarse stage has converged.

The paper gives no formula. Errors fall by about as much whenever the number of steps doubles, so a bound in dB would
suit one length of run only. Here the error (dB), averaged over the blocks between checks, counts as stable when the
later half of the steps has brought little of all that was gained, twice in a row, and the floor is reached.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from biresnerf.frozen_model import FrozenModel
from biresnerf.refinement.numbers.optimise import SwitchNumbers

Verdict = Literal["running", "stable", "cap"]


class DetectorState(FrozenModel):
    """What a checkpoint keeps of the detector."""

    decibels: tuple[float, ...] = ()
    confirmed: int = 0


@dataclass
class StabilityDetector:
    """Decides from the mean squared error of each block what to do next.

    Attributes:
        floor, cap: no switch before step `floor`; always at step `cap`.
    """

    floor: int
    cap: int
    numbers: SwitchNumbers = SwitchNumbers()
    decibels: list[float] = field(default_factory=list)
    confirmed: int = 0

    def keep_between(self, floor: int, cap: int) -> None:
        """Set the limits: no switch before step `floor`; always at step `cap`."""
        self.floor, self.cap = floor, cap

    def check(self, step: int, mean_squared_error: float) -> Verdict:
        """Add one block's result at `step`, and decide."""
        self.decibels.append(-10 * math.log10(max(mean_squared_error, 1e-12)))
        self.confirmed = self.confirmed + 1 if self._level() else 0
        if step >= self.cap:
            return "cap"
        return "stable" if self.confirmed >= self.numbers.confirmations and step >= self.floor else "running"

    def signal(self) -> dict[str, float]:
        """The detector's figures for curves: what the later half of the checks gained, and what counts as level, dB."""
        if len(self.decibels) < self.numbers.least_checks:
            return {"confirmed": self.confirmed}
        trend, _, gained = self._later_half()
        level = max(0.0, self.numbers.level_share * gained)
        return {"trend_db": trend, "level_db": level, "confirmed": self.confirmed}

    def _level(self) -> bool:
        if len(self.decibels) < self.numbers.least_checks:
            return False
        trend, scatter, gained = self._later_half()
        return max(abs(trend), scatter) <= self.numbers.level_share * gained

    def _later_half(self) -> tuple[float, float, float]:
        """Gain of the later half, standard deviation about its line, and gain since the first check; dB."""
        values = np.array(self.decibels[len(self.decibels) // 2 :])
        x = np.arange(len(values))
        slope, intercept = np.polyfit(x, values, 1)
        line = slope * x + intercept
        return float(line[-1] - line[0]), float(np.std(values - line)), float(line[-1] - self.decibels[0])

    def state(self) -> DetectorState:
        return DetectorState(decibels=tuple(self.decibels), confirmed=self.confirmed)

    def load_state(self, state: DetectorState) -> None:
        self.decibels, self.confirmed = list(state.decibels), state.confirmed
