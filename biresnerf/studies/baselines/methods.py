"""The published methods that ours is compared with: their fields, schedules and losses.

All schedules are shares of the requested steps, so short runs keep the proportions.
"""

from __future__ import annotations

import torch

from biresnerf.field.backends import make_field
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldRates, FieldShape, PositionGradient, RadianceField
from biresnerf.geometry.perturb import RIG_DISTANCE
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.optimise.methods import (
    BuildField,
    Method,
    half_squared_error,
    reconstruction_levels,
    squared_error,
    two_grids,
)
from biresnerf.refinement.optimise.schedule import Schedule, smooth_ramp
from biresnerf.refinement.scene.scene_frame import SceneFrame
from biresnerf.studies.baselines.mlp_field import MlpField

# Steps that update all cells of the occupancy grid, as shares: 256 of BAA-NGP's 40 000, of NerfAcc-BARF's 200 000.
FIRST_LOOKS, NERFACC_BARF_FIRST_LOOKS = 256 / 40_000, 256 / 200_000
BARF_NEAR, BARF_FAR = 0.5, 1.5  # depths 2 to 6 of cameras 4 away
NERFACC_BARF_INTERVAL = 0.03  # of cameras 4 away
BARF_HIDDEN, BARF_SAMPLES = 256, 128  # units of a layer, samples per ray


class PlainSchedule(Schedule):
    """Without our extensions: sharp photos, no near bound, empty space skipped from the start, plain gradients."""

    first_looks = FIRST_LOOKS

    def near(self, step: int, switch: int | None) -> float:
        return 0.0

    def blur(self, step: int, switch: int | None, long_side: float) -> float:
        return 0.0

    def pruned(self, step: int) -> bool:
        return True

    def dilated(self, switch: int | None) -> bool:
        return False

    def empty_cells_looked_at(self, step: int) -> float:
        return 1.0 if step < self.first_looks * self.steps else self.numbers.empty_looked_at

    def pose_rate(self, step: int, switch: int | None) -> float:
        return self._decayed_pose_rate(step / self.steps)

    def field_rates(self, step: int, switch: int | None) -> FieldRates:
        rate = self._decayed_field_rate(step / self.steps)
        return FieldRates(rate, rate, (), 0.0)

    def position_gradient(self, step: int, switch: int | None) -> PositionGradient:
        return PositionGradient()


class PaperSchedule(PlainSchedule):
    """The two stages with what the paper describes: coarse-to-fine ray sampling, and a smooth warm-up at the switch."""

    def _warmed(self, step: int, switch: int) -> float:
        return smooth_ramp((step - switch + 1) / self.options.warmup_steps)

    def pose_rate(self, step: int, switch: int | None) -> float:
        rate = super().pose_rate(step, switch)
        dip = self.numbers.pose_dip
        return rate if switch is None else rate * (dip + (1 - dip) * self._warmed(step, switch))

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
        return self.numbers.near_shares[1] if self.unbounded else BARF_NEAR

    def far(self, far: float) -> float:
        return far if self.unbounded else BARF_FAR * self.distance


def one_grid(
    options: ResolvedOptions, frame: SceneFrame, device: torch.device, threads: int
) -> RadianceField:
    """One hashed grid whose levels open from coarse to fine."""
    levels = reconstruction_levels(options)
    shape = FieldShape(levels, grid_levels(0, 1, 1, 0), frame.unbounded, broadcast=True)
    return make_field(shape, options, device, threads)


def barf_network(samples_per_ray: int | None) -> BuildField:
    """BARF's network, sampled in strata, or marched through the occupancy grid where no number is given."""

    def build(
        options: ResolvedOptions, frame: SceneFrame, device: torch.device, threads: int
    ) -> RadianceField:
        torch.set_num_threads(threads)  # in plain torch, and the kernels are idle
        return MlpField(
            options.seed,
            device,
            hidden=BARF_HIDDEN,
            unbounded=frame.unbounded,
            length=frame.distance / RIG_DISTANCE,
            stratified=samples_per_ray,
        )

    return build


def _published_occupancy(options: ResolvedOptions) -> int:
    """128 cells a side in the publications, for images of 400 px; fewer for smaller ones."""
    size = options.max_image_size
    return 128 if size > 200 else 64 if size > 64 else 32


# Guo et al. 2023 as far as it is known, its gaps filled from BAA-NGP, which it builds on.
BIRESNERF_PAPER = Method(two_grids, PaperSchedule, half_squared_error, _published_occupancy, two_stages=True)
# Liu et al. 2023.
BAA_NGP = Method(one_grid, OneStageSchedule, half_squared_error, _published_occupancy)
# BARF on NerfAcc's occupancy grid (Li et al. 2023).
NERFACC_BARF = Method(
    barf_network(None), BarfSchedule, squared_error, _published_occupancy, large_network=True, rays_least=16
)
# Lin et al. 2021.
BARF = Method(
    barf_network(BARF_SAMPLES), BarfSchedule, squared_error, _published_occupancy,
    large_network=True, pruned=False, rays_least=8,
)  # fmt: skip
