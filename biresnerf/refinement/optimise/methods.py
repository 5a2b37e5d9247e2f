"""What a method is, ours, and where the baselines are found.

The loop, the sampling of photos, the marching and the evaluation are the same for all methods.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from biresnerf.data.scene_kind import SceneKinds
from biresnerf.field.backends import make_field
from biresnerf.field.grid_levels import GridLevels, grid_levels
from biresnerf.field.radiance_field import FieldShape, Merging, RadianceField
from biresnerf.options.presets import MethodName
from biresnerf.options.refine_options import ResolvedOptions
from biresnerf.refinement.numbers.choosing import StartNumbers, VerdictNumbers, ViewNumbers
from biresnerf.refinement.numbers.finish import EvidenceNumbers, FinishNumbers
from biresnerf.refinement.numbers.lost import LostNumbers
from biresnerf.refinement.numbers.optimise import ErrorNumbers, ScheduleNumbers, SwitchNumbers
from biresnerf.refinement.numbers.scene import FrameNumbers, ParameterNumbers
from biresnerf.refinement.optimise.schedule import Schedule
from biresnerf.refinement.scene.scene_frame import SceneFrame

DENSE_TABLE_LOG2 = 22  # the pose-estimation module is stored densely up to 159 cells a side, hashed beyond

# (colour [rays, 3], target [rays, 3]) -> [rays, 3]. Training takes the mean, with a weight for each camera;
# the repair of lost cameras takes the sum.
Loss = Callable[[Tensor, Tensor], Tensor]
# Options, unit frame, device, threads -> the field at its first step.
BuildField = Callable[[ResolvedOptions, SceneFrame, torch.device, int], RadianceField]


@dataclass(frozen=True)
class Method:
    """What one method does differently from another.

    Attributes:
        build_field: makes the radiance field.
        occupancy_side: cells a side of the occupancy grid, given the options.
        two_stages: whether there is a switch; a run without one is in its last stage from the first step.
        pose_betas: of the poses' Adam.
        mobility: cameras placed by matches keep still in stage 1.
        short_where_matched: both stages are shorter where matches placed most cameras, if all are adjusted.
        near_plane: nothing is sampled nearer than where other cameras look too.
        weights: lost cameras weigh less in the loss.
        repair: lost cameras are given other poses.
        adjustment: all cameras are adjusted at once, and perspective lenses with them.
        uncertainty: the report says how far each pose may be off.
        robust_frame: results return to the input's frame by a similarity robust to lost cameras, or by the least
            squares of camera centres alone.
        large_network: the field is one large network, whose samples cost tens of times those of a grid.
        pruned: whether the occupancy grid is updated; otherwise every cell counts as occupied.
        merging: how intervals that give little light are merged, if they are.
        rays_least: fewest rays a step.
        by_detail: share of the rays that are drawn in proportion to the photos' detail, see `PixelChances`.
        course, errors, switch, kinds, lost: numbers of the schedule, of cameras that stand out, of the switch to
            stage 2, of open scenes, and of lost cameras.
        start, views, verdict: numbers of the start, of unseen views, and of the verdict.
        evidence, finish: numbers of what all cameras are adjusted to, and of when that is done.
        scene, parameters: numbers of the unit frame, and of what moves beside poses.
    """

    build_field: BuildField
    schedule: type[Schedule]
    loss: Loss
    occupancy_side: Callable[[ResolvedOptions], int]
    two_stages: bool = False
    pose_betas: tuple[float, float] = (0.9, 0.999)
    mobility: bool = False
    short_where_matched: bool = False
    near_plane: bool = False
    weights: bool = False
    repair: bool = False
    adjustment: bool = False
    uncertainty: bool = False
    robust_frame: bool = False
    large_network: bool = False
    pruned: bool = True
    merging: Merging | None = None
    rays_least: int = 256
    by_detail: float = 0.0
    course: ScheduleNumbers = ScheduleNumbers()
    errors: ErrorNumbers = ErrorNumbers()
    switch: SwitchNumbers = SwitchNumbers()
    kinds: SceneKinds = SceneKinds()
    lost: LostNumbers = LostNumbers()
    start: StartNumbers = StartNumbers()
    views: ViewNumbers = ViewNumbers()
    verdict: VerdictNumbers = VerdictNumbers()
    evidence: EvidenceNumbers = EvidenceNumbers()
    finish: FinishNumbers = FinishNumbers()
    scene: FrameNumbers = FrameNumbers()
    parameters: ParameterNumbers = ParameterNumbers()

    def scheduled(self, options: ResolvedOptions, frame: SceneFrame) -> Schedule:
        """The schedule of a run in a scene."""
        return self.schedule(options, frame.pixel, frame.unbounded, frame.distance, self.course, self.kinds)


def half_squared_error(colour: Tensor, target: Tensor) -> Tensor:
    """Half the squared difference: smooth L1 with beta 1, as no two colours in 0..1 differ by more than 1."""
    return 0.5 * (colour - target) ** 2


def squared_error(colour: Tensor, target: Tensor) -> Tensor:
    """BARF's loss."""
    return (colour - target) ** 2


