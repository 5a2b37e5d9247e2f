"""How learning rates, sampling and smoothing change over the steps (method.md of the docs names the symbols)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from biresnerf.field.radiance_field import FieldRates, PositionGradient
from biresnerf.geometry.perturb import RIG_DISTANCE
from biresnerf.options.refine_options import ResolvedOptions

COARSE_INTERVAL = 2.5e-2  # ray marching interval at the start, unit lengths: half a cell of the pose module
FINE_INTERVAL = 3.3e-3  # BAA-NGP's 5e-3 in a box of side 3
INTERVAL_PIXELS = 0.4  # no finer than this share of a pixel
# In scenes with surroundings samples fill the whole ray: coarser intervals and twice the budget keep enough rays.
OPEN_COARSE_INTERVAL, OPEN_INTERVAL_PIXELS, OPEN_SAMPLES = 3e-2, 1.0, 2
# Without a background to stand out from, gradients mean nothing until the field has formed: poses that move from
# the first step drift away (fox at noise 0.05: 3.9 deg became 5.1; with this wait, 1.6).
OPEN_POSE_START = 0.5  # of the least length of stage 1
# Shares of the cameras' distance, at the start and from the switch on: nothing nearer is sampled. A field that may
# put colour right in front of each camera explains any photo from any pose.
NEAR_SHARES = (0.4, 0.1)
UNPRUNED_SHARE = 0.1  # of the least length of stage 1: until then every cell counts as occupied
RAMP_SHARE = 0.75  # of the greatest length of stage 1: the interval has reached its fine value
BLUR_END_SHARE = 0.6  # of the greatest length of stage 1: photos are sharp from then on
BLUR_PIXELS = 0.03  # blur at the start, as a share of the long side (6 px of 200)
FIELD_START, POSE_START = 200, 500  # steps of the paper's 40 000 over which rates rise from zero
POSE_DIP = 0.05  # pose rate right after the switch, as a share
POSE_STAGE2_CAP = 1e-3
# Intrinsics begin to move at this share of the least length of stage 1, and rise over as many steps again. Before it,
# focal lengths answer to poses that are still off (lego at noise 0.05: from 5 to 6.6 % too long).
LENS_START, LENS_SHARE = 0.5, 1.0
FIELD_DIP = 0.3
FREEZE_SHARE = 0.95  # of all steps: poses stand still from then on
# As NerfAcc: from the start, steps that look at all cells of the occupancy grid; then the share of the empty ones.
FRESH_STEPS, EMPTY_LOOKED_AT = 256, 0.25


def smooth_ramp(q: float) -> float:
    """(1 - cos(pi q)) / 2 of q clamped to [0, 1]."""
    return (1 - math.cos(math.pi * min(max(q, 0.0), 1.0))) / 2


@dataclass(frozen=True)
class Schedule:
    """All schedules of a run. `switch` is the step stage 2 began at, None before.

    Attributes:
        pixel: what a pixel spans at the scene, unit lengths.
        unbounded: whether the scene has surroundings instead of a background.
        distance: mean distance of the cameras from the scene, unit lengths.
    """

    options: ResolvedOptions
    pixel: float
    unbounded: bool = False
    distance: float = RIG_DISTANCE

    @property
    def fine_interval(self) -> float:
        """Ray marching interval of stage 2, unit lengths."""
        pixels = OPEN_INTERVAL_PIXELS if self.unbounded else INTERVAL_PIXELS
        return max(FINE_INTERVAL, pixels * self.pixel)

    @property
    def steps(self) -> int:
        return self.options.steps

    def _decayed_pose_rate(self, share: float) -> float:
        start, end = self.options.pose_rate, self.options.pose_rate_final
        return start * (end / start) ** min(share, 1.0)

    def _decayed_field_rate(self, share: float) -> float:
        start, end = self.options.field_rate, self.options.field_rate_final
        return start * (end / start) ** min(share, 1.0)

    def interval(self, step: int, switch: int | None) -> float:
        """Ray marching interval, unit lengths."""
        if switch is not None:
            return self.fine_interval
        share = min(1.0, step / (RAMP_SHARE * self.options.coarse_steps_max))
        start = OPEN_COARSE_INTERVAL if self.unbounded else COARSE_INTERVAL
        return max(self.fine_interval, start * (self.fine_interval / start) ** share)

    def near(self, step: int, switch: int | None) -> float:
        """Distance that sampling starts at, as a share of the cameras' distance."""
        start, end = NEAR_SHARES
        share = 1.0 if switch is not None else min(1.0, step / self.options.coarse_steps_max)
        return start * (end / start) ** share

    def far(self, far: float) -> float:
        """Distance that sampling ends at, of the scene's own `far`; unit lengths."""
        return far

    def samples(self, step: int, switch: int | None) -> int:
        """Samples a step: half of the budget at the start of stage 1, all of it from its end."""
        share = 1.0 if switch is not None else min(1.0, step / (RAMP_SHARE * self.options.coarse_steps_max))
        budget = self.options.samples_per_step * (OPEN_SAMPLES if self.unbounded else 1)
        return int(budget * 2 ** (share - 1))

    def pruned(self, step: int) -> bool:
        """Whether empty space may be skipped."""
        return step >= UNPRUNED_SHARE * self.options.coarse_steps_min

    def dilated(self, switch: int | None) -> bool:
        """Whether neighbours of occupied cells are looked into."""
        return switch is None

    def empty_cells_looked_at(self, step: int) -> float:
        """Share of the empty cells that an update of the occupancy grid looks at."""
        return 1.0 if step < FRESH_STEPS else EMPTY_LOOKED_AT

    def blur(self, step: int, switch: int | None, long_side: float) -> float:
        """Standard deviation (px) that photos are blurred with, before its random factor."""
        end = BLUR_END_SHARE * self.options.coarse_steps_max
        if switch is not None or step >= end:
            return 0.0
        start = BLUR_PIXELS * long_side
        return start * (0.3 / max(start, 0.31)) ** (step / end)

    def pose_rate(self, step: int, switch: int | None) -> float:
        """Learning rate of the poses; 0 once they are frozen."""
        if step >= FREEZE_SHARE * self.steps:
            return 0.0
        rise = POSE_START / 40_000 * self.steps
        if self.unbounded:
            rise = max(rise, OPEN_POSE_START * self.options.coarse_steps_min)
        rate = smooth_ramp(step / rise) * self._decayed_pose_rate(step / self.steps)
        if switch is not None:
            warmup = 2 * self.options.warmup_steps
            share = POSE_DIP + (1 - POSE_DIP) * smooth_ramp((step - switch) / warmup)
            rate = min(rate, POSE_STAGE2_CAP) * share
        return rate

    def focal_moves(self, switch: int | None) -> bool:
        """Whether focal lengths move: only in stage 1, as stage 2 drives them away from the truth where poses are off.

        A method of one stage has its switch at step 0 and moves them throughout.
        """
        return not switch

    def lens_rate(self, step: int, switch: int | None) -> float:
        """Learning rate of the intrinsics: the poses' rate, rising later, so that poses explain what they can first."""
        start = LENS_START * self.options.coarse_steps_min
        return LENS_SHARE * self.pose_rate(step, switch) * smooth_ramp((step - start) / start)

    def field_rates(self, step: int, switch: int | None) -> FieldRates:
        """Learning rates of the field: smooth warm-up of the reconstruction module after the switch."""
        rate = smooth_ramp(step / (FIELD_START / 40_000 * self.steps)) * self._decayed_field_rate(
            step / self.steps
        )
        if switch is None:
            return FieldRates(rate, rate, (), 0.0)
        warmup = self.options.warmup_steps
        q = (step - switch + 1) / warmup
        rate *= FIELD_DIP + (1 - FIELD_DIP) * smooth_ramp(q)
        high = smooth_ramp(q) * self._decayed_field_rate((step - switch) / max(1, self.steps - switch))
        levels = self.options.reconstruction_levels
        # Level by level, about three at a time; the last opens as the warm-up ends.
        opened = [smooth_ramp(6 * q - 5 * level / max(1, levels - 1)) for level in range(levels)]
        return FieldRates(rate, rate, tuple(high * r for r in opened), high)

    def position_gradient(self, step: int, switch: int | None) -> PositionGradient:
        """Straight-through smoothing, and how much of the reconstruction module's gradient reaches the poses."""
        if switch is None:
            return PositionGradient(1.0, 0.0, 0.0)
        share = smooth_ramp((step - switch) / self.options.warmup_steps - 1)
        half = (switch + self.steps) / 2
        smoothing = 1.0 - smooth_ramp((step - half) / max(1.0, self.steps - half))
        return PositionGradient(1.0, smoothing, share)
