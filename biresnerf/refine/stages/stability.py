"""Error-stability detection, Algorithm 1 of Guo et al. 2023: when the coarse stage has converged.

The paper gives no formula. Here a line is fitted to the error (dB), averaged over the blocks between checks, over a
window of blocks. The error is stable when the line neither rises nor falls by more than the error's own fluctuation,
twice in a row, and the floor is reached.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from biresnerf.frozen_model import FrozenModel

Verdict = Literal["running", "stable", "cap"]

WINDOW = 10  # blocks
SLOPE_DB = 0.15  # net change over the window that still counts as flat
FLUCTUATION_DB = 0.35  # standard deviation about the line that still counts as calm
CONFIRMATIONS = 2  # checks in a row
STILL_DEG = 0.05  # 90 % quantile of rotation change per block below which cameras have settled
# Adam's steps have the size of the learning rate whatever the gradient: settled cameras still stagger by about
# rate * sqrt(steps) in a block. Measured on settled rigs: 1.2 to 1.5 times that; while they move, 3 and more.
STAGGER = 1.7


class DetectorState(FrozenModel):
    """What a checkpoint keeps of the detector."""

    decibels: tuple[float, ...] = ()
    confirmed: int = 0


@dataclass
class StabilityDetector:
    """Decides from the mean squared error of each block what to do next.

    Attributes:
        floor, cap: no switch before step `floor`; always at step `cap`.
        motion_deg: how calm cameras must be for STABLE: the 90 % quantile of their rotation within the block.
        guarded: whether moving cameras put the switch off, which is not in the paper.
    """

    floor: int
    cap: int
    motion_deg: float = STILL_DEG
    guarded: bool = True
    decibels: list[float] = field(default_factory=list)
    confirmed: int = 0

    def still_deg(self, pose_rate: float, steps: int) -> float:
        """Rotation within a block of `steps` steps that settled cameras may show at this learning rate (rad)."""
        return max(self.motion_deg, STAGGER * math.degrees(pose_rate) * math.sqrt(steps))

    def check(
        self, step: int, mean_squared_error: float, moved_deg: float, still_deg: float | None = None
    ) -> Verdict:
        """One block's result at `step`. `moved_deg`: 90 % quantile of the cameras' rotation during the block."""
        self.decibels.append(-10 * math.log10(max(mean_squared_error, 1e-12)))
        if len(self.decibels) >= WINDOW:
            still = moved_deg < (still_deg or self.motion_deg) or not self.guarded
            self.confirmed = self.confirmed + 1 if self._flat() and still else 0
        if step >= self.cap:
            return "cap"
        if self.confirmed >= CONFIRMATIONS and step >= self.floor:
            return "stable"
        return "running"

    def signal(self) -> dict[str, float]:
        """Its figures for curves: trend over the window and what counts as level, dB; confirmations in a row."""
        if len(self.decibels) < WINDOW:
            return {"confirmed": self.confirmed}
        change, fluctuation = self._trend()
        return {"trend_db": change, "level_db": max(SLOPE_DB, fluctuation), "confirmed": self.confirmed}

    def _flat(self) -> bool:
        """Whether the last window shows neither trend nor unrest."""
        imbalance = abs(int(np.sign(np.diff(self.decibels[-WINDOW:])).sum()))
        change, fluctuation = self._trend()
        tolerance = max(SLOPE_DB, fluctuation)
        return abs(change) <= tolerance and fluctuation <= FLUCTUATION_DB and imbalance <= WINDOW // 2

    def _trend(self) -> tuple[float, float]:
        """Net change (dB) over the window, and standard deviation about the line."""
        values = np.array(self.decibels[-WINDOW:])
        x = np.arange(WINDOW)
        slope, intercept = np.polyfit(x, values, 1)
        fluctuation = float(np.std(values - (slope * x + intercept)))
        return float(slope * (WINDOW - 1)), fluctuation

    def state(self) -> DetectorState:
        return DetectorState(decibels=tuple(self.decibels), confirmed=self.confirmed)

    def load_state(self, state: DetectorState) -> None:
        self.decibels, self.confirmed = list(state.decibels), state.confirmed
