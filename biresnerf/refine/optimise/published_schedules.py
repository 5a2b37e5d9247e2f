"""Schedules of the published methods: all shares of the steps asked for: short runs keep the proportions."""

from __future__ import annotations

from biresnerf.field.radiance_field import FieldRates, PositionGradient
from biresnerf.geometry.perturb import RIG_DISTANCE
from biresnerf.refine.optimise.schedule import EMPTY_LOOKED_AT, NEAR_SHARES, POSE_DIP, Schedule, smooth_ramp

# Steps that look at all cells of the occupancy grid, as shares: 256 of BAA-NGP's 40 000, of NerfAcc-BARF's 200 000.
FIRST_LOOKS, NERFACC_BARF_FIRST_LOOKS = 256 / 40_000, 256 / 200_000
BARF_NEAR, BARF_FAR = 0.5, 1.5  # depths 2 to 6 of cameras 4 away
NERFACC_BARF_INTERVAL = 0.03  # of cameras 4 away


class PlainSchedule(Schedule):
    """Without additions of ours: sharp photos, no near bound, empty space skipped from the start, plain gradients."""

    first_looks = FIRST_LOOKS

    def near(self, step: int, switch: int | None) -> float:
        return 0.0

    def blur(self, step: int, switch: int | None, long_side: float) -> float:
        return 0.0

    def pruned(self, step: int) -> bool:
        return True

    def dilated(self, switch: int | None) -> bool:
        return False

    def empty_cells_looked_at(self, step: int, switch: int | None) -> float:
        return 1.0 if step < self.first_looks * self.steps else EMPTY_LOOKED_AT[0]

    def pose_rate(self, step: int, switch: int | None) -> float:
        return self._decayed_pose_rate(step / self.steps)

    def field_rates(self, step: int, switch: int | None) -> FieldRates:
        rate = self._decayed_field_rate(step / self.steps)
        return FieldRates(rate, rate, (), 0.0)

    def position_gradient(self, step: int, switch: int | None) -> PositionGradient:
        return PositionGradient()


class PaperSchedule(PlainSchedule):
    """The two stages with what the paper tells of: coarse-to-fine ray sampling, and a smooth warm-up at the switch."""

    def _warmed(self, step: int, switch: int) -> float:
        return smooth_ramp((step - switch + 1) / self.options.warmup_steps)

    def pose_rate(self, step: int, switch: int | None) -> float:
        rate = super().pose_rate(step, switch)
        return rate if switch is None else rate * (POSE_DIP + (1 - POSE_DIP) * self._warmed(step, switch))

    def field_rates(self, step: int, switch: int | None) -> FieldRates:
        rates = super().field_rates(step, switch)
        if switch is None:
            return rates
        high = self._decayed_field_rate((step - switch) / max(1, self.steps - switch))
        high *= self._warmed(step, switch)
        levels = self.options.reconstruction_levels
        return FieldRates(rates.pose, rates.networks, (high,) * levels, high)


class OneStageSchedule(PlainSchedule):
    """BAA-NGP's: constant interval and budget, rates that decay exponentially over the whole run."""

    def interval(self, step: int, switch: int | None) -> float:
        return self.fine_interval

    def samples(self, step: int, switch: int | None) -> int:
        return int(self.options.samples_per_step)


class BarfSchedule(OneStageSchedule):
    """BARF's range of depths, and the fixed interval of its version on NerfAcc."""

    first_looks = NERFACC_BARF_FIRST_LOOKS

    @property
    def fine_interval(self) -> float:
        return NERFACC_BARF_INTERVAL * self.distance / RIG_DISTANCE

    def near(self, step: int, switch: int | None) -> float:
        return NEAR_SHARES[1] if self.unbounded else BARF_NEAR

    def far(self, far: float) -> float:
        return far if self.unbounded else BARF_FAR * self.distance
