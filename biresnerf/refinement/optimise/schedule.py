"""How learning rates, sampling and smoothing change over the steps (method.md of the docs names the symbols)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from biresnerf.data.scene_kind import SceneKind, SceneKinds
from biresnerf.field.radiance_field import FieldRates, PositionGradient
from biresnerf.geometry.perturb import RIG_DISTANCE
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.numbers.optimise import ScheduleNumbers


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
    numbers: ScheduleNumbers = ScheduleNumbers()
    kinds: SceneKinds = SceneKinds()

    @property
    def kind(self) -> SceneKind:
        return self.kinds.of(self.unbounded)

    @property
    def fine_interval(self) -> float:
        """Ray marching interval of stage 2, unit lengths."""
        return max(self.numbers.fine_interval, self.kind.interval_pixels * self.pixel)

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
        start = self.kind.coarse_interval
        return max(self.fine_interval, start * (self.fine_interval / start) ** self._ramped(step))

    def _ramped(self, step: int) -> float:
        return min(1.0, step / (self.numbers.ramp_share * self.options.coarse_steps_max))

    def near(self, step: int, switch: int | None) -> float:
        """Distance that sampling starts at, as a share of the cameras' distance."""
        start, end = self.numbers.near_shares
        share = 1.0 if switch is not None else min(1.0, step / self.options.coarse_steps_max)
        return start * (end / start) ** share

    def far(self, far: float) -> float:
        """Distance that sampling ends at, given the scene's own `far`; unit lengths."""
        return far

    def samples(self, step: int, switch: int | None) -> int:
        """Samples a step: half of the budget at the start of stage 1, all of it from its end."""
        share = 1.0 if switch is not None else self._ramped(step)
        budget = self.options.samples_per_step * self.kind.samples
        return int(budget * 2 ** (share - 1))

    def pruned(self, step: int) -> bool:
        """Whether empty space may be skipped."""
        return step >= self.numbers.unpruned_share * self.options.coarse_steps_min

    def dilated(self, switch: int | None) -> bool:
        """Whether neighbours of occupied cells are looked into."""
        return switch is None

    def empty_cells_looked_at(self, step: int) -> float:
        """Share of the empty cells that an update of the occupancy grid looks at."""
        return 1.0 if step < self.numbers.fresh_steps else self.numbers.empty_looked_at

    def blur(self, step: int, switch: int | None, long_side: float) -> float:
        """Standard deviation (px) that photos are blurred with, before its random factor."""
        end = self.numbers.blur_end_share * self.options.coarse_steps_max
        if switch is not None or step >= end:
            return 0.0
        start = self.numbers.blur_pixels * long_side
        return start * (0.3 / max(start, 0.31)) ** (step / end)

    def pose_rate(self, step: int, switch: int | None) -> float:
        """Learning rate of the poses; 0 once they are frozen."""
        if step >= self.numbers.freeze_share * self.steps:
            return 0.0
        rise = self.numbers.pose_start / 40_000 * self.steps
        rise = max(rise, self.kind.pose_start * self.options.coarse_steps_min)
        rate = smooth_ramp(step / rise) * self._decayed_pose_rate(step / self.steps)
        if switch is not None:
            warmup = 2 * self.options.warmup_steps
            dip = self.numbers.pose_dip
            share = dip + (1 - dip) * smooth_ramp((step - switch) / warmup)
            rate = min(rate, self.numbers.pose_stage2_cap) * share
        return rate

    def focal_moves(self, switch: int | None) -> bool:
        """Whether focal lengths move: only in stage 1, as stage 2 drives them away from the truth where poses are off.

        A method of one stage has its switch at step 0 and moves them throughout.
        """
        return not switch

    def lens_rate(self, step: int, switch: int | None) -> float:
        """Learning rate of the intrinsics: the poses' rate, rising later, so that poses explain what they can first."""
        start = self.numbers.lens_start * self.options.coarse_steps_min
        return self.numbers.lens_share * self.pose_rate(step, switch) * smooth_ramp((step - start) / start)

    def field_rates(self, step: int, switch: int | None) -> FieldRates:
        """Learning rates of the field: smooth warm-up of the reconstruction module after the switch."""
        rise = self.numbers.field_start / 40_000 * self.steps
        rate = smooth_ramp(step / rise) * self._decayed_field_rate(step / self.steps)
        if switch is None:
            return FieldRates(rate, rate, (), 0.0)
        warmup = self.options.warmup_steps
        q = (step - switch + 1) / warmup
        rate *= self.numbers.field_dip + (1 - self.numbers.field_dip) * smooth_ramp(q)
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
