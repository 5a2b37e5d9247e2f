"""The methods that can be run: ours, the paper's two stages without our additions, and those it is compared with.

A method is a description; the loop, the sampling of photos, the marching and the evaluation are the same for all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch

from biresnerf.field.backends import make_field
from biresnerf.field.grid_levels import grid_levels
from biresnerf.field.radiance_field import FieldShape, RadianceField
from biresnerf.field.reference.mlp_field import MlpField
from biresnerf.geometry.perturb import RIG_DISTANCE
from biresnerf.options.presets import MethodName
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refine.optimise.loss import Loss, half_squared_error, squared_error
from biresnerf.refine.optimise.published_schedules import BarfSchedule, OneStageSchedule, PaperSchedule
from biresnerf.refine.optimise.schedule import Schedule
from biresnerf.refine.scene.scene_frame import SceneFrame

DENSE_TABLE_LOG2 = 22  # the pose-estimation module is stored densely up to 159 cells a side, hashed beyond
BARF_HIDDEN, BARF_SAMPLES = 256, 128  # units of a layer, samples per ray


@dataclass(frozen=True)
class Method:
    """What one method does otherwise than another.

    Attributes:
        field: two grid encodings; one, opening from coarse to fine; BARF's network, marched or sampled in strata.
        two_stages: whether there is a switch; a run without one is in its last stage from the first step.
        pose_betas: of the poses' Adam.
        additions: ours around the switch: cameras must be still, rising errors are rolled back, cameras placed by
            matches move less, and stage 1 is shorter for them; lost cameras weigh less and are repaired.
        robust_frame: results return to the input's frame by a similarity robust to lost cameras, or by the least
            squares of camera centres alone.
        rays_least: fewest rays a step.
        fine_occupancy: 128^3 cells at the published image size, instead of as many as the batch can afford.
    """

    field: Literal["two grids", "one grid", "network", "stratified network"]
    schedule: type[Schedule]
    loss: Loss
    two_stages: bool = False
    pose_betas: tuple[float, float] = (0.9, 0.999)
    additions: bool = False
    robust_frame: bool = False
    rays_least: int = 256
    fine_occupancy: bool = True

    @property
    def network(self) -> bool:
        """Whether the field is one large network, whose samples cost tens of times those of a grid."""
        return self.field in ("network", "stratified network")

    @property
    def pruned(self) -> bool:
        """Whether an occupancy grid is kept."""
        return self.field != "stratified network"


METHODS: dict[MethodName, Method] = {
    "biresnerf": Method(
        "two grids", Schedule, half_squared_error, two_stages=True, pose_betas=(0.9, 0.99), additions=True,
        robust_frame=True, fine_occupancy=False,
    ),
    # Guo et al. 2023 as far as it is known, its gaps filled from BAA-NGP, which it builds on.
    "biresnerf-paper": Method("two grids", PaperSchedule, half_squared_error, two_stages=True),
    # Liu et al. 2023.
    "baa-ngp": Method("one grid", OneStageSchedule, half_squared_error),
    # BARF on NerfAcc's occupancy grid (Li et al. 2023).
    "nerfacc-barf": Method("network", BarfSchedule, squared_error, rays_least=16),
    # Lin et al. 2021.
    "barf": Method("stratified network", BarfSchedule, squared_error, rays_least=8),
}  # fmt: skip


def build_field(
    method: Method, options: ResolvedOptions, frame: SceneFrame, device: torch.device, threads: int
) -> RadianceField:
    """The method's radiance field at its start."""
    if method.network or options.wiring == "residual":
        torch.set_num_threads(threads)  # in plain torch, and the kernels are at rest
    if method.network:
        return MlpField(
            options.seed,
            device,
            hidden=BARF_HIDDEN,
            unbounded=frame.unbounded,
            length=frame.distance / RIG_DISTANCE,
            stratified=BARF_SAMPLES if method.field == "stratified network" else None,
        )
    hashed = grid_levels(
        options.reconstruction_levels,
        options.reconstruction_resolution_min,
        options.reconstruction_resolution_max,
        options.table_size_log2,
    )
    if method.field == "one grid":
        shape = FieldShape(hashed, grid_levels(0, 1, 1, 0), frame.unbounded, broadcast=True)
    else:
        dense = grid_levels(
            options.pose_levels, options.pose_resolution_min, options.pose_resolution_max, DENSE_TABLE_LOG2
        )
        shape = FieldShape(dense, hashed, frame.unbounded, wiring=options.wiring)
    return make_field(shape, options.seed, device, threads)


def occupancy_side(method: Method, options: ResolvedOptions) -> int:
    """Cells a side of the occupancy grid."""
    if not method.fine_occupancy:
        return 64 if options.samples_per_step <= 2**16 else 128
    size = options.max_image_size  # 128 in the publications, for images of 400 px
    return 128 if size > 200 else 64 if size > 64 else 32