def two_grids(
    options: ResolvedOptions, frame: SceneFrame, device: torch.device, threads: int
) -> RadianceField:
    """The pose-estimation module, stored densely, and the reconstruction module, hashed."""
    dense = grid_levels(
        options.pose_levels, options.pose_resolution_min, options.pose_resolution_max, DENSE_TABLE_LOG2
    )
    shape = FieldShape(dense, reconstruction_levels(options), frame.unbounded)
    return make_field(shape, options, device, threads)


def reconstruction_levels(options: ResolvedOptions) -> GridLevels:
    """The hashed levels of the reconstruction module."""
    return grid_levels(
        options.reconstruction_levels,
        options.reconstruction_resolution_min,
        options.reconstruction_resolution_max,
        options.table_size_log2,
    )


def _affordable_occupancy(options: ResolvedOptions) -> int:
    """As many cells as the batch can afford."""
    return 64 if options.samples_per_step <= 2**16 else 128


BIRESNERF = Method(
    two_grids,
    Schedule,
    half_squared_error,
    _affordable_occupancy,
    two_stages=True,
    pose_betas=(0.9, 0.99),
    mobility=True,
    short_where_matched=True,
    near_plane=True,
    weights=True,
    repair=True,
    adjustment=True,
    uncertainty=True,
    robust_frame=True,
    merging=Merging(light=0.03, most=8),
    by_detail=0.5,
)

# The baselines belong to the studies, which this package must not import. `find_method` loads theirs by name when a run
# requests one: the only link from here to there, and one that no import statement shows.
BASELINES = "biresnerf.studies.baselines.methods"


def find_method(name: MethodName) -> Method:
    """The method of that name. Baselines are imported now: ``baa-ngp`` is `BAA_NGP` of their module."""
    if name == "biresnerf":
        return BIRESNERF
    return getattr(importlib.import_module(BASELINES), name.upper().replace("-", "_"))


@dataclass(frozen=True)
class Recipe:
    """How a field and poses are trained: the options, the method, and where it is computed."""

    options: ResolvedOptions
    method: Method
    device: torch.device
    threads: int

    @classmethod
    def of(
        cls, options: ResolvedOptions, device: torch.device, threads: int, method: Method | None = None
    ) -> Recipe:
        """The recipe with the method that the options name, if none is given."""
        return cls(options, method or find_method(options.method), device, threads)

    def changed(self, **options: int) -> Recipe:
        """The recipe with other values of some options."""
        return replace(self, options=self.options.model_copy(update=options))

    def apart(self, steps: int, coarse: tuple[int, int], samples: int) -> Recipe:
        """The recipe of a short training: its steps, bounds on those of stage 1, and the most samples of a step."""
        samples, (least, most) = min(samples, self.options.samples_per_step), coarse
        return self.changed(
            steps=steps, coarse_steps_min=least, coarse_steps_max=most, samples_per_step=samples
        )
